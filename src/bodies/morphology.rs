//! Morphologies: a URDF and a config brought together, ready for the engine and the task.

use std::collections::BTreeMap;
use std::path::PathBuf;

use bevy_ecs::prelude::Resource;
use glam::{DMat3, DVec3};

use crate::actuator_network::{NetworkKind, read_onnx};
use crate::agreement;
use crate::components::Stance;
use crate::config::{ActuatorConfig, ActuatorModel, ConfigError, InputOrder, LoadedRobot, RobotConfig, table_steps};
use crate::dynamics::math::Spatial;
use crate::dynamics::{
    ActuatorNetwork, ContactFriction, ContactKind, ContactSettings, Drive, EffortTable, JointTopology, NetworkInput,
    NetworkStep, Parameters, Scalar, State, StepSettings, Topology, Workspace,
};
use crate::error::Error;
use crate::robot::{self, Articulation, BodyGroup, FASTEST, Joint, LimbKind, Model, Place, Pose, Roles, Site, Slot};

/// Normal of level ground.
pub(crate) const UP: [f64; 3] = [0.0, 0.0, 1.0];

/// A morphology: the description and the config of a robot.
#[derive(Clone, Debug)]
pub struct MorphologyModel {
    /// Resolved config of the robot.
    pub config: RobotConfig,
    /// The merged articulation, in the URDF's frames.
    pub model: Model,
    /// Roles of the joints.
    pub roles: Roles,
    /// Topology that all robots of the morphology share.
    pub topology: Topology,
    /// Turns a link's URDF axes into those of the engine, `[links]`.
    pub align: Vec<DMat3>,
    /// Collision shapes that may touch each other, counted body after body.
    pub shape_pairs: Vec<[usize; 2]>,
    /// Parameters before any randomisation.
    pub nominal: Parameters<f32>,
    /// The joints of a quadruped's legs, `[role][leg]` in the order of [`ROLES`](robot::ROLES) and
    /// [`LEGS`](robot::LEGS), if it has them all.
    pub quadruped: Option<QuadrupedJoints>,
    /// The slots that the policy drives, in order: the joints of its actions and per-joint
    /// observations. All others of [`roles`](Self::roles) hold their default pose.
    pub slots: Vec<SlotJoint>,
    /// Stance of a robot with the body of the URDF.
    pub stance: Stance,
    /// Group of each contact body.
    pub body_groups: Vec<BodyGroup>,
    /// Contact bodies that are feet, in the order of [`Roles::legs`].
    pub feet: Vec<usize>,
    /// Height of the hips above the base's frame in the default pose, m.
    pub hip_height: f32,
    /// Centres of the feet in the default pose, base axes about the base's origin, m.
    pub default_feet: Vec<[f32; 3]>,
    /// Column of each foot in the batch.
    pub foot_columns: Vec<usize>,
    /// Networks that drive joints, in the order of their groups' names.
    pub networks: Vec<ActuatorNetwork>,
    /// Fewest and most physics steps of delay of each actuator group, with its joints (physical).
    pub delays: Vec<([u32; 2], Vec<usize>)>,
    /// The most physics steps by which events of the task delay targets on top of that.
    pub max_action_delay: u32,
}

/// Physical joints of a quadruped's legs, `[role][leg]`.
pub type QuadrupedJoints = [[usize; robot::LEGS.len()]; robot::ROLES.len()];

/// A slot of a robot: its joint, and its place in the batch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlotJoint {
    /// Column of the batch's actions and per-joint observations.
    column: u32,
    /// Physical joint.
    joint: u32,
    /// 1, or -1 where the URDF's axis is turned round: the canonical position is `sign` times the
    /// physical one.
    pub sign: f32,
    /// Slot that the joint fills.
    pub slot: Slot,
}

impl SlotJoint {
    /// Column of the batch's actions and per-joint observations.
    #[inline(always)]
    pub fn column(&self) -> usize {
        self.column as usize
    }

    /// Physical joint.
    #[inline(always)]
    pub fn joint(&self) -> usize {
        self.joint as usize
    }
}

/// All morphologies of a simulation, in the order of their env blocks.
#[derive(Resource, Clone, Debug)]
pub struct Morphologies(pub Vec<MorphologyModel>, pub BatchSlots);

/// The columns of a batch: the union of its robots' slots and feet.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BatchSlots {
    /// Slots of the actions and of per-joint observations, in order.
    pub joints: Vec<Slot>,
    /// Legs whose feet are columns of per-foot arrays, in order.
    pub feet: Vec<Place>,
}

impl BatchSlots {
    /// Names of the actions' columns.
    pub fn joint_names(&self) -> Vec<String> {
        self.joints.iter().map(Slot::to_string).collect()
    }

