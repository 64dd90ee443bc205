//! What a viewer or another simulator asks of a running simulation: where the robots are and what they are made of.

use bevy_ecs::prelude::*;
use glam::{DMat3, DQuat, DVec3};
use serde::Serialize;

use crate::app::Sim;
use crate::components::{BasePose, BaseVelocity, ContactForces, EnvId, JointState, Robot};
use crate::morphology::MorphologyModel;
use crate::robot::{BodyGroup, Geometry, Pose, hull_triangles};
use crate::simulation::LinkPoses;

/// Links and collision shapes of a robot; SI units.
#[derive(Clone, Debug, Serialize)]
pub struct Outline {
    /// Names of the links, the base first; what is fixed to a link is part of it.
    pub links: Vec<String>,
    /// Centre of mass of the base in its frame, m.
    pub base_com: [f64; 3],
    /// Contact bodies: links of the URDF with collision shapes.
    pub bodies: Vec<BodyOutline>,
}

/// A contact body.
#[derive(Clone, Debug, Serialize)]
pub struct BodyOutline {
    /// Its link in the URDF.
    pub name: String,
    /// Index in [`Outline::links`] of the link that carries it.
    pub link: usize,
    /// base, hip, thigh, shank, foot or other.
    pub group: String,
    /// Its shapes.
    pub shapes: Vec<ShapeOutline>,
}

/// A collision shape; cylinders and capsules lie along z.
#[derive(Clone, Debug, Serialize)]
pub struct ShapeOutline {
    /// What it is.
    #[serde(flatten)]
    pub geometry: GeometryOutline,
    /// Of the shape's frame in that of the link that carries it, m.
    pub position: [f64; 3],
    /// Likewise; w, x, y, z.
    pub quaternion: [f64; 4],
}

/// Sizes in m.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "shape", rename_all = "snake_case")]
pub enum GeometryOutline {
    /// Ball.
    Sphere {
        /// m.
        radius: f64,
    },
    /// Box with these edge lengths.
    Box {
        /// m.
        size: [f64; 3],
    },
    /// Cylinder of full length.
    Cylinder {
        /// m.
        radius: f64,
        /// m.
        length: f64,
    },
    /// Cylinder with a half ball on each end; the length is the cylinder's.
    Capsule {
        /// m.
        radius: f64,
        /// m.
        length: f64,
    },
    /// Convex hull of points.
    Hull {
        /// m.
        points: Vec<[f64; 3]>,
        /// Its faces, outward, as indices of points; none where they cannot be told.
        triangles: Vec<[usize; 3]>,
    },
}

/// An orientation as w, x, y, z with `w >= 0`.
fn quaternion(rotation: &DMat3) -> [f64; 4] {
    let q = DQuat::from_mat3(rotation).normalize();
    let q = if q.w < 0.0 { -q } else { q };
    [q.w, q.x, q.y, q.z]
}

impl From<&Geometry> for GeometryOutline {
    fn from(geometry: &Geometry) -> Self {
        match geometry {
            Geometry::Sphere { radius } => Self::Sphere { radius: *radius },
            Geometry::Box { size } => Self::Box { size: size.to_array() },
            Geometry::Cylinder { radius, length } => Self::Cylinder { radius: *radius, length: *length },
            Geometry::Capsule { radius, length } => Self::Capsule { radius: *radius, length: *length },
            Geometry::Hull { points } => {
                Self::Hull { points: points.iter().map(|p| p.to_array()).collect(), triangles: hull_triangles(points) }
            }
        }
    }
}

