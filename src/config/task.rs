//! Task configs: `configs/tasks/*.toml`.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::PI;
use std::fmt;

use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use toml::Table;

use super::error::{ConfigError, ConfigErrorKind};
use super::parse::params_beside;
use super::quantities::{
    Bound, Duration, Extent, Factor, FrictionCoefficient, FrictionLength, Gain, Gravity, Length, Noise, PushSpeed,
    Time, Weight,
};
use super::robot::{check_pattern, matches};
use super::scene::{ObstacleConfig, SceneConfig};
use super::sensors::RayCasterCameraConfig;
use super::suggest::{did_you_mean, is_slip};
use super::values;
use crate::bounds::{MAX_DECIMATION, MAX_EXTERNAL, MAX_HISTORY, MAX_SUBSTEPS, MAX_SWEEPS};
use crate::dynamics::SWEEPS;
use crate::robot::Slot;

/// Commands, scene and rewards of the robots. SI units; world z up, base x forward, y left.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct TaskConfig {
    /// Full name, such as `Velocity-Flat-HeteroQuadruped-v0`.
    pub name: String,
    /// Short names for the command line.
    #[serde(default)]
    pub aliases: Vec<String>,
    /// Folder of the training logs.
    pub experiment_name: String,
    /// Names of the robots, in the order of their blocks of envs.
    pub robots: Vec<String>,
    /// Number of shares of the envs by robot; robots that are not named have one.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty", deserialize_with = "values::env_shares")]
    pub env_shares: BTreeMap<String, u32>,
    /// Changes of this task to robots' configs, by the robot's name: tables laid out like
    /// `configs/robots/*.toml`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub robot_overrides: BTreeMap<String, Table>,
    /// Time and space.
    pub sim: SimConfig,
    /// Engine and its settings.
    #[serde(default)]
    pub physics: PhysicsConfig,
    /// Ground and obstacles.
    #[serde(default)]
    pub scene: SceneConfig,
    /// Surface of the robots where no event randomises it.
    pub robot_material: MaterialConfig,
    /// Commands of the policy.
    #[serde(default)]
    pub commands: CommandsConfig,
    /// Actions of the policy. Default: all joints' positions.
    #[serde(default, skip_serializing_if = "ActionsConfig::is_default")]
    pub actions: ActionsConfig,
    /// Sensors beyond those that every robot has.
    #[serde(default)]
    pub sensors: SensorsConfig,
    /// Observations of the policy.
    pub observations: ObservationsConfig,
    /// Parameters of each termination term, by the term's name.
    pub terminations: BTreeMap<String, Table>,
    /// Randomisation and disturbances, by the term's name.
    #[serde(default)]
    pub events: BTreeMap<String, EventConfig>,
    /// Changes of difficulty from episode to episode, by the term's name.
    #[serde(default)]
    pub curriculum: BTreeMap<String, CurriculumConfig>,
    /// Reward sets: set name -> term name -> weight and parameters. A robot's `reward_set` picks
    /// one.
    pub rewards: BTreeMap<String, BTreeMap<String, RewardConfig>>,
}

/// Time steps, gravity and the grid of envs.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SimConfig {
    /// Physics step, s; at least 1e-6.
    #[serde(deserialize_with = "values::physics_step")]
    pub dt: f64,
    /// Physics steps per control step, 1 to 1000.
    #[serde(deserialize_with = "values::count_up_to::<MAX_DECIMATION, _>")]
    pub decimation: u32,
    /// Length of an episode that nothing ends earlier, s.
    #[serde(deserialize_with = "values::number_of::<Duration, _, _>")]
    pub episode_length_s: f64,
    /// World frame, m/s^2. Default: 9.81 downwards.
    #[serde(deserialize_with = "values::list_of::<Gravity, _, _>", default = "earth_gravity")]
    pub gravity: [f64; 3],
    /// Distance between env origins on the square grid, m. Default: 4.
    #[serde(default = "env_spacing", deserialize_with = "values::number_of::<Extent, _, _>")]
    pub env_spacing: f64,
}