    /// Names of the feet's columns.
    pub fn feet_names(&self) -> Vec<&'static str> {
        self.feet.iter().map(|place| place.name()).collect()
    }
}

impl Morphologies {
    /// Makes the morphologies of a batch, whose columns are the slots that a policy drives in any
    /// of them, and `more`.
    pub fn in_batch(mut models: Vec<MorphologyModel>, more: &[Slot]) -> Self {
        let mut columns = BatchSlots { joints: more.to_vec(), feet: Vec::new() };
        for model in &models {
            columns.joints.extend(model.slots.iter().map(|own| own.slot));
            columns.feet.extend(&model.roles.legs);
        }
        columns.joints.sort_unstable();
        columns.joints.dedup();
        columns.feet.sort_unstable();
        columns.feet.dedup();
        for model in &mut models {
            model.place_in(&columns);
        }
        Self(models, columns)
    }

    /// The morphology of a tag.
    pub fn get(&self, tag: crate::components::Morphology) -> &MorphologyModel {
        &self.0[usize::from(tag.0)]
    }
}

impl MorphologyModel {
    /// Reads the URDF, finds the joints' roles and applies the config.
    ///
    /// # Errors
    /// An error in the URDF or the config, with file, element and remedy.
    pub fn new(loaded: &LoadedRobot) -> Result<Self, Error> {
        let config = loaded.config.clone();
        let ConfiguredRobot { model, roles, articulation, networks, default_position } =
            ConfiguredRobot::new(loaded, &robot::LoadOptions::default(), true, None)?;
        let body_groups = body_groups(&config, &model, &roles)?;
        let Articulation { mut topology, parameters, align, shape_pairs } = articulation;
        let actuators = config.actuators_by_slot(&roles.slots)?;
        topology.has_delay = actuators.iter().any(|(_, a)| a.model == ActuatorModel::DelayedPd && a.delay[1] > 0);
        let nominal = Parameters::from_scalars(&topology, &parameters);
        let lowest = lowest_point(&topology, &parameters, &default_position, &UP);
        let links = model.forward_kinematics(&default_position);
        let hip_height = hip_height(&links, &roles);
        let feet = roles.foot_body.iter().zip(&roles.foot_point);
        let feet = feet.map(|(&body, &point)| links[model.bodies[body].link].transform_point(point));
        let default_feet = feet.map(|place| place.to_array().map(|x| x as f32)).collect();
        let mut delays: BTreeMap<&str, ([u32; 2], Vec<usize>)> = BTreeMap::new();
        for (slot, (group, actuator)) in actuators.iter().enumerate() {
            if actuator.delay[1] > 0 {
                delays.entry(group).or_insert((actuator.delay, Vec::new())).1.push(roles.joint_of_slot[slot]);
            }
        }
        let delays = delays.into_values().collect();
        let slots = roles.slots.iter().zip(&roles.joint_of_slot).zip(&roles.sign_of_slot).enumerate();
        let slots = slots.map(|(column, ((&slot, &joint), &sign))| SlotJoint {
            column: column as u32,
            joint: joint as u32,
            sign: sign as f32,
            slot,
        });
        Ok(Self {
            quadruped: Self::quadruped_joints(&roles),
            slots: slots.collect(),
            foot_columns: (0..roles.foot_body.len()).collect(),
            stance: Stance {
                default_position: default_position.iter().map(|&q| q as f32).collect(),
                action_scale: config.action_scale as f32,
                spawn_height: (config.reset.spawn_margin - lowest) as f32,
            },
            body_groups,
            feet: roles.foot_body.clone(),
            hip_height: hip_height as f32,
            default_feet,
            networks,
            delays,
            max_action_delay: 0,
            topology,
            align,
            shape_pairs,
            nominal,
            roles,
            model,
            config,
        })
    }

    /// The robot's name in configs.
    pub fn name(&self) -> &str {
        &self.config.name
    }

    /// Height of the base above level ground in the default pose, m.
    pub fn default_height(&self) -> f32 {
        self.stance.spawn_height - self.config.reset.spawn_margin as f32
    }

    /// Height of the hips above level ground in the default pose, m.
    pub fn default_hip_height(&self) -> f32 {
        self.default_height() + self.hip_height
    }

    /// Length by which `scale_by = "leg_length"` scales terrain: the height of the hips above level
    /// ground in the default pose, m.
    pub fn leg_length(&self) -> f64 {
        f64::from(self.default_hip_height())
    }

    /// Largest delay of any target, physics steps.
    pub fn max_delay(&self) -> u32 {
        self.delays.iter().map(|(range, _)| range[1]).max().unwrap_or(0) + self.max_action_delay
    }

