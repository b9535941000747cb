//! Criterion benchmarks of the graph builders: `cargo bench -p adaptgns-bench`.

use std::hint::black_box;

use adaptgns_core::graph::{
    Expansion, Options, Particles, Radius, adaptive_graph, knn_graph, radius_graph,
};
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};

/// Particles, dimension, mean degree.
const SIZES: [(usize, usize, f64); 4] = [
    (567, 2, 5.4),
    (1_270, 2, 6.8),
    (100_000, 2, 6.8),
    (100_000, 3, 20.0),
];

/// Coordinates in 0..1 from a linear congruential sequence.
fn uniform(count: usize) -> Vec<f32> {
    let mut state = 1_u64;
    (0..count)
        .map(|_| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1_u64 << 24) as f32
        })
        .collect()
}

/// The radius at which `count` uniform particles have this many neighbours inside the unit box.
fn radius(count: usize, dim: usize, degree: f64) -> f64 {
    let volume = degree / count as f64;
    match dim {
        2 => (volume / std::f64::consts::PI).sqrt(),
        _ => (volume * 0.75 / std::f64::consts::PI).cbrt(),
    }
}

fn builders(criterion: &mut Criterion) {
    let options = Options::default();
    for (count, dim, degree) in SIZES {
        let mut group = criterion.benchmark_group(format!("{dim}D"));
        group.throughput(Throughput::Elements(count as u64));
        let positions = uniform(count * dim);
        let sigma = uniform(count);
        let particles = Particles {
            positions: &positions,
            dim,
            ptr: None,
            period: None,
        };
        let r = radius(count, dim, degree);
        let expansion = Expansion {
            sigma: &sigma,
            tau: 70.0,
            factor: 1.267,
            eligible: None,
        };
        group.bench_function(BenchmarkId::new("radius", count), |bencher| {
            let radius = Radius::<f32>::Uniform(r);
            bencher.iter(|| radius_graph(black_box(&particles), radius, &options));
        });
        group.bench_function(BenchmarkId::new("adaptive", count), |bencher| {
            bencher.iter(|| adaptive_graph(black_box(&particles), r, &expansion, &options));
        });
        group.bench_function(BenchmarkId::new("knn", count), |bencher| {
            bencher.iter(|| knn_graph(black_box(&particles), 6, &options));
        });
        group.finish();
    }
}

criterion_group!(benches, builders);
criterion_main!(benches);
