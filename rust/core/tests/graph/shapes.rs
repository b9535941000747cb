//! Shapes that break grids, trees or memory.

use adaptgns_core::Error;
use adaptgns_core::graph::{Graph, Radius, Scalar, knn_graph, radius_graph};

use crate::oracle::Case;
use crate::properties::uniform;

fn build<T: Scalar>(dim: usize, positions: Vec<T>, radius: f64) -> Graph {
    let case = Case::open(dim, positions);
    radius_graph::<T, T>(&case.particles(), Radius::Uniform(radius), &case.options(0)).unwrap()
}

#[test]
fn no_particle_has_no_edge() {
    let empty = Graph {
        edge_index: vec![],
        offsets: vec![0],
    };
    for dim in [2, 3] {
        assert_eq!(build::<f32>(dim, vec![], 1.0), empty);
        let case = Case::<f64>::open(dim, vec![]);
        assert_eq!(
            knn_graph(&case.particles(), 3, &case.options(0)).unwrap(),
            empty
        );
    }
}

#[test]
fn one_particle_has_at_most_its_self_edge() {
    let mut case = Case::open(2, vec![0.5_f32, -3.0]);
    for edges in [0, 1] {
        case.self_edges = edges == 1;
        let built =
            radius_graph::<_, f32>(&case.particles(), Radius::Uniform(1.0), &case.options(0))
                .unwrap();
        assert_eq!(built.offsets, [0, edges]);
    }
}

#[test]
fn points_at_the_radius_are_connected() {
    let built = build(2, vec![0.0_f32, 0.0, 0.1, 0.0, 0.1, 0.1, 0.0, 0.1], 0.1);
    assert_eq!(built.offsets, [0, 2, 4, 6, 8]);
    let built = build(2, vec![0.0_f64, 0.0, 3.0, 4.0], 5.0);
    assert_eq!(built.edge_index, [1, 0, 0, 1]);
}

#[test]
fn an_outlier_a_million_radii_away_costs_nothing() {
    for dim in [2, 3] {
        let (n, r) = (100_000, 0.004 * (dim * dim) as f64 / 2.0);
        let mut positions = uniform(n * dim);
        let without = build(dim, positions.clone(), r);
        positions.extend(vec![1e6 * r; dim]);
        let with = build(dim, positions, r);
        assert_eq!(with.edge_index, without.edge_index);
        assert_eq!(with.offsets[n..], [without.offsets[n]; 2]);
    }
}

#[test]
fn two_far_clusters_are_two_graphs() {
    let n = 20_000;
    let here = uniform(2 * n);
    // Powers of two away, so that no position is rounded.
    let here: Vec<f64> = here.iter().map(|x| (x * 4096.0).floor() / 4096.0).collect();
    let there = here.iter().map(|x| x - 1048576.0);
    let both = build(2, here.iter().copied().chain(there).collect(), 0.01);
    let one = build(2, here, 0.01);
    let edges = one.senders().len();
    assert_eq!(both.senders()[..edges], *one.senders());
    assert!(
        one.senders()
            .iter()
            .zip(&both.senders()[edges..])
            .all(|(i, j)| i + n as i64 == *j)
    );
}

#[test]
fn particles_on_a_line_form_a_chain() {
    let n = 50_000;
    let axes: [fn(f64) -> [f64; 3]; 3] = [|x| [x, 0., 0.], |x| [0., x, 0.], |x| [x, x, x]];
    for axis in axes {
        let positions = (0..n).flat_map(|i| axis(f64::from(i))).collect();
        let chain = build(3, positions, 1.8);
        assert_eq!(chain.senders().len(), 2 * (n as usize - 1));
    }
}

#[test]
fn a_square_lattice_has_its_known_neighbours() {
    let side = 300;
    let lattice: Vec<f32> = (0..side * side)
        .flat_map(|i| [(i % side) as f32, (i / side) as f32])
        .collect();
    let built = build(2, lattice.clone(), 1.0);
    assert_eq!(built.senders().len(), 4 * side * (side - 1));
    // Far inside, the eight nearest are the cells around, at distances 1 and sqrt(2).
    let case = Case::open(2, lattice);
    let nearest = knn_graph(&case.particles(), 8, &case.options(0)).unwrap();
    let middle = (side / 2) * side + side / 2;
    let row: Vec<i64> = [-1, 0, 1]
        .into_iter()
        .flat_map(|y| [-1, 0, 1].map(|x| (middle as i64) + y * side as i64 + x))
        .filter(|&i| i != middle as i64)
        .collect();
    assert_eq!(nearest.senders()[8 * middle..8 * middle + 8], row);
}

#[test]
fn a_pile_of_coincident_points_is_complete() {
    let n = 5000;
    let pile = build(2, vec![0.25_f32; 2 * n], 1e-3);
    assert_eq!(pile.senders().len(), n * (n - 1));
    assert!((0..n).all(|i| pile.offsets[i + 1] - pile.offsets[i] == n as i64 - 1));
    assert_eq!(pile.senders()[..3], [1, 2, 3]);
    let case = Case::open(2, vec![0.25_f32; 2 * n]);
    let nearest = knn_graph(&case.particles(), 3, &case.options(0)).unwrap();
    assert_eq!(nearest.senders()[..6], [1, 2, 3, 0, 2, 3]);
    assert_eq!(nearest.senders()[3 * n - 3..], [0, 1, 2]);
}

#[test]
fn edges_that_fit_no_memory_are_an_error() {
    for outlier in [0.0, 1e7] {
        let mut positions = vec![0.5_f32; 2_000_000];
        positions[0] = outlier;
        let case = Case::open(2, positions);
        let built =
            radius_graph::<_, f32>(&case.particles(), Radius::Uniform(0.01), &case.options(0));
        assert!(matches!(built, Err(Error::OutOfMemory(_))));
    }
}

#[test]
fn large_coordinates_are_resolved() {
    // Spacing of float32 there: 1/16.
    let corner = [1e6_f32, -1e6];
    let positions: Vec<f32> = uniform(4000)
        .iter()
        .enumerate()
        .map(|(k, x)| corner[k % 2] + (*x * 40.0) as f32)
        .collect();
    let case = Case::open(2, positions.clone());
    let r = 1.0_f32;
    assert_eq!(build(2, positions, 1.0), case.pairs(|d2, _, _| d2 <= r * r));
}

#[test]
fn extreme_extents_neither_hang_nor_panic() {
    let case = Case::open(2, vec![-1.7e308, 1.7e308, 1.7e308, -1.7e308, 0.0, 0.0]);
    let built =
        radius_graph::<_, f64>(&case.particles(), Radius::Uniform(1.0), &case.options(1)).unwrap();
    assert_eq!(built.offsets, [0; 4]);
}

#[test]
fn a_box_far_smaller_than_the_radius_is_no_crowd() {
    let mut case = Case::open(2, vec![0.0; 6]);
    case.period = Some(vec![1e-300; 2]);
    let built =
        radius_graph::<_, f64>(&case.particles(), Radius::Uniform(1e10), &case.options(1)).unwrap();
    assert_eq!(built.edge_index, [1, 2, 0, 2, 0, 1, 0, 0, 1, 1, 2, 2]);
}
