//! The moving least squares material point method.

use std::ops::Range;

use super::grid::{Grid, Stencil, Walls};
use super::linalg::{self, Matrix};
use super::material::{History, Material};
use super::obstacle::{Bar, Pose};
use super::separation::Separation;
use crate::Error;

/// Standard gravity, along the second axis \[m/s²\].
pub const GRAVITY: f64 = 9.81;
/// Time between two frames \[s\].
pub const FRAME_TIME: f64 = 0.0025;
/// Part of a cell that sound and matter together may cross in one step.
const COURANT: f64 = 0.4;
/// Part of a squared cell that momentum may diffuse over in one step, half of what was
/// found stable: 0.24 is not.
const DIFFUSION: f64 = 0.12;
/// Distance that particles keep from the walls, in grid spacings: small against their
/// own distance, large against the rounding of a position to single precision.
const WALL_MARGIN: f64 = 0.05;
/// Distance from an obstacle at which a node stops what runs into it, in grid spacings: all
/// nodes that a particle on the surface weighs most on. With half of it, water around a bar
/// never came to rest and lost 3 % of its volume in five seconds; with this, 0.1 %.
const OBSTACLE_REACH: f64 = 1.0;
/// Part of what a close pair lacks in distance that is made up in one frame: slow enough
/// to add nothing visible to the accelerations.
const SEPARATION_RATE: f64 = 0.1;

#[derive(Clone)]
struct Particle<const D: usize> {
    position: [f64; D],
    /// Velocity half a step before the time of the position.
    velocity: [f64; D],
    velocity_gradient: Matrix<D>,
    history: History<D>,
}

/// Particles of one material: their positions \[m\] and velocities \[m/s\].
#[derive(Debug, Clone, PartialEq)]
pub struct Body<const D: usize> {
    /// What they are made of, for good.
    pub material: Material,
    /// Position and velocity of each.
    pub particles: Vec<([f64; D], [f64; D])>,
}

/// Bodies of one or several materials in a box with obstacles, after Hu et al., "A moving
/// least squares material point method" (2018), with affine transfers (Jiang et al. 2015).
///
/// A step scatters mass, momentum and stress to the grid, solves there for velocities
/// with gravity, walls and obstacles, and gathers them back. All materials share one
/// velocity field: where they touch they do not slide along each other, and they mix no
/// finer than a cell. Velocities live half a step before the positions, so that free
/// flight is an exact parabola whatever the step.
pub struct Simulation<const D: usize> {
    particles: Vec<Particle<D>>,
    /// Materials, and the particles of each: body after body.
    materials: Vec<(Material, Range<usize>)>,
    obstacles: Vec<Bar>,
    /// The obstacles at the time of the positions.
    poses: Vec<Pose>,
    /// Friction coefficient at walls and obstacles of the roughest material.
    friction: f64,
    /// The same of the roughest material that reaches each node; empty where all materials
    /// are equally rough.
    frictions: Vec<f64>,
    /// Acceleration against the second axis \[m/s²\].
    gravity: f64,
    /// Whether what leaves the box on one side comes in on the other.
    periodic: bool,
    grid: Grid<D>,
    separation: Separation<D>,
    walls: Walls,
    particle_spacing: f64,
    /// Volume of a particle at rest.
    volume: f64,
    /// Frames since the beginning.
    frame: u64,
    /// Length of the last step \[s\].
    step: f64,
}

impl<const D: usize> Simulation<D> {
    /// Particles of equal volume, at rest density when `particle_spacing` apart on a
    /// square lattice, on a grid of about `grid_spacing`. Positions outside the walls or
    /// inside an obstacle are moved to their surface.
    ///
    /// Obstacles keep matter on their two sides apart if they are at least two grid
    /// spacings thick.
    ///
    /// # Errors
    ///
    /// If a length is not positive and finite, a position or velocity not finite, or an
    /// obstacle without size or not always somewhere.
    pub fn new(
        walls: Walls,
        particle_spacing: f64,
        grid_spacing: f64,
        bodies: Vec<Body<D>>,
        obstacles: Vec<Bar>,
    ) -> Result<Self, Error> {
        Self::build(
            walls,
            particle_spacing,
            grid_spacing,
            bodies,
            obstacles,
            false,
        )
    }

