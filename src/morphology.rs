//! What a kind of robot is: its URDF and its config brought together, ready for the engine and the task.

use std::collections::BTreeMap;
use std::path::PathBuf;

use bevy_ecs::prelude::Resource;
use glam::DMat3;

use crate::components::{PerFoot, Stance};
use crate::config::{ActuatorConfig, ActuatorModel, ConfigError, LoadedRobot, RobotConfig};
use crate::dynamics::{EffortTable, JointTopology, Parameters, Topology};
use crate::error::Error;
use crate::robot::{self, Articulation, BodyGroup, Model, Roles, Site, UNLIMITED};

/// One kind of robot.
#[derive(Clone, Debug)]
pub struct MorphologyModel {
    /// Its config.
    pub config: RobotConfig,
    /// The merged articulation, in the URDF's frames.
    pub model: Model,
    /// Which joint is which.
    pub roles: Roles,
    /// What all robots of the kind share.
    pub topology: Topology,
    /// Turns a link's URDF axes into those of the engine, `[links]`.
    pub align: Vec<DMat3>,
    /// Collision shapes that may touch each other, counted body after body.
    pub shape_pairs: Vec<[usize; 2]>,
    /// Their numbers before any randomisation.
    pub nominal: Parameters<f32>,
    /// Canonical slot -> physical joint.
    pub joint_of_slot: [usize; 12],
    /// How a robot stands whose body is that of the URDF.
    pub stance: Stance,
    /// Group of each contact body.
    pub body_groups: Vec<BodyGroup>,
    /// Contact bodies that are feet, legs in the order LF, LH, RF, RH.
    pub feet: PerFoot<usize>,
    /// Fewest and most physics steps of delay of each actuator group, with its joints (physical).
    pub delays: Vec<([u32; 2], Vec<usize>)>,
    /// The most physics steps by which events of the task delay targets on top of that.
    pub max_action_delay: u32,
}

/// All kinds of robots of a simulation, in the order of their env blocks.
#[derive(Resource, Clone, Debug)]
pub struct Morphologies(pub Vec<MorphologyModel>);

impl Morphologies {
    /// The kind that a tag names.
    pub fn get(&self, tag: crate::components::Morphology) -> &MorphologyModel {
        &self.0[usize::from(tag.0)]
    }
}

