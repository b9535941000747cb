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
    sand_of(1.0)
}

fn sand_of(density: f64) -> Material {
    Material::Sand(Sand {
        density,
        lambda: 350.0,
        mu: 230.0,
        friction_angle: 35.0_f64.to_radians(),
        wall_friction: 0.4,
        collision_time: 0.01,
    })
}

fn jelly() -> Goop {
    Goop {
        bulk: 200.0,
        shear: 25.0,
        yield_stress: f64::INFINITY,
        viscosity: 0.02,
        wall_friction: 0.3,
    }
}

fn goop() -> Goop {
    Goop {
        yield_stress: 1.2,
        ..jelly()
    }
}

fn materials() -> [Material; 4] {
    [
        WATER,
        sand(),
        Material::Goop(jelly()),
        Material::Goop(goop()),
    ]
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
    for material in materials() {
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
    for material in materials() {
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
    // The paddle of the stirrer does work.
    let scenes = Scene::ALL.map(|(_, scene)| scene);
    for scene in scenes.into_iter().filter(|&s| s != Scene::Stirrer) {
        for seed in 0..3 {
            let full = scene == Scene::Vortices;
            let (particles, frames) = if full {
                (None, 100)
            } else {
                (Some((200, 400)), 500)
            };
            let mut simulation = scene.draw::<2>(seed, particles).unwrap();
            let start = simulation.energy();
            let mut before = start;
            let (mut lowest, mut worst) = (start, 0.0_f64);
            for _ in 0..frames {
                simulation.advance_frame();
                let now = simulation.energy();
                lowest = lowest.min(now);
                worst = worst.max((now - lowest) / start);
                before = now;
            }
            // Soft solids keep so much that their swings show the kinetic and the stored
            // energy being taken half a step apart.
            let soft = [Scene::Goop, Scene::Jelly, Scene::MultiMaterial].contains(&scene);
            let bound = if soft { 1e-3 } else { 1e-9 };
            assert!(worst < bound, "{scene:?} {seed}: {worst} of the energy");
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

#[test]
fn blocks_of_different_materials_collide_without_losing_momentum() {
    let bodies = vec![
        Body {
            material: sand_of(2.0),
            particles: lattice([0.25, 0.5], [0.45, 0.7], [1.0, 0.0]),
        },
        Body {
            material: Material::Goop(goop()),
            particles: lattice([0.5, 0.5], [0.7, 0.7], [-1.0, 0.0]),
        },
    ];
    let mut simulation = among(bodies, Vec::new());
    let mass = simulation.mass();
    assert!((mass - 3.0 * 0.2 * 0.2).abs() < 1e-12);
    let frames = 40;
    run(&mut simulation, frames);
    let momentum = simulation.momentum();
    // 2 − 1 against each other: what sticks together moves on at a third of the speed.
    assert!((momentum[0] / mass - 1.0 / 3.0).abs() < 1e-12);
    let fallen = GRAVITY * FRAME_TIME * frames as f64;
    assert!((momentum[1] / mass + fallen).abs() < 1e-12);
    let speeds: Vec<f64> = simulation.velocities().map(|v| v[0]).collect();
    let met = speeds
        .iter()
        .filter(|v| (**v - 1.0 / 3.0).abs() < 0.2)
        .count();
    assert!(met > speeds.len() / 2, "the blocks must have met");
}

/// Largest less smallest coordinate along each axis.
fn extent(simulation: &Simulation<2>) -> [f64; 2] {
    std::array::from_fn(|axis| {
        let along = || simulation.positions().map(|x| x[axis]);
        along().fold(f64::MIN, f64::max) - along().fold(f64::MAX, f64::min)
    })
}

#[test]
fn jelly_regains_its_shape_and_goop_does_not() {
    let block = lattice([0.4, 0.4], [0.6, 0.6], [0.0; 2]);
    let side = 0.2 - SPACING;
    let mut soft = simulation(Material::Goop(jelly()), block.clone());
    let mut flattest = side;
    for _ in 0..1600 {
        soft.advance_frame();
        flattest = f64::min(flattest, extent(&soft)[1]);
    }
    let speed = fastest(&soft);
    assert!(speed < 0.02, "jelly still wobbles at {speed} m/s");
    assert!(
        flattest < 0.9 * side,
        "the impact must flatten it: {flattest}"
    );
    let [width, height] = extent(&soft);
    // Its own weight of ρgh/2 on a Young's modulus of 3 μ or more presses it by 1 or 2 %,
    // and its foot more than that.
    assert!((width / side - 1.0).abs() < 0.05, "{width}");
    assert!((height / side - 1.0).abs() < 0.05, "{height}");

    let mut plastic = simulation(Material::Goop(goop()), block);
    run(&mut plastic, 1600);
    assert!(fastest(&plastic) < 0.02);
    let [width, height] = extent(&plastic);
    assert!(
        width > 1.3 * side && height < 0.9 * side,
        "{width} {height}"
    );
    assert!(height > 0.3 * side, "it must not flow like water: {height}");
}

/// A block of jelly on a ramp of this angle, down which it is released; the ramp's surface
/// goes through the box's middle.
fn block_on_ramp(angle: f64, friction: f64) -> Simulation<2> {
    let ramp = Bar::fixed(
        [0.5 + 0.03 * angle.sin(), 0.5 - 0.03 * angle.cos()],
        [0.35, 0.03],
        angle,
    );
    let stiff = Material::Goop(Goop {
        shear: 200.0,
        wall_friction: friction,
        ..jelly()
    });
    let (sine, cosine) = angle.sin_cos();
    let particles = lattice([0.1, 0.0], [0.25, 0.1], [0.0; 2])
        .into_iter()
        .map(|([x, y], velocity)| {
            let (x, y) = (x, y + 0.5 * SPACING);
            (
                [0.5 + cosine * x - sine * y, 0.5 + sine * x + cosine * y],
                velocity,
            )
        })
        .collect();
    let body = Body {
        material: stiff,
        particles,
    };
    among(vec![body], vec![ramp])
}

#[test]
fn a_block_slides_down_a_ramp_as_friction_lets_it() {
    let angle = 0.4_f64;
    for friction in [0.0, 0.2, 0.6] {
        let mut simulation = block_on_ramp(angle, friction);
        let along = |simulation: &Simulation<2>| {
            angle.cos() * mean(simulation, 0) + angle.sin() * mean(simulation, 1)
        };
        let start = along(&simulation);
        let frames = 120;
        run(&mut simulation, frames);
        let time = FRAME_TIME * frames as f64;
        let acceleration = GRAVITY * (angle.sin() - friction * angle.cos()).max(0.0);
        let slid = start - along(&simulation);
        let expected = 0.5 * acceleration * time * time;
        assert!(
            (slid - expected).abs() < 0.01 + 0.05 * expected,
            "{friction}: {slid} not {expected}"
        );
    }
}

#[test]
fn each_of_two_materials_rubs_the_floor_as_its_own_friction_lets_it() {
    let speed = 0.8;
    let sliding = |low: f64, friction| Body {
        material: Material::Goop(Goop {
            shear: 200.0,
            wall_friction: friction,
            ..jelly()
        }),
        particles: lattice([low, 0.105], [low + 0.15, 0.165], [speed, 0.0]),
    };
    let mut simulation = among(vec![sliding(0.12, 0.3), sliding(0.4, 0.0)], Vec::new());
    let centres = |simulation: &Simulation<2>| {
        let positions: Vec<_> = simulation.positions().map(|x| x[0]).collect();
        [0, 1].map(|k| positions[k * 90..][..90].iter().sum::<f64>() / 90.0)
    };
    let start = centres(&simulation);
    let frames = 60;
    run(&mut simulation, frames);
    let time = FRAME_TIME * frames as f64;
    let end = centres(&simulation);
    let braked = speed * time - 0.5 * 0.3 * GRAVITY * time * time;
    assert!(
        (end[0] - start[0] - braked).abs() < 0.005,
        "{}",
        end[0] - start[0]
    );
    assert!(
        (end[1] - start[1] - speed * time).abs() < 1e-3,
        "{}",
        end[1] - start[1]
    );
}

#[test]
fn nothing_enters_an_obstacle() {
    let mut touched = 0;
    for scene in [Scene::WaterRamps, Scene::Stirrer] {
        for seed in 0..6 {
            let mut simulation = scene.draw::<2>(seed, Some((300, 500))).unwrap();
            let bars = simulation.obstacles().to_vec();
            assert!(!bars.is_empty());
            for frame in 1..=400 {
                simulation.advance_frame();
                let time = FRAME_TIME * f64::from(frame);
                for position in simulation.positions() {
                    for bar in &bars {
                        let distance = bar.distance(*position, time);
                        // By rounding, at most.
                        assert!(distance > -1e-12, "{scene:?} {seed} {frame}: {distance}");
                        touched += usize::from(distance < 2.0 * SPACING);
                    }
                }
            }
        }
    }
    assert!(
        touched > 10_000,
        "the water must have met the obstacles: {touched}"
    );
}

#[test]
fn obstacles_move_as_prescribed_whatever_hits_them() {
    let paddle = Bar {
        centre: [0.5, 0.35],
        half: [0.12, 0.02],
        angle: 0.3,
        spin: 5.0,
        swing: [0.1, 0.02],
        period: 0.8,
    };
    let bodies = || {
        vec![Body {
            material: WATER,
            particles: lattice([0.3, 0.5], [0.7, 0.8], [0.0; 2]),
        }]
    };
    let mut hit = among(bodies(), vec![paddle]);
    let mut free = among(Vec::new(), vec![paddle]);
    let start: Vec<_> = hit.obstacle_positions().collect();
    for frame in 1..=200 {
        hit.advance_frame();
        free.advance_frame();
        assert!(hit.obstacle_positions().eq(free.obstacle_positions()));
        let time = FRAME_TIME * f64::from(frame);
        let (sine, cosine) = (5.0 * time).sin_cos();
        let phase = (std::f64::consts::TAU * time / 0.8).sin();
        for (now, then) in hit.obstacle_positions().zip(&start) {
            let (x, y) = (then[0] - 0.5, then[1] - 0.35);
            let expected = [
                0.5 + 0.1 * phase + cosine * x - sine * y,
                0.35 + 0.02 * phase + sine * x + cosine * y,
            ];
            for axis in 0..2 {
                assert!((now[axis] - expected[axis]).abs() < 1e-12);
            }
        }
    }
}

#[test]
fn a_pool_with_a_bar_in_it_keeps_its_volume_and_rests() {
    let bar = Bar::fixed([0.5, 0.2], [0.15, 0.03], 0.4);
    let depth = 0.25;
    let particles = lattice([0.1, 0.1], [0.9, 0.1 + depth], [0.0; 2])
        .into_iter()
        .filter(|(position, _)| bar.distance(*position, 0.0) > 0.5 * SPACING)
        .collect();
    let body = Body {
        material: WATER,
        particles,
    };
    let mut simulation = among(vec![body], vec![bar]);
    let full = mean(&simulation, 1) - BOX.low;
    run(&mut simulation, 800);
    let level = surface(&simulation);
    for height in level {
        assert!(
            (height / (depth - 0.5 * SPACING) - 1.0).abs() < 0.05,
            "{level:?}"
        );
    }
    let volume = (mean(&simulation, 1) - BOX.low) / full;
    assert!((volume - 1.0).abs() < 0.02, "volume {volume}");
    for _ in 0..40 {
        simulation.advance_frame();
        let speed = fastest(&simulation);
        assert!(speed < 0.02, "{speed} m/s");
    }
}

#[test]
fn sand_sinks_in_water_by_its_density() {
    let [light, heavy] = [1.0, 2.0].map(|density| {
        let water = lattice([0.1, 0.1], [0.9, 0.3], [0.0; 2]);
        let count = water.len();
        let bodies = vec![
            Body {
                material: WATER,
                particles: water,
            },
            Body {
                material: sand_of(density),
                particles: lattice([0.45, 0.3], [0.55, 0.4], [0.0; 2]),
            },
        ];
        let mut simulation = among(bodies, Vec::new());
        run(&mut simulation, 800);
        let sunk = simulation.positions().skip(count).map(|x| x[1] - BOX.low);
        sunk.sum::<f64>() / 100.0
    });
    assert!(heavy < 0.08, "wet sand at {heavy} m above the floor");
    assert!(
        light > heavy + 0.03,
        "as dense as water at {light}, denser at {heavy}"
    );
}

#[test]
fn blocks_at_rest_stay_at_rest_in_three_dimensions() {
    let walls = Walls {
        low: 0.0,
        high: 0.3,
    };
    let spacing = 0.02;
    let place = |index: usize| spacing * (index as f64 + 0.5);
    for material in materials() {
        let rest: Vec<_> = (0..15 * 15 * 5)
            .map(|k| {
                (
                    [place(k % 15), place(k / 225), place(k / 15 % 15)],
                    [0.0; 3],
                )
            })
            .collect();
        let body = Body {
            material,
            particles: rest.clone(),
        };
        let mut simulation =
            Simulation::<3>::new(walls, spacing, 2.0 * spacing, vec![body], Vec::new()).unwrap();
        run(&mut simulation, 100);
        let settled: Vec<_> = simulation.positions().copied().collect();
        run(&mut simulation, 100);
        for ((now, before), (start, _)) in simulation.positions().zip(&settled).zip(&rest) {
            for axis in 0..3 {
                let (moved, sagged) = (now[axis] - before[axis], now[axis] - start[axis]);
                assert!(
                    moved.abs() < 0.03 * spacing,
                    "{material:?} {now:?}: {moved}"
                );
                assert!(
                    sagged.abs() < 0.3 * spacing,
                    "{material:?} {now:?}: {sagged}"
                );
            }
        }
    }
}

/// Water that fills the periodic box, moved as a whole by `shift` with its lattice.
fn swirl(shift: f64) -> Simulation<2> {
    let wrap = |x: f64| BOX.low + (x - BOX.low).rem_euclid(BOX.high - BOX.low);
    let particles = lattice([BOX.low; 2], [BOX.high; 2], [0.0; 2])
        .into_iter()
        .map(|([x, y], _)| {
            let turn = |x: f64| 2.0 * std::f64::consts::PI * (x - BOX.low) / (BOX.high - BOX.low);
            let velocity = [
                turn(x).sin() * turn(y).cos(),
                -turn(x).cos() * turn(y).sin(),
            ];
            ([wrap(x + shift), wrap(y + shift)], velocity)
        })
        .collect();
    let material = Material::Water(Water {
        cohesion: f64::INFINITY,
        sound_speed: 14.0,
        exponent: 7.0,
        viscosity: 0.003,
        bulk_viscosity: 0.1,
    });
    let body = Body {
        material,
        particles,
    };
    Simulation::periodic(BOX, SPACING, 2.0 * SPACING, vec![body]).unwrap()
}

#[test]
fn a_periodic_box_has_no_place_of_its_own() {
    let shift = 5.0 * 2.0 * SPACING; // nodes fall on nodes
    let (mut here, mut there) = (swirl(0.0), swirl(shift));
    let energy = here.energy();
    run(&mut here, 20);
    run(&mut there, 20);
    let period = BOX.high - BOX.low;
    for (a, b) in here.positions().zip(there.positions()) {
        for axis in 0..2 {
            let apart = b[axis] - a[axis] - shift;
            assert!((apart - period * (apart / period).round()).abs() < 1e-9);
            assert!((BOX.low..=BOX.high).contains(&b[axis]));
        }
    }
    for momentum in here.momentum() {
        assert!(momentum.abs() < 1e-9);
    }
    // A Taylor-Green vortex decays by exp(-4 nu k^2 t) in energy, the grid adding a little.
    let decay =
        (-4.0 * 0.003 * (2.0 * std::f64::consts::PI / period).powi(2) * 20.0 * FRAME_TIME).exp();
    let left = here.energy() / energy;
    assert!(
        0.9 * decay < left && left < 1.01 * decay,
        "{left} of {decay}"
    );
}

#[test]
fn obstacles_that_cannot_be_are_refused() {
    let bar = Bar::fixed([0.5, 0.5], [0.1, 0.02], 0.0);
    let wrong = [
        Bar {
            half: [0.1, 0.0],
            ..bar
        },
        Bar { period: 0.0, ..bar },
        Bar {
            spin: f64::NAN,
            ..bar
        },
        Bar {
            swing: [f64::INFINITY, 0.0],
            ..bar
        },
    ];
    for bar in wrong {
        let Err(error) = Simulation::<2>::new(BOX, SPACING, 2.0 * SPACING, Vec::new(), vec![bar])
        else {
            panic!("{bar:?} was accepted");
        };
        let told = error.to_string();
        assert!(told.starts_with("obstacles: got Bar {"), "{told}");
        assert!(told.ends_with("accepted are finite numbers, with half and period above 0"));
    }
}
