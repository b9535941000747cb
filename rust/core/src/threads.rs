//! Thread pools that stay alive in forked processes.
//!
//! A process that forks (a torch `DataLoader` starting its workers, say) hands its
//! child a copy of the pool's memory but none of its threads, and perhaps locks that
//! a thread held at that moment. So nothing of an inherited pool is touched: the pool
//! is found through one atomic pointer, carries the id of the process that made it,
//! and a process with another id makes its own and leaks the old one.

use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicPtr, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use rayon::{ThreadPool, ThreadPoolBuilder};

/// How many threads, the caller's among them, may work on one call.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Threads {
    /// As many as the process may run at once (its affinity and quota respected).
    #[default]
    All,
    /// At most this many; one runs on the calling thread alone.
    AtMost(NonZeroUsize),
}

impl Threads {
    /// The calling thread alone if `small`.
    pub fn unless(self, small: bool) -> Self {
        if small {
            Self::AtMost(NonZeroUsize::MIN)
        } else {
            self
        }
    }
}

/// The helpers of one process: one thread fewer than it may run at once, since the
/// calling thread works too.
struct Helpers {
    process: u32,
    count: usize,
    pool: Option<ThreadPool>,
}

static HELPERS: AtomicPtr<Helpers> = AtomicPtr::new(std::ptr::null_mut());

fn helpers() -> &'static Helpers {
    let process = std::process::id();
    let current = HELPERS.load(Ordering::Acquire);
    // SAFETY: the pointer is null or came from `Box::into_raw` below, and what it
    // points to is never freed once published.
    if let Some(helpers) = unsafe { current.as_ref() }
        && helpers.process == process
    {
        return helpers;
    }
    let count = std::thread::available_parallelism().map_or(1, NonZeroUsize::get) - 1;
    // A pool that cannot be started (a limit on threads) leaves the caller alone.
    let pool = (count > 0)
        .then(|| {
            ThreadPoolBuilder::new()
                .num_threads(count)
                .thread_name(|i| format!("adaptgns-{i}"))
                .build()
                .ok()
        })
        .flatten();
    let fresh = Box::into_raw(Box::new(Helpers {
        process,
        count,
        pool,
    }));
    match HELPERS.compare_exchange(current, fresh, Ordering::AcqRel, Ordering::Acquire) {
        // SAFETY: `fresh` was just leaked and is published, so it lives for ever.
        Ok(_) => unsafe { &*fresh },
        Err(_) => {
            // SAFETY: another thread was faster; `fresh` is still ours alone.
            drop(unsafe { Box::from_raw(fresh) });
            helpers()
        }
    }
}

/// `task` of every item, in the order of the items, computed by up to `threads` threads.
pub fn map<I: Send, R: Send>(
    threads: Threads,
    items: Vec<I>,
    task: impl Fn(I) -> R + Sync,
) -> Vec<R> {
    let wanted = match threads {
        Threads::All => usize::MAX,
        Threads::AtMost(limit) => limit.get(),
    };
    let count = items.len();
    let pool = (wanted > 1 && count > 1).then(helpers).and_then(|helpers| {
        let spawned = helpers.count.min(wanted - 1).min(count - 1);
        helpers.pool.as_ref().map(|pool| (pool, spawned))
    });
    let Some((pool, spawned)) = pool else {
        return items.into_iter().map(task).collect();
    };

    let waiting = Mutex::new(items.into_iter().enumerate());
    let finished = Mutex::new(Vec::with_capacity(count));
    let work = || {
        let mut mine = Vec::new();
        loop {
            let next = lock(&waiting).next();
            let Some((i, item)) = next else { break };
            mine.push((i, task(item)));
        }
        lock(&finished).append(&mut mine);
    };
    pool.in_place_scope(|scope| {
        for _ in 0..spawned {
            scope.spawn(|_| work());
        }
        work();
    });
    let mut results = std::mem::take(&mut *lock(&finished));
    results.sort_unstable_by_key(|&(i, _)| i);
    results.into_iter().map(|(_, result)| result).collect()
}

/// Locks; what a panicking thread held is as good as ever, and its panic surfaces when
/// the scope ends.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
