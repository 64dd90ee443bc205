//! A file of tests that no `mod` line names is not compiled, and tests nothing: there is none.

use std::path::Path;

#[test]
fn every_test_file_is_a_module_of_its_folder() {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests");
    // helpers, data, a program, pytest
    let others = ["common", "data", "loom", "python"];
    let (mut files, mut problems) = (0, Vec::new());
    for entry in std::fs::read_dir(&tests).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap();
        if path.is_file() && name != "promises.rs" {
            problems.push(format!("tests/{name}: move it into a folder of tests/"));
        }
        if !path.is_dir() || others.contains(&name) {
            continue;
        }
        let list = if name == "program" { "main.rs" } else { "mod.rs" };
        let modules = std::fs::read_to_string(path.join(list)).unwrap_or_default();
        for file in std::fs::read_dir(&path).unwrap() {
            let file = file.unwrap().path();
            let module = file.file_stem().unwrap().to_str().unwrap();
            files += 1;
            if !file.ends_with(list) && !modules.lines().any(|line| line == format!("mod {module};")) {
                problems.push(format!("tests/{name}/{module}.rs: add `mod {module};` to tests/{name}/{list}"));
            }
        }
        let rooms = std::fs::read_to_string(tests.join("promises.rs")).unwrap();
        if name != "program" && !rooms.lines().any(|line| line == format!("mod {name};")) {
            problems.push(format!("tests/{name}: add `mod {name};` to tests/promises.rs"));
        }
    }
    assert!(files > 80, "{files} files");
    assert!(problems.is_empty(), "{}", problems.join("\n"));
}
