//! Products of matrices that fit the cache.

use super::rows::vectorized;
use super::vector::Vector;

/// Numbers read where they lie.
#[derive(Clone, Copy)]
pub(super) struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// Rows of `columns` numbers, one after the other.
    pub fn new(data: &'a [f32], columns: usize) -> Self {
        Self {
            data,
            rows: data.len() / columns,
            columns,
            row_stride: columns,
            column_stride: 1,
        }
    }

    /// The columns from `first` to `first + count`.
    pub fn columns(self, first: usize, count: usize) -> Self {
        assert!(first + count <= self.columns);
        Self {
            data: (self.data.get(first * self.column_stride..)).unwrap_or_default(),
            columns: count,
            ..self
        }
    }

    /// The rows from `first` to `first + count`.
    pub fn rows(self, first: usize, count: usize) -> Self {
        assert!(first + count <= self.rows);
        Self {
            data: &self.data[first * self.row_stride..],
            rows: count,
            ..self
        }
    }

    /// The same numbers with rows for columns.
    pub fn transposed(self) -> Self {
        Self {
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
            ..self
        }
    }

    /// How many rows and columns.
    pub fn size(&self) -> (usize, usize) {
        (self.rows, self.columns)
    }

    /// How far rows are apart, and columns.
    pub fn strides(&self) -> (usize, usize) {
        (self.row_stride, self.column_stride)
    }

    /// All numbers from the first to the last, as they lie.
    pub fn numbers(&self) -> &'a [f32] {
        &self.data[..self.extent()]
    }

    /// The same of other numbers that lie as its own do.
    pub fn with(self, numbers: &[f32]) -> Matrix<'_> {
        assert_eq!(numbers.len(), self.extent());
        Matrix {
            data: numbers,
            ..self
        }
    }

    /// Copies them to the rows of `out`, `stride` apart: square by square, since of rows and
    /// columns one lies across the lines of the cache.
    pub fn copy_to(&self, out: &mut [f32], stride: usize) {
        const SQUARE: usize = 16;
        let Self {
            rows,
            columns,
            row_stride,
            column_stride,
            ..
        } = *self;
        if rows == 0 || columns == 0 {
            return;
        }
        assert!(self.extent() <= self.data.len());
        assert!(columns <= stride && (rows - 1) * stride + columns <= out.len());
        let (data, out) = (self.data.as_ptr(), out.as_mut_ptr());
        for row in (0..rows).step_by(SQUARE) {
            for column in (0..columns).step_by(SQUARE) {
                for i in row..rows.min(row + SQUARE) {
                    for j in column..columns.min(column + SQUARE) {
                        // SAFETY: row i and column j are inside both, as asserted.
                        unsafe {
                            *out.add(i * stride + j) =
                                *data.add(i * row_stride + j * column_stride);
                        }
                    }
                }
            }
        }
    }

    /// How many numbers from the first to behind the last.
    fn extent(&self) -> usize {
        if self.rows == 0 || self.columns == 0 {
            return 0;
        }
        (self.rows - 1) * self.row_stride + (self.columns - 1) * self.column_stride + 1
    }
}

/// What a product is added to.
#[derive(Clone, Copy)]
pub(super) enum Start<'a> {
    /// What is there.
    There,
    /// Nothing.
    Zero,
    /// In every row, these numbers.
    Row(&'a [f32]),
}

/// What becomes of a product's numbers on their way into memory.
#[derive(Clone, Copy)]
pub(super) enum End<'a> {
    /// They stay.
    Whole,
    /// Negative ones become 0; NaN stays.
    Relu,
    /// All become 0 but where these numbers, laid out like the product's, are positive.
    WherePositive(&'a [f32]),
}

vectorized! {
    /// `out`, whose rows are `stride` numbers apart, becomes `start` plus the product of `a` and
    /// `b`, whose rows must be contiguous, and then what `end` says.
    fn product(
        out: &mut [f32],
        stride: usize,
        start: Start<'_>,
        a: Matrix<'_>,
        b: Matrix<'_>,
        end: End<'_>,
    ) {
        const TILE: (usize, usize) = <Lanes as Vector>::TILE;
        // SAFETY: the processor has the vectors that this is compiled for.
        unsafe { tiles::<Lanes, { TILE.0 }, { TILE.1 }>(out, stride, start, a, b, end) }
    }
}

/// A product to be taken: `out`, of rows `stride` apart, begins with `start`, gets `a` times `b`
/// and becomes what `end` says.
#[derive(Clone, Copy)]
struct Task<'a> {
    out: *mut f32,
    stride: usize,
    start: Start<'a>,
    a: Matrix<'a>,
    b: Matrix<'a>,
    end: End<'a>,
}

