//! Robots whose state diverged in a control step.

use serde::{Deserialize, Serialize};

use super::limits::{StateLimits, Violation};
use crate::components::{
    ActuatorDelay, ActuatorMemory, BasePose, BaseVelocity, ConstraintImpulses, ExternalWrench, JointEffort, JointState,
    JointTargets,
};

/// What physics moves of one robot.
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

/// What physics saw of a control step that broke a state.
pub(crate) struct DivergenceRecord {
    pub(crate) morphology: usize,
    pub(crate) env: usize,
    pub(crate) before: Motion,
    pub(crate) targets: JointTargets,
    pub(crate) delay: ActuatorDelay,
    pub(crate) memory: ActuatorMemory,
    pub(crate) wrench: ExternalWrench,
    pub(crate) after: Motion,
}
