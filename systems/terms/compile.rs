//! A task's terms, made for the robots of a run.

use std::collections::BTreeMap;
use std::ops::Range;

use bevy_ecs::prelude::Resource;
use serde::Deserialize;
use toml::{Table, Value};

use super::super::commanded::CommandTerm;
use super::super::view::RobotView;
use super::registry::{
    BodyFn, BuiltObservation, CurriculumFn, IntervalFn, NoParams, ObservationFn, Registry, ResetFn, RewardFn,
    TerminationFn,
};
use super::schedules::{Schedules, VelocityRanges};
use super::spec::{TermKind, TermSource, TermSpec};
use crate::bounds::MAX_BUCKETS;
use crate::config::quantities::{FrictionCoefficient, FrictionLength, SpeedLimit};
use crate::config::values;
use crate::config::{
    ConfigError, ConfigErrorKind, EventMode, ExternalConfig, ExternalKind, POLICY_GROUP, TaskConfig,
    VelocityCommandConfig, did_you_mean, parse_params,
};
use crate::dynamics::ContactFriction;
use crate::dynamics::lanes::Simd;
use crate::engine::StateLimits;
use crate::morphology::{BatchSlots, Morphologies, MorphologyModel};

/// One term of a reward set.
pub struct RewardTerm {
    /// Name of the term in the reward set.
    pub name: String,
    /// Factor of its value.
    pub weight: f32,
    /// Factors from later control steps of the simulation on, in the order of the steps.
    pub(in crate::systems) later: Vec<(u64, f32)>,
    pub(in crate::systems) value: RewardFn,
}

impl RewardTerm {
    /// Whether its factor changes in the course of the simulation.
    pub(in crate::systems) fn is_scheduled(&self) -> bool {
        !self.later.is_empty()
    }

    /// Sets its weight. Returns whether it could: a curriculum's entry sets it by control steps.
    pub(crate) fn set_weight(&mut self, weight: f32) -> bool {
        let can = self.later.is_empty();
        if can {
            self.weight = weight;
        }
        can
    }

    /// Factor of its value in a control step of the simulation.
    #[inline(always)]
    pub fn weight_at(&self, step: u64) -> f32 {
        self.later.iter().rfind(|(from, _)| *from <= step).map_or(self.weight, |(_, weight)| *weight)
    }

    /// Unweighted value of the term per second for a robot.
    pub fn value(&self, robot: &RobotView) -> f32 {
        (self.value)(robot, Simd::Portable.dispatch())
    }
}

/// One term of an observation group.
pub struct ObservationTerm {
    /// Name of the term in the task's config.
    pub name: String,
    /// Number of values in an observation, with its history.
    pub size: usize,
    /// Number of control steps that it remembers, the present one included; the oldest comes first.
    pub history: usize,
    /// Description of the term.
    pub spec: TermSpec,
    /// Number that the term takes off its source, before noise, limits and factor.
    pub offset: f32,
    /// Half width of its uniform noise; 0 without.
    pub noise: f32,
    /// Largest relative error of its numbers, which an episode keeps; 0 without.
    pub error: f32,
    /// Limits of the noisy numbers.
    pub clip: Option<[f32; 2]>,
    /// Factor of the limited numbers.
    pub scale: f32,
    pub(in crate::systems) write: ObservationFn,
    /// Whether a morphology has the term in a task; the others have zeros.
    is_on: fn(&MorphologyModel, &TaskConfig) -> bool,
    /// Whether the simulation's caller computes the term.
    pub is_external: bool,
    /// Names of the robots that have the term; all if empty.
    robots: Vec<String>,
}

impl ObservationTerm {
    /// Whether a robot has the term in a task; the others have zeros.
    pub(in crate::systems) fn is_of(&self, robot: &MorphologyModel, task: &TaskConfig) -> bool {
        (self.is_on)(robot, task) && (self.robots.is_empty() || self.robots.iter().any(|name| name == robot.name()))
    }
}

