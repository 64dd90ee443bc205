//! Kernels steer by `when`, `repeat` and `gather` of `Real` alone, so that a lane and a thread of a
//! device take the same steps.

use std::fs;
use std::path::{Path, PathBuf};

/// Operations on masks and lanes that those three are made of.
const PRIMITIVES: [&str; 4] = ["S::any(", "lane_f32(", ".lane(", ".set_lane("];
/// Files that move numbers into lanes and back between steps, and look at none within a step.
const BETWEEN_STEPS: [&str; 2] = ["parameters.rs", "state.rs"];

fn sources(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { sources(&path) } else { vec![path] }).collect()
}

/// Lines of a text, tests left out, that call a primitive.
fn offences(text: &str) -> Vec<&str> {
    let kernels = text.split("#[cfg(test)]").next().unwrap();
    kernels.lines().filter(|line| PRIMITIVES.iter().any(|primitive| line.contains(primitive))).collect()
}

#[test]
fn no_kernel_looks_at_lanes_itself() {
    let files = sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/dynamics/src"));
    assert!(files.len() > 25, "{files:?}");
    for file in files {
        if BETWEEN_STEPS.iter().any(|name| file.ends_with(name)) {
            continue;
        }
        let text = fs::read_to_string(&file).unwrap();
        assert_eq!(offences(&text), [""; 0], "{}: write it with when, repeat or gather", file.display());
    }
}

#[test]
fn an_offence_is_seen() {
    let found = offences("if S::any(near) {\n    x.set_lane_f32(lane, 1.0);\nS::when(near);\n#[cfg(test)]\nS::any(x)");
    assert_eq!(found, ["if S::any(near) {", "    x.set_lane_f32(lane, 1.0);"]);
}
