//! How many edges there is room for.

use std::sync::atomic::{AtomicUsize, Ordering};

use crate::Error;

/// Bytes that an edge takes while a graph is assembled: two 64-bit indices in the
/// result and one 32-bit index before.
const BYTES_PER_EDGE: usize = 2 * size_of::<i64>() + size_of::<i32>();

/// Up to this many edges nobody asks how much memory there is, which takes longer
/// than building a small graph.
const UNASKED: usize = 1 << 22;

/// Counts the edges that all threads have found so far.
#[derive(Default)]
pub(super) struct Budget {
    edges: AtomicUsize,
    /// Room for edges; 0 until somebody asks.
    room: AtomicUsize,
}

impl Budget {
    /// Adds `edges`, or fails if there is no room for that many.
    pub fn charge(&self, edges: usize) -> Result<(), Error> {
        let total = self.edges.fetch_add(edges, Ordering::Relaxed) + edges;
        if total <= UNASKED || total <= self.room() {
            return Ok(());
        }
        Err(too_many(total, self.room()))
    }

    fn room(&self) -> usize {
        let room = self.room.load(Ordering::Relaxed);
        if room > 0 {
            return room;
        }
        let room = (available_memory() / BYTES_PER_EDGE).max(1);
        self.room.store(room, Ordering::Relaxed);
        room
    }
}

/// The error for at least `edges` edges where there is room for `room`.
pub(super) fn too_many(edges: usize, room: usize) -> Error {
    Error::OutOfMemory(format!(
        "the graph has at least {edges} edges, and the available memory holds {room}; \
         use a smaller radius or fewer particles"
    ))
}

/// Bytes the machine, or the control group of this process, can still give; without
/// bound where the system does not tell.
fn available_memory() -> usize {
    let Ok(mut system) = sysinfo::System::new() else {
        return usize::MAX;
    };
    system.refresh_memory();
    let group = system.cgroup_limits().map(|limits| limits.free_memory);
    let bytes = system.available_memory().min(group.unwrap_or(u64::MAX));
    usize::try_from(bytes).unwrap_or(usize::MAX)
}
