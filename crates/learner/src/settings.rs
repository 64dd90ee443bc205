//! Settings of a training: sizes, hyperparameters, robots. Names are those of rsl_rl.

use serde::Deserialize;

use crate::activation::Activation;

/// All settings that decide what a learner computes.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Envs that are simulated.
    pub num_envs: usize,
    /// Numbers of an observation.
    pub num_obs: usize,
    /// Numbers of an action.
    pub num_actions: usize,
    /// Seed of the exploration and of the order of the samples.
    pub seed: u64,
    /// The robots, which together have all envs.
    pub robots: Vec<Robot>,
    /// Options of the train config.
    pub options: Options,
}

/// Options of the learner in a train config.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Options {
    /// Control steps per env and iteration.
    pub num_steps_per_env: usize,
    /// The policy's mean.
    pub actor: Network,
    /// The value function.
    pub critic: Network,
    /// Proximal policy optimisation.
    pub algorithm: Algorithm,
    /// Divide each robot's rewards by the deviation of its returns.
    pub normalize_reward_per_robot: bool,
    /// Whether advantages are normalised over each robot's own samples instead of all samples.
    pub normalize_advantage_per_robot: bool,
    /// Use of mirror images.
    pub symmetry: Symmetry,
}

/// A multi-layer perceptron, or a network of joints.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Network {
    /// Sizes of the hidden layers.
    pub hidden_dims: Vec<usize>,
    /// Function after each of them.
    pub activation: Activation,
    /// Whether observations are scaled to mean 0 and deviation 1 first.
    pub obs_normalization: bool,
    /// Columns of all observation groups that a perceptron reads, in order; all of them where
    /// empty.
    #[serde(default)]
    pub columns: Vec<usize>,
    /// Layout that a network of joints reads; None: a perceptron.
    #[serde(default)]
    pub joints: Option<Joints>,
}

/// A network of joints, like `polypod.networks.urma.JointNetwork`. Columns are those of a row of
/// all observation groups.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Joints {
    /// Width of a joint's encodings.
    pub joint_dim: usize,
    /// Heads of the attention.
    pub num_heads: usize,
    /// Columns of a joint's state, `[numbers][slots]`.
    pub states: Vec<Vec<usize>>,
    /// Factor of each of these numbers.
    pub scales: Vec<f32>,
    /// Columns of a joint's description, `[numbers][slots]`. A joint that a robot lacks has zeros
    /// alone.
    pub descriptions: Vec<Vec<usize>>,
    /// Columns that belong to no joint.
    pub general: Vec<usize>,
    /// Heads that look at joints of legs alone, the others at all other joints; joints are then
    /// compared with those of the legs. None: all heads look at all joints, which are compared with
    /// all of them.
    #[serde(default)]
    pub leg_heads: Option<usize>,
    /// Whether a slot is of a leg, `[slots]`.
    #[serde(default)]
    pub legs: Vec<bool>,
}

/// Hyperparameters of the update.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Algorithm {
    /// Number of times that each sample is learnt from.
    pub num_learning_epochs: usize,
    /// Updates of the weights per epoch.
    pub num_mini_batches: usize,
    /// Largest change of an action's probability, as a ratio.
    pub clip_param: f32,
    /// Discount per control step.
    pub gamma: f32,
    /// Decay of the generalised advantage estimate.
    pub lam: f32,
    /// Weight of the value loss.
    pub value_loss_coef: f32,
    /// Weight of the entropy.
    pub entropy_coef: f32,
    /// Greatest norm of each network's gradient.
    pub max_grad_norm: f64,
    /// Whether a value may move by `clip_param` at most.
    pub use_clipped_value_loss: bool,
    /// Kullback-Leibler divergence that the learning rate is adapted to; a fixed learning rate
    /// without.
    pub desired_kl: Option<f64>,
    /// Scale the advantages of each mini-batch separately, instead of those of all samples.
    pub normalize_advantage_per_mini_batch: bool,
    /// Weight of the mirror loss: the squared difference between the policy's mean at an image and
    /// the mirrored mean of the policy that collected the sample. It is averaged over images and a
    /// robot's actions.
    #[serde(default)]
    pub mirror_loss_coef: f32,
}

/// Use of samples with left and right exchanged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Symmetry {
    /// No mirror images.
    None,
    /// Each sample and its mirror image, at twice the cost.
    Both,
    /// Each sample or its mirror image, in turn from epoch to epoch.
    Alternate,
}

impl Symmetry {
    /// Rows of a mini-batch for each of its samples.
    pub(crate) fn rows_per_sample(self) -> usize {
        if self == Self::Both { 2 } else { 1 }
    }
}

/// A block of envs with the same robot.
#[derive(Clone, Debug)]
pub struct Robot {
    /// Envs of the robot, `[start, stop)`.
    pub envs: (usize, usize),
    /// Mirror of each number of an observation: index and sign of its image. Empty where there is
    /// no mirror.
    pub observation_mirror: Vec<(usize, f32)>,
    /// Mirror of each number of an action.
    pub action_mirror: Vec<(usize, f32)>,
    /// Numbers of an observation that the robot has; all where empty. Missing ones are 0 and count
    /// for nothing.
    pub observation_mask: Vec<bool>,
    /// Actions that the robot has; all where empty. Missing ones are 0 and count for nothing.
    pub action_mask: Vec<bool>,
}

