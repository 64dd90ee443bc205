//! Commands as their kinds and terms see them.

use std::ops::Range;

use serde::Serialize;

use crate::components::{BasePose, EnvRng};
use crate::morphology::MorphologyModel;

/// Description of a kind of command.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct CommandSpec {
    /// Names of its numbers.
    pub columns: &'static [&'static str],
    /// Meaning, with units and frames.
    pub description: &'static str,
}

/// Robot and env for which a command is drawn.
#[derive(Clone, Copy)]
pub struct CommandedRobot<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Pose of its base; x and y relative to the env's origin.
    pub pose: &'a BasePose,
}

/// A kind of command with the parameters of a task, for a morphology.
pub trait CommandKind: Send + Sync + 'static {
    /// Writes new numbers, at resets and after each resampling time.
    fn draw(&self, robot: &CommandedRobot, numbers: &mut [f32], rng: &mut EnvRng);

    /// Changes the numbers in a control step of this length, s.
    fn advance(&self, _numbers: &mut [f32], _step_dt: f32) {}
}

/// A command of a task other than the velocity.
pub struct CommandTerm {
    /// Name of the command in the task's config.
    pub name: String,
    /// Names of its numbers.
    pub columns: &'static [&'static str],
    /// Numbers of the term among those of all commands.
    pub range: Range<usize>,
    /// Time between two draws, s; absent where a reset alone draws it.
    pub(super) resampling_time_s: Option<f32>,
    /// The command of each morphology.
    pub(super) of_morphologies: Vec<Box<dyn CommandKind>>,
}

/// The commands of a robot other than the velocity, as terms read them.
#[derive(Clone, Copy, Default)]
pub struct CommandView<'a> {
    pub(super) terms: &'a [CommandTerm],
    pub(super) numbers: &'a [f32],
}

impl<'a> CommandView<'a> {
    /// The numbers of a command; empty where the task lacks it.
    #[inline(always)]
    pub fn of(&self, name: &str) -> &'a [f32] {
        let term = self.terms.iter().find(|term| term.name == name);
        term.and_then(|term| self.numbers.get(term.range.clone())).unwrap_or_default()
    }

    /// The first numbers of a command; zeros where the task lacks it.
    #[inline(always)]
    pub fn first<const N: usize>(&self, name: &str) -> [f32; N] {
        self.of(name).first_chunk().copied().unwrap_or([0.0; N])
    }
}

impl CommandTerm {
    /// Draws its numbers among those of all commands.
    pub(super) fn draw(&self, morphology: usize, robot: &CommandedRobot, numbers: &mut [f32], rng: &mut EnvRng) {
        self.of_morphologies[morphology].draw(robot, &mut numbers[self.range.clone()], rng);
    }
}
