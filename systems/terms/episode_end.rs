//! The end of an episode, as curricula see it.

use super::compile::CompiledTask;
use crate::components::{BasePose, Command, CurriculumProgress, EnvOrigin, Episode, EpisodeSums};
use crate::terrain::TerrainLayout;

/// An episode that is over, and what its end may change.
pub struct EpisodeEnd<'a> {
    /// Length of the episode and the causes of its end.
    pub episode: &'a Episode,
    /// Pose of the robot then.
    pub pose: &'a BasePose,
    /// Command at the end.
    pub command: &'a Command,
    /// Sums of its rewards and errors.
    pub sums: &'a EpisodeSums,
    /// Morphology of the robot, as its place among those of the task.
    pub(in crate::systems) robot: usize,
    /// Compiled task of the batch.
    pub(in crate::systems) task: &'a CompiledTask,
    /// Progress of the env through the curriculum.
    pub progress: &'a mut CurriculumProgress,
    /// Length of a full episode, s.
    pub episode_length_s: f32,
    /// Time since the episode's reset, s.
    pub lived_s: f32,
    /// Time that the robot was given, s: all until the time-out where a termination of the task
    /// ended the episode, and `lived_s` where the time ran out or a caller ended it.
    pub given_s: f32,
    /// The tiles, if the ground is generated terrain.
    pub layout: Option<&'a TerrainLayout>,
    /// Origin of the next episode.
    pub origin: &'a mut EnvOrigin,
}
