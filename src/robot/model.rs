//! The robot as the simulator sees it: moving links, moving joints and contact bodies.

use std::path::PathBuf;

use glam::{DMat3, DVec3};
use serde::{Serialize, Serializer};

use super::error::Warning;
use super::pose::Pose;

/// A legged robot in reduced coordinates: a tree of links, each moved by one joint. SI units, f64.
///
/// `links[0]` is the base; `links[i + 1]` is moved by `joints[i]`, and a parent always comes
/// before its children. Everything that was fixed to a link in the URDF is part of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Name of the robot in the URDF; may be empty.
    pub name: String,
    /// The file it came from.
    pub source: PathBuf,
    /// The base, then the child link of each joint.
    pub links: Vec<Link>,
    /// Moving joints, in the file's order where that puts parents before children, otherwise
    /// reordered as little as possible so that it does.
    pub joints: Vec<Joint>,
    /// Every URDF link with collision shapes, in the file's order: a foot fixed to a shank stays
    /// a separate contact body although its mass is part of the shank.
    pub bodies: Vec<Body>,
    /// Joints that options lock, by name.
    pub locked: Vec<LockedJoint>,
    /// Assumptions made while reading; the caller decides where to show them.
    pub warnings: Vec<Warning>,
}

/// A joint that options hold at a position for good. Units are rad when it turns, m when it slides.
#[derive(Clone, Debug, PartialEq)]
pub struct LockedJoint {
    /// Name in the URDF.
    pub name: String,
    /// Position at which it is held.
    pub position: f64,
    /// Lower position limit; negative infinity when there is none.
    pub lower: f64,
    /// Upper position limit; infinity when there is none.
    pub upper: f64,
}

/// A rigid link with everything that is fixed to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// Name of the URDF link whose frame this is.
    pub name: String,
    /// Mass, kg.
    pub mass: f64,
    /// Centre of mass in the link frame, m.
    pub com: DVec3,
    /// Inertia about the centre of mass in the link's axes, kg m^2; symmetric.
    pub inertia: DMat3,
    /// Names of the URDF links merged into this one, massless frames included.
    pub merged: Vec<String>,
}

/// Motion of a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointKind {
    /// Turns between limits.
    Revolute,
    /// Turns without limits.
    Continuous,
    /// Slides between limits.
    Prismatic,
}

/// A moving joint. Units are rad and N m when it turns, m and N when it slides.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Name in the URDF.
    pub name: String,
    /// Motion that the joint allows.
    pub kind: JointKind,
    /// Index of the parent in [`Model::links`].
    pub parent: usize,
    /// The joint frame in the parent link's frame at `q = 0`; the child link's frame at `q = 0`.
    pub origin: Pose,
    /// Unit vector in the joint frame.
    pub axis: DVec3,
    /// Lower position limit; negative infinity when there is none. The file's numbers beyond 1000
    /// rad or m are none.
    pub lower: f64,
    /// Upper position limit; infinity when there is none.
    pub upper: f64,
    /// Largest force or torque; infinity when there is none.
    pub effort: f64,
    /// Largest speed, rad/s or m/s; infinity when there is none.
    pub velocity: f64,
    /// Viscous friction, N m s/rad or N s/m.
    pub damping: f64,
    /// Dry friction, N m or N.
    pub friction: f64,
    /// Reflected rotor inertia, kg m^2 or kg; URDF has none, so 0 here.
    pub armature: f64,
}

impl Joint {
    /// The child link's frame in the parent link's frame at position `q` (rad or m).
    pub fn transform(&self, q: f64) -> Pose {
        self.origin * self.kind.motion(self.axis, q)
    }
}

impl JointKind {
    /// The motion of a joint of this kind by `q` (rad or m) about or along the unit vector `axis`.
    pub(super) fn motion(self, axis: DVec3, q: f64) -> Pose {
        match self {
            Self::Revolute | Self::Continuous => Pose::from_axis_angle(axis, q),
            Self::Prismatic => Pose::from_translation(axis * q),
        }
    }
}

