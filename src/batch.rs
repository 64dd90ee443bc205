//! The dense arrays between the simulator and a learner: all that Python sees.

use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

/// Row-major arrays over all envs; row `i` is env `i`.
#[derive(Resource, Clone, Debug, Serialize, Deserialize)]
pub struct Batch {
    /// Number of envs.
    pub num_envs: usize,
    /// Length of an observation.
    pub num_obs: usize,
    /// Length of an action: the canonical joints.
    pub num_actions: usize,
    /// Actions in canonical order, `[num_envs, num_actions]`; read at the start of a control step.
    pub actions: Vec<f32>,
    /// Observations after the control step (and after resets), `[num_envs, num_obs]`.
    pub observations: Vec<f32>,
    /// Rewards of the control step, `[num_envs]`.
    pub rewards: Vec<f32>,
    /// Episodes that ended in failure, `[num_envs]`.
    pub terminated: Vec<bool>,
    /// Episodes that ran out of time, `[num_envs]`.
    pub truncated: Vec<bool>,
    /// Last observation of an episode that ended in this control step, `[num_envs, num_obs]`; other rows are stale.
    pub final_observations: Vec<f32>,
    /// Which rows of `final_observations` are valid, `[num_envs]`.
    pub has_final: Vec<bool>,
}

impl Batch {
    /// All zero.
    pub fn new(num_envs: usize, num_obs: usize, num_actions: usize) -> Self {
        Self {
            num_envs,
            num_obs,
            num_actions,
            actions: vec![0.0; num_envs * num_actions],
            observations: vec![0.0; num_envs * num_obs],
            rewards: vec![0.0; num_envs],
            terminated: vec![false; num_envs],
            truncated: vec![false; num_envs],
            final_observations: vec![0.0; num_envs * num_obs],
            has_final: vec![false; num_envs],
        }
    }
    /// Whether all arrays are as long as those of `other`.
    pub(crate) fn has_sizes_of(&self, other: &Self) -> bool {
        let sizes = |batch: &Self| {
            let numbers =
                [&batch.actions, &batch.observations, &batch.rewards, &batch.final_observations].map(Vec::len);
            let flags = [&batch.terminated, &batch.truncated, &batch.has_final].map(Vec::len);
            (batch.num_envs, batch.num_obs, batch.num_actions, numbers, flags)
        };
        sizes(self) == sizes(other)
    }
}
