//! Threads that share the work of one call, and stay awake for the next.
//!
//! A process that forks (a torch `DataLoader` starting its workers, say) hands its
//! child a copy of the pool's memory but none of its threads, and perhaps locks that
//! a thread held at that moment. So nothing of an inherited pool is touched: the pool
//! is found through one atomic pointer, carries the id of the process that made it,
//! and a process with another id makes its own and leaks the old one.

use std::cell::UnsafeCell;
use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::num::NonZeroUsize;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicPtr, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

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

/// How long helpers stay awake when there is nothing more to do: waking one takes up to 100 µs, and
/// a loop often comes to its next call within this time.
const LINGER: Duration = Duration::from_micros(500);

/// The helpers of one process: one thread fewer than it may run at once, since the
/// calling thread works too.
struct Helpers {
    process: u32,
    pool: Option<ThreadPool>,
    /// Of each helper, whether it is awake or about to be.
    awake: Vec<AtomicBool>,
    /// Whether a [`team`] has them, to whose end they are nobody else's.
    taken: AtomicBool,
    /// How many of them at most, from the first, are in that team.
    members: AtomicUsize,
    /// What there is to do while `open` is not 0.
    work: UnsafeCell<Option<*const (dyn Fn() + Sync)>>,
    /// Number of the work that members may begin; 0 for none.
    open: AtomicUsize,
    /// Members that may be at work.
    active: AtomicUsize,
    /// How much work has come before.
    count: AtomicUsize,
}

// SAFETY: `work` is changed only by the thread of the team that has the helpers, while nothing is
// open and nobody active, and read only by helpers that are active and have found it open.
unsafe impl Sync for Helpers {}

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
    let fresh = Box::into_raw(Box::new(Helpers::new(process, count)));
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

impl Helpers {
    fn new(process: u32, count: usize) -> Self {
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
        Self {
            process,
            pool,
            awake: (0..count).map(|_| AtomicBool::new(false)).collect(),
            taken: AtomicBool::new(false),
            members: AtomicUsize::new(0),
            work: UnsafeCell::new(None),
            open: AtomicUsize::new(0),
            active: AtomicUsize::new(0),
            count: AtomicUsize::new(0),
        }
    }

    /// Wakes the members that sleep, without waiting until they are awake.
    fn wake(&'static self) {
        let Some(pool) = &self.pool else { return };
        let members = self.members.load(Ordering::Relaxed);
        for (i, awake) in self.awake.iter().enumerate().take(members) {
            if !awake.load(Ordering::SeqCst) && !awake.swap(true, Ordering::SeqCst) {
                pool.spawn(move || self.help(i));
            }
        }
    }

    /// Does `work` on the calling thread and on the members that are awake before it ends, which
    /// share it out themselves. Only for the team that has the helpers.
    fn all(&self, work: &(dyn Fn() + Sync)) {
        // SAFETY: only the lifetime changes, and nobody uses it after `_closed` below, which is
        // dropped before `work` ends.
        let work: *const (dyn Fn() + Sync) =
            unsafe { std::mem::transmute::<&(dyn Fn() + Sync), &'static (dyn Fn() + Sync)>(work) };
        // SAFETY: nothing is open and nobody active, so no helper looks.
        unsafe { *self.work.get() = Some(work) };
        let number = self.count.fetch_add(1, Ordering::Relaxed) + 1;
        self.open.store(number, Ordering::SeqCst);
        let _closed = OnDrop(|| {
            self.open.store(0, Ordering::SeqCst);
            let mut pauses = 0;
            while self.active.load(Ordering::SeqCst) > 0 {
                pause(&mut pauses);
            }
        });
        // SAFETY: it is alive, see above.
        unsafe { (*work)() };
    }

    /// What the helper of this number does until it goes to sleep.
    fn help(&self, number: usize) {
        let member = || number < self.members.load(Ordering::SeqCst);
        let (mut last, mut pauses, mut since) = (0, 0, Instant::now());
        loop {
            let open = self.open.load(Ordering::SeqCst);
            if open == 0 || open == last || !member() {
                if pause(&mut pauses) {
                    if member() {
                        since = Instant::now();
                    } else if since.elapsed() > LINGER {
                        self.awake[number].store(false, Ordering::SeqCst);
                        // A team that began just now may have found this helper awake.
                        if !member() || self.awake[number].swap(true, Ordering::SeqCst) {
                            return;
                        }
                    }
                }
                continue;
            }
            last = open;
            self.active.fetch_add(1, Ordering::SeqCst);
            let _left = OnDrop(|| {
                self.active.fetch_sub(1, Ordering::Release);
            });
            // Open still, so the owner waits until this helper has left.
            if self.open.load(Ordering::SeqCst) == open {
                // SAFETY: the owner changes the work, and lets what it points to go, only after it
                // has closed it and no helper is active.
                if let Some(work) = unsafe { *self.work.get() } {
                    // A panic is the owner's to tell, who misses what this was to make.
                    // SAFETY: as above.
                    let _ = catch_unwind(AssertUnwindSafe(|| unsafe { (*work)() }));
                }
            }
            since = Instant::now();
        }
    }
}

/// Waits for a moment; every now and then, which it tells, others may have the core.
fn pause(pauses: &mut u32) -> bool {
    std::hint::spin_loop();
    *pauses = (*pauses + 1) % (1 << 10);
    let yields = *pauses == 0;
    if yields {
        std::thread::yield_now();
    }
    yields
}

/// Threads that stay awake from one [`Team::map`] to the next.
pub struct Team {
    /// Where they are, if it has any but the caller's.
    helpers: Option<&'static Helpers>,
    /// A team is its thread's.
    _neither_send_nor_sync: PhantomData<*const ()>,
}

/// What `body` returns, which may share its work with up to `threads` threads; it works alone where
/// another team has the helpers, since waiting for that would take longer. Helpers that slept join
/// when they are awake.
pub fn team<R>(threads: Threads, body: impl FnOnce(&Team) -> R) -> R {
    team_from(helpers, threads, body)
}

fn team_from<R>(
    helpers: impl FnOnce() -> &'static Helpers,
    threads: Threads,
    body: impl FnOnce(&Team) -> R,
) -> R {
    let wanted = match threads {
        Threads::All => usize::MAX,
        Threads::AtMost(limit) => limit.get(),
    };
    let helpers = (wanted > 1)
        .then(helpers)
        .filter(|helpers| helpers.pool.is_some())
        .filter(|helpers| !helpers.taken.swap(true, Ordering::Acquire));
    let Some(helpers) = helpers else {
        return body(&Team::alone());
    };
    let _given_back = OnDrop(|| {
        helpers.members.store(0, Ordering::SeqCst);
        helpers.taken.store(false, Ordering::Release);
    });
    helpers.members.store(wanted - 1, Ordering::SeqCst);
    helpers.wake();
    body(&Team {
        helpers: Some(helpers),
        ..Team::alone()
    })
}

impl Team {
    /// The calling thread.
    pub fn alone() -> Self {
        Self {
            helpers: None,
            _neither_send_nor_sync: PhantomData,
        }
    }