/// A contact body: one URDF link's collision shapes.
#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    /// Name of the URDF link.
    pub name: String,
    /// Index in [`Model::links`] of the link that carries it.
    pub link: usize,
    /// Shapes of the body, at least one.
    pub shapes: Vec<Shape>,
    /// Surface where it touches the ground; a URDF says nothing of it.
    pub surface: BodySurface,
}

/// Surface of a contact body where it touches the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodySurface {
    /// Factor on the coefficients of sliding friction of robot and ground.
    pub friction: f64,
    /// Least coefficient of torsional friction, m.
    pub torsional_friction: f64,
    /// Least coefficient of rolling friction, m.
    pub rolling_friction: f64,
    /// Distance from the ground at which contact begins, m.
    pub margin: f64,
}

impl Default for BodySurface {
    fn default() -> Self {
        Self { friction: 1.0, torsional_friction: 0.0, rolling_friction: 0.0, margin: 0.0 }
    }
}

impl BodySurface {
    /// Whether friction is that of the rest of the robot.
    pub(crate) fn has_friction_of_robot(&self) -> bool {
        Self { margin: 0.0, ..*self } == Self::default()
    }
}

/// A collision shape.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// Geometry of the shape.
    pub geometry: Geometry,
    /// The shape's frame in the frame of the link that carries it.
    pub origin: Pose,
}

/// Geometry about the origin of its frame; cylinders and capsules lie along z. m.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "shape", rename_all = "snake_case")]
pub enum Geometry {
    /// Ball.
    Sphere {
        /// Radius, m.
        radius: f64,
    },
    /// Box.
    Box {
        /// Full edge lengths, m.
        #[serde(serialize_with = "as_array")]
        size: DVec3,
    },
    /// Cylinder along z.
    Cylinder {
        /// Radius, m.
        radius: f64,
        /// Full length, m.
        length: f64,
    },
    /// Cylinder along z with a half ball on each end.
    Capsule {
        /// Radius, m.
        radius: f64,
        /// Length of the cylindrical part, m.
        length: f64,
    },
    /// Convex hull of points; what a mesh is taken for.
    Hull {
        /// At least one, m.
        #[serde(serialize_with = "as_arrays")]
        points: Vec<DVec3>,
    },
}

fn as_array<S: Serializer>(vector: &DVec3, serializer: S) -> Result<S::Ok, S::Error> {
    vector.to_array().serialize(serializer)
}

fn as_arrays<S: Serializer>(vectors: &[DVec3], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(vectors.iter().map(|vector| vector.to_array()))
}

impl Model {
    /// Mass of all links, kg.
    pub fn total_mass(&self) -> f64 {
        self.links.iter().map(|link| link.mass).sum()
    }

    /// Index of the joint called `name`.
    pub fn joint_index(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|joint| joint.name == name)
    }

    /// Indices of the links whose parent is `link`, in joint order.
    pub fn children(&self, link: usize) -> impl Iterator<Item = usize> {
        self.joints.iter().enumerate().filter(move |(_, joint)| joint.parent == link).map(|(index, _)| index + 1)
    }

    /// Index of the link that `link` hangs on; `None` for the base.
    pub fn parent(&self, link: usize) -> Option<usize> {
        Some(self.joints.get(link.checked_sub(1)?)?.parent)
    }

    /// The frame of every link in the base frame at joint positions `q` (one per joint, rad or m;
    /// positions left out are 0).
    pub fn forward_kinematics(&self, q: &[f64]) -> Vec<Pose> {
        let mut poses = Vec::with_capacity(self.links.len());
        poses.push(Pose::IDENTITY);
        for (index, joint) in self.joints.iter().enumerate() {
            let position = q.get(index).copied().unwrap_or(0.0);
            poses.push(poses[joint.parent] * joint.transform(position));
        }
        poses
    }
}
