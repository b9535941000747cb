//! Memory that goes from one step to the next, since fresh memory costs page faults.
//!
//! It comes from the system's allocator: what is the global one, which a Python module chooses for
//! many small requests, may take half as much again for those of megabytes.

use std::alloc::{GlobalAlloc, Layout, System, handle_alloc_error};
use std::ops::{Deref, DerefMut};
use std::ptr::NonNull;
use std::slice;
use std::sync::{Mutex, MutexGuard};

use crate::Error;
use crate::system;

/// The most numbers that wait for use (1 GiB); what goes beyond is freed.
const MOST: usize = 1 << 28;

/// Bytes up to which nobody asks how much memory there is, which takes longer than a small pass.
const UNASKED: usize = 1 << 30;

static FREE: Mutex<Vec<Memory>> = Mutex::new(Vec::new());

/// The list of what waits; `None` if it stays locked, as it would in a process that forked while
/// another thread held it.
fn free() -> Option<MutexGuard<'static, Vec<Memory>>> {
    (0..1_000).find_map(|_| {
        std::hint::spin_loop();
        FREE.try_lock().ok()
    })
}

/// Fails if there is no memory for `bytes` in buffers, beside what waits for use.
pub(super) fn check_room(bytes: usize) -> Result<(), Error> {
    if bytes <= UNASKED {
        return Ok(());
    }
    let waiting = free().map_or(0, |free| free.iter().map(|memory| memory.capacity).sum());
    let room = system::available_memory().saturating_add(waiting * size_of::<f32>());
    if bytes <= room {
        return Ok(());
    }
    Err(Error::OutOfMemory(format!(
        "the network takes at least {bytes} bytes for so many particles and edges and the \
         available memory holds {room}; use fewer, or a narrower network"
    )))
}

/// Room for numbers, each of which has some value.
struct Memory {
    start: NonNull<f32>,
    capacity: usize,
}

// SAFETY: it owns what it points to.
unsafe impl Send for Memory {}
// SAFETY: as above, and it changes only for who has it alone.
unsafe impl Sync for Memory {}

impl Memory {
    fn new(capacity: usize) -> Self {
        let layout = Self::layout(capacity);
        let start = if capacity == 0 {
            NonNull::dangling()
        } else {
            // SAFETY: the layout has bytes, and zeros are numbers.
            let start = unsafe { System.alloc_zeroed(layout) };
            let start = NonNull::new(start.cast()).unwrap_or_else(|| handle_alloc_error(layout));
            system::ask_for_large(start.as_ptr(), capacity);
            start
        };
        Self { start, capacity }
    }

    fn layout(capacity: usize) -> Layout {
        Layout::array::<f32>(capacity).expect("memory that can be addressed")
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        if self.capacity > 0 {
            // SAFETY: it was allocated so.
            unsafe { System.dealloc(self.start.as_ptr().cast(), Self::layout(self.capacity)) };
        }
    }
}

/// Numbers whose memory is used again once they are dropped.
pub(super) struct Buffer {
    memory: Memory,
    /// At most the capacity.
    length: usize,
}

impl Buffer {
    /// `length` numbers of any value.
    pub fn any(length: usize) -> Self {
        let waiting = free().and_then(|mut free| {
            let fits = |memory: &Memory| (length..=length + length / 2).contains(&memory.capacity);
            if let Some(place) = free.iter().rposition(fits) {
                return Some(free.remove(place));
            }
            // What waits longest is of a size that nobody asks for.
            let mut freed = 0;
            while freed < length && !free.is_empty() {
                freed += free.remove(0).capacity;
            }
            None
        });
        // Graphs of one simulation have about as many edges from step to step.
        let memory = waiting.unwrap_or_else(|| Memory::new(length + length / 8));
        Self { memory, length }
    }

    pub fn zeros(length: usize) -> Self {
        let mut buffer = Self::any(length);
        buffer.fill(0.0);
        buffer
    }

    /// Its memory as `length` numbers of half the size.
    pub fn packed(&mut self, length: usize) -> &mut [u16] {
        assert!(length <= 2 * self.length);
        // SAFETY: so many lie there, of weaker alignment; any bits are a number.
        unsafe { slice::from_raw_parts_mut(self.memory.start.as_ptr().cast(), length) }
    }

    pub fn copy(data: &[f32]) -> Self {
        let mut buffer = Self::any(data.len());
        buffer.copy_from_slice(data);
        buffer
    }
}

impl Default for Buffer {
    fn default() -> Self {
        Self {
            memory: Memory::new(0),
            length: 0,
        }
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        if self.memory.capacity == 0 {
            return;
        }
        if let Some(mut free) = free() {
            free.push(std::mem::replace(&mut self.memory, Memory::new(0)));
            let mut waiting: usize = free.iter().map(|memory| memory.capacity).sum();
            while waiting > MOST {
                waiting -= free.remove(0).capacity;
            }
        }
    }
}

impl Deref for Buffer {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        // SAFETY: the memory is as long, or longer, and all of it has values.
        unsafe { slice::from_raw_parts(self.memory.start.as_ptr(), self.length) }
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        // SAFETY: as above, and nobody else has it.
        unsafe { slice::from_raw_parts_mut(self.memory.start.as_ptr(), self.length) }
    }
}
