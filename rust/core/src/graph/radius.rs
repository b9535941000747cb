//! Edges between all particles within a cutoff of one another.

use std::ops::Range;

use super::Graph;
use super::edges::{self, Rows};
use super::grid::Grid;
use super::input::{Batch, Options, Particles, check_length};
use super::memory::Budget;
use super::order::RANKED;
use super::scalar::Scalar;
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
const TASK: usize = 2048;

/// Particles below which starting other threads costs more than it saves.
const SERIAL: usize = 4096;

fn build<T: Scalar, const D: usize>(
    batch: &Batch<'_, T, D>,
    cutoff: Cutoff<'_, T>,
    options: &Options,
) -> Result<Graph, Error> {
    let threads = options.threads.unless(batch.positions.len() < SERIAL);
    let searches = threads::map(threads, batch.graphs.len(), |b| {
        Search::new(batch, batch.graphs[b].clone(), cutoff)
    });
    let tasks: Vec<(usize, Range<usize>)> = searches
        .iter()
        .enumerate()
        .flat_map(|(b, search)| {
            let n = search.grid.index.len();
            (0..n)
                .step_by(TASK)
                .map(move |start| (b, start..n.min(start + TASK)))
        })
        .collect();
    let budget = Budget::default();
    let found = threads::map(threads, tasks.len(), |t| {
        let (b, slots) = &tasks[t];
        searches[*b].run(slots.clone(), options.self_edges, &budget)
    })
    .into_iter()
    .collect::<Result<Vec<_>, _>>()?;
    let receivers = tasks
        .iter()
        .map(|(b, slots)| &searches[*b].grid.index[slots.clone()]);
    edges::assemble(
        batch.positions.len(),
        &receivers.map(|r| &r[..]).zip(&found).collect::<Vec<_>>(),
        threads,
    )
}

/// One graph, sorted and ready to be searched.
struct Search<T, const D: usize> {
    grid: Grid<T, D>,
    period: [T; D],
    cutoff: SquaredCutoff<T>,
}

enum SquaredCutoff<T> {
    Uniform(T),
    /// In cell order.
    PerParticle(Vec<T>),
}

impl<T: Scalar, const D: usize> Search<T, D> {
    fn new(batch: &Batch<'_, T, D>, graph: Range<usize>, cutoff: Cutoff<'_, T>) -> Self {
        let longest = match cutoff {
            Cutoff::Uniform(r) => r,
            Cutoff::PerParticle(radii) => radii[graph.clone()]
                .iter()
                .fold(T::default(), |longest, &r| longest.greater(r)),
        };
        let grid = Grid::new(
            &batch.positions[graph.clone()],
            graph.start,
            &batch.period,
            longest.to_f64(),
        );
        let cutoff = match cutoff {
            Cutoff::Uniform(r) => SquaredCutoff::Uniform(r * r),
            Cutoff::PerParticle(radii) => SquaredCutoff::PerParticle(
                grid.index
                    .iter()
                    .map(|&i| radii[i as usize] * radii[i as usize])
                    .collect(),
            ),
        };
        Self {
            grid,
            period: batch.period,
            cutoff,
        }
    }

    /// The rows of the sorted particles `slots`.
    fn run(&self, slots: Range<usize>, self_edges: bool, budget: &Budget) -> Result<Rows, Error> {
        let periodic = self.period.iter().any(|length| length.is_finite());
        match (periodic, &self.cutoff) {
            (false, SquaredCutoff::Uniform(limit)) => {
                self.search::<false>(slots, self_edges, budget, |_, _| *limit)
            }
            (true, SquaredCutoff::Uniform(limit)) => {
                self.search::<true>(slots, self_edges, budget, |_, _| *limit)
            }
            (false, SquaredCutoff::PerParticle(limits)) => {
                self.search::<false>(slots, self_edges, budget, |i, j| {
                    limits[i].greater(limits[j])
                })
            }
            (true, SquaredCutoff::PerParticle(limits)) => {
                self.search::<true>(slots, self_edges, budget, |i, j| {
                    limits[i].greater(limits[j])
                })
            }
        }
    }

    fn search<const PERIODIC: bool>(
        &self,
        slots: Range<usize>,
        self_edges: bool,
        budget: &Budget,
        limit: impl Fn(usize, usize) -> T,
    ) -> Result<Rows, Error> {
        let grid = &self.grid;
        let mut rows = Rows::with_receivers(slots.len());
        let mut hits: Vec<i32> = Vec::new();
        let mut outcome = Ok(());
        grid.for_each_cell(slots, |receivers, candidates| {
            if outcome.is_err() {
                return;
            }
            let most: usize = candidates.iter().map(Range::len).sum();
            if hits.len() < most + RANKED {
                hits.resize(most + RANKED, 0);
            }
            for i in receivers {
                let here: [T; D] = std::array::from_fn(|a| grid.coords[a][i]);
                let mut n = 0;
                for run in candidates {
                    for j in run.clone() {
                        let there: [T; D] = std::array::from_fn(|a| grid.coords[a][j]);
                        let near =
                            distance2::<T, D, PERIODIC>(here, there, &self.period) <= limit(i, j);
                        hits[n] = grid.index[j];
                        n += usize::from(near);
                    }
                }
                let dropped = if self_edges { -1 } else { grid.index[i] };
                outcome = rows.push(&mut hits, n, dropped, budget);
                if outcome.is_err() {
                    return;
                }
            }
        });
        outcome.map(|()| rows)
    }
}

/// Squared distance, on periodic axes to the nearest image. Swapping the ends changes
/// no bit of it, so both directions of a pair fall the same way.
#[inline(always)]
pub(super) fn distance2<T: Scalar, const D: usize, const PERIODIC: bool>(
    from: [T; D],
    to: [T; D],
    period: &[T; D],
) -> T {
    let square = |a: usize| {
        let mut d = (from[a] - to[a]).abs();
        if PERIODIC {
            // Both lie inside the box, so no image is nearer than these two.
            d = d.lesser(period[a] - d);
        }
        d * d
    };
    (1..D).fold(square(0), |sum, a| sum + square(a))
}
