#![doc = include_str!("README.md")]

mod articulation;
mod canonical;
mod chains;
mod check;
mod colliders;
mod error;
mod feet;
mod hull;
mod inertia;
mod limb_roles;
mod limbs;
mod merge;
mod mesh;
mod missing;
mod model;
mod pose;
mod quadruped;
mod reader;
mod roles;
mod shapes;
mod tree;
mod urdf;

pub use articulation::{Articulation, FASTEST, Site, soft_limits, symmetric};
pub use check::check;
pub use error::{Diagnosis, RobotError, Warning};
pub(crate) use hull::triangles as hull_triangles;
pub use limbs::{Foot, Limb, LimbJoint, LimbKind, Place, Role, Roles, Side, Slot};
pub(crate) use mesh::{Surface, read_surface};
pub use missing::naming_missing_meshes;
pub use model::{Body, Geometry, Joint, JointKind, Link, LockedJoint, Model, Shape};
pub use pose::Pose;
pub use quadruped::{CANONICAL_JOINT_NAMES, LEGS, ROLES};
pub use roles::{BodyGroup, body_groups, detect};
pub use urdf::{LoadOptions, load, load_str};
