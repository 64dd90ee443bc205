//! Robot configs: `configs/robots/*.toml`.

use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::path::PathBuf;

use serde::{Deserialize, Deserializer, Serialize};

use crate::bounds::{MAX_DELAY, Shown};
use crate::robot::{CANONICAL_JOINT_NAMES, Place, Role, Side, Slot};

use super::error::{ConfigError, ConfigErrorKind};
use super::quantities::{
    ActionScale, Angle, BaseVelocity, Damping, Factor, Friction, JointSpeedLimit, JointVelocity, Quantity, Rise,
    RotorInertia, Stiffness, TorqueLimit,
};
use super::randomization::{RandomizationConfig, VariationConfig};
use super::sensors::CameraMountConfig;
use super::suggest::did_you_mean;
use super::surfaces::SurfaceConfig;
use super::task::VelocityCommandConfig;
use super::values;

/// Data that a robot's URDF lacks: default pose, actuators, reset and randomisation. SI units.
/// Canonical joints are named by limb and role, such as `LF_HFE` or `L_HIP_YAW`; their order is
/// that of the policy's action, and their positive directions are those of
/// [`Role`](crate::robot::Role), whichever way the URDF's axes turn.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RobotConfig {
    /// Name, equal to the file's stem.
    pub name: String,
    /// Name for people.
    pub title: String,
    /// The URDF, relative to this file or to the root that holds `configs/` and `assets/`.
    pub urdf: PathBuf,
    /// The `[rewards.<set>]` table of a task that this robot is rewarded by.
    pub reward_set: String,
    /// Radians of joint target per unit of action.
    #[serde(deserialize_with = "values::number_of::<ActionScale, _, _>")]
    pub action_scale: f64,
    /// Whether the robot's own links may collide with one another. Default: no.
    #[serde(default)]
    pub self_collisions: bool,
    /// Why the robot cannot stand in its default pose without a policy. Default: it stands. No part
    /// of a resolved task: it says something about the robot and sets nothing.
    #[serde(default, skip_serializing)]
    pub needs_policy: Option<String>,
    /// Joint angles of the default pose by canonical joint, rad; each joint, in the canonical
    /// direction.
    #[serde(deserialize_with = "values::map_of::<Angle, _>")]
    pub default_pose: BTreeMap<String, f64>,
    /// Groups of actuators; every canonical joint is in exactly one.
    pub actuators: BTreeMap<String, ActuatorConfig>,
    /// Limits of the robot's commands.
    #[serde(default, skip_serializing_if = "CommandLimitsConfig::is_empty")]
    pub commands: CommandLimitsConfig,
    /// How an episode begins.
    #[serde(default)]
    pub reset: ResetConfig,
    /// Ranges that a task's events draw from.
    #[serde(default)]
    pub randomization: RandomizationConfig,
    /// Ranges that the event `body_variation` draws bodies from.
    #[serde(default)]
    pub variation: VariationConfig,
    /// Canonical joint -> joint of the URDF, where geometry alone does not tell.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub joint_roles: BTreeMap<String, String>,
    /// Canonical joint -> lowest and highest position, rad or m, of a joint that the URDF lets move
    /// farther than the robot does.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub joint_limits: BTreeMap<String, [f64; 2]>,
    /// Leg (`LF`, `LH`, `RF`, `RH`; `L`, `R` of a biped) -> link of the URDF that is its foot,
    /// where geometry alone does not tell.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub feet: BTreeMap<String, String>,
    /// Surfaces of links that differ from the rest of the robot where they touch the ground, by a
    /// name for people.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub surfaces: BTreeMap<String, SurfaceConfig>,
    /// Links of the URDF by group of bodies, where geometry alone does not tell.
    #[serde(default, skip_serializing_if = "BodiesConfig::is_empty")]
    pub bodies: BodiesConfig,
    /// Mount of the robot's depth camera, for tasks that have one. Default: the task's mount.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraMountConfig>,
    /// ROS package -> folder, for `package://` meshes; relative to the config's folder.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub package_dirs: BTreeMap<String, PathBuf>,
    /// Joint of the URDF -> position in rad or m at which it is held for good.
    #[serde(deserialize_with = "values::map_of::<Angle, _>", default, skip_serializing_if = "BTreeMap::is_empty")]
    pub locked_joints: BTreeMap<String, f64>,
}

