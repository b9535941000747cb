//! The solver obeys mechanics: what is conserved stays, what rests stays at rest.

use adaptgns_core::mpm::{
    Bar, Body, FRAME_TIME, GRAVITY, Goop, Material, Sand, Scene, Simulation, Walls, Water,
};

const BOX: Walls = Walls {
    low: 0.1,
    high: 0.9,
};
const SPACING: f64 = 0.01;

const WATER: Material = Material::Water(Water {
    sound_speed: 14.0,
    exponent: 7.0,
    viscosity: 0.003,
    bulk_viscosity: 0.1,
    cohesion: 0.05,
});

fn sand() -> Material {
    Material::Sand(Sand {
        lambda: 350.0,
        mu: 230.0,
        density: 1.0,
        friction_angle: 35.0_f64.to_radians(),
        wall_friction: 0.4,
        collision_time: 0.01,
    })
}

/// A square lattice of particles that fills the box between two corners.
fn lattice(low: [f64; 2], high: [f64; 2], velocity: [f64; 2]) -> Vec<([f64; 2], [f64; 2])> {
    let [columns, rows] =
        std::array::from_fn(|axis| ((high[axis] - low[axis]) / SPACING).round() as usize);
    (0..columns * rows)
        .map(|k| {
            let index = [k % columns, k / columns];
            let place = |axis: usize| low[axis] + SPACING * (index[axis] as f64 + 0.5);
            ([place(0), place(1)], velocity)
        })
        .collect()
}

fn simulation(material: Material, particles: Vec<([f64; 2], [f64; 2])>) -> Simulation<2> {
    let body = Body {
        material,
        particles,
    };
    among(vec![body], Vec::new())
}

fn among(bodies: Vec<Body<2>>, obstacles: Vec<Bar>) -> Simulation<2> {
    Simulation::new(BOX, SPACING, 2.0 * SPACING, bodies, obstacles).unwrap()
}

fn run<const D: usize>(simulation: &mut Simulation<D>, frames: usize) {
    for _ in 0..frames {
        simulation.advance_frame();
    }
}

/// Mean coordinate, in metres.
fn mean(simulation: &Simulation<2>, axis: usize) -> f64 {
    let count = simulation.positions().len() as f64;
    simulation.positions().map(|x| x[axis]).sum::<f64>() / count
}

fn fastest(simulation: &Simulation<2>) -> f64 {
    simulation
        .velocities()
        .map(|v| v[0].hypot(v[1]))
        .fold(0.0, f64::max)
}

/// Height of the highest particle above the floor in each of eight columns of the box.
fn surface(simulation: &Simulation<2>) -> [f64; 8] {
    let mut heights = [0.0_f64; 8];
    for position in simulation.positions() {
        let column = ((position[0] - BOX.low) / (BOX.high - BOX.low) * 8.0) as usize;
        heights[column] = heights[column].max(position[1] - BOX.low);
    }
    heights
}

#[test]
fn free_fall_is_the_parabola() {
    let velocity = [0.7, 1.1];
    for material in [WATER, sand()] {
        let start = lattice([0.3, 0.5], [0.5, 0.7], velocity);
        let mut simulation = simulation(material, start.clone());
        for frame in 1..=60 {
            simulation.advance_frame();
            let time = FRAME_TIME * f64::from(frame);
            for (now, (then, _)) in simulation.positions().zip(&start) {
                assert!((now[0] - then[0] - velocity[0] * time).abs() < 1e-11);
                let rise = velocity[1] * time - 0.5 * GRAVITY * time * time;
                assert!((now[1] - then[1] - rise).abs() < 1e-11);
            }
            for now in simulation.velocities() {
                assert!((now[1] - velocity[1] + GRAVITY * time).abs() < 1e-9);
            }
        }
    }
}

#[test]
fn a_collision_in_the_air_conserves_mass_and_momentum() {
    for material in [WATER, sand()] {
        let mut particles = lattice([0.25, 0.5], [0.45, 0.7], [2.0, 0.6]);
        particles.extend(lattice([0.55, 0.55], [0.75, 0.7], [-1.5, 0.3]));
        let mut simulation = simulation(material, particles);
        let (mass, momentum) = (simulation.mass(), simulation.momentum());
        let centre = [mean(&simulation, 0), mean(&simulation, 1)];
        let calm = simulation.energy();
        let frames = 28;
        run(&mut simulation, frames);
        assert!(
            simulation.energy() < 0.95 * calm,
            "the blocks must have met"
        );
        let time = FRAME_TIME * frames as f64;
        assert_eq!(simulation.mass(), mass);
        let expected = [momentum[0], momentum[1] - mass * GRAVITY * time];
        for (now, expected) in simulation.momentum().into_iter().zip(expected) {
            let change = now - expected;
            assert!(change.abs() < 1e-12 * mass, "{change}");
        }
        let flight = [
            momentum[0] / mass * time,
            momentum[1] / mass * time - 0.5 * GRAVITY * time * time,
        ];
        for (axis, flown) in flight.into_iter().enumerate() {
            let error = mean(&simulation, axis) - centre[axis] - flown;
            assert!(error.abs() < 1e-12, "axis {axis}: {error}");
        }
    }
}