/// An observation group: consecutive terms, and consecutive numbers of a row of
/// [`Batch::observations`](crate::batch::Batch).
pub struct ObservationGroup {
    /// Name of the group; the first one is [`POLICY_GROUP`](crate::config::POLICY_GROUP).
    pub name: String,
    /// Terms of the group, as indices.
    pub terms: Range<usize>,
    /// Numbers of the group in a row.
    pub columns: Range<usize>,
}

/// One reason for an episode to end.
pub struct TerminationTerm {
    /// Name of the term in the task's config.
    pub name: String,
    /// Whether it truncates the episode rather than failing it.
    pub time_out: bool,
    pub(in crate::systems) ends: TerminationFn,
}

pub(in crate::systems) struct IntervalEvent {
    pub(in crate::systems) range_s: [f32; 2],
    pub(in crate::systems) apply: IntervalFn,
}

/// A task made ready for the robots of a run.
#[derive(Resource)]
pub struct CompiledTask {
    /// The config it was made from.
    pub config: TaskConfig,
    /// Velocity commands of each morphology: the task's, within the robot's limits. Zero in a task
    /// without a velocity command.
    pub commands: Vec<VelocityCommandConfig>,
    /// Ranges of the velocity commands of each morphology, as the curriculum changes them.
    pub(in crate::systems) velocity_ranges: Vec<VelocityRanges>,
    /// The other commands, in the order of their numbers.
    pub command_terms: Vec<CommandTerm>,
    /// Slots of the batch.
    pub num_joints: usize,
    /// Length of a control step, s.
    pub step_dt: f32,
    /// Control steps in a full episode.
    pub max_episode_length: u32,
    /// Terms of all observation groups, in order.
    pub observations: Vec<ObservationTerm>,
    /// The groups, the policy's first.
    pub groups: Vec<ObservationGroup>,
    /// Terms of each morphology's reward set.
    pub rewards: Vec<Vec<RewardTerm>>,
    /// Reasons for an episode to end.
    pub terminations: Vec<TerminationTerm>,
    /// Limits beyond which a state ends its episode, whatever the task says.
    pub limits: StateLimits,
    pub(in crate::systems) startup_events: Vec<BodyFn>,
    pub(in crate::systems) reset_body_events: Vec<BodyFn>,
    pub(in crate::systems) reset_events: Vec<ResetFn>,
    action_delay: Option<ActionDelay>,
    physics_material: Option<PhysicsMaterial>,
    pub(in crate::systems) interval_events: Vec<IntervalEvent>,
    pub(in crate::systems) curriculum: Vec<CurriculumFn>,
    pub(in crate::systems) schedules: Schedules,
}

/// The event that changes the shapes of links.
pub(in crate::systems) const BODY_VARIATION: &str = "body_variation";

/// The event that delays all targets of a robot.
pub(crate) const ACTION_DELAY: &str = "action_delay";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::systems) struct ActionDelay {
    /// Fewest and most physics steps, both included. Default: each robot's own range.
    #[serde(default, deserialize_with = "crate::config::values::optional_step_range")]
    delay_range: Option<[u32; 2]>,
}

impl ActionDelay {
    /// Fewest and most physics steps for a robot.
    pub(in crate::systems) fn range(&self, morphology: &MorphologyModel) -> [u32; 2] {
        self.delay_range.unwrap_or(morphology.config.randomization.action_delay)
    }
}

/// The event that gives robots a surface.
pub(crate) const PHYSICS_MATERIAL: &str = "physics_material";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::systems) struct PhysicsMaterial {
    /// Number of equally spaced materials that are drawn from.
    #[serde(deserialize_with = "values::count_up_to::<MAX_BUCKETS, _>")]
    pub(in crate::systems) num_buckets: u32,
    /// Static coefficient of friction. Default: each robot's own range.
    #[serde(default, deserialize_with = "values::optional_range_of::<FrictionCoefficient, _, _>")]
    pub(in crate::systems) static_friction_range: Option<[f64; 2]>,
    /// Dynamic coefficient of friction, at most the static one. Default: each robot's own range.
    #[serde(default, deserialize_with = "values::optional_range_of::<FrictionCoefficient, _, _>")]
    pub(in crate::systems) dynamic_friction_range: Option<[f64; 2]>,
    /// Coefficient of torsional friction, m. Default: each robot's own range.
    #[serde(default, deserialize_with = "values::optional_range_of::<FrictionLength, _, _>")]
    torsional_friction_range: Option<[f64; 2]>,
    /// Coefficient of rolling friction, m. Default: each robot's own range.
    #[serde(default, deserialize_with = "values::optional_range_of::<FrictionLength, _, _>")]
    rolling_friction_range: Option<[f64; 2]>,
}