impl SimConfig {
    /// Duration of a control step, s.
    #[must_use]
    pub fn step_dt(&self) -> f64 {
        self.dt * f64::from(self.decimation)
    }

    /// Control steps in a full episode, rounded up.
    #[must_use]
    pub fn max_episode_length(&self) -> u32 {
        // The small number keeps 20 s / 0.02 s at 1000 steps whatever the last bit of the quotient.
        ((self.episode_length_s / self.step_dt()) - 1e-9).ceil().max(1.0) as u32
    }
}

/// Gravity of tasks and simulations that say nothing else, m/s^2.
pub const EARTH_GRAVITY: f64 = 9.81;

fn earth_gravity() -> [f64; 3] {
    [0.0, 0.0, -EARTH_GRAVITY]
}

fn env_spacing() -> f64 {
    4.0
}

/// Usual number of substeps of a physics step of the engine `avian`.
pub const AVIAN_SUBSTEPS: usize = 8;

/// The physics engine and its settings.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct PhysicsConfig {
    /// Name of the engine: `articulated`, `cuda`, `auto` (the faster of these two), `avian`, or one
    /// that a plugin has added. Default: articulated.
    pub engine: String,
    /// Sweeps of the articulated engine's solver over the contacts of one physics step. Default: 4.
    #[serde(deserialize_with = "values::count_up_to::<MAX_SWEEPS, _>")]
    pub solver_iterations: u32,
    /// Substeps of one physics step of the engine `avian`. Default: 8.
    #[serde(deserialize_with = "values::count_up_to::<MAX_SUBSTEPS, _>")]
    pub avian_substeps: u32,
    /// Fastest speed at which overlapping shapes are pushed apart, m/s. Default: 1.
    #[serde(deserialize_with = "values::number_of::<PushSpeed, _, _>")]
    pub max_depenetration_velocity: f64,
    /// Share of the overlap that is pushed out in one physics step, as far as that speed allows.
    /// Default: 0.2.
    #[serde(deserialize_with = "values::fraction")]
    pub depenetration_rate: f64,
    /// Whether every link of every robot is a kinematic body in Avian's world, too, for its
    /// queries, events and other bodies. Default: no.
    pub mirror_links: bool,
}

impl Default for PhysicsConfig {
    fn default() -> Self {
        Self {
            engine: "articulated".into(),
            solver_iterations: SWEEPS as u32,
            avian_substeps: AVIAN_SUBSTEPS as u32,
            max_depenetration_velocity: 1.0,
            depenetration_rate: 0.2,
            mirror_links: false,
        }
    }
}

/// A surface.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct MaterialConfig {
    /// Coefficient of friction at rest.
    #[serde(deserialize_with = "values::number_of::<FrictionCoefficient, _, _>")]
    pub static_friction: f64,
    /// Coefficient of friction when sliding.
    #[serde(deserialize_with = "values::number_of::<FrictionCoefficient, _, _>")]
    pub dynamic_friction: f64,
    /// Coefficient of torsional friction, m: torque about a contact's normal per normal force.
    /// Default: 0.
    #[serde(
        default,
        deserialize_with = "values::number_of::<FrictionLength, _, _>",
        skip_serializing_if = "values::is_zero"
    )]
    pub torsional_friction: f64,
    /// Coefficient of rolling friction, m: torque across a contact's normal per normal force.
    /// Default: 0.
    #[serde(
        default,
        deserialize_with = "values::number_of::<FrictionLength, _, _>",
        skip_serializing_if = "values::is_zero"
    )]
    pub rolling_friction: f64,
    /// Share of the approach speed that is given back, 0 to 1.
    #[serde(deserialize_with = "values::fraction")]
    pub restitution: f64,
}

/// Actions of the policy.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct ActionsConfig {
    /// Targets of joint positions.
    pub joint_pos: JointPositionActionConfig,
}

