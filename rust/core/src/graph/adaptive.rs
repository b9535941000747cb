//! Particles that were uncertain see farther.

use super::Graph;
use super::input::{Options, Particles, check_length, check_values};
use super::radius::{check_radius, within_cutoff};
use super::scalar::Scalar;
use super::search::Cutoff;
use crate::Error;

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

    let mut radii = vec![base; count];
    let mut values = Vec::new();
    for graph in particles.graphs()? {
        let counts = |i: usize| eligible.is_none_or(|eligible| eligible[i]);
        values.clear();
        values.extend(graph.clone().filter(|&i| counts(i)).map(|i| sigma[i]));
        let Some(threshold) = percentile(&mut values, tau) else {
            continue;
        };
        for i in graph {
            if counts(i) && sigma[i] > threshold {
                radii[i] = expanded;
            }
        }
    }
    if radii.iter().all(|&radius| radius == base) {
        within_cutoff(particles, Cutoff::Uniform(base), options)
    } else {
        within_cutoff(particles, Cutoff::PerParticle(&radii), options)
    }
}

/// The `tau`-th percentile by linear interpolation, in the arithmetic of numpy's
/// `percentile`; `None` of no values. Reorders the values.
///
/// Sorted, the percentile lies at the position h = (n - 1) tau / 100, between the values
/// a and b before and after it: a + (b - a) t with t the fraction of h, evaluated from
/// the nearer end.
fn percentile<S: Scalar>(values: &mut [S], tau: f64) -> Option<S> {
    let last = values.len().checked_sub(1)?;
    let position = last as f64 * (tau / 100.0);
    let before = (position as usize).min(last);
    let (_, &mut a, after) = values.select_nth_unstable_by(before, S::total_cmp);
    let Some(b) = after.iter().copied().reduce(S::lesser) else {
        return Some(a);
    };
    let t = position - before as f64;
    let step = b - a;
    Some(if t < 0.5 {
        a + step * S::from_f64(t)
    } else {
        b - step * S::from_f64(1.0 - t)
    })
}