impl PhysicsMaterial {
    /// Ranges of a robot's torsional and rolling friction, m; none where the coefficient is not
    /// drawn.
    pub(in crate::systems) fn spin_ranges(&self, morphology: &MorphologyModel) -> [Option<[f64; 2]>; 2] {
        let own = &morphology.config.randomization;
        [self.torsional_friction_range.or(own.torsional_friction), self.rolling_friction_range.or(own.rolling_friction)]
    }
}

/// Largest number of terms that end episodes. Each has a bit of
/// [`Episode::causes`](crate::components::Episode::causes), whose first bit is the guard's.
const MOST_TERMINATIONS: usize = u32::BITS as usize - 1;
/// Parameters of [`ILLEGAL_STATE`]: [`StateLimits`] that walking robots stay within.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct SpeedLimits {
    #[serde(deserialize_with = "values::number_of::<SpeedLimit, _, _>")]
    max_lin_vel: f32,
    #[serde(deserialize_with = "values::number_of::<SpeedLimit, _, _>")]
    max_ang_vel: f32,
    #[serde(deserialize_with = "values::number_of::<SpeedLimit, _, _>")]
    max_joint_vel: f32,
}

impl Default for SpeedLimits {
    fn default() -> Self {
        let StateLimits { max_lin_vel, max_ang_vel, max_joint_vel } = StateLimits::default();
        Self { max_lin_vel, max_ang_vel, max_joint_vel }
    }
}

impl From<SpeedLimits> for StateLimits {
    fn from(SpeedLimits { max_lin_vel, max_ang_vel, max_joint_vel }: SpeedLimits) -> Self {
        Self { max_lin_vel, max_ang_vel, max_joint_vel }
    }
}

/// Name under which the guard against broken states appears among the terminations.
pub(super) const ILLEGAL_STATE: &str = "illegal_state";

impl CompiledTask {
    /// Sets the ranges of the velocity commands of the robot at place `index`: forward and left
    /// velocity, m/s, and yaw rate, rad/s. Returns whether it could: stages of a curriculum set
    /// them.
    ///
    /// # Panics
    /// If there is no such robot.
    pub(crate) fn set_velocity_ranges(&mut self, index: usize, ranges: [[f64; 2]; 3]) -> bool {
        let can = self.velocity_ranges[index].set_base(ranges.map(|range| range.map(|x| x as f32)));
        if can {
            let config = &mut self.commands[index];
            [config.lin_vel_x, config.lin_vel_y, config.ang_vel_z] = ranges;
        }
        can
    }

