//! What callers hand in, and the checks it must pass.

use std::ops::Range;

use super::scalar::Scalar;
use crate::Error;
use crate::threads::Threads;

/// The particles of one graph, or of several independent ones in a batch.
#[derive(Debug, Clone, Copy)]
pub struct Particles<'a, T> {
    /// Positions, particle after particle: `[N, dim]`, row-major.
    pub positions: &'a [T],
    /// Number of coordinates of a particle, 2 or 3.
    pub dim: usize,
    /// Graph `b` of a batch holds the particles `ptr[b]..ptr[b + 1]`; one graph if absent.
    pub ptr: Option<&'a [i64]>,
    /// Period length of each axis, infinite or zero where it is open; all open if absent.
    pub period: Option<&'a [f64]>,
}

/// What all three builders can be told beside their rule.
#[derive(Debug, Clone, Copy, Default)]
pub struct Options {
    /// Whether each particle is also a neighbour of itself.
    pub self_edges: bool,
    /// How many threads may work on the call; the result is the same for any number.
    pub threads: Threads,
}

/// Particles that passed every check, with their dimension in the type.
#[derive(Debug, Clone)]
pub(super) struct Batch<'a, T, const D: usize> {
    pub positions: &'a [[T; D]],
    /// The particles of each graph.
    pub graphs: Vec<Range<usize>>,
    /// Period length of each axis, infinite where it is open.
    pub period: [T; D],
}

impl<'a, T: Scalar> Particles<'a, T> {
    /// Number of particles.
    pub(super) fn count(&self) -> Result<usize, Error> {
        if !matches!(self.dim, 2 | 3) {
            return Err(Error::invalid(
                "pos",
                format!(
                    "got {} coordinates per particle, must be [N, 2] or [N, 3]",
                    self.dim
                ),
            ));
        }
        let count = self.positions.len() / self.dim;
        if i32::try_from(count).is_err() {
            return Err(Error::invalid(
                "pos",
                format!("got {count} particles, must be fewer than 2^31"),
            ));
        }
        Ok(count)
    }

    /// The particles of each graph.
    pub(super) fn graphs(&self) -> Result<Vec<Range<usize>>, Error> {
        graphs(self.ptr, self.count()?)
    }

    /// Checks everything about the particles; `D` is their dimension.
    pub(super) fn check<const D: usize>(&self) -> Result<Batch<'a, T, D>, Error> {
        let (positions, rest) = self.positions.as_chunks::<D>();
        assert!(self.dim == D && rest.is_empty(), "dimension mismatch");
        check_values("pos", self.positions, "finite", |x| x.is_finite())?;
        Ok(Batch {
            positions,
            graphs: self.graphs()?,
            period: period(self.period)?,
        })
    }
}

/// Fails on the first value that `accepted` refuses. The whole slice is read without
/// an early exit, which lets the compiler vectorise the usual case.
pub(super) fn check_values<T: Scalar>(
    argument: &'static str,
    values: &[T],
    requirement: &str,
    accepted: impl Fn(T) -> bool,
) -> Result<(), Error> {
    if values.iter().fold(true, |all, &x| all & accepted(x)) {
        return Ok(());
    }
    let found = values.iter().enumerate().find(|&(_, &x)| !accepted(x));
    let (at, value) = found.expect("a value was refused");
    Err(Error::invalid(
        argument,
        format!("got {value} at flat index {at}, every value must be {requirement}"),
    ))
}

/// Fails unless there is one value per particle.
pub(super) fn check_length(
    argument: &'static str,
    length: usize,
    particles: usize,
) -> Result<(), Error> {
    if length == particles {
        return Ok(());
    }
    Err(Error::invalid(
        argument,
        format!("got {length} values for {particles} particles, must be one per particle"),
    ))
}

fn graphs(ptr: Option<&[i64]>, particles: usize) -> Result<Vec<Range<usize>>, Error> {
    let Some(ptr) = ptr else {
        return Ok(std::iter::once(0..particles).collect());
    };
    let fail = |problem: String| {
        Err(Error::invalid(
            "ptr",
            format!("{problem}, must rise from 0 to the number of particles, {particles}"),
        ))
    };
    let (Some(&first), Some(&last)) = (ptr.first(), ptr.last()) else {
        return fail("got no offsets".into());
    };
    if first != 0 {
        return fail(format!("starts at {first}"));
    }
    if let Some(b) = ptr.windows(2).position(|pair| pair[0] > pair[1]) {
        return fail(format!(
            "falls from {} to {} at index {}",
            ptr[b],
            ptr[b + 1],
            b + 1
        ));
    }
    if usize::try_from(last) != Ok(particles) {
        return fail(format!("ends at {last}"));
    }
    Ok(ptr
        .windows(2)
        .map(|pair| pair[0] as usize..pair[1] as usize)
        .collect())
}

fn period<T: Scalar, const D: usize>(lengths: Option<&[f64]>) -> Result<[T; D], Error> {
    let mut period = [T::INFINITY; D];
    let Some(lengths) = lengths else {
        return Ok(period);
    };
    if lengths.len() != D {
        return Err(Error::invalid(
            "box",
            format!("got {} lengths, must be {D}, one per axis", lengths.len()),
        ));
    }
    for (axis, &length) in period.iter_mut().zip(lengths) {
        if length == 0.0 || length == f64::INFINITY {
            continue;
        }
        *axis = T::from_f64(length);
        if !(length > 0.0 && axis.is_normal()) {
            return Err(Error::invalid(
                "box",
                format!(
                    "got the length {length}, must be a positive {} or, for an open axis, inf or 0",
                    T::NAME
                ),
            ));
        }
    }
    Ok(period)
}
