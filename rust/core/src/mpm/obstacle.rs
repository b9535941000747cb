//! Rigid bodies that move as prescribed, whatever hits them.

use std::f64::consts::TAU;

use super::grid::Walls;

/// Particle type of obstacles in the data sets of GNS.
pub const OBSTACLE_TYPE: i64 = 3;

/// A rectangle in the plane of the first two axes, which in three dimensions reaches from
/// wall to wall along the third: a ramp, a pillar, or, moving, a paddle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bar {
    /// Middle of the swing \[m\].
    pub centre: [f64; 2],
    /// Half the length and half the thickness \[m\].
    pub half: [f64; 2],
    /// Angle from the first axis to the length \[rad\] at time zero.
    pub angle: f64,
    /// Angular velocity \[rad/s\].
    pub spin: f64,
    /// How far the centre swings to either side \[m\], sinusoidally from the middle.
    pub swing: [f64; 2],
    /// Time \[s\] of one swing there and back.
    pub period: f64,
}

impl Bar {
    /// A bar that rests.
    pub fn fixed(centre: [f64; 2], half: [f64; 2], angle: f64) -> Self {
        Self {
            centre,
            half,
            angle,
            spin: 0.0,
            swing: [0.0; 2],
            period: 1.0,
        }
    }

    /// Distance \[m\] of a point from the surface at a time \[s\], negative inside.
    pub fn distance(&self, point: [f64; 2], time: f64) -> f64 {
        self.at(time).distance(point).0
    }

    /// Whether it has a size and is somewhere at all times.
    pub(crate) fn is_possible(&self) -> bool {
        let lengths = [self.half[0], self.half[1], self.period];
        let numbers = [self.centre, self.swing, [self.angle, self.spin]];
        lengths.iter().all(|x| *x > 0.0 && x.is_finite())
            && numbers.as_flattened().iter().all(|x| x.is_finite())
    }

    /// Speed \[m/s\] that no point of the bar exceeds.
    pub(crate) fn top_speed(&self) -> f64 {
        self.swing[0].hypot(self.swing[1]) * TAU / self.period
            + self.spin.abs() * self.half[0].hypot(self.half[1])
    }

    pub(crate) fn at(&self, time: f64) -> Pose {
        let (sine, cosine) = (self.angle + self.spin * time).sin_cos();
        let frequency = TAU / self.period;
        let (phase_sine, phase_cosine) = (frequency * time).sin_cos();
        Pose {
            centre: std::array::from_fn(|k| self.centre[k] + self.swing[k] * phase_sine),
            half: self.half,
            direction: [cosine, sine],
            velocity: self.swing.map(|swing| swing * frequency * phase_cosine),
            spin: self.spin,
        }
    }

    /// Points on a lattice of about `spacing` that fill the bar, half a spacing below its
    /// surface: in the bar's own axes, and along the third axis in those of the box.
    pub(crate) fn lattice<const D: usize>(&self, walls: Walls, spacing: f64) -> Vec<[f64; D]> {
        let low: [f64; D] = std::array::from_fn(|k| if k < 2 { -self.half[k] } else { walls.low });
        let high: [f64; D] = std::array::from_fn(|k| if k < 2 { self.half[k] } else { walls.high });
        let across: [usize; D] =
            std::array::from_fn(|k| ((high[k] - low[k]) / spacing).round().max(1.0) as usize);
        (0..across.iter().product())
            .map(|number: usize| {
                let mut remainder = number;
                std::array::from_fn(|k| {
                    let index = remainder % across[k];
                    remainder /= across[k];
                    low[k] + (high[k] - low[k]) * (index as f64 + 0.5) / across[k] as f64
                })
            })
            .collect()
    }
}

/// Where a bar is at some moment and how it moves there.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pose {
    centre: [f64; 2],
    half: [f64; 2],
    /// Unit vector along the length.
    direction: [f64; 2],
    velocity: [f64; 2],
    spin: f64,
}

impl Pose {
    /// Distance of a point from the surface, negative inside, and the normal out of the
    /// surface where it is nearest.
    pub(crate) fn distance(&self, point: [f64; 2]) -> (f64, [f64; 2]) {
        let [cosine, sine] = self.direction;
        let (x, y) = (point[0] - self.centre[0], point[1] - self.centre[1]);
        let local = [cosine * x + sine * y, cosine * y - sine * x];
        let beyond: [f64; 2] = std::array::from_fn(|k| local[k].abs() - self.half[k]);
        let (distance, normal) = if beyond[0] > 0.0 && beyond[1] > 0.0 {
            let distance = beyond[0].hypot(beyond[1]);
            (distance, beyond.map(|b| b / distance))
        } else if beyond[0] > beyond[1] {
            (beyond[0], [1.0, 0.0])
        } else {
            (beyond[1], [0.0, 1.0])
        };
        let (u, v) = (normal[0].copysign(local[0]), normal[1].copysign(local[1]));
        (distance, [cosine * u - sine * v, sine * u + cosine * v])
    }

