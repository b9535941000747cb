//! Interaction graphs: who sends messages to whom.
//!
//! The conventions, which hold wherever a graph is built or used:
//!
//! - An edge is a pair (sender, receiver) of particle indices. Row 0 of
//!   [`Graph::edge_index`] holds the senders, row 1 the receivers.
//! - Edges are sorted by receiver, then by sender, whatever the number of threads.
//!   Particle `i` receives the edges `offsets[i]..offsets[i + 1]`.
//! - [`radius_graph`] and [`adaptive_graph`] hold both directions of every pair, a pair
//!   being near if its distance is at most the cutoff (`<=`). In [`knn_graph`] every
//!   receiver has the same number of senders, and the graph is not symmetric.
//! - Self-edges are there only if asked for.
//! - Along a periodic axis the distance is that to the nearest image, and a pair is one
//!   edge in each direction however short the period is.
//! - Distances are computed and compared in the type of the positions. A pair within
//!   rounding of the cutoff may fall either way; both directions fall the same way.
//!   Along a periodic axis positions outside `[0, L)` are wrapped into it first, which
//!   rounds them as numbers as large as `L` are.

mod adaptive;
mod edges;
mod grid;
mod input;
mod knn;
mod lanes;
mod memory;
mod order;
mod radius;
mod scalar;
mod search;
mod sort;

pub use adaptive::{Expansion, adaptive_graph};
pub use input::{Options, Particles};
pub use knn::{Nearest, knn_graph};
pub use radius::{Radius, radius_graph};
pub use scalar::Scalar;

/// The edges of one graph, or of several independent ones in a batch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Graph {
    /// All senders, then all receivers: `[2, E]`, row-major.
    pub edge_index: Vec<i64>,
    /// Where the edges of each receiver begin, and the number of edges: `[N + 1]`.
    pub offsets: Vec<i64>,
}

impl Graph {
    /// The senders, edge by edge.
    pub fn senders(&self) -> &[i64] {
        &self.edge_index[..self.edge_index.len() / 2]
    }

    /// The receivers, edge by edge.
    pub fn receivers(&self) -> &[i64] {
        &self.edge_index[self.edge_index.len() / 2..]
    }
}
