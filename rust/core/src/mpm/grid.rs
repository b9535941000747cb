//! The background grid: quadratic B-splines on the nodes of a box.

/// Nodes beyond each wall that the splines of a particle inside the box can reach.
const PADDING: usize = 1;
/// Nodes one spline overlaps along one axis.
const REACH: usize = 3;
/// Nodes one spline overlaps in three dimensions; two dimensions use the first nine.
const MAX_STENCIL: usize = REACH * REACH * REACH;

/// An axis-aligned box, the same along every axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Walls {
    /// Smallest coordinate inside.
    pub low: f64,
    /// Largest coordinate inside.
    pub high: f64,
}

#[derive(Clone, Copy)]
pub(crate) struct Node<const D: usize> {
    pub mass: f64,
    /// Momentum while particles are gathered, velocity after the update.
    pub velocity: [f64; D],
}

/// The nodes around a particle: index, spline weight, and vector from the particle.
pub(crate) struct Stencil<const D: usize> {
    pub nodes: [usize; MAX_STENCIL],
    pub weights: [f64; MAX_STENCIL],
    pub arms: [[f64; D]; MAX_STENCIL],
}

impl<const D: usize> Stencil<D> {
    pub(crate) const LEN: usize = REACH.pow(D as u32);
}

pub(crate) struct Grid<const D: usize> {
    pub nodes: Vec<Node<D>>,
    pub spacing: f64,
    walls: Walls,
    cells: usize,
    strides: [usize; D],
    /// Node indices along each axis, first and one past the last, outside of which all
    /// nodes are empty.
    active: [(usize, usize); D],
}

impl<const D: usize> Grid<D> {
    /// A grid on `walls` with nodes on both of them and about `spacing` apart.
    pub(crate) fn new(walls: Walls, spacing: f64) -> Self {
        let extent = walls.high - walls.low;
        let cells = (extent / spacing).round().max(REACH as f64) as usize;
        let spacing = extent / cells as f64;
        let side = cells + 1 + 2 * PADDING;
        let strides = std::array::from_fn(|axis| side.pow((D - 1 - axis) as u32));
        let empty = Node {
            mass: 0.0,
            velocity: [0.0; D],
        };
        Self {
            nodes: vec![empty; side.pow(D as u32)],
            spacing,
            walls,
            cells,
            strides,
            active: [(0, side); D],
        }
    }

    /// Nodes and weights of a particle inside the walls (Hu et al. 2018, eq. of the
    /// quadratic kernel; the splines sum to one).
    pub(crate) fn stencil(&self, position: &[f64; D]) -> Stencil<D> {
        let mut base = 0;
        let mut weights = [[0.0; REACH]; D];
        let mut arms = [0.0; D];
        for axis in 0..D {
            let (first, offset) = self.locate(position[axis]);
            weights[axis] = [
                0.5 * (1.5 - offset).powi(2),
                0.75 - (offset - 1.0).powi(2),
                0.5 * (offset - 0.5).powi(2),
            ];
            arms[axis] = -offset * self.spacing;
            base += first * self.strides[axis];
        }
        let mut stencil = Stencil {
            nodes: [0; MAX_STENCIL],
            weights: [0.0; MAX_STENCIL],
            arms: [[0.0; D]; MAX_STENCIL],
        };
        for k in 0..Stencil::<D>::LEN {
            let mut remainder = k;
            let mut node = base;
            let mut weight = 1.0;
            let mut arm = arms;
            for axis in (0..D).rev() {
                let step = remainder % REACH;
                remainder /= REACH;
                node += step * self.strides[axis];
                weight *= weights[axis][step];
                arm[axis] += step as f64 * self.spacing;
            }
            stencil.nodes[k] = node;
            stencil.weights[k] = weight;
            stencil.arms[k] = arm;
        }
        stencil
    }

    /// Empties the nodes in use and takes into use those around `positions`.
    pub(crate) fn cover<'a>(&mut self, positions: impl Iterator<Item = &'a [f64; D]>) {
        self.for_each_row(|row, _| {
            row.fill(Node {
                mass: 0.0,
                velocity: [0.0; D],
            });
        });
        let (mut low, mut high) = ([f64::INFINITY; D], [f64::NEG_INFINITY; D]);
        for position in positions {
            for axis in 0..D {
                low[axis] = low[axis].min(position[axis]);
                high[axis] = high[axis].max(position[axis]);
            }
        }
        self.active = std::array::from_fn(|axis| {
            (self.locate(low[axis]).0, self.locate(high[axis]).0 + REACH)
        });
    }

    /// First node of the spline around a coordinate, and the coordinate's distance from
    /// it in units of the spacing.
    fn locate(&self, coordinate: f64) -> (usize, f64) {
        let x = (coordinate - self.walls.low) / self.spacing + PADDING as f64;
        let first = (x - 0.5) as usize;
        (first, x - first as f64)
    }

    /// Calls `visit` for each run of used nodes along the last axis with the indices of
    /// its first node.
    pub(crate) fn for_each_row(&mut self, mut visit: impl FnMut(&mut [Node<D>], [usize; D])) {
        let mut index = std::array::from_fn(|axis| self.active[axis].0);
        let length = self.active[D - 1].1 - self.active[D - 1].0;
        loop {
            let start: usize = (0..D).map(|axis| index[axis] * self.strides[axis]).sum();
            visit(&mut self.nodes[start..start + length], index);
            let mut axis = D - 1;
            loop {
                if axis == 0 {
                    return;
                }
                axis -= 1;
                index[axis] += 1;
                if index[axis] < self.active[axis].1 {
                    break;
                }
                index[axis] = self.active[axis].0;
            }
        }
    }

    /// Nodes along one axis.
    pub(crate) fn side(&self) -> usize {
        self.cells + 1 + 2 * PADDING
    }

    /// Outward sign (-1 or 1) if the node lies on a wall of this axis or beyond, else 0.
    pub(crate) fn wall_side(&self, index: usize) -> f64 {
        if index <= PADDING {
            -1.0
        } else if index >= self.cells + PADDING {
            1.0
        } else {
            0.0
        }
    }
}
