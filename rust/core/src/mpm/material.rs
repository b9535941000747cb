//! Constitutive laws. Stresses and moduli are per unit of the material's own rest
//! density, so that they are squared speeds [m²/s²].

use super::linalg::{self, Matrix};

/// What a particle is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Material {
    /// A weakly compressible liquid.
    Water(Water),
    /// A dry granular medium.
    Sand(Sand),
    /// A soft solid.
    Goop(Goop),
}

/// Tait's equation of state p = c²/γ ((ρ/ρ₀)^γ − 1) with a Newtonian viscosity.
///
/// The density follows the divergence of the velocity. Measured on the grid instead it
/// would need no memory, but it would also carry the noise of the particles' arrangement
/// relative to the grid, of several per cent where one per cent is c²/100 of pressure:
/// drops then burst in free fall, or heat up without end if tension holds them together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Water {
    /// Speed of sound at rest density \[m/s\].
    pub sound_speed: f64,
    /// Exponent γ.
    pub exponent: f64,
    /// Kinematic shear viscosity \[m²/s\].
    pub viscosity: f64,
    /// Kinematic bulk viscosity \[m²/s\], far above that of real water: it silences
    /// the sound of an impact, which would ring on for seconds.
    pub bulk_viscosity: f64,
    /// Largest expansion that water resists and remembers, as a logarithm of volume.
    /// What is torn further apart is spray, as good as at rest when it meets water again.
    pub cohesion: f64,
}

/// Drucker–Prager plasticity on Hencky strains (Klár et al. 2016, section 6).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sand {
    /// Lamé's first parameter \[m²/s²\].
    pub lambda: f64,
    /// Shear modulus \[m²/s²\].
    pub mu: f64,
    /// Density at rest over that of water.
    pub density: f64,
    /// Angle of internal friction \[rad\].
    pub friction_angle: f64,
    /// Friction coefficient at walls and obstacles.
    pub wall_friction: f64,
    /// Time \[s\] whose product with the divergence of the velocity is the part of the
    /// pressure lost in expansion and added in compression, a bulk viscosity: colliding
    /// grains don't bounce, while the elastic continuum of Klár et al. would.
    pub collision_time: f64,
}

/// A neo-Hookean solid that flows where it is sheared beyond its yield stress (J₂
/// plasticity by radial return, Simo and Hughes 1998, section 9.3), with the viscosity of
/// a Kelvin–Voigt solid.
///
/// The stored energy is κ/2 (½(J² − 1) − ln J) + μ/2 (tr b̄ − d), where J is the ratio of
/// volumes and b̄ the elastic left Cauchy–Green tensor without its change of volume.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Goop {
    /// Bulk modulus κ \[m²/s²\].
    pub bulk: f64,
    /// Shear modulus μ \[m²/s²\].
    pub shear: f64,
    /// Shear stress that it bears \[m²/s²\]; infinite for a jelly, which never flows.
    pub yield_stress: f64,
    /// Kinematic viscosity \[m²/s\].
    pub viscosity: f64,
    /// Friction coefficient at walls and obstacles.
    pub wall_friction: f64,
}

/// What a material remembers of a particle's past.
#[derive(Debug, Clone, Copy)]
pub(crate) struct History<const D: usize> {
    /// Sand: elastic left Cauchy–Green tensor b = F Fᵀ. Its eigenvectors are the left
    /// singular vectors of F and its eigenvalues the squared singular values, which is
    /// all that isotropic return mapping needs. Goop: b̄ = b / (det b)^(1/d).
    left_cauchy_green: Matrix<D>,
    /// Logarithm of the volume over the volume at rest. Sand: of the part gained while
    /// falling apart, which is given back before the material bears load again (the
    /// volume correction of Klár et al.).
    log_volume: f64,
}

impl<const D: usize> History<D> {
    pub(crate) fn at_rest() -> Self {
        Self {
            left_cauchy_green: linalg::identity(),
            log_volume: 0.0,
        }
    }

    /// The left Cauchy–Green tensor after the velocity gradient has acted for the time `dt`.
    fn stretched(&self, velocity_gradient: &Matrix<D>, dt: f64) -> Matrix<D> {
        let mut step = linalg::identity();
        for i in 0..D {
            for j in 0..D {
                step[i][j] += dt * velocity_gradient[i][j];
            }
        }
        linalg::congruence(&step, &self.left_cauchy_green)
    }
}

impl Material {
    /// Number of the material in the data sets of GNS.
    pub fn particle_type(&self) -> i64 {
        match self {
            Self::Water(_) => 5,
            Self::Sand(_) => 6,
            Self::Goop(_) => 7,
        }
    }

