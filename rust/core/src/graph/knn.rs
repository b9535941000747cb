//! Each particle's nearest ones, found with kiddo's k-d tree.

use std::cmp::Ordering;
use std::num::NonZeroUsize;
use std::ops::Range;

use kiddo::{ImmutableKdTree, SquaredEuclidean};

use super::Graph;
use super::edges::{self, Rows};
use super::grid::{bounds, wrap};
use super::input::{Batch, Options, Particles};
use super::memory::Budget;
use super::scalar::Scalar;
use super::search::separation;
use crate::Error;
use crate::threads;

/// The graph in which every particle receives from its `k` nearest others, ties going to
/// the lower index, and with `self_edges` from itself too.
///
/// # Errors
/// [`Error::InvalidArgument`] for arguments outside what is accepted,
/// [`Error::OutOfMemory`] if the edges would not fit in the memory there is.
pub fn knn_graph<T: Nearest>(
    particles: &Particles<'_, T>,
    k: usize,
    options: &Options,
) -> Result<Graph, Error> {
    particles.count()?;
    match particles.dim {
        2 => build(&particles.check::<2>()?, k, options),
        _ => build(&particles.check::<3>()?, k, options),
    }
}

/// Locations searched as one task.
const TASK: usize = 512;

fn build<T: Nearest, const D: usize>(
    batch: &Batch<'_, T, D>,
    k: usize,
    options: &Options,
) -> Result<Graph, Error> {
    let smallest = batch.graphs.iter().map(Range::len).filter(|&n| n > 0).min();
    if k < 1 || smallest.is_some_and(|n| k >= n) {
        let below = smallest.map_or(String::new(), |n| {
            format!(" and less than {n}, the particles of the smallest graph")
        });
        return Err(Error::invalid(
            "k",
            format!("got {k}, must be at least 1{below}"),
        ));
    }
    let count = batch.positions.len();
    let budget = Budget::default();
    budget.check(count * k)?;
    threads::team(options.threads.at_most(count / TASK), |team| {
        let searches = team
            .map(batch.graphs.clone(), |graph| Search::new(batch, graph, k))
            .into_iter()
            .collect::<Result<Vec<_>, _>>()?;
        let tasks: Vec<(&Search<T, D>, Range<usize>)> = searches
            .iter()
            .flat_map(|search| {
                let n = search.locations.len();
                (0..n)
                    .step_by(TASK)
                    .map(move |start| (search, start..n.min(start + TASK)))
            })
            .collect();
        let found = team
            .map(tasks.clone(), |(search, locations)| {
                search.run(locations, options.self_edges, &budget)
            })
            .into_iter()
            .collect::<Result<Vec<_>, _>>()?;
        let parts: Vec<(&[i32], &Rows)> = tasks
            .iter()
            .map(|(search, locations)| search.members_of(locations.clone()))
            .zip(&found)
            .collect();
        // SAFETY: the graphs partition the particles, and a search has each of its own once.
        unsafe { edges::assemble(count, parts, false, team, &budget) }
    })
}

/// One graph. Particles at the same place are one location, so that a pile of them
/// costs one search and no more than its `k + 1` lowest indices are looked at.
struct Search<T: Nearest, const D: usize> {
    k: usize,
    locations: Vec<[T; D]>,
    /// The particles of each location in ascending order.
    members: Vec<i32>,
    /// First member of each location, and one past the last member.
    starts: Vec<u32>,
    tree: ImmutableKdTree<T, D>,
    period: [T; D],
    /// The locations as the tree has them.
    in_tree: Vec<[T; D]>,
    /// The box the tree is told to repeat.
    tree_box: Option<[T; D]>,
}

