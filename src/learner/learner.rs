//! A learner: two networks, and the envs' samples of an iteration.

use std::cell::RefCell;

use polypod_dynamics::lanes::{Simd, SimdDispatch};

use crate::gaussian::Gaussian;
use crate::lines::{Line, WIDTH, lines_of};
use crate::matrix::Matrix;
use crate::moments::Moments;
use crate::network::{Mirror, Net, NetworkState, Which};
use crate::normalizer::Normalizer;
use crate::perceptron::Tile;
use crate::random::Use;
use crate::reward_scale::RewardScale;
use crate::rollout::{End, Episode, Part, parts_of};
use crate::settings::{LearnerError, Settings};

/// Threads that work on tasks side by side.
pub trait Team {
    /// Calls `f` with every task.
    fn for_each<T: Send>(&self, tasks: Vec<T>, f: impl Fn(T) + Sync);
}

/// PPO over some envs: networks, samples, statistics. One iteration is [`act`](Learner::act) and [`record`](Learner::record) for each
/// step, then [`finish_rollout`](Learner::finish_rollout) and [`update`](Learner::update).
///
/// All it computes depends on its settings, its networks' numbers, the iteration and what is recorded, and on nothing else.
pub struct Learner {
    pub(crate) settings: Settings,
    pub(crate) matrix: Matrix,
    pub(crate) dispatch: SimdDispatch,
    pub(crate) actor: Net,
    pub(crate) critic: Net,
    pub(crate) mirrors: Vec<Mirror>,
    pub(crate) parts: Vec<Part>,
    /// The policy's distribution while the samples are collected.
    pub(crate) old: Gaussian,
    /// What brings advantages to one scale: their mean and one over their deviation, of each robot.
    pub(crate) advantage_scale: Vec<(f32, f32)>,
    pub(crate) reward_scale: Option<RewardScale>,
    iteration: u64,
    step: usize,
}

/// Samples of an iteration by steps and envs, as rsl_rl stores them.
#[derive(Clone, Debug, Default)]
pub struct RolloutArrays {
    /// `[steps, envs, num_obs]`
    pub observations: Vec<f32>,
    /// `[steps, envs, num_actions]`
    pub actions: Vec<f32>,
    /// `[steps, envs, num_actions]`
    pub means: Vec<f32>,
    /// `[steps, envs]`, as the simulator gave them.
    pub rewards: Vec<f32>,
    /// `[steps, envs]`: 0 while an episode goes on, 1 where it terminated, 2 where its time was up.
    pub ends: Vec<u8>,
    /// `[steps, envs]`
    pub log_probs: Vec<f32>,
    /// `[steps, envs]`
    pub values: Vec<f32>,
    /// `[steps, envs]`
    pub returns: Vec<f32>,
    /// `[steps, envs]`, brought to one scale.
    pub advantages: Vec<f32>,
    /// Samples in the order in which the mini-batches take them: `step * envs + env`.
    pub order: Vec<u32>,
}

thread_local! {
    /// Where a thread computes tiles.
    static TILE: RefCell<Tile> = RefCell::default();
}

/// Works with the thread's tile.
pub(crate) fn with_tile<R>(f: impl FnOnce(&mut Tile) -> R) -> R {
    TILE.with(|tile| f(&mut tile.borrow_mut()))
}

impl Learner {
    /// A learner whose networks' numbers are all zero.
    ///
    /// # Errors
    /// Settings that contradict each other.
    pub fn new(settings: Settings, simd: Simd) -> Result<Self, LearnerError> {
        settings.check()?;
        let actor = Net::new(settings.num_obs, &settings.options.actor, settings.num_actions, settings.num_actions);
        let critic = Net::new(settings.num_obs, &settings.options.critic, 1, 0);
        let parts = parts_of(settings.num_envs).map(|envs| Part::new(envs, &settings)).collect();
        let of = |robot: &crate::settings::Robot| Mirror {
            observation: robot.observation_mirror.clone(),
            action: robot.action_mirror.clone(),
        };
        Ok(Self {
            matrix: Matrix::new(simd),
            dispatch: simd.dispatch(),
            mirrors: settings.robots.iter().map(of).collect(),
            old: Gaussian::new(actor.perceptron.extra(), settings.num_actions),
            advantage_scale: vec![(0.0, 1.0); settings.robots.len()],
            reward_scale: settings.options.normalize_reward_per_robot.then(|| RewardScale::new(settings.robots.len())),
            iteration: 0,
            step: 0,
            actor,
            critic,
            parts,
            settings,
        })
    }