    /// Height at which a robot stands whose base is at `height` in the default pose, m: that of its
    /// base, or of its hips where the frame of the base lies below half their height and says
    /// little.
    #[inline(always)]
    pub fn standing_height(&self, height: f32) -> f32 {
        let hips = height + self.hip_height;
        if height >= 0.5 * hips { height } else { hips }
    }

    /// Height of the base above the ground, m, at which a robot has sunk to `share` of its height
    /// in the default pose, in which the base is at `height`.
    ///
    /// A frame of the base below half the height of the hips says little of how the robot stands:
    /// then the height of the hips above the ground counts.
    pub fn least_height(&self, share: f32, height: f32) -> f32 {
        let hips = height + self.hip_height;
        if height >= 0.5 * hips { share * height } else { height - (1.0 - share) * hips }
    }

    /// Lets events of the task delay targets by up to this many physics steps on top of the
    /// actuators' own delays.
    pub(crate) fn allow_action_delay(&mut self, most: u32) {
        self.max_action_delay = most;
        self.topology.has_delay |= most > 0;
    }

    /// Lets the policy drive the joints of some slots alone. All others hold their default pose and
    /// have no columns.
    pub(crate) fn drive_only(&mut self, is_driven: impl Fn(&Slot) -> bool) {
        self.slots.retain(|own| is_driven(&own.slot));
    }

    /// Enables kinds of friction with the ground beyond sliding, in addition to those of the
    /// robot's surfaces.
    pub(crate) fn allow_friction(&mut self, friction: ContactFriction) {
        self.topology.friction = friction.max(self.topology.friction);
    }

    /// Names of the driven slots' joints in the URDF.
    pub fn joint_names_by_slot(&self) -> Vec<&str> {
        self.slots.iter().map(|slot| self.model.joints[slot.joint()].name.as_str()).collect()
    }

    /// Sign of the slot of a physical joint, driven or not; 1 for a joint without one.
    pub fn sign_of(&self, joint: usize) -> f32 {
        let at = self.roles.joint_of_slot.iter().position(|own| *own == joint);
        at.map_or(1.0, |at| self.roles.sign_of_slot[at] as f32)
    }

    /// Canonical position at which a leg hangs straight at this slot, rad; 0 elsewhere.
    pub(crate) fn zero_of(&self, slot: &SlotJoint) -> f64 {
        self.roles.slots.binary_search(&slot.slot).map_or(0.0, |at| self.roles.zero_of_slot[at])
    }

    /// Physical joint of each driven slot.
    pub fn joint_of_slot(&self) -> Vec<usize> {
        self.slots.iter().map(|slot| slot.joint()).collect()
    }

    /// Whether the policy drives a joint of the robot in each of `columns`.
    pub fn action_mask(&self, columns: usize) -> Vec<bool> {
        let mut mask = vec![false; columns];
        self.slots.iter().for_each(|slot| mask[slot.column()] = true);
        mask
    }

    fn quadruped_joints(roles: &Roles) -> Option<QuadrupedJoints> {
        let mut joints = [[0; robot::LEGS.len()]; robot::ROLES.len()];
        for (at, name) in robot::CANONICAL_JOINT_NAMES.into_iter().enumerate() {
            joints[at / robot::LEGS.len()][at % robot::LEGS.len()] = roles.joint(Slot::parse(name)?)?;
        }
        Some(joints)
    }

    /// Sets its columns in a batch.
    fn place_in(&mut self, batch: &BatchSlots) {
        let column_of = |slot: &Slot| batch.joints.binary_search(slot).unwrap_or(0) as u32;
        self.slots.iter_mut().for_each(|slot| slot.column = column_of(&slot.slot));
        let foot_column = |leg: &Place| batch.feet.binary_search(leg).unwrap_or(0);
        self.foot_columns = self.roles.legs.iter().map(foot_column).collect();
    }
}

/// A robot of the library with all that physics needs: its URDF with the actuators of its config.
pub(crate) struct ConfiguredRobot {
    pub(crate) model: Model,
    pub(crate) roles: Roles,
    /// Topology and numbers, with the feet as sites, in the order of [`Roles::legs`].
    pub(crate) articulation: Articulation,
    /// See [`MorphologyModel::networks`].
    pub(crate) networks: Vec<ActuatorNetwork>,
    /// Joint positions of the default pose, physical order, rad.
    pub(crate) default_position: Vec<f64>,
}

