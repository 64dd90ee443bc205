//! Samples of a part's envs in an iteration, and their values, scaled rewards, returns and
//! advantages.

use std::ops::Range;

use crate::bodies::Bodies;
use crate::device::DevicePart;
use crate::lines::{Line, WIDTH, lines_of};
use crate::moments::Moments;
use crate::network::{Mirror, Net, NetworkName};
use crate::settings::{Robot, Settings};

/// Largest number of parts of the envs.
const MOST_PARTS: usize = 32;
/// Least number of envs of a part.
const LEAST_ENVS: usize = 16;

/// The envs of each part. They depend on the number of envs alone, and so do all sums.
pub(crate) fn parts_of(num_envs: usize) -> impl Iterator<Item = Range<usize>> {
    let count = (num_envs / LEAST_ENVS).clamp(1, MOST_PARTS);
    (0..count).map(move |part| part * num_envs / count..(part + 1) * num_envs / count)
}

/// The share of a mini-batch in `count` samples.
pub(crate) fn share(count: usize, batch: usize, batches: usize) -> Range<usize> {
    batch * count / batches..(batch + 1) * count / batches
}

/// A block of envs that is simulated, stored and learnt from separately.
///
/// Sample `step * num_envs + env` is that of the part's env `env` at step `step`.
pub(crate) struct Part {
    /// Numbers of the envs among those of all workers.
    pub(crate) envs: Range<usize>,
    /// Rows of the envs in this worker's arrays.
    pub(crate) rows: Range<usize>,
    /// Robots of the part, with their envs, counted from the part's first.
    pub(crate) blocks: Vec<(usize, Range<usize>)>,
    /// Robot of each of its envs.
    pub(crate) robot_of: Vec<usize>,
    /// Raw observations, `[samples][lines of an observation]`.
    pub(crate) observations: Vec<Line>,
    /// Actions, `[samples][lines of an action]`.
    pub(crate) actions: Vec<Line>,
    /// Mean of the policy, `[samples][lines of an action]`.
    pub(crate) means: Vec<Line>,
    /// Logarithm of the action's probability density, `[samples]`.
    pub(crate) log_probs: Vec<f32>,
    /// Raw rewards, `[samples]`.
    pub(crate) rewards: Vec<f32>,
    pub(crate) ends: Vec<End>,
    pub(crate) values: Vec<f32>,
    /// Values of the observations after the last step, `[envs]`.
    pub(crate) last_values: Vec<f32>,
    pub(crate) returns: Vec<f32>,
    pub(crate) advantages: Vec<f32>,
    /// Discounted sum of the rewards so far, `[envs]`.
    pub(crate) discounted: Vec<f32>,
    /// Sum of the rewards of the present episode, `[envs]`.
    pub(crate) episode_reward: Vec<f32>,
    /// Control steps so far of the present episode, `[envs]`.
    pub(crate) episode_length: Vec<f32>,
    /// Samples in the order in which they are learnt from.
    pub(crate) order: Vec<u32>,
    /// Bodies of the samples, as the actor and the critic read them.
    pub(crate) bodies: [Bodies; 2],
}

/// State of an env's episode after a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum End {
    None,
    /// The episode ended; later rewards count nothing.
    Terminated,
    /// The episode's time was up; the value stands for the later rewards.
    TimeOut,
}

/// An episode that ended: its step and env, its return and its length.
#[derive(Clone, Copy, Debug)]
pub struct Episode {
    /// Step of the iteration.
    pub step: usize,
    /// Global index of the env.
    pub env: usize,
    /// Sum of its rewards.
    pub reward: f32,
    /// Length, control steps.
    pub length: f32,
}

impl Part {
    /// Part of the worker whose first env is `first_env`.
    pub(crate) fn new(envs: Range<usize>, first_env: usize, settings: &Settings) -> Self {
        let count = envs.len();
        let samples = count * settings.options.num_steps_per_env;
        let overlap = |(robot, of): (usize, &crate::settings::Robot)| {
            let (first, end) = (of.envs.0.max(envs.start), of.envs.1.min(envs.end));
            (first < end).then(|| (robot, first - envs.start..end - envs.start))
        };
        let blocks: Vec<_> = settings.robots.iter().enumerate().filter_map(overlap).collect();
        let robot_of = blocks.iter().flat_map(|(robot, of)| of.clone().map(|_| *robot)).collect();
        let lines = |numbers: usize| vec![Line::ZERO; samples * lines_of(numbers)];
        Self {
            observations: lines(settings.num_obs),
            actions: lines(settings.num_actions),
            means: lines(settings.num_actions),
            log_probs: vec![0.0; samples],
            rewards: vec![0.0; samples],
            ends: vec![End::None; samples],
            values: vec![0.0; samples],
            last_values: vec![0.0; count],
            returns: vec![0.0; samples],
            advantages: vec![0.0; samples],
            discounted: vec![0.0; count],
            episode_reward: vec![0.0; count],
            episode_length: vec![0.0; count],
            order: Vec::new(),
            bodies: Default::default(),
            rows: envs.start - first_env..envs.end - first_env,
            envs,
            blocks,
            robot_of,
        }
    }