impl ActionsConfig {
    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// Actions that are targets of joint positions, about the default pose.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct JointPositionActionConfig {
    /// Joints that the policy drives: patterns on canonical names, such as `*_KNEE`; `*` stands for
    /// any run of letters. All other joints hold their default pose by the gains of their
    /// actuators, and have no column in actions and observations. Default: all joints.
    pub joint_names: Vec<String>,
}

impl Default for JointPositionActionConfig {
    fn default() -> Self {
        Self { joint_names: vec!["*".into()] }
    }
}

impl JointPositionActionConfig {
    /// Path of `joint_names` in a task.
    pub(crate) const JOINT_NAMES: &str = "actions.joint_pos.joint_names";

    /// Whether the policy drives the joints of this slot.
    pub(crate) fn drives(&self, slot: &Slot) -> bool {
        let name = slot.to_string();
        self.joint_names.iter().any(|pattern| matches(pattern, &name))
    }

    /// Element, problem and remedy of patterns that drive no joint of any robot.
    fn problem(&self) -> Option<(String, String, String)> {
        if self.joint_names.is_empty() {
            let remedy = "name the joints, as in [\"*_KNEE\"], or remove it: the policy then drives all joints";
            return Some((Self::JOINT_NAMES.into(), "the policy drives no joint".into(), remedy.into()));
        }
        let mut patterns = self.joint_names.iter().enumerate();
        patterns.find_map(|(index, pattern)| check_pattern(&format!("{}[{index}]", Self::JOINT_NAMES), pattern).err())
    }
}

/// Commands, by name.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CommandsConfig {
    /// A velocity of the base; absent in tasks that ask for no velocity.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub base_velocity: Option<VelocityCommandConfig>,
    /// Commands of other kinds, by the kind's name.
    #[serde(flatten)]
    pub others: BTreeMap<String, CommandConfig>,
}

impl<'de> Deserialize<'de> for CommandsConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(CommandTables)
    }
}

/// Reads commands. By hand, since a flattened map would lose the place of an error.
struct CommandTables;

impl<'de> Visitor<'de> for CommandTables {
    type Value = CommandsConfig;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a table of commands")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<CommandsConfig, A::Error> {
        let mut commands = CommandsConfig::default();
        while let Some(key) = map.next_key::<String>()? {
            if key == VELOCITY_COMMAND {
                commands.base_velocity = Some(map.next_value()?);
            } else if is_slip(&key, VELOCITY_COMMAND) {
                return Err(serde::de::Error::unknown_field(&key, &[VELOCITY_COMMAND]));
            } else {
                commands.others.insert(key, map.next_value()?);
            }
        }
        Ok(commands)
    }
}

impl CommandsConfig {
    /// Whether the task gives a command of this name.
    pub fn has(&self, name: &str) -> bool {
        if name == VELOCITY_COMMAND { self.base_velocity.is_some() } else { self.others.contains_key(name) }
    }

    /// Names of the commands.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        let velocity = self.base_velocity.as_ref().map(|_| VELOCITY_COMMAND);
        velocity.into_iter().chain(self.others.keys().map(String::as_str))
    }
}

/// Name of the command that is a velocity of the base.
pub const VELOCITY_COMMAND: &str = "base_velocity";
/// Names of its numbers, which are those of its ranges.
pub const VELOCITY_COLUMNS: [&str; 3] = ["lin_vel_x", "lin_vel_y", "ang_vel_z"];

/// A command of another kind than a velocity.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct CommandConfig {
    /// Time between two draws, s. Default: the command is drawn at resets alone.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<Duration, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub resampling_time_s: Option<f64>,
    /// The remaining keys, for [`parse_params`](super::parse_params).
    #[serde(flatten, deserialize_with = "command_params")]
    pub params: Table,
}

fn command_params<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Table, D::Error> {
    params_beside(deserializer, &["resampling_time_s"])
}

