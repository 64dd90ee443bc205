//! Files of `tests/data/hostile`, by the reader that they are for: each is accepted or refused, and
//! breaks nothing. The fuzz targets start from them and do the same with what they make of them;
//! what they find is added there.

use std::path::Path;

#[path = "../../fuzz/src/lib.rs"]
mod targets;

/// Gives each file of a folder to a target. Both outcomes must come about: a target that refuses
/// everything would test nothing.
#[track_caller]
fn each(folder: &str, target: fn(&[u8]) -> bool) {
    let folder = Path::new(crate::ROOT).join("tests/data/hostile").join(folder);
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let mut accepted = 0;
    for file in &files {
        // shown if the target panics
        println!("{}", file.display());
        accepted += usize::from(target(&std::fs::read(file).unwrap()));
    }
    targets::folder::remove();
    assert!(accepted > 0 && accepted < files.len(), "{accepted} of {} files are accepted", files.len());
}

#[test]
fn urdfs() {
    each("urdf", targets::urdf_loader::run);
}

#[test]
fn configs() {
    each("toml", targets::toml_layers::run);
}

#[test]
fn snapshots() {
    each("snapshots", targets::snapshots::run);
}

#[test]
fn dumps() {
    each("dumps", targets::dumps::run);
}

#[test]
fn policies() {
    each("manifests", targets::onnx_manifest::run);
}