    /// Density at rest over that of water.
    pub(crate) fn density(&self) -> f64 {
        match self {
            Self::Water(_) | Self::Goop(_) => 1.0,
            Self::Sand(sand) => sand.density,
        }
    }

    /// Speed of sound \[m/s\] in a particle.
    pub(crate) fn sound_speed<const D: usize>(&self, history: &History<D>) -> f64 {
        match self {
            Self::Water(water) => {
                let compression = (-history.log_volume).max(0.0);
                water.sound_speed * (0.5 * (water.exponent - 1.0) * compression).exp()
            }
            Self::Sand(sand) => (sand.lambda + 2.0 * sand.mu).sqrt(),
            Self::Goop(goop) => goop.sound_speed(history),
        }
    }

    /// Largest constant kinematic viscosity \[m²/s\] of a deformation. That of sand varies
    /// with the pressure and never more than doubles it, which is no limit to the step.
    pub(crate) fn viscosity(&self) -> f64 {
        match self {
            Self::Water(water) => water.bulk_viscosity + 2.0 * water.viscosity,
            Self::Sand(_) => 0.0,
            Self::Goop(goop) => 2.0 * goop.viscosity,
        }
    }

    /// Coefficient of Coulomb friction at walls and obstacles, which every material leaves
    /// without resistance; 0 where they take the velocity into them and nothing else.
    pub(crate) fn wall_friction(&self) -> f64 {
        match self {
            Self::Water(_) => 0.0,
            Self::Sand(sand) => sand.wall_friction,
            Self::Goop(goop) => goop.wall_friction,
        }
    }

    /// Kirchhoff stress per unit of rest density \[m²/s²\], after the velocity gradient
    /// has acted on the particle for the time `dt`.
    pub(crate) fn stress<const D: usize>(
        &self,
        history: &mut History<D>,
        velocity_gradient: &Matrix<D>,
        dt: f64,
    ) -> Matrix<D> {
        match self {
            Self::Water(water) => water.stress(history, velocity_gradient, dt),
            Self::Sand(sand) => sand.stress(history, velocity_gradient, dt),
            Self::Goop(goop) => goop.stress(history, velocity_gradient, dt),
        }
    }

    /// Stored elastic energy per mass \[m²/s²\].
    pub(crate) fn energy<const D: usize>(&self, history: &History<D>) -> f64 {
        match self {
            Self::Water(water) => water.energy(history.log_volume),
            Self::Sand(sand) => sand.energy(history),
            Self::Goop(goop) => goop.energy(history),
        }
    }
}

impl Water {
    fn stress<const D: usize>(
        &self,
        history: &mut History<D>,
        velocity_gradient: &Matrix<D>,
        dt: f64,
    ) -> Matrix<D> {
        let divergence = linalg::trace(velocity_gradient);
        history.log_volume = (history.log_volume + dt * divergence).min(self.cohesion);
        let modulus = self.sound_speed.powi(2) / self.exponent;
        let pressure = modulus * ((-self.exponent * history.log_volume).exp() - 1.0)
            - (self.bulk_viscosity - 2.0 / D as f64 * self.viscosity) * divergence;
        // Kirchhoff stress is Cauchy stress times the volume ratio.
        let volume = history.log_volume.exp();
        let mut stress = linalg::zero();
        for i in 0..D {
            for j in 0..D {
                stress[i][j] =
                    volume * self.viscosity * (velocity_gradient[i][j] + velocity_gradient[j][i]);
            }
            stress[i][i] -= volume * pressure;
        }
        stress
    }

    /// −∫ p dV from rest.
    fn energy(&self, log_volume: f64) -> f64 {
        let modulus = self.sound_speed.powi(2) / self.exponent;
        let pressure_work =
            (((1.0 - self.exponent) * log_volume).exp() - 1.0) / (self.exponent - 1.0);
        modulus * (pressure_work + log_volume.exp() - 1.0)
    }
}

impl Sand {
    fn stress<const D: usize>(
        &self,
        history: &mut History<D>,
        velocity_gradient: &Matrix<D>,
        dt: f64,
    ) -> Matrix<D> {
        let trial = history.stretched(velocity_gradient, dt);
        let (squares, axes) = linalg::symmetric_eigen(&trial);
        let trial: [f64; D] = squares.map(|square| 0.5 * square.max(f64::MIN_POSITIVE).ln());
        let strain = self.project(trial, &mut history.log_volume);
        history.left_cauchy_green =
            linalg::congruence(&axes, &linalg::diagonal(&strain.map(|e| (2.0 * e).exp())));
        let volumetric: f64 = self.lambda * strain.iter().sum::<f64>();
        let kirchhoff = strain.map(|e| volumetric + 2.0 * self.mu * e);
        let mean = kirchhoff.iter().sum::<f64>() / D as f64;
        let damping =
            -mean * (self.collision_time * linalg::trace(velocity_gradient)).clamp(-1.0, 1.0);
        linalg::congruence(&axes, &linalg::diagonal(&kirchhoff.map(|s| s + damping)))
    }

