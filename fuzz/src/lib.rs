//! Bodies of the fuzz targets. The tests include this file and run it with `tests/data/hostile`.
//!
//! Each function panics where polypod breaks a promise, and returns whether polypod accepts the
//! input.

pub mod dumps;
mod edits;
pub mod folder;
pub mod onnx_manifest;
pub mod snapshots;
pub mod toml_layers;
pub mod urdf_loader;
