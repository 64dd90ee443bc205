#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]
#![warn(missing_docs)]

mod activation;
mod adam;
mod arrays;
mod attention;
mod bodies;
mod device;
mod gaussian;
mod joints;
mod layer;
mod learner;
mod lines;
mod matrix;
mod moments;
mod network;
mod normalizer;
mod peers;
mod perceptron;
mod random;
mod reward_scale;
mod rollout;
mod settings;
mod tree;
mod update;

pub use activation::Activation;
pub use adam::Rates;
pub use arrays::RolloutArrays;
pub use device::{
    DeviceBatch, DeviceFailure, DeviceLayer, DeviceNetwork, DevicePart, DeviceSums, DeviceUpdate, UpdateDevice,
};
pub use learner::{Learner, Team};
pub use lines::{Line, WIDTH};
pub use network::{NetworkName, NetworkState};
pub use normalizer::Normalizer;
pub use peers::{Peers, Worker};
pub use reward_scale::RewardScale;
pub use rollout::Episode;
pub use settings::{Algorithm, Joints, LearnerError, Network, Options, Robot, Settings, Symmetry};
pub use update::Losses;
