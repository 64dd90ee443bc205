//! Terms: the named pieces of which a task's rewards, observations, terminations and events are
//! made.
//!
//! A term is one function and one line in a registry; its parameters come from the task's TOML and
//! are checked when the task is compiled for the robots of a run. A term that no robot of the run
//! uses is never made.

mod builtin;
mod compile;
mod device;
mod episode_end;
mod registry;
mod schedules;
mod spec;

pub(crate) use compile::{ACTION_DELAY, PHYSICS_MATERIAL};
pub(super) use compile::{ActionDelay, BODY_VARIATION, PhysicsMaterial};
pub use compile::{CompiledTask, ObservationGroup, ObservationTerm, RewardTerm, TerminationTerm};
pub use episode_end::EpisodeEnd;
pub(super) use registry::FormLists;
pub(crate) use registry::NoParams;
pub use registry::Registry;
pub(super) use schedules::VelocityRanges;
pub use spec::{Block, JointMirror, Per, TermKind, TermSource, TermSpec};
