//! Particles that were uncertain see farther.

use std::ops::Range;

use super::Graph;
use super::input::{Options, Particles, check_length, check_values};
use super::memory::{SHARE, filled};
use super::radius::{check_radius, within_cutoff};
use super::scalar::Scalar;
use super::search::Cutoff;
use crate::Error;
use crate::threads::Team;

/// Which particles see farther, and how much.
#[derive(Debug, Clone, Copy)]
pub struct Expansion<'a, S> {
    /// Uncertainty of each particle.
    pub sigma: &'a [S],
    /// Percentile of its own graph's `sigma` above which a particle is high, 0 to 100.
    pub tau: f64,
    /// How many times the base radius a high particle sees, at least 1.
    pub factor: f64,
    /// The particles over which the percentile is taken, all if absent; the others are
    /// never high.
    pub eligible: Option<&'a [bool]>,
}

/// The graph of all pairs within `r`, and within `factor * r` where at least one end is
/// high, that is its sigma exceeds the `tau`-th percentile of its graph.
///
/// # Errors
/// As [`radius_graph`](super::radius_graph).
pub fn adaptive_graph<T: Scalar, S: Scalar>(
    particles: &Particles<'_, T>,
    r: f64,
    expansion: &Expansion<'_, S>,
    options: &Options,
) -> Result<Graph, Error> {
    let &Expansion {
        sigma,
        tau,
        factor,
        eligible,
    } = expansion;
    let count = particles.count()?;
    let base: T = check_radius("r", r)?;
    if !(0.0..=100.0).contains(&tau) {
        return Err(Error::invalid(
            "tau",
            format!("got {tau}, must be a percentile in [0, 100]"),
        ));
    }
    if !(factor >= 1.0 && factor.is_finite()) {
        return Err(Error::invalid(
            "factor",
            format!("got {factor}, must be a finite number >= 1"),
        ));
    }
    let expanded: T = check_radius("factor * r", factor * r)?;
    check_length("sigma", sigma.len(), count)?;
    check_values("sigma", sigma, "finite and >= 0", |s| {
        s.is_finite() && s >= S::default()
    })?;
    if let Some(eligible) = eligible {
        check_length("eligible", eligible.len(), count)?;
    }

    let graphs = particles.graphs()?;
    let radii = [base, expanded];
    within_cutoff(particles, options, |team| match eligible {
        None => expand(sigma, graphs, |_| true, tau, radii, team),
        Some(eligible) => expand(sigma, graphs, |i| eligible[i], tau, radii, team),
    })
}

/// The second radius for high particles, the first one for the others.
fn expand<T: Scalar, S: Scalar>(
    sigma: &[S],
    graphs: Vec<Range<usize>>,
    eligible: impl Fn(usize) -> bool + Sync,
    tau: f64,
    [base, expanded]: [T; 2],
    team: &Team,
) -> Cutoff<T> {
    let mut radii = filled(base, sigma.len());
    let mut left = &mut radii[..];
    let mut tasks = Vec::new();
    for graph in graphs {
        let radii = left.split_off_mut(..graph.len()).expect("particles left");
        if let Some(threshold) = percentile(sigma, graph.clone(), &eligible, tau, team) {
            let shares = graph.step_by(SHARE).zip(radii.chunks_mut(SHARE));
            tasks.extend(shares.map(|(first, radii)| (first, radii, threshold)));
        }
    }
    let high = team.map(tasks, |(first, radii, threshold)| {
        let mut high = 0;
        for ((i, &sigma), radius) in (first..).zip(&sigma[first..]).zip(radii) {
            let is_high = eligible(i) & (sigma > threshold);
            high += usize::from(is_high);
            *radius = if is_high { expanded } else { base };
        }
        high
    });
    if high.iter().sum::<usize>() > 0 {
        Cutoff::PerParticle {
            radii,
            shortest: base,
            longest: expanded,
        }
    } else {
        Cutoff::Uniform(base)
    }
}

/// The `tau`-th percentile of the `sigma` of the eligible particles of a graph by linear
/// interpolation, in the arithmetic of numpy's `percentile`; `None` where none is eligible.
///
/// Sorted, the percentile lies at the position h = (n - 1) tau / 100, between the values
/// a and b before and after it: a + (b - a) t with t the fraction of h, evaluated from
/// the nearer end.
fn percentile<S: Scalar>(
    sigma: &[S],
    graph: Range<usize>,
    eligible: &(impl Fn(usize) -> bool + Sync),
    tau: f64,
    team: &Team,
) -> Option<S> {
    let everything = [S::default(), S::INFINITY];
    let mut bounds = everything;
    if graph.len() > SHARE {
        let sample = graph.clone().step_by(graph.len() / SAMPLE);
        bounds = likely(sample.filter(|&i| eligible(i)).map(|i| sigma[i]), tau);
    }
    loop {
        let [low, high] = bounds;
        let shares = graph.clone().step_by(SHARE);
        let found = team.map(shares.collect(), |first| {
            let share = first..graph.end.min(first + SHARE);
            let mut near = vec![S::default(); share.len()];
            let (mut count, mut below, mut within) = (0, 0, 0);
            for (i, &value) in share.clone().zip(&sigma[share]) {
                let counts = eligible(i);
                count += usize::from(counts);
                below += usize::from(counts & (value < low));
                near[within] = value; // stays if it is within, without a branch
                within += usize::from(counts & (low <= value) & (value <= high));
            }
            near.truncate(within);
            (count, below, near)
        });
        let count: usize = found.iter().map(|&(count, ..)| count).sum();
        let below: usize = found.iter().map(|&(_, below, _)| below).sum();
        let mut near: Vec<S> = found.into_iter().flat_map(|(.., near)| near).collect();
        let last = count.checked_sub(1)?;
        let position = last as f64 * (tau / 100.0);
        let before = position as usize;
        if below <= before && last.min(before + 1) < below + near.len() {
            let t = position - before as f64;
            return Some(interpolated(&mut near, before - below, t));
        }
        bounds = everything;
    }
}

/// Values of a sample that tells between which ones a percentile lies.
const SAMPLE: usize = 512;

/// Places in it by which it is wrong less than once in a hundred times: three times the standard
/// deviation.
const MARGIN: usize = 32;

/// Between which values the percentile lies in all likelihood.
fn likely<S: Scalar>(sample: impl Iterator<Item = S>, tau: f64) -> [S; 2] {
    let mut sample: Vec<S> = sample.collect();
    sample.sort_unstable_by(S::total_cmp);
    let rank = (sample.len() as f64 * (tau / 100.0)) as usize;
    let low = rank.checked_sub(MARGIN).map(|rank| sample[rank]);
    let high = sample.get(rank + MARGIN).copied();
    [low.unwrap_or_default(), high.unwrap_or(S::INFINITY)]
}

/// The value between those at the places `before` and `before + 1`, if there is one, of the sorted
/// `values`. Reorders them.
fn interpolated<S: Scalar>(values: &mut [S], before: usize, t: f64) -> S {
    let (_, &mut a, after) = values.select_nth_unstable_by(before, S::total_cmp);
    let Some(b) = after.iter().copied().reduce(S::lesser) else {
        return a;
    };
    let step = b - a;
    if t < 0.5 {
        a + step * S::from_f64(t)
    } else {
        b - step * S::from_f64(1.0 - t)
    }
}
