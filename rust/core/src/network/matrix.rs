//! Products of matrices that fit the cache.

use super::rows::vectorized;

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
        assert!(first + count <= self.columns && self.column_stride == 1);
        Self {
            data: self.data.get(first..).unwrap_or_default(),
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

vectorized! {
    /// `out`, whose rows are `stride` numbers apart, becomes `start` plus the product of `a` and
    /// `b`, whose rows must be contiguous.
    kinds product(
        out: &mut [f32],
        stride: usize,
        start: Start<'_>,
        a: Matrix<'_>,
        b: Matrix<'_>,
    )
    // Tiles as large as the registers hold.
    [
        v4 => tiles::<std::arch::x86_64::__m512, 8, 2>(out, stride, start, a, b),
        v3 => tiles::<std::arch::x86_64::__m256, 6, 2>(out, stride, start, a, b),
        plain => tiles::<[f32; 4], 4, 2>(out, stride, start, a, b),
    ]
}

/// Some numbers in one register. Only for processors that have such.
trait Vector: Copy {
    const LANES: usize;
    /// # Safety
    /// The processor has such registers; `LANES` numbers are at `from`.
    unsafe fn load(from: *const f32) -> Self;
    /// # Safety
    /// The processor has such registers; there is room for `LANES` numbers at `to`.
    unsafe fn store(self, to: *mut f32);
    /// # Safety
    /// The processor has such registers.
    unsafe fn all(number: f32) -> Self;
    /// `self + a * b`
    /// # Safety
    /// The processor has such registers.
    unsafe fn add_product(self, a: Self, b: Self) -> Self;
}

impl<const N: usize> Vector for [f32; N] {
    const LANES: usize = N;

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: as promised.
        unsafe { *from.cast() }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: as promised.
        unsafe { *to.cast() = self }
    }

    #[inline(always)]
    unsafe fn all(number: f32) -> Self {
        [number; N]
    }

    #[inline(always)]
    unsafe fn add_product(self, a: Self, b: Self) -> Self {
        std::array::from_fn(|i| self[i] + a[i] * b[i])
    }
}

/// A [`Vector`] by four intrinsics.
#[cfg(target_arch = "x86_64")]
macro_rules! vector {
    ($($kind:ident $lanes:literal $load:ident $store:ident $all:ident $add_product:ident,)*) => {
        $(impl Vector for std::arch::x86_64::$kind {
            const LANES: usize = $lanes;

            #[inline(always)]
            unsafe fn load(from: *const f32) -> Self {
                // SAFETY: as promised.
                unsafe { std::arch::x86_64::$load(from) }
            }

            #[inline(always)]
            unsafe fn store(self, to: *mut f32) {
                // SAFETY: as promised.
                unsafe { std::arch::x86_64::$store(to, self) }
            }

            #[inline(always)]
            unsafe fn all(number: f32) -> Self {
                // SAFETY: as promised.
                unsafe { std::arch::x86_64::$all(number) }
            }

            #[inline(always)]
            unsafe fn add_product(self, a: Self, b: Self) -> Self {
                // SAFETY: as promised.
                unsafe { std::arch::x86_64::$add_product(a, b, self) }
            }
        })*
    };
}
#[cfg(target_arch = "x86_64")]
vector! {
    __m512 16 _mm512_loadu_ps _mm512_storeu_ps _mm512_set1_ps _mm512_fmadd_ps,
    __m256 8 _mm256_loadu_ps _mm256_storeu_ps _mm256_set1_ps _mm256_fmadd_ps,
}

/// A product to be taken: `out`, of rows `stride` apart, begins with `start` and gets `a` times `b`.
#[derive(Clone, Copy)]
struct Task<'a> {
    out: *mut f32,
    stride: usize,
    start: Start<'a>,
    a: Matrix<'a>,
    b: Matrix<'a>,
}

/// Tile by tile of `R` rows, at most 8, and `C` vectors.
#[inline(always)]
fn tiles<V: Vector, const R: usize, const C: usize>(
    out: &mut [f32],
    stride: usize,
    start: Start<'_>,
    a: Matrix<'_>,
    b: Matrix<'_>,
) {
    let (rows, columns) = (a.rows, b.columns);
    assert_eq!(a.columns, b.rows, "inner sizes");
    if rows == 0 || columns == 0 {
        return;
    }
    assert!(a.extent() <= a.data.len() && b.extent() <= b.data.len() && b.column_stride == 1);
    assert!(columns <= stride && (rows - 1) * stride + columns <= out.len());
    if let Start::Row(row) = start {
        assert!(columns <= row.len());
    }
    let task = Task {
        out: out.as_mut_ptr(),
        stride,
        start,
        a,
        b,
    };
    let mut column = 0;
    // SAFETY: as just asserted, all that is read and written lies in the slices; the caller has
    // chosen vectors that the processor has.
    unsafe {
        while column + C * V::LANES <= columns {
            strip::<V, R, C>(task, column);
            column += C * V::LANES;
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
    } = task;
    // SAFETY: rows `row..row + R` and the vectors from `column` are inside, as the callers see to;
    // `out` overlaps neither matrix, being borrowed alone.
    unsafe {
        let out = out.add(row * stride + column);
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
        for i in 0..R {
            for j in 0..C {
                sums[i][j].store(out.add(i * stride + j * V::LANES));
            }
        }
    }
}