/// Ranges of velocity commands, which are drawn uniformly; base frame, ends from -1000 to 1000.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct VelocityCommandConfig {
    /// Forward speed, m/s.
    #[serde(deserialize_with = "values::command_range")]
    pub lin_vel_x: [f64; 2],
    /// Speed to the left, m/s.
    #[serde(deserialize_with = "values::command_range")]
    pub lin_vel_y: [f64; 2],
    /// Yaw rate, rad/s; also the limits of the heading controller.
    #[serde(deserialize_with = "values::command_range")]
    pub ang_vel_z: [f64; 2],
    /// Heading in the world, rad. Default: the full turn.
    #[serde(default = "full_turn", deserialize_with = "values::command_range")]
    pub heading: [f64; 2],
    /// Whether envs may be steered by heading. Default: no.
    #[serde(default)]
    pub heading_command: bool,
    /// Yaw rate per heading error, 1/s. Default: 0.5.
    #[serde(default = "half", deserialize_with = "values::number_of::<Gain, _, _>")]
    pub heading_control_stiffness: f64,
    /// Share of envs steered by heading, if any may be. Default: all.
    #[serde(default = "one", deserialize_with = "values::fraction")]
    pub rel_heading_envs: f64,
    /// Share of envs told to stand still. Default: none.
    #[serde(default, deserialize_with = "values::fraction")]
    pub rel_standing_envs: f64,
    /// Share of envs told to turn in place, at a yaw rate of the range. Default: none.
    #[serde(default, deserialize_with = "values::fraction")]
    pub rel_turning_envs: f64,
    /// Share of envs told to walk sideways alone, at a speed of the range. Default: none.
    #[serde(default, deserialize_with = "values::fraction")]
    pub rel_sideways_envs: f64,
    /// Time between two draws, s.
    #[serde(deserialize_with = "values::number_of::<Duration, _, _>")]
    pub resampling_time_s: f64,
}

fn full_turn() -> [f64; 2] {
    [-PI, PI]
}

fn half() -> f64 {
    0.5
}

fn one() -> f64 {
    1.0
}

fn yes() -> bool {
    true
}

fn one_step() -> u32 {
    1
}

fn is_one_step(steps: &u32) -> bool {
    *steps == 1
}

impl VelocityCommandConfig {
    /// The command to stand, for tasks that give no velocity command.
    #[must_use]
    pub fn none() -> Self {
        Self {
            lin_vel_x: [0.0; 2],
            lin_vel_y: [0.0; 2],
            ang_vel_z: [0.0; 2],
            heading: [0.0; 2],
            heading_command: false,
            heading_control_stiffness: half(),
            rel_heading_envs: 0.0,
            rel_standing_envs: 1.0,
            rel_turning_envs: 0.0,
            rel_sideways_envs: 0.0,
            resampling_time_s: 1e9,
        }
    }
}

/// Sensors that a task gives to every robot.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorsConfig {
    /// Looks at the heights around the base.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height_scanner: Option<HeightScannerConfig>,
    /// Looks at the distances to the ground ahead.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ray_caster_camera: Option<RayCasterCameraConfig>,
}

/// Rays straight down on a grid that follows the base's position and heading.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct HeightScannerConfig {
    /// Edge lengths of the grid along the base's x and y, m.
    #[serde(deserialize_with = "values::list_of::<Extent, _, _>")]
    pub size: [f64; 2],
    /// Distance of two rays, m.
    #[serde(deserialize_with = "values::number_of::<Length, _, _>")]
    pub resolution: f64,
}

impl HeightScannerConfig {
    /// Rays along x and y.
    #[must_use]
    pub fn counts(&self) -> [usize; 2] {
        // the small number keeps 1.6 m / 0.1 m at 17 rays whatever the last bit of the quotient
        self.size.map(|length| ((length / self.resolution + 1e-9) as usize).saturating_add(1))
    }

    /// Places of the rays about the base, m: from back to front and, row by row, from right to
    /// left.
    #[must_use]
    pub fn rays(&self) -> Vec<[f32; 2]> {
        let [nx, ny] = self.counts();
        let place = |i: usize, axis: usize| (i as f64 * self.resolution - 0.5 * self.size[axis]) as f32;
        (0..nx * ny).map(|k| [place(k % nx, 0), place(k / nx, 1)]).collect()
    }
}

