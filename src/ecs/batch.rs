//! The dense arrays between the simulator and a learner, which Python sees.

use std::ops::Range;

use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

/// Row-major arrays over all envs; row `i` is env `i`.
#[derive(Resource, Clone, Debug, Serialize, Deserialize)]
pub struct Batch {
    /// Number of envs.
    pub num_envs: usize,
    /// Length of an observation.
    pub num_obs: usize,
    /// Length of an action: the slots of the batch's robots.
    pub num_actions: usize,
    /// Actions in the order of the slots, `[num_envs, num_actions]`; read at the start of a control
    /// step.
    pub actions: Vec<f32>,
    /// Observations after the control step (and after resets), `[num_envs, num_obs]`.
    pub observations: Vec<f32>,
    /// Rewards of the control step, `[num_envs]`.
    pub rewards: Vec<f32>,
    /// Episodes that ended in failure, `[num_envs]`.
    pub terminated: Vec<bool>,
    /// Episodes that ran out of time, `[num_envs]`.
    pub truncated: Vec<bool>,
    /// Last observation of an episode that ended in this control step, `[num_envs, num_obs]`; other
    /// rows are stale.
    pub final_observations: Vec<f32>,
    /// Whether each row of `final_observations` is valid, `[num_envs]`.
    pub has_final: Vec<bool>,
}

impl Batch {
    /// Arrays of zeros.
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

    /// Appends the rows of another batch.
    pub(crate) fn append(&mut self, other: Self) {
        self.num_envs += other.num_envs;
        self.actions.extend(other.actions);
        self.observations.extend(other.observations);
        self.rewards.extend(other.rewards);
        self.terminated.extend(other.terminated);
        self.truncated.extend(other.truncated);
        self.final_observations.extend(other.final_observations);
        self.has_final.extend(other.has_final);
    }

    /// Some of its rows; None if it lacks them or its arrays have another number of rows.
    pub(crate) fn rows(&self, rows: Range<usize>) -> Option<Self> {
        let wide = |data: &[f32], width: usize| {
            let is_whole = self.num_envs.checked_mul(width) == Some(data.len());
            is_whole.then(|| data.get(rows.start * width..rows.end * width)).flatten().map(<[f32]>::to_vec)
        };
        let flags = |data: &[bool]| {
            (data.len() == self.num_envs).then(|| data.get(rows.clone())).flatten().map(<[bool]>::to_vec)
        };
        if rows.start > rows.end || rows.end > self.num_envs {
            return None;
        }
        Some(Self {
            num_envs: rows.len(),
            num_obs: self.num_obs,
            num_actions: self.num_actions,
            actions: wide(&self.actions, self.num_actions)?,
            observations: wide(&self.observations, self.num_obs)?,
            rewards: wide(&self.rewards, 1)?,
            terminated: flags(&self.terminated)?,
            truncated: flags(&self.truncated)?,
            final_observations: wide(&self.final_observations, self.num_obs)?,
            has_final: flags(&self.has_final)?,
        })
    }

    /// A copy of some rows.
    pub(crate) fn select(&self, envs: &[usize]) -> Option<Self> {
        let mut all = self.rows(0..0)?;
        for &env in envs {
            all.append(self.rows(env..env + 1)?);
        }
        Some(all)
    }

    /// Overwrites a row with one of a batch of the same widths.
    pub(crate) fn put_row(&mut self, env: usize, from: &Self, row: usize) {
        let wide = |to: &mut [f32], from: &[f32], width: usize| {
            to[env * width..(env + 1) * width].copy_from_slice(&from[row * width..(row + 1) * width]);
        };
        wide(&mut self.actions, &from.actions, self.num_actions);
        wide(&mut self.observations, &from.observations, self.num_obs);
        wide(&mut self.rewards, &from.rewards, 1);
        wide(&mut self.final_observations, &from.final_observations, self.num_obs);
        self.terminated[env] = from.terminated[row];
        self.truncated[env] = from.truncated[row];
        self.has_final[env] = from.has_final[row];
    }
}
