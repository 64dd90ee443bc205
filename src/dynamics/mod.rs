#![doc = include_str!("README.md")]

pub mod algorithms;
pub mod articulation;
pub mod blocks;
pub mod contact;
pub mod factor;
pub mod kinematics;
pub mod lanes;
pub mod math;
pub mod numbers;
pub mod parameters;
pub mod proximity;
pub mod rows;
pub mod self_contact;
pub mod solver;
mod sparse_rows;
pub mod state;
pub mod step;
pub mod terrain;

pub use algorithms::Dynamics;
pub use articulation::{
    Axis, ColliderTopology, ContactKind, ContactTopology, EffortTable, JointMotion, JointTopology, PairTopology,
    Topology,
};
pub use contact::{ContactSettings, Plane, SWEEPS};
pub use lanes::{Lanes, Real, Simd};
pub use numbers::Numbers;
pub use parameters::Parameters;
pub use state::{Drive, Report, State, Workspace};
pub use step::{ControlStep, StepSettings};
pub use terrain::{HeightGrid, Terrain};
