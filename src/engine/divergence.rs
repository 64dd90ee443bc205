//! Robots whose state diverged in a control step.

use serde::{Deserialize, Serialize};

use super::PhysicsRows;
use super::limits::{StateLimits, Violation};
use crate::components::{
    ActuatorDelay, BasePose, BaseVelocity, ConstraintImpulses, ExternalWrench, JointEffort, JointState, JointTargets,
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
    pub(crate) wrench: ExternalWrench,
    pub(crate) after: Motion,
}

impl DivergenceRecord {
    /// Writes new states to the rows of a morphology, whose envs begin at `first_env`. If a row diverged, returns its state before and
    /// after the step.
    pub(crate) fn of_writing(
        broken: Option<usize>,
        morphology: usize,
        first_env: usize,
        rows: &mut PhysicsRows,
        write: impl FnOnce(&mut PhysicsRows),
    ) -> Option<Self> {
        let before = broken.map(|row| (row, rows.motion(row)));
        write(rows);
        before.map(|(row, before)| Self {
            morphology,
            env: first_env + row,
            before,
            targets: rows.targets[row].clone(),
            delay: rows.delays[row].clone(),
            wrench: rows.wrenches[row],
            after: rows.motion(row),
        })
    }
}
