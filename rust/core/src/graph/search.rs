//! The search for all pairs within a cutoff: the inner loop of the radius graphs.
//!
//! Candidates are looked at in blocks of constant size, without a branch that depends on
//! whether one is near: such branches are mispredicted about once per neighbour, and cost
//! more than the arithmetic.

use std::ops::Range;

use super::edges::Rows;
use super::grid::Grid;
use super::input::Batch;
use super::lanes::{LONGEST, Lanes, Work, widest};
use super::memory::{Budget, collected};
use super::scalar::Scalar;
use crate::Error;
use crate::threads::Team;

/// A checked [`Radius`](super::Radius).
pub(super) enum Cutoff<T> {
    Uniform(T),
    PerParticle {
        radii: Vec<T>,
        shortest: T,
        longest: T,
    },
}

/// One graph, sorted and ready to be searched.
pub(super) struct Search<T, const D: usize> {
    grid: Grid<T, D>,
    period: [T; D],
    /// The largest squared cutoff.
    limit: T,
    /// Where each particle has its own, those in cell order, with room for a block at the end; else
    /// empty.
    limits: Vec<T>,
}

impl<T: Scalar, const D: usize> Search<T, D> {
    pub fn new(
        batch: &Batch<'_, T, D>,
        graph: Range<usize>,
        cutoff: &Cutoff<T>,
        team: &Team,
        budget: &Budget,
    ) -> Result<Self, Error> {
        let &(Cutoff::Uniform(shortest) | Cutoff::PerParticle { shortest, .. }) = cutoff;
        let &(Cutoff::Uniform(longest) | Cutoff::PerParticle { longest, .. }) = cutoff;
        let grid = Grid::new(
            &batch.positions[graph.clone()],
            graph.start,
            &batch.period,
            longest.to_f64(),
            team,
        );
        budget.check(grid.pairs_at_least(shortest.to_f64()))?;
        let limits = match cutoff {
            Cutoff::Uniform(_) => Vec::new(),
            Cutoff::PerParticle { radii, .. } => {
                let index = grid.index();
                collected(team, index.len() + LONGEST, |slot| {
                    let r = index.get(slot).map_or(T::default(), |&i| radii[i as usize]);
                    r * r
                })
            }
        };
        Ok(Self {
            grid,
            period: batch.period,
            limit: longest * longest,
            limits,
        })
    }

    /// The caller's indices of the sorted particles.
    pub fn index(&self) -> &[i32] {
        self.grid.index()
    }

    /// The rows of the sorted particles `slots`, every one among its own neighbours.
    pub fn run(&self, slots: Range<usize>, budget: &Budget) -> Result<Rows, Error> {
        let periodic = self.period.iter().any(|length| length.is_finite());
        match (periodic, self.limits.is_empty()) {
            (false, true) => self.pass::<false, true>(slots, budget),
            (false, _) => self.pass::<false, false>(slots, budget),
            (true, true) => self.pass::<true, true>(slots, budget),
            (true, _) => self.pass::<true, false>(slots, budget),
        }
    }

    fn pass<const PERIODIC: bool, const UNIFORM: bool>(
        &self,
        slots: Range<usize>,
        budget: &Budget,
    ) -> Result<Rows, Error> {
        widest(Pass::<T, D, PERIODIC, UNIFORM> {
            search: self,
            slots,
            budget,
        })
    }
}

/// The search of some of the sorted particles.
struct Pass<'a, T, const D: usize, const PERIODIC: bool, const UNIFORM: bool> {
    search: &'a Search<T, D>,
    slots: Range<usize>,
    budget: &'a Budget,
}

impl<T: Scalar, const D: usize, const PERIODIC: bool, const UNIFORM: bool> Work
    for Pass<'_, T, D, PERIODIC, UNIFORM>
{
    type Output = Result<Rows, Error>;

    #[inline(always)]
    fn run<const BLOCK: usize, L: Lanes<BLOCK>>(self, lanes: L) -> Self::Output {
        let mut rows = Rows::with_receivers(self.slots.len());
        let mut cells = self.search.grid.cells(self.slots);
        // Those of the next group are gathered before those of this one are looked at, since what
        // was just written can't be read in other blocks for a while.
        let (mut candidates, mut coming) = (Candidates::new(), Candidates::new());
        let mut receivers = 0..0;
        loop {
            let next = cells.next();
            if next.is_some() {
                coming.gather::<BLOCK, UNIFORM>(self.search, cells.runs());
            }
            for receiver in receivers {
                let row = rows.next(candidates.count, self.budget)?.as_mut_ptr();
                let mut n = 0;
                candidates.near::<BLOCK, _, PERIODIC, UNIFORM>(
                    lanes,
                    self.search,
                    receiver,
                    // SAFETY: the row has room for a block behind all candidates.
                    |near, senders| n += unsafe { lanes.append(near, senders, row.add(n).cast()) },
                );
                rows.finish(n);
            }
            let Some(next) = next else { break };
            receivers = next;
            std::mem::swap(&mut candidates, &mut coming);
        }
        rows.trim();
        Ok(rows)
    }
}

