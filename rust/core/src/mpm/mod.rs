//! The embedded data generator: a moving least squares material point solver, the
//! materials it knows, and the random scenes it simulates.
//!
//! Data flows one way: a [`Scene`] and a seed draw the blocks, [`Simulation`] moves
//! them, [`trajectory`] records its frames. A new material is a variant of [`Material`],
//! a new scene one of [`Scene`].

#![expect(
    clippy::needless_range_loop,
    reason = "one index runs over several vectors and matrices of constant size"
)]

mod grid;
mod linalg;
mod material;
mod rng;
mod scene;
mod separation;
mod solver;

pub use grid::Walls;
pub use material::{Contact, Material, Sand, Water};
pub use scene::{Scene, WALLS};
pub use solver::{FRAME_TIME, GRAVITY, Simulation};

use crate::Error;

/// The positions of a scene's particles, frame after frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory<const D: usize> {
    /// Positions \[m\], all particles of the first frame first.
    pub positions: Vec<[f32; D]>,
    /// Number of particles.
    pub particles: usize,
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
    let count = simulation.positions().len();
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
        positions.extend(
            simulation
                .positions()
                .map(|x| x.map(|coordinate| coordinate as f32)),
        );
    }
    Ok(Trajectory {
        positions,
        particles: count,
    })
}
