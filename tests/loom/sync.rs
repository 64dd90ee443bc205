//! Loom's counterpart of `src/threads/sync.rs`.

pub(crate) use loom::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
pub(crate) use loom::sync::{Arc, Mutex, RwLock};
pub(crate) use loom::thread::yield_now;
pub(crate) use std::sync::{LockResult, PoisonError};

use std::time::Duration;

/// Time does not pass: a helper that finds nothing to do goes to sleep at once.
pub(crate) struct Instant;

impl Instant {
    pub(crate) fn now() -> Self {
        Self
    }

    pub(crate) fn elapsed(&self) -> Duration {
        Duration::from_secs(1)
    }
}

pub(crate) const SPIN_TIME: Duration = Duration::ZERO;
/// Every look lets the others go on.
pub(crate) const SPINS: usize = 0;

pub(crate) fn pause() {
    yield_now();
}

/// A new thread for each thing to do.
pub(crate) struct Pool;

impl Pool {
    pub(crate) fn new(_threads: usize) -> Self {
        Self
    }

    pub(crate) fn spawn(&self, f: impl FnOnce() + Send + 'static) {
        drop(loom::thread::spawn(f));
    }
}
