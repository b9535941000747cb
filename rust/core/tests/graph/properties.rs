//! What must hold for any input.

use std::collections::BTreeSet;

use adaptgns_core::graph::{
    Expansion, Graph, Radius, Scalar, adaptive_graph, knn_graph, radius_graph,
};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

use crate::oracle::Case;

fn config(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        rng_seed: RngSeed::Fixed(3),
        ..ProptestConfig::default()
    }
}

/// Positions that are often equal, collinear or exactly a lattice spacing apart, spread
/// so that a radius of order 1 gives anything from no edge to all.
fn positions<T: Scalar>(dim: usize, most: usize) -> impl Strategy<Value = Vec<T>> {
    let spread = prop_oneof![Just(0.5), Just(3.0), Just(30.0), Just(3000.0)];
    let origin = prop_oneof![Just(0.0), Just(-7.0), Just(1e6)];
    (spread, origin, any::<bool>(), 0..=most).prop_flat_map(move |(spread, origin, lattice, n)| {
        let coordinate = (-1.0..1.0).prop_map(move |x: f64| {
            let x = spread * x;
            T::from_f64(origin + if lattice { (2.0 * x).round() / 2.0 } else { x })
        });
        prop::collection::vec(coordinate, n * dim)
    })
}

fn case<T: Scalar>(most: usize) -> impl Strategy<Value = Case<T>> {
    let length = prop_oneof![
        Just(0.0),
        Just(f64::INFINITY),
        Just(0.3),
        Just(1.5),
        Just(5.0),
        Just(40.0),
    ];
    (2..=3_usize).prop_flat_map(move |dim| {
        let period = prop::option::of(prop::collection::vec(length.clone(), dim));
        let cuts = prop::option::of(prop::collection::vec(0.0..1.0, 0..4));
        (positions(dim, most), period, cuts, any::<bool>()).prop_map(
            move |(positions, period, cuts, self_edges)| {
                let n = positions.len() / dim;
                let ptr = cuts.map(|cuts: Vec<f64>| {
                    let mut ptr: Vec<i64> = cuts.iter().map(|c| (c * n as f64) as i64).collect();
                    ptr.extend([0, n as i64]);
                    ptr.sort_unstable();
                    ptr
                });
                Case {
                    dim,
                    positions,
                    ptr,
                    period,
                    self_edges,
                }
            },
        )
    })
}

const RADII: [f64; 4] = [0.1, 0.5, 1.0, 2.7];

fn equals_brute_force<T: Scalar>(case: &Case<T>, radius: f64) -> Graph {
    let r = T::from_f64(radius);
    let built =
        radius_graph::<T, T>(&case.particles(), Radius::Uniform(radius), &case.options(1)).unwrap();
    assert_eq!(built, case.pairs(|d2, _, _| d2 <= r * r));
    built
}

fn edges(graph: &Graph) -> BTreeSet<(i64, i64)> {
    let pairs = graph.senders().iter().zip(graph.receivers());
    pairs.map(|(&i, &j)| (i, j)).collect()
}

