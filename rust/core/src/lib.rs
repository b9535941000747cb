//! Interaction graphs for learned particle simulators, their network on the CPU, and the
//! material point solver that makes their training data. No Python in here: the binding crate
//! converts arguments and calls these functions.

mod error;
pub mod graph;
pub mod mpm;
pub mod network;
mod system;
pub mod threads;

pub use error::Error;
