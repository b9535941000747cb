//! `simulate`: one trajectory of the embedded data generator.

use adaptgns_core::Error;
use adaptgns_core::mpm::{self, Scene};
use numpy::ndarray::Array3;
use numpy::{IntoPyArray, PyArray1, PyArray3};
use pyo3::prelude::*;

use crate::errors::to_python;

type Simulated<'py> = (Bound<'py, PyArray3<f32>>, Bound<'py, PyArray1<i64>>);

/// Positions float32 [frames, particles, dim] and particle types int64 [particles] of one
/// random scene; `_core.pyi` has the whole contract.
#[pyfunction]
#[pyo3(signature = (scene, *, seed, frames, dim = 2, particles = None))]
fn simulate<'py>(
    py: Python<'py>,
    scene: &str,
    seed: u64,
    frames: usize,
    dim: usize,
    particles: Option<(usize, usize)>,
) -> PyResult<Simulated<'py>> {
    let scene = Scene::from_name(scene).map_err(to_python)?;
    let (positions, types) = py
        .detach(|| match dim {
            2 => record::<2>(scene, seed, frames, particles),
            3 => record::<3>(scene, seed, frames, particles),
            _ => Err(Error::InvalidArgument {
                argument: "dim",
                problem: format!("got {dim}, accepted are 2 and 3"),
            }),
        })
        .map_err(to_python)?;
    Ok((positions.into_pyarray(py), types.into_pyarray(py)))
}

fn record<const D: usize>(
    scene: Scene,
    seed: u64,
    frames: usize,
    particles: Option<(usize, usize)>,
) -> Result<(Array3<f32>, Vec<i64>), Error> {
    let trajectory = mpm::trajectory::<D>(scene, seed, frames, particles)?;
    let types = trajectory.particle_types;
    let shape = (frames, types.len(), D);
    let positions = Array3::from_shape_vec(shape, trajectory.positions.into_flattened())
        .expect("as many positions as frames and particles");
    Ok((positions, types))
}

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(simulate, module)?)
}
