//! One robot as the terms see it.

use bevy_ecs::prelude::*;
use bevy_ecs::system::SystemParam;

use crate::components::{
    Action, BasePose, BaseVelocity, Body, Command, ContactSensor, Feet, HeightScan, Imu, JointEffort, JointState,
    Morphology, Robot, Stance,
};
use crate::dynamics::Parameters;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::rows::read_rows;

/// All that reward, observation and termination terms may read of one robot and its env.
#[derive(Clone, Copy)]
pub struct RobotView<'a> {
    /// What kind of robot it is.
    pub morphology: &'a MorphologyModel,
    /// Forward and left velocity (m/s) and yaw rate (rad/s) that it is to follow, base frame.
    pub command: &'a [f32; 3],
    /// Pose of the base, position relative to the env's origin.
    pub pose: &'a BasePose,
    /// Velocity of the base.
    pub velocity: &'a BaseVelocity,
    /// Velocity and gravity in the base frame.
    pub imu: &'a Imu,
    /// Joint positions and velocities, physical order.
    pub joints: &'a JointState,
    /// Joint efforts and accelerations, physical order.
    pub effort: &'a JointEffort,
    /// Present and previous action, canonical order.
    pub action: &'a Action,
    /// Contact forces and times.
    pub contacts: &'a ContactSensor,
    /// Positions, velocities and heights of the feet.
    pub feet: &'a Feet,
    /// Heights of the ground where the height scanner's rays hit it, m; empty where the task has none.
    pub height_scan: &'a [f32],
    /// The robot's own numbers, as randomised.
    pub body: &'a Parameters<f32>,
    /// Default pose and action scale of this body.
    pub stance: &'a Stance,
    /// Whether the episode ends as failed in this step. Rewards alone know: for other terms it is false.
    pub terminated: bool,
    /// Length of a control step, s.
    pub step_dt: f32,
}

/// System parameter that gives [`Views`].
#[derive(SystemParam)]
pub(super) struct ViewParam<'w, 's> {
    morphologies: Res<'w, Morphologies>,
    tags: Query<'w, 's, &'static Morphology, With<Robot>>,
    commands: Query<'w, 's, &'static Command>,
    poses: Query<'w, 's, &'static BasePose>,
    velocities: Query<'w, 's, &'static BaseVelocity>,
    imus: Query<'w, 's, &'static Imu>,
    joints: Query<'w, 's, &'static JointState>,
    efforts: Query<'w, 's, &'static JointEffort>,
    actions: Query<'w, 's, &'static Action>,
    contacts: Query<'w, 's, &'static ContactSensor>,
    feet: Query<'w, 's, &'static Feet>,
    scans: Query<'w, 's, &'static HeightScan>,
    bodies: Query<'w, 's, &'static Body>,
    stances: Query<'w, 's, &'static Stance>,
}

impl ViewParam<'_, '_> {
    pub(super) fn views(&self, step_dt: f32) -> Views<'_> {
        Views {
            morphologies: &self.morphologies,
            tags: read_rows(&self.tags),
            commands: read_rows(&self.commands),
            poses: read_rows(&self.poses),
            velocities: read_rows(&self.velocities),
            imus: read_rows(&self.imus),
            joints: read_rows(&self.joints),
            efforts: read_rows(&self.efforts),
            actions: read_rows(&self.actions),
            contacts: read_rows(&self.contacts),
            feet: read_rows(&self.feet),
            scans: read_rows(&self.scans),
            bodies: read_rows(&self.bodies),
            stances: read_rows(&self.stances),
            step_dt,
        }
    }
}

/// The views of all robots, by env.
#[derive(Clone, Copy)]
pub(super) struct Views<'a> {
    morphologies: &'a Morphologies,
    pub(super) tags: &'a [Morphology],
    commands: &'a [Command],
    poses: &'a [BasePose],
    velocities: &'a [BaseVelocity],
    imus: &'a [Imu],
    joints: &'a [JointState],
    efforts: &'a [JointEffort],
    actions: &'a [Action],
    contacts: &'a [ContactSensor],
    feet: &'a [Feet],
    scans: &'a [HeightScan],
    bodies: &'a [Body],
    stances: &'a [Stance],
    step_dt: f32,
}

impl<'a> Views<'a> {
    pub(super) fn len(&self) -> usize {
        self.tags.len()
    }

    #[inline(always)]
    pub(super) fn get(&self, env: usize) -> RobotView<'a> {
        RobotView {
            morphology: self.morphologies.get(self.tags[env]),
            command: &self.commands[env].velocity,
            pose: &self.poses[env],
            velocity: &self.velocities[env],
            imu: &self.imus[env],
            joints: &self.joints[env],
            effort: &self.efforts[env],
            action: &self.actions[env],
            contacts: &self.contacts[env],
            feet: &self.feet[env],
            height_scan: self.scans.get(env).map_or(&[], |scan| &scan.hits),
            body: &self.bodies[env].0,
            stance: &self.stances[env],
            terminated: false,
            step_dt: self.step_dt,
        }
    }
}