    /// What it was made from.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Changes what the coming updates aim at: the weight of the entropy, and the divergence that the learning rate is adapted to.
    pub fn set_goals(&mut self, entropy_coef: f32, desired_kl: Option<f64>) {
        let algorithm = &mut self.settings.options.algorithm;
        (algorithm.entropy_coef, algorithm.desired_kl) = (entropy_coef, desired_kl);
    }

    fn net(&self, which: Which) -> &Net {
        if which == Which::Actor { &self.actor } else { &self.critic }
    }

    fn net_mut(&mut self, which: Which) -> &mut Net {
        if which == Which::Actor { &mut self.actor } else { &mut self.critic }
    }

    /// A network's numbers.
    pub fn network(&self, which: Which) -> NetworkState {
        self.net(which).state()
    }

    /// Takes over a network's numbers.
    ///
    /// # Errors
    /// Arrays of other sizes, which change nothing.
    pub fn set_network(&mut self, which: Which, state: &NetworkState) -> Result<(), LearnerError> {
        let fits = self.net_mut(which).set_state(state);
        fits.then_some(()).ok_or_else(|| LearnerError::new("state", "its arrays have other sizes than the network's"))
    }

    /// Deviations of the actions, `[num_actions]`.
    pub fn deviations(&self) -> Vec<f32> {
        self.actor.perceptron.extra().iter().flat_map(|line| line.0).take(self.settings.num_actions).collect()
    }

    /// A network's statistics of the observations, if it has any.
    pub fn normalizer(&self, which: Which) -> Option<&Normalizer> {
        self.net(which).normalizer.as_ref()
    }

    /// Takes over statistics of the observations; a network without them ignores it.
    ///
    /// # Errors
    /// Those of other observations.
    pub fn set_normalizer(&mut self, which: Which, normalizer: Normalizer) -> Result<(), LearnerError> {
        let size = self.settings.num_obs;
        if normalizer.mean.len() != size || normalizer.variance.len() != size {
            return Err(LearnerError::new("normalizer", format!("it is not of {size} numbers")));
        }
        if let Some(of) = &mut self.net_mut(which).normalizer {
            *of = normalizer;
        }
        Ok(())
    }

    /// Statistics of the returns, if rewards are scaled by them.
    pub fn reward_scale(&self) -> Option<&RewardScale> {
        self.reward_scale.as_ref()
    }

    /// Takes over statistics of the returns, and the discounted returns so far, `[envs]`.
    ///
    /// # Errors
    /// Those of other robots or envs.
    pub fn set_reward_scale(&mut self, scale: RewardScale, discounted: &[f32]) -> Result<(), LearnerError> {
        let robots = self.settings.robots.len();
        let lengths = [scale.count.len(), scale.mean.len(), scale.variance.len()];
        if lengths != [robots; 3] || discounted.len() != self.settings.num_envs {
            return Err(LearnerError::new("reward_scale", format!("it is not of {robots} robots and these envs")));
        }
        if self.reward_scale.is_some() {
            self.reward_scale = Some(scale);
        }
        for part in &mut self.parts {
            part.discounted.copy_from_slice(&discounted[part.envs.clone()]);
        }
        Ok(())
    }

    /// Discounted returns so far, `[envs]`.
    pub fn discounted(&self) -> Vec<f32> {
        self.parts.iter().flat_map(|part| part.discounted.iter().copied()).collect()
    }

    /// Sums of the rewards and control steps of the present episodes, `[envs]` each.
    pub fn episodes(&self) -> (Vec<f32>, Vec<f32>) {
        let rewards = self.parts.iter().flat_map(|part| part.episode_reward.iter().copied()).collect();
        (rewards, self.parts.iter().flat_map(|part| part.episode_length.iter().copied()).collect())
    }

    /// Takes over what [`Learner::episodes`] gave.
    ///
    /// # Errors
    /// Arrays of other sizes.
    pub fn set_episodes(&mut self, rewards: &[f32], lengths: &[f32]) -> Result<(), LearnerError> {
        if [rewards.len(), lengths.len()] != [self.settings.num_envs; 2] {
            return Err(LearnerError::new("episodes", format!("they are not of {} envs", self.settings.num_envs)));
        }
        for part in &mut self.parts {
            part.episode_reward.copy_from_slice(&rewards[part.envs.clone()]);
            part.episode_length.copy_from_slice(&lengths[part.envs.clone()]);
        }
        Ok(())
    }

