//! A learner: two networks, and the envs' samples of an iteration.

use std::cell::RefCell;
use std::ops::Range;

use polypod_lanes::{Simd, SimdDispatch};

use crate::bodies::Bodies;
use crate::device::{DeviceFailure, UpdateDevice};
use crate::gaussian::{Distributions, RANGE};
use crate::lines::{Line, WIDTH, lines_of};
use crate::matrix::Matrix;
use crate::moments::Moments;
use crate::network::{Mirror, Net, NetworkName, NetworkState, Row};
use crate::normalizer::Normalizer;
use crate::peers::{Alone, Peers, Shares, Worker};
use crate::perceptron::Tile;
use crate::random::Purpose;
use crate::reward_scale::RewardScale;
use crate::rollout::{Episode, Part, parts_of};
use crate::settings::{LearnerError, Settings, Symmetry};

/// Threads that work on tasks side by side.
pub trait Team {
    /// Calls `f` with every task.
    fn for_each<T: Send>(&self, tasks: Vec<T>, f: impl Fn(T) + Sync);
}

/// PPO over some envs: networks, samples, statistics. One iteration is [`act`](Learner::act) and
/// [`record`](Learner::record) for each step, then [`finish_rollout`](Learner::finish_rollout) and
/// [`update`](Learner::update).
///
/// The results depend on its settings, its networks' numbers, the iteration and the recorded
/// samples, and on nothing else.
pub struct Learner {
    pub(crate) settings: Settings,
    pub(crate) matrix: Matrix,
    pub(crate) dispatch: SimdDispatch,
    pub(crate) actor: Net,
    pub(crate) critic: Net,
    pub(crate) mirrors: Vec<Mirror>,
    /// Parts of this worker.
    pub(crate) parts: Vec<Part>,
    pub(crate) shares: Shares,
    pub(crate) peers: Box<dyn Peers>,
    /// The policy's distributions while the samples are collected.
    pub(crate) old: Distributions,
    /// Scale of each robot's advantages: their mean and one over their deviation.
    pub(crate) advantage_scale: Vec<(f32, f32)>,
    /// Scale of all robots' advantages, of each mini-batch; empty where the scale is that of all
    /// samples.
    pub(crate) mini_batch_scale: Vec<(f32, f32)>,
    pub(crate) reward_scale: Option<RewardScale>,
    /// Device that computes updates, and why it was given up.
    pub(crate) device: Option<Box<dyn UpdateDevice>>,
    pub(crate) device_failure: Option<DeviceFailure>,
    iteration: u64,
    step: usize,
}

thread_local! {
    /// A thread's memory for tiles.
    static TILE: RefCell<Tile> = RefCell::default();
}

/// Calls `f` with the thread's tile.
pub(crate) fn with_tile<R>(f: impl FnOnce(&mut Tile) -> R) -> R {
    TILE.with(|tile| f(&mut tile.borrow_mut()))
}

/// Refuses the first number that is not finite, or below the least one.
fn check_numbers<'a, T: Copy + Into<f64> + 'a>(
    element: &'static str,
    numbers: impl IntoIterator<Item = &'a T>,
    least: T,
) -> Result<(), LearnerError> {
    let least: f64 = least.into();
    let wrong = numbers
        .into_iter()
        .map(|&x| x.into())
        .enumerate()
        .find(|(_, x): &(usize, f64)| !(x.is_finite() && *x >= least));
    let Some((index, x)) = wrong else { return Ok(()) };
    let wanted = if least == 0.0 { "a finite number that is not below 0" } else { "a finite number" };
    Err(LearnerError::new(element, format!("number {index} is {x}; it must be {wanted}")))
}

impl Learner {
    /// A learner whose networks' numbers are all zero, with all envs.
    ///
    /// # Errors
    /// Settings that contradict each other, or an instruction set that the machine lacks.
    pub fn new(settings: Settings, simd: Simd) -> Result<Self, LearnerError> {
        Self::with_peers(settings, simd, Worker::ALONE, Box::new(Alone))
    }