/// One group of like actuators.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ActuatorConfig {
    /// Patterns on canonical names; `*` stands for any run of letters.
    pub joints: Vec<String>,
    /// Law by which targets become torques.
    pub model: ActuatorModel,
    /// Torque per position error, N m / rad; networks do not use it, all other models need it.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<Stiffness, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub stiffness: Option<f64>,
    /// Torque per velocity error, N m s / rad; networks do not use it, all other models need it.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<Damping, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub damping: Option<f64>,
    /// Largest torque, N m. Default: the URDF's.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<TorqueLimit, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub effort_limit: Option<f64>,
    /// Torque at standstill of a DC motor, N m; `dc_motor` needs it, networks may have it, other
    /// models may not.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<TorqueLimit, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub saturation_effort: Option<f64>,
    /// Largest joint speed, rad/s; with `saturation_effort` it is needed: the motor's speed without
    /// load. Default: the URDF's; none where that is 0.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<JointSpeedLimit, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub velocity_limit: Option<f64>,
    /// Rotor inertia as seen at the joint, kg m^2. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<RotorInertia, _, _>")]
    pub armature: f64,
    /// Dry friction of the joint, N m. Default: as in the URDF.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<Friction, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub friction: Option<f64>,
    /// Viscous friction of the joint, N m s / rad. Default: as in the URDF.
    #[serde(
        default,
        deserialize_with = "values::optional_of::<Damping, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub joint_damping: Option<f64>,
    /// Stiffness of the joint's passive spring, N m / rad. Default: 0, no spring.
    #[serde(
        default,
        deserialize_with = "values::number_of::<Stiffness, _, _>",
        skip_serializing_if = "values::is_zero"
    )]
    pub spring_stiffness: f64,
    /// Joint angle at which the spring is at rest, in the canonical direction, rad. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Angle, _, _>", skip_serializing_if = "values::is_zero")]
    pub spring_reference: f64,
    /// Let the gains act on the beginning of each physics step, as a motor controller at its rate
    /// would. Default: on its end, which stays stable with any gains.
    #[serde(default)]
    pub explicit: bool,
    /// Fewest and most physics steps by which targets come late, both included; only `delayed_pd`.
    /// Default: none.
    #[serde(default)]
    pub delay: [u32; 2],
    /// Largest torque over the joint angle in the canonical direction: rows of `[rad, N m]`, linear
    /// in between, constant beyond the ends.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub effort_table: Vec<[f64; 2]>,
    /// ONNX file of a network that drives each joint of the group; looked for like the URDF.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub network_file: Option<PathBuf>,
    /// FNV-1a of that file. Default: whatever the file has; stated, the file must have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub network_checksum: Option<String>,
    /// Whether position errors or velocities come first; `actuator_net_mlp` alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input_order: Option<InputOrder>,
    /// Ages of the position errors and velocities that are inputs, in physics steps, 0 the present;
    /// `actuator_net_mlp` alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input_idx: Option<Vec<u32>>,
    /// Factor on position errors (target less position, rad); `actuator_net_mlp` alone.
    #[serde(
        deserialize_with = "values::optional_of::<Factor, _, _>",
        default,
        skip_serializing_if = "Option::is_none"
    )]
    pub pos_scale: Option<f64>,
    /// Factor on velocities (rad/s); `actuator_net_mlp` alone.
    #[serde(
        deserialize_with = "values::optional_of::<Factor, _, _>",
        default,
        skip_serializing_if = "Option::is_none"
    )]
    pub vel_scale: Option<f64>,
    /// Factor on the network's output, N m; `actuator_net_mlp` alone.
    #[serde(
        deserialize_with = "values::optional_of::<Factor, _, _>",
        default,
        skip_serializing_if = "Option::is_none"
    )]
    pub torque_scale: Option<f64>,
}

/// Order of the inputs of an actuator network; names are Isaac Lab's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum InputOrder {
    /// Position errors, then velocities.
    PosVel,
    /// Velocities, then position errors.
    VelPos,
}