    /// Makes every term that the robots of the run use.
    ///
    /// # Errors
    /// A term is unknown or its parameters are wrong; a robot asks for a reward set that the task
    /// lacks.
    pub fn new(config: &TaskConfig, morphologies: &Morphologies, registry: &Registry) -> Result<Self, ConfigError> {
        let file = config.name.as_str();
        let step_dt = config.sim.step_dt() as f32;
        let num_joints = morphologies.1.joints.len();
        let (mut observations, mut groups, mut width) = (Vec::new(), Vec::new(), 0);
        for (group, terms) in config.observations.groups() {
            let (first_term, first_column) = (observations.len(), width);
            for (i, term) in terms.iter().enumerate() {
                let element = format!("observations.{group}[{i}]");
                let (spec, size, built, is_on) = match &term.external {
                    Some(external) => external_term(external, &term.params, file, &element, &morphologies.1)?,
                    None => {
                        let registered = find(&registry.observations, &term.term, file, &element, "observation")?;
                        check_command(config, registry, &term.term, &term.params, &element)?;
                        let size = (registered.size)(config, &morphologies.1).map_err(|(problem, remedy)| {
                            ConfigError::invalid(file, element.as_str(), problem, remedy)
                        })?;
                        let built = (registered.build)(file, &element, &term.params)?;
                        (registered.spec, size, built, registered.is_on)
                    }
                };
                spec.check_size(size, &morphologies.1).map_err(|needed| {
                    let problem = format!(
                        "the term `{}` is registered with {size} numbers, but its kind has {needed}",
                        term.term
                    );
                    let remedy = "register it with another size, kind or blocks";
                    ConfigError::invalid(file, element.as_str(), problem, remedy)
                })?;
                // a teacher of quadrupeds may read it in other groups, where other robots have
                // zeros
                let other = morphologies.0.iter().find(|robot| robot.quadruped.is_none() && group == POLICY_GROUP);
                if let Some(other) = other.filter(|_| spec.is_of_quadrupeds()) {
                    let problem = format!(
                        "the term `{}` describes quadrupeds of twelve joints; {} is none",
                        term.term,
                        other.name()
                    );
                    let remedy = "use the term `joint_descriptors`, or other robots";
                    return Err(ConfigError::invalid(file, element, problem, remedy));
                }
                if term.error > 0.0 && (spec.source != TermSource::RobotConstant || term.history_length > 1) {
                    let problem =
                        format!("the term `{}` does not describe the robot by one number for an episode", term.term);
                    let remedy = "remove it, or give `noise`, which is drawn in every control step";
                    return Err(ConfigError::invalid(file, format!("{element}.error"), problem, remedy));
                }
                let history = term.history_length as usize;
                width += size * history;
                observations.push(ObservationTerm {
                    name: term.term.clone(),
                    size: size * history,
                    history,
                    noise: if config.observations.enable_noise { term.noise as f32 } else { 0.0 },
                    error: if config.observations.enable_noise { term.error as f32 } else { 0.0 },
                    clip: term.clip.map(|range| range.map(|x| x as f32)),
                    scale: term.scale as f32,
                    spec,
                    offset: built.offset,
                    write: built.write,
                    is_on,
                    is_external: term.external.is_some(),
                    robots: term.external.as_ref().map_or_else(Vec::new, |external| external.robots.clone()),
                });
            }
            let (terms, columns) = (first_term..observations.len(), first_column..width);
            groups.push(ObservationGroup { name: group.to_owned(), terms, columns });
        }
        let schedules = Schedules::new(config)?;
        let mut rewards = Vec::new();
        for morphology in &morphologies.0 {
            let set = &morphology.config.reward_set;
            let mut terms = Vec::new();
            for (name, term) in config.reward_set(morphology.name(), set)? {
                let later = schedules.weights_of(name);
                if term.weight == 0.0 && later.is_empty() {
                    continue;
                }
                let element = format!("rewards.{set}.{name}");
                let kind = term.term.as_ref().unwrap_or(name);
                let build = find(&registry.rewards, kind, file, &element, "reward")?;
                check_command(config, registry, kind, &term.params, &element)?;
                let value = build(file, &element, &term.params, morphology)?;
                terms.push(RewardTerm { name: name.clone(), weight: term.weight as f32, later, value });
            }
            rewards.push(terms);
        }
        let mut terminations = Vec::new();
        let mut limits = StateLimits::default();
        for (name, params) in &config.terminations {
            let element = format!("terminations.{name}");
            if name == ILLEGAL_STATE {
                limits = parse_params::<SpeedLimits>(file, &element, params)?.into();
                continue;
            }
            let (time_out, build) = find(&registry.terminations, name, file, &element, "termination")?;
            let ends = build(file, &element, params)?;
            terminations.push(TerminationTerm { name: name.clone(), time_out: *time_out, ends });
        }
        if terminations.len() > MOST_TERMINATIONS {
            let problem = format!("there are {} terms", terminations.len());
            let remedy = format!("name {MOST_TERMINATIONS} at most: let one term look for several reasons");
            return Err(ConfigError::invalid(file, "terminations", problem, remedy));
        }
        let commands = morphologies.0.iter().map(|robot| match &config.commands.base_velocity {
            Some(velocity) => robot.config.velocity_commands(velocity),
            None => Ok(VelocityCommandConfig::none()),
        });
        let commands = commands.collect::<Result<Vec<_>, _>>()?;
        let mut velocity_ranges = Vec::new();
        for (robot, commands) in morphologies.0.iter().zip(&commands) {
            velocity_ranges.push(schedules.ranges_of(robot, config, commands)?);
        }
        let mut task = Self {
            commands,
            velocity_ranges,
            command_terms: command_terms(config, morphologies, registry)?,
            schedules,
            num_joints,
            step_dt,
            max_episode_length: config.sim.max_episode_length(),
            observations,
            groups,
            rewards,
            terminations,
            limits,
            startup_events: Vec::new(),
            reset_body_events: Vec::new(),
            reset_events: Vec::new(),
            action_delay: None,
            physics_material: None,
            interval_events: Vec::new(),
            curriculum: Vec::new(),
            config: config.clone(),
        };
        for (name, term) in config.curriculum.iter().filter(|(_, term)| term.enabled) {
            let element = format!("curriculum.{name}");
            let build = find(&registry.curriculum, term.term.as_ref().unwrap_or(name), file, &element, "curriculum")?;
            task.curriculum.push(build(file, &element, &term.params)?);
        }
        task.schedules.check_rewards(&task.rewards, config, morphologies)?;
        task.add_events(registry)?;
        Ok(task)
    }