    /// A learner that has [`Worker::envs`] and learns with others that have the rest. All come to
    /// the same networks, bit for bit those of a learner with all envs. Arrays `[envs, ..]` have
    /// rows for its own envs alone.
    ///
    /// # Errors
    /// Settings that contradict each other, an instruction set that the machine lacks, or more
    /// workers than blocks of envs.
    pub fn with_peers(
        settings: Settings,
        simd: Simd,
        worker: Worker,
        peers: Box<dyn Peers>,
    ) -> Result<Self, LearnerError> {
        settings.check()?;
        let Some(token) = simd.token() else {
            let problem = format!("this machine has no {}; use one of `Simd::available()`", simd.name());
            return Err(LearnerError::new("simd", problem));
        };
        let own = worker.envs(settings.num_envs)?;
        let all: Vec<_> = parts_of(settings.num_envs).collect();
        let shares = Shares::new(worker, all.len());
        let (actor, critic) = (Net::new(NetworkName::Actor, &settings), Net::new(NetworkName::Critic, &settings));
        let is_own = |envs: &Range<usize>| own.start <= envs.start && envs.end <= own.end;
        let parts = all.into_iter().filter(is_own).map(|envs| Part::new(envs, own.start, &settings)).collect();
        let of = |robot: &crate::settings::Robot| Mirror {
            observation: robot.observation_mirror.clone(),
            action: robot.action_mirror.clone(),
        };
        Ok(Self {
            matrix: Matrix::new(token),
            dispatch: simd.dispatch(),
            mirrors: settings.robots.iter().map(of).collect(),
            old: Distributions::new(actor.deviations(), &settings),
            advantage_scale: vec![(0.0, 1.0); settings.robots.len()],
            mini_batch_scale: Vec::new(),
            reward_scale: settings.options.normalize_reward_per_robot.then(|| RewardScale::new(settings.robots.len())),
            device: None,
            device_failure: None,
            iteration: 0,
            step: 0,
            actor,
            critic,
            parts,
            shares,
            peers,
            settings,
        })
    }

    /// Settings that it was made from.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Number of this worker's envs.
    pub fn num_own_envs(&self) -> usize {
        self.parts.iter().map(Part::len).sum()
    }

    /// Changes the goals of the coming updates: the weight of the entropy, and the divergence that
    /// the learning rate is adapted to.
    pub fn set_goals(&mut self, entropy_coef: f32, desired_kl: Option<f64>) {
        let algorithm = &mut self.settings.options.algorithm;
        (algorithm.entropy_coef, algorithm.desired_kl) = (entropy_coef, desired_kl);
    }

    fn net(&self, name: NetworkName) -> &Net {
        if name == NetworkName::Actor { &self.actor } else { &self.critic }
    }

    fn net_mut(&mut self, name: NetworkName) -> &mut Net {
        if name == NetworkName::Actor { &mut self.actor } else { &mut self.critic }
    }

    /// A network's numbers.
    pub fn network(&self, name: NetworkName) -> NetworkState {
        self.net(name).state()
    }

    /// Takes over a network's numbers.
    ///
    /// # Errors
    /// Arrays of other sizes, a deviation or a mean of squares below 0, and a number that is not
    /// finite, which change nothing.
    pub fn set_network(&mut self, name: NetworkName, state: &NetworkState) -> Result<(), LearnerError> {
        let has_deviations = !self.net(name).deviations().is_empty();
        let deviations = state.weights.iter().take(usize::from(has_deviations)).flatten();
        check_numbers("deviations", deviations, 0.0)?;
        check_numbers("second", state.second.iter().flatten(), 0.0)?;
        for (element, arrays) in [("weights", &state.weights), ("first", &state.first)] {
            check_numbers(element, arrays.iter().flatten(), f32::MIN)?;
        }
        let fits = self.net_mut(name).set_state(state);
        fits.then_some(()).ok_or_else(|| LearnerError::new("state", "its arrays have other sizes than the network's"))
    }

    /// Standard deviations of the actions' distribution, `[num_actions]`: at least 1e-6. A network
    /// of joints gives those of the last actions of all envs, one for each joint that a robot has.
    pub fn deviations(&self) -> Vec<f32> {
        if self.actor.joints().is_some() {
            return self.parts.iter().flat_map(|part| part.bodies[0].last_deviations()).collect();
        }
        let numbers = self.actor.deviations().iter().flat_map(|line| line.0).take(self.settings.num_actions);
        numbers.map(|x| x.clamp(RANGE[0], RANGE[1])).collect()
    }

