//! Edges between all particles within a cutoff of one another.

use std::ops::Range;

use super::Graph;
use super::edges::{self, Rows};
use super::input::{Batch, Options, Particles, check_length};
use super::memory::Budget;
use super::scalar::Scalar;
use super::search::{Cutoff, Search};
use crate::Error;
use crate::threads::{self, Team};

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
            let r = check_radius("r", r)?;
            within_cutoff(particles, options, |_| Cutoff::Uniform(r))
        }
        Radius::PerParticle(radii) => {
            check_length("r", radii.len(), count)?;
            let radii = radii
                .iter()
                .map(|&r| check_radius("r", r.to_f64()))
                .collect::<Result<Vec<T>, _>>()?;
            let cutoff = Cutoff::PerParticle {
                shortest: radii.iter().copied().fold(T::INFINITY, T::lesser),
                longest: radii.iter().copied().fold(T::default(), T::greater),
                radii,
            };
            within_cutoff(particles, options, |_| cutoff)
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

/// The graph of all pairs within a cutoff, which the threads find that build it.
pub(super) fn within_cutoff<T: Scalar>(
    particles: &Particles<'_, T>,
    options: &Options,
    cutoff: impl FnOnce(&Team) -> Cutoff<T>,
) -> Result<Graph, Error> {
    match particles.dim {
        2 => build(&particles.check::<2>()?, options, cutoff),
        _ => build(&particles.check::<3>()?, options, cutoff),
    }
}

/// Most sorted particles searched as one task.
const TASK: usize = 1024;

fn build<T: Scalar, const D: usize>(
    batch: &Batch<'_, T, D>,
    options: &Options,
    cutoff: impl FnOnce(&Team) -> Cutoff<T>,
) -> Result<Graph, Error> {
    let count = batch.positions.len();
    let task = edges::task_size(count, TASK);
    // The others wake while the particles are sorted.
    threads::team(options.threads.at_most(count.div_ceil(task)), |team| {
        let budget = Budget::default();
        let cutoff = &cutoff(team);
        let searches = match &batch.graphs[..] {
            [graph] => vec![Search::new(batch, graph.clone(), cutoff, team, &budget)],
            graphs => team.map(graphs.to_vec(), |graph| {
                Search::new(batch, graph, cutoff, &Team::alone(), &budget)
            }),
        };
        let searches = searches.into_iter().collect::<Result<Vec<_>, _>>()?;
        let tasks: Vec<(&Search<T, D>, Range<usize>)> = searches
            .iter()
            .flat_map(|search| {
                let n = search.index().len();
                (0..n)
                    .step_by(task)
                    .map(move |start| (search, start..n.min(start + task)))
            })
            .collect();
        let found = team
            .map(tasks.clone(), |(search, slots)| search.run(slots, &budget))
            .into_iter()
            .collect::<Result<Vec<_>, _>>()?;
        let parts: Vec<(&[i32], &Rows)> = tasks
            .iter()
            .map(|(search, slots)| &search.index()[slots.clone()])
            .zip(&found)
            .collect();
        // SAFETY: the graphs partition the particles, and a search has each of its own once.
        unsafe { edges::assemble(count, parts, !options.self_edges, team, &budget) }
    })
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroUsize;

    use super::*;
    use crate::graph::lanes::{Kind, MOST};

    #[test]
    fn every_processor_builds_the_same_graph() {
        check::<f32>();
        check::<f64>();
    }

    fn check<T: Scalar>() {
        const COUNT: usize = 600;
        /// A sequence that fills the unit interval evenly, another one for each `alpha`.
        fn weyl<T: Scalar>(alpha: f64) -> impl Fn(usize) -> T {
            move |i| T::from_f64((i as f64 * alpha).fract())
        }
        let axes = [0.819_172_513_4, 0.671_043_606_7, 0.549_700_477_9].map(weyl::<T>);
        let periodic = [1.0, 0.0];
        let mut edges = 0;
        // One cell to sixteen along the period, and groups of one cell to four.
        let radii = [0.06, 0.13, 0.15, 0.18, 0.22, 0.28, 0.35, 0.6];
        let boxes = radii.map(|r| [(2, r, None), (2, r, Some(&periodic[..])), (3, r, None)]);
        for ((dim, r, period), count) in boxes
            .into_iter()
            .flatten()
            .flat_map(|case| [(case, COUNT / 15), (case, COUNT)])
        {
            let positions: Vec<T> = (0..count)
                .flat_map(|i| axes[..dim].iter().map(move |axis| axis(i)))
                .collect();
            let particles = Particles {
                positions: &positions,
                dim,
                ptr: None,
                period,
            };
            let radii: Vec<f64> = (0..count)
                .map(|i| r * (0.5 + weyl::<f64>(0.754_877_666_2)(i)))
                .collect();
            for self_edges in [false, true] {
                let options = Options {
                    self_edges,
                    threads: threads::Threads::AtMost(NonZeroUsize::MIN),
                };
                let build = |kind| {
                    MOST.set(kind);
                    [Radius::Uniform(r), Radius::PerParticle(&radii)]
                        .map(|radius| radius_graph(&particles, radius, &options).expect("room"))
                };
                let graphs = build(Kind::Portable);
                edges += graphs[0].senders().len();
                for kind in [Kind::Avx2, Kind::Avx512] {
                    assert_eq!(
                        graphs,
                        build(kind),
                        "{kind:?} {dim} {period:?} {self_edges}"
                    );
                }
            }
        }
        assert!(edges > 500 * COUNT);
    }
}
