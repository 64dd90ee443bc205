//! The crates hold their code, configs and robots: no data, media or policies, and well under 3 MB.

use std::path::Path;
use std::process::Command;

/// Files that `cargo publish` packs.
fn packed(package: &str) -> Vec<String> {
    let list = Command::new(env!("CARGO"))
        .args(["package", "--list", "--locked", "--allow-dirty", "--package", package])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(list.status.success(), "{}", String::from_utf8_lossy(&list.stderr));
    String::from_utf8(list.stdout).unwrap().lines().map(|line| line.replace('\\', "/")).collect()
}

#[test]
fn the_library_is_small() {
    let files = packed("polypod");
    for needed in ["src/lib.rs", "systems/mod.rs", "configs/tasks/velocity_flat.toml", "README.md"] {
        assert!(files.iter().any(|file| file == needed), "{needed} is missing");
    }
    let folders = ["src/", "systems/", "configs/", "assets/robots/", "examples/"];
    let page = "docs/write-a-term.md";
    let stray =
        |file: &&String| file.contains('/') && !folders.iter().any(|folder| file.starts_with(folder)) && *file != page;
    assert_eq!(files.iter().find(stray), None);
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    // files that cargo writes itself are not there
    let bytes: u64 =
        files.iter().filter_map(|file| std::fs::metadata(root.join(file)).ok()).map(|file| file.len()).sum();
    assert!((500_000..2_700_000).contains(&bytes), "{bytes} bytes before they are compressed");
}

#[test]
fn the_kernels_are_code_alone() {
    let ends = [".rs", ".h", ".cu", ".md", "Cargo.toml", "Cargo.toml.orig", "Cargo.lock", ".cargo_vcs_info.json"];
    for (package, needed) in [
        ("polypod-lanes", "native.rs"),
        ("polypod-dynamics", "kernels.rs"),
        ("polypod-learner", "matrix.rs"),
        ("polypod-cuda", "driver/mod.rs"),
    ] {
        let files = packed(package);
        assert!(files.contains(&format!("src/{needed}")), "{package}: {files:?}");
        assert_eq!(files.iter().find(|file| !ends.iter().any(|end| file.ends_with(end))), None, "{package}");
    }
}