impl ConfiguredRobot {
    /// Reads the URDF, finds the joints' roles and applies the config. `more` comes on top of the
    /// config's package folders and locked joints; `floating`, or with the base fixed to the world.
    /// Without `self_collision` the config says whether links collide.
    ///
    /// # Errors
    /// An error in the URDF or the config, with file, element and remedy.
    pub(crate) fn new(
        loaded: &LoadedRobot,
        more: &robot::LoadOptions,
        floating: bool,
        self_collision: Option<bool>,
    ) -> Result<Self, Error> {
        let config = &loaded.config;
        let mut options = more.clone();
        for (package, folder) in &config.package_dirs {
            options.package_dirs.entry(package.clone()).or_insert_with(|| folder.clone());
        }
        for (joint, position) in &config.locked_joints {
            options.locked_joints.entry(joint.clone()).or_insert(*position);
        }
        let mut model = robot::load_str(&loaded.urdf_text, &loaded.urdf_path, &options)?;
        let names: Vec<&str> = model.bodies.iter().map(|body| body.name.as_str()).collect();
        let surfaces = config.surfaces_of(&names)?;
        model.bodies.iter_mut().zip(surfaces).for_each(|(body, surface)| body.surface = surface);
        let roles = robot::detect(&model, &config.joint_roles, &config.feet)
            .map_err(|error| robot::naming_causes(error, &model))?;
        agreement::narrow_limits(loaded, &mut model, &roles)?;
        let unequal = robot::unequal_sides(&model, &roles);
        model.warnings.extend(unequal);
        let default_pose = config.default_pose_by_slot(&roles.slots)?;
        agreement::check(loaded, &model, &roles, &default_pose)?;
        let actuators = config.actuators_by_slot(&roles.slots)?;
        let mut default_position = vec![0.0; model.joints.len()];
        for (slot, &joint) in roles.joint_of_slot.iter().enumerate() {
            // a negative zero becomes zero
            default_position[joint] = roles.sign_of_slot[slot] * default_pose[slot] + 0.0;
        }
        let feet = roles.foot_body.iter().zip(&roles.foot_point);
        let sites: Vec<Site> =
            feet.map(|(&body, &position)| Site { link: model.bodies[body].link, position }).collect();
        let reference = self_collision.unwrap_or(config.self_collisions).then_some(&default_position[..]);
        let mut articulation = Articulation::new(&model, floating, &sites, reference);
        if actuators.iter().any(|(_, actuator)| actuator.spring_stiffness > 0.0) {
            articulation.topology.has_springs = true;
            articulation.parameters.spring = vec![[0.0; 2]; model.joints.len()].into();
        }
        for (slot, &j) in roles.joint_of_slot.iter().enumerate() {
            let is_turned = roles.sign_of_slot[slot] < 0.0;
            let joint = &mut articulation.topology.joints[j];
            apply_actuator(joint, &mut articulation.parameters, j, &model.joints[j], actuators[slot].1, is_turned);
        }
        let networks = networks(loaded, &actuators, &roles)?;
        Ok(Self { model, roles, articulation, networks, default_position })
    }
}

/// The networks of a robot's actuator groups; `actuators` are those of its slots.
fn networks(
    loaded: &LoadedRobot,
    actuators: &[(&str, &ActuatorConfig)],
    roles: &Roles,
) -> Result<Vec<ActuatorNetwork>, Error> {
    let mut networks = Vec::new();
    for (group, config) in loaded.config.actuators.iter().filter(|(_, config)| config.model.is_network()) {
        let element = format!("actuators.{group}");
        let Some(file) = loaded.networks.get(group) else {
            let problem = "has no file of its network";
            return Err(
                ConfigError::invalid(loaded.config.name.clone(), element, problem, "name a network_file").into()
            );
        };
        let kind = match config.model {
            ActuatorModel::ActuatorNetLstm => NetworkKind::Lstm,
            _ => NetworkKind::Perceptron,
        };
        let inputs = network_inputs(config);
        let program = read_onnx(&file.bytes, inputs.len(), kind).map_err(|error| {
            ConfigError::invalid(
                file.path.display().to_string(),
                error.element,
                format!("{} (network of {element} of {})", error.problem, loaded.config.name),
                error.remedy,
            )
        })?;
        let of_group = actuators.iter().zip(&roles.joint_of_slot).filter(|((name, _), _)| name == group);
        let mut joints: Vec<usize> = of_group.map(|(_, &joint)| joint).collect();
        joints.sort_unstable();
        let scale = config.torque_scale.unwrap_or(1.0) as f32;
        // never fails: the program was read for these inputs
        networks.extend(ActuatorNetwork::new(joints, inputs, scale, program));
    }
    Ok(networks)
}

/// Inputs of a network, in order.
fn network_inputs(config: &ActuatorConfig) -> Vec<NetworkInput> {
    let ages = config.input_idx.as_deref().unwrap_or(&[0]);
    let of = |is_velocity: bool| {
        let scale = if is_velocity { config.vel_scale } else { config.pos_scale };
        let scale = scale.unwrap_or(1.0) as f32;
        ages.iter().map(move |&age| NetworkInput { is_velocity, age: age as usize, scale })
    };
    match config.input_order.unwrap_or(InputOrder::PosVel) {
        InputOrder::PosVel => of(false).chain(of(true)).collect(),
        InputOrder::VelPos => of(true).chain(of(false)).collect(),
    }
}

