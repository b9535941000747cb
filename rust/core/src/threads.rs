//! Thread pools that stay alive in forked processes.
//!
//! A process that forks (a torch `DataLoader` starting its workers, say) hands its
//! child a copy of the pool's memory but none of its threads, and perhaps locks that
//! a thread held at that moment. So nothing of an inherited pool is touched: the pool
//! is found through one atomic pointer, carries the id of the process that made it,
//! and a process with another id makes its own and leaks the old one.

use std::cell::{Cell, UnsafeCell};
use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicBool, AtomicPtr, AtomicUsize, Ordering};
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
    /// At most `count` of them, and at least one.
    pub fn at_most(self, count: usize) -> Self {
        let most = match self {
            Self::All => count,
            Self::AtMost(limit) => limit.get().min(count),
        };
        Self::AtMost(NonZeroUsize::new(most).unwrap_or(NonZeroUsize::MIN))
    }
}

/// The helpers of one process: one thread fewer than it may run at once, since the
/// calling thread works too.
struct Helpers {
    process: u32,
    count: usize,
    pool: Option<ThreadPool>,
    /// Whether a [`team`] has them, to whose end they are nobody else's.
    taken: AtomicBool,
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
        taken: AtomicBool::new(false),
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

/// Threads that stay awake from one [`Team::map`] to the next: waking them costs more than a short
/// one takes.
pub struct Team {
    /// What there is to do while `open` is not 0.
    work: UnsafeCell<Option<*const (dyn Fn() + Sync)>>,
    /// Number of the work that helpers may begin; 0 for none.
    open: AtomicUsize,
    /// Helpers that may be at work.
    active: AtomicUsize,
    /// How many have come before.
    count: Cell<usize>,
    over: AtomicBool,
    helped: bool,
}

/// What helpers see of a [`Team`].
struct Helped<'t>(&'t Team);

// SAFETY: a helper touches `open`, `active`, `over` and, while `open` says so and `active` counts
// it, `work`, which its owner does not change then; `count` is the owner's.
unsafe impl Sync for Helped<'_> {}

/// What `body` returns, which may share its work with up to `threads` threads; it works alone where
/// another team has the helpers, since waiting for that would take longer.
pub fn team<R>(threads: Threads, body: impl FnOnce(&Team) -> R) -> R {
    let wanted = match threads {
        Threads::All => usize::MAX,
        Threads::AtMost(limit) => limit.get(),
    };
    let helpers = (wanted > 1)
        .then(helpers)
        .and_then(|helpers| Some((helpers, helpers.pool.as_ref()?)))
        .filter(|(helpers, _)| !helpers.taken.swap(true, Ordering::Relaxed));
    let team = Team {
        helped: helpers.is_some(),
        ..Team::alone()
    };
    let Some((helpers, pool)) = helpers else {
        return body(&team);
    };
    let _given_back = OnDrop(|| helpers.taken.store(false, Ordering::Relaxed));
    let helped = Helped(&team);
    pool.in_place_scope(|scope| {
        // Also where `body` panics: the scope waits for the helpers.
        let _over = OnDrop(|| team.over.store(true, Ordering::Release));
        for _ in 0..helpers.count.min(wanted - 1) {
            scope.spawn(|_| helped.help());
        }
        body(&team)
    })
}

impl Helped<'_> {
    fn help(&self) {
        let team = self.0;
        let mut last = 0;
        let mut idle = 0_u32;
        while !team.over.load(Ordering::Acquire) {
            let number = team.open.load(Ordering::SeqCst);
            if number == 0 || number == last {
                idle += 1;
                if idle.is_multiple_of(1 << 10) {
                    std::thread::yield_now(); // others may need the core
                }
                std::hint::spin_loop();
                continue;
            }
            idle = 0;
            last = number;
            team.active.fetch_add(1, Ordering::SeqCst);
            let _left = OnDrop(|| {
                team.active.fetch_sub(1, Ordering::Release);
            });
            // Open still, so the owner waits until this helper has left.
            if team.open.load(Ordering::SeqCst) == number {
                // SAFETY: the owner changes the work, and lets what it points to go, only after it
                // has closed it and no helper is active.
                if let Some(work) = unsafe { *team.work.get() } {
                    // SAFETY: as above.
                    unsafe { (*work)() };
                }
            }
        }
    }
}

impl Team {
    /// The calling thread.
    pub fn alone() -> Self {
        Self {
            work: UnsafeCell::new(None),
            open: AtomicUsize::new(0),
            active: AtomicUsize::new(0),
            count: Cell::new(0),
            over: AtomicBool::new(false),
            helped: false,
        }
    }

    /// `task` of every item, in the order of the items, computed by the whole team. It returns only
    /// after every task has, so that what these write may be taken as written; should one panic, so
    /// does this.
    pub fn map<I: Send, R: Send>(&self, items: Vec<I>, task: impl Fn(I) -> R + Sync) -> Vec<R> {
        if !self.helped || items.len() < 2 {
            return items.into_iter().map(task).collect();
        }
        let count = items.len();
        let finished = Mutex::new(Vec::with_capacity(count));
        let waiting = Mutex::new(items.into_iter().enumerate());
        self.all(&|| {
            let mut mine = Vec::new();
            loop {
                let next = lock(&waiting).next();
                let Some((i, item)) = next else { break };
                mine.push((i, task(item)));
            }
            lock(&finished).append(&mut mine);
        });
        let mut results = std::mem::take(&mut *lock(&finished));
        assert_eq!(results.len(), count, "a task panicked on another thread");
        results.sort_unstable_by_key(|&(i, _)| i);
        results.into_iter().map(|(_, result)| result).collect()
    }

