//! The search for all pairs within a cutoff: the inner loop of the radius graphs.
//!
//! Candidates are looked at in blocks of constant size, without a branch that depends on
//! whether one is near: such branches are mispredicted about once per neighbour, and cost
//! more than the arithmetic.

use std::ops::Range;

use super::edges::Rows;
use super::grid::Grid;
use super::input::Batch;
use super::lanes::{BLOCK, Lanes, Work, widest};
use super::memory::Budget;
use super::scalar::Scalar;
use crate::Error;

/// A checked [`Radius`](super::Radius).
#[derive(Clone, Copy)]
pub(super) enum Cutoff<'a, T> {
    Uniform(T),
    PerParticle(&'a [T]),
}

/// One graph, sorted and ready to be searched.
pub(super) struct Search<T, const D: usize> {
    grid: Grid<T, D>,
    period: [T; D],
    limits: Limits<T>,
}

/// Squared cutoffs.
enum Limits<T> {
    Uniform(T),
    /// In cell order, with room for a block at the end.
    PerParticle(Vec<T>),
}

impl<T: Scalar, const D: usize> Search<T, D> {
    pub fn new(
        batch: &Batch<'_, T, D>,
        graph: Range<usize>,
        cutoff: Cutoff<'_, T>,
        budget: &Budget,
    ) -> Result<Self, Error> {
        let (shortest, longest) = match cutoff {
            Cutoff::Uniform(r) => (r, r),
            Cutoff::PerParticle(radii) => radii[graph.clone()]
                .iter()
                .fold((T::INFINITY, T::default()), |(shortest, longest), &r| {
                    (shortest.lesser(r), longest.greater(r))
                }),
        };
        let grid = Grid::new(
            &batch.positions[graph.clone()],
            graph.start,
            &batch.period,
            longest.to_f64(),
        );
        budget.check(grid.pairs_at_least(shortest.to_f64()))?;
        let limits = match cutoff {
            Cutoff::Uniform(r) => Limits::Uniform(r * r),
            Cutoff::PerParticle(radii) => {
                let squares = grid.index().iter().map(|&i| {
                    let r = radii[i as usize];
                    r * r
                });
                Limits::PerParticle(squares.chain([T::default(); BLOCK]).collect())
            }
        };
        Ok(Self {
            grid,
            period: batch.period,
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
        match (periodic, &self.limits) {
            (false, Limits::Uniform(_)) => self.pass::<false, true>(slots, budget),
            (false, _) => self.pass::<false, false>(slots, budget),
            (true, Limits::Uniform(_)) => self.pass::<true, true>(slots, budget),
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

    /// A function that tells which sorted particles are within the cutoff of `receiver`:
    /// one bit for each of the block from a sorted particle on.
    #[inline(always)]
    fn near<const PERIODIC: bool, const UNIFORM: bool>(
        &self,
        receiver: usize,
    ) -> impl Fn(usize) -> u8 {
        let coords: [&[T]; D] = std::array::from_fn(|a| &self.grid.coords[a][..]);
        let here = coords.map(|coords| coords[receiver]);
        let period = self.period;
        let (limit, limits) = match &self.limits {
            &Limits::Uniform(limit) => (limit, &[][..]),
            Limits::PerParticle(limits) => (limits[receiver], &limits[..]),
        };
        move |start| {
            let mut distances = [T::default(); BLOCK];
            for a in 0..D {
                // SAFETY: the arrays have room for a block behind the last particle.
                let there = unsafe { block(coords[a], start) };
                for l in 0..BLOCK {
                    let d = separation::<T, PERIODIC>(here[a], there[l], period[a]);
                    distances[l] = distances[l] + d * d;
                }
            }
            if UNIFORM {
                T::at_most(&distances, &[limit; BLOCK])
            } else {
                // SAFETY: as above.
                let theirs = unsafe { block(limits, start) };
                T::at_most(&distances, &theirs.map(|theirs| theirs.greater(limit)))
            }
        }
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
    fn run<L: Lanes>(self, lanes: L) -> Self::Output {
        let Grid { index, .. } = &self.search.grid;
        let mut rows = Rows::with_receivers(self.slots.len());
        let mut cells = self.search.grid.cells(self.slots);
        while let Some(receivers) = cells.next() {
            let most = cells.runs().iter().map(Range::len).sum();
            for receiver in receivers {
                let near = self.search.near::<PERIODIC, UNIFORM>(receiver);
                let row = rows.next(most, self.budget)?.as_mut_ptr();
                let mut n = 0;
                for run in cells.runs() {
                    let mut start = run.start;
                    while start < run.end {
                        let beyond = BLOCK - BLOCK.min(run.end - start);
                        // SAFETY: `start` is a sorted particle, behind the last of which
                        // the arrays have room for a block, and so has the row behind
                        // `most` senders.
                        n += unsafe {
                            lanes.append(
                                near(start) & (u8::MAX >> beyond),
                                block(index, start),
                                row.add(n).cast(),
                            )
                        };
                        start += BLOCK;
                    }
                }
                rows.finish(n);
            }
        }
        Ok(rows)
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
unsafe fn block<T>(values: &[T], start: usize) -> &[T; BLOCK] {
    debug_assert!(start + BLOCK <= values.len());
    // SAFETY: promised by the caller.
    unsafe { &*values.as_ptr().add(start).cast() }
}