/// Tile by tile of `R` rows, at most 8, and `C` vectors.
///
/// # Safety
/// The processor has such vectors.
#[inline(always)]
unsafe fn tiles<V: Vector, const R: usize, const C: usize>(
    out: &mut [f32],
    stride: usize,
    start: Start<'_>,
    a: Matrix<'_>,
    b: Matrix<'_>,
    end: End<'_>,
) {
    let (rows, columns) = (a.rows, b.columns);
    assert_eq!(a.columns, b.rows, "inner sizes");
    if rows == 0 || columns == 0 {
        return;
    }
    assert!(a.columns > 0, "nothing to sum");
    assert!(a.extent() <= a.data.len() && b.extent() <= b.data.len() && b.column_stride == 1);
    let extent = (rows - 1) * stride + columns;
    assert!(columns <= stride && extent <= out.len());
    if let Start::Row(row) = start {
        assert!(columns <= row.len());
    }
    if let End::WherePositive(like) = end {
        assert!(extent <= like.len());
    }
    let task = Task {
        out: out.as_mut_ptr(),
        stride,
        start,
        a,
        b,
        end,
    };
    let mut column = 0;
    // SAFETY: as just asserted, all that is read and written lies in the slices.
    unsafe {
        while column + C * V::LANES <= columns {
            strip::<V, R, C>(task, column);
            column += C * V::LANES;
        }
        if C > 2 && column + 2 * V::LANES <= columns {
            strip::<V, R, 2>(task, column);
            column += 2 * V::LANES;
        }
        while column + V::LANES <= columns {
            strip::<V, R, 1>(task, column);
            column += V::LANES;
        }
        while column < columns {
            strip::<[f32; 1], R, 1>(task, column);
            column += 1;
        }
    }
}

/// All rows of `C` vectors of columns from `column`.
///
/// # Safety
/// The processor has such vectors, and the numbers of the task are there.
#[inline(always)]
unsafe fn strip<V: Vector, const R: usize, const C: usize>(task: Task<'_>, column: usize) {
    const { assert!(R <= 8, "less than eight rows are left") };
    let mut row = 0;
    // SAFETY: handed on.
    unsafe {
        while row + R <= task.a.rows {
            tile::<V, R, C>(task, row, column);
            row += R;
        }
        if row + 4 <= task.a.rows {
            tile::<V, 4, C>(task, row, column);
            row += 4;
        }
        if row + 2 <= task.a.rows {
            tile::<V, 2, C>(task, row, column);
            row += 2;
        }
        if row < task.a.rows {
            tile::<V, 1, C>(task, row, column);
        }
    }
}

/// # Safety
/// The processor has such vectors, and the numbers of the task are there.
#[inline(always)]
unsafe fn tile<V: Vector, const R: usize, const C: usize>(
    task: Task<'_>,
    row: usize,
    column: usize,
) {
    let Task {
        out,
        stride,
        start,
        a,
        b,
        end,
    } = task;
    // SAFETY: rows `row..row + R` and the vectors from `column` are inside, as the callers see to;
    // `out` overlaps neither matrix, being borrowed alone.
    unsafe {
        let first = row * stride + column;
        let out = out.add(first);
        let mut sums = [[V::all(0.0); C]; R];
        for i in 0..R {
            for j in 0..C {
                match start {
                    Start::There => sums[i][j] = V::load(out.add(i * stride + j * V::LANES)),
                    Start::Zero => {}
                    Start::Row(row) => {
                        sums[i][j] = V::load(row.as_ptr().add(column + j * V::LANES));
                    }
                }
            }
        }
        let left = a.data.as_ptr().add(row * a.row_stride);
        let right = b.data.as_ptr().add(column);
        for k in 0..a.columns {
            let mut of_b = [V::all(0.0); C];
            for j in 0..C {
                of_b[j] = V::load(right.add(k * b.row_stride + j * V::LANES));
            }
            for i in 0..R {
                let of_a = V::all(*left.add(i * a.row_stride + k * a.column_stride));
                for j in 0..C {
                    sums[i][j] = sums[i][j].add_product(of_a, of_b[j]);
                }
            }
        }
        match end {
            End::Whole => {}
            End::Relu => sums = sums.map(|row| row.map(|sum| sum.relu())),
            End::WherePositive(like) => {
                let like = like.as_ptr().add(first);
                for i in 0..R {
                    for j in 0..C {
                        let of_like = V::load(like.add(i * stride + j * V::LANES));
                        sums[i][j] = sums[i][j].where_positive(of_like);
                    }
                }
            }
        }
        for i in 0..R {
            for j in 0..C {
                sums[i][j].store(out.add(i * stride + j * V::LANES));
            }
        }
    }
}