fn body_groups(config: &RobotConfig, model: &Model, roles: &Roles) -> Result<Vec<BodyGroup>, Error> {
    let mut groups = robot::body_groups(model, roles);
    let named = [
        (&config.bodies.base, BodyGroup::Base, "bodies.base"),
        (&config.bodies.torso, BodyGroup::Torso, "bodies.torso"),
        (&config.bodies.hip, BodyGroup::Hip, "bodies.hip"),
        (&config.bodies.thigh, BodyGroup::Thigh, "bodies.thigh"),
        (&config.bodies.shank, BodyGroup::Shank, "bodies.shank"),
        (&config.bodies.foot, BodyGroup::Foot, "bodies.foot"),
        (&config.bodies.arm, BodyGroup::Arm, "bodies.arm"),
        (&config.bodies.head, BodyGroup::Head, "bodies.head"),
        (&config.bodies.other, BodyGroup::Other, "bodies.other"),
    ];
    for (names, group, element) in named {
        for name in names {
            let Some(index) = model.bodies.iter().position(|body| body.name == *name) else {
                let known: Vec<&str> = model.bodies.iter().map(|body| body.name.as_str()).collect();
                return Err(ConfigError::invalid(
                    config.name.clone(),
                    element,
                    format!("`{name}` is no link with a collision shape"),
                    format!("use one of {}", known.join(", ")),
                )
                .into());
            };
            groups[index] = group;
        }
    }
    Ok(groups)
}

/// Gives joint `j`, whose axis `is_turned` round or not, the actuator of a config, but for its
/// delay. Limits of effort and speed that the config leaves out are those of the URDF's joint.
fn apply_actuator(
    joint: &mut JointTopology,
    p: &mut Parameters<f64>,
    j: usize,
    in_urdf: &Joint,
    actuator: &ActuatorConfig,
    is_turned: bool,
) {
    joint.effort_table = if is_turned {
        let turned: Vec<[f64; 2]> =
            actuator.effort_table.iter().rev().map(|[angle, torque]| [-angle, *torque]).collect();
        effort_table(&turned)
    } else {
        effort_table(&actuator.effort_table)
    };
    // a network's torque is that of the beginning of a physics step, and has no gains
    let is_network = actuator.model.is_network();
    joint.explicit = actuator.explicit || is_network;
    p.stiffness[j] = actuator.stiffness.filter(|_| !is_network).unwrap_or(0.0);
    p.damping[j] = actuator.damping.filter(|_| !is_network).unwrap_or(0.0);
    p.armature[j] = actuator.armature;
    // a table holds the limits itself: the factor scales it
    p.effort_limit[j] = match (actuator.effort_limit, actuator.effort_table.is_empty()) {
        (_, false) => 1.0,
        (Some(limit), true) => limit,
        (None, true) => in_urdf.effort,
    };
    if let Some(friction) = actuator.friction {
        p.joint_friction[j] = friction;
    }
    if let Some(damping) = actuator.joint_damping {
        p.joint_damping[j] = damping;
    }
    if let Some(spring) = p.spring.get_mut(j) {
        // without a negative zero
        let rest = if is_turned { -actuator.spring_reference } else { actuator.spring_reference };
        *spring = [actuator.spring_stiffness, rest + 0.0];
    }
    // files that know no speed write 0
    let in_urdf = if in_urdf.velocity > 0.0 { in_urdf.velocity.min(FASTEST) } else { FASTEST };
    let limit = actuator.velocity_limit.unwrap_or(in_urdf);
    if let Some(stall) = actuator.saturation_effort {
        p.saturation_effort[j] = stall;
        p.motor_velocity_limit[j] = limit;
    } else {
        p.velocity_limit[j] = limit;
    }
}

/// A table of effort limits on an equally spaced grid that holds its rows.
fn effort_table(rows: &[[f64; 2]]) -> Option<EffortTable> {
    let (first, last) = (rows.first()?, rows.last()?);
    // a config's table has a grid
    let steps = table_steps(rows)? as f64;
    let step = ((last[0] - first[0]) / steps).max(1e-9);
    let limits = (0..=steps as usize).map(|i| interpolate(rows, first[0] + step * i as f64) as f32).collect();
    Some(EffortTable { start: first[0] as f32, inverse_step: (1.0 / step) as f32, limits })
}

