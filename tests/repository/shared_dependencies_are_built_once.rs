//! The extension, the program and the tests agree on the features of every dependency that they
//! share, so that cargo builds it once.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

/// The sets of features with which a selection of the workspace's members builds each package.
fn features(selection: &[&str]) -> BTreeMap<String, BTreeSet<String>> {
    let tree = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--prefix", "none", "--format", "{p}|{f}"])
        .args(selection)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(tree.status.success(), "{}", String::from_utf8_lossy(&tree.stderr));
    let mut found: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for line in String::from_utf8(tree.stdout).unwrap().lines() {
        if let Some((package, features)) = line.trim_end_matches(" (*)").split_once('|') {
            found.entry(package.into()).or_default().insert(features.into());
        }
    }
    found
}

#[test]
fn every_command_of_the_makefile_asks_for_the_same_features() {
    let all = features(&["--workspace", "--edges", "normal,build,dev"]);
    assert!(all.len() > 200, "only {} packages", all.len());
    for member in ["polypod-python", "polypod-sim"] {
        let part = features(&["--package", member, "--edges", "normal,build"]);
        assert!(part.keys().any(|package| package.starts_with("bevy_ecs ")), "not the tree of {member}");
        let differing: Vec<String> = part
            .iter()
            .filter(|(package, features)| !features.is_subset(&all[*package]))
            .map(|(package, features)| format!("{package}: {features:?} alone, {:?} in the workspace", all[package]))
            .collect();
        assert!(
            differing.is_empty(),
            "{member}: name these features in workspace-hack/Cargo.toml:\n{}",
            differing.join("\n")
        );
    }
}
