//! Scenes are the same for a seed, stay in their box, and look like their counterparts.

use adaptgns_core::Error;
use adaptgns_core::mpm::{OBSTACLE_TYPE, Scene, Trajectory, WALLS, trajectory};
use rayon::prelude::*;

/// Scenes of blocks, of any number of particles; the other fills its box.
fn scenes() -> impl Iterator<Item = Scene> {
    let all = Scene::ALL.into_iter().map(|(_, scene)| scene);
    all.filter(|&scene| scene != Scene::Vortices)
}

/// Number of particles that are not an obstacle's.
fn mobile<const D: usize>(trajectory: &Trajectory<D>) -> usize {
    let types = trajectory.particle_types.iter();
    types.filter(|kind| **kind != OBSTACLE_TYPE).count()
}

fn assert_inside<const D: usize>(trajectory: &Trajectory<D>) {
    for position in &trajectory.positions {
        for x in position {
            assert!(
                (WALLS.low as f32..=WALLS.high as f32).contains(x),
                "{position:?}"
            );
        }
    }
}

#[test]
fn a_hundred_seeds_stay_in_the_box_for_a_thousand_frames() {
    (0..100_u64).into_par_iter().for_each(|seed| {
        let scene = scenes().nth(seed as usize % scenes().count()).unwrap();
        let made = trajectory::<2>(scene, seed, 1000, Some((16, 150))).unwrap();
        assert!((16..=150).contains(&mobile(&made)));
        assert_eq!(made.positions.len(), 1000 * made.particle_types.len());
        assert_inside(&made);
    });
}

#[test]
fn full_scenes_and_three_dimensions_stay_in_the_box() {
    assert_inside(&trajectory::<2>(Scene::Vortices, 1, 100, None).unwrap());
    scenes().par_bridge().for_each(|scene| {
        let seed = 1;
        assert_inside(&trajectory::<2>(scene, seed, 320, None).unwrap());
        let solid = trajectory::<3>(scene, seed, 150, Some((300, 600))).unwrap();
        assert!((300..=600).contains(&mobile(&solid)));
        assert_inside(&solid);
    });
}

#[test]
fn a_seed_is_the_same_alone_and_among_many_threads() {
    for scene in scenes() {
        let make = |seed: u64| trajectory::<2>(scene, seed, 60, Some((100, 200))).unwrap();
        let alone: Vec<_> = (0..6).map(make).collect();
        let together: Vec<_> = (0..24_u64).into_par_iter().map(|k| make(k % 6)).collect();
        for (k, among) in together.iter().enumerate() {
            assert_eq!(among, &alone[k % 6]);
        }
        assert_ne!(alone[0], alone[1]);
    }
}

#[test]
fn the_number_of_particles_is_the_one_asked_for() {
    for scene in scenes() {
        for count in [16, 17, 101, 997] {
            let made = trajectory::<2>(scene, 3, 1, Some((count, count))).unwrap();
            assert_eq!(mobile(&made), count);
        }
        let made = trajectory::<3>(scene, 3, 1, Some((1001, 1001))).unwrap();
        assert_eq!(mobile(&made), 1001);
    }
}

#[test]
fn vortices_fill_the_box() {
    let plane = trajectory::<2>(Scene::Vortices, 3, 1, Some((16, 2500))).unwrap();
    assert_eq!(plane.particle_types, [5; 2500]);
    let solid = trajectory::<3>(Scene::Vortices, 3, 1, None).unwrap();
    assert_eq!(solid.particle_types.len(), 8000);
    let error = trajectory::<2>(Scene::Vortices, 3, 1, Some((16, 2499))).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("accepted is a range that holds 2500"),
        "{error}"
    );
    let again = trajectory::<2>(Scene::Vortices, 3, 1, None).unwrap();
    assert_eq!(plane, again);
    assert_ne!(plane, trajectory::<2>(Scene::Vortices, 4, 1, None).unwrap());
}