/// Law by which joint targets become torques.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ActuatorModel {
    /// Proportional-derivative control, clipped at the effort limit.
    IdealPd,
    /// The same as `ideal_pd`; Isaac Lab's name for gains that are integrated implicitly, as all
    /// are here by default.
    ImplicitPd,
    /// Proportional-derivative control, clipped by the torque-speed line of a DC motor.
    DcMotor,
    /// `ideal_pd` on targets that come late.
    DelayedPd,
    /// A perceptron over position errors and velocities of some physics steps.
    ActuatorNetMlp,
    /// A network with LSTM layers over the present position error and velocity.
    ActuatorNetLstm,
}

impl ActuatorModel {
    /// Whether a network file gives the torque.
    #[must_use]
    pub fn is_network(self) -> bool {
        matches!(self, Self::ActuatorNetMlp | Self::ActuatorNetLstm)
    }
}

/// Most rows of an effort table: as fine as 0.1 degrees over a turn and a half.
const MAX_TABLE_ROWS: usize = 5400;
/// Most steps of the grid that an effort table becomes: a megabyte.
const MOST_TABLE_STEPS: u64 = 1 << 18;
/// Least distance of two rows' angles, rad: angles of 10 rad are 1e-6 apart in single precision.
const MIN_TABLE_STEP: f64 = 1e-5;
/// Oldest past input of an actuator network, physics steps.
const MAX_INPUT_AGE: u32 = 100;

/// Links of the URDF by group of bodies; an empty group is left to geometry.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct BodiesConfig {
    /// The trunk and what is fixed to it.
    pub base: Vec<String>,
    /// Links between the base and other limbs.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub torso: Vec<String>,
    /// Links between abduction and flexion joint of the hip.
    pub hip: Vec<String>,
    /// Links between hip and knee.
    pub thigh: Vec<String>,
    /// Links below the knee.
    pub shank: Vec<String>,
    /// Bodies that stand on the ground.
    pub foot: Vec<String>,
    /// Parts of an arm.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub arm: Vec<String>,
    /// Parts of a head.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub head: Vec<String>,
    /// Bodies that belong to none of these, though they are fixed to one: a head on the trunk, say.
    pub other: Vec<String>,
}

impl BodiesConfig {
    /// Whether all groups are left to geometry.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// Limits of the commands that a robot is given, by the command's name.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct CommandLimitsConfig {
    /// A velocity of the base.
    pub base_velocity: VelocityLimitsConfig,
}

impl CommandLimitsConfig {
    /// Whether the task alone decides.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// Limits of velocity commands, base frame. A task draws from the part of its ranges that lies
/// within them.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct VelocityLimitsConfig {
    /// Forward speed, m/s. Default: the task's range.
    #[serde(deserialize_with = "values::optional_command_range", skip_serializing_if = "Option::is_none")]
    pub lin_vel_x: Option<[f64; 2]>,
    /// Speed to the left, m/s. Default: the task's range.
    #[serde(deserialize_with = "values::optional_command_range", skip_serializing_if = "Option::is_none")]
    pub lin_vel_y: Option<[f64; 2]>,
    /// Yaw rate, rad/s. Default: the task's range.
    #[serde(deserialize_with = "values::optional_command_range", skip_serializing_if = "Option::is_none")]
    pub ang_vel_z: Option<[f64; 2]>,
}

/// How an episode begins.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct ResetConfig {
    /// Joint angles. Default: the default pose.
    pub joint_position: JointPositionReset,
    /// Joint velocities, rad/s. Default: 0.
    #[serde(deserialize_with = "range_config::<JointVelocity, _>")]
    pub joint_velocity: RangeConfig,
    /// Each of the six components of the base velocity, world frame, m/s and rad/s. Default: 0.
    #[serde(deserialize_with = "range_config::<BaseVelocity, _>")]
    pub base_velocity: RangeConfig,
    /// Share of each joint's range, about its middle, that resets stay within. Default: 1. A joint
    /// without two limits has no range: resets stay within the limit that it has.
    #[serde(deserialize_with = "values::fraction")]
    pub soft_limit_factor: f64,
    /// Distance between the lowest foot of the default pose and the ground, and the least one of
    /// any collision shape in any pose, m. Default: 0.02.
    #[serde(deserialize_with = "values::number_of::<Rise, _, _>")]
    pub spawn_margin: f64,
}

