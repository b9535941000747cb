//! Interaction graphs.

mod adaptive;
mod edges;
mod grid;
mod input;
mod knn;
mod memory;
mod order;
mod radius;
mod scalar;

pub use adaptive::{Expansion, adaptive_graph};
pub use input::{Options, Particles};
pub use knn::knn_graph;
pub use radius::{Radius, radius_graph};
pub use scalar::Scalar;

/// A graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Graph {
    /// `[2, E]`
    pub edge_index: Vec<i64>,
    /// `[N + 1]`
    pub offsets: Vec<i64>,
}