    /// Whether the task gives a velocity command.
    pub fn has_velocity_command(&self) -> bool {
        self.config.commands.base_velocity.is_some()
    }

    /// Makes the events that are switched on, those of a kind in the order of their registration.
    fn add_events(&mut self, registry: &Registry) -> Result<(), ConfigError> {
        let file = self.config.name.as_str();
        let (mut at_startup, mut on_body, mut at_reset, mut at_intervals) = (vec![], vec![], vec![], vec![]);
        for (name, event) in self.config.events.iter().filter(|(_, event)| event.enabled) {
            let element = format!("events.{name}");
            if name == PHYSICS_MATERIAL {
                self.physics_material = Some(parse_params(file, &element, &event.params)?);
            }
            match event.mode {
                EventMode::Startup => {
                    let (place, build) = find(&registry.body, name, file, &element, "startup event")?;
                    at_startup.push((*place, build(file, &element, &event.params)?));
                }
                EventMode::Reset => {
                    if let Some((place, build)) = registry.body.get(name.as_str()) {
                        on_body.push((*place, build(file, &element, &event.params)?));
                    } else {
                        if name == ACTION_DELAY {
                            self.action_delay = Some(parse_params(file, &element, &event.params)?);
                        }
                        let (place, build) = find(&registry.reset, name, file, &element, "reset event")?;
                        at_reset.push((*place, build(file, &element, &event.params)?));
                    }
                }
                EventMode::Interval => {
                    let (place, build) = find(&registry.interval, name, file, &element, "interval event")?;
                    let event = IntervalEvent {
                        range_s: event.interval_range_s.unwrap_or_default().map(|x| x as f32),
                        apply: build(file, &element, &event.params)?,
                    };
                    at_intervals.push((*place, event));
                }
            }
        }
        self.startup_events = in_order(at_startup);
        self.reset_body_events = in_order(on_body);
        self.reset_events = in_order(at_reset);
        self.interval_events = in_order(at_intervals);
        Ok(())
    }

    /// The most physics steps by which the task's events delay the targets of a robot, on top of
    /// its actuators' delays.
    pub fn max_action_delay(&self, morphology: &MorphologyModel) -> u32 {
        self.action_delay.as_ref().map_or(0, |event| event.range(morphology)[1])
    }

    /// Kinds of friction between a robot's contacts and the ground, by the largest coefficients
    /// that the task gives it.
    pub fn contact_friction(&self, morphology: &MorphologyModel) -> ContactFriction {
        let (ground, robot) = (&self.config.scene.ground, &self.config.robot_material);
        let drawn = self.physics_material.as_ref().map_or([None; 2], |event| event.spin_ranges(morphology));
        let most = |ground: f64, robot: f64, drawn: Option<[f64; 2]>| ground.max(drawn.map_or(robot, |[_, high]| high));
        ContactFriction::of(
            most(ground.torsional_friction, robot.torsional_friction, drawn[0]),
            most(ground.rolling_friction, robot.rolling_friction, drawn[1]),
        )
        .max(morphology.topology.friction)
    }

