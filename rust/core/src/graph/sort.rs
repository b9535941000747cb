//! A stable counting sort of particles by the number of their cell.
//!
//! Where there are many, they are copied to slabs of consecutive cells first, so that each slab
//! fits into the cache while its particles are sorted, and threads share both passes.

use std::mem::MaybeUninit;
use std::ops::Range;

use super::lanes::LONGEST;
use super::memory::{filled, room};
use super::scalar::Scalar;
use crate::threads::Team;

/// Particles in a slab, about.
const SLAB: usize = 1 << 13;

/// A processor can't keep the ends of many more at hand while it writes to all of them.
const MOST_SLABS: usize = 1 << 11;

/// Parts of the particles that are copied to their slabs as one task each.
const PARTS: usize = 32;

/// Particles in cell order, those of one cell in the order in which they came.
pub(super) struct Sorted<T, const D: usize> {
    /// First particle of each cell, and one past the last particle.
    pub starts: Vec<u32>,
    /// One array per axis, with room for a block behind.
    pub coords: [Vec<T>; D],
    /// The caller's index of each, with the same room.
    pub index: Vec<i32>,
}

#[derive(Clone, Copy)]
struct Particle<T, const D: usize> {
    position: [T; D],
    /// The caller's index.
    index: i32,
    cell: u32,
}

/// Sorts `positions`, whose caller's indices begin at `first`, into so many `cells`; `numbers`
/// tells the cell of each particle in a range.
pub(super) fn sort_by_cell<T: Scalar, const D: usize>(
    positions: &[[T; D]],
    first: usize,
    cells: usize,
    numbers: impl Fn(Range<usize>) -> Vec<u32> + Sync,
    team: &Team,
) -> Sorted<T, D> {
    let count = positions.len();
    let mut starts = filled(0, cells + 1);
    starts[cells] = count as u32;
    let mut coords: [Vec<T>; D] = std::array::from_fn(|_| room(count + LONGEST));
    let mut index = room(count + LONGEST);
    let mut all = Slab {
        begin: 0,
        first_cell: 0,
        starts: &mut starts[..cells],
        coords: coords
            .each_mut()
            .map(|coords| &mut coords.spare_capacity_mut()[..count]),
        index: &mut index.spare_capacity_mut()[..count],
    };
    let particle = |i: usize, cell| Particle {
        position: positions[i],
        index: (first + i) as i32,
        cell,
    };
    let slabs = (count / SLAB).min(MOST_SLABS);
    if slabs < 2 {
        let numbered = (0..count).zip(numbers(0..count));
        let particles: Vec<_> = numbered.map(|(i, cell)| particle(i, cell)).collect();
        all.sort(&particles);
    } else {
        let bits = cells.div_ceil(slabs).next_power_of_two().ilog2();
        let (particles, counts) = to_slabs(count, particle, numbers, cells, bits, team);
        let mut left = &particles[..];
        let tasks = counts.iter().map(|&count| {
            let particles = left.split_off(..count).expect("counted");
            (all.split_off(1 << bits, count), particles)
        });
        team.map(tasks.collect(), |(slab, particles)| slab.sort(particles));
    }
    for coords in &mut coords {
        // SAFETY: the slabs are all of it, and each wrote all of its own.
        unsafe { coords.set_len(count) };
        coords.resize(count + LONGEST, T::default());
    }
    // SAFETY: as above.
    unsafe { index.set_len(count) };
    index.resize(count + LONGEST, 0);
    Sorted {
        starts,
        coords,
        index,
    }
}

/// All `count` particles in slabs of `2^bits` of the `cells`, in one slab as they come; also how
/// many there are in each.
fn to_slabs<T: Scalar, const D: usize>(
    count: usize,
    particle: impl Fn(usize, u32) -> Particle<T, D> + Sync,
    numbers: impl Fn(Range<usize>) -> Vec<u32> + Sync,
    cells: usize,
    bits: u32,
    team: &Team,
) -> (Vec<Particle<T, D>>, Vec<usize>) {
    let slabs = cells.div_ceil(1 << bits);
    let part = count.div_ceil(PARTS);
    let parts = (0..count)
        .step_by(part)
        .map(|begin| begin..count.min(begin + part));
    let counted = team.map(parts.collect(), |part| {
        let mut counts = vec![0; slabs];
        let cells = numbers(part.clone());
        for cell in &cells {
            counts[(cell >> bits) as usize] += 1;
        }
        (part, cells, counts)
    });
    let mut particles = room(count);
    let mut left = &mut particles.spare_capacity_mut()[..count];
    // Of each part, its places in every slab.
    let mut places: Vec<Vec<_>> = counted.iter().map(|_| Vec::with_capacity(slabs)).collect();
    let mut totals = vec![0; slabs];
    for (slab, total) in totals.iter_mut().enumerate() {
        for ((_, _, counts), places) in counted.iter().zip(&mut places) {
            let place = left.split_off_mut(..counts[slab]).expect("counted");
            places.push(place.iter_mut());
            *total += counts[slab];
        }
    }
    let tasks = counted.into_iter().zip(places).collect();
    team.map(tasks, |((part, cells, _), mut places)| {
        for (i, cell) in part.zip(cells) {
            let place = places[(cell >> bits) as usize].next();
            place.expect("counted").write(particle(i, cell));
        }
    });
    // SAFETY: the places of all parts are all of it, and each was written to.
    unsafe { particles.set_len(count) };
    (particles, totals)
}

