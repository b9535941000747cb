//! Random scenes: blocks of matter thrown into a box, on obstacles in some.

use std::f64::consts::PI;

use super::grid::Walls;
use super::material::{Goop, Material, Sand, Water};
use super::obstacle::Bar;
use super::rng::Rng;
use super::solver::{Body, Simulation};
use crate::Error;

/// The box of every scene.
pub const WALLS: Walls = Walls {
    low: 0.1,
    high: 0.9,
};
/// Fewest particles a scene can be asked for.
const MIN_PARTICLES: usize = 16;
/// Largest part of the room for blocks that a scene can be asked to fill.
const MAX_FILL: f64 = 0.5;
/// Tries at placing blocks apart before settling for a single one.
const MAX_TRIES: usize = 100;
/// Distance of grid nodes over distance of particles.
const COARSENESS: f64 = 2.0;
/// Largest offset of a particle from its lattice point, in spacings.
const JITTER: f64 = 0.45;

const WATER: Material = Material::Water(Water {
    sound_speed: 14.0,
    exponent: 7.0,
    viscosity: 0.003,
    bulk_viscosity: 0.1,
    cohesion: 0.05,
});
/// Water with no surface, which may be pulled as it may be pressed.
const EVERYWHERE: Material = Material::Water(Water {
    sound_speed: 14.0,
    exponent: 7.0,
    viscosity: 0.003,
    bulk_viscosity: 0.1,
    cohesion: f64::INFINITY,
});
const SAND: Material = Material::Sand(Sand {
    lambda: 350.0,
    mu: 230.0,
    // Wet sand's, which sinks in water; alone, sand moves the same at any density, and a
    // power of two leaves even the rounding as it is.
    density: 2.0,
    friction_angle: 35.0_f64.to_radians(),
    wall_friction: 0.4,
    collision_time: 0.01,
});
/// Keeps the shape that an impact gives it.
const GOOP: Material = Material::Goop(Goop {
    bulk: 300.0,
    shear: 100.0,
    yield_stress: 2.0,
    viscosity: 0.02,
    wall_friction: 0.5,
});
/// Springs back and wobbles.
const JELLY: Material = Material::Goop(Goop {
    bulk: 200.0,
    shear: 25.0,
    yield_stress: f64::INFINITY,
    viscosity: 0.02,
    wall_friction: 0.3,
});

/// A family of random scenes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scene {
    /// One or two blocks of water.
    WaterDrop,
    /// One to three blocks of sand.
    Sand,
    /// One to three blocks of goop, a soft plastic solid.
    Goop,
    /// One or two blocks of jelly, a soft elastic solid.
    Jelly,
    /// Two to four blocks of water, sand and goop in turn.
    MultiMaterial,
    /// One or two blocks of water above one to three ramps.
    WaterRamps,
    /// One or two blocks of water above a paddle that turns and swings.
    Stirrer,
    /// Eddies in water that fills a periodic box, without gravity.
    Vortices,
}

/// What is drawn for a scene, at the resolution of its published counterpart.
struct Recipe {
    /// What the blocks are made of, in turn from a random one on.
    materials: &'static [Material],
    /// Draws the obstacles; given the least thickness that keeps their two sides apart.
    obstacles: fn(&mut Rng, f64) -> Vec<Bar>,
    /// Height \[m\] above which the blocks begin, and below which obstacles stay.
    ground: f64,
    /// Distance of particles \[m\], in 2D and 3D.
    spacing: [f64; 2],
    /// Range of the number of particles, in 2D and 3D.
    particles: [(usize, usize); 2],
    /// Probability of one block, two blocks, ...
    blocks: &'static [f64],
    /// Largest side over smallest.
    aspect: f64,
    /// Range of the horizontal velocities \[m/s\].
    sideways: (f64, f64),
    /// Range of the vertical velocity \[m/s\].
    upwards: (f64, f64),
}

struct Block<const D: usize> {
    low: [f64; D],
    size: [f64; D],
    velocity: [f64; D],
    particles: usize,
}