fn interpolate(rows: &[[f64; 2]], x: f64) -> f64 {
    let after = rows.partition_point(|row| row[0] <= x);
    match (after.checked_sub(1).and_then(|i| rows.get(i)), rows.get(after)) {
        (Some(a), Some(b)) => a[1] + (b[1] - a[1]) * (x - a[0]) / (b[0] - a[0]),
        (Some(end), None) | (None, Some(end)) => end[1],
        (None, None) => 0.0,
    }
}

/// Mean height of the first joints of the legs above the frame of the base, m, with links at these
/// poses.
pub(crate) fn hip_height(links: &[Pose], roles: &Roles) -> f64 {
    let legs = roles.limbs.iter().filter(|limb| limb.kind == LimbKind::Leg);
    let hips: Vec<f64> =
        legs.filter_map(|leg| leg.joints.first()).map(|hip| links[hip.joint + 1].translation.z).collect();
    hips.iter().sum::<f64>() / hips.len().max(1) as f64
}

/// Height of the lowest point of a robot's collision shapes above the plane with this unit normal
/// through its base's origin, m. The base is level, the joints have these positions. Negative below
/// the plane, 0 without shapes.
///
/// Points, rims of cylinders and balls are those that the engine pushes out of the ground. A robot
/// that is set down by this height touches the ground and is not in it.
pub(crate) fn lowest_point(
    topology: &Topology,
    parameters: &Parameters<f64>,
    position: &[f64],
    normal: &[f64; 3],
) -> f64 {
    let normal = DVec3::from_array(*normal);
    let mut work = Workspace::new(topology);
    let (rest, base) = (vec![0.0; topology.num_joints()], Spatial::zero());
    f64::forward_kinematics(topology, parameters, position, &rest, &base, &mut work);
    let heights = topology.contacts.iter().enumerate().map(|(c, contact)| {
        let link = &work.links[contact.link];
        let axes = DMat3::from_cols_array_2d(&link.rotation).transpose();
        let up = axes.transpose() * normal;
        let rim = match contact.kind {
            ContactKind::Point => 0.0,
            ContactKind::Rim { across, .. } => {
                let [a, b] = across.map(|u| DVec3::from_array(u).dot(up));
                parameters.contact_rim[c] * a.hypot(b)
            }
        };
        let centre = DVec3::from_array(link.position) + axes * DVec3::from_array(parameters.contact_position[c]);
        normal.dot(centre) - parameters.contact_radius[c] - rim
    });
    heights.reduce(f64::min).unwrap_or(0.0)
}

/// Description of a robot for deployments of a policy; SI units, physical joint order unless said
/// otherwise.
#[derive(serde::Serialize, Clone, Debug)]
pub struct RobotDescription {
    /// Name for people.
    pub title: String,
    /// Mass of the robot, kg.
    pub mass: f64,
    /// Networks that give torques in the place of gains.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub actuator_networks: Vec<NetworkDescription>,
    /// Names in the URDF.
    pub joint_names: Vec<String>,
    /// Physical index of the joint in each of the robot's slots that the policy drives.
    pub joint_of_slot: Vec<usize>,
    /// Names of these slots.
    pub slots: Vec<String>,
    /// For each slot, 1, or -1 where the joint's own positive direction is opposite to the slot's.
    pub slot_signs: Vec<f32>,
    /// For each slot, its column in the batch.
    pub columns: Vec<usize>,
    /// Joints that the policy does not drive: they hold their default pose.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub held_joints: Vec<HeldJoint>,
    /// `biped`, `humanoid`, `quadruped`, `hexapod` ...
    pub class: String,
    /// Joint positions of the default pose, rad.
    pub default_pose: Vec<f32>,
    /// Joint target per unit of action, rad.
    pub action_scale: f32,
    /// Stiffness of each joint, N m/rad.
    pub stiffness: Vec<f32>,
    /// Damping of each joint, N m s/rad.
    pub damping: Vec<f32>,
    /// Effort limit of each joint, N m; the largest one where it depends on the angle, infinity
    /// (`null` in JSON) where there is no limit.
    pub effort_limit: Vec<f32>,
    /// Speed limit of each joint or of its DC motor without load, rad/s; infinity (`null` in JSON)
    /// where there is no limit.
    pub velocity_limit: Vec<f32>,
    /// Lower position limits, rad; minus infinity (`null` in JSON) where there is no limit.
    pub lower: Vec<f32>,
    /// Upper position limits, rad; infinity (`null` in JSON) where there is no limit.
    pub upper: Vec<f32>,
    /// Height of the base above the ground in the default pose, m.
    pub base_height: f32,
    /// Height of the hips above the base's frame in the default pose, m.
    pub hip_height: f32,
    /// Contact bodies that are feet, in the order of `legs`.
    pub feet: Vec<String>,
    /// Names of the legs.
    pub legs: Vec<String>,
    /// For each slot the one on the robot's other side, and the sign that its position takes there:
    /// the mirror image of a pose about the plane between left and right.
    pub mirror: Vec<(usize, f32)>,
}

