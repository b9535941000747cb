//! Particles of one graph sorted into the cells of a grid.
//!
//! Cells are numbered along x first, so the cells `x - 1 ..= x + 1` of a row hold one
//! contiguous run of sorted particles, and the neighbours of a cell lie in 3 such runs
//! (9 in three dimensions). The cost of a grid follows the particles and not the volume
//! they span: where it would have many more cells than particles, only the rows that
//! hold particles are stored.

use std::ops::Range;

use super::lanes::{LONGEST, Lanes, Work, widest};
use super::memory::{SHARE, collected};
use super::scalar::Scalar;
use super::sort::sort_by_cell;
use crate::threads::Team;

/// Particles that are worth the care for a group of cells: that takes longer than the search
/// among a few candidates more.
const WORTH: f64 = 5.0;

/// Most cells in a group.
const MOST_TOGETHER: f64 = 4.0;

/// Above this many cells per particle (plus a constant), or more than an `i32` counts, a grid stores
/// occupied rows only.
const MOST_CELLS_PER_PARTICLE: usize = 16;

/// The rows around a row, in three dimensions, twice where the x axis is periodic.
const MOST_RUNS: usize = 2 * 9;

pub(super) struct Grid<T, const D: usize> {
    axes: [Axis; D],
    rows: Rows<D>,
    /// Cells along x that are walked through together.
    together: u64,
    /// Coordinates in cell order, one array per axis, inside the box on periodic axes.
    pub coords: [Vec<T>; D],
    /// The caller's index of each sorted particle.
    pub index: Vec<i32>,
}

/// How one axis is cut into cells.
#[derive(Debug, Clone, Copy)]
struct Axis {
    origin: f64,
    cells_per_length: f64,
    count: u64,
    periodic: bool,
}

/// Where the cells of each row begin among the sorted particles. A row is named by its
/// number in `Dense` and by its position among the occupied rows in `Sparse`.
enum Rows<const D: usize> {
    Dense {
        /// First particle of each cell, and one past the last particle.
        starts: Vec<u32>,
    },
    Sparse {
        /// Cell coordinates of each row, x set to zero, in ascending order from the
        /// last axis to the first.
        keys: Vec<[u64; D]>,
        /// First particle of each row, and one past the last particle.
        starts: Vec<u32>,
        /// Cell of each particle along x.
        x: Vec<u64>,
    },
}

impl Axis {
    /// Cuts an axis into cells no smaller than the cutoff.
    ///
    /// Two particles closer than the cutoff must never lie more than one cell apart,
    /// whatever the rounding: the decision about an edge rounds a distance in
    /// `T`, relative to the cutoff on an open axis and to the period on a periodic one,
    /// and the cell rounds a coordinate in double precision, relative to the extent.
    /// Each is covered with room to spare by widening the cells as much.
    fn new<T: Scalar>(low: f64, high: f64, period: T, cutoff: f64) -> Self {
        let periodic = period.is_finite();
        let (origin, extent, slack) = if periodic {
            (0.0, period.to_f64(), 4.0 * T::EPSILON)
        } else {
            (low, high - low, 4.0 * f64::EPSILON)
        };
        let width = cutoff * (1.0 + 16.0 * T::EPSILON) + extent * slack;
        let count = if periodic {
            ((extent / width) as u64).max(1)
        } else {
            (extent / width) as u64 + 1
        };
        let cells_per_length = if periodic {
            count as f64 / extent
        } else {
            width.recip()
        };
        Self {
            origin,
            cells_per_length,
            count,
            periodic,
        }
    }

    #[inline(always)]
    fn cell<T: Scalar>(&self, x: T) -> u64 {
        // A conversion from floating point saturates, so rounding just below the
        // origin gives cell 0.
        let cell = ((x.to_f64() - self.origin) * self.cells_per_length) as i64 as u64;
        cell.min(self.count - 1)
    }

    /// The same where there are no more cells than an `i32` counts, which several coordinates at
    /// once are converted to.
    #[inline(always)]
    fn cell_of_few<T: Scalar>(&self, x: T) -> u32 {
        debug_assert!(self.count <= i32::MAX as u64);
        let cell = (x.to_f64() - self.origin) * self.cells_per_length;
        let cell = cell.greater(0.0).lesser((self.count - 1) as f64);
        // SAFETY: NaN, of an endless extent, has become 0, and a dense grid has at most `i32::MAX` cells.
        (unsafe { cell.to_int_unchecked::<i32>() }) as u32
    }