    /// Number of its envs.
    pub(crate) fn len(&self) -> usize {
        self.envs.len()
    }

    /// Its samples, for a device.
    pub(crate) fn on_device(&self) -> DevicePart<'_> {
        DevicePart {
            robot_of: &self.robot_of,
            observations: &self.observations,
            actions: &self.actions,
            means: &self.means,
            log_probs: &self.log_probs,
            advantages: &self.advantages,
            returns: &self.returns,
            values: &self.values,
            order: &self.order,
        }
    }

    /// Stores the observations before a step, `[envs, num_obs]`.
    pub(crate) fn store_observations(&mut self, step: usize, observations: &[f32], num_obs: usize) {
        let first = step * self.len() * lines_of(num_obs);
        rows_to_lines(observations, num_obs, &mut self.observations[first..]);
    }

    /// Finds the bodies of some samples, and their mirror images, as a network of joints reads
    /// them.
    pub(crate) fn find_bodies(
        &mut self,
        name: NetworkName,
        net: &Net,
        samples: Range<usize>,
        mirrors: Option<&[Mirror]>,
        num_obs: usize,
    ) {
        let Some(joints) = net.joints() else { return };
        let (lines, n, bodies) = (lines_of(num_obs), self.envs.len(), &mut self.bodies[name as usize]);
        for sample in samples {
            let (env, observation) = (sample % n, &self.observations[sample * lines..][..lines]);
            let mirror = mirrors.map(|mirrors| &mirrors[self.robot_of[env]]);
            let body = bodies.number_of(joints, &net.normalizers, env, observation, mirror);
            bodies.of_samples.push(body);
        }
    }

    /// Bodies of the observations after the last step, `[envs]`; empty for a perceptron.
    pub(crate) fn last_bodies(&mut self, name: NetworkName, net: &Net, last: &[Line], num_obs: usize) -> Vec<usize> {
        let Some(joints) = net.joints() else { return Vec::new() };
        let (bodies, rows) = (&mut self.bodies[name as usize], last.chunks_exact(lines_of(num_obs)).enumerate());
        rows.map(|(env, of)| bodies.number_of(joints, &net.normalizers, env, of, None)).collect()
    }

    /// The samples of a mini-batch.
    pub(crate) fn mini_batch(&self, batch: usize, batches: usize) -> &[u32] {
        &self.order[share(self.order.len(), batch, batches)]
    }

    /// Stores the outcome of a step; `[envs]` each. Episodes that ended are added to `episodes`.
    pub(crate) fn store_outcome(
        &mut self,
        step: usize,
        rewards: &[f32],
        terminated: &[bool],
        truncated: &[bool],
        episodes: &mut Vec<Episode>,
    ) {
        let first = step * self.len();
        for env in 0..self.len() {
            let (reward, ended) = (rewards[env], terminated[env] || truncated[env]);
            self.rewards[first + env] = reward;
            self.ends[first + env] = match (terminated[env], truncated[env]) {
                (true, _) => End::Terminated,
                (false, true) => End::TimeOut,
                (false, false) => End::None,
            };
            self.episode_reward[env] += reward;
            self.episode_length[env] += 1.0;
            if ended {
                let (reward, length) = (self.episode_reward[env], self.episode_length[env]);
                episodes.push(Episode { step, env: self.envs.start + env, reward, length });
                (self.episode_reward[env], self.episode_length[env]) = (0.0, 0.0);
            }
        }
    }

    /// Follows the discounted returns through the iteration; their moments of each step and of each
    /// of the part's robots, `[steps][blocks]`.
    pub(crate) fn discounted_returns(&mut self, gamma: f32) -> Vec<Moments> {
        let n = self.len();
        let mut moments = Vec::new();
        for (rewards, ends) in self.rewards.chunks_exact(n).zip(self.ends.chunks_exact(n)) {
            for (sum, reward) in self.discounted.iter_mut().zip(rewards) {
                *sum = *sum * gamma + reward;
            }
            moments
                .extend(self.blocks.iter().map(|(_, envs)| Moments::of(self.discounted[envs.clone()].iter().copied())));
            for (sum, end) in self.discounted.iter_mut().zip(ends) {
                if *end != End::None {
                    *sum = 0.0;
                }
            }
        }
        moments
    }

    /// Moments of the part's blocks as those of all robots.
    pub(crate) fn by_robot(&self, of_blocks: &[Moments], robots: usize) -> Vec<Moments> {
        let mut of_robots = vec![Moments::default(); robots];
        for (&(robot, _), of) in self.blocks.iter().zip(of_blocks) {
            of_robots[robot] = *of;
        }
        of_robots
    }

    /// Returns and advantages by generalised advantage estimation; `scale` is the factor of the
    /// rewards of a step and a robot.
    pub(crate) fn estimate_advantages(&mut self, gamma: f32, lam: f32, scale: impl Fn(usize, usize) -> f32) {
        let n = self.len();
        let mut advantage = vec![0.0f32; n];
        let steps = self.rewards.len() / n.max(1);
        for step in (0..steps).rev() {
            for env in 0..n {
                let at = step * n + env;
                let (value, end) = (self.values[at], self.ends[at]);
                let next_value = if step + 1 == steps { self.last_values[env] } else { self.values[at + n] };
                let mut reward = self.rewards[at] * scale(step, self.robot_of[env]);
                if end == End::TimeOut {
                    reward += gamma * value;
                }
                let goes_on = if end == End::None { 1.0 } else { 0.0 };
                let delta = reward + goes_on * gamma * next_value - value;
                advantage[env] = delta + goes_on * gamma * lam * advantage[env];
                self.returns[at] = advantage[env] + value;
                self.advantages[at] = self.returns[at] - value;
            }
        }
    }

    /// Advantages of one of the part's blocks of envs.
    pub(crate) fn advantages_of(&self, envs: Range<usize>) -> impl Iterator<Item = f32> + Clone {
        self.advantages.chunks_exact(self.len()).flat_map(move |step| step[envs.clone()].iter().copied())
    }

    /// Moments of each number of the observations, about `about`, over the robots that have it.
    #[inline(always)]
    pub(crate) fn observation_moments(&self, about: &[f32], robots: &[Robot]) -> Vec<Moments> {
        if robots.iter().all(|robot| robot.observation_mask.is_empty()) {
            return self.moments_of(about, 0..self.len());
        }
        let mut all = vec![Moments::default(); about.len()];
        for (robot, envs) in &self.blocks {
            let own = self.moments_of(about, envs.clone());
            for (number, (all, own)) in all.iter_mut().zip(own).enumerate() {
                if robots[*robot].has_number(number) {
                    *all = all.merge(own);
                }
            }
        }
        all
    }

    /// Moments of all numbers over some of the part's envs.
    #[inline(always)]
    fn moments_of(&self, about: &[f32], envs: Range<usize>) -> Vec<Moments> {
        let lines = lines_of(about.len());
        let mut shift = vec![Line::ZERO; lines];
        copy_to_lines(about, &mut shift);
        let mut sums = vec![([0.0f64; WIDTH], [0.0f64; WIDTH]); lines];
        let steps = self.observations.chunks_exact(lines * self.len());
        let observations = steps.flat_map(|step| step[envs.start * lines..envs.end * lines].chunks_exact(lines));
        for observation in observations {
            for ((line, shift), (sum, squares)) in observation.iter().zip(&shift).zip(&mut sums) {
                for i in 0..WIDTH {
                    let x = f64::from(line.0[i] - shift.0[i]);
                    sum[i] += x;
                    squares[i] += x * x;
                }
            }
        }
        let count = (self.rewards.len() / self.len() * envs.len()) as f64;
        let moments = |(i, &about): (usize, &f32)| {
            let (sum, squares) = (sums[i / WIDTH].0[i % WIDTH], sums[i / WIDTH].1[i % WIDTH]);
            Moments { count, mean: f64::from(about) + sum / count, squares: (squares - sum * sum / count).max(0.0) }
        };
        about.iter().enumerate().map(moments).collect()
    }
}

/// Rows of `width` numbers as rows of lines.
pub(crate) fn rows_to_lines(from: &[f32], width: usize, to: &mut [Line]) {
    for (to, from) in to.chunks_exact_mut(lines_of(width)).zip(from.chunks_exact(width)) {
        copy_to_lines(from, to);
    }
}

/// Numbers as lines, the last of which is filled with zeros.
fn copy_to_lines(from: &[f32], to: &mut [Line]) {
    let (whole, rest) = from.as_chunks::<WIDTH>();
    for (line, numbers) in to.iter_mut().zip(whole) {
        line.0 = *numbers;
    }
    if let Some(line) = to.get_mut(whole.len()) {
        line.0[..rest.len()].copy_from_slice(rest);
    }
}
