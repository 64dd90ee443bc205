//! Views for terms: a robot, its body, its new state.

use super::commanded::CommandView;
use crate::components::{
    Action, ActuatorDelay, BasePose, BaseVelocity, ContactSensor, EnvOrigin, ExternalWrench, Feet, Imu, JointEffort,
    JointState, Stance,
};
use crate::dynamics::Parameters;
use crate::morphology::MorphologyModel;
use crate::world::Ground;

/// All that reward, observation and termination terms may read of one robot and its env.
#[derive(Clone, Copy)]
pub struct RobotView<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Forward and left velocity (m/s) and yaw rate (rad/s) that it is to follow, base frame.
    pub command: &'a [f32; 3],
    /// Numbers of the robot's other commands.
    pub commands: CommandView<'a>,
    /// Pose of the base; see [`base_height`](Self::base_height) for its height above the ground.
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
    /// Heights of the ground where the height scanner's rays hit it, m; empty where the task has
    /// none.
    pub height_scan: &'a [f32],
    /// Distances of the pixels of its depth camera, rows from top to bottom, m; empty where it has
    /// none.
    pub image: &'a [f32],
    /// Whether the image is another than in the control step before.
    pub is_new_image: bool,
    /// Descriptions of its joints, see [`JointDescriptors`](crate::components::JointDescriptors);
    /// empty where the task does not observe them.
    pub joint_descriptors: &'a [f32],
    /// The robot's own numbers, as randomised.
    pub body: &'a Parameters<f32>,
    /// Default pose and action scale of this body.
    pub stance: &'a Stance,
    /// Ground that the robots stand on, and gravity.
    pub ground: &'a Ground,
    /// Place of the env on the ground.
    pub origin: &'a EnvOrigin,
    /// Whether the episode ends as failed in this step. Rewards alone know: for other terms it is
    /// false.
    pub terminated: bool,
    /// Length of a control step, s.
    pub step_dt: f32,
}

impl RobotView<'_> {
    /// Height of the base above level ground in this body's default pose, m.
    #[inline(always)]
    pub fn default_height(&self) -> f32 {
        self.stance.spawn_height - self.morphology.config.reset.spawn_margin as f32
    }

    /// Height of the base's origin above the ground below it, m; above the mean of the ground below
    /// the height scanner's rays where the task has one, as Isaac Lab does.
    #[inline(always)]
    pub fn base_height(&self) -> f32 {
        let (scan, [x, y, z]) = (self.height_scan, self.pose.position);
        let ground = match scan.len() {
            0 => self.ground.height_at(self.origin, [x, y]),
            rays => scan.iter().sum::<f32>() / rays as f32,
        };
        z - ground
    }
}

/// A robot's numbers, as events of its body may change them.
pub struct NewBody<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Ground that it will stand on.
    pub ground: &'a Ground,
    /// Masses, lengths, gains and friction: at startup the morphology's, at a reset the result of
    /// the startup events.
    pub parameters: &'a mut Parameters<f32>,
    /// Default pose, action scale and the height at which its episodes begin, with the same start.
    pub stance: &'a mut Stance,
}

impl NewBody<'_> {
    /// Sets the robot's friction coefficients; the ground's are combined with them.
    pub fn set_material(&mut self, static_friction: f32, dynamic_friction: f32) {
        let [static_friction, dynamic_friction] = self.ground.friction_with([static_friction, dynamic_friction]);
        self.parameters.static_friction = static_friction;
        self.parameters.dynamic_friction = dynamic_friction;
    }

    /// Sets the coefficients of torsional and rolling friction of the robot's surface, m; `None`
    /// leaves one as it is. The larger one of robot and ground acts. They act on robots for which
    /// the task has such friction: see
    /// [`CompiledTask::contact_friction`](super::CompiledTask::contact_friction).
    pub fn set_spin_friction(&mut self, torsional: Option<f32>, rolling: Option<f32>) {
        let of_robot = [torsional, rolling].map(Option::unwrap_or_default);
        let [combined_torsional, combined_rolling] = self.ground.spin_friction_with(of_robot);
        if torsional.is_some() {
            self.parameters.torsional_friction = combined_torsional;
        }
        if rolling.is_some() {
            self.parameters.rolling_friction = combined_rolling;
        }
    }
}

/// The state in which an episode begins, as reset events may change it.
pub struct NewState<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Pose of the base; starts at the env's origin, at the spawn height above level ground, level.
    /// Afterwards it is lifted onto what stands there, and further until no collision shape is
    /// nearer to the ground than the reset's `spawn_margin`.
    pub pose: &'a mut BasePose,
    /// Velocity of the base; starts at rest.
    pub velocity: &'a mut BaseVelocity,
    /// Joints; start at rest in the default pose.
    pub joints: &'a mut JointState,
    /// Delay of each joint's targets; starts as the actuators' own delays.
    pub delay: &'a mut ActuatorDelay,
    /// Force and torque from outside; start at zero.
    pub wrench: &'a mut ExternalWrench,
    /// The robot's own numbers.
    pub body: &'a Parameters<f32>,
}

/// Robot as an interval event may change it.
pub struct EventBody<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Force and torque from outside; hold until the next reset or event.
    pub wrench: &'a mut ExternalWrench,
    /// Velocity of the base.
    pub velocity: &'a mut BaseVelocity,
}
