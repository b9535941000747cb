//! The graph builders: arguments in, `edge_index` out.

use adaptgns_core::Error;
use adaptgns_core::graph::{self, Expansion, Graph, Options, Particles, Radius};
use numpy::ndarray::Array2;
use numpy::prelude::*;
use numpy::{IntoPyArray, PyReadonlyArrayDyn, PyUntypedArray};
use pyo3::prelude::*;

use crate::arguments::{self, Reals, with_slice};
use crate::errors::to_python;

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(radius_graph, module)?)?;
    module.add_function(wrap_pyfunction!(adaptive_graph, module)?)?;
    module.add_function(wrap_pyfunction!(knn_graph, module)?)
}

/// Connect all particles that are at most a radius apart, in both directions.
///
/// Distances are computed in the type of ``pos``. A pair within rounding of the radius may
/// fall either way; both directions fall the same way.
///
/// Parameters
/// ----------
/// pos : float32 or float64 array ``[N, d]``
///     Positions, ``d`` 2 or 3. Any strides; only what is not contiguous is copied.
/// r : float, or float array ``[N]``
///     The radius in the unit of ``pos``, or one per particle: an edge wherever
///     ``distance <= max(r[i], r[j])``. Every particle is compared with all that are within
///     about the longest one.
/// ptr : int64 array ``[B + 1]``, optional
///     Graph ``b`` of a batch holds the particles ``ptr[b]:ptr[b + 1]``; no edge joins two
///     graphs. One graph if absent.
/// box : d lengths, optional
///     Period of each axis, ``inf`` or 0 for an open one. A pair counts once, at its
///     nearest image.
/// self_edges : bool
///     Whether every particle is also its own neighbour.
/// threads : int, optional
///     How many threads may work on the call, all cores if absent. The result is the same.
/// return_offsets : bool
///     Whether to return the receivers' row offsets too.
///
/// Returns
/// -------
/// edge_index : int64 array ``[2, E]``
///     Row 0 the senders, row 1 the receivers, sorted by receiver, then by sender.
/// offsets : int64 array ``[N + 1]``, if asked for
///     Particle ``i`` receives the edges ``offsets[i]:offsets[i + 1]``.
///
/// Raises
/// ------
/// ValueError, TypeError
///     For an argument of the wrong value or kind, with its name and what is accepted.
/// MemoryError
///     If the edges would not fit in the memory there is.
#[pyfunction]
#[pyo3(signature = (pos, r, *, ptr=None, r#box=None, self_edges=false, threads=None, return_offsets=false))]
fn radius_graph<'py>(
    pos: &Bound<'py, PyAny>,
    r: &Bound<'py, PyAny>,
    ptr: Option<&Bound<'py, PyAny>>,
    r#box: Option<&Bound<'py, PyAny>>,
    self_edges: bool,
    threads: Option<&Bound<'py, PyAny>>,
    return_offsets: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let common = Common::new(pos, ptr, r#box, self_edges, threads, return_offsets)?;
    let per_particle = r
        .cast::<PyUntypedArray>()
        .is_ok_and(|array| array.ndim() > 0);
    if per_particle {
        let radii = arguments::reals("r", r, 1)?;
        with_slice!(&common.pos, pos => with_slice!(&radii, radii => {
            common.build(pos, |p, o| graph::radius_graph(p, Radius::PerParticle(radii), o))
        }))
    } else {
        let r = arguments::number("r", r)?;
        with_slice!(&common.pos, pos => {
            common.build(pos, |p, o| graph::radius_graph::<_, f64>(p, Radius::Uniform(r), o))
        })
    }
}

