//! Statistics of finished episodes, per robot.

use std::collections::BTreeMap;

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

use super::terms::CompiledTask;
use super::view::RobotView;
use super::{ResetSet, Setup, SetupSet, for_both};
use crate::blocks::{Block, Blocks};
use crate::components::{CurriculumProgress, Env, EnvOrigin, Episode, EpisodeSums};
use crate::config::VELOCITY_COLUMNS;
use crate::morphology::Morphologies;
use crate::world::Ground;

/// Counts ended episodes.
#[derive(Default)]
pub struct LogsPlugin;

impl Plugin for LogsPlugin {
    fn build(&self, app: &mut App) {
        let make = |mut commands: Commands, task: Res<CompiledTask>| commands.insert_resource(Logs::new(&task));
        app.add_systems(Setup, make.in_set(SetupSet::Engine).ambiguous_with_all());
        for_both(app, || collect_episodes.in_set(ResetSet::Log));
    }
}

impl EpisodeSums {
    /// Adds the step's tracking errors.
    pub(super) fn add_errors(&mut self, robot: &RobotView) {
        let (c, v) = (robot.command, &robot.imu.linear_velocity);
        let length = |x: f32, y: f32| (x * x + y * y).sqrt();
        self.error_vel_xy += length(c[0] - v[0], c[1] - v[1]);
        self.error_vel_yaw += (c[2] - robot.imu.angular_velocity[2]).abs();
        self.command_xy += length(c[0], c[1]);
        self.command_yaw += c[2].abs();
        self.speed_xy += length(v[0], v[1]);
        self.steps += 1;
    }
}

/// Means over finished episodes of one robot. Velocity errors are time averages.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeStats {
    /// Number of episodes.
    pub episodes: u64,
    /// Number of episodes that ended in failure.
    pub falls: u64,
    /// Mean length, s.
    pub episode_length_s: f64,
    /// Error of the planar velocity, m/s.
    pub error_vel_xy: f64,
    /// Error of the yaw rate, rad/s.
    pub error_vel_yaw: f64,
    /// Error of planar velocity of a robot that stands still, m/s.
    pub command_xy: f64,
    /// Error of the yaw rate of a robot that does not turn, rad/s.
    pub command_yaw: f64,
    /// Reward per second.
    pub reward_per_s: f64,
    /// Distance of the base in an episode, m.
    pub distance: f64,
    /// Level of difficulty of the tile on which the episode was, if the ground is generated
    /// terrain.
    pub terrain_level: Option<f64>,
}

/// Largest count in a restored log: later counts do not overflow.
const MAX_LOGGED: u64 = u64::MAX / 2;

/// A sum of single-precision numbers in steps of 2^-64. It depends neither on the order of its
/// terms nor on who adds them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
struct ExactSum(i128);

impl ExactSum {
    const STEPS: f64 = (1u128 << 64) as f64;

    /// Adds a number; one that is not finite counts as 0.
    fn add(&mut self, x: f32) {
        self.0 = self.0.saturating_add((f64::from(x) * Self::STEPS) as i128);
    }

    fn append(&mut self, other: Self) {
        self.0 = self.0.saturating_add(other.0);
    }

    fn value(self) -> f64 {
        self.0 as f64 / Self::STEPS
    }
}

/// Sums over the finished episodes of one robot.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct RobotLog {
    episodes: u64,
    falls: u64,
    steps: u64,
    reward: ExactSum,
    error_vel_xy: ExactSum,
    error_vel_yaw: ExactSum,
    command_xy: ExactSum,
    command_yaw: ExactSum,
    speed_xy: ExactSum,
    /// Control steps of the simulation at the last episode's end.
    age: u64,
    /// Sum of the widening of the commands' ranges.
    widening: ExactSum,
    /// Sum of the terrain levels, of those episodes that had one.
    levels: Option<f64>,
    /// Episode sums of each reward term.
    terms: Vec<ExactSum>,
    /// Episodes ended by each cause.
    causes: Vec<u64>,
}

impl RobotLog {
    fn new(terms: usize, causes: usize) -> Self {
        Self { terms: vec![ExactSum::default(); terms], causes: vec![0; causes], ..Self::default() }
    }

