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

/// Connect all particles that are at most a radius apart.
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

/// Connect all particles within a radius, and those that were uncertain within a larger one.
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
    let eligible = eligible
        .as_ref()
        .map(|array| array.as_slice())
        .transpose()?;
    with_slice!(&common.pos, pos => with_slice!(&sigma, sigma => {
        let expansion = Expansion { sigma, tau, factor, eligible };
        common.build(pos, |p, o| graph::adaptive_graph(p, r, &expansion, o))
    }))
}

/// Connect every particle to its k nearest others.
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
