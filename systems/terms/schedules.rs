//! Curricula of commands and of reward weights.
//!
//! | term | source | what it changes |
//! |---|---|---|
//! | `command_curriculum` | legged_gym (BSD-3-Clause) | widens an env's velocity ranges while it tracks well |
//! | `commands_vel` | mjlab (Apache-2.0) | velocity ranges from a control step on |
//! | `modify_reward_weight` | Isaac Lab (BSD-3-Clause) | a reward term's weight from a control step on |
//!
//! legged_gym widens the ranges of all envs by the mean over those that are reset together. Here
//! each env has separate ranges, widened by the running mean over its own episodes. They depend
//! neither on other envs nor on how the envs are spread over processes.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::compile::RewardTerm;
use super::episode_end::EpisodeEnd;
use super::registry::Registry;
use crate::bounds::MAX_COMMAND;
use crate::components::{CurriculumProgress, EnvRng};
use crate::config::quantities::{SpeedThreshold, Steps, Weight};
use crate::config::{
    ConfigError, ConfigErrorKind, TaskConfig, VelocityCommandConfig, did_you_mean, parse_params, values,
};
use crate::engine::device::FormKind;
use crate::morphology::{Morphologies, MorphologyModel};

/// Names of the terms.
const COMMAND_CURRICULUM: &str = "command_curriculum";
const COMMANDS_VEL: &str = "commands_vel";
const MODIFY_REWARD_WEIGHT: &str = "modify_reward_weight";

/// Share by which an episode moves the running mean of the tracking reward: of five episodes or so.
const NEWEST: f32 = 0.2;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CommandCurriculum {
    /// Entries of reward sets that pay for tracking; the first one that a robot's set has counts.
    reward_terms: Vec<String>,
    /// Share of the most that an episode can pay, from which the ranges are widened. Default: 0.8,
    /// legged_gym's.
    #[serde(default = "most_of_it", deserialize_with = "values::fraction")]
    threshold: f64,
    /// Amount by which both ends of a range move after an episode, m/s or rad/s. Default: 0.1.
    #[serde(default = "tenth", deserialize_with = "values::number_of::<SpeedThreshold, _, _>")]
    step: f32,
    /// Widest forward speeds, m/s. Default: the range is not widened.
    #[serde(default, deserialize_with = "values::optional_command_range")]
    lin_vel_x: Option<[f64; 2]>,
    /// Widest speeds to the left, m/s. Default: the range is not widened.
    #[serde(default, deserialize_with = "values::optional_command_range")]
    lin_vel_y: Option<[f64; 2]>,
    /// Widest yaw rates, rad/s. Default: the range is not widened.
    #[serde(default, deserialize_with = "values::optional_command_range")]
    ang_vel_z: Option<[f64; 2]>,
}

fn most_of_it() -> f64 {
    0.8
}

