//! From the rows that each task found to one edge list.

use std::mem::MaybeUninit;

use super::Graph;
use super::lanes::{LONGEST, Lanes, Work, widest};
use super::memory::{Budget, Places, reserve, room};
use super::order::{NONE, SHORT, write_sorted_long};
use crate::Error;
use crate::threads::Team;

/// The senders of some receivers, row after row, each in any order.
pub(super) struct Rows {
    /// Has room for what is to come at its end.
    senders: Vec<i32>,
    used: usize,
    /// Of those used, what the budget knows of.
    charged: usize,
    counts: Vec<u32>,
}

/// Room that there always is behind a row.
const ROOM: usize = LONGEST;

impl Rows {
    pub fn with_receivers(receivers: usize) -> Self {
        Self {
            senders: vec![0; 8 * receivers + ROOM],
            used: 0,
            charged: 0,
            counts: Vec::with_capacity(receivers),
        }
    }

    /// The place of the next row, with room for `most` senders.
    #[inline(always)]
    pub fn next(&mut self, most: usize, budget: &Budget) -> Result<&mut [i32], Error> {
        if self.used + most + ROOM > self.senders.len() {
            self.grow(most, budget)?;
        }
        Ok(&mut self.senders[self.used..])
    }

    /// Ends the next row behind its first `n` senders.
    #[inline(always)]
    pub fn finish(&mut self, n: usize) {
        self.used += n;
        self.counts.push(n as u32);
    }

    /// Gives back what was asked for in vain: a row has room for all candidates, which may be many
    /// more than it holds.
    pub fn trim(&mut self) {
        if self.senders.len() > 4 * (self.used + ROOM) {
            self.senders.truncate(self.used + ROOM);
            self.senders.shrink_to_fit();
        }
    }

    #[cold]
    fn grow(&mut self, most: usize, budget: &Budget) -> Result<(), Error> {
        budget.charge(self.used - self.charged)?;
        self.charged = self.used;
        let more = self.senders.len().max(most + ROOM);
        self.senders
            .try_reserve_exact(more)
            .map_err(|_| no_memory_for(self.used + most))?;
        self.senders.resize(self.senders.len() + more, 0);
        Ok(())
    }
}

fn no_memory_for(edges: usize) -> Error {
    Error::OutOfMemory(format!(
        "no memory for {edges} edges; use a smaller radius or fewer particles"
    ))
}

/// Rows that lie between the one that is written and the one that is fetched from memory
/// meanwhile: where receivers are not in the order of their cells, each is somewhere else.
const SOON: usize = 32;
/// Numbers of a row to a line of the cache.
const LINE: usize = 16;

/// Most receivers whose rows are written as one task.
const TASK: usize = 4096;

/// Particles below which one thread goes over all rows: several would wait for each other's memory
/// longer than that takes.
const PASSED_ALONE: usize = 1 << 14;

/// Particles below which several threads wait for each other's memory longer than the rest takes.
const WORTH_SHARING: usize = 1 << 10;

/// How many of `count` particles are dealt with as one task: all where they are few, else at most
/// `most`. Few tasks are a power of two, since threads that are as many then end together.
pub(super) fn task_size(count: usize, most: usize) -> usize {
    const FEW_TASKS: usize = 16;
    if count < WORTH_SHARING {
        return count.max(1);
    }
    let mut tasks = count.div_ceil(most).max(2);
    if tasks < FEW_TASKS {
        tasks = tasks.next_power_of_two();
    }
    count.div_ceil(tasks)
}

