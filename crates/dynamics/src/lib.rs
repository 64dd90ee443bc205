#![doc = include_str!("../README.md")]
#![deny(unsafe_code)]
#![warn(missing_docs)]
#![cfg_attr(
    test,
    allow(dead_code, unused_imports, reason = "the kernels that use it are not compiled again for unit tests")
)]
#![allow(rustdoc::private_intra_doc_links, reason = "the README explains the private modules too")]

// Each public name has one path: types stand at the root, functions of numbers in `elementary`, of
// vectors in `math`, and what depends on instruction sets in `lanes`.

mod actuators;
mod algorithms;
mod articulation;
mod blocks;
mod factor;
mod gaps;
mod ground;
mod ground_contacts;
mod joint_bounds;
mod kernels;
mod kinematics;
mod lists;
pub mod math;
mod networks;
mod parameters;
mod proximity;
mod ray_cast;
mod report;
mod rows;
mod self_contact;
mod settings;
mod shared_array;
mod solver;
mod sparse_rows;
mod spin_rows;
mod springs;
mod state;
mod step;
mod terrain;

pub use algorithms::Dynamics;
pub use articulation::{
    Axis, ColliderTopology, ContactFriction, ContactKind, ContactTopology, EffortTable, JointMotion, JointTopology,
    MAX_DEPTH, PairTopology, Topology,
};
pub use ground::Plane;
pub use kernels::{Kernels, Scalar, WithKernels};
#[cfg(not(test))]
pub use kernels::{cast_rays, forward_kinematics, pair_gaps, with_kernels};
pub use kinematics::point_motion;
pub use networks::{
    ActuatorNetwork, Function, Instruction, NetworkInput, NetworkProgram, NetworkStep, Operation, Span,
};
pub use parameters::Parameters;
pub use polypod_lanes::{self as lanes, elementary};
pub use ray_cast::{HeightBounds, Rays};
pub use report::Report;
pub use settings::{ContactSettings, SWEEPS, SolverSettings, StepSettings};
pub use shared_array::SharedArray;
pub use state::{Drive, LinkForce, LinkState, State, Workspace};
pub use step::ControlStep;
pub use terrain::{HeightGrid, LARGE_GROUP, Squares, Terrain};