impl Robot {
    /// Whether the robot has an action.
    pub(crate) fn has_action(&self, action: usize) -> bool {
        self.action_mask.get(action).is_none_or(|has| *has)
    }

    /// Whether the robot has a number of an observation.
    pub(crate) fn has_number(&self, number: usize) -> bool {
        self.observation_mask.get(number).is_none_or(|has| *has)
    }
}

/// Settings that contradict each other, or arrays that do not fit them.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{element}: {problem}")]
pub struct LearnerError {
    /// The setting or argument.
    pub element: &'static str,
    /// Problem and remedy.
    pub problem: String,
}

impl LearnerError {
    pub(crate) fn new(element: &'static str, problem: impl Into<String>) -> Self {
        Self { element, problem: problem.into() }
    }
}

/// Largest width of a layer, an observation or an action.
const MOST_NUMBERS: usize = 65_536;
/// Largest number of samples of an iteration.
const MOST_SAMPLES: usize = 1 << 28;

impl Settings {
    /// Checks that a learner can be made of them.
    pub(crate) fn check(&self) -> Result<(), LearnerError> {
        let sizes = [("num_envs", self.num_envs), ("num_steps_per_env", self.options.num_steps_per_env)];
        let algorithm = &self.options.algorithm;
        let counts =
            [("num_learning_epochs", algorithm.num_learning_epochs), ("num_mini_batches", algorithm.num_mini_batches)];
        for (element, size) in sizes.into_iter().chain(counts) {
            if size == 0 || size > MOST_SAMPLES {
                return Err(LearnerError::new(element, format!("{size} is not from 1 to {MOST_SAMPLES}")));
            }
        }
        if self.num_envs.saturating_mul(self.options.num_steps_per_env) > MOST_SAMPLES {
            return Err(LearnerError::new("num_envs", format!("more than {MOST_SAMPLES} samples an iteration")));
        }
        let layers = self.options.actor.hidden_dims.iter().chain(&self.options.critic.hidden_dims);
        for &size in layers.chain([&self.num_obs, &self.num_actions]) {
            if size == 0 || size > MOST_NUMBERS {
                return Err(LearnerError::new("hidden_dims", format!("{size} is not from 1 to {MOST_NUMBERS}")));
            }
        }
        for (element, network) in [("actor", &self.options.actor), ("critic", &self.options.critic)] {
            self.check_columns(element, network)?;
        }
        let mut next = 0;
        for robot in &self.robots {
            let (start, stop) = robot.envs;
            if start != next || stop < start {
                return Err(LearnerError::new("robots", "their envs must follow one another"));
            }
            next = stop;
            let mirrors = [(&robot.observation_mirror, self.num_obs), (&robot.action_mirror, self.num_actions)];
            for (mirror, size) in mirrors {
                let fits = mirror.len() == size && mirror.iter().all(|&(index, _)| index < size);
                if !(fits || mirror.is_empty() && self.options.symmetry == Symmetry::None) {
                    return Err(LearnerError::new("robots", format!("a mirror must say {size} numbers below {size}")));
                }
            }
        }
        for robot in &self.robots {
            let masks = [(&robot.observation_mask, self.num_obs), (&robot.action_mask, self.num_actions)];
            if let Some((_, size)) = masks.into_iter().find(|(mask, size)| !mask.is_empty() && mask.len() != *size) {
                return Err(LearnerError::new("robots", format!("a mask must say {size} numbers, or none")));
            }
        }
        if next != self.num_envs {
            return Err(LearnerError::new("robots", format!("they have {next} of {} envs", self.num_envs)));
        }
        Ok(())
    }

    /// Checks that a network reads existing columns.
    fn check_columns(&self, element: &'static str, network: &Network) -> Result<(), LearnerError> {
        let error = |problem: String| Err(LearnerError::new(element, problem));
        let mut columns: Vec<usize> = network.columns.clone();
        if let Some(joints) = &network.joints {
            for size in [joints.joint_dim, joints.num_heads] {
                if size == 0 || size > MOST_NUMBERS {
                    return error(format!("joint_dim and num_heads: {size} is not from 1 to {MOST_NUMBERS}"));
                }
            }
            if joints.states.is_empty() || joints.descriptions.is_empty() || network.hidden_dims.is_empty() {
                return error("a network of joints needs states, descriptions and hidden_dims".into());
            }
            if joints.scales.len() != joints.states.len() {
                return error(format!("{} scales for {} states", joints.scales.len(), joints.states.len()));
            }
            for of_number in joints.states.iter().chain(&joints.descriptions) {
                if of_number.len() != self.num_actions {
                    return error(format!("{} columns of a number for {} slots", of_number.len(), self.num_actions));
                }
                columns.extend(of_number);
            }
            columns.extend(&joints.general);
            if let Some(heads) = joints.leg_heads {
                if heads == 0 || heads > joints.num_heads {
                    return error(format!("leg_heads: {heads} is not from 1 to num_heads = {}", joints.num_heads));
                }
                if joints.legs.len() != self.num_actions {
                    return error(format!("legs: {} of {} slots", joints.legs.len(), self.num_actions));
                }
            }
        }
        match columns.iter().find(|&&column| column >= self.num_obs) {
            Some(column) => error(format!("column {column} of a row of {} numbers", self.num_obs)),
            None => Ok(()),
        }
    }
}
