//! Threads that share out rows of work.

pub(crate) mod sync;
pub(crate) mod thread_team;
pub mod workers;
