//! Memory that goes from one step to the next, since fresh memory costs a page fault every 4 KiB.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, MutexGuard};

/// The most numbers that wait for use (1 GiB); what goes beyond is freed.
const MOST: usize = 1 << 28;

static FREE: Mutex<Vec<Vec<f32>>> = Mutex::new(Vec::new());

/// The list of what waits; `None` if it stays locked, as it would in a process that forked while
/// another thread held it.
fn free() -> Option<MutexGuard<'static, Vec<Vec<f32>>>> {
    (0..1_000).find_map(|_| {
        std::hint::spin_loop();
        FREE.try_lock().ok()
    })
}

/// Numbers whose memory is used again once they are dropped.
#[derive(Default)]
pub(super) struct Buffer(Vec<f32>);

impl Buffer {
    /// `length` numbers of any value.
    pub fn any(length: usize) -> Self {
        let waiting = free().and_then(|mut free| {
            let fits = |data: &Vec<f32>| (length..=length + length / 2).contains(&data.capacity());
            if let Some(place) = free.iter().rposition(fits) {
                return Some(free.remove(place));
            }
            // What waits longest is of a size that nobody asks for.
            let mut freed = 0;
            while freed < length && !free.is_empty() {
                freed += free.remove(0).capacity();
            }
            None
        });
        // Graphs of one simulation have about as many edges from step to step.
        let mut data = waiting.unwrap_or_else(|| Vec::with_capacity(length + length / 8));
        data.resize(length, 0.0);
        Self(data)
    }

    pub fn zeros(length: usize) -> Self {
        let mut buffer = Self::any(length);
        buffer.fill(0.0);
        buffer
    }

    pub fn copy(data: &[f32]) -> Self {
        let mut buffer = Self::any(data.len());
        buffer.copy_from_slice(data);
        buffer
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        if self.0.capacity() == 0 {
            return;
        }
        if let Some(mut free) = free() {
            free.push(std::mem::take(&mut self.0));
            let mut waiting: usize = free.iter().map(Vec::capacity).sum();
            while waiting > MOST {
                waiting -= free.remove(0).capacity();
            }
        }
    }
}

impl Deref for Buffer {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.0
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.0
    }
}
