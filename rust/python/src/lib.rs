//! `adaptgns._core`: converts and validates arguments, releases the GIL, and calls
//! the core crate. No algorithm lives here.

mod arguments;
mod errors;
mod graph;
mod mpm;
mod network;

use pyo3::prelude::*;

/// Graph builders, the data generator and the graph network of AdaptGNS.
#[pymodule]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    graph::register(module)?;
    mpm::register(module)?;
    network::register(module)
}