proptest! {
    #![proptest_config(config(400))]

    #[test]
    fn radius_graph_equals_brute_force(
        single in case::<f32>(60),
        double in case::<f64>(60),
        radius in prop::sample::select(&RADII),
    ) {
        for graph in [
            equals_brute_force(&single, radius),
            equals_brute_force(&double, radius),
        ] {
            let edges = edges(&graph);
            prop_assert!(edges.iter().all(|&(i, j)| edges.contains(&(j, i))), "symmetric");
        }
    }

    #[test]
    fn per_particle_radii_equal_brute_force(
        case in case::<f32>(60),
        radii in prop::collection::vec(0.05_f32..3.0, 60),
    ) {
        let radii = &radii[..case.count()];
        let built =
            radius_graph(&case.particles(), Radius::PerParticle(radii), &case.options(1)).unwrap();
        let near = |d2, i: usize, j: usize| {
            let r = radii[i].max(radii[j]);
            d2 <= r * r
        };
        prop_assert_eq!(built, case.pairs(near));
    }

    #[test]
    fn adaptive_graph_expands_around_high_particles(
        case in case::<f64>(60),
        levels in prop::collection::vec((0..5_u8, any::<bool>()), 60),
        tau in prop::sample::select(&[0.0, 30.0, 70.0, 99.0, 100.0][..]),
        factor in prop::sample::select(&[1.0, 1.267, 2.0][..]),
    ) {
        let n = case.count();
        let sigma: Vec<f32> = levels[..n].iter().map(|&(level, _)| f32::from(level)).collect();
        let eligible: Vec<bool> = levels[..n].iter().map(|&(_, eligible)| eligible).collect();
        let expansion = Expansion { sigma: &sigma, tau, factor, eligible: Some(&eligible) };
        let built =
            adaptive_graph(&case.particles(), 0.5, &expansion, &case.options(1)).unwrap();

        let high = |i: usize| {
            let mut own: Vec<f32> = (0..n)
                .filter(|&j| eligible[j] && case.graph_of(i) == case.graph_of(j))
                .map(|j| sigma[j])
                .collect();
            own.sort_by(f32::total_cmp);
            eligible[i] && {
                // By its definition, for values that are small integers.
                let at = (own.len() - 1) as f64 * tau / 100.0;
                let (low, up) = (own[at.floor() as usize], own[at.ceil() as usize]);
                f64::from(sigma[i]) > f64::from(low) + f64::from(up - low) * at.fract()
            }
        };
        let high: Vec<bool> = (0..n).map(high).collect();
        let expected = case.pairs(|d2, i, j| {
            let r = if high[i] || high[j] { factor * 0.5 } else { 0.5 };
            d2 <= r * r
        });
        prop_assert_eq!(built, expected);
    }

    #[test]
    fn knn_graph_equals_brute_force(case in case::<f32>(40), k in 1..12_usize) {
        let smallest = (0..case.count())
            .map(|i| (0..case.count()).filter(|&j| case.graph_of(i) == case.graph_of(j)).count())
            .min();
        prop_assume!(smallest.is_none_or(|n| k < n));
        let built = knn_graph(&case.particles(), k, &case.options(1)).unwrap();
        prop_assert_eq!(built, case.nearest(k));
    }

    #[test]
    fn permuting_particles_permutes_edges(
        (case, order) in case::<f64>(60)
            .prop_filter("one graph", |case| case.ptr.is_none())
            .prop_flat_map(|case| {
                let order = Just((0..case.count()).collect::<Vec<_>>()).prop_shuffle();
                (Just(case), order)
            }),
        radius in prop::sample::select(&RADII),
    ) {
        let moved: Vec<f64> = order
            .iter()
            .flat_map(|&i| case.positions[i * case.dim..(i + 1) * case.dim].to_vec())
            .collect();
        let moved = Case { positions: moved, ..case.clone() };
        let back = edges(&equals_brute_force(&moved, radius))
            .into_iter()
            .map(|(i, j)| (order[i as usize] as i64, order[j as usize] as i64))
            .collect::<BTreeSet<_>>();
        prop_assert_eq!(back, edges(&equals_brute_force(&case, radius)));
    }

    #[test]
    fn shifting_a_periodic_lattice_keeps_edges(
        case in case::<f64>(60),
        cells in -8..8_i32,
        radius in prop::sample::select(&[0.6, 1.1, 2.3][..]),
    ) {
        // Multiples of 1/4 are shifted and wrapped without rounding.
        let quarter = |x: f64| (4.0 * (x % 100.0)).round() / 4.0;
        let period = Some(vec![8.0; case.dim]);
        let positions: Vec<f64> = case.positions.iter().map(|&x| quarter(x)).collect();
        let shifted = positions.iter().map(|x| x + 1.75 * f64::from(cells)).collect();
        let here = Case { positions, period, ..case };
        let there = Case { positions: shifted, ..here.clone() };
        prop_assert_eq!(
            equals_brute_force(&here, radius),
            equals_brute_force(&there, radius)
        );
    }
}

/// A reproducible sequence in [0, 1).
pub fn uniform(count: usize) -> Vec<f64> {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    (0..count)
        .map(|_| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1_u64 << 53) as f64
        })
        .collect()
}