fn tenth() -> f32 {
    0.1
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CommandsVel {
    /// Ranges of the velocity command, in the order of their steps.
    velocity_stages: Vec<VelocityStage>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct VelocityStage {
    /// Control step of the simulation from which the ranges hold.
    #[serde(deserialize_with = "values::number_of::<Steps, _, _>")]
    step: f64,
    /// Forward speed, m/s. Default: as before.
    #[serde(default, deserialize_with = "values::optional_command_range")]
    lin_vel_x: Option<[f64; 2]>,
    /// Speed to the left, m/s. Default: as before.
    #[serde(default, deserialize_with = "values::optional_command_range")]
    lin_vel_y: Option<[f64; 2]>,
    /// Yaw rate, rad/s. Default: as before.
    #[serde(default, deserialize_with = "values::optional_command_range")]
    ang_vel_z: Option<[f64; 2]>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ModifyRewardWeight {
    /// Entry of the reward sets; sets without it stay as they are.
    term_name: String,
    /// Weight that it has then.
    #[serde(deserialize_with = "values::number_of::<Weight, _, _>")]
    weight: f32,
    /// Control step of the simulation from which it has that weight.
    #[serde(deserialize_with = "values::number_of::<Steps, _, _>")]
    num_steps: f64,
}

/// All terms of this file. Weights and ranges that depend on the step alone are read where they
/// act, and change nothing at an episode's end.
pub(super) fn register(registry: &mut Registry) {
    registry.curriculum(COMMAND_CURRICULUM, widen_commands);
    // Ranges of the velocity command that hold from control steps of the simulation on.
    registry.curriculum(COMMANDS_VEL, |_: &CommandsVel, _, _| {});
    // Weight of a reward from a control step of the simulation on.
    registry.curriculum(MODIFY_REWARD_WEIGHT, |_: &ModifyRewardWeight, _, _| {});
    registry.on_device(FormKind::Curriculum, COMMAND_CURRICULUM, |p: CommandCurriculum, _| {
        Some((vec![p.threshold as f32, p.step, MAX_COMMAND as f32], Some(Vec::new())))
    });
    registry.on_device(FormKind::Curriculum, COMMANDS_VEL, |_: CommandsVel, _| Some((Vec::new(), Some(Vec::new()))));
    registry.on_device(FormKind::Curriculum, MODIFY_REWARD_WEIGHT, |_: ModifyRewardWeight, _| {
        Some((Vec::new(), Some(Vec::new())))
    });
}

/// Moves the running mean of an env's tracking reward, and widens its ranges where that is high.
fn widen_commands(p: &CommandCurriculum, end: &mut EpisodeEnd, _: &mut EnvRng) {
    let progress = &mut *end.progress;
    let terms = &end.task.rewards[end.robot];
    let Some(at) = tracking_term(&p.reward_terms, terms) else {
        return;
    };
    let (term, sum) = (&terms[at], end.sums.terms[at]);
    let most = term.weight_at(progress.steps) * end.episode_length_s;
    if most <= 0.0 {
        return;
    }
    progress.tracking += NEWEST * (sum / most - progress.tracking);
    if progress.tracking > p.threshold as f32 {
        progress.widening = (progress.widening + p.step).min(MAX_COMMAND as f32);
    }
}

/// Place of the term that pays a robot for tracking.
fn tracking_term(names: &[String], terms: &[RewardTerm]) -> Option<usize> {
    names.iter().find_map(|name| terms.iter().position(|term| term.name == *name))
}

/// Ranges of the velocity command of a morphology: forward and left velocity, m/s, and yaw rate,
/// rad/s.
pub(in crate::systems) struct VelocityRanges {
    base: [[f32; 2]; 3],
    /// Ranges from a control step on, in the order of the steps.
    stages: Vec<(u64, [[f32; 2]; 3])>,
    /// Ranges beyond which none is widened; absent for those that are not widened.
    widest: [Option<[f32; 2]>; 3],
}

impl VelocityRanges {
    /// The ranges of an env.
    #[inline(always)]
    pub(in crate::systems) fn at(&self, progress: &CurriculumProgress) -> [[f32; 2]; 3] {
        let stage = self.stages.iter().rfind(|(step, _)| *step <= progress.steps);
        let mut ranges = stage.map_or(self.base, |(_, ranges)| *ranges);
        for ([low, high], widest) in ranges.iter_mut().zip(&self.widest) {
            if let Some([least, most]) = widest {
                *low = (*low - progress.widening).max(*least).min(*low);
                *high = (*high + progress.widening).min(*most).max(*high);
            }
        }
        ranges
    }

    /// The ranges from later control steps on, in the order of the steps.
    pub(super) fn stages(&self) -> &[(u64, [[f32; 2]; 3])] {
        &self.stages
    }

    /// Ranges beyond which none is widened; absent for those that are not widened.
    pub(super) fn widest(&self) -> [Option<[f32; 2]>; 3] {
        self.widest
    }

    /// The ranges in front of any change.
    pub(in crate::systems) fn base(&self) -> [[f32; 2]; 3] {
        self.base
    }

    /// Replaces the ranges in front of any change. Returns whether it could: stages replace them.
    pub(super) fn set_base(&mut self, base: [[f32; 2]; 3]) -> bool {
        let can = self.stages.is_empty();
        if can {
            self.base = base;
        }
        can
    }

    /// Whether the ranges change.
    pub(in crate::systems) fn are_scheduled(&self) -> bool {
        !self.stages.is_empty() || self.widest.iter().any(Option::is_some)
    }
}

/// A task's curricula of commands and weights.
#[derive(Default)]
pub(in crate::systems) struct Schedules {
    /// Weights by the entry's name: control step and weight, in the order of the steps.
    weights: BTreeMap<String, Vec<(u64, f32)>>,
    stages: Option<(String, CommandsVel)>,
    widening: Option<(String, CommandCurriculum)>,
    /// Reward entry of each curriculum entry that changes a weight.
    entries: Vec<(String, String)>,
}

impl Schedules {
    /// Reads the terms of this file that the task switches on.
    ///
    /// # Errors
    /// Wrong parameters; a reward entry that no set of the task has; ranges of a velocity command
    /// that the task does not give; one of the terms on commands twice.
    pub(in crate::systems) fn new(config: &TaskConfig) -> Result<Self, ConfigError> {
        let file = config.name.as_str();
        let mut schedules = Self::default();
        for (key, term) in config.curriculum.iter().filter(|(_, term)| term.enabled) {
            let element = format!("curriculum.{key}");
            let kind = term.term.as_ref().unwrap_or(key).as_str();
            match kind {
                MODIFY_REWARD_WEIGHT => {
                    let p: ModifyRewardWeight = parse_params(file, &element, &term.params)?;
                    let names = || config.rewards.values().flat_map(|set| set.keys().map(String::as_str));
                    if !names().any(|name| name == p.term_name) {
                        let problem = format!("no reward set of the task has an entry `{}`", p.term_name);
                        let remedy = did_you_mean(&p.term_name, names(), "reward entries");
                        return Err(ConfigError::invalid(file, format!("{element}.term_name"), problem, remedy)
                            .of_kind(ConfigErrorKind::UnknownName));
                    }
                    schedules.entries.push((key.clone(), p.term_name.clone()));
                    schedules.weights.entry(p.term_name).or_default().push((p.num_steps as u64, p.weight));
                }
                COMMANDS_VEL | COMMAND_CURRICULUM => {
                    if config.commands.base_velocity.is_none() {
                        let problem = "the task gives no velocity command, `base_velocity`";
                        let remedy = "add [commands.base_velocity], or remove the term";
                        return Err(ConfigError::invalid(file, element, problem, remedy));
                    }
                    let is_second = match kind {
                        COMMANDS_VEL => {
                            let p = parse_params(file, &element, &term.params)?;
                            schedules.stages.replace((element.clone(), p)).is_some()
                        }
                        _ => {
                            let p = parse_params(file, &element, &term.params)?;
                            schedules.widening.replace((element.clone(), p)).is_some()
                        }
                    };
                    if is_second {
                        let problem = format!("the term `{kind}` stands here a second time");
                        return Err(ConfigError::invalid(file, element, problem, "remove one of them"));
                    }
                }
                _ => {}
            }
        }
        schedules.weights.values_mut().for_each(|weights| weights.sort_by_key(|(step, _)| *step));
        Ok(schedules)
    }

    /// Place of the term that pays a robot for tracking, where the curriculum `term` widens
    /// commands by it.
    pub(super) fn tracking_term(&self, term: &str, terms: &[RewardTerm]) -> Option<usize> {
        let (_, widening) = self.widening.as_ref().filter(|_| term == COMMAND_CURRICULUM)?;
        tracking_term(&widening.reward_terms, terms)
    }

    /// Weights of a reward entry from later control steps on.
    pub(in crate::systems) fn weights_of(&self, entry: &str) -> Vec<(u64, f32)> {
        self.weights.get(entry).cloned().unwrap_or_default()
    }

    /// Curriculum entries that change weights, each with its reward entry.
    pub(in crate::systems) fn entries(&self) -> impl Iterator<Item = (&str, &str)> {
        self.entries.iter().map(|(key, entry)| (key.as_str(), entry.as_str()))
    }

    /// Ranges of a robot's velocity command; all lie within the robot's limits.
    ///
    /// # Errors
    /// A range has nothing in common with the robot's limits; a range to which none is widened does
    /// not hold that of the command.
    pub(in crate::systems) fn ranges_of(
        &self,
        robot: &MorphologyModel,
        config: &TaskConfig,
        commands: &VelocityCommandConfig,
    ) -> Result<VelocityRanges, ConfigError> {
        let of = |commands: &VelocityCommandConfig| {
            [commands.lin_vel_x, commands.lin_vel_y, commands.ang_vel_z].map(|range| range.map(|x| x as f32))
        };
        let mut ranges = VelocityRanges { base: of(commands), stages: Vec::new(), widest: [None; 3] };
        let Some(task) = &config.commands.base_velocity else {
            return Ok(ranges);
        };
        if let Some((element, term)) = &self.stages {
            let mut present = task.clone();
            for (i, stage) in term.velocity_stages.iter().enumerate() {
                if i > 0 && stage.step <= term.velocity_stages[i - 1].step {
                    let (at, problem) =
                        (format!("{element}.velocity_stages[{i}].step"), "it is not after the one before");
                    return Err(ConfigError::invalid(
                        config.name.as_str(),
                        at,
                        problem,
                        "sort the stages by their steps",
                    ));
                }
                present.lin_vel_x = stage.lin_vel_x.unwrap_or(present.lin_vel_x);
                present.lin_vel_y = stage.lin_vel_y.unwrap_or(present.lin_vel_y);
                present.ang_vel_z = stage.ang_vel_z.unwrap_or(present.ang_vel_z);
                ranges.stages.push((stage.step as u64, of(&robot.config.velocity_commands(&present)?)));
            }
        }
        if let Some((element, term)) = &self.widening {
            let limits = [("lin_vel_x", term.lin_vel_x), ("lin_vel_y", term.lin_vel_y), ("ang_vel_z", term.ang_vel_z)];
            let own = [task.lin_vel_x, task.lin_vel_y, task.ang_vel_z];
            for ((key, limit), [low, high]) in limits.into_iter().zip(own) {
                if limit.is_some_and(|[least, most]| least > low || most < high) {
                    let problem = format!("it does not hold the command's range [{low}, {high}]");
                    let remedy = "write the widest range, which holds the first one";
                    return Err(ConfigError::invalid(
                        config.name.as_str(),
                        format!("{element}.{key}"),
                        problem,
                        remedy,
                    ));
                }
            }
            let widest = VelocityCommandConfig {
                lin_vel_x: term.lin_vel_x.unwrap_or(task.lin_vel_x),
                lin_vel_y: term.lin_vel_y.unwrap_or(task.lin_vel_y),
                ang_vel_z: term.ang_vel_z.unwrap_or(task.ang_vel_z),
                ..task.clone()
            };
            let within_robot = of(&robot.config.velocity_commands(&widest)?);
            for ((place, (_, limit)), within) in ranges.widest.iter_mut().zip(limits).zip(within_robot) {
                *place = limit.map(|_| within);
            }
        }
        Ok(ranges)
    }

    /// Checks that each robot is paid for tracking where its commands are widened by that.
    ///
    /// # Errors
    /// A robot's reward set has none of the entries.
    pub(in crate::systems) fn check_rewards(
        &self,
        rewards: &[Vec<RewardTerm>],
        config: &TaskConfig,
        morphologies: &Morphologies,
    ) -> Result<(), ConfigError> {
        let Some((element, term)) = &self.widening else {
            return Ok(());
        };
        for (terms, robot) in rewards.iter().zip(&morphologies.0) {
            if tracking_term(&term.reward_terms, terms).is_none() {
                let problem = format!("the reward set of {} has none of {:?}", robot.name(), term.reward_terms);
                let remedy =
                    did_you_mean("track_lin_vel_xy_exp", terms.iter().map(|term| term.name.as_str()), "entries");
                let at = format!("{element}.reward_terms");
                return Err(ConfigError::invalid(config.name.as_str(), at, problem, remedy));
            }
        }
        Ok(())
    }
}
