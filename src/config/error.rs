//! The one error of this module.

use crate::bounds::with_short_numbers;

/// Sort of mistake that a [`ConfigError`] reports; callers map it to their own exceptions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ConfigErrorKind {
    /// No robot, task or training config has this name.
    UnknownName,
    /// A key that nothing reads, mostly a typing error.
    UnknownKey,
    /// A value of the wrong type, out of range, missing, or at odds with another one.
    InvalidValue,
    /// The text is not TOML.
    Syntax,
    /// A file or folder cannot be read.
    Unreadable,
}

/// A mistake in a config: which file, which element of it, what is wrong and what to do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{file}: {element}: {problem}; {remedy}")]
pub struct ConfigError {
    /// Sort of mistake.
    pub kind: ConfigErrorKind,
    /// The file that holds the mistake, `--set` for an override.
    pub file: String,
    /// Dotted key such as `rewards.trot.gait.weight`, or a position such as `line 3, column 5`.
    pub element: String,
    /// Problem of the element.
    pub problem: String,
    /// Remedy.
    pub remedy: String,
}

impl ConfigError {
    /// An error about the value at `element` in `file`.
    pub fn invalid(
        file: impl Into<String>,
        element: impl Into<String>,
        problem: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Self {
            kind: ConfigErrorKind::InvalidValue,
            file: file.into(),
            element: element.into(),
            problem: with_short_numbers(problem.into()),
            remedy: remedy.into(),
        }
    }

    /// Error about a robot that is not part of a run, whose robots are `names`.
    pub fn unknown_robot_of_run(robot: &str, names: &[&str]) -> Self {
        let remedy = super::did_you_mean(robot, names.iter().copied(), "robots of this run");
        Self::invalid("robots", robot, format!("no robot `{robot}` takes part in this run"), remedy)
            .of_kind(ConfigErrorKind::UnknownName)
    }

    /// The same error as another kind.
    #[must_use]
    pub(crate) fn of_kind(mut self, kind: ConfigErrorKind) -> Self {
        self.kind = kind;
        self
    }

    /// The same error, blamed on `file`.
    #[must_use]
    pub(super) fn in_file(mut self, file: impl Into<String>) -> Self {
        self.file = file.into();
        self
    }
}