    /// Place in the box of a point given in the bar's own axes.
    pub(crate) fn place<const D: usize>(&self, mut point: [f64; D]) -> [f64; D] {
        let [cosine, sine] = self.direction;
        let (x, y) = (point[0], point[1]);
        point[0] = self.centre[0] + cosine * x - sine * y;
        point[1] = self.centre[1] + sine * x + cosine * y;
        point
    }

    /// Takes from the velocity of a `point` what leads into the bar where it is nearer than
    /// `reach`, and from the rest what Coulomb's `friction` takes.
    pub(crate) fn stop<const D: usize>(
        &self,
        velocity: &mut [f64; D],
        point: [f64; 2],
        reach: f64,
        friction: f64,
    ) {
        let (distance, normal) = self.distance(point);
        if distance >= reach {
            return;
        }
        let own = [
            self.velocity[0] - self.spin * (point[1] - self.centre[1]),
            self.velocity[1] + self.spin * (point[0] - self.centre[0]),
        ];
        for k in 0..2 {
            velocity[k] -= own[k];
        }
        let into = -(normal[0] * velocity[0] + normal[1] * velocity[1]);
        if into > 0.0 {
            for k in 0..2 {
                velocity[k] += into * normal[k];
            }
            let sliding = velocity.iter().map(|v| v * v).sum::<f64>().sqrt();
            let kept = (1.0 - friction * into / sliding.max(f64::MIN_POSITIVE)).max(0.0);
            for component in velocity.iter_mut() {
                *component *= kept;
            }
        }
        for k in 0..2 {
            velocity[k] += own[k];
        }
    }

    /// Moves a position that is nearer than `margin` straight out to it.
    pub(crate) fn push_out<const D: usize>(&self, position: &mut [f64; D], margin: f64) {
        let (distance, normal) = self.distance([position[0], position[1]]);
        if distance < margin {
            for k in 0..2 {
                position[k] += (margin - distance) * normal[k];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TILTED: Bar = Bar {
        centre: [0.5, 0.4],
        half: [0.2, 0.05],
        angle: 0.5,
        spin: 2.0,
        swing: [0.1, -0.05],
        period: 1.5,
    };

    #[test]
    fn the_normal_is_the_gradient_of_the_distance() {
        let pose = TILTED.at(0.3);
        for k in 0..400 {
            let point = [
                0.2 + 0.03 * f64::from(k % 20),
                0.1 + 0.031 * f64::from(k / 20),
            ];
            let (distance, normal) = pose.distance(point);
            let h = 1e-6;
            for axis in 0..2 {
                let mut moved = point;
                moved[axis] += h;
                let slope = (pose.distance(moved).0 - distance) / h;
                assert!((slope - normal[axis]).abs() < 1e-3, "{point:?}");
            }
        }
    }

    #[test]
    fn a_point_of_the_bar_moves_at_the_velocity_it_stops_others_to() {
        let (time, h) = (0.7, 1e-6);
        for local in [[0.2, 0.05], [-0.2, 0.0], [0.1, -0.05]] {
            let [before, now, after] =
                [time - h, time, time + h].map(|t| TILTED.at(t).place(local));
            let (_, normal) = TILTED.at(time).distance(now);
            // Runs into the bar so fast that friction takes all the sliding.
            let mut velocity = normal.map(|n| -1e3 * n);
            TILTED.at(time).stop(&mut velocity, now, 1e-9, 1e3);
            for k in 0..2 {
                let expected = (after[k] - before[k]) / (2.0 * h);
                assert!((velocity[k] - expected).abs() < 1e-6, "{velocity:?}");
            }
            assert!(velocity[0].hypot(velocity[1]) <= TILTED.top_speed());
        }
    }

    #[test]
    fn what_leaves_or_is_far_is_not_stopped_and_what_slides_slips() {
        let pose = Bar::fixed([0.5, 0.5], [0.2, 0.05], 0.0).at(9.0);
        let stopped = |mut velocity: [f64; 3], y, friction| {
            pose.stop(&mut velocity, [0.5, y], 0.01, friction);
            velocity
        };
        assert_eq!(stopped([1.0, 2.0, 0.5], 0.555, 1.0), [1.0, 2.0, 0.5]);
        assert_eq!(stopped([1.0, -2.0, 0.5], 0.58, 1.0), [1.0, -2.0, 0.5]);
        assert_eq!(stopped([1.0, -2.0, 0.5], 0.555, 0.0), [1.0, 0.0, 0.5]);
        let rubbed = stopped([3.0, -2.0, 4.0], 0.555, 0.5);
        assert!((rubbed[0] - 2.4).abs() < 1e-12 && (rubbed[2] - 3.2).abs() < 1e-12);
    }

    #[test]
    fn the_lattice_fills_the_bar() {
        let walls = Walls {
            low: 0.1,
            high: 0.9,
        };
        let points = TILTED.lattice::<3>(walls, 0.02);
        assert_eq!(points.len(), 20 * 5 * 40);
        let pose = TILTED.at(0.4);
        for point in points {
            let placed = pose.place(point);
            assert!(TILTED.distance([placed[0], placed[1]], 0.4) <= -0.01 + 1e-12);
            assert!((0.11 - 1e-12..=0.89 + 1e-12).contains(&placed[2]));
        }
    }
}