    /// Terms of a group.
    pub fn terms_of(&self, group: &ObservationGroup) -> &[ObservationTerm] {
        &self.observations[group.terms.clone()]
    }

    /// The group of that name.
    ///
    /// # Errors
    /// An unknown group.
    pub fn group(&self, name: &str) -> Result<&ObservationGroup, ConfigError> {
        self.groups.iter().find(|group| group.name == name).ok_or_else(|| {
            let remedy = did_you_mean(name, self.groups.iter().map(|group| group.name.as_str()), "observation groups");
            let problem = format!("the task has no observation group `{name}`");
            ConfigError::invalid(self.config.name.as_str(), "observations", problem, remedy)
                .of_kind(ConfigErrorKind::UnknownName)
        })
    }

    /// Whether an observation holds numbers of the one before: of a term that remembers, or whose
    /// error lasts an episode.
    pub fn has_history(&self) -> bool {
        self.observations.iter().any(|term| term.history > 1 || term.error > 0.0)
    }

    /// Names of the terms that the simulation's caller computes.
    pub fn external_terms(&self) -> Vec<&str> {
        self.observations.iter().filter(|term| term.is_external).map(|term| term.name.as_str()).collect()
    }

    /// Numbers in a row of all groups.
    pub fn num_obs(&self) -> usize {
        self.observations.iter().map(|term| term.size).sum()
    }

    /// The mirror image of a row of all groups of this robot, left and right exchanged: the number
    /// that takes the place of each number, and its sign. Numbers stay in their group.
    pub fn mirrored_observation(&self, robot: &MorphologyModel) -> Vec<(usize, f32)> {
        let mut mirror = Vec::with_capacity(self.num_obs());
        for term in &self.observations {
            let image = term.spec.mirror(term.size / term.history, self.num_joints, robot, &self.config.sensors);
            for _ in 0..term.history {
                let start = mirror.len();
                mirror.extend(image.iter().map(|&(index, sign)| (start + index, sign)));
            }
        }
        mirror
    }

    /// Whether this robot has each number of an observation: numbers of joints, feet and sensors
    /// that it lacks are zero, and count for nothing.
    pub fn observation_mask(&self, robot: &MorphologyModel) -> Vec<bool> {
        let joints = robot.action_mask(self.num_joints);
        let mut mask = Vec::with_capacity(self.num_obs());
        for term in &self.observations {
            match term.spec.kind {
                _ if !term.is_of(robot, &self.config) => mask.extend(std::iter::repeat_n(false, term.size)),
                TermKind::PerJoint => mask.extend(joints.iter().cycle().take(term.size)),
                TermKind::PerFoot => {
                    let columns = term.size / term.history;
                    mask.extend((0..term.size).map(|at| robot.foot_columns.contains(&(at % columns))));
                }
                _ => mask.extend(std::iter::repeat_n(true, term.size)),
            }
        }
        mask
    }

    /// Interval events that each env keeps a timer for.
    pub fn num_interval_events(&self) -> usize {
        self.interval_events.len()
    }

    /// Whether causes of an end hold a failure, see
    /// [`Episode::causes`](crate::components::Episode::causes).
    pub(in crate::systems) fn has_failed(&self, causes: u32) -> bool {
        self.failures() & causes != 0
    }

    /// Causes of an end that are failures.
    pub(super) fn failures(&self) -> u32 {
        let of_terms = self.terminations.iter().enumerate().filter(|(_, term)| !term.time_out);
        of_terms.fold(1, |failures, (bit, _)| failures | 1 << (bit + 1))
    }

    /// Names of the bits of [`Episode::causes`](crate::components::Episode::causes).
    pub fn cause_names(&self) -> impl Iterator<Item = &str> {
        std::iter::once(ILLEGAL_STATE).chain(self.terminations.iter().map(|term| term.name.as_str()))
    }
}