    fn add(&mut self, episode: &Episode, sums: &EpisodeSums, progress: &CurriculumProgress, level: Option<u32>) {
        self.episodes += 1;
        self.age = self.age.max(progress.steps);
        self.widening.add(progress.widening);
        self.falls += u64::from(episode.terminated);
        self.steps += u64::from(sums.steps);
        self.reward.add(sums.reward);
        self.error_vel_xy.add(sums.error_vel_xy);
        self.error_vel_yaw.add(sums.error_vel_yaw);
        self.command_xy.add(sums.command_xy);
        self.command_yaw.add(sums.command_yaw);
        self.speed_xy.add(sums.speed_xy);
        if let Some(level) = level {
            self.levels = Some(self.levels.unwrap_or_default() + f64::from(level));
        }
        for (sum, &term) in self.terms.iter_mut().zip(&sums.terms) {
            sum.add(term);
        }
        for (bit, count) in self.causes.iter_mut().enumerate() {
            *count += u64::from(episode.causes >> bit & 1);
        }
    }

    /// Adds another's episodes.
    fn append(&mut self, other: &Self) {
        self.episodes = self.episodes.saturating_add(other.episodes);
        self.falls = self.falls.saturating_add(other.falls);
        self.steps = self.steps.saturating_add(other.steps);
        self.reward.append(other.reward);
        self.error_vel_xy.append(other.error_vel_xy);
        self.error_vel_yaw.append(other.error_vel_yaw);
        self.command_xy.append(other.command_xy);
        self.command_yaw.append(other.command_yaw);
        self.speed_xy.append(other.speed_xy);
        self.age = self.age.max(other.age);
        self.widening.append(other.widening);
        if let Some(levels) = other.levels {
            self.levels = Some(self.levels.unwrap_or_default() + levels);
        }
        self.terms.iter_mut().zip(&other.terms).for_each(|(sum, term)| sum.append(*term));
        self.causes.iter_mut().zip(&other.causes).for_each(|(sum, count)| *sum = sum.saturating_add(*count));
    }

    /// Whether the log of a snapshot has the entries of `present` and counts within bounds.
    fn fits(&self, present: &Self) -> bool {
        let counts = [self.episodes, self.falls, self.steps, self.age].into_iter().chain(self.causes.iter().copied());
        self.terms.len() == present.terms.len()
            && self.causes.len() == present.causes.len()
            && counts.max() <= Some(MAX_LOGGED)
    }

    /// Means over the episodes that were counted; `step_dt` is a control step, s.
    pub fn stats(&self, step_dt: f64) -> EpisodeStats {
        let steps = self.steps.max(1) as f64;
        EpisodeStats {
            episodes: self.episodes,
            falls: self.falls,
            episode_length_s: self.steps as f64 * step_dt / self.episodes.max(1) as f64,
            error_vel_xy: self.error_vel_xy.value() / steps,
            error_vel_yaw: self.error_vel_yaw.value() / steps,
            command_xy: self.command_xy.value() / steps,
            command_yaw: self.command_yaw.value() / steps,
            reward_per_s: self.reward.value() / (steps * step_dt),
            distance: self.speed_xy.value() * step_dt / self.episodes.max(1) as f64,
            terrain_level: self.levels.map(|sum| sum / self.episodes.max(1) as f64),
        }
    }
}

/// Finished episodes of each morphology, twice: since the log was last taken, and since the
/// statistics were cleared.
#[derive(Resource, Clone, Debug, Default, Serialize, Deserialize)]
pub struct Logs {
    recent: Vec<RobotLog>,
    all: Vec<RobotLog>,
}

impl Logs {
    /// Whether the logs may replace `present`: they have the same number of robots, terms and
    /// causes.
    pub(crate) fn fits(&self, present: &Self) -> bool {
        let same = |ours: &[RobotLog], theirs: &[RobotLog]| {
            ours.len() == theirs.len() && ours.iter().zip(theirs).all(|(a, b)| a.fits(b))
        };
        same(&self.recent, &present.recent) && same(&self.all, &present.all)
    }

    /// Adds the episodes of others that [fit](Self::fits).
    pub(crate) fn append(&mut self, other: &Self) {
        self.recent.iter_mut().zip(&other.recent).for_each(|(log, other)| log.append(other));
        self.all.iter_mut().zip(&other.all).for_each(|(log, other)| log.append(other));
    }

    /// Counts an episode of a robot at a place among the morphologies, and its level on ground with
    /// tiles.
    pub(super) fn add(
        &mut self,
        morphology: usize,
        episode: &Episode,
        sums: &EpisodeSums,
        progress: &CurriculumProgress,
        level: Option<u32>,
    ) {
        for logs in [&mut self.recent, &mut self.all] {
            logs[morphology].add(episode, sums, progress, level);
        }
    }

