#![doc = include_str!("README.md")]

mod articulation;
mod canonical;
mod chains;
mod colliders;
mod error;
mod feet;
mod inertia;
mod merge;
mod model;
mod pose;
mod reader;
mod roles;
mod shapes;
mod tree;
mod urdf;

pub use articulation::{Articulation, Site, UNLIMITED, symmetric};
pub use error::{Diagnosis, RobotError, Warning};
pub use model::{Body, Geometry, Joint, JointKind, Link, Model, Shape};
pub use pose::Pose;
pub use roles::{BodyGroup, CANONICAL_JOINT_NAMES, LEGS, ROLES, Roles, body_groups, detect};
pub use urdf::{LoadOptions, load, load_str};