/// Observations of the policy, and further groups of terms, such as a critic's in training.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ObservationsConfig {
    /// Whether the terms' noise is added. Default: yes.
    pub enable_noise: bool,
    /// Terms of the policy's observation, in order.
    pub policy: Vec<ObservationTerm>,
    /// Terms of the other groups, by the group's name.
    #[serde(flatten)]
    pub groups: BTreeMap<String, Vec<ObservationTerm>>,
}

impl<'de> Deserialize<'de> for ObservationsConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(Groups)
    }
}

/// Reads observation groups. By hand, since a flattened map would lose the place of an error.
struct Groups;

impl<'de> Visitor<'de> for Groups {
    type Value = ObservationsConfig;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a table of observation groups")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<ObservationsConfig, A::Error> {
        const KEYS: &[&str] = &["enable_noise", POLICY_GROUP];
        let (mut enable_noise, mut policy, mut groups) = (true, None, BTreeMap::new());
        while let Some(key) = map.next_key::<String>()? {
            match key.as_str() {
                "enable_noise" => enable_noise = map.next_value()?,
                POLICY_GROUP => policy = Some(map.next_value()?),
                _ if KEYS.iter().any(|known| is_slip(&key, known)) => {
                    return Err(serde::de::Error::unknown_field(&key, KEYS));
                }
                _ => {
                    groups.insert(key, map.next_value()?);
                }
            }
        }
        let policy = policy.ok_or_else(|| serde::de::Error::missing_field(POLICY_GROUP))?;
        Ok(ObservationsConfig { enable_noise, policy, groups })
    }
}

impl ObservationsConfig {
    /// Names and terms of all groups: the policy's first, then the others by name.
    pub fn groups(&self) -> impl Iterator<Item = (&str, &[ObservationTerm])> {
        let others = self.groups.iter().map(|(name, terms)| (name.as_str(), terms.as_slice()));
        std::iter::once((POLICY_GROUP, self.policy.as_slice())).chain(others)
    }
}

/// Name of the observation group that policies see.
pub const POLICY_GROUP: &str = "policy";

/// One term of an observation.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct ObservationTerm {
    /// Name of the term.
    pub term: String,
    /// Half width of the uniform noise on each element, in the term's units. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Noise, _, _>")]
    pub noise: f64,
    /// Largest relative error of each element, drawn uniformly at the beginning of each episode.
    /// For terms that describe the robot: they keep their numbers until the episode ends. Default:
    /// 0.
    #[serde(default, deserialize_with = "values::fraction", skip_serializing_if = "values::is_zero")]
    pub error: f64,
    /// Limits of the noisy numbers, in the term's units. Default: no limits.
    #[serde(
        default,
        deserialize_with = "values::optional_range_of::<Bound, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub clip: Option<[f64; 2]>,
    /// Factor of the limited numbers. Default: 1.
    #[serde(deserialize_with = "values::number_of::<Factor, _, _>", default = "one")]
    pub scale: f64,
    /// Number of control steps that it remembers: the term's last numbers, the oldest first.
    /// Default: 1, the present one alone.
    #[serde(default = "one_step", skip_serializing_if = "is_one_step")]
    pub history_length: u32,
    /// Declaration of a term that the simulation's caller computes. Default: none, the term is
    /// built in or a plugin's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub external: Option<ExternalConfig>,
    /// The remaining keys, for [`parse_params`](super::parse_params).
    #[serde(flatten, deserialize_with = "observation_params")]
    pub params: Table,
}

fn observation_params<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Table, D::Error> {
    params_beside(deserializer, &["term", "noise", "error", "clip", "scale", "history_length", "external"])
}