    /// Begins the samples of an iteration.
    pub fn begin(&mut self, iteration: u64) {
        (self.iteration, self.step) = (iteration, 0);
        self.old = Gaussian::new(self.actor.perceptron.extra(), self.settings.num_actions);
    }

    /// Stores the observations `[envs, num_obs]` before a step, and draws the actions `[envs, num_actions]`.
    ///
    /// # Panics
    /// If the arrays have other sizes, or all steps are taken.
    pub fn act(&mut self, team: &impl Team, observations: &[f32], actions: &mut [f32]) {
        let Settings { num_obs, num_actions, seed, .. } = self.settings;
        let (step, lines) = (self.step, [lines_of(num_obs), lines_of(num_actions)]);
        let time = self.iteration * self.settings.options.num_steps_per_env as u64 + step as u64;
        let (actor, matrix, gaussian) = (&self.actor, self.matrix, &self.old);
        let mut rest = actions;
        let mut tasks = Vec::new();
        for part in &mut self.parts {
            let (mine, more) = std::mem::take(&mut rest).split_at_mut(part.len() * num_actions);
            rest = more;
            let from = &observations[part.envs.start * num_obs..part.envs.end * num_obs];
            tasks.push((part, from, mine));
        }
        team.for_each(tasks, |(part, from, to)| {
            part.store_observations(step, from, num_obs);
            let (n, first_env) = (part.len(), part.envs.start);
            let observations = &part.observations[step * n * lines[0]..][..n * lines[0]];
            with_tile(|tile| {
                actor.evaluate(matrix, observations, tile, |env, mean| {
                    let at = (step * n + env) * lines[1];
                    let action = &mut part.actions[at..][..lines[1]];
                    let mut noise = Use::Noise.stream(seed, time, first_env + env);
                    let to = &mut to[env * num_actions..][..num_actions];
                    for (pair, to) in to.chunks_mut(2).enumerate() {
                        for (k, x) in noise.normal_pair().into_iter().take(to.len()).enumerate() {
                            let i = 2 * pair + k;
                            let (line, lane) = (i / WIDTH, i % WIDTH);
                            to[k] = mean[line].0[lane] + gaussian.deviation[line].0[lane] * x;
                            action[line].0[lane] = to[k];
                        }
                    }
                    part.log_probs[step * n + env] = gaussian.log_prob(action, mean);
                    part.means[at..][..lines[1]].copy_from_slice(mean);
                });
            });
        });
    }

    /// Stores what came of the step, `[envs]` each; episodes that ended are added to `episodes`, in the order of the envs.
    ///
    /// # Panics
    /// If the arrays have other sizes, or all steps are taken.
    pub fn record(&mut self, rewards: &[f32], terminated: &[bool], truncated: &[bool], episodes: &mut Vec<Episode>) {
        for part in &mut self.parts {
            let envs = part.envs.clone();
            let (rewards, terminated) = (&rewards[envs.clone()], &terminated[envs.clone()]);
            part.store_outcome(self.step, rewards, terminated, &truncated[envs], episodes);
        }
        self.step += 1;
    }