/// Connect all particles within a radius, and those that are uncertain within a larger one.
///
/// A particle is high if its sigma exceeds the ``tau``-th percentile of its graph
/// (``numpy.percentile``, linear). An edge where ``distance <= r``, or where
/// ``distance <= factor * r`` and at least one end is high. ``factor = 1``, ``tau = 100``
/// or equal sigma give the base graph.
///
/// Parameters
/// ----------
/// pos : float32 or float64 array ``[N, d]``
///     Positions, ``d`` 2 or 3. Any strides; only what is not contiguous is copied.
/// sigma : float32 or float64 array ``[N]``
///     Uncertainty of each particle, not negative.
/// r : float
///     The base radius in the unit of ``pos``.
/// tau : float
///     Percentile, 0 to 100.
/// factor : float
///     How many times the base radius a high particle sees, at least 1.
/// eligible : bool array ``[N]``, optional
///     The particles over which the percentile is taken; the others are never high. All if
///     absent.
/// ptr : int64 array ``[B + 1]``, optional
///     Graph ``b`` of a batch holds the particles ``ptr[b]:ptr[b + 1]``; no edge joins two
///     graphs. One graph if absent.
/// box : d lengths, optional
///     Period of each axis, ``inf`` or 0 for an open one. A pair counts once, at its
///     nearest image.
/// self_edges : bool
///     Whether every particle is also its own neighbour.
/// threads : int, optional
///     How many threads may work on the call, all cores if absent. The result is the same.
/// return_offsets : bool
///     Whether to return the receivers' row offsets too.
///
/// Returns
/// -------
/// edge_index : int64 array ``[2, E]``
///     Row 0 the senders, row 1 the receivers, sorted by receiver, then by sender.
/// offsets : int64 array ``[N + 1]``, if asked for
///     Particle ``i`` receives the edges ``offsets[i]:offsets[i + 1]``.
///
/// Raises
/// ------
/// ValueError, TypeError
///     For an argument of the wrong value or kind, with its name and what is accepted.
/// MemoryError
///     If the edges would not fit in the memory there is.
#[pyfunction]
#[pyo3(signature = (pos, sigma, r, tau, factor, *, eligible=None, ptr=None, r#box=None, self_edges=false, threads=None, return_offsets=false))]
#[expect(clippy::too_many_arguments, reason = "keyword arguments in Python")]
fn adaptive_graph<'py>(
    pos: &Bound<'py, PyAny>,
    sigma: &Bound<'py, PyAny>,
    r: &Bound<'py, PyAny>,
    tau: &Bound<'py, PyAny>,
    factor: &Bound<'py, PyAny>,
    eligible: Option<&Bound<'py, PyAny>>,
    ptr: Option<&Bound<'py, PyAny>>,
    r#box: Option<&Bound<'py, PyAny>>,
    self_edges: bool,
    threads: Option<&Bound<'py, PyAny>>,
    return_offsets: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let common = Common::new(pos, ptr, r#box, self_edges, threads, return_offsets)?;
    let sigma = arguments::reals("sigma", sigma, 1)?;
    let r = arguments::number("r", r)?;
    let tau = arguments::number("tau", tau)?;
    let factor = arguments::number("factor", factor)?;
    let eligible = eligible
        .map(|value| arguments::flags("eligible", value))
        .transpose()?;
    let eligible = eligible.as_deref();
    with_slice!(&common.pos, pos => with_slice!(&sigma, sigma => {
        let expansion = Expansion { sigma, tau, factor, eligible };
        common.build(pos, |p, o| graph::adaptive_graph(p, r, &expansion, o))
    }))
}