impl<T: Nearest, const D: usize> Search<T, D> {
    fn new(batch: &Batch<'_, T, D>, graph: Range<usize>, k: usize) -> Result<Self, Error> {
        let first = graph.start;
        let positions: Vec<[T; D]> = batch.positions[graph]
            .iter()
            // Adding zero turns -0 into 0, so that equal positions have equal bits.
            .map(|p| wrap(p, &batch.period).map(|x| x + T::default()))
            .collect();
        let (low, high) = bounds(&positions);
        let extent = (0..D).map(|a| high[a] - low[a]).fold(0.0, f64::max);
        if !T::from_f64(64.0 * extent * extent).is_finite() {
            return Err(Error::invalid(
                "pos",
                format!(
                    "spans {extent}, too far for squared distances in {}",
                    T::NAME
                ),
            ));
        }
        let mut order: Vec<u32> = (0..positions.len() as u32).collect();
        order.sort_unstable_by(|&i, &j| {
            let (p, q) = (&positions[i as usize], &positions[j as usize]);
            (0..D)
                .fold(Ordering::Equal, |order, a| {
                    order.then_with(|| p[a].total_cmp(&q[a]))
                })
                .then(i.cmp(&j))
        });
        let mut locations = Vec::new();
        let mut starts = Vec::new();
        for (slot, &i) in (0_u32..).zip(&order) {
            if locations.last() != Some(&positions[i as usize]) {
                locations.push(positions[i as usize]);
                starts.push(slot);
            }
        }
        starts.push(order.len() as u32);
        // Where an axis is periodic, the tree wants a box that holds all points and has a
        // finite length on every axis: one of four times the extent is too long on an
        // open axis for any image to be nearer.
        let periodic = batch.period.iter().any(|length| length.is_finite());
        let span = batch.period.map(|length| {
            if length.is_finite() {
                length
            } else {
                T::from_f64(4.0 * extent + 1.0)
            }
        });
        let in_tree = locations
            .iter()
            .map(|location: &[T; D]| {
                std::array::from_fn(|a| {
                    let open = periodic && !batch.period[a].is_finite();
                    location[a]
                        - if open {
                            T::from_f64(low[a])
                        } else {
                            T::default()
                        }
                })
            })
            .collect::<Vec<_>>();
        Ok(Self {
            k,
            tree: T::tree(&in_tree),
            in_tree,
            locations,
            members: order.into_iter().map(|i| first as i32 + i as i32).collect(),
            starts,
            period: batch.period,
            tree_box: periodic.then_some(span),
        })
    }

    fn members_of(&self, locations: Range<usize>) -> &[i32] {
        &self.members[self.starts[locations.start] as usize..self.starts[locations.end] as usize]
    }

    fn run(
        &self,
        locations: Range<usize>,
        self_edges: bool,
        budget: &Budget,
    ) -> Result<Rows, Error> {
        let mut rows = Rows::with_receivers(self.members_of(locations.clone()).len());
        let mut nearest = Vec::new();
        for location in locations {
            self.nearest(location, &mut nearest);
            for &receiver in self.members_of(location..location + 1) {
                let others = nearest.iter().map(|&(_, i)| i).filter(|&i| i != receiver);
                let own = self_edges.then_some(receiver);
                let row = rows.next(self.k + 1, budget)?;
                let mut n = 0;
                for sender in others.take(self.k).chain(own) {
                    row[n] = sender;
                    n += 1;
                }
                rows.finish(n);
            }
        }
        Ok(rows)
    }

    /// The `k + 1` particles nearest to a location, its own among them, with squared
    /// distances and ordered by them, then by index.
    fn nearest(&self, location: usize, nearest: &mut Vec<(T, i32)>) {
        let (here, query) = (self.locations[location], &self.in_tree[location]);
        // One location more than could be needed shows whether the last place is tied.
        let asked = self.k + 2;
        let found = T::nearest(&self.tree, query, self.tree_box.as_ref(), asked);
        self.rank(here, &found, nearest);
        if found.len() == self.locations.len() {
            return;
        }
        let farthest = found
            .iter()
            .map(|&location| self.distance2(here, location))
            .fold(T::default(), T::greater);
        let [certain, reach] = self.around(farthest);
        if nearest.len() > self.k && nearest[self.k].0 < certain {
            return;
        }
        let found = T::within(&self.tree, query, self.tree_box.as_ref(), reach);
        self.rank(here, &found, nearest);
    }