impl MorphologyModel {
    /// Its links and collision shapes.
    pub fn outline(&self) -> Outline {
        let shape = |shape: &crate::robot::Shape| ShapeOutline {
            geometry: GeometryOutline::from(&shape.geometry),
            position: shape.origin.translation.to_array(),
            quaternion: quaternion(&shape.origin.rotation),
        };
        let body = |(body, group): (&crate::robot::Body, &BodyGroup)| BodyOutline {
            name: body.name.clone(),
            link: body.link,
            group: format!("{group:?}").to_lowercase(),
            shapes: body.shapes.iter().map(shape).collect(),
        };
        Outline {
            links: self.model.links.iter().map(|link| link.name.clone()).collect(),
            base_com: self.model.links.first().map_or([0.0; 3], |base| base.com.to_array()),
            bodies: self.model.bodies.iter().zip(&self.body_groups).map(body).collect(),
        }
    }
}

/// State of the robots of one kind, row-major, a row per env; see [`simulation`](crate::simulation) for the layout.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotStates {
    /// `[envs, 7 + joints]`; the position is relative to the env's origin.
    pub qpos: Vec<f64>,
    /// `[envs, 6 + joints]`.
    pub qvel: Vec<f64>,
}

impl Sim {
    /// States of the envs of the robot at place `index`.
    pub fn robot_states(&mut self, index: usize) -> RobotStates {
        let envs = self.env_ids(index);
        let joints = self.morphologies().get(index).map_or(0, |model| model.topology.num_joints());
        let (nq, nv) = (7 + joints, 6 + joints);
        let mut states = RobotStates { qpos: vec![0.0; envs.len() * nq], qvel: vec![0.0; envs.len() * nv] };
        let world = self.world_mut();
        let mut robots = world.query_filtered::<(&EnvId, &BasePose, &BaseVelocity, &JointState), With<Robot>>();
        for (env, pose, velocity, joints) in robots.iter(world) {
            let env = env.0 as usize;
            if envs.contains(&env) {
                let row = env - envs.start;
                let position = pose.position.iter().chain(&pose.rotation).chain(&joints.position);
                let rate = velocity.linear.iter().chain(&velocity.angular).chain(&joints.velocity);
                copy(&mut states.qpos[row * nq..(row + 1) * nq], position);
                copy(&mut states.qvel[row * nv..(row + 1) * nv], rate);
            }
        }
        states
    }

    /// Where the links of the robot at place `index` are, relative to the env's origin.
    pub fn link_pose(&mut self, index: usize) -> LinkPoses {
        let states = self.robot_states(index);
        let envs = self.env_ids(index).len();
        let mut poses = LinkPoses { position: Vec::new(), quaternion: Vec::new() };
        let Some(robot) = self.morphologies().get(index) else {
            return poses;
        };
        for row in states.qpos.chunks_exact(states.qpos.len() / envs.max(1)) {
            let rotation = DQuat::from_xyzw(row[4], row[5], row[6], row[3]).normalize();
            let base = Pose { rotation: DMat3::from_quat(rotation), translation: DVec3::from_slice(row) };
            for link in robot.model.forward_kinematics(&row[7..]) {
                let link = base * link;
                poses.position.extend(link.translation.to_array());
                poses.quaternion.extend(quaternion(&link.rotation));
            }
        }
        poses
    }

    /// Net force on each contact body of the robot at place `index` in the last physics step, world axes, N,
    /// `[envs, bodies, 3]`.
    pub fn contact_forces(&mut self, index: usize) -> Vec<f64> {
        let envs = self.env_ids(index);
        let Some(model) = self.morphologies().get(index) else {
            return Vec::new();
        };
        let (bodies, feet) = (model.topology.num_bodies, model.feet);
        let width = 3 * bodies;
        let mut forces = vec![0.0; envs.len() * width];
        let world = self.world_mut();
        for (env, touching) in world.query_filtered::<(&EnvId, &ContactForces), With<Robot>>().iter(world) {
            let env = env.0 as usize;
            if envs.contains(&env) {
                let row = env - envs.start;
                copy(&mut forces[row * width..(row + 1) * width], touching.net(bodies, &feet).as_flattened().iter());
            }
        }
        forces
    }
}

fn copy<'a>(to: &mut [f64], from: impl Iterator<Item = &'a f32>) {
    for (x, y) in to.iter_mut().zip(from) {
        *x = f64::from(*y);
    }
}
