//! Threads of a Bevy task pool that stay awake from one job to the next.
//!
//! A control step is a dozen jobs, each over in less time than a sleeping thread takes to wake. So
//! the pool's threads are woken once: they help with jobs for as long as these follow each other
//! closely, and go back to sleep after that.
//!
//! `tests/loom` runs this file under every order of its threads' steps: all that threads share is
//! named in [`sync`](crate::sync).
//!
//! Besides [`lanes`](crate::dynamics::lanes) the only file of the crate with `unsafe` code: a job
//! borrows from its caller, which the threads cannot know.

#![allow(unsafe_code)]

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

use crate::sync::{
    Arc, AtomicBool, AtomicUsize, Instant, LockResult, Mutex, Ordering, PoisonError, Pool, RwLock, SPIN_TIME, SPINS,
    pause, yield_now,
};

/// Number of tasks that memory is asked for at once. The tasks of a job are written one after the
/// other, and are moved whenever the memory for them grows.
const MOST_ROOM: usize = 64;

/// The caller's thread and helpers, which work on one job at a time.
pub(crate) struct ThreadTeam {
    pool: Pool,
    shared: Arc<Shared>,
    /// Whether a job is being worked on.
    busy: AtomicBool,
}

type Job<'a> = dyn Fn() + Sync + 'a;

/// Pads to a cache line, or two where processors fetch pairs, and so avoids false sharing.
#[derive(Default)]
#[repr(align(128))]
struct CachePadded<T>(T);

struct Shared {
    /// Number of jobs so far.
    jobs: CachePadded<AtomicUsize>,
    /// Number of helpers that the current job uses.
    wanted: AtomicUsize,
    /// The current job.
    job: CachePadded<RwLock<Option<&'static Job<'static>>>>,
    /// Number of helpers that read the job or work on it.
    inside: CachePadded<AtomicUsize>,
    /// Whether each helper is awake or waking up.
    awake: CachePadded<Vec<AtomicBool>>,
    /// Payload of a helper's panic.
    panic: Mutex<Option<Box<dyn Any + Send>>>,
}

/// Content of a lock, even if a thread panicked with it: panics are passed on, and nothing is left
/// half done.
fn open<T>(lock: LockResult<T>) -> T {
    lock.unwrap_or_else(PoisonError::into_inner)
}

/// Waits: spins first, then yields.
struct Wait {
    spins: usize,
}

impl Wait {
    fn new() -> Self {
        Self { spins: 0 }
    }

    fn pause(&mut self) {
        if self.spins < SPINS {
            self.spins += 1;
            pause();
        } else {
            yield_now();
        }
    }

    fn is_long(&self) -> bool {
        self.spins == SPINS
    }
}

impl ThreadTeam {
    /// A team of the caller's thread and `helpers` helpers.
    pub(crate) fn new(helpers: usize) -> Self {
        let pool = Pool::new(helpers);
        let shared = Shared {
            jobs: CachePadded::default(),
            wanted: AtomicUsize::new(0),
            job: CachePadded::default(),
            inside: CachePadded::default(),
            awake: CachePadded((0..helpers).map(|_| AtomicBool::new(false)).collect()),
            panic: Mutex::default(),
        };
        Self { pool, shared: Arc::new(shared), busy: AtomicBool::new(false) }
    }

    /// Runs `f(task)` on every task, on at most `threads` threads. Threads take one task after the
    /// other.
    pub(crate) fn for_each<T: Send>(&self, tasks: impl Iterator<Item = T>, threads: usize, f: impl Fn(T) + Sync) {
        let room = tasks.size_hint().1.unwrap_or_default().min(MOST_ROOM);
        let mut queue: Vec<Mutex<Option<T>>> = Vec::with_capacity(room);
        queue.extend(tasks.map(|task| Mutex::new(Some(task))));
        let tasks = queue;
        let next = CachePadded(AtomicUsize::new(0));
        let job = || {
            while let Some(task) = tasks.get(next.0.fetch_add(1, Ordering::Relaxed)) {
                let task = open(task.lock()).take();
                task.into_iter().for_each(&f);
            }
        };
        self.run(tasks.len().min(threads).saturating_sub(1), &job);
    }

