//! Interaction graphs.