    /// The cells and those beside them, each once, as one run and on a periodic axis perhaps
    /// a second one.
    #[inline(always)]
    fn around(&self, cells: Range<u64>) -> [Range<u64>; 2] {
        let n = self.count;
        let (before, behind) = (cells.start.saturating_sub(1), cells.end + 1);
        if !self.periodic {
            [before..n.min(behind), 0..0]
        } else if cells.end - cells.start + 2 >= n {
            [0..n, 0..0]
        } else if cells.start == 0 {
            [0..behind, n - 1..n]
        } else if cells.end == n {
            [before..n, 0..1]
        } else {
            [before..behind, 0..0]
        }
    }
}

/// The numbers of the cells that hold `positions`, in a dense grid.
struct Numbers<'a, T, const D: usize> {
    axes: [Axis; D],
    positions: &'a [[T; D]],
}

impl<T: Scalar, const D: usize> Work for Numbers<'_, T, D> {
    type Output = Vec<u32>;

    #[inline(always)]
    fn run<const BLOCK: usize, L: Lanes<BLOCK>>(self, _: L) -> Vec<u32> {
        let Self { axes, positions } = self;
        let number = |p: &[T; D]| {
            (0..D).rev().fold(0, |row, a| {
                row * axes[a].count as u32 + axes[a].cell_of_few(p[a])
            })
        };
        positions.iter().map(number).collect()
    }
}

/// How many cells are walked through together for so many particles.
fn together<const D: usize>(axes: &[Axis; D], particles: usize) -> u64 {
    let cells: f64 = axes.iter().map(|axis| axis.count as f64).product();
    let together = (WORTH * cells / particles as f64).ceil();
    together.clamp(1.0, MOST_TOGETHER) as u64
}

impl<T: Scalar, const D: usize> Grid<T, D> {
    /// Sorts `positions` for searches up to `cutoff`; their caller's indices begin at
    /// `first`. Within a cell particles keep their order.
    pub fn new(
        positions: &[[T; D]],
        first: usize,
        period: &[T; D],
        cutoff: f64,
        team: &Team,
    ) -> Self {
        if period.iter().any(|length| length.is_finite()) {
            let wrapped = collected(team, positions.len(), |i| wrap(&positions[i], period));
            Self::from_wrapped(&wrapped, first, period, cutoff, team)
        } else {
            Self::from_wrapped(positions, first, period, cutoff, team)
        }
    }

    fn from_wrapped(
        positions: &[[T; D]],
        first: usize,
        period: &[T; D],
        cutoff: f64,
        team: &Team,
    ) -> Self {
        let shares = team.map(positions.chunks(SHARE).collect(), bounds);
        let (low, high) = shares
            .into_iter()
            .reduce(|(low, high), (lower, higher)| {
                (
                    std::array::from_fn(|a| low[a].min(lower[a])),
                    std::array::from_fn(|a| high[a].max(higher[a])),
                )
            })
            .unwrap_or(([0.0; D], [0.0; D]));
        let most = (MOST_CELLS_PER_PARTICLE * positions.len() + 1024).min(i32::MAX as usize);
        let axes: [Axis; D] =
            std::array::from_fn(|a| Axis::new(low[a], high[a], period[a], cutoff));
        let cells = axes.iter().map(|axis| axis.count as f64).product::<f64>();
        if cells <= most as f64 {
            Self::dense(positions, first, axes, cells as usize, team)
        } else {
            Self::sparse(positions, first, axes)
        }
    }

    fn dense(
        positions: &[[T; D]],
        first: usize,
        axes: [Axis; D],
        cells: usize,
        team: &Team,
    ) -> Self {
        let numbers = |particles: Range<usize>| {
            widest(Numbers {
                axes,
                positions: &positions[particles],
            })
        };
        let sorted = sort_by_cell(positions, first, cells, numbers, team);
        Self {
            together: together(&axes, positions.len()),
            axes,
            rows: Rows::Dense {
                starts: sorted.starts,
            },
            coords: sorted.coords,
            index: sorted.index,
        }
    }