impl Default for ResetConfig {
    fn default() -> Self {
        Self {
            joint_position: JointPositionReset { mode: JointPositionMode::Offset, range: [0.0, 0.0] },
            joint_velocity: RangeConfig { range: [0.0, 0.0] },
            base_velocity: RangeConfig { range: [0.0, 0.0] },
            soft_limit_factor: 1.0,
            spawn_margin: 0.02,
        }
    }
}

/// Draw of the joint angles of a reset, each joint for itself.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct JointPositionReset {
    /// Operation of the drawn number.
    pub mode: JointPositionMode,
    /// Factor, or angle in rad.
    #[serde(deserialize_with = "values::range_of::<Angle, _, _>")]
    pub range: [f64; 2],
}

/// Operation of a drawn number on a default joint angle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum JointPositionMode {
    /// Multiplies it.
    Scale,
    /// Is added to it.
    Offset,
}

/// A range that is drawn from uniformly.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RangeConfig {
    /// Lower and upper end.
    #[serde(deserialize_with = "values::range")]
    pub range: [f64; 2],
}

/// Reads a [`RangeConfig`] of a quantity.
fn range_config<'de, Q: Quantity, D: Deserializer<'de>>(deserializer: D) -> Result<RangeConfig, D::Error> {
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields, bound = "")]
    struct Within<Q: Quantity> {
        #[serde(deserialize_with = "values::range_of::<Q, _, _>")]
        range: [f64; 2],
        #[serde(skip)]
        quantity: PhantomData<Q>,
    }
    let Within { range, quantity: PhantomData::<Q> } = Within::deserialize(deserializer)?;
    Ok(RangeConfig { range })
}

impl RobotConfig {
    /// The velocity commands that this robot is given: those of `task`, within the robot's limits.
    ///
    /// # Errors
    /// A range of the task has nothing in common with the robot's limits.
    pub fn velocity_commands(&self, task: &VelocityCommandConfig) -> Result<VelocityCommandConfig, ConfigError> {
        let limits = &self.commands.base_velocity;
        let within = |key: &str, range: [f64; 2], limit: Option<[f64; 2]>| {
            let [low, high] = limit.unwrap_or(range);
            let common = [range[0].max(low), range[1].min(high)];
            if common[0] <= common[1] {
                return Ok(common);
            }
            let at = format!("commands.base_velocity.{key}");
            let problem = format!("the task's {range:?} has nothing in common with the robot's {:?}", [low, high]);
            let remedy = format!("change the task's {at}, or robot_overrides.{}.{at}", self.name);
            self.invalid(&at, problem, remedy)
        };
        Ok(VelocityCommandConfig {
            lin_vel_x: within("lin_vel_x", task.lin_vel_x, limits.lin_vel_x)?,
            lin_vel_y: within("lin_vel_y", task.lin_vel_y, limits.lin_vel_y)?,
            ang_vel_z: within("ang_vel_z", task.ang_vel_z, limits.ang_vel_z)?,
            ..task.clone()
        })
    }

    /// Joint angles of the default pose in these slots, canonical directions, rad.
    ///
    /// # Errors
    /// A slot is missing from `[default_pose]`, or another name is in it.
    pub fn default_pose_by_slot(&self, slots: &[Slot]) -> Result<Vec<f64>, ConfigError> {
        let names: Vec<String> = slots.iter().map(Slot::to_string).collect();
        let known: Vec<&str> = names.iter().map(String::as_str).collect();
        self.check_names("default_pose", self.default_pose.keys(), &known)?;
        self.refuse_missing(known.iter().copied())?;
        Ok(known.iter().map(|joint| self.default_pose.get(*joint).copied().unwrap_or(0.0)).collect())
    }

