//! Bevy's facade, which the members of polypod do without and Avian uses. The published one asks
//! for a newer Rust than all the crates behind it do, for the sake of its examples.

#![no_std]

pub use bevy_internal::*;