/// Size and form of a term that the simulation's caller computes.
#[expect(clippy::type_complexity, reason = "the parts of a registered term")]
fn external_term(
    external: &ExternalConfig,
    params: &Table,
    file: &str,
    element: &str,
    slots: &BatchSlots,
) -> Result<(TermSpec, usize, BuiltObservation, fn(&MorphologyModel, &TaskConfig) -> bool), ConfigError> {
    let NoParams {} = parse_params(file, element, params)?;
    let size = external.size as usize;
    let size = match external.kind {
        ExternalKind::PerJoint => size * slots.joints.len(),
        ExternalKind::PerFoot => size * slots.feet.len(),
        _ => size,
    };
    let is_on: fn(&MorphologyModel, &TaskConfig) -> bool = |_, _| true;
    Ok((TermSpec::external(external), size, BuiltObservation { offset: 0.0, write: None }, is_on))
}

/// Makes the commands of a task other than the velocity.
fn command_terms(
    config: &TaskConfig,
    morphologies: &Morphologies,
    registry: &Registry,
) -> Result<Vec<CommandTerm>, ConfigError> {
    let file = config.name.as_str();
    let (mut terms, mut start) = (Vec::new(), 0);
    for (name, command) in &config.commands.others {
        let element = format!("commands.{name}");
        let registered = find(&registry.commands, name, file, &element, "command")?;
        let Some(build) = &registered.build else {
            continue;
        };
        let of_morphologies = morphologies.0.iter().map(|robot| build(file, &element, &command.params, robot));
        let end = start + registered.spec.columns.len();
        terms.push(CommandTerm {
            name: name.clone(),
            columns: registered.spec.columns,
            range: start..end,
            resampling_time_s: command.resampling_time_s.map(|time| time as f32),
            of_morphologies: of_morphologies.collect::<Result<_, _>>()?,
        });
        start = end;
    }
    if terms.len() > MOST_COMMANDS {
        let problem = format!("there are {} commands", terms.len());
        return Err(ConfigError::invalid(file, "commands", problem, format!("name {MOST_COMMANDS} at most")));
    }
    Ok(terms)
}

/// Largest number of commands other than the velocity: each has a bit of
/// [`CommandNumbers::pinned`](crate::components::CommandNumbers::pinned).
const MOST_COMMANDS: usize = u32::BITS as usize;

/// Checks that the task gives the command that a term follows.
fn check_command(
    config: &TaskConfig,
    registry: &Registry,
    term: &str,
    params: &Table,
    element: &str,
) -> Result<(), ConfigError> {
    let Some(needed) = registry.needs.get(term) else {
        return Ok(());
    };
    let named = params.get("command_name").and_then(Value::as_str);
    // an unknown name is refused with the term's parameters
    let is_absent = |command: &&str| !config.commands.has(command) && registry.commands.contains_key(*command);
    let needed: Vec<&str> = named.map_or_else(|| needed.clone(), |named| vec![named]);
    let Some(command) = needed.into_iter().find(is_absent) else {
        return Ok(());
    };
    let given: Vec<&str> = config.commands.names().collect();
    let given = if given.is_empty() { "no command".into() } else { given.join(", ") };
    let problem = format!("the term `{term}` follows the command `{command}`, and the task gives {given}");
    let remedy = format!("add [commands.{command}], or remove the term");
    Err(ConfigError::invalid(config.name.as_str(), element, problem, remedy))
}

fn in_order<T>(mut events: Vec<(usize, T)>) -> Vec<T> {
    events.sort_by_key(|(place, _)| *place);
    events.into_iter().map(|(_, event)| event).collect()
}

fn find<'a, T>(
    terms: &'a BTreeMap<&'static str, T>,
    name: &str,
    file: &str,
    element: &str,
    kind: &str,
) -> Result<&'a T, ConfigError> {
    terms.get(name).ok_or_else(|| {
        let plural = format!("{kind} terms");
        let remedy = did_you_mean(name, terms.keys().copied(), &plural);
        ConfigError::invalid(file, element, format!("there is no {kind} term `{name}`"), remedy)
            .of_kind(ConfigErrorKind::UnknownName)
    })
}