    /// As [`Self::new`], in a periodic box between `walls` that are one and the same place, without
    /// gravity and obstacles.
    ///
    /// # Errors
    ///
    /// If a length is not positive and finite, or a position or velocity not finite.
    pub fn periodic(
        walls: Walls,
        particle_spacing: f64,
        grid_spacing: f64,
        bodies: Vec<Body<D>>,
    ) -> Result<Self, Error> {
        Self::build(
            walls,
            particle_spacing,
            grid_spacing,
            bodies,
            Vec::new(),
            true,
        )
    }

    fn build(
        walls: Walls,
        particle_spacing: f64,
        grid_spacing: f64,
        bodies: Vec<Body<D>>,
        obstacles: Vec<Bar>,
        periodic: bool,
    ) -> Result<Self, Error> {
        const {
            assert!(D == 2 || D == 3);
        }
        let positive = [
            ("walls", walls.high - walls.low),
            ("particle_spacing", particle_spacing),
            ("grid_spacing", grid_spacing),
        ];
        for (argument, length) in positive {
            if !(length > 0.0 && length.is_finite()) {
                return Err(Error::invalid(
                    argument,
                    format!("got a length of {length}, accepted are positive ones"),
                ));
            }
        }
        if let Some(bar) = obstacles.iter().find(|bar| !bar.is_possible()) {
            return Err(Error::invalid(
                "obstacles",
                format!("got {bar:?}, accepted are finite numbers, with half and period above 0"),
            ));
        }
        let rough = |body: &Body<D>| body.material.wall_friction();
        let friction = bodies.iter().map(rough).fold(0.0, f64::max);
        let differ = bodies.iter().any(|body| rough(body) != friction);
        let grid = Grid::new(walls, grid_spacing, periodic);
        let frictions = vec![0.0; if differ { grid.nodes.len() } else { 0 }];
        let mut materials = Vec::with_capacity(bodies.len());
        let mut particles = Vec::with_capacity(bodies.iter().map(|b| b.particles.len()).sum());
        for body in bodies {
            let first = particles.len();
            materials.push((body.material, first..first + body.particles.len()));
            for (position, velocity) in body.particles {
                if !position.iter().chain(&velocity).all(|x| x.is_finite()) {
                    return Err(Error::invalid(
                        "particles",
                        format!(
                            "got {position:?} moving at {velocity:?}, accepted are finite numbers"
                        ),
                    ));
                }
                particles.push(Particle {
                    position,
                    velocity,
                    velocity_gradient: linalg::zero(),
                    history: History::at_rest(),
                });
            }
        }
        let mut simulation = Self {
            particles,
            materials,
            poses: obstacles.iter().map(|bar| bar.at(0.0)).collect(),
            obstacles,
            friction,
            frictions,
            gravity: if periodic { 0.0 } else { GRAVITY },
            periodic,
            grid,
            separation: Separation::new(walls, particle_spacing, periodic),
            walls,
            particle_spacing,
            volume: particle_spacing.powi(D as i32),
            frame: 0,
            step: 0.0,
        };
        simulation.keep_inside();
        Ok(simulation)
    }

    /// Advances by [`FRAME_TIME`].
    pub fn advance_frame(&mut self) {
        let (mut fastest, mut sound) = (0.0_f64, 0.0_f64);
        for (material, particle) in self.particles_with_material() {
            let square = linalg::dot(&particle.velocity, &particle.velocity);
            assert!(square.is_finite(), "a stable step cannot diverge");
            fastest = fastest.max(square.sqrt());
            sound = sound.max(material.sound_speed(&particle.history));
        }
        for bar in &self.obstacles {
            fastest = fastest.max(bar.top_speed());
        }
        let viscosities = self.materials.iter().map(|(m, _)| m.viscosity());
        let viscosity = viscosities.fold(0.0, f64::max);
        let spacing = self.grid.spacing;
        let longest = f64::min(
            COURANT * spacing / (fastest + sound),
            DIFFUSION * spacing.powi(2) / viscosity,
        );
        let steps = (FRAME_TIME / longest).ceil().max(1.0);
        self.change_step(FRAME_TIME / steps);
        for step in 1..=steps as usize {
            let time = FRAME_TIME * (self.frame as f64 + step as f64 / steps);
            self.advance_step(time);
        }
        self.frame += 1;
        self.separate(SEPARATION_RATE);
    }

    /// Positions in the order of construction \[m\].
    pub fn positions(&self) -> impl ExactSizeIterator<Item = &[f64; D]> {
        self.particles.iter().map(|particle| &particle.position)
    }

