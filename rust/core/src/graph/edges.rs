//! From the rows that each task found to one edge list.

use std::mem::MaybeUninit;

use super::Graph;
use super::memory::Budget;
use super::order::{RANKED, sort_row};
use crate::Error;
use crate::threads::{self, Threads};

/// The senders of some receivers, row after row.
pub(super) struct Rows {
    /// Has room for what is to come at its end.
    senders: Vec<i32>,
    used: usize,
    /// Of those used, what the budget knows of.
    charged: usize,
    counts: Vec<u32>,
}

impl Rows {
    pub fn with_receivers(receivers: usize) -> Self {
        Self {
            senders: vec![0; 8 * receivers + RANKED],
            used: 0,
            charged: 0,
            counts: Vec::with_capacity(receivers),
        }
    }

    /// Adds a row of the `n` senders at the front of `found`, sorted and without
    /// `dropped`; see [`sort_row`].
    #[inline(always)]
    pub fn push(
        &mut self,
        found: &mut [i32],
        n: usize,
        dropped: i32,
        budget: &Budget,
    ) -> Result<(), Error> {
        if self.used + n + RANKED > self.senders.len() {
            self.grow(n, budget)?;
        }
        sort_row(found, n, dropped, &mut self.senders[self.used..]);
        let kept = n - usize::from(dropped >= 0);
        self.used += kept;
        self.counts.push(kept as u32);
        Ok(())
    }

    #[cold]
    fn grow(&mut self, n: usize, budget: &Budget) -> Result<(), Error> {
        budget.charge(self.used - self.charged)?;
        self.charged = self.used;
        let more = self.senders.len().max(n + RANKED);
        self.senders
            .try_reserve_exact(more)
            .map_err(|_| no_memory_for(self.used + n))?;
        self.senders.resize(self.senders.len() + more, 0);
        Ok(())
    }
}

fn no_memory_for(edges: usize) -> Error {
    Error::OutOfMemory(format!(
        "no memory for {edges} edges; use a smaller radius or fewer particles"
    ))
}

/// Receivers whose rows are written as one task.
const TASK: usize = 4096;

/// Puts `parts`, each the rows of the receivers named, into one edge list over
/// `particles`, sorted by receiver. Every particle is named once.
pub(super) fn assemble(
    particles: usize,
    parts: &[(&[i32], &Rows)],
    threads: Threads,
    budget: &Budget,
) -> Result<Graph, Error> {
    let mut rows: Vec<&[i32]> = vec![&[]; particles];
    for (receivers, part) in parts {
        let mut senders = &part.senders[..];
        for (&receiver, &count) in receivers.iter().zip(&part.counts) {
            (rows[receiver as usize], senders) = senders.split_at(count as usize);
        }
    }
    let mut offsets = Vec::with_capacity(particles + 1);
    let mut total = 0;
    offsets.push(0);
    offsets.extend(rows.iter().map(|row| {
        total += row.len() as i64;
        total
    }));

    let edges = total as usize;
    budget.check(edges)?;
    let mut edge_index: Vec<i64> = Vec::new();
    edge_index
        .try_reserve_exact(2 * edges)
        .map_err(|_| no_memory_for(edges))?;
    let (mut senders, mut receivers) =
        edge_index.spare_capacity_mut()[..2 * edges].split_at_mut(edges);
    let mut tasks = Vec::new();
    for (t, rows) in rows.chunks(TASK).enumerate() {
        let first = t * TASK;
        let edges = (offsets[first + rows.len()] - offsets[first]) as usize;
        tasks.push((
            first,
            rows,
            senders.split_off_mut(..edges).expect("edges left"),
            receivers.split_off_mut(..edges).expect("edges left"),
        ));
    }
    threads::map(threads, tasks, |(first, rows, senders, receivers)| {
        let mut at = 0;
        for (receiver, row) in (first as i64..).zip(rows) {
            let end = at + row.len();
            for (slot, &sender) in senders[at..end].iter_mut().zip(*row) {
                slot.write(i64::from(sender));
            }
            receivers[at..end].fill(MaybeUninit::new(receiver));
            at = end;
        }
    });
    // SAFETY: the tasks' rows partition both halves, and each wrote all of its part.
    unsafe { edge_index.set_len(2 * edges) };
    Ok(Graph {
        edge_index,
        offsets,
    })
}
