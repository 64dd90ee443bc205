//! The update as a device computes it: its inputs, its steps, its results.
//!
//! A device keeps its own copies of samples and networks. The learner's copies stay as they are
//! until the update has ended, so that an update whose device fails is made again on the CPU.

use std::ops::Range;

use crate::activation::Activation;
use crate::adam::Rates;
use crate::gaussian::RANGE;
use crate::learner::Learner;
use crate::lines::{Line, WIDTH};
use crate::network::Mirror;
use crate::rollout::{Part, share};
use crate::settings::{LearnerError, Symmetry};

/// Why a device cannot compute updates, or no longer can.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct DeviceFailure(pub String);

/// A device that computes gradients and steps with the bits of this crate. The calls of an update
/// are [`begin`](Self::begin), then [`gradients`](Self::gradients) and [`step`](Self::step) for
/// each mini-batch, then [`networks`](Self::networks).
pub trait UpdateDevice: Send + Sync {
    /// Name of the device.
    fn name(&self) -> &str;

    /// Takes over networks and samples.
    ///
    /// # Errors
    /// Too little memory, or a device that is lost.
    fn begin(&mut self, update: &DeviceUpdate) -> Result<(), DeviceFailure>;

    /// Computes the gradients of a mini-batch.
    ///
    /// # Errors
    /// A device that is lost.
    fn gradients(&mut self, batch: &DeviceBatch) -> Result<DeviceSums, DeviceFailure>;

    /// Takes a step with the actor and the critic; returns the deviations of the actions, `[lines
    /// of an action]`.
    ///
    /// # Errors
    /// A device that is lost.
    fn step(&mut self, rates: [Rates; 2]) -> Result<Vec<Line>, DeviceFailure>;

    /// Weights, and Adam's two moments, of the actor and the critic.
    ///
    /// # Errors
    /// A device that is lost.
    fn networks(&mut self) -> Result<[[Vec<Line>; 3]; 2], DeviceFailure>;
}

/// Inputs of an update.
#[derive(Debug)]
pub struct DeviceUpdate<'a> {
    /// Numbers of an observation.
    pub num_obs: usize,
    /// Numbers of an action.
    pub num_actions: usize,
    /// The actor and the critic.
    pub networks: [DeviceNetwork<'a>; 2],
    /// The parts of the envs.
    pub parts: Vec<DevicePart<'a>>,
    /// The samples of each part in each mini-batch, as places in its order,
    /// `[mini-batches][parts]`.
    pub batches: Vec<Vec<Range<usize>>>,
    /// Number of sums over parts that are complete with each part.
    pub complete: &'a [usize],
    /// Images of the numbers of each robot's observations and actions: index and sign. Empty where
    /// no images are learnt from.
    pub mirrors: Vec<[&'a [(usize, f32)]; 2]>,
    /// Number of robots.
    pub num_robots: usize,
    /// Use of mirror images.
    pub symmetry: Symmetry,
    /// Largest change of an action's probability, as a ratio.
    pub clip_param: f32,
    /// Whether a value may move by `clip_param` at most.
    pub use_clipped_value_loss: bool,
    /// Weight of the value loss.
    pub value_loss_coef: f32,
    /// Range of the deviations.
    pub deviations: [f32; 2],
}

/// A perceptron as lines. A layer's weights are panels `[outputs / 16][inputs, then the bias]`.
#[derive(Debug)]
pub struct DeviceNetwork<'a> {
    /// Layers from the input on.
    pub layers: Vec<DeviceLayer>,
    /// Function after each layer but the last.
    pub activation: Activation,
    /// Numbers that the network reads.
    pub inputs: usize,
    /// Columns of an observation that these are; None: all of them.
    pub columns: Option<&'a [usize]>,
    /// Mean of each input, and one over its deviation; None: they are read as they are.
    pub statistics: Option<[&'a [Line]; 2]>,
    /// Weights, and Adam's two moments. Deviations of actions are last.
    pub numbers: [&'a [Line]; 3],
    /// First line of the deviations.
    pub first_deviation: usize,
    /// Number of deviations.
    pub num_deviations: usize,
}

/// Place of a layer among the lines of its network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceLayer {
    /// First line of its weights.
    pub first: usize,
    /// Inputs, rounded up to a multiple of eight: lines of a panel without the bias.
    pub inner: usize,
    /// Lines of a row of outputs.
    pub panels: usize,
    /// Outputs, rounded up to a multiple of eight: the inner dimension on the way back.
    pub inner_back: usize,
}

/// Samples of a part. Sample `step * envs + env` is that of the part's env `env` at step `step`.
#[derive(Debug)]
pub struct DevicePart<'a> {
    /// Robot of each env.
    pub robot_of: &'a [usize],
    /// Raw observations, `[samples][lines of an observation]`.
    pub observations: &'a [Line],
    /// Actions, `[samples][lines of an action]`.
    pub actions: &'a [Line],
    /// Means of the policy that drew them, `[samples][lines of an action]`.
    pub means: &'a [Line],
    /// Logarithms of the actions' density, `[samples]`.
    pub log_probs: &'a [f32],
    /// Advantages before they are scaled, `[samples]`.
    pub advantages: &'a [f32],
    /// Returns, `[samples]`.
    pub returns: &'a [f32],
    /// Values, `[samples]`.
    pub values: &'a [f32],
    /// Samples in the order in which they are learnt from.
    pub order: &'a [u32],
}