/// Puts `parts`, each the rows of the receivers named, into one edge list over
/// `particles`, sorted by receiver.
///
/// # Safety
/// The parts name every particle once, each part as many as it has rows; in a row no sender, which
/// all are particles, comes twice, and with `drop_self` the receiver is one of them.
pub(super) unsafe fn assemble(
    particles: usize,
    parts: Vec<(&[i32], &Rows)>,
    drop_self: bool,
    team: &Team,
    budget: &Budget,
) -> Result<Graph, Error> {
    let (task, alone) = (task_size(particles, TASK), Team::alone());
    let passing = if particles < PASSED_ALONE {
        &alone
    } else {
        team
    };
    // The senders of each receiver, and the room behind them.
    let mut rows: Vec<&[i32]> = room(particles);
    let places = Places::of(&mut rows.spare_capacity_mut()[..particles]);
    passing.map(parts, |(receivers, part)| {
        assert_eq!(receivers.len(), part.counts.len());
        let mut senders = &part.senders[..];
        for (&receiver, &count) in receivers.iter().zip(&part.counts) {
            let count = count as usize;
            // SAFETY: nobody else writes the row of this receiver.
            unsafe { places.write(receiver as usize, &senders[..count + ROOM]) };
            senders = &senders[count..];
        }
    });
    // SAFETY: every particle is named.
    unsafe { rows.set_len(particles) };

    let kept = |row: &&[i32]| row.len() - ROOM - usize::from(drop_self);
    let counts = passing.map(rows.chunks(task).collect(), |rows| {
        rows.iter().map(kept).sum::<usize>()
    });
    let edges = counts.iter().sum();
    budget.check(edges)?;
    let mut edge_index: Vec<i64> = reserve(2 * edges).ok_or_else(|| no_memory_for(edges))?;
    let mut offsets: Vec<i64> = room(particles + 1);
    let (mut senders, mut receivers) =
        edge_index.spare_capacity_mut()[..2 * edges].split_at_mut(edges);
    let mut first_edge = 0;
    let tasks = rows
        .chunks(task)
        .zip(offsets.spare_capacity_mut().chunks_mut(task))
        .zip(counts)
        .enumerate()
        .map(|(t, ((rows, offsets), count))| {
            first_edge += count;
            Writing {
                first: (t * task) as i32,
                first_edge: first_edge - count,
                rows,
                offsets,
                drop_self,
                senders: senders.split_off_mut(..count).expect("edges left"),
                receivers: receivers.split_off_mut(..count).expect("edges left"),
            }
        });
    team.map(tasks.collect(), widest);
    // SAFETY: the tasks' rows partition both halves, and each wrote all of its part.
    unsafe { edge_index.set_len(2 * edges) };
    // SAFETY: as above, and the last one is written here.
    unsafe { offsets.set_len(particles) };
    offsets.push(edges as i64);
    Ok(Graph {
        edge_index,
        offsets,
    })
}

/// The rows of some receivers, and their place in the edge list.
struct Writing<'a> {
    first: i32,
    first_edge: usize,
    rows: &'a [&'a [i32]],
    /// At least as many.
    offsets: &'a mut [MaybeUninit<i64>],
    drop_self: bool,
    senders: &'a mut [MaybeUninit<i64>],
    receivers: &'a mut [MaybeUninit<i64>],
}

impl Work for Writing<'_> {
    type Output = ();

    #[inline(always)]
    fn run<const BLOCK: usize, L: Lanes<BLOCK>>(self, lanes: L) {
        let Self {
            first,
            first_edge,
            rows,
            offsets,
            drop_self,
            senders,
            receivers,
        } = self;
        let edges = senders.len();
        let mut at = 0;
        for (k, (row, offset)) in rows.iter().zip(offsets).enumerate() {
            let soon = rows[rows.len().min(k + SOON + 1) - 1];
            // A row and its room always lie in two.
            for line in 0..2 {
                lanes.prefetch(soon.as_ptr().wrapping_add(line * LINE));
            }
            for place in (2 * LINE..soon.len().min(SHORT + ROOM)).step_by(LINE) {
                lanes.prefetch(soon.as_ptr().wrapping_add(place));
            }
            offset.write((first_edge + at) as i64);
            let receiver = first + k as i32;
            let found = row.len() - ROOM;
            let count = found - usize::from(drop_self);
            let dropped = if drop_self { receiver } else { NONE };
            if found <= SHORT && at + found + LONGEST <= edges {
                // SAFETY: a search finds every sender once, the receiver among them, in front of
                // `ROOM`; there is room for whole blocks, which the next rows overwrite.
                unsafe {
                    lanes.write_sorted(row, found, dropped, senders.as_mut_ptr().add(at).cast());
                    fill(
                        receivers.as_mut_ptr().add(at).cast(),
                        count,
                        i64::from(receiver),
                    );
                }
            } else {
                let places = at..at + count;
                write_sorted_long(&row[..found], dropped, &mut senders[places.clone()]);
                receivers[places].fill(MaybeUninit::new(i64::from(receiver)));
            }
            at += count;
        }
    }
}

/// Writes `count` times `value`, in whole blocks.
///
/// # Safety
/// There is room for these, and for one at least.
#[inline(always)]
unsafe fn fill(out: *mut [i64; LONGEST / 2], count: usize, value: i64) {
    const WHOLE: usize = LONGEST / 2;
    // SAFETY: promised by the caller.
    unsafe {
        out.write([value; WHOLE]);
        // Asked for itself, since it is seldom so.
        if count > WHOLE {
            for block in 1..count.div_ceil(WHOLE) {
                out.add(block).write([value; WHOLE]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tasks_are_one_then_a_power_of_two_then_as_large_as_they_may_be() {
        let sizes = [0, 1, 1_023, 1_024, 2_049, 5_000, 16_000, 1_000_000];
        assert_eq!(
            sizes.map(|count| task_size(count, 1_024)),
            [1, 1, 1_023, 512, 513, 625, 1_000, 1_024]
        );
    }
}