impl Scene {
    /// Every scene, with its name.
    pub const ALL: [(&'static str, Self); 8] = [
        ("waterdrop", Self::WaterDrop),
        ("sand", Self::Sand),
        ("goop", Self::Goop),
        ("jelly", Self::Jelly),
        ("multimaterial", Self::MultiMaterial),
        ("waterramps", Self::WaterRamps),
        ("stirrer", Self::Stirrer),
        ("vortices", Self::Vortices),
    ];

    /// The scene of this name.
    ///
    /// # Errors
    ///
    /// Lists the names there are if there is none.
    pub fn from_name(name: &str) -> Result<Self, Error> {
        Self::ALL
            .iter()
            .find(|(known, _)| *known == name)
            .map(|&(_, scene)| scene)
            .ok_or_else(|| {
                let names: Vec<String> = Self::ALL
                    .iter()
                    .map(|(known, _)| format!("'{known}'"))
                    .collect();
                Error::invalid(
                    "scene",
                    format!("got '{name}', accepted are {}", names.join(", ")),
                )
            })
    }

    /// Draws the scene of a seed, with a number of particles in `particles` (both ends
    /// included, obstacles not counted) or as many as its published counterpart has.
    ///
    /// # Errors
    ///
    /// If `particles` is empty, too small for a block or too large for the room.
    pub fn draw<const D: usize>(
        self,
        seed: u64,
        particles: Option<(usize, usize)>,
    ) -> Result<Simulation<D>, Error> {
        let Some(recipe) = self.recipe() else {
            return vortices(seed, particles);
        };
        let spacing = recipe.spacing[D - 2];
        let (low, high) = particles.unwrap_or(recipe.particles[D - 2]);
        let most = (MAX_FILL
            * ((WALLS.high - WALLS.low) / spacing).powi(D as i32 - 1)
            * ((WALLS.high - recipe.ground) / spacing)) as usize;
        if !(MIN_PARTICLES <= low && low <= high && high <= most) {
            return Err(Error::invalid(
                "particles",
                format!(
                    "got ({low}, {high}), accepted is {MIN_PARTICLES} <= low <= high <= {most}"
                ),
            ));
        }
        let mut rng = Rng::new(seed, self as u64 * 2 + D as u64);
        let count = rng.integer(low, high);
        let blocks = draw_blocks::<D>(&mut rng, &recipe, count);
        let obstacles = (recipe.obstacles)(&mut rng, 2.0 * COARSENESS * spacing);
        let first = match recipe.materials.len() {
            1 => 0,
            several => rng.integer(0, several - 1),
        };
        let body = |(index, block)| Body {
            material: recipe.materials[(first + index) % recipe.materials.len()],
            particles: fill(&mut rng, block, spacing),
        };
        let bodies = blocks.iter().enumerate().map(body).collect();
        let mut simulation =
            Simulation::new(WALLS, spacing, COARSENESS * spacing, bodies, obstacles)?;
        // Otherwise the pairs that the jitter brought together would part in flight.
        simulation.separate_fully();
        Ok(simulation)
    }

    /// Water's and sand's are chosen so that 30 scenes have the published statistics of
    /// their counterparts (`benchmarks/generate.py` compares them). None for what is not made of
    /// blocks.
    fn recipe(self) -> Option<Recipe> {
        let water = Recipe {
            materials: &[WATER],
            obstacles: |_, _| Vec::new(),
            ground: WALLS.low,
            spacing: [0.0102, 0.025],
            particles: [(220, 914), (1000, 6000)],
            blocks: &[0.8, 0.2],
            aspect: 1.6,
            sideways: (-0.5, 0.5),
            upwards: (-0.5, 0.5),
        };
        let sand = Recipe {
            materials: &[SAND],
            spacing: [0.009, 0.025],
            particles: [(400, 2140), (2000, 8000)],
            blocks: &[0.4, 0.3, 0.3],
            aspect: 2.0,
            sideways: (-3.0, 3.0),
            upwards: (-3.5, 0.5),
            ..water
        };
        Some(match self {
            Self::WaterDrop => water,
            Self::Sand => sand,
            Self::Goop => Recipe {
                materials: &[GOOP],
                sideways: (-1.5, 1.5),
                ..sand
            },
            Self::Jelly => Recipe {
                materials: &[JELLY],
                particles: [(300, 1200), (1000, 6000)],
                blocks: &[0.5, 0.5],
                sideways: (-1.5, 1.5),
                upwards: (-2.0, 0.5),
                ..water
            },
            Self::MultiMaterial => Recipe {
                materials: &[WATER, SAND, GOOP],
                particles: [(600, 1800), (2000, 5000)],
                blocks: &[0.0, 0.25, 0.5, 0.25],
                sideways: (-1.5, 1.5),
                upwards: (-2.0, 0.5),
                ..water
            },
            Self::WaterRamps => Recipe {
                obstacles: ramps,
                ground: 0.6,
                particles: [(300, 1100), (1000, 5000)],
                blocks: &[0.6, 0.4],
                ..water
            },
            Self::Stirrer => Recipe {
                obstacles: paddle,
                ground: 0.5,
                particles: [(400, 1400), (1500, 6000)],
                blocks: &[0.6, 0.4],
                ..water
            },
            Self::Vortices => return None,
        })
    }
}

/// Water that fills the periodic box, with velocities that add up from a few waves across their
/// directions: free of divergence and of any motion of the whole.
fn vortices<const D: usize>(
    seed: u64,
    particles: Option<(usize, usize)>,
) -> Result<Simulation<D>, Error> {
    const ALONG: [usize; 2] = [50, 20];
    const WAVES: usize = 4;
    /// Of each wave at its highest \[m/s\].
    const SPEED: f64 = 0.7;
    /// Most periods of a wave along an axis.
    const SHORTEST: usize = 2;
    let along = ALONG[D - 2];
    let count = along.pow(D as u32);
    if let Some((low, high)) = particles
        && !(low..=high).contains(&count)
    {
        return Err(Error::invalid(
            "particles",
            format!("got ({low}, {high}), accepted is a range that holds {count}, the full box"),
        ));
    }
    let period = WALLS.high - WALLS.low;
    let spacing = period / along as f64;
    let mut rng = Rng::new(seed, Scene::Vortices as u64 * 2 + D as u64);
    let waves: [_; WAVES] = std::array::from_fn(|_| {
        let wave = loop {
            let numbers: [f64; D] =
                std::array::from_fn(|_| rng.integer(0, 2 * SHORTEST) as f64 - SHORTEST as f64);
            if numbers.iter().any(|&number| number != 0.0) {
                break numbers;
            }
        };
        let square: f64 = wave.iter().map(|number| number * number).sum();
        let drawn: [f64; D] = std::array::from_fn(|_| rng.uniform(-1.0, 1.0));
        let inward: f64 = drawn.iter().zip(&wave).map(|(a, b)| a * b).sum::<f64>() / square;
        let across: [f64; D] = std::array::from_fn(|axis| drawn[axis] - inward * wave[axis]);
        let length = across.iter().map(|a| a * a).sum::<f64>().sqrt();
        let across = across.map(|a| SPEED * a / length);
        (wave, across, rng.uniform(0.0, 2.0 * PI))
    });
    let filling = (0..count)
        .map(|index| {
            let mut remainder = index;
            let position: [f64; D] = std::array::from_fn(|_| {
                let step = remainder % along;
                remainder /= along;
                WALLS.low + spacing * (step as f64 + 0.5 + rng.uniform(-JITTER, JITTER))
            });
            let mut velocity = [0.0; D];
            for (wave, across, phase) in &waves {
                let turn: f64 = (wave.iter().zip(&position))
                    .map(|(number, x)| 2.0 * PI * number * (x - WALLS.low) / period)
                    .sum();
                for axis in 0..D {
                    velocity[axis] += across[axis] * (turn + phase).cos();
                }
            }
            (position, velocity)
        })
        .collect();
    let body = Body {
        material: EVERYWHERE,
        particles: filling,
    };
    let mut simulation = Simulation::periodic(WALLS, spacing, COARSENESS * spacing, vec![body])?;
    simulation.separate_fully();
    Ok(simulation)
}

/// One to three inclined bars side by side, longer than thick, with room for matter to pass
/// on both sides of each and beneath.
fn ramps(rng: &mut Rng, thickness: f64) -> Vec<Bar> {
    const LONGEST: f64 = 0.36;
    const GAP: f64 = 0.1;
    let width = WALLS.high - WALLS.low;
    let most = (width / (GAP + 2.0 * thickness)) as usize;
    let number = rng.integer(1, most.min(3));
    let slot = width / number as f64;
    (0..number)
        .map(|index| {
            let steepness = rng.uniform(15.0_f64.to_radians(), 40.0_f64.to_radians());
            let angle = steepness.copysign(rng.uniform(-1.0, 1.0));
            let length = (slot - GAP).min(LONGEST) * rng.uniform(0.75, 1.0);
            let room = slot - GAP - length;
            let left = WALLS.low + slot * index as f64 + 0.5 * GAP;
            let centre = [
                left + 0.5 * length + rng.uniform(0.0, room),
                rng.uniform(0.3, 0.42),
            ];
            Bar::fixed(centre, [0.5 * length, 0.5 * thickness], angle)
        })
        .collect()
}

/// A bar that turns either way and swings sideways, low enough to dip into a pool.
fn paddle(rng: &mut Rng, thickness: f64) -> Vec<Bar> {
    let spin = rng.uniform(3.0, 8.0);
    vec![Bar {
        centre: [rng.uniform(0.42, 0.58), 0.31],
        half: [rng.uniform(0.12, 0.17), 0.5 * thickness],
        angle: rng.uniform(0.0, PI),
        spin: spin.copysign(rng.uniform(-1.0, 1.0)),
        swing: [rng.uniform(0.0, 0.1), 0.0],
        period: rng.uniform(1.0, 2.0),
    }]
}

/// Blocks that lie inside the box and apart from each other.
fn draw_blocks<const D: usize>(rng: &mut Rng, recipe: &Recipe, count: usize) -> Vec<Block<D>> {
    let spacing = recipe.spacing[D - 2];
    let number = draw_number(rng, recipe.blocks).min(count / MIN_PARTICLES);
    for _ in 0..MAX_TRIES {
        let mut blocks = Vec::with_capacity(number);
        let mut left = count;
        for index in 0..number {
            let share = left as f64 / (number - index) as f64;
            let particles = if index + 1 == number {
                left
            } else {
                (share * rng.uniform(0.7, 1.3)) as usize
            };
            left -= particles;
            blocks.push(draw_block(rng, recipe, particles, 1.0));
        }
        let inside = |block: &Block<D>| {
            (0..D).all(|axis| block.low[axis] + block.size[axis] <= WALLS.high - 0.5 * spacing)
        };
        let apart = |a: &Block<D>, b: &Block<D>| {
            (0..D).any(|axis| {
                a.low[axis] + a.size[axis] + spacing <= b.low[axis]
                    || b.low[axis] + b.size[axis] + spacing <= a.low[axis]
            })
        };
        if blocks.iter().all(inside)
            && (0..number).all(|a| (0..a).all(|b| apart(&blocks[a], &blocks[b])))
        {
            return blocks;
        }
    }
    // A block of the room's own proportions fits with every volume that is accepted.
    let proportionate = Recipe {
        aspect: 1.0,
        ..*recipe
    };
    let height = (WALLS.high - recipe.ground) / (WALLS.high - WALLS.low);
    vec![draw_block(rng, &proportionate, count, height)]
}

/// Number of blocks, of which `probabilities[k]` is that of k + 1.
fn draw_number(rng: &mut Rng, probabilities: &[f64]) -> usize {
    let mut level = rng.uniform(0.0, 1.0);
    for (index, probability) in probabilities.iter().enumerate() {
        level -= probability;
        if level < 0.0 {
            return index + 1;
        }
    }
    probabilities.len()
}

/// A block of `particles` at rest density, inside the room where it fits, whose height over
/// its width is `height` on average.
fn draw_block<const D: usize>(
    rng: &mut Rng,
    recipe: &Recipe,
    particles: usize,
    height: f64,
) -> Block<D> {
    let spacing = recipe.spacing[D - 2];
    let stretch = 0.5 * recipe.aspect.ln();
    let mut stretch: [f64; D] = std::array::from_fn(|_| rng.uniform(-stretch, stretch));
    stretch[1] += height.ln();
    let mean = stretch.iter().sum::<f64>() / D as f64;
    let side = spacing * (particles as f64).powf(1.0 / D as f64);
    // Whole rows across, and along the first axis whatever length gives the volume.
    let mut size = stretch.map(|s| (side * (s - mean).exp() / spacing).round().max(1.0) * spacing);
    let rows: f64 = size[1..].iter().map(|length| length / spacing).product();
    size[0] = particles as f64 * spacing / rows;
    let low = std::array::from_fn(|axis| {
        let start = if axis == 1 { recipe.ground } else { WALLS.low };
        let room = (WALLS.high - start - spacing - size[axis]).max(0.0);
        start + 0.5 * spacing + rng.uniform(0.0, room)
    });
    let velocity = std::array::from_fn(|axis| {
        let (low, high) = if axis == 1 {
            recipe.upwards
        } else {
            recipe.sideways
        };
        rng.uniform(low, high)
    });
    Block {
        low,
        size,
        velocity,
        particles,
    }
}

/// Positions and velocities of a block's particles, on a lattice of rows along the first
/// axis, each moved at random by up to [`JITTER`] spacings.
fn fill<const D: usize>(
    rng: &mut Rng,
    block: &Block<D>,
    spacing: f64,
) -> Vec<([f64; D], [f64; D])> {
    let across: [usize; D] = block.size.map(|length| (length / spacing).round() as usize);
    let rows: usize = across[1..].iter().product();
    let mut particles = Vec::with_capacity(block.particles);
    for row in 0..rows {
        // The rows share the particles evenly; where this leaves a remainder, some rows
        // are denser by one particle.
        let along = (row + 1) * block.particles / rows - row * block.particles / rows;
        for index in 0..along {
            let mut remainder = row;
            let position = std::array::from_fn(|axis| {
                let lattice = if axis == 0 {
                    block.size[0] / along as f64 * (index as f64 + 0.5)
                } else {
                    let step = remainder % across[axis];
                    remainder /= across[axis];
                    spacing * (step as f64 + 0.5)
                };
                block.low[axis] + lattice + spacing * rng.uniform(-JITTER, JITTER)
            });
            particles.push((position, block.velocity));
        }
    }
    particles
}
