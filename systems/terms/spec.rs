//! Descriptions of observation terms: stated once, where a term is registered, and read there by
//! export, mirror images and docs.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

use serde::Serialize;

use crate::config::{ExternalConfig, ExternalKind, SensorsConfig};
use crate::morphology::{BatchSlots, MorphologyModel};
use crate::robot::{CANONICAL_JOINT_NAMES, ROLES, Slot};

/// Joints of a body that blocks describe: a quadruped's.
const JOINTS: usize = CANONICAL_JOINT_NAMES.len();

/// Kind of a term's numbers: how they change in a mirror that exchanges left and right.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum TermKind {
    /// Numbers that a mirror leaves alone.
    Scalar,
    /// Numbers that change their signs in a mirror, such as an angle to the left.
    Odd,
    /// A vector x, y, z: y changes its sign.
    Vector,
    /// A pseudovector x, y, z, such as an angular velocity: x and z change their signs.
    Pseudovector,
    /// Forward and left velocity and yaw rate: the last two change their signs.
    PlanarVelocity,
    /// Numbers of each joint, in the batch's columns: all joints' first number, then their next.
    /// Joints change sides, and some of them their signs. A robot's own numbers are written and
    /// observed; columns of joints that it lacks are zero.
    PerJoint,
    /// A number of each foot, in the batch's columns: feet change sides. A robot's own numbers are
    /// written and observed; columns of feet that it lacks are zero.
    PerFoot,
    /// A number of each ray of the height scanner: its rows change sides.
    Scan,
    /// A number of each pixel of the depth camera, which changes with its image alone: the columns
    /// of the image change sides.
    Image,
    /// Description of the robot's body, in blocks ([`TermSpec::blocks`]): numbers of joints change
    /// like those of `PerJoint`.
    Body,
}

/// Source of a term on a robot, and its formula. Exported graphs and the comparison with MuJoCo
/// compute it, so that a deployment gives what its sensors read. In Python:
/// `polypod.export.sources`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum TermSource {
    /// The term as it is: a deployment measures it and gives it by the term's name.
    Measured,
    /// Description of the robot's body: numbers that do not change, which a graph folded for a
    /// robot holds.
    RobotConstant,
    /// Velocity of the base's centre of mass in base axes, from that of the base link's origin and
    /// the angular velocity.
    CenterOfMassVelocity,
    /// Angular velocity of the base, base axes.
    BaseAngularVelocity,
    /// Unit vector of gravity, base axes.
    ProjectedGravity,
    /// Commanded forward velocity, left velocity and yaw rate.
    VelocityCommand,
    /// Joint positions, in the batch's columns and canonical directions.
    JointPosition,
    /// Joint positions less the default pose, in the batch's columns and canonical directions.
    JointPositionMinusDefault,
    /// Joint velocities, in the batch's columns and canonical directions.
    JointVelocity,
    /// The action of the previous control step.
    LastAction,
    /// Height of the base above the ground below each ray of the height scanner.
    HeightScan,
}

impl TermSource {
    /// Inputs of a folded graph for a term called `name`, in the order of its formula.
    pub fn inputs(self, name: &str) -> Vec<&str> {
        match self {
            Self::Measured => vec![name],
            Self::RobotConstant => vec![],
            Self::CenterOfMassVelocity => vec!["base_lin_vel", "base_ang_vel"],
            Self::BaseAngularVelocity => vec!["base_ang_vel"],
            Self::ProjectedGravity => vec!["projected_gravity"],
            Self::VelocityCommand => vec!["velocity_commands"],
            Self::JointPosition | Self::JointPositionMinusDefault => vec!["joint_pos"],
            Self::JointVelocity => vec!["joint_vel"],
            Self::LastAction => vec!["last_action"],
            Self::HeightScan => vec!["height_scan"],
        }
    }
}

/// Part of the body that each number of a block belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Per {
    /// The whole body.
    Body,
    /// The whole body: a distance between front and hind legs. A leg stands half of it ahead of the
    /// middle or behind it.
    Length,
    /// The whole body: a distance between left and right legs. A leg stands half of it from the
    /// middle.
    Width,
    /// A role of joints: all numbers of the first role, then those of the next.
    Role,
    /// A joint of a quadruped: the first number of all joints in canonical order, then the next
    /// number of all joints.
    Joint,
}

/// Consecutive numbers of a term of the kind [`TermKind::Body`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Block {
    /// Part of the body.
    pub per: Per,
    /// Number of values for each part: the body, a role, a joint.
    pub count: usize,
}