/// Declaration of an observation term that the simulation's caller computes after each control
/// step, such as a function in Python.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ExternalConfig {
    /// Number of values of a control step; of each joint or foot with those kinds.
    #[serde(deserialize_with = "values::count_up_to::<MAX_EXTERNAL, _>")]
    pub size: u32,
    /// Change of the numbers in a mirror. Default: none.
    #[serde(default)]
    pub kind: ExternalKind,
    /// SI units. Default: none.
    #[serde(default)]
    pub units: String,
    /// Meaning, with the frame. Default: none.
    #[serde(default)]
    pub description: String,
    /// Names of the robots that have the term; the others have zeros. Default: all.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub robots: Vec<String>,
}

/// Kind of the numbers of a term: how they change in a mirror that exchanges left and right.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ExternalKind {
    /// Numbers that a mirror leaves alone.
    #[default]
    Scalar,
    /// Vectors x, y, z.
    Vector,
    /// Pseudovectors x, y, z, such as an angular velocity.
    Pseudovector,
    /// Forward and left velocity and yaw rate.
    PlanarVelocity,
    /// Numbers of each joint, in the batch's columns.
    PerJoint,
    /// A number of each foot, in the batch's columns.
    PerFoot,
}

/// One randomisation or disturbance.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct EventConfig {
    /// Occasion of the event.
    pub mode: EventMode,
    /// Whether it happens at all. Default: yes.
    #[serde(default = "yes")]
    pub enabled: bool,
    /// Time between two occurrences, drawn uniformly each time, s; with `mode = "interval"` and
    /// only then.
    #[serde(
        default,
        deserialize_with = "values::optional_range_of::<Time, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub interval_range_s: Option<[f64; 2]>,
    /// The remaining keys, for [`parse_params`](super::parse_params).
    #[serde(flatten, deserialize_with = "event_params")]
    pub params: Table,
}

fn event_params<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Table, D::Error> {
    params_beside(deserializer, &["mode", "enabled", "interval_range_s"])
}

/// Occasion of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EventMode {
    /// The event happens once, when the envs are made.
    Startup,
    /// The event happens at the beginning of each episode.
    Reset,
    /// The event happens again and again within an episode.
    Interval,
}

/// One curriculum term: what changes when an episode ends.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct CurriculumConfig {
    /// Whether it changes anything. Default: yes.
    #[serde(default = "yes")]
    pub enabled: bool,
    /// Name of the term, where the key is not it: a task may have a term several times.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub term: Option<String>,
    /// The remaining keys, for [`parse_params`](super::parse_params).
    #[serde(flatten, deserialize_with = "curriculum_params")]
    pub params: Table,
}

fn curriculum_params<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Table, D::Error> {
    params_beside(deserializer, &["enabled", "term"])
}

/// One term of a reward set.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct RewardConfig {
    /// Factor of the term's value, per second; 0 switches the term off.
    #[serde(deserialize_with = "values::number_of::<Weight, _, _>")]
    pub weight: f64,
    /// Name of the term, where the key is not it: a set may have a term several times, for other
    /// joints say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub term: Option<String>,
    /// The remaining keys, for [`parse_params`](super::parse_params).
    #[serde(flatten, deserialize_with = "reward_params")]
    pub params: Table,
}

fn reward_params<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Table, D::Error> {
    params_beside(deserializer, &["weight", "term"])
}

impl TaskConfig {
    /// The reward terms of the set named `reward_set`, which is what `robot` asks for.
    ///
    /// # Errors
    /// There is no such set; the message names the robot and the sets.
    pub fn reward_set(&self, robot: &str, reward_set: &str) -> Result<&BTreeMap<String, RewardConfig>, ConfigError> {
        self.rewards.get(reward_set).ok_or_else(|| {
            ConfigError::invalid(
                self.name.clone(),
                format!("rewards.{reward_set}"),
                format!("robot `{robot}` asks for the reward set `{reward_set}`, which is missing"),
                did_you_mean(reward_set, self.rewards.keys().map(String::as_str), "reward sets"),
            )
            .of_kind(ConfigErrorKind::UnknownName)
        })
    }