#[test]
fn particles_are_of_the_scenes_materials_and_obstacles_come_last() {
    for scene in scenes() {
        let expected: &[i64] = match scene {
            Scene::WaterDrop => &[5],
            Scene::Sand => &[6],
            Scene::Goop | Scene::Jelly => &[7],
            Scene::MultiMaterial => &[5, 6, 7],
            Scene::WaterRamps | Scene::Stirrer => &[3, 5],
            Scene::Vortices => unreachable!("no scene of blocks"),
        };
        let mut found = Vec::new();
        for seed in 0..8 {
            let types = trajectory::<2>(scene, seed, 1, None)
                .unwrap()
                .particle_types;
            let obstacles = types.iter().skip_while(|kind| **kind != OBSTACLE_TYPE);
            assert!(obstacles.clone().all(|kind| *kind == OBSTACLE_TYPE));
            let mut kinds = types;
            kinds.sort_unstable();
            kinds.dedup();
            assert!(
                kinds.len() >= expected.len().min(2),
                "{scene:?} {seed}: {kinds:?}"
            );
            found.extend(kinds);
        }
        found.sort_unstable();
        found.dedup();
        assert_eq!(found, expected, "{scene:?}");
    }
}

#[test]
fn wrong_arguments_are_named() {
    let argument = |result: Result<Trajectory<2>, Error>| match result {
        Err(Error::InvalidArgument { argument, .. }) => argument,
        other => panic!("{other:?}"),
    };
    let make = |frames, particles| trajectory::<2>(Scene::WaterDrop, 0, frames, particles);
    assert_eq!(argument(make(0, None)), "frames");
    assert_eq!(argument(make(1, Some((10, 100)))), "particles");
    assert_eq!(argument(make(1, Some((200, 100)))), "particles");
    assert_eq!(argument(make(1, Some((100, 1_000_000)))), "particles");
    // Ramps leave less room than an empty box.
    let fits = Some((16, 2000));
    assert!(make(1, fits).is_ok());
    assert_eq!(
        argument(trajectory(Scene::WaterRamps, 0, 1, fits)),
        "particles"
    );
    assert!(matches!(make(usize::MAX, None), Err(Error::OutOfMemory(_))));
    let unknown = Scene::from_name("lava").unwrap_err().to_string();
    assert!(unknown.contains("'lava'") && unknown.contains("'waterdrop', 'sand'"));
}

/// Mean degree, and mean over particles of the part of their pairs of neighbours that
/// are neighbours too (networkx's average clustering), within the published radius.
fn graph_statistics(positions: &[[f32; 2]]) -> (f64, f64) {
    let near = |a: usize, b: usize| {
        let square: f32 = (0..2)
            .map(|k| (positions[a][k] - positions[b][k]).powi(2))
            .sum();
        a != b && square <= 0.015 * 0.015
    };
    let count = positions.len();
    let neighbours: Vec<Vec<usize>> = (0..count)
        .map(|a| (0..count).filter(|&b| near(a, b)).collect())
        .collect();
    let degree: usize = neighbours.iter().map(Vec::len).sum();
    let clustering: f64 = neighbours
        .iter()
        .filter(|list| list.len() > 1)
        .map(|list| {
            let linked: usize = list
                .iter()
                .map(|&a| list.iter().filter(|&&b| near(a, b)).count())
                .sum();
            linked as f64 / (list.len() * (list.len() - 1)) as f64
        })
        .sum();
    (degree as f64 / count as f64, clustering / count as f64)
}

/// The marks of `benchmarks/generate.py`, which compares more scenes and more figures.
#[test]
fn scenes_have_the_published_graph_statistics() {
    let published = [
        (Scene::WaterDrop, 567.0, 5.42, 0.494),
        (Scene::Sand, 1270.0, 6.76, 0.500),
    ];
    for (scene, particles, degree, clustering) in published {
        let counts = (0..200).map(|seed| {
            let made = trajectory::<2>(scene, seed, 1, None).unwrap();
            made.particle_types.len()
        });
        let mean = counts.sum::<usize>() as f64 / 200.0;
        assert!((mean / particles - 1.0).abs() < 0.1, "{mean} particles");

        let seeds = 8;
        let found: Vec<_> = (0..seeds)
            .into_par_iter()
            .map(|seed| {
                let made = trajectory::<2>(scene, seed, 101, None).unwrap();
                graph_statistics(&made.positions[100 * made.particle_types.len()..])
            })
            .collect();
        let mean_degree = found.iter().map(|pair| pair.0).sum::<f64>() / seeds as f64;
        let mean_clustering = found.iter().map(|pair| pair.1).sum::<f64>() / seeds as f64;
        assert!(
            (mean_degree / degree - 1.0).abs() < 0.15,
            "{scene:?} {mean_degree}"
        );
        assert!(
            (mean_clustering - clustering).abs() < 0.08,
            "{scene:?} {mean_clustering}"
        );
    }
}