#[test]
fn water_at_rest_keeps_its_volume_and_rests() {
    let depth = 0.2;
    let mut simulation = simulation(WATER, lattice([0.1, 0.1], [0.9, 0.1 + depth], [0.0; 2]));
    for _ in 0..20 {
        run(&mut simulation, 50);
        let volume = 2.0 * (mean(&simulation, 1) - BOX.low) / depth;
        assert!((volume - 1.0).abs() < 0.05, "volume {volume}");
        let level = surface(&simulation);
        for height in level {
            assert!(
                (height / (depth - 0.5 * SPACING) - 1.0).abs() < 0.05,
                "{level:?}"
            );
        }
    }
    // The settling of the first moments has died out, not merely paused between swings.
    for _ in 0..40 {
        simulation.advance_frame();
        let speed = fastest(&simulation);
        assert!(speed < 0.01, "{speed} m/s");
    }
}

#[test]
fn a_column_of_sand_becomes_a_slope_and_one_of_water_a_level() {
    let column = lattice([0.1, 0.1], [0.3, 0.5], [0.0; 2]);
    let mut pile = simulation(sand(), column.clone());
    run(&mut pile, 400);
    let slope = surface(&pile);
    let speed = fastest(&pile);
    assert!(speed < 0.05, "sand still moves at {speed} m/s");
    assert!(slope[0] < 0.35, "the column stands: {slope:?}");
    assert!(slope[0] > 0.15, "no slope: {slope:?}");
    assert!(slope[0] > slope[2] && slope[2] > slope[4], "{slope:?}");
    // No steeper than friction allows, over the foot that is wider than a cell.
    assert!(
        (slope[0] - slope[3]) / 0.3 < 35.0_f64.to_radians().tan(),
        "{slope:?}"
    );

    let mut pool = simulation(WATER, column);
    run(&mut pool, 2000);
    let level = surface(&pool);
    // The column's area over the width of the box.
    for height in level {
        assert!((height - 0.1).abs() < 0.02, "{level:?}");
    }
}

#[test]
fn energy_never_grows() {
    for scene in [Scene::WaterDrop, Scene::Sand] {
        for seed in 0..3 {
            let mut simulation = scene.draw::<2>(seed, Some((200, 400))).unwrap();
            let start = simulation.energy();
            let mut before = start;
            let mut worst = 0.0_f64;
            for _ in 0..500 {
                simulation.advance_frame();
                let now = simulation.energy();
                worst = worst.max((now - before) / start);
                before = now;
            }
            assert!(
                worst < 1e-9,
                "{scene:?} {seed}: {worst} of the energy in a frame"
            );
            assert!(before < start, "{scene:?} {seed}");
        }
    }
}

#[test]
fn a_slab_across_a_slippery_box_moves_as_in_two_dimensions() {
    let walls = Walls {
        low: 0.0,
        high: 0.4,
    };
    let spacing = 0.02;
    let inviscid = Material::Water(Water {
        sound_speed: 14.0,
        exponent: 7.0,
        viscosity: 0.0,
        bulk_viscosity: 0.0,
        cohesion: 0.05,
    });
    let place = |index: usize| spacing * (index as f64 + 0.5);
    let flat: Vec<_> = (0..80)
        .map(|k| ([place(k % 8 + 4), place(k / 8 + 1)], [0.8, -0.5]))
        .collect();
    let deep = (0..20).flat_map(|layer| {
        let lift = move |x: [f64; 2], z| [x[0], x[1], z];
        flat.iter()
            .map(move |&(x, v)| (lift(x, place(layer)), lift(v, 0.0)))
    });
    let deep = Body {
        material: inviscid,
        particles: deep.collect(),
    };
    let shallow = Body {
        material: inviscid,
        particles: flat.clone(),
    };
    let mut thick = Simulation::<3>::new(walls, spacing, 0.04, vec![deep], Vec::new()).unwrap();
    let mut thin = Simulation::<2>::new(walls, spacing, 0.04, vec![shallow], Vec::new()).unwrap();
    for _ in 0..80 {
        thick.advance_frame();
        thin.advance_frame();
        let mut square = 0.0;
        for (k, solid) in thick.positions().enumerate() {
            let plane = thin.positions().nth(k % 80).unwrap();
            square += (solid[0] - plane[0]).powi(2) + (solid[1] - plane[1]).powi(2);
            // Only the layers next to the walls move along the third axis, by what the
            // missing half of their neighbourhood would have held back.
            assert!((solid[2] - place(k / 80)).abs() < 0.15 * spacing);
        }
        let deviation = (square / thick.positions().len() as f64).sqrt();
        assert!(deviation < 0.1 * spacing, "{deviation} m");
    }
    assert!(
        thin.positions()
            .zip(&flat)
            .any(|(x, (start, _))| (x[0] - start[0]).abs() > 0.05),
        "the water must have splashed"
    );
}