    /// Return mapping of principal Hencky strains to the Drucker–Prager cone: what
    /// expands falls apart, what is sheared beyond friction slides without changing
    /// its volume.
    fn project<const D: usize>(&self, trial: [f64; D], log_volume: &mut f64) -> [f64; D] {
        let dimension = D as f64;
        let expansion = trial.iter().sum::<f64>() + *log_volume;
        if expansion >= 0.0 {
            *log_volume = expansion;
            return [0.0; D];
        }
        let mean = (expansion - *log_volume) / dimension;
        *log_volume = 0.0;
        let deviator = trial.map(|e| e - mean);
        let shear = linalg::dot(&deviator, &deviator).sqrt();
        let sine = self.friction_angle.sin();
        let slope = (2.0_f64 / 3.0).sqrt() * 2.0 * sine / (3.0 - sine);
        let bearable =
            -slope * expansion * (dimension * self.lambda + 2.0 * self.mu) / (2.0 * self.mu);
        let scale = if shear > bearable {
            bearable / shear
        } else {
            1.0
        };
        deviator.map(|e| expansion / dimension + scale * e)
    }

    fn energy<const D: usize>(&self, history: &History<D>) -> f64 {
        let (squares, _) = linalg::symmetric_eigen(&history.left_cauchy_green);
        let strain = squares.map(|square| 0.5 * square.ln());
        let volumetric: f64 = strain.iter().sum();
        self.mu * linalg::dot(&strain, &strain) + 0.5 * self.lambda * volumetric.powi(2)
    }
}

impl Goop {
    fn stress<const D: usize>(
        &self,
        history: &mut History<D>,
        velocity_gradient: &Matrix<D>,
        dt: f64,
    ) -> Matrix<D> {
        history.log_volume += dt * linalg::trace(velocity_gradient);
        history.left_cauchy_green = self.project(&history.stretched(velocity_gradient, dt));
        let mean = linalg::trace(&history.left_cauchy_green) / D as f64;
        let pressure = -0.5 * self.bulk * ((2.0 * history.log_volume).exp() - 1.0);
        let mut stress = linalg::zero();
        for i in 0..D {
            for j in 0..D {
                stress[i][j] = self.shear * history.left_cauchy_green[i][j]
                    + self.viscosity * (velocity_gradient[i][j] + velocity_gradient[j][i]);
            }
            stress[i][i] -= self.shear * mean + pressure;
        }
        stress
    }

    /// Return mapping of a trial b: its deviator shrinks to what the yield stress bears, and
    /// its determinant becomes one.
    fn project<const D: usize>(&self, trial: &Matrix<D>) -> Matrix<D> {
        let scale = linalg::determinant(trial).powf(-1.0 / D as f64);
        let mut isochoric = trial.map(|row| row.map(|x| scale * x));
        let mean = linalg::trace(&isochoric) / D as f64;
        let mut square = 0.0;
        for i in 0..D {
            for j in 0..D {
                square += (isochoric[i][j] - mean * f64::from(i == j)).powi(2);
            }
        }
        // Pure shear by the stress τ has a deviator of norm √2 τ.
        let excess = self.shear * (0.5 * square).sqrt() / self.yield_stress;
        if excess <= 1.0 {
            return isochoric;
        }
        for i in 0..D {
            for j in 0..D {
                let spherical = mean * f64::from(i == j);
                isochoric[i][j] = spherical + (isochoric[i][j] - spherical) / excess;
            }
        }
        let scale = linalg::determinant(&isochoric).powf(-1.0 / D as f64);
        isochoric.map(|row| row.map(|x| scale * x))
    }

    /// Of the stiffer direction of a stretched particle, or faster.
    fn sound_speed<const D: usize>(&self, history: &History<D>) -> f64 {
        let stretch = linalg::trace(&history.left_cauchy_green) / D as f64;
        let volume = history.log_volume.exp().max(1.0);
        (self.bulk * volume.powi(2) + 2.0 * self.shear * stretch).sqrt()
    }