impl Block {
    /// `count` numbers for each.
    pub const fn new(per: Per, count: usize) -> Self {
        Self { per, count }
    }

    /// Number of values of the block.
    pub const fn size(self) -> usize {
        match self.per {
            Per::Body | Per::Length | Per::Width => self.count,
            Per::Role => self.count * ROLES.len(),
            Per::Joint => self.count * JOINTS,
        }
    }
}

/// Description of an observation term. Mirror images, exported graphs, networks of joints and the
/// comparison with MuJoCo read it, and so does Python (`VecSim.observation_terms`).
#[derive(Clone, Copy, Debug, Serialize)]
pub struct TermSpec {
    /// Kind of its numbers.
    pub kind: TermKind,
    /// SI units; empty for numbers without.
    pub units: &'static str,
    /// Meaning, with the frame.
    pub description: &'static str,
    /// Source of the term on a robot.
    pub source: TermSource,
    /// Typical magnitude of its numbers, in `units`: networks of joints divide by it where nothing
    /// else normalises.
    pub magnitude: f32,
    /// Blocks of its numbers, in order, for the kind [`TermKind::Body`]; empty for the others.
    pub blocks: &'static [Block],
    /// Signs that the numbers of one joint take in a mirror on top of the joint's own, for the kind
    /// [`TermKind::PerJoint`]; empty where each takes the joint's own sign.
    pub joint_mirror: &'static [JointMirror],
}

/// Change of a number of a joint in a mirror between left and right.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum JointMirror {
    /// The number takes the joint's sign, as its position does.
    Position,
    /// The number takes the opposite of the joint's sign: components of an axis forward and up.
    Opposite,
    /// No change.
    Even,
    /// A change of sign: a component to the left.
    Odd,
    /// A lower limit. The next number is the upper limit: they change places where positions change
    /// their sign.
    Lower,
    /// An upper limit, after the lower one.
    Upper,
}

impl TermSpec {
    /// A term of typical magnitude 1 that a deployment measures as it is.
    pub const fn new(kind: TermKind, units: &'static str, description: &'static str) -> Self {
        Self { kind, units, description, source: TermSource::Measured, magnitude: 1.0, blocks: &[], joint_mirror: &[] }
    }

    /// A term that the simulation's caller computes.
    pub(super) fn external(config: &ExternalConfig) -> Self {
        let kind = match config.kind {
            ExternalKind::Scalar => TermKind::Scalar,
            ExternalKind::Vector => TermKind::Vector,
            ExternalKind::Pseudovector => TermKind::Pseudovector,
            ExternalKind::PlanarVelocity => TermKind::PlanarVelocity,
            ExternalKind::PerJoint => TermKind::PerJoint,
            ExternalKind::PerFoot => TermKind::PerFoot,
        };
        Self::new(kind, interned(&config.units), interned(&config.description))
    }

    /// A term that is computed from sensor readings.
    pub const fn from_source(self, source: TermSource) -> Self {
        Self { source, ..self }
    }

    /// A term whose numbers have this typical magnitude.
    pub const fn with_magnitude(self, magnitude: f32) -> Self {
        Self { magnitude, ..self }
    }

    /// A term whose numbers describe the body in these blocks.
    pub const fn with_blocks(self, blocks: &'static [Block]) -> Self {
        Self { blocks, ..self }
    }

    /// A term with several numbers of each joint, which change in this way.
    pub const fn with_joint_mirror(self, joint_mirror: &'static [JointMirror]) -> Self {
        Self { joint_mirror, ..self }
    }

    /// Whether a term of this kind may have `size` numbers in a batch of these slots.
    ///
    /// # Errors
    /// The number of values that it would have.
    pub(super) fn check_size(&self, size: usize, slots: &BatchSlots) -> Result<(), String> {
        let (joints, feet) = (slots.joints.len(), slots.feet.len());
        let blocks: usize = self.blocks.iter().map(|block| block.size()).sum();
        match self.kind {
            TermKind::PerJoint if size == 0 || !size.is_multiple_of(joints) => {
                Err(format!("a number for each of {joints} joints"))
            }
            TermKind::Vector | TermKind::Pseudovector | TermKind::PlanarVelocity if !size.is_multiple_of(3) => {
                Err("three numbers for each vector".into())
            }
            TermKind::PerFoot if size != feet => Err(format!("a number for each of {feet} feet")),
            TermKind::Body if size != blocks => Err(format!("{blocks} numbers in its blocks")),
            _ => Ok(()),
        }
    }

