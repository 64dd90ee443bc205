#![doc = include_str!("README.md")]
#![deny(unsafe_code)]
#![warn(missing_docs)]

mod access;
pub mod app;
mod avian;
pub mod batch;
pub mod bounds;
pub mod components;
pub mod config;
mod crew;
pub mod draft;
pub mod dump;
pub mod files;
mod fits;
pub mod mirrors;
pub mod morphology;
mod obstacles;
pub mod outline;
pub mod robot;
pub mod rows;
pub mod simulation;
pub mod snapshot;
mod sync;
#[path = "../systems/mod.rs"]
pub mod systems;
pub mod terrain;
pub mod variation;
pub mod world;

pub use polypod_dynamics as dynamics;

pub use app::{Sim, SimError, SimOptions};
pub use avian::SUBSTEPS as AVIAN_SUBSTEPS;
pub use simulation::{Control, Simulation, SimulationError, SimulationOptions};

/// The Rust blocks of the pages, which `cargo test --doc` compiles.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
#[doc = include_str!("../docs/write-a-term.md")]
struct Pages;