/// A mini-batch, and the policy before its step.
#[derive(Debug)]
pub struct DeviceBatch {
    /// Number of the pass over the samples.
    pub epoch: usize,
    /// Number of the mini-batch in it.
    pub batch: usize,
    /// One over the number of rows: samples, and mirror images in addition to them.
    pub weight: f32,
    /// One over the deviations of each robot's actions, 0 for actions that it lacks,
    /// `[robots][lines of an action]`.
    pub inverse: Vec<Line>,
    /// Constant of the log-density, divergence that deviations add, mean of the advantages, one
    /// over their deviation, and factor of the mirror loss' derivatives, `[robots]`.
    pub of_robots: Vec<[f32; 5]>,
    /// Derivatives of the deviations that each part's sum begins with, `[parts][lines of an
    /// action]`.
    pub start: Vec<Line>,
}

/// Sums over a mini-batch.
#[derive(Debug)]
pub struct DeviceSums {
    /// Surrogate loss, value loss, divergence, and rows that are no mirror images, `[parts]`.
    pub parts: Vec<[f64; 4]>,
    /// Sums of the squares of the actor's and the critic's gradients, `[chunks of lines][lanes]`.
    pub squares: [Vec<[f64; WIDTH]>; 2],
}

impl Learner {
    /// Computes the coming updates on a device.
    ///
    /// # Errors
    /// Networks of joints, and several workers, whose update is on the CPU.
    pub fn use_device(&mut self, device: Box<dyn UpdateDevice>) -> Result<(), LearnerError> {
        for (name, net) in [("actor", &self.actor), ("critic", &self.critic)] {
            if net.joints().is_some() {
                return Err(LearnerError::new(name, "a card learns perceptrons, and this is a network of joints"));
            }
        }
        if !self.shares.is_alone() {
            return Err(LearnerError::new("workers", "a card learns for one process, and there are several"));
        }
        self.device = Some(device);
        self.device_failure = None;
        Ok(())
    }

    /// Why the device was given up; the CPU made its last update again, with the same bits. Says it
    /// once.
    pub fn take_device_failure(&mut self) -> Option<DeviceFailure> {
        self.device_failure.take()
    }

    /// Inputs of an update; None for networks that no device learns.
    pub(crate) fn device_update(&self) -> Option<DeviceUpdate<'_>> {
        let options = &self.settings.options;
        let [(_, tree)] = &self.shares.nodes[..] else { return None };
        let batches = options.algorithm.num_mini_batches;
        let of_batch = |batch| self.parts.iter().map(|part| share(part.order.len(), batch, batches)).collect();
        let learns_images = options.symmetry != Symmetry::None;
        Some(DeviceUpdate {
            num_obs: self.settings.num_obs,
            num_actions: self.settings.num_actions,
            networks: [self.actor.on_device()?, self.critic.on_device()?],
            parts: self.parts.iter().map(Part::on_device).collect(),
            batches: (0..batches).map(of_batch).collect(),
            complete: tree.complete(),
            mirrors: if learns_images { self.mirrors.iter().map(Mirror::on_device).collect() } else { Vec::new() },
            num_robots: self.settings.robots.len(),
            symmetry: options.symmetry,
            clip_param: options.algorithm.clip_param,
            use_clipped_value_loss: options.algorithm.use_clipped_value_loss,
            value_loss_coef: options.algorithm.value_loss_coef,
            deviations: RANGE,
        })
    }
}