    fn refuse_missing<'a>(&self, wanted: impl Iterator<Item = &'a str>) -> Result<(), ConfigError> {
        let missing: Vec<&str> = wanted.filter(|joint| !self.default_pose.contains_key(*joint)).collect();
        if missing.is_empty() {
            return Ok(());
        }
        let problem = format!("no angle for {}", missing.join(", "));
        self.invalid("default_pose", problem, "add each of them, in rad, or lock the joint in [locked_joints]")
    }

    /// Name and settings of the actuator group that drives the joint in each of these slots.
    ///
    /// # Errors
    /// A joint in no group or in several, or a pattern that matches no joint.
    pub fn actuators_by_slot(&self, slots: &[Slot]) -> Result<Vec<(&str, &ActuatorConfig)>, ConfigError> {
        let names: Vec<String> = slots.iter().map(Slot::to_string).collect();
        self.actuators_by_name(&names.iter().map(String::as_str).collect::<Vec<_>>())
    }

    fn actuators_by_name(&self, joints: &[&str]) -> Result<Vec<(&str, &ActuatorConfig)>, ConfigError> {
        for (group, actuator) in &self.actuators {
            let mut patterns = actuator.joints.iter().enumerate();
            let idle = |pattern: &str| !joints.iter().any(|j| matches(pattern, j));
            if let Some((index, pattern)) = patterns.find(|(_, pattern)| idle(pattern)) {
                return self.invalid(
                    &format!("actuators.{group}.joints[{index}]"),
                    format!("`{pattern}` matches no canonical joint"),
                    did_you_mean(pattern, joints.iter().copied(), "joints"),
                );
            }
        }
        let mut by_slot = Vec::with_capacity(joints.len());
        let mut complaints: Vec<String> = Vec::new();
        for joint in joints {
            let groups: Vec<(&str, &ActuatorConfig)> = self
                .actuators
                .iter()
                .filter(|(_, actuator)| actuator.joints.iter().any(|p| matches(p, joint)))
                .map(|(group, actuator)| (group.as_str(), actuator))
                .collect();
            match groups[..] {
                [group] => by_slot.push(group),
                [] => complaints.push(format!("{joint} is in no group")),
                _ => {
                    let names: Vec<&str> = groups.iter().map(|(group, _)| *group).collect();
                    complaints.push(format!("{joint} is in {}", names.join(" and ")));
                }
            }
        }
        if complaints.is_empty() {
            return Ok(by_slot);
        }
        self.invalid(
            "actuators",
            complaints.join(", "),
            "let the `joints` patterns name every canonical joint in exactly one group",
        )
    }

    /// Checks values against each other; errors name the robot in place of a file. Names of joints
    /// are checked once the URDF is read.
    pub(crate) fn validate(&self) -> Result<(), ConfigError> {
        self.check_slots("default_pose", self.default_pose.keys())?;
        self.refuse_missing(self.corners())?;
        for (group, actuator) in &self.actuators {
            self.validate_actuator(&format!("actuators.{group}"), actuator)?;
        }
        self.validate_surfaces()?;
        let mut slots: Vec<Slot> = self.default_pose.keys().filter_map(|name| Slot::parse(name)).collect();
        slots.sort_unstable();
        self.actuators_by_slot(&slots)?;
        self.check_slots("joint_roles", self.joint_roles.keys())?;
        self.check_slots("joint_limits", self.joint_limits.keys())?;
        for (joint, [lower, upper]) in &self.joint_limits {
            if lower >= upper {
                let problem = format!("the lowest position {lower} is not below the highest {upper}");
                return self.invalid(&format!("joint_limits.{joint}"), problem, "write [lowest, highest], rad or m");
            }
        }
        let legs = Place::ALL.into_iter().filter(|place| place.side() != Side::Middle).map(Place::name);
        self.check_names("feet", self.feet.keys(), &legs.collect::<Vec<_>>())
    }

    /// Joints that one leg of a quadruped has and every leg must have.
    fn corners(&self) -> impl Iterator<Item = &'static str> {
        let roles = crate::robot::ROLES.into_iter().filter(|role| {
            let mut corners = CANONICAL_JOINT_NAMES.into_iter().filter(|joint| joint.ends_with(role));
            corners.any(|joint| self.default_pose.contains_key(joint))
        });
        roles.flat_map(|role| CANONICAL_JOINT_NAMES.into_iter().filter(move |joint| joint.ends_with(role)))
    }

    /// Every key of the table `element` must be the name of a slot.
    fn check_slots<'a>(&self, element: &str, mut keys: impl Iterator<Item = &'a String>) -> Result<(), ConfigError> {
        match keys.find(|key| Slot::parse(key).is_none()) {
            Some(stranger) => self.refuse_name(element, stranger, &CANONICAL_JOINT_NAMES),
            None => Ok(()),
        }
    }

    fn validate_actuator(&self, at: &str, actuator: &ActuatorConfig) -> Result<(), ConfigError> {
        self.validate_network(at, actuator)?;
        let is_dc_motor = actuator.model == ActuatorModel::DcMotor
            || (actuator.model.is_network() && actuator.saturation_effort.is_some());
        let missing: Vec<&str> =
            [("saturation_effort", actuator.saturation_effort), ("velocity_limit", actuator.velocity_limit)]
                .into_iter()
                .filter_map(|(key, value)| value.is_none().then_some(key))
                .collect();
        if is_dc_motor && !missing.is_empty() {
            let missing = missing.join(" and ");
            let problem = format!("model {} needs {missing}", named(actuator.model));
            return self.invalid(at, problem, format!("add {missing}"));
        }
        if !is_dc_motor && actuator.saturation_effort.is_some() {
            return self.invalid(
                &format!("{at}.saturation_effort"),
                "only model \"dc_motor\" has a torque at standstill".into(),
                "remove it, or set model = \"dc_motor\"",
            );
        }
        let [fewest, most] = actuator.delay;
        if fewest > most {
            let problem = format!("the lower end {fewest} is above the upper end {most}");
            return self.invalid(&format!("{at}.delay"), problem, "write [fewest, most]");
        }
        if most > MAX_DELAY {
            let problem = format!("{most} physics steps are too many");
            return self.invalid(&format!("{at}.delay"), problem, format!("write at most {MAX_DELAY}"));
        }
        if most > 0 && actuator.model != ActuatorModel::DelayedPd {
            return self.invalid(
                &format!("{at}.delay"),
                "only model \"delayed_pd\" delays its targets".into(),
                "remove it, or set model = \"delayed_pd\"",
            );
        }
        if actuator.spring_stiffness == 0.0 && actuator.spring_reference != 0.0 {
            let problem = "a joint without a spring has no angle at which it is at rest".to_owned();
            return self.invalid(&format!("{at}.spring_reference"), problem, "add `spring_stiffness`, or remove it");
        }
        self.validate_effort_table(&format!("{at}.effort_table"), &actuator.effort_table)
    }

    fn validate_effort_table(&self, at: &str, rows: &[[f64; 2]]) -> Result<(), ConfigError> {
        if rows.len() > MAX_TABLE_ROWS {
            let problem = format!("has {} rows", rows.len());
            return self.invalid(at, problem, format!("write at most {MAX_TABLE_ROWS}"));
        }
        for (index, &[angle, torque]) in rows.iter().enumerate() {
            let element = format!("{at}[{index}]");
            if torque < 0.0 {
                let problem = format!("the torque {} is negative", Shown(torque));
                return self.invalid(&element, problem, "write its magnitude, in N m");
            }
            if torque > Friction::MOST {
                let problem = format!("the torque {} is beyond {} N m", Shown(torque), Shown(Friction::MOST));
                return self.invalid(&element, problem, "write it in N m");
            }
            if !(Angle::LEAST..=Angle::MOST).contains(&angle) {
                let problem = format!("the angle {} is beyond {} rad", Shown(angle), Angle::MOST);
                return self.invalid(&element, problem, "write it in rad");
            }
            let Some([before, _]) = index.checked_sub(1).and_then(|i| rows.get(i)) else {
                continue;
            };
            if *before >= angle {
                let problem = format!("the angle {angle} is not above the row before");
                return self.invalid(&element, problem, "sort the rows by angle, each angle once");
            }
            if angle - before < MIN_TABLE_STEP || *before as f32 >= angle as f32 {
                let problem = format!("the angle {angle} is less than {MIN_TABLE_STEP:e} rad above the row before");
                return self.invalid(&element, problem, "leave one of the two rows out, or move them apart");
            }
        }
        if !rows.is_empty() && table_steps(rows).is_none() {
            let problem = format!("its angles lie on no grid of at most {MOST_TABLE_STEPS} steps");
            return self.invalid(at, problem, "round them to 0.0001 rad, or leave out rows that are close together");
        }
        if !rows.is_empty() && rows.iter().all(|row| row[1] == 0.0) {
            let problem = "every torque of it is 0, so that the joint cannot be driven".to_owned();
            return self.invalid(at, problem, "write torques above 0, in N m");
        }
        Ok(())
    }

    /// Checks the gains and the network that a model needs.
    fn validate_network(&self, at: &str, actuator: &ActuatorConfig) -> Result<(), ConfigError> {
        let model = actuator.model;
        let missing = |keys: &[(&str, bool)]| -> Vec<String> {
            keys.iter().filter(|(_, is_there)| !is_there).map(|(key, _)| format!("`{key}`")).collect()
        };
        if !model.is_network() {
            let gains = [("stiffness", actuator.stiffness.is_some()), ("damping", actuator.damping.is_some())];
            if let Some(key) = missing(&gains).first() {
                return self.invalid(at, format!("key {key} is missing"), format!("add {key}"));
            }
        }
        let scales = [
            ("input_order", actuator.input_order.is_some()),
            ("input_idx", actuator.input_idx.is_some()),
            ("pos_scale", actuator.pos_scale.is_some()),
            ("vel_scale", actuator.vel_scale.is_some()),
            ("torque_scale", actuator.torque_scale.is_some()),
        ];
        let of_files = [("network_file", actuator.network_file.is_some())];
        let of_sums = [("network_checksum", actuator.network_checksum.is_some())];
        let (needed, allowed): (Vec<_>, Vec<_>) = match model {
            ActuatorModel::ActuatorNetMlp => ([&of_files[..], &scales].concat(), of_sums.to_vec()),
            ActuatorModel::ActuatorNetLstm => (of_files.to_vec(), of_sums.to_vec()),
            _ => (Vec::new(), Vec::new()),
        };
        let missing = missing(&needed);
        if !missing.is_empty() {
            let missing = missing.join(", ");
            let problem = format!("model {} needs {missing}", named(model));
            return self.invalid(at, problem, format!("add {missing}, as the network was trained"));
        }
        let known: Vec<&str> = needed.iter().chain(&allowed).map(|(key, _)| *key).collect();
        let given = of_files.iter().chain(&of_sums).chain(&scales).filter(|(_, is_there)| *is_there);
        if let Some((key, _)) = given.into_iter().find(|(key, _)| !known.contains(key)) {
            let problem = format!("model {} does not have it", named(model));
            let remedy = "remove it, or set model = \"actuator_net_mlp\"";
            return self.invalid(&format!("{at}.{key}"), problem, remedy);
        }
        let ages = actuator.input_idx.as_deref();
        if ages.is_some_and(<[u32]>::is_empty) {
            let problem = "is empty, so that the network has no input".into();
            return self.invalid(&format!("{at}.input_idx"), problem, "write [0] for the present alone");
        }
        if let Some(age) = ages.into_iter().flatten().find(|&&age| age > MAX_INPUT_AGE) {
            let problem = format!("{age} physics steps ago is too long ago");
            return self.invalid(&format!("{at}.input_idx"), problem, format!("write at most {MAX_INPUT_AGE}"));
        }
        if ages.is_some_and(|ages| ages.len() > MAX_INPUT_AGE as usize + 1) {
            let problem = "has too many entries".into();
            let remedy = format!("write at most {}", MAX_INPUT_AGE + 1);
            return self.invalid(&format!("{at}.input_idx"), problem, remedy);
        }
        Ok(())
    }

    /// Every key of the table `element` must be one of `known`.
    fn check_names<'a>(
        &self,
        element: &str,
        mut keys: impl Iterator<Item = &'a String>,
        known: &[&str],
    ) -> Result<(), ConfigError> {
        match keys.find(|key| !known.contains(&key.as_str())) {
            Some(stranger) => self.refuse_name(element, stranger, known),
            None => Ok(()),
        }
    }

    fn refuse_name(&self, element: &str, stranger: &str, known: &[&str]) -> Result<(), ConfigError> {
        let remedy = did_you_mean(stranger, known.iter().copied(), "names");
        self.invalid(&format!("{element}.{stranger}"), format!("unknown key `{stranger}`"), remedy)
            .map_err(|error| error.of_kind(ConfigErrorKind::UnknownKey))
    }

    fn invalid<T>(&self, element: &str, problem: String, remedy: impl Into<String>) -> Result<T, ConfigError> {
        Err(ConfigError::invalid(self.name.clone(), element, problem, remedy))
    }
}

