//! Robots whose state diverged in a control step.

use serde::{Deserialize, Serialize};

use super::limits::{StateLimits, Violation};
use crate::components::{
    ActuatorDelay, ActuatorMemory, BasePose, BaseVelocity, ConstraintImpulses, ExternalWrench, JointEffort, JointState,
    JointTargets, LinkForces,
};

/// Motion of one robot: the numbers that physics integrates.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Motion {
    /// Pose of the base.
    pub pose: BasePose,
    /// Velocity of the base.
    pub velocity: BaseVelocity,
    /// Joint positions and velocities, physical order.
    pub joints: JointState,
    /// Joint efforts and accelerations of the last physics step, physical order.
    pub effort: JointEffort,
    /// Impulses of contacts and joint limits in the last physics step.
    pub impulses: ConstraintImpulses,
}

impl Motion {
    /// The first number that is not finite or beyond its limit.
    pub fn violation(&self, limits: &StateLimits) -> Option<Violation> {
        let numbers = [
            &self.pose.position[..],
            &self.pose.rotation,
            &self.velocity.linear,
            &self.velocity.angular,
            &self.joints.position,
            &self.joints.velocity,
            &self.effort.applied,
        ];
        limits.violation(numbers, |x| x)
    }
}

/// Record of a control step that broke a state: its inputs and its result.
pub struct DivergenceRecord {
    /// The env's morphology.
    pub morphology: usize,
    /// Env whose state broke.
    pub env: usize,
    /// The robot before the step.
    pub before: Motion,
    /// Targets of its actuators.
    pub targets: JointTargets,
    /// Delay of its actuators.
    pub delay: ActuatorDelay,
    /// Memory of its actuator networks before the step.
    pub memory: ActuatorMemory,
    /// Force and torque from outside.
    pub wrench: ExternalWrench,
    /// Forces on links from outside.
    pub link_forces: LinkForces,
    /// The robot after the step, with its broken state.
    pub after: Motion,
}
