//! Edges between all particles within a cutoff of one another.

use std::ops::Range;

use super::Graph;
use super::edges::{self, Rows};
use super::grid::Grid;
use super::input::{Batch, Options, Particles, check_length};
use super::memory::Budget;
use super::order::RANKED;
use super::scalar::{BLOCK, Scalar};
use crate::Error;
use crate::threads;

/// How far particles see.
#[derive(Debug, Clone, Copy)]
pub enum Radius<'a, S> {
    /// An edge wherever the distance is at most this.
    Uniform(f64),
    /// One radius per particle; an edge wherever the distance is at most the larger
    /// radius of the two ends.
    PerParticle(&'a [S]),
}

/// The graph of all pairs within `radius`, in both directions.
///
/// # Errors
/// [`Error::InvalidArgument`] for arguments outside what is accepted,
/// [`Error::OutOfMemory`] if the edges would not fit in the memory there is.
pub fn radius_graph<T: Scalar, S: Scalar>(
    particles: &Particles<'_, T>,
    radius: Radius<'_, S>,
    options: &Options,
) -> Result<Graph, Error> {
    let count = particles.count()?;
    match radius {
        Radius::Uniform(r) => {
            within_cutoff(particles, Cutoff::Uniform(check_radius("r", r)?), options)
        }
        Radius::PerParticle(radii) => {
            check_length("r", radii.len(), count)?;
            let radii = radii
                .iter()
                .map(|&r| check_radius("r", r.to_f64()))
                .collect::<Result<Vec<T>, _>>()?;
            within_cutoff(particles, Cutoff::PerParticle(&radii), options)
        }
    }
}

/// `value` as a radius in the arithmetic of the positions.
pub(super) fn check_radius<T: Scalar>(argument: &'static str, value: f64) -> Result<T, Error> {
    let radius = T::from_f64(value);
    if value > 0.0 && (radius * radius).is_normal() {
        return Ok(radius);
    }
    Err(Error::invalid(
        argument,
        format!(
            "got {value}, must be a finite number > 0 (whose square is a normal {})",
            T::NAME
        ),
    ))
}

/// A checked [`Radius`].
#[derive(Clone, Copy)]
pub(super) enum Cutoff<'a, T> {
    Uniform(T),
    PerParticle(&'a [T]),
}

pub(super) fn within_cutoff<T: Scalar>(
    particles: &Particles<'_, T>,
    cutoff: Cutoff<'_, T>,
    options: &Options,
) -> Result<Graph, Error> {
    match particles.dim {
        2 => build(&particles.check::<2>()?, cutoff, options),
        _ => build(&particles.check::<3>()?, cutoff, options),
    }
}

/// Sorted particles searched as one task.
const TASK: usize = 1024;

/// Particles below which starting other threads costs more than it saves.
const SERIAL: usize = 2048;

fn build<T: Scalar, const D: usize>(
    batch: &Batch<'_, T, D>,
    cutoff: Cutoff<'_, T>,
    options: &Options,
) -> Result<Graph, Error> {
    let threads = options.threads.unless(batch.positions.len() < SERIAL);
    let budget = Budget::default();
    let searches = threads::map(threads, batch.graphs.clone(), |graph| {
        Search::new(batch, graph, cutoff, &budget)
    })
    .into_iter()
    .collect::<Result<Vec<_>, _>>()?;
    let tasks: Vec<(&Search<T, D>, Range<usize>)> = searches
        .iter()
        .flat_map(|search| {
            let n = search.grid.index().len();
            (0..n)
                .step_by(TASK)
                .map(move |start| (search, start..n.min(start + TASK)))
        })
        .collect();
    let found = threads::map(threads, tasks.clone(), |(search, slots)| {
        search.run(slots, options.self_edges, &budget)
    })
    .into_iter()
    .collect::<Result<Vec<_>, _>>()?;
    let parts: Vec<(&[i32], &Rows)> = tasks
        .iter()
        .map(|(search, slots)| &search.grid.index()[slots.clone()])
        .zip(&found)
        .collect();
    edges::assemble(batch.positions.len(), &parts, threads, &budget)
}

/// One graph, sorted and ready to be searched.
struct Search<T, const D: usize> {
    grid: Grid<T, D>,
    period: [T; D],
    limits: Limits<T>,
}

/// Squared cutoffs.
enum Limits<T> {
    Uniform(T),
    /// In cell order.
    PerParticle(Vec<T>),
}

