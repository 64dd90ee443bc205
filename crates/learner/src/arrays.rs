//! The samples of an iteration as flat arrays, for a learner elsewhere.

use crate::learner::{Learner, Team};
use crate::lines::{Line, WIDTH, lines_of};
use crate::rollout::{End, Part};
use crate::settings::LearnerError;

/// Destination of an iteration's samples, by steps and envs, as rsl_rl stores them.
#[derive(Debug)]
pub struct RolloutArrays<'a> {
    /// Observations, `[steps, envs, num_obs]`.
    pub observations: &'a mut [f32],
    /// Actions, `[steps, envs, num_actions]`.
    pub actions: &'a mut [f32],
    /// Means of the policy, `[steps, envs, num_actions]`.
    pub means: &'a mut [f32],
    /// Rewards of the simulator, `[steps, envs]`.
    pub rewards: &'a mut [f32],
    /// `[steps, envs]`: 0 while an episode goes on, 1 where it terminated, 2 where its time was up.
    pub ends: &'a mut [u8],
    /// Logarithms of the actions' probability density, `[steps, envs]`.
    pub log_probs: &'a mut [f32],
    /// Values, `[steps, envs]`.
    pub values: &'a mut [f32],
    /// Returns, `[steps, envs]`.
    pub returns: &'a mut [f32],
    /// Scaled advantages, `[steps, envs]`.
    pub advantages: &'a mut [f32],
    /// `[steps, envs]`: number of the sample in its block of envs.
    pub places: &'a mut [u32],
}

impl Learner {
    /// Number of samples of an iteration, of this worker's envs.
    pub fn num_own_samples(&self) -> usize {
        self.num_own_envs() * self.settings.options.num_steps_per_env
    }

    /// Writes the samples of the iteration.
    ///
    /// # Errors
    /// Arrays of other sizes.
    pub fn write_rollout(&self, team: &impl Team, arrays: RolloutArrays) -> Result<(), LearnerError> {
        let samples = self.num_own_samples();
        for (name, found, wanted) in arrays.sizes(self.widths(), samples) {
            if found != wanted {
                return Err(LearnerError::new(name, format!("it has {found} numbers, not {wanted}")));
            }
        }
        let (mut rest, mut tasks) = (arrays, Vec::new());
        for step in 0..self.settings.options.num_steps_per_env {
            for part in &self.parts {
                let (mine, more) = rest.split(self.widths(), part.len());
                rest = more;
                tasks.push((part, step, mine));
            }
        }
        team.for_each(tasks, |(part, step, arrays)| self.write_step(part, step, arrays));
        Ok(())
    }

    /// Samples in the order in which the mini-batches take them: `step * envs + env`.
    pub fn order(&self) -> Vec<u32> {
        let (num_envs, batches) = (self.num_own_envs(), self.settings.options.algorithm.num_mini_batches);
        let mut order = Vec::with_capacity(self.num_own_samples());
        for batch in 0..batches {
            for part in &self.parts {
                let global = |&sample: &u32| {
                    let (step, env) = (sample as usize / part.len(), sample as usize % part.len());
                    (step * num_envs + part.rows.start + env) as u32
                };
                order.extend(part.mini_batch(batch, batches).iter().map(global));
            }
        }
        order
    }

    /// Number of this worker's samples in each mini-batch.
    pub fn batch_sizes(&self) -> Vec<u32> {
        let batches = self.settings.options.algorithm.num_mini_batches;
        let samples = |batch| self.parts.iter().map(|part| part.mini_batch(batch, batches).len() as u32).sum();
        (0..batches).map(samples).collect()
    }

    fn widths(&self) -> [usize; 2] {
        [self.settings.num_obs, self.settings.num_actions]
    }

    fn write_step(&self, part: &Part, step: usize, to: RolloutArrays) {
        let (samples, [num_obs, num_actions]) = (step * part.len()..(step + 1) * part.len(), self.widths());
        write_rows(&part.observations, samples.start, num_obs, to.observations);
        write_rows(&part.actions, samples.start, num_actions, to.actions);
        write_rows(&part.means, samples.start, num_actions, to.means);
        to.rewards.copy_from_slice(&part.rewards[samples.clone()]);
        to.log_probs.copy_from_slice(&part.log_probs[samples.clone()]);
        to.values.copy_from_slice(&part.values[samples.clone()]);
        to.returns.copy_from_slice(&part.returns[samples.clone()]);
        for (env, sample) in samples.enumerate() {
            to.ends[env] = match part.ends[sample] {
                End::None => 0,
                End::Terminated => 1,
                End::TimeOut => 2,
            };
            let (mean, inverse) = self.advantage_scale[part.robot_of[env]];
            to.advantages[env] = (part.advantages[sample] - mean) * inverse;
            to.places[env] = sample as u32;
        }
    }
}

impl<'a> RolloutArrays<'a> {
    /// Name, length and expected length of each array.
    fn sizes(&self, [num_obs, num_actions]: [usize; 2], samples: usize) -> [(&'static str, usize, usize); 10] {
        [
            ("observations", self.observations.len(), samples * num_obs),
            ("actions", self.actions.len(), samples * num_actions),
            ("means", self.means.len(), samples * num_actions),
            ("rewards", self.rewards.len(), samples),
            ("ends", self.ends.len(), samples),
            ("log_probs", self.log_probs.len(), samples),
            ("values", self.values.len(), samples),
            ("returns", self.returns.len(), samples),
            ("advantages", self.advantages.len(), samples),
            ("places", self.places.len(), samples),
        ]
    }

    /// The first `samples` and the others.
    fn split(self, [num_obs, num_actions]: [usize; 2], samples: usize) -> (Self, Self) {
        let (observations, more_observations) = self.observations.split_at_mut(samples * num_obs);
        let (actions, more_actions) = self.actions.split_at_mut(samples * num_actions);
        let (means, more_means) = self.means.split_at_mut(samples * num_actions);
        let (rewards, more_rewards) = self.rewards.split_at_mut(samples);
        let (ends, more_ends) = self.ends.split_at_mut(samples);
        let (log_probs, more_log_probs) = self.log_probs.split_at_mut(samples);
        let (values, more_values) = self.values.split_at_mut(samples);
        let (returns, more_returns) = self.returns.split_at_mut(samples);
        let (advantages, more_advantages) = self.advantages.split_at_mut(samples);
        let (places, more_places) = self.places.split_at_mut(samples);
        (
            Self { observations, actions, means, rewards, ends, log_probs, values, returns, advantages, places },
            Self {
                observations: more_observations,
                actions: more_actions,
                means: more_means,
                rewards: more_rewards,
                ends: more_ends,
                log_probs: more_log_probs,
                values: more_values,
                returns: more_returns,
                advantages: more_advantages,
                places: more_places,
            },
        )
    }
}

/// Writes rows of `width` numbers from rows of lines, from the row `first` on.
fn write_rows(lines: &[Line], first: usize, width: usize, to: &mut [f32]) {
    let of_row = lines_of(width);
    for (row, lines) in to.chunks_exact_mut(width).zip(lines[first * of_row..].chunks_exact(of_row)) {
        for (numbers, line) in row.chunks_mut(WIDTH).zip(lines) {
            numbers.copy_from_slice(&line.0[..numbers.len()]);
        }
    }
}