    /// A network's statistics: of a perceptron, those of the observations; of a network of joints,
    /// those of states, of a description's numbers, of their logarithms and of the rest. Empty
    /// where nothing is normalised.
    pub fn normalizers(&self, name: NetworkName) -> &[Normalizer] {
        &self.net(name).normalizers
    }

    /// Takes over one of a network's statistics; a network without them ignores it.
    ///
    /// # Errors
    /// A normalizer of another size, a variance below 0, and a number that is not finite.
    pub fn set_normalizer(
        &mut self,
        name: NetworkName,
        index: usize,
        normalizer: Normalizer,
    ) -> Result<(), LearnerError> {
        let normalizers = &mut self.net_mut(name).normalizers;
        if normalizers.is_empty() {
            return Ok(());
        }
        let Some(of) = normalizers.get_mut(index) else {
            return Err(LearnerError::new("normalizer", format!("there is no number {index}")));
        };
        let size = of.mean.len();
        check_numbers("mean", &normalizer.mean, f32::MIN)?;
        check_numbers("variance", &normalizer.variance, 0.0)?;
        if normalizer.mean.len() != size || normalizer.variance.len() != size {
            return Err(LearnerError::new("normalizer", format!("it is not of {size} numbers")));
        }
        *of = normalizer;
        Ok(())
    }

    /// Statistics of the returns, if rewards are scaled by them.
    pub fn reward_scale(&self) -> Option<&RewardScale> {
        self.reward_scale.as_ref()
    }

