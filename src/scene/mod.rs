//! Avian's world: the ground and the obstacles that robots stand on, and the mirrors of their
//! links.

pub mod mirrors;
pub(crate) mod obstacles;
pub mod world;