    /// Bounds of what the tree may hold a squared distance for, which it rounds in other
    /// ways and places: by a few units at each of its levels, and in a box by units of
    /// the box.
    fn around(&self, distance2: T) -> [T; 2] {
        let lengths = self.tree_box.iter().flatten();
        let longest = lengths.fold(0.0, |longest, length| length.to_f64().max(longest));
        let distance = distance2.to_f64().sqrt();
        let slack = T::EPSILON * (64.0 * distance + 16.0 * longest);
        [distance - slack, distance + slack].map(|d| T::from_f64(d.max(0.0).powi(2)))
    }

    fn rank(&self, here: [T; D], found: &[u32], nearest: &mut Vec<(T, i32)>) {
        let keep = self.k + 1;
        nearest.clear();
        for &l in found {
            let d2 = self.distance2(here, l);
            let members = self.members_of(l as usize..l as usize + 1);
            nearest.extend(members.iter().take(keep).map(|&i| (d2, i)));
        }
        let order = |p: &(T, i32), q: &(T, i32)| p.0.total_cmp(&q.0).then(p.1.cmp(&q.1));
        nearest.sort_unstable_by(order);
        nearest.truncate(keep);
    }

    fn distance2(&self, here: [T; D], location: u32) -> T {
        let there = self.locations[location as usize];
        (0..D).fold(T::default(), |sum, a| {
            let d = separation::<T, true>(here[a], there[a], self.period[a]);
            sum + d * d
        })
    }
}

/// The tree searches for one kind of coordinates, which kiddo's bounds do not let one
/// write for both at once.
pub trait Nearest: Scalar + kiddo::Axis<Coord = Self> {
    /// A tree over `points`; they are known by their place in the slice.
    fn tree<const D: usize>(points: &[[Self; D]]) -> ImmutableKdTree<Self, D>;

    /// The `count` points nearest to `query`, or all if there are fewer.
    fn nearest<const D: usize>(
        tree: &ImmutableKdTree<Self, D>,
        query: &[Self; D],
        period: Option<&[Self; D]>,
        count: usize,
    ) -> Vec<u32>;

    /// The points whose squared distance from `query` is at most `reach`.
    fn within<const D: usize>(
        tree: &ImmutableKdTree<Self, D>,
        query: &[Self; D],
        period: Option<&[Self; D]>,
        reach: Self,
    ) -> Vec<u32>;
}

macro_rules! nearest {
    ($kind:ident) => {
        impl Nearest for $kind {
            fn tree<const D: usize>(points: &[[Self; D]]) -> ImmutableKdTree<Self, D> {
                ImmutableKdTree::new_from_slice(points).expect("fewer than 2^32 points")
            }

            fn nearest<const D: usize>(
                tree: &ImmutableKdTree<Self, D>,
                query: &[Self; D],
                period: Option<&[Self; D]>,
                count: usize,
            ) -> Vec<u32> {
                let count = NonZeroUsize::new(count).expect("at least one point");
                let query = tree.query(query);
                let found = match period {
                    None => query.nearest_n::<SquaredEuclidean<Self>>(count).execute(),
                    Some(period) => query
                        .periodic_boundary_condition(period)
                        .nearest_n::<SquaredEuclidean<Self>>(count)
                        .execute(),
                };
                found.into_iter().map(|found| found.item).collect()
            }

            fn within<const D: usize>(
                tree: &ImmutableKdTree<Self, D>,
                query: &[Self; D],
                period: Option<&[Self; D]>,
                reach: Self,
            ) -> Vec<u32> {
                let query = tree.query(query);
                let found = match period {
                    None => query
                        .within::<SquaredEuclidean<Self>>(reach)
                        .unsorted()
                        .execute(),
                    Some(period) => query
                        .periodic_boundary_condition(period)
                        .within::<SquaredEuclidean<Self>>(reach)
                        .unsorted()
                        .execute(),
                };
                found.into_iter().map(|found| found.item).collect()
            }
        }
    };
}

nearest!(f32);
nearest!(f64);
