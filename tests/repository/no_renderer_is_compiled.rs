//! A headless simulator builds no renderer, window or asset pipeline, whatever its dependencies
//! could bring along.

use std::process::Command;

#[test]
fn the_dependency_tree_holds_none() {
    let tree = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--workspace", "--prefix", "none", "--edges", "normal,build"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(tree.status.success(), "{}", String::from_utf8_lossy(&tree.stderr));
    let text = String::from_utf8(tree.stdout).unwrap();
    let names: Vec<&str> = text.lines().filter_map(|line| line.split(' ').next()).collect();
    assert!(
        ["avian3d", "bevy_ecs", "pyo3", "clap"].iter().all(|name| names.contains(name)),
        "not polypod's tree: {text}"
    );
    for unwanted in ["bevy_render", "bevy_pbr", "bevy_winit", "bevy_window", "bevy_asset", "wgpu", "winit", "naga"] {
        assert!(!names.contains(&unwanted), "{unwanted} is compiled");
    }
}
