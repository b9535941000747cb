//! The background grid: quadratic B-splines on the nodes of a box.

use std::ops::Range;

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
    /// Momentum while particles are scattered, velocity after the update.
    pub velocity: [f64; D],
}

impl<const D: usize> Node<D> {
    const EMPTY: Self = Self {
        mass: 0.0,
        velocity: [0.0; D],
    };
}

/// Where a node is.
pub(crate) struct Place<const D: usize> {
    pub index: usize,
    pub position: [f64; D],
    /// Along each axis, -1 or 1 on the low or high wall or beyond, 0 between.
    pub sides: [f64; D],
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
    /// Nodes along an axis.
    side: usize,
    /// Whether the walls are one and the same place: the node there is the first one.
    periodic: bool,
    strides: [usize; D],
    /// Where a node is along an axis: -1 or 1 on the low or high wall or beyond, else 0.
    sides: Vec<f64>,
    /// Node indices along each axis outside of which all nodes are empty.
    active: [Range<usize>; D],
}

impl<const D: usize> Grid<D> {
    /// A grid on `walls` with nodes on both of them and about `spacing` apart.
    pub(crate) fn new(walls: Walls, spacing: f64, periodic: bool) -> Self {
        let extent = walls.high - walls.low;
        let cells = (extent / spacing).round().max(REACH as f64) as usize;
        let spacing = extent / cells as f64;
        let side = if periodic {
            cells
        } else {
            cells + 1 + 2 * PADDING
        };
        let strides = std::array::from_fn(|axis| side.pow((D - 1 - axis) as u32));
        let sides = (0..side).map(|index| {
            let walled = !periodic;
            f64::from(walled && index >= cells + PADDING) - f64::from(walled && index <= PADDING)
        });
        Self {
            nodes: vec![Node::EMPTY; side.pow(D as u32)],
            spacing,
            walls,
            side,
            periodic,
            strides,
            sides: sides.collect(),
            active: std::array::from_fn(|_| 0..0),
        }
    }

    /// Nodes and weights of the quadratic B-spline around a particle inside the walls;
    /// the weights sum to one.
    pub(crate) fn stencil(&self, position: &[f64; D]) -> Stencil<D> {
        let mut along = [[0; REACH]; D];
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
            along[axis] = std::array::from_fn(|step| {
                let node = first + step;
                self.strides[axis]
                    * if self.periodic {
                        node % self.side
                    } else {
                        node
                    }
            });
        }
        let mut stencil = Stencil {
            nodes: [0; MAX_STENCIL],
            weights: [0.0; MAX_STENCIL],
            arms: [[0.0; D]; MAX_STENCIL],
        };
        for k in 0..Stencil::<D>::LEN {
            let mut remainder = k;
            let mut node = 0;
            let mut weight = 1.0;
            let mut arm = arms;
            for axis in (0..D).rev() {
                let step = remainder % REACH;
                remainder /= REACH;
                node += along[axis][step];
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
        self.for_each_node(|node, _| *node = Node::EMPTY);
        if self.periodic {
            self.active = std::array::from_fn(|_| 0..self.side);
            return;
        }
        let (mut low, mut high) = ([f64::INFINITY; D], [f64::NEG_INFINITY; D]);
        for position in positions {
            for axis in 0..D {
                low[axis] = low[axis].min(position[axis]);
                high[axis] = high[axis].max(position[axis]);
            }
        }
        self.active =
            std::array::from_fn(|axis| self.locate(low[axis]).0..self.locate(high[axis]).0 + REACH);
    }

    /// First node of the spline around a coordinate, and the coordinate's distance from
    /// it in units of the spacing; in a periodic grid the node's number is one period up.
    fn locate(&self, coordinate: f64) -> (usize, f64) {
        let ahead = if self.periodic { self.side } else { PADDING };
        let x = (coordinate - self.walls.low) / self.spacing + ahead as f64;
        let first = (x - 0.5) as usize;
        (first, x - first as f64)
    }

    /// Calls `visit` for each node in use.
    pub(crate) fn for_each_node(&mut self, mut visit: impl FnMut(&mut Node<D>, Place<D>)) {
        if self.active.iter().any(Range::is_empty) {
            return;
        }
        let (low, spacing) = (self.walls.low, self.spacing);
        let coordinate = |along: usize| low + (along as f64 - PADDING as f64) * spacing;
        let last = self.active[D - 1].clone();
        let mut index: [usize; D] = std::array::from_fn(|axis| self.active[axis].start);
        loop {
            let row: usize = (0..D - 1)
                .map(|axis| index[axis] * self.strides[axis])
                .sum();
            let mut position = index.map(coordinate);
            let mut sides = index.map(|along| self.sides[along]);
            for along in last.clone() {
                position[D - 1] = coordinate(along);
                sides[D - 1] = self.sides[along];
                let index = row + along;
                let place = Place {
                    index,
                    position,
                    sides,
                };
                visit(&mut self.nodes[index], place);
            }
            let Some(axis) = (0..D - 1).rfind(|&axis| index[axis] + 1 < self.active[axis].end)
            else {
                return;
            };
            index[axis] += 1;
            for later in axis + 1..D - 1 {
                index[later] = self.active[later].start;
            }
        }
    }
}
