//! States that broke, with all that is needed to step there again.

use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

use super::terminate::{StateLimits, Violation};
use super::terms::CompiledTask;
use crate::components::{
    ActuatorDelay, BasePose, BaseVelocity, Body, ConstraintImpulses, EnvId, Episode, ExternalWrench, JointEffort,
    JointState, JointTargets,
};
use crate::rows::read_rows;

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
pub(super) struct Evidence {
    pub(super) morphology: usize,
    pub(super) env: usize,
    pub(super) before: Motion,
    pub(super) targets: JointTargets,
    pub(super) delay: ActuatorDelay,
    pub(super) wrench: ExternalWrench,
    pub(super) after: Motion,
}

/// A control step that broke a state: what went in and what came out.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct BrokenState {
    /// The env.
    pub env: EnvId,
    /// Control steps of the simulation before this one, since it was made.
    pub step: u64,
    /// Control steps of the episode before this one.
    pub episode_step: u32,
    /// What counted as broken.
    pub limits: StateLimits,
    /// The robot before the control step's physics; pushes and the like have happened.
    pub before: Motion,
    /// What its actuators were asked for.
    pub targets: JointTargets,
    /// How late they were asked for it.
    pub delay: ActuatorDelay,
    /// Force and torque from outside.
    pub wrench: ExternalWrench,
    /// The robot's own numbers.
    pub body: Body,
    /// The robot after it: broken.
    pub after: Motion,
}

/// Watches for states that break and keeps the first one of each morphology.
#[derive(Resource)]
pub struct BrokenStates {
    watched: Vec<bool>,
    seen: Vec<bool>,
    step: u64,
    evidence: Vec<Evidence>,
    found: Vec<(usize, BrokenState)>,
}

impl BrokenStates {
    /// Watches none of so many morphologies.
    pub fn new(morphologies: usize) -> Self {
        let none = vec![false; morphologies];
        Self { watched: none.clone(), seen: none, step: 0, evidence: Vec::new(), found: Vec::new() }
    }

    /// Watches all morphologies of which no broken state was found yet, or none.
    pub fn watch(&mut self, on: bool) {
        for (watched, seen) in self.watched.iter_mut().zip(&self.seen) {
            *watched = on && !seen;
        }
    }

    /// What was found since the last call, each with the place of its morphology.
    pub fn take(&mut self) -> Vec<(usize, BrokenState)> {
        std::mem::take(&mut self.found)
    }

    pub(super) fn watched(&self) -> &[bool] {
        &self.watched
    }

    pub(super) fn note(&mut self, evidence: Vec<Evidence>) {
        for found in &evidence {
            self.watched[found.morphology] = false;
            self.seen[found.morphology] = true;
        }
        self.evidence = evidence;
    }
}

/// Adds to the evidence what physics does not see.
pub(super) fn describe_broken_states(
    task: Res<CompiledTask>,
    mut broken: ResMut<BrokenStates>,
    bodies: Query<&'static Body>,
    episodes: Query<&'static Episode>,
) {
    let broken = &mut *broken;
    if !broken.evidence.is_empty() {
        let (bodies, episodes) = (read_rows(&bodies), read_rows(&episodes));
        let described =
            broken.evidence.drain(..).map(|Evidence { morphology, env, before, targets, delay, wrench, after }| {
                let state = BrokenState {
                    env: EnvId(env as u32),
                    step: broken.step,
                    episode_step: episodes[env].length,
                    limits: task.limits,
                    before,
                    targets,
                    delay,
                    wrench,
                    body: bodies[env].clone(),
                    after,
                };
                (morphology, state)
            });
        broken.found.extend(described);
    }
    broken.step += 1;
}