/// A model as a config writes it.
fn named(model: ActuatorModel) -> String {
    let name = match model {
        ActuatorModel::IdealPd => "ideal_pd",
        ActuatorModel::ImplicitPd => "implicit_pd",
        ActuatorModel::DcMotor => "dc_motor",
        ActuatorModel::DelayedPd => "delayed_pd",
        ActuatorModel::ActuatorNetMlp => "actuator_net_mlp",
        ActuatorModel::ActuatorNetLstm => "actuator_net_lstm",
    };
    format!("\"{name}\"")
}

/// Steps of the coarsest equally spaced grid that holds the angles of an effort table, each rounded
/// as little as the grid's size allows: to 1e-6 rad, which most files do themselves, to 1e-5 or to
/// 1e-4. None where the grid would be too large.
pub(crate) fn table_steps(rows: &[[f64; 2]]) -> Option<u64> {
    let divisor = |mut a: u64, mut b: u64| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let steps = |resolution: f64| {
        let mut gaps = Vec::with_capacity(rows.len());
        for pair in rows.windows(2) {
            let [low, high] = [pair[0][0], pair[1][0]].map(|angle| (angle / resolution).round());
            gaps.push((high - low).max(0.0) as u64);
        }
        let step = gaps.iter().copied().reduce(divisor).unwrap_or(1);
        let count = gaps.iter().sum::<u64>() / step.max(1);
        (!gaps.contains(&0) && count <= MOST_TABLE_STEPS).then_some(count.max(1))
    };
    [1e-6, 1e-5, 1e-4].into_iter().find_map(steps)
}

