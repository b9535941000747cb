//! Brute force over all pairs, in the arithmetic of the positions.

use std::num::NonZeroUsize;

use adaptgns_core::graph::{Graph, Options, Particles, Scalar};
use adaptgns_core::threads::Threads;

/// A graph's input that owns its arrays.
#[derive(Debug, Clone)]
pub struct Case<T> {
    pub dim: usize,
    pub positions: Vec<T>,
    pub ptr: Option<Vec<i64>>,
    pub period: Option<Vec<f64>>,
    pub self_edges: bool,
}

impl<T: Scalar> Case<T> {
    pub fn open(dim: usize, positions: Vec<T>) -> Self {
        Self {
            dim,
            positions,
            ptr: None,
            period: None,
            self_edges: false,
        }
    }

    pub fn particles(&self) -> Particles<'_, T> {
        Particles {
            positions: &self.positions,
            dim: self.dim,
            ptr: self.ptr.as_deref(),
            period: self.period.as_deref(),
        }
    }

    pub fn options(&self, threads: usize) -> Options {
        Options {
            self_edges: self.self_edges,
            threads: NonZeroUsize::new(threads).map_or(Threads::All, Threads::AtMost),
        }
    }

    pub fn count(&self) -> usize {
        self.positions.len() / self.dim
    }

    /// The graph in the batch that holds a particle.
    pub fn graph_of(&self, particle: usize) -> usize {
        self.ptr.as_ref().map_or(0, |ptr| {
            ptr.partition_point(|&start| start as usize <= particle)
        })
    }

    pub fn distance2(&self, i: usize, j: usize) -> T {
        (0..self.dim).fold(T::default(), |sum, a| {
            let period = self.period.as_ref().map_or(0.0, |period| period[a]);
            let at = |i: usize| {
                let x = self.positions[i * self.dim + a];
                if period == 0.0 || period.is_infinite() {
                    return x;
                }
                let length = T::from_f64(period).to_f64();
                T::from_f64(x.to_f64() - length * (x.to_f64() / length).floor())
            };
            let mut d = (at(i) - at(j)).abs();
            if period > 0.0 && period.is_finite() {
                d = d.lesser(T::from_f64(period) - d);
            }
            sum + d * d
        })
    }

    /// All pairs of one graph that are near according to `near(squared distance, i, j)`.
    pub fn pairs(&self, near: impl Fn(T, usize, usize) -> bool) -> Graph {
        self.rows(|i| {
            (0..self.count())
                .filter(|&j| i != j || self.self_edges)
                .filter(|&j| self.graph_of(i) == self.graph_of(j))
                .filter(|&j| near(self.distance2(i, j), i, j))
                .collect()
        })
    }

    pub fn nearest(&self, k: usize) -> Graph {
        self.rows(|i| {
            let mut others: Vec<usize> = (0..self.count())
                .filter(|&j| i != j && self.graph_of(i) == self.graph_of(j))
                .collect();
            others.sort_by(|&p, &q| {
                self.distance2(i, p)
                    .total_cmp(&self.distance2(i, q))
                    .then(p.cmp(&q))
            });
            others.truncate(k);
            others.extend(self.self_edges.then_some(i));
            others.sort_unstable();
            others
        })
    }

    fn rows(&self, row: impl Fn(usize) -> Vec<usize>) -> Graph {
        let rows: Vec<Vec<usize>> = (0..self.count()).map(row).collect();
        let senders = rows.iter().flatten().map(|&j| j as i64);
        let receivers = (0..)
            .zip(&rows)
            .flat_map(|(i, row)| row.iter().map(move |_| i));
        let mut offsets = vec![0];
        for row in &rows {
            offsets.push(offsets[offsets.len() - 1] + row.len() as i64);
        }
        Graph {
            edge_index: senders.chain(receivers).collect(),
            offsets,
        }
    }
}