    /// Empty, for a task and its robots.
    pub fn new(task: &CompiledTask) -> Self {
        Self { recent: Self::empty(task), all: Self::empty(task) }
    }

    fn empty(task: &CompiledTask) -> Vec<RobotLog> {
        let causes = task.cause_names().count();
        task.rewards.iter().map(|terms| RobotLog::new(terms.len(), causes)).collect()
    }

    /// Log entries over the episodes that ended since the last call; empty without episodes.
    ///
    /// Reward terms are episode sums divided by the full episode's length in seconds, as in Isaac
    /// Lab.
    pub fn take(&mut self, task: &CompiledTask, morphologies: &Morphologies) -> BTreeMap<String, f64> {
        let logs = std::mem::replace(&mut self.recent, Self::empty(task));
        let step_dt = f64::from(task.step_dt);
        let full = f64::from(task.max_episode_length) * step_dt;
        let mut out = BTreeMap::new();
        for (index, ((log, terms), morphology)) in logs.iter().zip(&task.rewards).zip(&morphologies.0).enumerate() {
            if log.episodes == 0 {
                continue;
            }
            let robot = morphology.name();
            let episodes = log.episodes as f64;
            for (term, sum) in terms.iter().zip(&log.terms) {
                out.insert(format!("Episode_Reward/{robot}/{}", term.name), sum.value() / episodes / full);
            }
            for (name, count) in task.cause_names().zip(&log.causes) {
                out.insert(format!("Episode_Termination/{robot}/{name}"), *count as f64);
            }
            let stats = log.stats(step_dt);
            out.insert(format!("Metrics/{robot}/error_vel_xy"), stats.error_vel_xy);
            out.insert(format!("Metrics/{robot}/error_vel_yaw"), stats.error_vel_yaw);
            out.insert(format!("Metrics/{robot}/fall_rate"), stats.falls as f64 / episodes);
            out.insert(format!("Metrics/{robot}/episode_length_s"), stats.episode_length_s);
            out.insert(format!("Metrics/{robot}/reward_per_s"), stats.reward_per_s);
            out.insert(format!("Metrics/{robot}/distance"), stats.distance);
            for (key, entry) in task.schedules.entries() {
                if let Some(term) = terms.iter().find(|term| term.name == entry) {
                    out.insert(format!("Curriculum/{robot}/{key}"), f64::from(term.weight_at(log.age)));
                }
            }
            let ranges = &task.velocity_ranges[index];
            if ranges.are_scheduled() {
                let widening = (log.widening.value() / episodes) as f32;
                let mean = ranges.at(&CurriculumProgress { steps: log.age, widening, tracking: 0.0 });
                for (key, [low, high]) in VELOCITY_COLUMNS.iter().zip(mean) {
                    out.insert(format!("Curriculum/{robot}/{key}_min"), f64::from(low));
                    out.insert(format!("Curriculum/{robot}/{key}_max"), f64::from(high));
                }
            }
            if let Some(level) = stats.terrain_level {
                out.insert(format!("Curriculum/{robot}/terrain_levels"), level);
            }
        }
        out
    }

    /// Statistics of each robot over the episodes that ended since they were last cleared.
    pub fn stats(
        &mut self,
        task: &CompiledTask,
        morphologies: &Morphologies,
        clear: bool,
    ) -> Vec<(String, EpisodeStats)> {
        let names = morphologies.0.iter().map(|m| m.name().to_string());
        let stats = names.zip(self.all.iter().map(|log| log.stats(f64::from(task.step_dt)))).collect();
        if clear {
            self.all = Self::empty(task);
        }
        stats
    }
}

/// Counts the episodes that have just ended.
pub(super) fn collect_episodes(
    mut envs: Blocks<
        (&'static mut Episode, &'static EpisodeSums, &'static CurriculumProgress, &'static EnvOrigin),
        Env,
    >,
    ground: Res<Ground>,
    mut logs: ResMut<Logs>,
) -> Result {
    let Logs { recent, all } = &mut *logs;
    for Block { morphology, rows: (episodes, sums, progress, origins), .. } in envs.write()? {
        let morphology = usize::from(morphology.0);
        let (recent, all) = (&mut recent[morphology], &mut all[morphology]);
        for (i, episode) in episodes.iter_mut().enumerate() {
            if episode.done() && !episode.logged {
                episode.logged = true;
                let level = ground.layout.as_ref().map(|_| origins[i].terrain_level);
                recent.add(episode, &sums[i], &progress[i], level);
                all.add(episode, &sums[i], &progress[i], level);
            }
        }
    }
    Ok(())
}
