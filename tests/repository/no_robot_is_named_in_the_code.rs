//! A robot is data: the code names none.

use std::path::{Path, PathBuf};

#[test]
fn src_and_systems_name_no_robot() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = Vec::new();
    for folder in ["src", "systems", "crates"] {
        rust_files(&root.join(folder), &mut files);
    }
    assert!(files.len() > 30, "only {} files found", files.len());
    let mut found = Vec::new();
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap();
        let name = file.strip_prefix(root).unwrap().display();
        found.extend(lines_that_name_a_robot(&text).into_iter().map(|(n, line)| format!("{name}:{n}: {line}")));
    }
    assert!(found.is_empty(), "robots belong in configs/robots:\n{}", found.join("\n"));
}

#[test]
fn the_search_finds_names_and_skips_unit_tests() {
    let text = "// Spot's gait\nlet x = \"unitree_a1\";\nANYMAL_D\nspots despotic\n#[cfg(test)]\nmod tests {\n    // spot\n}\nanymal";
    let lines: Vec<usize> = lines_that_name_a_robot(text).into_iter().map(|(n, _)| n).collect();
    assert_eq!(lines, [1, 2, 3, 9]);
}

fn rust_files(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_files(&path, files);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
}

/// SharedArray and texts of the lines outside `#[cfg(test)]` modules that hold a robot's or its
/// maker's name.
fn lines_that_name_a_robot(text: &str) -> Vec<(usize, &str)> {
    let mut found = Vec::new();
    let mut in_tests = false;
    for (i, line) in text.lines().enumerate() {
        // rustfmt puts a top-level module's closing brace at the start of a line
        in_tests = if in_tests { line != "}" } else { line.starts_with("#[cfg(test)]") };
        let words = line.split(|c: char| !c.is_alphanumeric()).map(str::to_lowercase);
        if !in_tests
            && words.into_iter().any(|word| ["anymal", "unitree"].iter().any(|n| word.starts_with(n)) || word == "spot")
        {
            found.push((i + 1, line));
        }
    }
    found
}