    /// Velocities at the time of the positions \[m/s\].
    pub fn velocities(&self) -> impl ExactSizeIterator<Item = [f64; D]> {
        self.particles.iter().map(|particle| {
            let mut velocity = particle.velocity;
            velocity[1] -= 0.5 * self.gravity * self.step;
            velocity
        })
    }

    /// GNS's particle types in the order of construction.
    pub fn particle_types(&self) -> impl Iterator<Item = i64> {
        self.particles_with_material()
            .map(|(material, _)| material.particle_type())
    }

    /// The bars that the particles collide with.
    pub fn obstacles(&self) -> &[Bar] {
        &self.obstacles
    }

    /// Positions of the obstacles' own particles \[m\], which fill them as densely as matter
    /// at rest fills the box; always the same ones in the same order.
    pub fn obstacle_positions(&self) -> impl Iterator<Item = [f64; D]> {
        self.obstacles
            .iter()
            .zip(&self.poses)
            .flat_map(|(bar, pose)| {
                bar.lattice::<D>(self.walls, self.particle_spacing)
                    .into_iter()
                    .map(|point| pose.place(point))
            })
    }

    /// Mass of all particles, where water at rest has density 1.
    pub fn mass(&self) -> f64 {
        self.particles_with_material()
            .map(|(material, _)| self.mass_of(material))
            .sum()
    }

    /// Sum of mass times velocity.
    pub fn momentum(&self) -> [f64; D] {
        let mut momentum = [0.0; D];
        for ((material, _), velocity) in self.particles_with_material().zip(self.velocities()) {
            for axis in 0..D {
                momentum[axis] += self.mass_of(material) * velocity[axis];
            }
        }
        momentum
    }

    /// Kinetic, potential and stored energy.
    pub fn energy(&self) -> f64 {
        // Inertia of a quadratic spline about its centre (Jiang et al. 2015).
        let inertia = 0.25 * self.grid.spacing.powi(2);
        self.particles_with_material()
            .zip(self.velocities())
            .map(|((material, particle), velocity)| {
                let spin: f64 = particle
                    .velocity_gradient
                    .iter()
                    .map(|row| linalg::dot(row, row))
                    .sum();
                let per_mass = 0.5 * linalg::dot(&velocity, &velocity)
                    + 0.5 * inertia * spin
                    + self.gravity * (particle.position[1] - self.walls.low)
                    + material.energy(&particle.history);
                self.mass_of(material) * per_mass
            })
            .sum()
    }

    /// Mass of a particle of this material.
    fn mass_of(&self, material: &Material) -> f64 {
        self.volume * material.density()
    }

    fn particles_with_material(&self) -> impl Iterator<Item = (&Material, &Particle<D>)> {
        self.materials.iter().flat_map(|(material, range)| {
            let particles = self.particles[range.clone()].iter();
            particles.map(move |particle| (material, particle))
        })
    }

    /// Velocities are those of half a step before: a new step moves that moment, between
    /// which gravity acts.
    fn change_step(&mut self, step: f64) {
        let kick = -0.5 * self.gravity * (self.step - step);
        for particle in &mut self.particles {
            particle.velocity[1] += kick;
        }
        self.step = step;
    }

    /// One step, to the time `end`.
    fn advance_step(&mut self, end: f64) {
        self.grid
            .cover(self.particles.iter().map(|particle| &particle.position));
        self.scatter();
        if !self.frictions.is_empty() {
            self.scatter_friction();
        }
        self.update_grid();
        self.gather();
        self.poses.clear();
        self.poses
            .extend(self.obstacles.iter().map(|bar| bar.at(end)));
        self.keep_inside();
    }

    fn scatter(&mut self) {
        let stress_scale = -self.step * 4.0 / self.grid.spacing.powi(2);
        for (material, range) in &self.materials {
            let mass = self.volume * material.density();
            for particle in &mut self.particles[range.clone()] {
                let stress = material.stress(
                    &mut particle.history,
                    &particle.velocity_gradient,
                    self.step,
                );
                let mut affine = particle.velocity_gradient;
                for i in 0..D {
                    for j in 0..D {
                        affine[i][j] += stress_scale * stress[i][j];
                    }
                }
                let stencil = self.grid.stencil(&particle.position);
                for k in 0..Stencil::<D>::LEN {
                    let node = &mut self.grid.nodes[stencil.nodes[k]];
                    let weighted_mass = stencil.weights[k] * mass;
                    node.mass += weighted_mass;
                    for axis in 0..D {
                        node.velocity[axis] += weighted_mass
                            * (particle.velocity[axis]
                                + linalg::dot(&affine[axis], &stencil.arms[k]));
                    }
                }
            }
        }
    }