#[test]
fn radius_graph_equals_kiddo() {
    let positions = uniform(40_000);
    let points = positions.as_chunks::<2>().0;
    let tree: ImmutableKdTree<f64, 2> = ImmutableKdTree::new_from_slice(points).unwrap();
    let r = 0.01;
    let case = Case::open(2, positions.clone());
    let built =
        radius_graph::<_, f64>(&case.particles(), Radius::Uniform(r), &case.options(0)).unwrap();
    let mut expected = BTreeSet::new();
    for (i, point) in points.iter().enumerate() {
        for found in tree
            .query(point)
            .within::<SquaredEuclidean<f64>>(r * r)
            .execute()
        {
            if found.item as usize != i {
                expected.insert((i64::from(found.item), i as i64));
            }
        }
    }
    assert_eq!(edges(&built), expected);
}

#[test]
fn any_number_of_threads_gives_the_same_graph() {
    let n = 30_000;
    let graphs = [None, Some(vec![0, 10_000, 10_000, 10_007, n as i64])];
    for (dim, ptr) in [2, 3]
        .into_iter()
        .flat_map(|dim| graphs.clone().map(|ptr| (dim, ptr)))
    {
        let sigma = uniform(n);
        let radii: Vec<f64> = sigma.iter().map(|s| 0.01 + 0.02 * s).collect();
        let expansion = Expansion {
            sigma: &sigma,
            tau: 70.0,
            factor: 1.267,
            eligible: None,
        };
        let case = Case {
            ptr,
            ..Case::open(dim, uniform(n * dim))
        };
        let build = |threads| {
            let (particles, options) = (case.particles(), case.options(threads));
            [
                radius_graph::<_, f64>(&particles, Radius::Uniform(0.02), &options),
                radius_graph(&particles, Radius::PerParticle(&radii), &options),
                adaptive_graph(&particles, 0.02, &expansion, &options),
                knn_graph(&particles, 6, &options),
            ]
            .map(Result::unwrap)
        };
        let alone = build(1);
        for threads in [0, 2, 3, 8] {
            assert_eq!(build(threads), alone);
        }
    }
}

#[test]
fn the_percentile_of_many_is_that_of_all_of_them() {
    let n = 20_000;
    let random = uniform(n);
    // Where a sample is taken at equal distances, it misleads.
    let sampled = |i: usize| i.is_multiple_of(n / 512);
    let sigmas: [Vec<f64>; 5] = [
        random.clone(),
        (0..n).map(|i| random[i] + f64::from(sampled(i))).collect(),
        (0..n)
            .map(|i| random[i] - f64::from(sampled(i)))
            .map(|x| x.max(0.0))
            .collect(),
        (0..n).map(|i| (i % 3) as f64).collect(),
        vec![0.5; n],
    ];
    let masks: [Option<Vec<bool>>; 4] = [
        None,
        Some((0..n).map(|i| i.is_multiple_of(997)).collect()),
        Some((0..n).map(|i| i == n / 2).collect()),
        Some(vec![false; n]),
    ];
    let case = Case::open(2, uniform(2 * n));
    let (particles, options, r, factor) = (case.particles(), case.options(0), 0.01, 1.5);
    for (sigma, eligible) in sigmas
        .iter()
        .flat_map(|s| masks.iter().map(move |m| (s, m)))
    {
        let counts = |i: usize| eligible.as_ref().is_none_or(|eligible| eligible[i]);
        let mut sorted: Vec<f64> = (0..n).filter(|&i| counts(i)).map(|i| sigma[i]).collect();
        sorted.sort_by(f64::total_cmp);
        for tau in [0.0, 12.5, 70.0, 99.99, 100.0] {
            // Above the percentile lies what is above the value at its place, or the last before.
            let place = sorted.len().saturating_sub(1) as f64 * (tau / 100.0);
            let before = sorted.get(place as usize);
            let high = |i| counts(i) && before.is_some_and(|&before| sigma[i] > before);
            let radius = |i| if high(i) { factor * r } else { r };
            let radii: Vec<f64> = (0..n).map(radius).collect();
            let expansion = Expansion {
                sigma,
                tau,
                factor,
                eligible: eligible.as_deref(),
            };
            assert_eq!(
                adaptive_graph(&particles, r, &expansion, &options).unwrap(),
                radius_graph(&particles, Radius::PerParticle(&radii), &options).unwrap(),
            );
        }
    }
}
