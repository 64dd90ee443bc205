//! The library's error.

use std::path::PathBuf;

use crate::bounds::with_short_numbers;
use crate::config::ConfigError;
use crate::dynamics::lanes::SimdError;
use crate::robot::RobotError;

/// Failure to make, read, write or step something. The message names the place and a remedy.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A config, or the name of one.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A URDF.
    #[error(transparent)]
    Robot(#[from] RobotError),
    /// An instruction set that is unknown or that the machine lacks.
    #[error(transparent)]
    Simd(#[from] SimdError),
    /// A scene that robots cannot stand in.
    #[error("{0}")]
    Scene(String),
    /// An argument.
    #[error("{element}: {problem}; {remedy}")]
    Argument {
        /// Name of the argument.
        element: &'static str,
        /// Problem with the argument.
        problem: String,
        /// Remedy.
        remedy: String,
    },
    /// A snapshot.
    #[error("snapshot: {0}")]
    Snapshot(String),
    /// A file, such as the dump of a broken state.
    #[error("{}: {problem}; {remedy}", file.display())]
    File {
        /// Path of the file.
        file: PathBuf,
        /// Problem with the file.
        problem: String,
        /// Remedy.
        remedy: String,
    },
    /// Entities of one kind that break their blocks: one per env, in the order of the env ids, with
    /// the same components.
    #[error("rows of the {kind}s: {problem}; {remedy}")]
    Rows {
        /// Kind of the entities: robot, env or a sensor.
        kind: &'static str,
        /// Problem with the rows; names the entity.
        problem: String,
        /// Remedy.
        remedy: String,
    },
    /// A system of the pipeline, maybe a user's.
    #[error("system `{system}`: {problem}")]
    System {
        /// Name of the system.
        system: String,
        /// Message of the system's error.
        problem: String,
    },
}

impl Error {
    /// An error about an argument.
    pub(crate) fn argument(element: &'static str, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Argument { element, problem: with_short_numbers(problem.into()), remedy: remedy.into() }
    }

    /// An error about a file.
    pub(crate) fn file(file: impl Into<PathBuf>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::File { file: file.into(), problem: problem.into(), remedy: remedy.into() }
    }
}
