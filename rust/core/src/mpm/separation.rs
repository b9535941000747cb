//! Keeps particles apart below the resolution of the grid.
//!
//! The grid sees no clump smaller than a cell, so shear slowly turns any arrangement of
//! particles into a random one, with pairs that all but coincide. A small shift of close
//! pairs, equal and opposite, prevents it and leaves mass, momentum, the centre of mass
//! and thereby the potential energy as they are.

use super::grid::Walls;

/// Distance below which two particles repel, in particle spacings: far enough to keep
/// the arrangement even, too near to carry load.
const DISTANCE: f64 = 0.6;

/// A search for close pairs on uniform cells, reused from frame to frame.
pub(crate) struct Separation<const D: usize> {
    walls: Walls,
    periodic: bool,
    distance: f64,
    cell_width: f64,
    /// Cells along one axis.
    side: usize,
    /// Where the particles of each cell start in `sorted`.
    starts: Vec<usize>,
    /// Particle numbers and positions, cell by cell.
    sorted: Vec<(usize, [f64; D])>,
    shifts: Vec<[f64; D]>,
}

impl<const D: usize> Separation<D> {
    /// For particles that are `spacing` apart at rest.
    pub(crate) fn new(walls: Walls, spacing: f64, periodic: bool) -> Self {
        let distance = DISTANCE * spacing;
        let extent = walls.high - walls.low;
        let side = (extent / distance).floor().max(1.0) as usize;
        Self {
            walls,
            periodic,
            distance,
            cell_width: extent / side as f64,
            side,
            starts: Vec::new(),
            sorted: Vec::new(),
            shifts: Vec::new(),
        }
    }

    /// The shift of each particle that takes the part `strength` of what every close
    /// pair lacks in distance.
    pub(crate) fn shifts(&mut self, positions: &[[f64; D]], strength: f64) -> &[[f64; D]] {
        self.sort(positions);
        self.shifts.clear();
        self.shifts.resize(positions.len(), [0.0; D]);
        for &(particle, position) in &self.sorted {
            let cell = self.cell(&position);
            for neighbour in 0..3_usize.pow(D as u32) {
                let Some(index) = self.neighbour(&cell, neighbour) else {
                    continue;
                };
                for (_, other) in &self.sorted[self.starts[index]..self.starts[index + 1]] {
                    let arm = self.arm(&position, other);
                    let square: f64 = arm.iter().map(|a| a * a).sum();
                    if square > 0.0 && square < self.distance.powi(2) {
                        let scale = 0.5 * strength * (self.distance / square.sqrt() - 1.0);
                        for axis in 0..D {
                            self.shifts[particle][axis] += scale * arm[axis];
                        }
                    }
                }
            }
        }
        &self.shifts
    }

    /// From `other` to `position`, to the nearest image in a periodic box.
    fn arm(&self, position: &[f64; D], other: &[f64; D]) -> [f64; D] {
        let period = self.walls.high - self.walls.low;
        std::array::from_fn(|axis| {
            let arm = position[axis] - other[axis];
            if self.periodic {
                arm - period * (arm / period).round()
            } else {
                arm
            }
        })
    }

    /// Counting sort by cell.
    fn sort(&mut self, positions: &[[f64; D]]) {
        self.starts.clear();
        self.starts.resize(self.side.pow(D as u32) + 1, 0);
        for position in positions {
            let index = self.index(&self.cell(position));
            self.starts[index] += 1;
        }
        let mut end = 0;
        for start in &mut self.starts {
            end += *start;
            *start = end;
        }
        self.sorted.clear();
        self.sorted.resize(positions.len(), (0, [0.0; D]));
        for (particle, position) in positions.iter().enumerate().rev() {
            let index = self.index(&self.cell(position));
            self.starts[index] -= 1;
            self.sorted[self.starts[index]] = (particle, *position);
        }
    }

    fn cell(&self, position: &[f64; D]) -> [usize; D] {
        position.map(|x| (((x - self.walls.low) / self.cell_width) as usize).min(self.side - 1))
    }

    fn index(&self, cell: &[usize; D]) -> usize {
        cell.iter()
            .fold(0, |index, along| index * self.side + along)
    }

    /// Index of one of the 3^`D` cells around `cell`, if it is inside; a periodic box, of at least
    /// three cells along each axis, has no outside.
    fn neighbour(&self, cell: &[usize; D], number: usize) -> Option<usize> {
        let mut remainder = number;
        let mut neighbour = *cell;
        for along in &mut neighbour {
            if self.periodic {
                *along = (*along + remainder % 3 + self.side - 1) % self.side;
                remainder /= 3;
                continue;
            }
            *along = (*along + remainder % 3).checked_sub(1)?;
            remainder /= 3;
            if *along >= self.side {
                return None;
            }
        }
        Some(self.index(&neighbour))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WALLS: Walls = Walls {
        low: 0.0,
        high: 1.0,
    };

    #[test]
    fn only_close_pairs_are_shifted_and_equally() {
        let positions = [[0.50, 0.5], [0.53, 0.5], [0.9, 0.1], [0.9, 0.17]];
        let shifts = Separation::new(WALLS, 0.1, false)
            .shifts(&positions, 1.0)
            .to_vec();
        // The pair lacks 0.06 − 0.03, half for each; the other is far enough apart.
        assert!((shifts[0][0] + 0.015).abs() < 1e-12);
        assert!((shifts[1][0] - 0.015).abs() < 1e-12);
        assert_eq!(shifts[2..], [[0.0; 2]; 2]);
    }

    #[test]
    fn pairs_across_a_periodic_boundary_are_found() {
        let positions = [[0.01, 0.5], [0.98, 0.5]];
        let shifts = Separation::new(WALLS, 0.1, true)
            .shifts(&positions, 1.0)
            .to_vec();
        assert!((shifts[0][0] - 0.015).abs() < 1e-12);
        assert!((shifts[1][0] + 0.015).abs() < 1e-12);
    }

    #[test]
    fn pairs_across_cells_are_found() {
        let mut separation = Separation::<3>::new(WALLS, 0.1, false);
        for step in 0..100 {
            let x = 0.01 * f64::from(step);
            let positions = [[x, x, 1.0 - x], [x + 0.02, x + 0.02, 1.0 - x - 0.02]];
            let shifts = separation.shifts(&positions, 0.5);
            assert!(shifts[0][0] < 0.0 && shifts[0][2] > 0.0, "{positions:?}");
            assert_eq!(shifts[0], shifts[1].map(|s| -s));
        }
    }
}
