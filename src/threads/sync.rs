//! Synchronisation primitives of [`thread_team`](crate::thread_team). `tests/loom` replaces them
//! with loom's, which try every order of steps.

pub(crate) use std::hint::spin_loop as pause;
pub(crate) use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
pub(crate) use std::sync::{Arc, LockResult, Mutex, PoisonError, RwLock};
pub(crate) use std::thread::yield_now;
pub(crate) use std::time::Instant;

use std::time::Duration;

use bevy_tasks::{TaskPool, TaskPoolBuilder};

/// How long an idle thread spins before it sleeps. Longer than the gap between two jobs, short
/// compared with a control step.
pub(crate) const SPIN_TIME: Duration = Duration::from_micros(200);
/// Number of times that a thread spins before it yields the core between two tries.
pub(crate) const SPINS: usize = 2000;

/// Threads that sleep until they are given a job.
pub(crate) struct Pool {
    pool: Option<TaskPool>,
    /// The process that its threads live in.
    process: u32,
}

impl Pool {
    /// A pool of `threads` threads.
    pub(crate) fn new(threads: usize) -> Self {
        let pool = TaskPoolBuilder::new().num_threads(threads).thread_name("polypod".to_string()).build();
        Self { pool: Some(pool), process: std::process::id() }
    }

    /// Calls `f` on one of the threads.
    pub(crate) fn spawn(&self, f: impl FnOnce() + Send + 'static) {
        if let Some(pool) = &self.pool {
            pool.spawn(async move { f() }).detach();
        }
    }
}

impl Drop for Pool {
    /// Ends the threads. A forked process has no threads of its parent: there is nothing to wait
    /// for.
    fn drop(&mut self) {
        if std::process::id() != self.process {
            std::mem::forget(self.pool.take());
        }
    }
}
