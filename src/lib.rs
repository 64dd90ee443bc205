#![doc = include_str!("README.md")]
#![deny(unsafe_code)]
#![warn(missing_docs)]

mod actuator_network;
pub mod app;
mod bodies;
pub mod bounds;
pub mod config;
pub mod draft;
mod ecs;
pub mod engine;
mod error;
mod options;
pub mod robot;
mod scene;
pub mod simulation;
mod storage;
#[path = "../systems/mod.rs"]
pub mod systems;
pub mod terrain;
mod threads;

pub use polypod_dynamics as dynamics;
pub use polypod_learner as learner;

pub use app::{ForceRows, HostPlugin, HostedStep, LinkRows, ParameterRows, Sim, StateRows, dump, snapshot};
pub use bodies::{geometry_export, morphology, variation};
pub use config::AVIAN_SUBSTEPS;
pub use ecs::{batch, blocks, components};
pub use error::Error;
pub use options::{Autoreset, SimOptions};
pub use scene::{mirrors, world};
pub use simulation::{Control, Simulation, SimulationOptions};
pub use storage::files;
pub use threads::workers;

// rooms name these as if they stood at the root
use bodies::agreement;
use scene::obstacles;
use storage::{hash, sealed};
use threads::{sync, thread_team};

/// The Rust blocks of the pages, which `cargo test --doc` compiles.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
#[doc = include_str!("../docs/write-a-term.md")]
struct Pages;