    /// Calls `job` on the caller's thread and on up to `helpers` others; returns when all have
    /// returned.
    ///
    /// A nested job runs on the caller's thread alone.
    fn run(&self, helpers: usize, job: &Job) {
        if helpers == 0 || self.busy.swap(true, Ordering::Acquire) {
            return job();
        }
        let shared = &self.shared;
        // SAFETY: the reference leaves `shared.job` below, whether or not a thread panics. A helper
        // that has read it has counted itself in `inside` before that, and is waited for.
        let job_for_helpers = unsafe { std::mem::transmute::<&Job<'_>, &'static Job<'static>>(job) };
        *open(shared.job.0.write()) = Some(job_for_helpers);
        shared.wanted.store(helpers, Ordering::Relaxed);
        shared.jobs.0.fetch_add(1, Ordering::Release);
        for (helper, awake) in shared.awake.0.iter().enumerate().take(helpers) {
            if !awake.load(Ordering::Relaxed) {
                awake.store(true, Ordering::Relaxed);
                let shared = shared.clone();
                self.pool.spawn(move || shared.help(helper));
            }
        }
        let mine = catch_unwind(AssertUnwindSafe(job));
        *open(shared.job.0.write()) = None;
        let mut wait = Wait::new();
        while shared.inside.0.load(Ordering::Acquire) > 0 {
            wait.pause();
        }
        let theirs = open(shared.panic.lock()).take();
        self.busy.store(false, Ordering::Release);
        if let Some(panic) = mine.err().or(theirs) {
            resume_unwind(panic);
        }
    }
}

impl Shared {
    /// Works on every job that has work for this helper, until none has come for a while.
    fn help(&self, helper: usize) {
        let mut seen = 0;
        let (mut wait, mut last) = (Wait::new(), None);
        loop {
            let jobs = self.jobs.0.load(Ordering::Acquire);
            if jobs != seen {
                seen = jobs;
                if helper < self.wanted.load(Ordering::Relaxed) {
                    self.work();
                }
                (wait, last) = (Wait::new(), None);
            } else if wait.is_long() && last.get_or_insert_with(Instant::now).elapsed() > SPIN_TIME {
                break;
            } else {
                wait.pause();
            }
        }
        self.awake.0[helper].store(false, Ordering::Relaxed);
    }

    /// Works on the present job, if there still is one.
    fn work(&self) {
        self.inside.0.fetch_add(1, Ordering::AcqRel);
        let job = *open(self.job.0.read());
        if let Some(job) = job
            && let Err(panic) = catch_unwind(AssertUnwindSafe(job))
        {
            *open(self.panic.lock()) = Some(panic);
        }
        self.inside.0.fetch_sub(1, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_task_is_done_once_before_the_job_ends() {
        let team = ThreadTeam::new(3);
        let mut counts = vec![0u32; 1000];
        for round in 0..2000 {
            let n = 1 + round % 40;
            team.for_each(counts[..n].iter_mut(), 1 + round % 7, |x| *x += 1);
            if round % 500 == 0 {
                // long enough for the helpers to fall asleep
                std::thread::sleep(2 * SPIN_TIME);
            }
        }
        let expected: Vec<u32> = (0..1000).map(|i| if i < 40 { 50 * (40 - i) } else { 0 }).collect();
        assert_eq!(counts, expected);
    }

    #[test]
    fn a_job_within_a_job_is_done() {
        let (team, sum) = (ThreadTeam::new(2), AtomicUsize::new(0));
        team.for_each(0..10, 3, |i| team.for_each(0..i, 3, |_| _ = sum.fetch_add(1, Ordering::Relaxed)));
        assert_eq!(sum.into_inner(), 45);
    }

    #[test]
    fn a_panic_reaches_the_caller_after_all_have_returned() {
        let team = ThreadTeam::new(2);
        for bad in [0, 7, 99] {
            let done = AtomicUsize::new(0);
            let result = catch_unwind(AssertUnwindSafe(|| {
                team.for_each(0..100, 3, |i| {
                    assert_ne!(i, bad, "as it should");
                    done.fetch_add(1, Ordering::Relaxed);
                });
            }));
            assert!(result.is_err());
            assert!(done.into_inner() <= 99);
        }
        // and the team still works
        let sum = AtomicUsize::new(0);
        team.for_each(1..=100, 3, |i| _ = sum.fetch_add(i, Ordering::Relaxed));
        assert_eq!(sum.into_inner(), 5050);
    }
}