    /// All results of [`Self::map`] joined, in the order of the items: a result is joined as soon as
    /// those before it are, so that few wait at a time.
    pub fn reduce<I: Send, R: Send>(
        &self,
        items: Vec<I>,
        task: impl Fn(I) -> R + Sync,
        join: impl Fn(R, R) -> R + Sync,
    ) -> Option<R> {
        struct Joined<R> {
            /// What is joined; whoever joins the next result to it has taken it.
            total: Option<R>,
            count: usize,
            waiting: BTreeMap<usize, R>,
        }
        let joined = Mutex::new(Joined {
            total: None,
            count: 0,
            waiting: BTreeMap::new(),
        });
        self.map(items.into_iter().enumerate().collect(), |(i, item)| {
            let result = task(item);
            lock(&joined).waiting.insert(i, result);
            loop {
                let mut now = lock(&joined);
                let count = now.count;
                if count > 0 && now.total.is_none() {
                    break;
                }
                let Some(next) = now.waiting.remove(&count) else {
                    break;
                };
                let total = now.total.take();
                now.count += 1;
                drop(now);
                let total = match total {
                    Some(total) => join(total, next),
                    None => next,
                };
                lock(&joined).total = Some(total);
            }
        });
        let joined = joined.into_inner();
        joined.unwrap_or_else(PoisonError::into_inner).total
    }

    /// Does `work` on every thread of the team, which shares it out itself.
    fn all(&self, work: &(dyn Fn() + Sync)) {
        // SAFETY: only the lifetime changes, and nobody uses it after `closed` below, which is
        // dropped before `work` ends.
        let work: *const (dyn Fn() + Sync) =
            unsafe { std::mem::transmute::<&(dyn Fn() + Sync), &'static (dyn Fn() + Sync)>(work) };
        // SAFETY: nothing is open and nobody active, so no helper looks.
        unsafe { *self.work.get() = Some(work) };
        self.count.set(self.count.get() + 1);
        self.open.store(self.count.get(), Ordering::SeqCst);
        let _closed = OnDrop(|| {
            self.open.store(0, Ordering::SeqCst);
            while self.active.load(Ordering::SeqCst) > 0 {
                std::hint::spin_loop();
            }
        });
        // SAFETY: it is alive, see above.
        unsafe { (*work)() };
    }
}

/// Calls what it holds when it goes out of scope, also in a panic.
struct OnDrop<F: FnMut()>(F);

impl<F: FnMut()> Drop for OnDrop<F> {
    fn drop(&mut self) {
        (self.0)();
    }
}

/// Locks; what a panicking thread held is as good as ever. Its panic surfaces when the scope ends,
/// and before that nothing takes what it was to make for made.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_team_does_one_thing_after_the_other() {
        for threads in [Threads::All, Threads::AtMost(NonZeroUsize::MIN)] {
            let total = team(threads, |team| {
                let mut numbers: Vec<u64> = (0..40).collect();
                for _ in 0..2_000 {
                    numbers = team.map(numbers, |x| x + 1);
                }
                numbers
            });
            assert_eq!(total, (2_000..2_040).collect::<Vec<u64>>());
        }
    }

    #[test]
    fn results_are_joined_in_order() {
        for threads in [Threads::All, Threads::AtMost(NonZeroUsize::MIN)] {
            for count in [0_usize, 1, 2, 300] {
                let joined = team(threads, |team| {
                    let task = |i: usize| {
                        std::thread::sleep(std::time::Duration::from_micros((i as u64 * 37) % 90));
                        vec![i]
                    };
                    team.reduce((0..count).collect(), task, |mut all, next| {
                        all.extend(next);
                        all
                    })
                });
                let expected = (count > 0).then(|| (0..count).collect::<Vec<_>>());
                assert_eq!(joined, expected);
            }
        }
    }

    #[test]
    fn beside_a_team_one_works_alone() {
        let shares = |threads| {
            let ids = team(threads, |team| {
                team.map((0..64).collect(), |_: i32| std::thread::current().id())
            });
            ids.iter().all(|&id| id == std::thread::current().id())
        };
        team(Threads::All, |_| {
            std::thread::scope(|scope| {
                // It doesn't wait for the team around it, which ends after it.
                assert!(scope.spawn(|| shares(Threads::All)).join().unwrap());
            });
        });
        assert_eq!(
            team(Threads::All, |team| team.map(vec![1, 2, 3], |x| 2 * x)),
            [2, 4, 6]
        );
    }

    #[test]
    fn nothing_goes_on_without_what_a_helper_did_not_make() {
        for _ in 0..100 {
            let (panicked, went_on) = (AtomicBool::new(false), AtomicBool::new(false));
            let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                team(Threads::All, |team| {
                    let owner = std::thread::current().id();
                    team.map((0..200).collect(), |_: i32| {
                        if std::thread::current().id() != owner {
                            panicked.store(true, Ordering::SeqCst);
                            panic!("on a helper");
                        }
                        std::thread::sleep(std::time::Duration::from_millis(1));
                    });
                    went_on.store(true, Ordering::SeqCst);
                });
            }));
            let panicked = panicked.into_inner();
            assert_eq!(result.is_err(), panicked);
            assert_eq!(went_on.into_inner(), !panicked);
            if panicked {
                return;
            }
            // The helpers are another test's, or there is one core.
        }
        assert!(std::thread::available_parallelism().map_or(1, NonZeroUsize::get) == 1);
    }

    #[test]
    fn a_panic_in_a_team_surfaces() {
        let result = std::panic::catch_unwind(|| {
            team(Threads::All, |team| {
                team.map((0..100).collect(), |x: i32| assert!(x != 57, "57"));
            });
        });
        assert!(result.is_err());
        assert_eq!(
            team(Threads::All, |team| team.map(vec![1, 2, 3], |x| 2 * x)),
            [2, 4, 6]
        );
    }
}
