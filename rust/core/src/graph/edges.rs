//! From the rows that each task found to one edge list.

use super::Graph;
use super::memory::Budget;
use super::order::{RANKED, sort_row};
use crate::Error;
use crate::threads::{self, Threads};

/// The senders of some receivers, row after row.
pub(super) struct Rows {
    /// Room for what is to come at the end.
    senders: Vec<i32>,
    used: usize,
    counts: Vec<u32>,
}

impl Rows {
    pub fn with_receivers(receivers: usize) -> Self {
        Self {
            senders: vec![0; 8 * receivers + RANKED],
            used: 0,
            counts: Vec::with_capacity(receivers),
        }
    }

    /// Adds a row of the `n` senders at the front of `found`, sorted and without
    /// `dropped`.
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
        let more = self.senders.len().max(n + RANKED);
        budget.charge(more)?;
        self.senders.resize(self.senders.len() + more, 0);
        Ok(())
    }
}

/// Copies `parts`, each the rows of the receivers named, into one edge list over
/// `particles`, sorted by receiver. Every particle is named once.
pub(super) fn assemble(
    particles: usize,
    parts: &[(&[i32], &Rows)],
    threads: Threads,
) -> Result<Graph, Error> {
    let mut offsets = vec![0_i64; particles + 1];
    for (receivers, rows) in parts {
        for (&receiver, &count) in receivers.iter().zip(&rows.counts) {
            offsets[receiver as usize + 1] = i64::from(count);
        }
    }
    let mut total = 0;
    for offset in &mut offsets {
        total += *offset;
        *offset = total;
    }
    let edges = total as usize;
    let mut edge_index: Vec<i64> = Vec::new();
    if edge_index.try_reserve_exact(2 * edges).is_err() {
        return Err(Error::OutOfMemory(format!(
            "no memory for the {edges} edges of the graph; use a smaller radius or fewer particles"
        )));
    }
    let out = Out(edge_index.as_mut_ptr());
    threads::map(threads, parts.len(), |p| {
        let out = &out;
        let (receivers, rows) = parts[p];
        let mut at = 0;
        for (&receiver, &count) in receivers.iter().zip(&rows.counts) {
            let row = &rows.senders[at..at + count as usize];
            let begin = offsets[receiver as usize] as usize;
            for (k, &sender) in row.iter().enumerate() {
                unsafe {
                    out.0.add(begin + k).write(i64::from(sender));
                    out.0.add(edges + begin + k).write(i64::from(receiver));
                }
            }
            at += count as usize;
        }
    });
    unsafe { edge_index.set_len(2 * edges) };
    Ok(Graph {
        edge_index,
        offsets,
    })
}

struct Out(*mut i64);
unsafe impl Sync for Out {}