    fn sparse(positions: &[[T; D]], first: usize, axes: [Axis; D]) -> Self {
        // Cell coordinates from the last axis to the first, then the index.
        let mut order: Vec<([u64; D], u32)> = (0_u32..)
            .zip(positions)
            .map(|(i, p)| {
                (
                    std::array::from_fn(|a| axes[D - 1 - a].cell(p[D - 1 - a])),
                    i,
                )
            })
            .collect();
        order.sort_unstable();
        let mut keys = Vec::new();
        let mut starts = Vec::new();
        for (slot, &(mut key, _)) in (0_u32..).zip(&order) {
            key[D - 1] = 0;
            if keys.last() != Some(&key) {
                keys.push(key);
                starts.push(slot);
            }
        }
        starts.push(order.len() as u32);
        let x = order.iter().map(|(key, _)| key[D - 1]).collect();
        Self {
            together: together(&axes, positions.len()),
            axes,
            rows: Rows::Sparse { keys, starts, x },
            coords: std::array::from_fn(|a| {
                let sorted = order.iter().map(|&(_, i)| positions[i as usize][a]);
                sorted.chain([T::default(); LONGEST]).collect()
            }),
            index: order
                .iter()
                .map(|&(_, i)| (first + i as usize) as i32)
                .chain([0; LONGEST])
                .collect(),
        }
    }

    /// The caller's indices of the sorted particles.
    pub fn index(&self) -> &[i32] {
        &self.index[..self.index.len() - LONGEST]
    }

    /// A lower bound of the number of ordered pairs, no particle with itself, that are
    /// at most `radius` apart, from the occupation of the cells alone.
    ///
    /// A cell can be cut into p boxes with no diagonal longer than the radius. All pairs
    /// within a box are near, and n particles in p boxes make at least n^2 / p of them.
    pub fn pairs_at_least(&self, radius: f64) -> usize {
        let boxes: f64 = self
            .axes
            .iter()
            .map(|axis| {
                ((D as f64).sqrt() / (axis.cells_per_length * radius))
                    .ceil()
                    .max(1.0)
            })
            .product();
        let square = |n: usize| n as u64 * n as u64;
        let pairs: u64 = match &self.rows {
            Rows::Dense { starts } => starts
                .windows(2)
                .map(|cell| square((cell[1] - cell[0]) as usize))
                .sum(),
            Rows::Sparse { starts, x, .. } => starts
                .windows(2)
                .flat_map(|row| x[row[0] as usize..row[1] as usize].chunk_by(u64::eq))
                .map(|cell| square(cell.len()))
                .sum(),
        };
        ((pairs as f64 / boxes) as usize).saturating_sub(self.index().len())
    }

    /// Goes through the sorted particles `slots`, group of cells after group.
    pub fn cells(&self, slots: Range<usize>) -> Cells<'_, T, D> {
        Cells {
            grid: self,
            slots,
            row: 0,
            row_end: 0,
            x: 0,
            neighbours: Vec::new(),
            runs: std::array::from_fn(|_| 0..0),
            run_count: 0,
        }
    }

    /// The rows around `row`, itself included, each once.
    fn neighbour_rows(&self, row: usize, neighbours: &mut Vec<usize>) {
        neighbours.clear();
        let y_axis = &self.axes[1];
        let [y, z] = match &self.rows {
            Rows::Dense { .. } => [row as u64 % y_axis.count, row as u64 / y_axis.count],
            Rows::Sparse { keys, .. } => {
                let key = &keys[row];
                if D == 2 {
                    [key[0], 0]
                } else {
                    [key[1], key[0]]
                }
            }
        };
        let z_runs = if D == 3 {
            self.axes[2].around(z..z + 1)
        } else {
            [0..1, 0..0]
        };
        for z in z_runs.into_iter().flatten() {
            for y in y_axis.around(y..y + 1).into_iter().flatten() {
                match &self.rows {
                    Rows::Dense { .. } => neighbours.push((z * y_axis.count + y) as usize),
                    Rows::Sparse { keys, .. } => {
                        let mut key = [0; D];
                        key[D - 2] = y;
                        if D == 3 {
                            key[0] = z;
                        }
                        neighbours.extend(keys.binary_search(&key));
                    }
                }
            }
        }
    }
}

/// A walk through the cells of some sorted particles.
pub(super) struct Cells<'a, T, const D: usize> {
    grid: &'a Grid<T, D>,
    /// The particles still to come.
    slots: Range<usize>,
    row: usize,
    row_end: usize,
    x: u64,
    /// The rows around `row`.
    neighbours: Vec<usize>,
    runs: [Range<usize>; MOST_RUNS],
    run_count: usize,
}

