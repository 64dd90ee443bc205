//! Data of the simulated world: components, blocks of them, and the arrays that a learner sees.

pub mod batch;
pub mod blocks;
pub mod components;