/// Consecutive cells, and room for the particles in them.
struct Slab<'a, T, const D: usize> {
    first_cell: usize,
    /// Sorted particles before them.
    begin: u32,
    /// Of each cell, zero until it is sorted.
    starts: &'a mut [u32],
    coords: [&'a mut [MaybeUninit<T>]; D],
    index: &'a mut [MaybeUninit<i32>],
}

impl<T: Scalar, const D: usize> Slab<'_, T, D> {
    /// The first of its `cells`, with `count` particles, which it has no longer.
    fn split_off(&mut self, cells: usize, count: usize) -> Self {
        let cells = cells.min(self.starts.len());
        let front = Self {
            begin: self.begin,
            first_cell: self.first_cell,
            starts: self.starts.split_off_mut(..cells).expect("cells left"),
            coords: self
                .coords
                .each_mut()
                .map(|coords| coords.split_off_mut(..count).expect("room left")),
            index: self.index.split_off_mut(..count).expect("room left"),
        };
        self.begin += count as u32;
        self.first_cell += cells;
        front
    }

    /// Puts `particles`, as many as there is room for, in order.
    fn sort(self, particles: &[Particle<T, D>]) {
        assert_eq!(particles.len(), self.index.len());
        let cell = |particle: &Particle<T, D>| particle.cell as usize - self.first_cell;
        for particle in particles {
            self.starts[cell(particle)] += 1;
        }
        // From counts to ends; then, from the last particle to the first, each moves the end of
        // its cell back, at last to its start.
        let mut end = self.begin;
        for start in &mut *self.starts {
            end += *start;
            *start = end;
        }
        for particle in particles.iter().rev() {
            let start = &mut self.starts[cell(particle)];
            *start -= 1;
            let slot = (*start - self.begin) as usize;
            for a in 0..D {
                self.coords[a][slot].write(particle.position[a]);
            }
            self.index[slot].write(particle.index);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroUsize;

    use super::*;
    use crate::threads::{Threads, team};

    #[test]
    fn sorts_as_the_standard_library() {
        let uneven = |i: usize, cells: usize| (i * i / 7 % 1_009 * i) % cells;
        let one = |_, cells| cells - 1;
        for threads in [Threads::All, Threads::AtMost(NonZeroUsize::MIN)] {
            for count in [0, 1, 700, 2 * SLAB - 1, 2 * SLAB, 9 * SLAB + 13] {
                for cells in [1, 7, 3 * SLAB] {
                    for cell_of in [uneven, one] {
                        check(threads, count, cells, |i| cell_of(i, cells));
                    }
                }
            }
        }
    }

    fn check(threads: Threads, count: usize, cells: usize, cell_of: impl Fn(usize) -> usize) {
        const FIRST: usize = 5;
        let positions: Vec<[f64; 2]> = (0..count).map(|i| [i as f64, cell_of(i) as f64]).collect();
        let numbers = |range: Range<usize>| positions[range].iter().map(|p| p[1] as u32).collect();
        let sorted = team(threads, |team| {
            sort_by_cell(&positions, FIRST, cells, numbers, team)
        });
        let mut expected = positions.clone();
        expected.sort_by(|p, q| p[1].total_cmp(&q[1]));
        for (a, coords) in sorted.coords.iter().enumerate() {
            let expected = expected.iter().map(|p| p[a]);
            assert!(coords.iter().copied().eq(expected.chain([0.0; LONGEST])));
        }
        let index = expected.iter().map(|p| p[0] as i32 + FIRST as i32);
        assert!(sorted.index.iter().copied().eq(index.chain([0; LONGEST])));
        let starts = (0..=cells).map(|cell| expected.partition_point(|p| (p[1] as usize) < cell));
        assert!(sorted.starts.iter().map(|&start| start as usize).eq(starts));
    }
}