    /// Whether the term describes quadrupeds alone.
    pub(super) fn is_of_quadrupeds(&self) -> bool {
        self.blocks.iter().any(|block| matches!(block.per, Per::Role | Per::Joint))
    }

    /// The mirror image of `size` numbers in a batch of `joints` slots: the number that takes the
    /// place of each, and its sign.
    pub(crate) fn mirror(
        &self,
        size: usize,
        columns: usize,
        robot: &MorphologyModel,
        sensors: &SensorsConfig,
    ) -> Vec<(usize, f32)> {
        let signs = |signs: [f32; 3]| (0..size).map(|i| (i, signs[i % 3])).collect();
        match self.kind {
            TermKind::Scalar => signs([1.0; 3]),
            TermKind::Odd => signs([-1.0; 3]),
            TermKind::Vector => signs([1.0, -1.0, 1.0]),
            TermKind::Pseudovector => signs([-1.0, 1.0, -1.0]),
            TermKind::PlanarVelocity => signs([1.0, -1.0, -1.0]),
            TermKind::PerJoint => self.mirror_joints(size / columns.max(1), columns, robot),
            TermKind::PerFoot => robot.mirrored_feet(size).into_iter().map(|foot| (foot, 1.0)).collect(),
            TermKind::Scan => {
                // rows from right to left, each from back to front
                let rows = sensors.height_scanner.as_ref().map_or(1, |scanner| scanner.counts()[1]).max(1);
                let length = size / rows;
                (0..rows).rev().flat_map(|row| (row * length..(row + 1) * length).map(|i| (i, 1.0))).collect()
            }
            TermKind::Image => {
                let width = sensors.ray_caster_camera.as_ref().map_or(1, |camera| camera.pattern_cfg.width as usize);
                (0..size).map(|i| (i / width * width + (width - 1 - i % width), 1.0)).collect()
            }
            TermKind::Body => {
                let mut mirror = Vec::with_capacity(size);
                for block in self.blocks {
                    let first = mirror.len();
                    match block.per {
                        Per::Joint => (0..block.count).for_each(|k| {
                            let image = mirrored_quadruped(robot).into_iter();
                            mirror.extend(image.map(|(slot, sign)| (first + k * JOINTS + slot, sign)));
                        }),
                        _ => mirror.extend((first..first + block.size()).map(|i| (i, 1.0))),
                    }
                }
                mirror
            }
        }
    }

    fn mirror_joints(&self, count: usize, columns: usize, robot: &MorphologyModel) -> Vec<(usize, f32)> {
        let joints = robot.mirrored_columns(columns);
        let mut mirror = Vec::with_capacity(count * columns);
        for k in 0..count {
            let kind = self.joint_mirror.get(k).copied().unwrap_or(JointMirror::Position);
            mirror.extend(joints.iter().map(|&(column, sign)| match kind {
                JointMirror::Position => (k * columns + column, sign),
                JointMirror::Opposite => (k * columns + column, -sign),
                JointMirror::Even => (k * columns + column, 1.0),
                JointMirror::Odd => (k * columns + column, -1.0),
                JointMirror::Lower if sign < 0.0 => ((k + 1) * columns + column, -1.0),
                JointMirror::Upper if sign < 0.0 => ((k - 1) * columns + column, -1.0),
                JointMirror::Lower | JointMirror::Upper => (k * columns + column, 1.0),
            }));
        }
        mirror
    }
}

/// The one copy of a text. It stays in memory: specs are copied freely, and hold texts of the
/// program and of configs.
fn interned(text: &str) -> &'static str {
    static TEXTS: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
    let mut texts = TEXTS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(known) = texts.get(text) {
        return known;
    }
    let text: &'static str = Box::leak(text.into());
    texts.insert(text);
    text
}

/// The mirror of a quadruped's joints in their canonical order.
fn mirrored_quadruped(robot: &MorphologyModel) -> [(usize, f32); JOINTS] {
    let (slots, mirrored) = (&robot.roles.slots, robot.mirrored_roles());
    std::array::from_fn(|at| {
        let own = Slot::parse(CANONICAL_JOINT_NAMES[at]).and_then(|slot| slots.binary_search(&slot).ok());
        let Some((other, sign)) = own.map(|own| mirrored[own]) else {
            return (at, 1.0);
        };
        let name = slots[other].to_string();
        (CANONICAL_JOINT_NAMES.iter().position(|known| *known == name).unwrap_or(at), sign)
    })
}