    /// Checks what no single value can tell; errors name the task in place of a file.
    pub(crate) fn validate(&self) -> Result<(), ConfigError> {
        let invalid = |element: String, problem: &str, remedy: &str| {
            Err(ConfigError::invalid(self.name.clone(), element, problem, remedy))
        };
        if self.robots.is_empty() {
            return invalid("robots".into(), "the list is empty", "name at least one robot");
        }
        if let Some(index) = self.robots.iter().position(|robot| robot.trim().is_empty()) {
            return invalid(format!("robots[{index}]"), "the name is empty", "write a robot's name, or remove it");
        }
        if self.sim.max_episode_length() < 2 {
            let problem = format!("an episode is a single control step of {} s", self.sim.step_dt());
            return invalid("sim.episode_length_s".into(), &problem, "write the length of two control steps or more");
        }
        let mut seen = BTreeSet::new();
        if let Some((index, robot)) = self.robots.iter().enumerate().find(|(_, robot)| !seen.insert(robot.as_str())) {
            let problem = format!("robot `{robot}` is listed twice");
            return invalid(format!("robots[{index}]"), &problem, "name each robot once");
        }
        if self.observations.policy.is_empty() {
            let element = "observations.policy".to_owned();
            return invalid(element, "the policy sees nothing", "add [[observations.policy]] terms");
        }
        for (group, terms) in self.observations.groups() {
            if let Some(i) = terms.iter().position(|term| !(1..=MAX_HISTORY).contains(&term.history_length)) {
                let element = format!("observations.{group}[{i}].history_length");
                let problem = format!("{} control steps are remembered", terms[i].history_length);
                return invalid(element, &problem, &format!("choose from 1 to {MAX_HISTORY}"));
            }
            if terms.is_empty() {
                let remedy = format!("add [[observations.{group}]] terms, or leave the group out");
                return invalid(format!("observations.{group}"), "the group has no terms", &remedy);
            }
        }
        const MOST_RAYS: usize = 10_000;
        if let Some(scanner) = &self.sensors.height_scanner
            && scanner.counts().into_iter().fold(1, usize::saturating_mul) > MOST_RAYS
        {
            let element = "sensors.height_scanner".to_owned();
            return invalid(element, "it has more than 10 000 rays", "make it smaller, or raise its resolution in m");
        }
        const MOST_PIXELS: usize = 100_000;
        if let Some(camera) = &self.sensors.ray_caster_camera {
            let element = "sensors.ray_caster_camera".to_owned();
            if camera.pattern_cfg.num_pixels() > MOST_PIXELS {
                let remedy = "lower width or height of its pattern_cfg";
                return invalid(element, "it has more than 100 000 pixels", remedy);
            }
            if camera.min_distance >= camera.max_distance {
                return invalid(element, "it measures no distance", "write a min_distance below max_distance");
            }
        }
        if let Some(obstacle) = self.scene.obstacles.iter().position(ObstacleConfig::is_out_of_reach) {
            let problem = "it lies where no robot comes";
            let remedy = "write positions within 10 km and 100 m in height, sizes up to 10 km, in m, and angles in rad";
            return invalid(format!("scene.obstacles[{obstacle}]"), problem, remedy);
        }
        if let Some((element, problem, remedy)) = self.scene.problem() {
            return invalid(element, problem, remedy);
        }
        if let Some((element, problem, remedy)) = self.actions.joint_pos.problem() {
            return invalid(element, &problem, &remedy);
        }
        for (name, event) in &self.events {
            let element = format!("events.{name}.interval_range_s");
            match (event.mode, event.interval_range_s) {
                (EventMode::Interval, None) => {
                    let problem = "an interval event needs its time between two occurrences";
                    return invalid(element, problem, "add interval_range_s = [lower, upper]");
                }
                (EventMode::Interval, Some([_, upper])) if upper <= 0.0 => {
                    return invalid(element, "no time would pass", "write an upper end above 0");
                }
                (EventMode::Startup | EventMode::Reset, Some(_)) => {
                    let problem = "only interval events have a time between two occurrences";
                    return invalid(element, problem, "remove it, or set mode = \"interval\"");
                }
                _ => {}
            }
        }
        Ok(())
    }
}