/// Whether `pattern`, in which `*` stands for any run of characters, is all of `name`.
pub(crate) fn matches(pattern: &str, name: &str) -> bool {
    match pattern.split_once('*') {
        None => pattern == name,
        Some((before, after)) => name.strip_prefix(before).is_some_and(|rest| {
            rest.char_indices().map(|(at, _)| &rest[at..]).chain([""]).any(|tail| matches(after, tail))
        }),
    }
}

/// Key, problem and remedy of a pattern that matches the name of no joint that any robot could
/// have.
pub(crate) fn check_pattern(element: &str, pattern: &str) -> Result<(), (String, String, String)> {
    let slots = || {
        let of = |place: Place| Role::ALL.into_iter().map(move |role| Slot::new(place, role).to_string());
        Place::ALL.into_iter().flat_map(of).filter(|name| Slot::parse(name).is_some())
    };
    let numbered = |name: String| (1..10).map(move |n| if n == 1 { name.clone() } else { format!("{name}_{n}") });
    if slots().flat_map(numbered).any(|name| matches(pattern, &name)) {
        return Ok(());
    }
    let roles = Role::ALL.map(Role::name).join(", ");
    let places = Place::ALL.map(Place::name).join(", ");
    let remedy =
        format!("joints are named PLACE_ROLE, `*` stands for any run of letters; places: {places}; roles: {roles}");
    Err((element.to_owned(), format!("`{pattern}` matches the name of no joint"), remedy))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_star_stands_for_any_run() {
        assert!(matches("*_HAA", "LF_HAA"));
        assert!(matches("LF_*", "LF_HAA"));
        assert!(matches("*", "LF_HAA"));
        assert!(matches("L*_*AA", "LF_HAA"));
        assert!(!matches("*_HAA", "LF_HFE"));
        assert!(!matches("LF_HA", "LF_HAA"));
    }
}
