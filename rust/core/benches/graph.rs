//! Criterion benchmarks of the graph builders.
fn main() {}