/// Let every particle receive from its k nearest others, ties going to the lower index.
///
/// The graph is not symmetric. A self-edge, if asked for, comes beside the ``k``.
///
/// Parameters
/// ----------
/// pos : float32 or float64 array ``[N, d]``
///     Positions, ``d`` 2 or 3. Any strides; only what is not contiguous is copied.
/// k : int
///     Senders of each receiver, at least 1 and less than the particles of any graph.
/// ptr : int64 array ``[B + 1]``, optional
///     Graph ``b`` of a batch holds the particles ``ptr[b]:ptr[b + 1]``; no edge joins two
///     graphs. One graph if absent.
/// box : d lengths, optional
///     Period of each axis, ``inf`` or 0 for an open one. A pair counts once, at its
///     nearest image.
/// self_edges : bool
///     Whether every particle is also its own neighbour.
/// threads : int, optional
///     How many threads may work on the call, all cores if absent. The result is the same.
/// return_offsets : bool
///     Whether to return the receivers' row offsets too.
///
/// Returns
/// -------
/// edge_index : int64 array ``[2, E]``
///     Row 0 the senders, row 1 the receivers, sorted by receiver, then by sender.
/// offsets : int64 array ``[N + 1]``, if asked for
///     Particle ``i`` receives the edges ``offsets[i]:offsets[i + 1]``.
///
/// Raises
/// ------
/// ValueError, TypeError
///     For an argument of the wrong value or kind, with its name and what is accepted.
/// MemoryError
///     If the edges would not fit in the memory there is.
#[pyfunction]
#[pyo3(signature = (pos, k, *, ptr=None, r#box=None, self_edges=false, threads=None, return_offsets=false))]
fn knn_graph<'py>(
    pos: &Bound<'py, PyAny>,
    k: &Bound<'py, PyAny>,
    ptr: Option<&Bound<'py, PyAny>>,
    r#box: Option<&Bound<'py, PyAny>>,
    self_edges: bool,
    threads: Option<&Bound<'py, PyAny>>,
    return_offsets: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let common = Common::new(pos, ptr, r#box, self_edges, threads, return_offsets)?;
    let k = arguments::count("k", k)?.get();
    with_slice!(&common.pos, pos => common.build(pos, |p, o| graph::knn_graph(p, k, o)))
}

/// The arguments that all builders share.
struct Common<'py> {
    py: Python<'py>,
    pos: Reals<'py>,
    dim: usize,
    ptr: Option<PyReadonlyArrayDyn<'py, i64>>,
    period: Option<Vec<f64>>,
    options: Options,
    return_offsets: bool,
}

impl<'py> Common<'py> {
    fn new(
        pos: &Bound<'py, PyAny>,
        ptr: Option<&Bound<'py, PyAny>>,
        period: Option<&Bound<'py, PyAny>>,
        self_edges: bool,
        threads: Option<&Bound<'py, PyAny>>,
        return_offsets: bool,
    ) -> PyResult<Self> {
        let reals = arguments::reals("pos", pos, 2)?;
        let dim = match &reals {
            Reals::Single(array) => array.shape()[1],
            Reals::Double(array) => array.shape()[1],
        };
        Ok(Self {
            py: pos.py(),
            pos: reals,
            dim,
            ptr: ptr
                .map(|value| arguments::offsets("ptr", value))
                .transpose()?,
            period: period
                .map(|value| arguments::numbers("box", value))
                .transpose()?,
            options: Options {
                self_edges,
                threads: arguments::threads(threads)?,
            },
            return_offsets,
        })
    }

    /// Runs `builder` without the GIL and hands its arrays to numpy without a copy.
    fn build<T: Sync>(
        &self,
        positions: &[T],
        builder: impl FnOnce(&Particles<'_, T>, &Options) -> Result<Graph, Error> + Send,
    ) -> PyResult<Bound<'py, PyAny>> {
        let particles = Particles {
            positions,
            dim: self.dim,
            ptr: self
                .ptr
                .as_ref()
                .map(|array| array.as_slice())
                .transpose()?,
            period: self.period.as_deref(),
        };
        let options = self.options;
        let graph = self
            .py
            .detach(move || builder(&particles, &options))
            .map_err(to_python)?;
        let shape = (2, graph.edge_index.len() / 2);
        let edge_index = Array2::from_shape_vec(shape, graph.edge_index)
            .expect("two rows of equal length")
            .into_pyarray(self.py);
        if self.return_offsets {
            let offsets = graph.offsets.into_pyarray(self.py);
            return Ok((edge_index, offsets).into_pyobject(self.py)?.into_any());
        }
        Ok(edge_index.into_any())
    }
}
