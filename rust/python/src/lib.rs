//! `adaptgns._core`: converts and validates arguments, releases the GIL, and calls
//! the core crate. No algorithm lives here.

mod arguments;
mod errors;
mod graph;
mod mpm;
mod network;

use mimalloc::MiMalloc;
use pyo3::prelude::*;

/// Keeps what is freed until something else is asked for, later than a moment: from step to step of
/// a rollout the same memory is asked for, and the usual allocator gives that back to the system each
/// time, to get it again page by page. It holds a lock only while a thread starts or it gets more
/// from the system; a child that is forked in that very moment, by another thread, would wait for it.
#[global_allocator]
static ALLOCATOR: MiMalloc = MiMalloc;

/// Graph builders, the data generator and the graph network of AdaptGNS. Other Python threads go on
/// during a call; none of them may write to the arrays that it was given.
#[pymodule]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    graph::register(module)?;
    mpm::register(module)?;
    network::register(module)
}
