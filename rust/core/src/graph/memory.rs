//! How many edges there is room for, and that room.

use std::cell::Cell;
use std::mem::MaybeUninit;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::Error;
use crate::system;
use crate::threads::Team;

/// Bytes that an edge takes while a graph is assembled: two 64-bit indices in the
/// result and one 32-bit index before.
const BYTES_PER_EDGE: usize = 2 * size_of::<i64>() + size_of::<i32>();

/// Up to this many edges nobody asks how much memory there is, which takes longer
/// than building a small graph.
const UNASKED: usize = 1 << 22;

/// Values that one thread deals with at a time where all are alike.
pub(super) const SHARE: usize = 1 << 12;

/// Counts the edges that all threads have found so far.
#[derive(Default)]
pub(super) struct Budget {
    edges: AtomicUsize,
    room: OnceLock<usize>,
}

impl Budget {
    /// Counts `edges` more, or fails if there is no room for them.
    pub fn charge(&self, edges: usize) -> Result<(), Error> {
        self.check(self.edges.fetch_add(edges, Ordering::Relaxed) + edges)
    }

    /// Fails if there is no room for a graph of at least `edges` edges.
    pub fn check(&self, edges: usize) -> Result<(), Error> {
        let room = || {
            *self
                .room
                .get_or_init(|| system::available_memory() / BYTES_PER_EDGE)
        };
        if edges <= UNASKED || edges <= room() {
            return Ok(());
        }
        Err(Error::OutOfMemory(format!(
            "the graph has at least {edges} edges and the available memory holds {}; \
             use a smaller radius or fewer particles",
            room()
        )))
    }
}

/// `count` times `value`, in memory as [`reserve`] asks for it.
pub(super) fn filled<T: Copy>(value: T, count: usize) -> Vec<T> {
    let mut all = room(count);
    all.resize(count, value);
    all
}

/// What `value` is of every number below `count`, computed by the whole team.
pub(super) fn collected<T: Send>(
    team: &Team,
    count: usize,
    value: impl Fn(usize) -> T + Sync,
) -> Vec<T> {
    let mut all = room(count);
    let shares = all.spare_capacity_mut()[..count].chunks_mut(SHARE);
    team.map(shares.enumerate().collect(), |(number, share)| {
        for (i, place) in (number * SHARE..).zip(share) {
            place.write(value(i));
        }
    });
    // SAFETY: the shares are all of it, and each was written to.
    unsafe { all.set_len(count) };
    all
}

/// Places in memory that several threads write to, each to its own.
pub(super) struct Places<'a, T>(&'a [Cell<MaybeUninit<T>>]);

// SAFETY: whoever writes promises that nobody else writes there.
unsafe impl<T: Send> Sync for Places<'_, T> {}

impl<'a, T> Places<'a, T> {
    pub fn of(room: &'a mut [MaybeUninit<T>]) -> Self {
        Self(Cell::from_mut(room).as_slice_of_cells())
    }

    /// # Safety
    /// No other thread writes to this place, and nobody reads there meanwhile.
    pub unsafe fn write(&self, at: usize, value: T) {
        self.0[at].set(MaybeUninit::new(value));
    }
}

/// An empty vector with room for `count` values, in memory as [`reserve`] asks for it.
pub(super) fn room<T>(count: usize) -> Vec<T> {
    reserve(count).unwrap_or_else(|| Vec::with_capacity(count))
}

/// An empty vector with room for `count` values, `None` if there is no memory for it.
///
/// Fresh memory is mapped page by page as it is written to, which for a large graph takes as
/// long as the search; the system is asked for large pages.
pub(super) fn reserve<T>(count: usize) -> Option<Vec<T>> {
    let mut room = Vec::<T>::new();
    room.try_reserve_exact(count).ok()?;
    system::ask_for_large(room.as_mut_ptr(), count);
    Some(room)
}