impl<T: Scalar, const D: usize> Cells<'_, T, D> {
    /// The runs of sorted particles that hold every particle within the cutoff of any in
    /// the group, each once.
    #[inline(always)]
    pub fn runs(&self) -> &[Range<usize>] {
        &self.runs[..self.run_count]
    }

    /// The particles of the next group of cells, whose surroundings are then in [`Self::runs`].
    #[inline(always)]
    pub fn next(&mut self) -> Option<Range<usize>> {
        let Grid { axes, rows, .. } = self.grid;
        let start = self.slots.start;
        if start >= self.slots.end {
            return None;
        }
        if start >= self.row_end {
            self.row = rows.row_of(start, axes);
            self.row_end = rows.cell_start(self.row, axes[0].count, axes);
            self.x = 0;
            self.grid.neighbour_rows(self.row, &mut self.neighbours);
        }
        let end = match rows {
            Rows::Dense { starts } => {
                let length = axes[0].count as usize;
                let cell_start = |row: usize, x: u64| starts[row * length + x as usize] as usize;
                self.x = (self.x..)
                    .find(|&x| cell_start(self.row, x + 1) > start)
                    .expect("a row ends after its particles");
                self.reach(cell_start)
            }
            Rows::Sparse { x, .. } => {
                self.x = x[start];
                self.reach(|row, x| rows.cell_start(row, x, axes))
            }
        };
        self.slots.start = end.min(self.slots.end);
        Some(start..self.slots.start)
    }

    /// Holds the runs around the group of cells that begins at [`Self::x`] in this row, where a
    /// row's particles from a cell on begin at `cell_start`; returns where the group ends.
    #[inline(always)]
    fn reach(&mut self, cell_start: impl Fn(usize, u64) -> usize) -> usize {
        let x_axis = &self.grid.axes[0];
        let cells = self.x..(self.x + self.grid.together).min(x_axis.count);
        let mut count = 0;
        for reached in x_axis.around(cells.clone()) {
            if !reached.is_empty() {
                for &row in &self.neighbours {
                    self.runs[count] = cell_start(row, reached.start)..cell_start(row, reached.end);
                    count += 1;
                }
            }
        }
        self.run_count = count;
        cell_start(self.row, cells.end)
    }
}

impl<const D: usize> Rows<D> {
    /// The row that holds a particle.
    fn row_of(&self, slot: usize, axes: &[Axis; D]) -> usize {
        let starting = |starts: &[u32]| starts.partition_point(|&s| s as usize <= slot) - 1;
        match self {
            Rows::Dense { starts } => starting(starts) / axes[0].count as usize,
            Rows::Sparse { starts, .. } => starting(starts),
        }
    }

    /// The first particle of `row` whose cell along x is at least `x`.
    #[inline(always)]
    fn cell_start(&self, row: usize, x: u64, axes: &[Axis; D]) -> usize {
        match self {
            Rows::Dense { starts } => starts[row * axes[0].count as usize + x as usize] as usize,
            Rows::Sparse {
                starts, x: cells, ..
            } => {
                let (begin, end) = (starts[row] as usize, starts[row + 1] as usize);
                begin + cells[begin..end].partition_point(|&cell| cell < x)
            }
        }
    }
}

pub(super) fn bounds<T: Scalar, const D: usize>(positions: &[[T; D]]) -> ([f64; D], [f64; D]) {
    let Some(&first) = positions.first() else {
        return ([0.0; D], [0.0; D]);
    };
    // Several bounds side by side, none of which waits for another.
    const SIDE: usize = 4;
    let (mut lows, mut highs) = ([first; SIDE], [first; SIDE]);
    let mut take = |s: usize, p: &[T; D]| {
        for a in 0..D {
            lows[s][a] = lows[s][a].lesser(p[a]);
            highs[s][a] = highs[s][a].greater(p[a]);
        }
    };
    let (blocks, rest) = positions.as_chunks::<SIDE>();
    for block in blocks {
        for s in 0..SIDE {
            take(s, &block[s]);
        }
    }
    for p in rest {
        take(0, p);
    }
    let fold = |side: [[T; D]; SIDE], pick: fn(T, T) -> T| {
        std::array::from_fn(|a| side.iter().map(|p| p[a]).fold(first[a], pick).to_f64())
    };
    (fold(lows, T::lesser), fold(highs, T::greater))
}

/// Moves a position into the box along its periodic axes.
pub(super) fn wrap<T: Scalar, const D: usize>(position: &[T; D], period: &[T; D]) -> [T; D] {
    std::array::from_fn(|a| {
        if !period[a].is_finite() {
            return position[a];
        }
        let (x, length) = (position[a].to_f64(), period[a].to_f64());
        // Rounding may give the period itself, never more, which is the box's other end.
        T::from_f64((x - length * (x / length).floor()).clamp(0.0, length))
    })
}