    /// Takes over statistics of the returns, and the discounted returns so far, `[envs]`.
    ///
    /// # Errors
    /// A scale of other robots or envs, a count or variance below 0, and a number that is not
    /// finite.
    pub fn set_reward_scale(&mut self, scale: RewardScale, discounted: &[f32]) -> Result<(), LearnerError> {
        let robots = self.settings.robots.len();
        let lengths = [scale.count.len(), scale.mean.len(), scale.variance.len()];
        if lengths != [robots; 3] || discounted.len() != self.num_own_envs() {
            return Err(LearnerError::new("reward_scale", format!("it is not of {robots} robots and these envs")));
        }
        check_numbers("returns", discounted, f32::MIN)?;
        for (element, numbers, least) in
            [("count", &scale.count, 0.0), ("mean", &scale.mean, f64::MIN), ("variance", &scale.variance, 0.0)]
        {
            check_numbers(element, numbers, least)?;
        }
        if self.reward_scale.is_some() {
            self.reward_scale = Some(scale);
        }
        for part in &mut self.parts {
            part.discounted.copy_from_slice(&discounted[part.rows.clone()]);
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

    /// Takes over the values of [`Learner::episodes`].
    ///
    /// # Errors
    /// Arrays of other sizes, a length below 0, and a number that is not finite.
    pub fn set_episodes(&mut self, rewards: &[f32], lengths: &[f32]) -> Result<(), LearnerError> {
        let envs = self.num_own_envs();
        if [rewards.len(), lengths.len()] != [envs; 2] {
            return Err(LearnerError::new("episodes", format!("they are not of {envs} envs")));
        }
        check_numbers("rewards", rewards, f32::MIN)?;
        check_numbers("lengths", lengths, 0.0)?;
        for part in &mut self.parts {
            part.episode_reward.copy_from_slice(&rewards[part.rows.clone()]);
            part.episode_length.copy_from_slice(&lengths[part.rows.clone()]);
        }
        Ok(())
    }

    /// Begins the samples of an iteration.
    pub fn begin(&mut self, iteration: u64) {
        (self.iteration, self.step) = (iteration, 0);
        self.old = Distributions::new(self.actor.deviations(), &self.settings);
        for part in &mut self.parts {
            part.bodies.iter_mut().for_each(Bodies::clear);
        }
    }

    /// Stores the observations `[envs, num_obs]` before a step, and draws the actions `[envs,
    /// num_actions]`.
    ///
    /// # Panics
    /// If the arrays have other sizes, or all steps are taken.
    pub fn act(&mut self, team: &impl Team, observations: &[f32], actions: &mut [f32]) {
        let Settings { num_obs, num_actions, seed, .. } = self.settings;
        let (step, lines) = (self.step, [lines_of(num_obs), lines_of(num_actions)]);
        let time = self.iteration * self.settings.options.num_steps_per_env as u64 + step as u64;
        let (actor, matrix, distributions, mirrors) = (&self.actor, self.matrix, &self.old, &self.mirrors[..]);
        let learns_images = self.settings.options.symmetry != Symmetry::None;
        let mut rest = actions;
        let mut tasks = Vec::new();
        for part in &mut self.parts {
            let (mine, more) = std::mem::take(&mut rest).split_at_mut(part.len() * num_actions);
            rest = more;
            let from = &observations[part.rows.start * num_obs..part.rows.end * num_obs];
            tasks.push((part, from, mine));
        }
        team.for_each(tasks, |(part, from, to)| {
            part.store_observations(step, from, num_obs);
            let (n, first_env) = (part.len(), part.envs.start);
            part.find_bodies(
                NetworkName::Actor,
                actor,
                step * n..(step + 1) * n,
                learns_images.then_some(mirrors),
                num_obs,
            );
            let mut old = std::mem::take(&mut part.bodies[0].old);
            let bodies = &part.bodies[0];
            let observations = part.observations[step * n * lines[0]..][..n * lines[0]].chunks_exact(lines[0]);
            let rows: Vec<Row> = observations
                .enumerate()
                .map(|(env, observation)| Row {
                    observation,
                    mirror: None,
                    robot: part.robot_of[env],
                    body: bodies.of_samples.get(step * n + env).copied().unwrap_or(0),
                })
                .collect();
            with_tile(|tile| {
                let mut own_mean = vec![Line::ZERO; lines[1]];
                actor.evaluate(matrix, &rows, bodies, tile, |env, mean, of_body| {
                    if let Some(gaussian) = of_body {
                        old[rows[env].body].get_or_insert_with(|| gaussian.clone());
                    }
                    let gaussian = of_body.unwrap_or_else(|| distributions.of(part.robot_of[env]));
                    own_mean.copy_from_slice(mean);
                    gaussian.clear_absent(&mut own_mean);
                    let mean = &own_mean[..];
                    let at = (step * n + env) * lines[1];
                    let action = &mut part.actions[at..][..lines[1]];
                    let mut noise = Purpose::Noise.stream(seed, time, first_env + env);
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
            part.bodies[0].old = old;
        });
    }

    /// Stores the outcome of the step, `[envs]` each; episodes that ended are added to `episodes`,
    /// in the order of the envs.
    ///
    /// # Panics
    /// If the arrays have other sizes, or all steps are taken.
    pub fn record(&mut self, rewards: &[f32], terminated: &[bool], truncated: &[bool], episodes: &mut Vec<Episode>) {
        for part in &mut self.parts {
            let rows = part.rows.clone();
            let (rewards, terminated) = (&rewards[rows.clone()], &terminated[rows.clone()]);
            part.store_outcome(self.step, rewards, terminated, &truncated[rows], episodes);
        }
        self.step += 1;
    }

    /// Estimates values, returns and advantages; `observations` are those after the last step,
    /// `[envs, num_obs]`.
    ///
    /// # Errors
    /// Another worker is gone.
    ///
    /// # Panics
    /// If the array has another size.
    pub fn finish_rollout(&mut self, team: &impl Team, observations: &[f32]) -> Result<(), LearnerError> {
        let Settings { num_obs, seed, .. } = self.settings;
        let (algorithm, iteration) = (&self.settings.options.algorithm, self.iteration);
        let (critic, matrix, mirrors) = (&self.critic, self.matrix, &self.mirrors[..]);
        let learns_images = self.settings.options.symmetry != Symmetry::None;
        let mut returns: Vec<Vec<Moments>> = vec![Vec::new(); self.parts.len()];
        let tasks: Vec<_> = self.parts.iter_mut().zip(&mut returns).collect();
        team.for_each(tasks, |(part, returns)| {
            let (n, lines, mirrors) = (part.len(), lines_of(num_obs), learns_images.then_some(mirrors));
            part.find_bodies(NetworkName::Critic, critic, 0..part.rewards.len(), mirrors, num_obs);
            let mut last = vec![Line::ZERO; n * lines];
            let from = &observations[part.rows.start * num_obs..part.rows.end * num_obs];
            crate::rollout::rows_to_lines(from, num_obs, &mut last);
            let last_bodies = part.last_bodies(NetworkName::Critic, critic, &last, num_obs);
            let Part { observations: stored, values, last_values, robot_of, bodies: [_, bodies], .. } = part;
            let row = |k: usize, observation, body: &[usize]| Row {
                observation,
                mirror: None,
                robot: robot_of[k % n],
                body: body.get(k).copied().unwrap_or(0),
            };
            with_tile(|tile| {
                let samples = stored.chunks_exact(lines).enumerate();
                let rows: Vec<Row> = samples.map(|(k, of)| row(k, of, &bodies.of_samples)).collect();
                critic.evaluate(matrix, &rows, bodies, tile, |sample, value, _| values[sample] = value[0].0[0]);
                let rows: Vec<Row> =
                    last.chunks_exact(lines).enumerate().map(|(k, of)| row(k, of, &last_bodies)).collect();
                critic.evaluate(matrix, &rows, bodies, tile, |env, value, _| last_values[env] = value[0].0[0]);
            });
            *returns = part.discounted_returns(algorithm.gamma);
            let samples = part.rewards.len();
            part.order = crate::random::shuffled(samples, Purpose::Order.stream(seed, iteration, part.envs.start));
        });

        let (robots, steps) = (self.settings.robots.len(), self.settings.options.num_steps_per_env);
        let mut scales = vec![1.0f32; steps * robots];
        if let Some(scale) = &mut self.reward_scale {
            let of_part = |(part, returns): (&Part, Vec<Moments>)| {
                returns.chunks_exact(part.blocks.len()).flat_map(|of| part.by_robot(of, robots)).collect()
            };
            let returns: Vec<Vec<Moments>> = self.parts.iter().zip(returns).map(of_part).collect();
            let returns = self.shares.sum(&*self.peers, &returns)?;
            for (k, (moments, to)) in returns.into_iter().zip(&mut scales).enumerate() {
                *to = scale.update(k % robots, moments);
            }
        }

        let mut advantages: Vec<Vec<Moments>> = vec![Vec::new(); self.parts.len()];
        let tasks: Vec<_> = self.parts.iter_mut().zip(&mut advantages).collect();
        team.for_each(tasks, |(part, advantages)| {
            part.estimate_advantages(algorithm.gamma, algorithm.lam, |step, robot| scales[step * robots + robot]);
            let of_block = |(_, envs): &(usize, Range<usize>)| Moments::of(part.advantages_of(envs.clone()));
            let of_blocks: Vec<_> = part.blocks.iter().map(of_block).collect();
            *advantages = part.by_robot(&of_blocks, robots);
        });
        let of_robots = self.shares.sum(&*self.peers, &advantages)?;
        self.scale_advantages(&of_robots)
    }

    /// Chooses the scale of the advantages: over each robot, over all samples, or over each
    /// mini-batch.
    fn scale_advantages(&mut self, of_robots: &[Moments]) -> Result<(), LearnerError> {
        let algorithm = &self.settings.options.algorithm;
        let all = of_robots.iter().copied().fold(Moments::default(), Moments::merge);
        let scale = |of: &Moments| {
            if algorithm.normalize_advantage_per_mini_batch {
                (0.0, 1.0)
            } else if self.settings.options.normalize_advantage_per_robot {
                of.scale(of.variance())
            } else {
                all.scale(all.unbiased_variance())
            }
        };
        self.advantage_scale = of_robots.iter().map(scale).collect();
        if algorithm.normalize_advantage_per_mini_batch {
            let batches = algorithm.num_mini_batches;
            let of = |part: &Part, batch: usize| {
                let samples = part.mini_batch(batch, batches).iter();
                Moments::of(samples.map(|&sample| part.advantages[sample as usize]))
            };
            let parts: Vec<Vec<_>> =
                self.parts.iter().map(|part| (0..batches).map(|batch| of(part, batch)).collect()).collect();
            let of_batches = self.shares.sum(&*self.peers, &parts)?;
            self.mini_batch_scale = of_batches.iter().map(|of| of.scale(of.unbiased_variance())).collect();
        }
        Ok(())
    }
}
