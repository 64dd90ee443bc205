//! The promises of the library: a file each, in folders by subject. All are one executable, so that
//! the library is linked once; `cargo nextest run terrain::` runs a folder.

mod common;
#[path = "common/driven.rs"]
mod driven;
#[path = "common/passive.rs"]
mod passive;
#[path = "common/trees.rs"]
mod trees;

mod bits;
mod config;
mod engines;
mod physics;
mod repository;
mod robots;
mod tasks;
mod terrain;
