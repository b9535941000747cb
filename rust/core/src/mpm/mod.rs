//! The embedded data generator: a moving least squares material point solver, the
//! materials it knows, and the random scenes it simulates.
//!
//! Data flows one way: a [`Scene`] and a seed draw bodies and obstacles, [`Simulation`]
//! moves them, [`trajectory`] records its frames. A new material is a variant of
//! [`Material`], a new scene one of [`Scene`].

mod grid;
mod linalg;
mod material;
mod obstacle;
mod rng;
mod scene;
mod separation;
mod solver;

pub use grid::Walls;
pub use material::{Goop, Material, Sand, Water};
pub use obstacle::{Bar, OBSTACLE_TYPE};
pub use scene::{Scene, WALLS};
pub use solver::{Body, FRAME_TIME, GRAVITY, Simulation};

use crate::Error;

/// The particles of a scene, frame after frame: those of the bodies first, then those of
/// the obstacles.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory<const D: usize> {
    /// Positions \[m\], all particles of the first frame first.
    pub positions: Vec<[f32; D]>,
    /// GNS's type of each particle.
    pub particle_types: Vec<i64>,
}

/// Simulates the scene of a seed and records `frames` frames, [`FRAME_TIME`] apart; the
/// first is the scene as drawn.
///
/// One thread does all the work, and the result depends on nothing but the arguments.
///
/// # Errors
///
/// If `frames` is zero, or for the reasons of [`Scene::draw`].
pub fn trajectory<const D: usize>(
    scene: Scene,
    seed: u64,
    frames: usize,
    particles: Option<(usize, usize)>,
) -> Result<Trajectory<D>, Error> {
    if frames == 0 {
        return Err(Error::invalid("frames", "got 0, accepted is 1 or more"));
    }
    let mut simulation = scene.draw::<D>(seed, particles)?;
    let mut particle_types: Vec<i64> = simulation.particle_types().collect();
    let obstacle_particles = simulation.obstacle_positions().count();
    particle_types.extend(std::iter::repeat_n(OBSTACLE_TYPE, obstacle_particles));
    let count = particle_types.len();
    let mut positions = Vec::new();
    positions
        .try_reserve_exact(frames.saturating_mul(count))
        .map_err(|_| {
            Error::OutOfMemory(format!(
                "frames: {frames} frames of {count} particles do not fit in memory"
            ))
        })?;
    for frame in 0..frames {
        if frame > 0 {
            simulation.advance_frame();
        }
        let bodies = simulation.positions().copied();
        let frame = bodies.chain(simulation.obstacle_positions());
        positions.extend(frame.map(|x| x.map(|coordinate| coordinate as f32)));
    }
    Ok(Trajectory {
        positions,
        particle_types,
    })
}