impl MorphologyModel {
    /// Reads the URDF, finds the joints' roles and applies the config.
    ///
    /// # Errors
    /// What is wrong with the URDF or the config, with file, element and remedy.
    pub fn new(loaded: &LoadedRobot) -> Result<Self, Error> {
        let config = loaded.config.clone();
        let ConfiguredRobot { model, roles, articulation, default_position } =
            ConfiguredRobot::new(loaded, &BTreeMap::new(), true, None)?;
        let body_groups = body_groups(&config, &model, &roles)?;
        let Articulation { mut topology, parameters, align, shape_pairs } = articulation;
        let actuators = config.actuators_by_slot()?;
        topology.has_delay = actuators.iter().any(|(_, a)| a.model == ActuatorModel::DelayedPd && a.delay[1] > 0);
        let nominal = Parameters::from_scalars(&topology, &parameters);
        let lowest_foot = lowest_foot(&model, &roles, &default_position);
        let mut delays: BTreeMap<&str, ([u32; 2], Vec<usize>)> = BTreeMap::new();
        for (slot, (group, actuator)) in actuators.iter().enumerate() {
            if actuator.delay[1] > 0 {
                delays.entry(group).or_insert((actuator.delay, Vec::new())).1.push(roles.joint_of_slot[slot]);
            }
        }
        let delays = delays.into_values().collect();
        Ok(Self {
            joint_of_slot: roles.joint_of_slot,
            stance: Stance {
                default_position: default_position.iter().map(|&q| q as f32).collect(),
                action_scale: config.action_scale as f32,
                spawn_height: (config.reset.spawn_margin - lowest_foot) as f32,
            },
            body_groups,
            feet: roles.foot_body,
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

    /// Largest delay of any target, physics steps.
    pub fn max_delay(&self) -> u32 {
        self.delays.iter().map(|(range, _)| range[1]).max().unwrap_or(0) + self.max_action_delay
    }

    /// Lets events of the task delay targets by up to this many physics steps on top of the actuators' own delays.
    pub(crate) fn allow_action_delay(&mut self, most: u32) {
        self.max_action_delay = most;
        self.topology.has_delay |= most > 0;
    }

    /// Names of the canonical slots' joints in the URDF.
    pub fn joint_names_by_slot(&self) -> [&str; 12] {
        self.joint_of_slot.map(|j| self.model.joints[j].name.as_str())
    }
}

/// A robot of the library as physics knows it: its URDF with the actuators of its config.
pub(crate) struct ConfiguredRobot {
    pub(crate) model: Model,
    pub(crate) roles: Roles,
    /// With the feet as sites, legs in the order LF, LH, RF, RH.
    pub(crate) articulation: Articulation,
    /// Joint positions of the default pose, physical order, rad.
    pub(crate) default_position: Vec<f64>,
}

impl ConfiguredRobot {
    /// Reads the URDF, finds the joints' roles and applies the config. `package_dirs` come on top of the config's; `floating`, or with the
    /// base fixed to the world. Without `self_collision` the config says whether links collide.
    ///
    /// # Errors
    /// What is wrong with the URDF or the config, with file, element and remedy.
    pub(crate) fn new(
        loaded: &LoadedRobot,
        package_dirs: &BTreeMap<String, PathBuf>,
        floating: bool,
        self_collision: Option<bool>,
    ) -> Result<Self, Error> {
        let config = &loaded.config;
        let mut options = robot::LoadOptions {
            package_dirs: config.package_dirs.clone(),
            locked_joints: config.locked_joints.clone(),
        };
        options.package_dirs.extend(package_dirs.clone());
        let model = robot::load_str(&loaded.urdf_text, &loaded.urdf_path, &options)?;
        let roles = robot::detect(&model, &config.joint_roles, &config.feet)
            .map_err(|error| robot::naming_missing_meshes(error, &model))?;
        let (default_pose, actuators) = (config.default_pose_by_slot()?, config.actuators_by_slot()?);
        let mut default_position = vec![0.0; model.joints.len()];
        for (slot, &joint) in roles.joint_of_slot.iter().enumerate() {
            default_position[joint] = default_pose[slot];
        }
        let sites: Vec<Site> = (0..4)
            .map(|leg| Site { link: model.bodies[roles.foot_body[leg]].link, position: roles.foot_point[leg] })
            .collect();
        let reference = self_collision.unwrap_or(config.self_collisions).then_some(&default_position[..]);
        let mut articulation = Articulation::new(&model, floating, &sites, reference);
        for (slot, &j) in roles.joint_of_slot.iter().enumerate() {
            apply_actuator(&mut articulation.topology.joints[j], &mut articulation.parameters, j, actuators[slot].1);
        }
        Ok(Self { model, roles, articulation, default_position })
    }
}

fn body_groups(config: &RobotConfig, model: &Model, roles: &Roles) -> Result<Vec<BodyGroup>, Error> {
    let mut groups = robot::body_groups(model, roles);
    let named = [
        (&config.bodies.base, BodyGroup::Base, "bodies.base"),
        (&config.bodies.hip, BodyGroup::Hip, "bodies.hip"),
        (&config.bodies.thigh, BodyGroup::Thigh, "bodies.thigh"),
        (&config.bodies.shank, BodyGroup::Shank, "bodies.shank"),
        (&config.bodies.foot, BodyGroup::Foot, "bodies.foot"),
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

/// Gives joint `j` the actuator of a config, but for its delay.
fn apply_actuator(joint: &mut JointTopology, p: &mut Parameters<f64>, j: usize, actuator: &ActuatorConfig) {
    joint.effort_table = effort_table(&actuator.effort_table);
    joint.explicit = actuator.explicit;
    p.stiffness[j] = actuator.stiffness;
    p.damping[j] = actuator.damping;
    p.armature[j] = actuator.armature;
    // a table holds the limits itself: the factor scales it
    p.effort_limit[j] = match (actuator.effort_limit, actuator.effort_table.is_empty()) {
        (_, false) => 1.0,
        (Some(limit), true) => limit,
        (None, true) => UNLIMITED,
    };
    if let Some(friction) = actuator.friction {
        p.joint_friction[j] = friction;
    }
    if let Some(damping) = actuator.joint_damping {
        p.joint_damping[j] = damping;
    }
    let limit = actuator.velocity_limit.unwrap_or(UNLIMITED);
    if actuator.model == ActuatorModel::DcMotor {
        p.saturation_effort[j] = actuator.saturation_effort.unwrap_or(UNLIMITED);
        p.motor_velocity_limit[j] = limit;
    } else {
        p.velocity_limit[j] = limit;
    }
}

/// A table of effort limits on an equally spaced grid, as fine as its closest rows.
fn effort_table(rows: &[[f64; 2]]) -> Option<EffortTable> {
    let (first, last) = (rows.first()?, rows.last()?);
    let gap = rows.windows(2).map(|w| w[1][0] - w[0][0]).fold(f64::INFINITY, f64::min);
    let steps = if gap.is_finite() { ((last[0] - first[0]) / gap).round().max(1.0) } else { 1.0 };
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

/// Lowest point of the foot spheres in the default pose, relative to the base, m.
fn lowest_foot(model: &Model, roles: &Roles, q: &[f64]) -> f64 {
    let poses = model.forward_kinematics(q);
    (0..4)
        .map(|leg| {
            let link = model.bodies[roles.foot_body[leg]].link;
            poses[link].transform_point(roles.foot_point[leg]).z - roles.foot_radius[leg]
        })
        .fold(f64::INFINITY, f64::min)
}

/// What a deployment must know of a robot to run a policy on it; SI units, physical joint order unless said otherwise.
#[derive(serde::Serialize, Clone, Debug)]
pub struct RobotDescription {
    /// Name for people.
    pub title: String,
    /// kg.
    pub mass: f64,
    /// Names in the URDF.
    pub joint_names: Vec<String>,
    /// Physical index of each canonical slot.
    pub joint_of_slot: [usize; 12],
    /// rad.
    pub default_pose: Vec<f32>,
    /// rad per unit of action.
    pub action_scale: f32,
    /// N m/rad.
    pub stiffness: Vec<f32>,
    /// N m s/rad.
    pub damping: Vec<f32>,
    /// N m; the largest one where it depends on the angle.
    pub effort_limit: Vec<f32>,
    /// rad.
    pub lower: Vec<f32>,
    /// rad.
    pub upper: Vec<f32>,
    /// Height of the base above the ground in the default pose, m.
    pub base_height: f32,
    /// Contact bodies that are feet, legs in the order LF, LH, RF, RH.
    pub feet: Vec<String>,
    /// For each canonical slot the one on the robot's other side, and the sign that its position takes there: the
    /// mirror image of a pose about the plane between left and right.
    pub mirror: [(usize, f32); 12],
}

impl MorphologyModel {
    /// Its description.
    pub fn describe(&self) -> RobotDescription {
        let p = &self.nominal;
        let effort_limit = (0..self.topology.num_joints()).map(|j| self.max_effort(j, p)).collect();
        RobotDescription {
            title: self.config.title.clone(),
            mass: self.model.total_mass(),
            joint_names: self.model.joints.iter().map(|joint| joint.name.clone()).collect(),
            joint_of_slot: self.joint_of_slot,
            default_pose: self.stance.default_position.to_vec(),
            action_scale: self.stance.action_scale,
            stiffness: p.stiffness.to_vec(),
            damping: p.damping.to_vec(),
            effort_limit,
            lower: p.lower.to_vec(),
            upper: p.upper.to_vec(),
            base_height: self.stance.spawn_height - self.config.reset.spawn_margin as f32,
            feet: self.feet.iter().map(|&body| self.model.bodies[body].name.clone()).collect(),
            mirror: self.mirrored_slots(),
        }
    }

    /// For each canonical slot the one on the robot's other side, and the sign that its position takes there.
    pub fn mirrored_slots(&self) -> [(usize, f32); 12] {
        std::array::from_fn(|slot| self.mirror(slot))
    }

    fn mirror(&self, slot: usize) -> (usize, f32) {
        // legs come in the order LF, LH, RF, RH within a role
        let other = slot ^ 2;
        let axis = |slot: usize| self.topology.joints[self.joint_of_slot[slot]].axis.direction();
        let ([x, y, z], [ox, oy, oz]) = (axis(slot), axis(other));
        // axes of rotation are mirrored as pseudovectors
        (other, if y * oy - x * ox - z * oz < 0.0 { -1.0 } else { 1.0 })
    }

    /// Largest effort of a joint at any position, N m; `body` holds the numbers of a robot of this kind.
    pub fn max_effort(&self, joint: usize, body: &Parameters<f32>) -> f32 {
        let limit = body.effort_limit[joint];
        match &self.topology.joints[joint].effort_table {
            Some(table) => limit * table.limits.iter().copied().fold(0.0, f32::max),
            None => limit,
        }
    }
}