    fn energy<const D: usize>(&self, history: &History<D>) -> f64 {
        let squared_volume = (2.0 * history.log_volume).exp();
        let stretch = linalg::trace(&history.left_cauchy_green) - D as f64;
        0.5 * self.bulk * (0.5 * (squared_volume - 1.0) - history.log_volume)
            + 0.5 * self.shear * stretch
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WATER: Water = Water {
        sound_speed: 14.0,
        exponent: 7.0,
        viscosity: 0.0,
        bulk_viscosity: 0.0,
        cohesion: 0.05,
    };
    const SAND: Sand = Sand {
        lambda: 350.0,
        mu: 230.0,
        density: 1.0,
        friction_angle: 0.6,
        wall_friction: 0.4,
        collision_time: 0.0,
    };
    const JELLY: Goop = Goop {
        bulk: 300.0,
        shear: 50.0,
        yield_stress: f64::INFINITY,
        viscosity: 0.0,
        wall_friction: 0.4,
    };

    /// A slow compression along the first axis: the work done is the energy stored.
    fn assert_work_is_stored(material: Material) {
        let mut history = History::<2>::at_rest();
        let (rate, dt) = ([[-1.0, 0.0], [0.0, -0.8]], 1e-5);
        let mut work = 0.0;
        for _ in 0..1000 {
            let before = material.energy(&history);
            let stress = material.stress(&mut history, &rate, dt);
            let power = stress[0][0] * rate[0][0] + stress[1][1] * rate[1][1];
            work += power * dt;
            assert!(material.energy(&history) > before);
        }
        let stored = material.energy(&history);
        assert!((work / stored - 1.0).abs() < 0.01, "{work} and {stored}");
    }

    #[test]
    fn stress_is_the_derivative_of_energy() {
        assert_work_is_stored(Material::Water(WATER));
        assert_work_is_stored(Material::Sand(SAND));
        assert_work_is_stored(Material::Goop(JELLY));
    }

    #[test]
    fn sound_speed_is_the_stiffness() {
        let history = History::<2>::at_rest;
        let stress = WATER.stress(&mut history(), &[[-1.0, 0.0], [0.0, 0.0]], 1e-6);
        assert!((stress[0][0] / -1e-6 / WATER.sound_speed.powi(2) - 1.0).abs() < 1e-3);
        let stress = SAND.stress(&mut history(), &[[-1.0, 0.0], [0.0, -1.0]], 1e-6);
        let expected = -2.0 * (SAND.lambda + SAND.mu) * 1e-6;
        assert!((stress[0][0] / expected - 1.0).abs() < 1e-3);
    }

    #[test]
    fn sheared_sand_stays_on_the_cone_and_keeps_its_volume() {
        let mut gained = 0.0;
        let strain = SAND.project([-0.05, 0.03], &mut gained);
        assert!((strain[0] + strain[1] + 0.02).abs() < 1e-15);
        assert!(strain[1] - strain[0] < 0.08);
        assert_eq!(gained, 0.0);
        let again = SAND.project(strain, &mut gained);
        assert!((again[0] - strain[0]).abs() < 1e-15, "projected twice");
    }

    #[test]
    fn sand_bears_load_only_after_giving_back_the_volume_it_gained() {
        let mut gained = 0.0;
        assert_eq!(SAND.project([0.02, 0.01], &mut gained), [0.0; 2]);
        assert!((gained - 0.03).abs() < 1e-15);
        assert_eq!(SAND.project([-0.01, -0.01], &mut gained), [0.0; 2]);
        let strain = SAND.project([-0.01, -0.01], &mut gained);
        assert!((strain[0] + 0.005).abs() < 1e-15);
        assert_eq!(gained, 0.0);
    }

    #[test]
    fn jelly_remembers_its_shape_and_goop_keeps_what_it_yielded() {
        let goop = Goop {
            yield_stress: 1.0,
            ..JELLY
        };
        let shear = |rate: f64| [[0.0, rate, 0.0], [0.0; 3], [0.0; 3]];
        for (material, returns) in [(JELLY, true), (goop, false)] {
            let mut history = History::<3>::at_rest();
            let mut largest = 0.0_f64;
            for step in 0..2000 {
                let rate = if step < 1000 { 1.0 } else { -1.0 };
                let stress = material.stress(&mut history, &shear(rate), 1e-4);
                largest = largest.max(stress[0][1]);
                let volume = linalg::determinant(&history.left_cauchy_green);
                assert!((volume - 1.0).abs() < 1e-12, "{volume}");
            }
            let energy = material.energy(&history);
            if returns {
                assert!(
                    (largest / (0.1 * JELLY.shear) - 1.0).abs() < 0.01,
                    "{largest}"
                );
                assert!(energy < 1e-4, "{energy}");
            } else {
                assert!((largest - goop.yield_stress).abs() < 0.01, "{largest}");
                assert!(energy > 0.9 * 0.5 * goop.yield_stress.powi(2) / goop.shear);
            }
        }
    }
}