impl<T: Scalar, const D: usize> Search<T, D> {
    fn new(
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

    /// The rows of the sorted particles `slots`.
    fn run(&self, slots: Range<usize>, self_edges: bool, budget: &Budget) -> Result<Rows, Error> {
        if self.period.iter().any(|length| length.is_finite()) {
            self.search::<true>(slots, self_edges, budget)
        } else {
            self.search::<false>(slots, self_edges, budget)
        }
    }

    fn search<const PERIODIC: bool>(
        &self,
        slots: Range<usize>,
        self_edges: bool,
        budget: &Budget,
    ) -> Result<Rows, Error> {
        let grid = &self.grid;
        let mut rows = Rows::with_receivers(slots.len());
        let mut hits = Hits::default();
        let mut outcome = Ok(());
        grid.for_each_cell(slots, |receivers, runs| {
            hits.reserve(runs.iter().map(Range::len).sum());
            for i in receivers {
                hits.count = 0;
                for run in runs {
                    self.search_run::<PERIODIC>(i, run.clone(), &mut hits);
                }
                let dropped = if self_edges { -1 } else { grid.index[i] };
                if outcome.is_ok() {
                    outcome = rows.push(&mut hits.index, hits.count, dropped, budget);
                }
            }
            outcome.is_ok()
        });
        outcome.map(|()| rows)
    }

    /// Appends the sorted particles in `run` that are within the cutoff of `receiver`.
    #[inline(always)]
    fn search_run<const PERIODIC: bool>(
        &self,
        receiver: usize,
        run: Range<usize>,
        hits: &mut Hits,
    ) {
        let grid = &self.grid;
        let here = std::array::from_fn(|a| grid.coords[a][receiver]);
        for start in run.clone().step_by(BLOCK) {
            let there = std::array::from_fn(|a| block(&grid.coords[a], start));
            let distances = distances2::<T, D, PERIODIC>(here, there, &self.period);
            let limits = match &self.limits {
                &Limits::Uniform(limit) => [limit; BLOCK],
                Limits::PerParticle(limits) => {
                    block(limits, start).map(|limit| limit.greater(limits[receiver]))
                }
            };
            let beyond = BLOCK - BLOCK.min(run.end - start);
            let near = T::at_most(&distances, &limits) & (u8::MAX >> beyond);
            hits.push(block(&grid.index, start), near);
        }
    }
}

/// The candidates that are neighbours of one receiver.
#[derive(Default)]
struct Hits {
    index: Vec<i32>,
    count: usize,
}

/// The places of the ones in each byte, from the lowest.
static ONES: [[u8; BLOCK]; 256] = {
    let mut table = [[0; BLOCK]; 256];
    let mut byte = 0;
    while byte < 256 {
        let (mut place, mut found) = (0, 0);
        while place < BLOCK {
            if byte >> place & 1 == 1 {
                table[byte][found] = place as u8;
                found += 1;
            }
            place += 1;
        }
        byte += 1;
    }
    table
};

impl Hits {
    /// Makes room for `most` hits of one receiver.
    fn reserve(&mut self, most: usize) {
        if self.index.len() < most + BLOCK + RANKED {
            self.index.resize(2 * (most + BLOCK + RANKED), 0);
        }
    }

    /// Appends those of `index` whose bit in `near` is set. As many are written as there
    /// often are, and those count that there are: a branch for each would be mispredicted.
    #[inline(always)]
    fn push(&mut self, index: &[i32; BLOCK], near: u8) {
        const OFTEN: usize = BLOCK / 2;
        let places = &ONES[usize::from(near)];
        let count = near.count_ones() as usize;
        let end: &mut [i32; BLOCK] = self.index[self.count..].first_chunk_mut().expect("room");
        for l in 0..OFTEN {
            end[l] = index[usize::from(places[l]) % BLOCK];
        }
        if count > OFTEN {
            for l in OFTEN..BLOCK {
                end[l] = index[usize::from(places[l]) % BLOCK];
            }
        }
        self.count += count;
    }
}

/// Squared distances from one point to each of a block of others, on periodic axes to the
/// nearest image. Swapping the ends of a pair changes no bit of its distance, so both
/// directions fall the same way.
#[inline(always)]
fn distances2<T: Scalar, const D: usize, const PERIODIC: bool>(
    from: [T; D],
    to: [&[T; BLOCK]; D],
    period: &[T; D],
) -> [T; BLOCK] {
    let mut sum = [T::default(); BLOCK];
    for a in 0..D {
        for l in 0..BLOCK {
            let d = separation::<T, PERIODIC>(from[a], to[a][l], period[a]);
            sum[l] = sum[l] + d * d;
        }
    }
    sum
}

/// Distance along one axis, up to its sign.
#[inline(always)]
pub(super) fn separation<T: Scalar, const PERIODIC: bool>(from: T, to: T, period: T) -> T {
    let d = from - to;
    if PERIODIC {
        // Both lie inside the box, so no image is nearer than these two.
        let d = d.abs();
        d.lesser(period - d)
    } else {
        d
    }
}

#[inline(always)]
fn block<T>(values: &[T], start: usize) -> &[T; BLOCK] {
    values[start..].first_chunk().expect("room for a block")
}
