//! Robots of a task: a URDF and a config brought together, variations of it, and its shapes for
//! viewers.

pub(crate) mod agreement;
pub mod geometry_export;
pub mod morphology;
pub mod variation;
