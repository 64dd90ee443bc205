//! States that broke, with all that is needed to step there again.

use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

use super::terms::CompiledTask;
use crate::blocks::Blocks;
use crate::components::{
    ActuatorDelay, ActuatorMemory, Body, Env, EnvId, Episode, ExternalWrench, JointTargets, LinkForces, Robot,
};
use crate::engine::{DivergenceRecord, Motion, StateLimits};

/// A control step that broke a state: what went in and what came out.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct BrokenState {
    /// Env whose state broke.
    pub env: EnvId,
    /// Control steps of the simulation before this one, since it was made.
    pub step: u64,
    /// Control steps of the episode before this one.
    pub episode_step: u32,
    /// Limits beyond which a state counts as broken.
    pub limits: StateLimits,
    /// The robot before the control step's physics; pushes and the like have happened.
    pub before: Motion,
    /// Targets of its actuators.
    pub targets: JointTargets,
    /// Delay of its actuators.
    pub delay: ActuatorDelay,
    /// Memory of its actuator networks.
    pub memory: ActuatorMemory,
    /// Force and torque from outside.
    pub wrench: ExternalWrench,
    /// Forces on links from outside.
    pub link_forces: LinkForces,
    /// The robot's own numbers.
    pub body: Body,
    /// The robot after it: broken.
    pub after: Motion,
}

impl BrokenState {
    fn new(record: DivergenceRecord, step: u64, episode_step: u32, limits: StateLimits, body: Body) -> Self {
        let DivergenceRecord { env, before, targets, delay, memory, wrench, link_forces, after, .. } = record;
        let env = EnvId(env as u32);
        Self { env, step, episode_step, limits, before, targets, delay, memory, wrench, link_forces, body, after }
    }
}

/// Watches for states that break and keeps the first one of each morphology.
#[derive(Resource)]
pub struct BrokenStates {
    watched: Vec<bool>,
    seen: Vec<bool>,
    step: u64,
    records: Vec<DivergenceRecord>,
    found: Vec<(usize, BrokenState)>,
}

impl BrokenStates {
    /// Watches none of `morphologies` morphologies.
    pub fn new(morphologies: usize) -> Self {
        let none = vec![false; morphologies];
        Self { watched: none.clone(), seen: none, step: 0, records: Vec::new(), found: Vec::new() }
    }

    /// Watches all morphologies of which no broken state was found yet, or none.
    pub fn watch(&mut self, on: bool) {
        for (watched, seen) in self.watched.iter_mut().zip(&self.seen) {
            *watched = on && !seen;
        }
    }

    /// Broken states since the last call, each with the place of its morphology.
    pub fn take(&mut self) -> Vec<(usize, BrokenState)> {
        std::mem::take(&mut self.found)
    }

    pub(super) fn watched(&self) -> &[bool] {
        &self.watched
    }

    /// Counts a control step that a device made alone. `found` are the records of the robots whose
    /// states it broke, each with the length of its episode before, and the robot's body.
    pub(super) fn count_step(&mut self, found: Vec<(DivergenceRecord, u32, Body)>, limits: StateLimits) {
        for (record, episode_step, body) in found {
            let morphology = record.morphology;
            self.watched[morphology] = false;
            self.seen[morphology] = true;
            self.found.push((morphology, BrokenState::new(record, self.step, episode_step, limits, body)));
        }
        self.step += 1;
    }

    pub(super) fn note(&mut self, records: Vec<DivergenceRecord>) {
        for found in &records {
            self.watched[found.morphology] = false;
            self.seen[found.morphology] = true;
        }
        self.records = records;
    }
}

/// Adds to the records what physics does not see.
pub(super) fn describe_broken_states(
    task: Res<CompiledTask>,
    mut broken: ResMut<BrokenStates>,
    robots: Blocks<&'static Body, Robot>,
    envs: Blocks<&'static Episode, Env>,
) -> Result {
    let broken = &mut *broken;
    if !broken.records.is_empty() {
        let (robots, envs) = (robots.read()?, envs.read()?);
        let described = broken.records.drain(..).filter_map(|record| {
            let ((bodies, row), (episodes, _)) = (robots.at(record.env)?, envs.at(record.env)?);
            let (morphology, length, body) = (record.morphology, episodes[row].length, bodies[row].clone());
            Some((morphology, BrokenState::new(record, broken.step, length, task.limits, body)))
        });
        broken.found.extend(described);
    }
    broken.step += 1;
    Ok(())
}