/// A joint that the policy does not drive.
#[derive(serde::Serialize, Clone, Debug, PartialEq)]
pub struct HeldJoint {
    /// Physical index.
    pub joint: usize,
    /// Name of its slot.
    pub slot: String,
    /// 1, or -1 where the joint's own positive direction is opposite to the slot's.
    pub sign: f32,
}

/// A network that gives the torque of joints; SI units.
#[derive(serde::Serialize, Clone, Debug)]
pub struct NetworkDescription {
    /// Actuator group in the robot's config.
    pub group: String,
    /// Model of the actuator.
    pub model: ActuatorModel,
    /// File as the config names it.
    pub file: PathBuf,
    /// FNV-1a of the file.
    pub checksum: String,
    /// Physical joints that it drives, each for itself.
    pub joints: Vec<usize>,
    /// Inputs, in order: `pos_error[0]` is the target less the position, rad, `vel[1]` the velocity
    /// one physics step ago, rad/s.
    pub inputs: Vec<String>,
    /// Factor of position errors.
    pub pos_scale: f64,
    /// Factor of velocities.
    pub vel_scale: f64,
    /// Factor of the output, N m.
    pub torque_scale: f64,
}

impl MorphologyModel {
    /// Torques of the joints that networks drive, before the actuators' limits, and zero for all
    /// others, N m, `[joints]`: for position errors (target less position, rad) and velocities
    /// (rad/s) `[joints]`, one physics step after the other. `memory` holds
    /// [`num_remembered`](Self::num_remembered) numbers, zero to begin with.
    ///
    /// # Panics
    /// If a list is shorter.
    pub fn network_torques(&self, error: &[f32], velocity: &[f32], memory: &mut [f32]) -> Vec<f32> {
        let topology = &self.topology;
        let mut state = State::zeros(topology);
        state.joint_position.iter_mut().zip(error).for_each(|(q, &error)| *q = -error);
        state.joint_velocity.copy_from_slice(&velocity[..topology.num_joints()]);
        let mut drive = Drive::zeros(topology, 1);
        let settings = StepSettings {
            dt: 1.0,
            decimation: 1,
            gravity: [0.0; 3],
            contact: ContactSettings { ground: None, ..ContactSettings::default() },
        };
        let step = NetworkStep {
            topology,
            settings: &settings,
            networks: &self.networks,
            substep: 0,
            state: &state,
            drive: &mut drive,
            memory,
            features: &mut Vec::new(),
            work: &mut Workspace::new(topology),
        };
        step.run();
        drive.feedforward
    }

    /// Number of values that the networks remember.
    pub fn num_remembered(&self) -> usize {
        ActuatorNetwork::num_remembered_by(&self.networks)
    }

    /// Returns the description of the robot.
    pub fn describe(&self) -> RobotDescription {
        let p = &self.nominal;
        let effort_limit = (0..self.topology.num_joints()).map(|j| self.max_effort(j, p)).collect();
        RobotDescription {
            title: self.config.title.clone(),
            mass: self.model.total_mass(),
            actuator_networks: self.describe_networks(),
            joint_names: self.model.joints.iter().map(|joint| joint.name.clone()).collect(),
            joint_of_slot: self.joint_of_slot(),
            slots: self.slots.iter().map(|slot| slot.slot.to_string()).collect(),
            slot_signs: self.slots.iter().map(|slot| slot.sign).collect(),
            columns: self.slots.iter().map(|slot| slot.column()).collect(),
            held_joints: self.held_joints(),
            class: self.roles.class().to_owned(),
            legs: self.roles.legs.iter().map(|place| place.name().to_owned()).collect(),
            default_pose: self.stance.default_position.to_vec(),
            action_scale: self.stance.action_scale,
            stiffness: p.stiffness.to_vec(),
            damping: p.damping.to_vec(),
            effort_limit,
            velocity_limit: (0..p.velocity_limit.len())
                .map(|j| p.velocity_limit[j].min(p.motor_velocity_limit[j]))
                .collect(),
            lower: p.lower.to_vec(),
            upper: p.upper.to_vec(),
            base_height: self.default_height(),
            hip_height: self.hip_height,
            feet: self.feet.iter().map(|&body| self.model.bodies[body].name.clone()).collect(),
            mirror: self.mirrored_slots(),
        }
    }

    fn held_joints(&self) -> Vec<HeldJoint> {
        let roles = self.roles.slots.iter().zip(&self.roles.joint_of_slot);
        let is_held = |(_, joint): &(&Slot, &usize)| self.slots.iter().all(|own| own.joint() != **joint);
        let describe =
            |(slot, &joint): (&Slot, &usize)| HeldJoint { joint, slot: slot.to_string(), sign: self.sign_of(joint) };
        roles.filter(is_held).map(describe).collect()
    }