    /// Estimates values, returns and advantages; `observations` are those after the last step, `[envs, num_obs]`.
    ///
    /// # Panics
    /// If the array has another size.
    pub fn finish_rollout(&mut self, team: &impl Team, observations: &[f32]) {
        let Settings { num_obs, seed, .. } = self.settings;
        let (algorithm, iteration) = (&self.settings.options.algorithm, self.iteration);
        let (critic, matrix) = (&self.critic, self.matrix);
        let mut returns: Vec<Vec<Moments>> = vec![Vec::new(); self.parts.len()];
        let tasks: Vec<_> = self.parts.iter_mut().zip(&mut returns).collect();
        team.for_each(tasks, |(part, returns)| {
            let Part { observations: stored, values, last_values, .. } = part;
            with_tile(|tile| {
                critic.evaluate(matrix, stored, tile, |sample, value| values[sample] = value[0].0[0]);
                let mut last = vec![Line::ZERO; part.envs.len() * lines_of(num_obs)];
                let from = &observations[part.envs.start * num_obs..part.envs.end * num_obs];
                crate::rollout::rows_to_lines(from, num_obs, &mut last);
                critic.evaluate(matrix, &last, tile, |env, value| last_values[env] = value[0].0[0]);
            });
            *returns = part.discounted_returns(algorithm.gamma);
            let samples = part.rewards.len();
            part.order = crate::random::shuffled(samples, Use::Order.stream(seed, iteration, part.envs.start));
        });

        let robots = self.settings.robots.len();
        let mut scales = vec![1.0f32; self.settings.options.num_steps_per_env * robots];
        if let Some(scale) = &mut self.reward_scale {
            for step in 0..self.settings.options.num_steps_per_env {
                let mut of_robots = vec![Moments::default(); robots];
                for (part, returns) in self.parts.iter().zip(&returns) {
                    for (k, &(robot, _)) in part.blocks.iter().enumerate() {
                        let of = &mut of_robots[robot];
                        *of = of.merge(returns[step * part.blocks.len() + k]);
                    }
                }
                for (robot, moments) in of_robots.into_iter().enumerate() {
                    scales[step * robots + robot] = scale.update(robot, moments);
                }
            }
        }

        let mut advantages: Vec<Vec<Moments>> = vec![Vec::new(); self.parts.len()];
        let tasks: Vec<_> = self.parts.iter_mut().zip(&mut advantages).collect();
        team.for_each(tasks, |(part, advantages)| {
            part.estimate_advantages(algorithm.gamma, algorithm.lam, |step, robot| scales[step * robots + robot]);
            *advantages = part.blocks.iter().map(|(_, envs)| Moments::of(part.advantages_of(envs.clone()))).collect();
        });
        self.scale_advantages(&advantages);
    }

    /// Decides what brings the advantages to one scale: that of each robot's own, or that of all.
    fn scale_advantages(&mut self, parts: &[Vec<Moments>]) {
        let mut of_robots = vec![Moments::default(); self.settings.robots.len()];
        for (part, moments) in self.parts.iter().zip(parts) {
            for (&(robot, _), &of) in part.blocks.iter().zip(moments) {
                of_robots[robot] = of_robots[robot].merge(of);
            }
        }
        let all = of_robots.iter().copied().fold(Moments::default(), Moments::merge);
        let scale = |of: &Moments| {
            if self.settings.options.algorithm.normalize_advantage_per_mini_batch {
                (0.0, 1.0)
            } else if self.settings.options.normalize_advantage_per_robot {
                of.scale(of.variance())
            } else {
                all.scale(all.unbiased_variance())
            }
        };
        self.advantage_scale = of_robots.iter().map(scale).collect();
    }

    /// The samples of the iteration, as rsl_rl would store them.
    pub fn rollout(&self) -> RolloutArrays {
        let Settings { num_envs, num_obs, num_actions, .. } = self.settings;
        let steps = self.settings.options.num_steps_per_env;
        let mut out = RolloutArrays::default();
        let numbers =
            |lines: &[Line], count: usize| lines.iter().flat_map(|line| line.0).take(count).collect::<Vec<_>>();
        for step in 0..steps {
            for part in &self.parts {
                for env in 0..part.len() {
                    let at = step * part.len() + env;
                    let (obs, actions) = (lines_of(num_obs), lines_of(num_actions));
                    out.observations.extend(numbers(&part.observations[at * obs..], num_obs));
                    out.actions.extend(numbers(&part.actions[at * actions..], num_actions));
                    out.means.extend(numbers(&part.means[at * actions..], num_actions));
                    out.rewards.push(part.rewards[at]);
                    out.ends.push(match part.ends[at] {
                        End::None => 0,
                        End::Terminated => 1,
                        End::TimeOut => 2,
                    });
                    out.log_probs.push(part.log_probs[at]);
                    out.values.push(part.values[at]);
                    out.returns.push(part.returns[at]);
                    let (mean, inverse) = self.advantage_scale[part.robot_of[env]];
                    out.advantages.push((part.advantages[at] - mean) * inverse);
                }
            }
        }
        for batch in 0..self.settings.options.algorithm.num_mini_batches {
            for part in &self.parts {
                let global = |&sample: &u32| {
                    let (step, env) = (sample as usize / part.len(), sample as usize % part.len());
                    (step * num_envs + part.envs.start + env) as u32
                };
                out.order.extend(
                    part.mini_batch(batch, self.settings.options.algorithm.num_mini_batches).iter().map(global),
                );
            }
        }
        out
    }
}
