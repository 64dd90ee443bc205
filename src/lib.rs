#![doc = include_str!("README.md")]
#![deny(unsafe_code)]
#![warn(missing_docs)]

mod access;
pub mod app;
mod avian;
pub mod batch;
pub mod components;
pub mod config;
mod crew;
pub mod draft;
pub mod dump;
pub mod dynamics;
pub mod mirrors;
pub mod morphology;
mod obstacles;
pub mod outline;
#[cfg(feature = "onnx")]
pub mod policy;
#[cfg(feature = "python")]
mod python;
pub mod robot;
pub mod rows;
pub mod simulation;
pub mod snapshot;
#[path = "../systems/mod.rs"]
pub mod systems;
pub mod terrain;
pub mod variation;
pub mod world;

pub use app::{Sim, SimError, SimOptions};
pub use simulation::{Control, Simulation, SimulationError, SimulationOptions};