/// The particles around a group of cells, packed, so that every particle of the group goes
/// through the same whole blocks.
struct Candidates<T, const D: usize> {
    count: usize,
    /// Room for a block behind the candidates; there x is NaN, which is near to nothing.
    coords: [Vec<T>; D],
    /// Squared cutoffs, where each particle has its own.
    limits: Vec<T>,
    /// The caller's indices.
    index: Vec<i32>,
}

impl<T: Scalar, const D: usize> Candidates<T, D> {
    fn new() -> Self {
        Self {
            count: 0,
            coords: std::array::from_fn(|_| Vec::new()),
            limits: Vec::new(),
            index: Vec::new(),
        }
    }

    /// Holds the sorted particles `runs` instead.
    #[inline(always)]
    fn gather<const BLOCK: usize, const UNIFORM: bool>(
        &mut self,
        search: &Search<T, D>,
        runs: &[Range<usize>],
    ) {
        self.count = runs.iter().map(|run| run.end - run.start).sum();
        let room = self.count + BLOCK;
        if self.index.len() < room {
            for coords in &mut self.coords {
                coords.resize(2 * room, T::default());
            }
            self.limits.resize(2 * room, T::default());
            self.index.resize(2 * room, 0);
        }
        let mut end = 0;
        for run in runs {
            // One block at least, since few runs are longer.
            let (mut from, mut to) = (run.start, end);
            loop {
                // SAFETY: there is room for a block behind the sorted particles and behind
                // the candidates.
                unsafe {
                    for (coords, sorted) in self.coords.iter_mut().zip(&search.grid.coords) {
                        copy_block::<BLOCK, _>(sorted, from, coords, to);
                    }
                    copy_block::<BLOCK, _>(&search.grid.index, from, &mut self.index, to);
                    if !UNIFORM {
                        copy_block::<BLOCK, _>(&search.limits, from, &mut self.limits, to);
                    }
                }
                (from, to) = (from + BLOCK, to + BLOCK);
                if from >= run.end {
                    break;
                }
            }
            end += run.end - run.start;
        }
        let behind = self.coords[0][end..].first_chunk_mut::<BLOCK>();
        *behind.expect("room for a block") = [T::NAN; BLOCK];
    }

    /// Tells `found`, block after block, which candidates are within the cutoff of the sorted
    /// particle `receiver`, one bit each, and who they are.
    #[inline(always)]
    fn near<const BLOCK: usize, L: Lanes<BLOCK>, const PERIODIC: bool, const UNIFORM: bool>(
        &self,
        lanes: L,
        search: &Search<T, D>,
        receiver: usize,
        mut found: impl FnMut(u16, &[i32; BLOCK]),
    ) {
        let here: [T; D] = std::array::from_fn(|a| search.grid.coords[a][receiver]);
        let limit = if UNIFORM {
            search.limit
        } else {
            search.limits[receiver]
        };
        for start in (0..self.count).step_by(BLOCK) {
            let mut distances = [T::default(); BLOCK];
            for a in 0..D {
                // SAFETY: there is room for a block behind the candidates.
                let there: &[T; BLOCK] = unsafe { block(&self.coords[a], start) };
                for l in 0..BLOCK {
                    let d = separation::<T, PERIODIC>(here[a], there[l], search.period[a]);
                    distances[l] = distances[l] + d * d;
                }
            }
            let near = if UNIFORM {
                lanes.at_most(&distances, &[limit; BLOCK])
            } else {
                // SAFETY: as above.
                let theirs: &[T; BLOCK] = unsafe { block(&self.limits, start) };
                lanes.at_most(&distances, &theirs.map(|theirs| theirs.greater(limit)))
            };
            // SAFETY: as above.
            found(near, unsafe { block(&self.index, start) });
        }
    }
}

/// Distance along one axis, up to its sign: on a periodic one to the nearest image of a
/// position that is inside the box like the other. Swapping the two changes nothing but
/// the sign, so both directions of a pair fall the same way.
#[inline(always)]
pub(super) fn separation<T: Scalar, const PERIODIC: bool>(from: T, to: T, period: T) -> T {
    let d = from - to;
    if PERIODIC {
        let d = d.abs();
        d.lesser(period - d)
    } else {
        d
    }
}

/// The block of `values` from `start` on.
///
/// # Safety
/// There are that many.
#[inline(always)]
unsafe fn block<const BLOCK: usize, T>(values: &[T], start: usize) -> &[T; BLOCK] {
    debug_assert!(start + BLOCK <= values.len());
    // SAFETY: promised by the caller.
    unsafe { &*values.as_ptr().add(start).cast() }
}

/// Copies the block of `from` at `start` to that of `to` at `end`.
///
/// # Safety
/// There are such blocks.
#[inline(always)]
unsafe fn copy_block<const BLOCK: usize, T: Copy>(
    from: &[T],
    start: usize,
    to: &mut [T],
    end: usize,
) {
    debug_assert!(end + BLOCK <= to.len());
    // SAFETY: promised by the caller.
    unsafe {
        to.as_mut_ptr()
            .add(end)
            .cast::<[T; BLOCK]>()
            .write_unaligned(*block::<BLOCK, _>(from, start))
    };
}