    /// `task` of every item, in the order of the items, computed by the whole team. It returns only
    /// after every task has, so that what these write may be taken as written; should one panic, so
    /// does this.
    pub fn map<I: Send, R: Send>(&self, items: Vec<I>, task: impl Fn(I) -> R + Sync) -> Vec<R> {
        let Some(helpers) = self.helpers.filter(|_| items.len() > 1) else {
            return items.into_iter().map(task).collect();
        };
        let next = AtomicUsize::new(0);
        let places: Vec<Mutex<(Option<I>, Option<R>)>> = items
            .into_iter()
            .map(|item| Mutex::new((Some(item), None)))
            .collect();
        helpers.all(&|| {
            while let Some(place) = places.get(next.fetch_add(1, Ordering::Relaxed)) {
                let item = lock(place).0.take();
                let result = task(item.expect("each is taken once"));
                lock(place).1 = Some(result);
            }
        });
        let results = places.into_iter().map(|place| {
            let (_, result) = place.into_inner().unwrap_or_else(PoisonError::into_inner);
            result.unwrap_or_else(|| panic!("a task panicked on another thread"))
        });
        results.collect()
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
}

/// Calls what it holds when it goes out of scope, also in a panic.
struct OnDrop<F: FnMut()>(F);

impl<F: FnMut()> Drop for OnDrop<F> {
    fn drop(&mut self) {
        (self.0)();
    }
}

/// Locks; what a panicking thread held is as good as ever, and what it was to make is missed.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

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
    fn teams_come_and_go() {
        // Helpers are awake still, fall asleep meanwhile, or are another team's.
        std::thread::scope(|scope| {
            for caller in 1..=3_u64 {
                scope.spawn(move || {
                    for round in 0..400 {
                        let members = NonZeroUsize::new(round as usize % 4);
                        let threads = members.map_or(Threads::All, Threads::AtMost);
                        let total: u64 = team(threads, |team| {
                            let squares = team.map((0..50).collect(), |x: u64| x * x + round);
                            team.reduce(squares, |x| x, |x, y| x + y).expect("some")
                        });
                        assert_eq!(total, 40_425 + 50 * round);
                        if round % 11 == 0 {
                            std::thread::sleep(LINGER * (caller as u32 - 1));
                        }
                    }
                });
            }
        });
    }

    #[test]
    fn no_more_threads_than_allowed_work_even_where_others_are_awake() {
        let helpers: &'static Helpers = Box::leak(Box::new(Helpers::new(std::process::id(), 3)));
        let workers = |threads| {
            team_from(
                || helpers,
                threads,
                |team| {
                    let ids = team.map((0..200).collect(), |_: i32| {
                        std::thread::sleep(Duration::from_micros(100));
                        std::thread::current().id()
                    });
                    ids.into_iter().collect::<HashSet<_>>().len()
                },
            )
        };
        for most in [4, 3, 2, 1] {
            let threads = Threads::AtMost(NonZeroUsize::new(most).expect("not zero"));
            let counts: Vec<usize> = (0..20).map(|_| workers(threads)).collect();
            assert_eq!(counts.into_iter().max(), Some(most));
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