    fn scatter_friction(&mut self) {
        self.frictions.fill(0.0);
        for (material, range) in &self.materials {
            let friction = material.wall_friction();
            for particle in &self.particles[range.clone()] {
                let stencil = self.grid.stencil(&particle.position);
                for &node in &stencil.nodes[..Stencil::<D>::LEN] {
                    self.frictions[node] = self.frictions[node].max(friction);
                }
            }
        }
    }

    /// Momentum to velocity, gravity, obstacles, walls.
    fn update_grid(&mut self) {
        let kick = -self.gravity * self.step;
        let reach = OBSTACLE_REACH * self.grid.spacing;
        let (poses, common, frictions) = (&self.poses, self.friction, &self.frictions);
        self.grid.for_each_node(|node, place| {
            if node.mass == 0.0 {
                return;
            }
            for component in &mut node.velocity {
                *component /= node.mass;
            }
            node.velocity[1] += kick;
            let friction = frictions.get(place.index).copied().unwrap_or(common);
            for pose in poses {
                let point = [place.position[0], place.position[1]];
                pose.stop(&mut node.velocity, point, reach, friction);
            }
            for axis in 0..D {
                let into = place.sides[axis] * node.velocity[axis];
                if into > 0.0 {
                    node.velocity[axis] = 0.0;
                    if friction > 0.0 {
                        slow(&mut node.velocity, axis, friction * into);
                    }
                }
            }
        });
    }

    fn gather(&mut self) {
        let gradient_scale = 4.0 / self.grid.spacing.powi(2);
        for particle in &mut self.particles {
            let stencil = self.grid.stencil(&particle.position);
            let mut velocity = [0.0; D];
            let mut gradient: Matrix<D> = linalg::zero();
            for k in 0..Stencil::<D>::LEN {
                let node = &self.grid.nodes[stencil.nodes[k]];
                for axis in 0..D {
                    let weighted = stencil.weights[k] * node.velocity[axis];
                    velocity[axis] += weighted;
                    for other in 0..D {
                        gradient[axis][other] += gradient_scale * weighted * stencil.arms[k][other];
                    }
                }
            }
            particle.velocity = velocity;
            particle.velocity_gradient = gradient;
            for axis in 0..D {
                particle.position[axis] += self.step * velocity[axis];
            }
        }
    }

    /// Moves particles that are too close apart, by the part `strength` of what they lack.
    fn separate(&mut self, strength: f64) {
        let positions: Vec<_> = self.positions().copied().collect();
        let shifts = self.separation.shifts(&positions, strength);
        for (particle, shift) in self.particles.iter_mut().zip(shifts) {
            for axis in 0..D {
                particle.position[axis] += shift[axis];
            }
        }
        self.keep_inside();
    }

    /// Moves the particles until hardly a pair is too close.
    pub(crate) fn separate_fully(&mut self) {
        const ROUNDS: usize = 30;
        for _ in 0..ROUNDS {
            self.separate(0.5);
        }
    }

    /// Out of the obstacles and, above all, inside the walls; in a periodic box to the image inside.
    fn keep_inside(&mut self) {
        if self.periodic {
            let (low, period) = (self.walls.low, self.walls.high - self.walls.low);
            for particle in &mut self.particles {
                for x in &mut particle.position {
                    *x = low + (*x - low).rem_euclid(period);
                }
            }
            return;
        }
        let margin = WALL_MARGIN * self.grid.spacing;
        let (low, high) = (self.walls.low + margin, self.walls.high - margin);
        for particle in &mut self.particles {
            for pose in &self.poses {
                pose.push_out(&mut particle.position, margin);
            }
            for x in &mut particle.position {
                *x = x.clamp(low, high);
            }
        }
    }
}

/// Takes `amount` off the speed along a wall with the normal `axis`, at most all of it.
fn slow<const D: usize>(velocity: &mut [f64; D], axis: usize, amount: f64) {
    let sliding = linalg::dot(velocity, velocity) - velocity[axis].powi(2);
    let kept = (1.0 - amount / sliding.max(f64::MIN_POSITIVE).sqrt()).max(0.0);
    for (other, component) in velocity.iter_mut().enumerate() {
        if other != axis {
            *component *= kept;
        }
    }
}