    fn describe_networks(&self) -> Vec<NetworkDescription> {
        let groups = self.config.actuators.iter().filter(|(_, actuator)| actuator.model.is_network());
        let describe =
            |((group, actuator), network): ((&String, &ActuatorConfig), &ActuatorNetwork)| NetworkDescription {
                group: group.clone(),
                model: actuator.model,
                file: actuator.network_file.clone().unwrap_or_default(),
                checksum: actuator.network_checksum.clone().unwrap_or_default(),
                joints: network.joints().to_vec(),
                inputs: network_inputs(actuator).iter().map(NetworkInput::to_string).collect(),
                pos_scale: actuator.pos_scale.unwrap_or(1.0),
                vel_scale: actuator.vel_scale.unwrap_or(1.0),
                torque_scale: actuator.torque_scale.unwrap_or(1.0),
            };
        groups.zip(&self.networks).map(describe).collect()
    }

    /// Driven slot on the other side of each driven slot, and the sign that its position takes
    /// there. A slot whose counterpart is absent or not driven is its own.
    pub fn mirrored_slots(&self) -> Vec<(usize, f32)> {
        let mirror = |(at, own): (usize, &SlotJoint)| {
            let other = self.slots.binary_search_by_key(&own.slot.mirrored(), |other| other.slot).unwrap_or(at);
            (other, self.mirrored_sign(own.joint(), self.slots[other].joint()))
        };
        self.slots.iter().enumerate().map(mirror).collect()
    }

    /// Slot on the other side of each of the robot's slots, driven or not, and the sign that its
    /// position takes there.
    pub fn mirrored_roles(&self) -> Vec<(usize, f32)> {
        let (slots, joints) = (&self.roles.slots, &self.roles.joint_of_slot);
        let mirror = |(at, slot): (usize, &Slot)| {
            // a limb without a counterpart is its own
            let other = slots.binary_search(&slot.mirrored()).unwrap_or(at);
            (other, self.mirrored_sign(joints[at], joints[other]))
        };
        slots.iter().enumerate().map(mirror).collect()
    }

    /// Column on the other side of each of the `columns` of a batch, and the sign there; columns
    /// that the robot lacks stay as they are.
    pub fn mirrored_columns(&self, columns: usize) -> Vec<(usize, f32)> {
        let mut mirror: Vec<(usize, f32)> = (0..columns).map(|column| (column, 1.0)).collect();
        for (own, (other, sign)) in self.slots.iter().zip(self.mirrored_slots()) {
            mirror[own.column()] = (self.slots[other].column(), sign);
        }
        mirror
    }

    /// The foot on the other side of each of a batch's `columns` of feet; those that the robot
    /// lacks stay as they are.
    pub fn mirrored_feet(&self, columns: usize) -> Vec<usize> {
        let mut mirror: Vec<usize> = (0..columns).collect();
        for (leg, column) in self.roles.legs.iter().zip(&self.foot_columns) {
            if let Some(other) = self.roles.legs.iter().position(|other| *other == leg.mirrored()) {
                mirror[*column] = self.foot_columns[other];
            }
        }
        mirror
    }

    /// Sign that the position of the slot of a physical joint takes at that of another one, which
    /// is its mirror image.
    fn mirrored_sign(&self, joint: usize, other: usize) -> f32 {
        let axis = |joint: usize| self.topology.joints[joint].axis.direction();
        let ([x, y, z], [ox, oy, oz]) = (axis(joint), axis(other));
        // axes of rotation are mirrored as pseudovectors
        let sign = if y * oy - x * ox - z * oz < 0.0 { -1.0 } else { 1.0 };
        sign * self.sign_of(joint) * self.sign_of(other)
    }

    /// Largest effort of a joint at any position, N m, infinity without a limit; `body` holds the
    /// numbers of a robot of this kind.
    pub fn max_effort(&self, joint: usize, body: &Parameters<f32>) -> f32 {
        body.effort_limit[joint] * self.effort_share(joint)
    }

    /// Largest share of its effort limit that a joint's effort table leaves.
    fn effort_share(&self, joint: usize) -> f32 {
        let table = self.topology.joints[joint].effort_table.as_ref();
        table.map_or(1.0, |table| table.limits.iter().copied().fold(0.0, f32::max))
    }

    /// Largest share of its effort limit that each joint's effort table leaves.
    pub(crate) fn effort_shares(&self) -> impl Iterator<Item = f32> + '_ {
        (0..self.topology.num_joints()).map(|joint| self.effort_share(joint))
    }
}
