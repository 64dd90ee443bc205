#![doc = include_str!("README.md")]
#![deny(unsafe_code)]
#![warn(missing_docs)]

mod actuator_network;
mod agreement;
pub mod app;
pub mod batch;
pub mod blocks;
pub mod bounds;
pub mod components;
pub mod config;
pub mod draft;
pub mod engine;
mod error;
pub mod files;
pub mod geometry_export;
mod hash;
pub mod mirrors;
pub mod morphology;
mod obstacles;
mod options;
pub mod robot;
mod sealed;
pub mod simulation;
mod sync;
#[path = "../systems/mod.rs"]
pub mod systems;
pub mod terrain;
mod thread_team;
pub mod variation;
pub mod workers;
pub mod world;

pub use polypod_dynamics as dynamics;
pub use polypod_learner as learner;

pub use app::{ForceRows, LinkRows, ParameterRows, Sim, StateRows, dump, snapshot};
pub use config::AVIAN_SUBSTEPS;
pub use error::Error;
pub use options::{Autoreset, SimOptions};
pub use simulation::{Control, Simulation, SimulationOptions};

/// The Rust blocks of the pages, which `cargo test --doc` compiles.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
#[doc = include_str!("../docs/write-a-term.md")]
struct Pages;
