//! Rooms of the library use only rooms below them: `use` lines and paths say so.

use std::path::{Path, PathBuf};

/// The rooms of `src/` from the ground up, `systems/` among them. A room is a file or a folder; it
/// uses those before it. The first two are other crates, whose arrows cargo holds. The files of
/// [`SHELVES`] are rooms too.
const ROOMS: [&str; 31] = [
    "dynamics",
    "learner",
    "bounds",
    "files",
    "hash",
    "sync",
    "sealed",
    "thread_team",
    "workers",
    "robot",
    "actuator_network",
    "config",
    "error",
    "options",
    "components",
    "batch",
    "agreement",
    "morphology",
    "blocks",
    "variation",
    "geometry_export",
    "terrain",
    "obstacles",
    "world",
    "engine",
    "mirrors",
    "simulation",
    "systems",
    "app",
    "draft",
    "lib",
];

/// Folders of `src/` whose modules stand at the root of the library.
const SHELVES: [&str; 5] = ["bodies", "ecs", "scene", "storage", "threads"];

/// The files of `systems/` from the ground up; `mod` holds what they share, the schedules and sets.
const SYSTEMS: [&str; 31] = [
    "commanded",
    "view",
    "terms",
    "views",
    "faults",
    "sampling",
    "saved",
    "load",
    "scene",
    "spawn",
    "act",
    "command",
    "curriculum",
    "disturb",
    "broken",
    "physics",
    "mirror",
    "sense",
    "groups",
    "terminate",
    "logs",
    "gather",
    "reward",
    "startup",
    "place",
    "reset",
    "observe",
    "privileged",
    "finite",
    "whole",
    "builtin",
];

fn sources(dir: &Path, out: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, out);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            out.push(path);
        }
    }
}

/// The code of a file, without comments and unit tests.
fn code(path: &Path) -> String {
    let text = std::fs::read_to_string(path).unwrap();
    let end = text.find("#[cfg(test)]\nmod tests").unwrap_or(text.len());
    text[..end].lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

/// The names that follow `prefix`, one by one or in braces.
fn names_after(code: &str, prefix: &str) -> Vec<String> {
    let word = |text: &str| text.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    let mut names = Vec::new();
    for (at, _) in code.match_indices(prefix) {
        if code[..at].ends_with("super::") {
            continue;
        }
        let rest = &code[at + prefix.len()..];
        match rest.strip_prefix('{') {
            Some(group) => names.extend(group[..group.find('}').unwrap()].split(',').map(word)),
            None => names.push(word(rest)),
        }
    }
    names
}

/// Room of a file, and the file's depth in it.
fn room(root: &Path, path: &Path) -> (String, usize) {
    let parts: Vec<&str> = path.strip_prefix(root).unwrap().iter().map(|part| part.to_str().unwrap()).collect();
    let place = usize::from(SHELVES.contains(&parts[0]) && parts[1] != "mod.rs");
    (parts[place].trim_end_matches(".rs").to_string(), parts.len() - 1)
}

/// Uses of a room that is not below the one that uses it.
fn upward(rooms: &[&str], file: &Path, room: &str, used: &[String]) -> Vec<String> {
    let place = |name: &str| rooms.iter().position(|room| *room == name);
    let Some(own) = place(room) else {
        return vec![format!("{}: the room `{room}` has no place in the list", file.display())];
    };
    let above = |name: &&String| *name != room && place(name).is_some_and(|place| place >= own);
    used.iter().filter(above).map(|name| format!("{}: {room} uses {name}", file.display())).collect()
}

#[test]
fn rooms_of_the_library() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let (mut files, mut found) = (Vec::new(), Vec::new());
    sources(&src, &mut files);
    for file in &files {
        let (name, _) = room(&src, file);
        if SHELVES.contains(&name.as_str()) {
            continue;
        }
        found.extend(upward(&ROOMS, file, &name, &names_after(&code(file), "crate::")));
    }
    let systems = Path::new(env!("CARGO_MANIFEST_DIR")).join("systems");
    let mut files = Vec::new();
    sources(&systems, &mut files);
    for file in &files {
        found.extend(upward(&ROOMS, file, "systems", &names_after(&code(file), "crate::")));
    }
    assert!(found.is_empty(), "upward arrows:\n{}", found.join("\n"));
}

#[test]
fn files_of_the_pipeline() {
    let systems = Path::new(env!("CARGO_MANIFEST_DIR")).join("systems");
    let (mut files, mut found) = (Vec::new(), Vec::new());
    sources(&systems, &mut files);
    for file in &files {
        let (name, depth) = room(&systems, file);
        let code = code(file);
        let stem = file.file_stem().unwrap().to_str().unwrap();
        // paths that reach into the folder itself
        let supers = match (depth, stem) {
            (0, _) | (_, "mod") => names_after(&code, "super::"),
            _ => code
                .match_indices("super::super::")
                .map(|(at, _)| &code[at + 7..])
                .flat_map(|rest| names_after(&rest[..rest.find(';').unwrap_or(rest.len())], "super::"))
                .collect(),
        };
        // the list of built-in terms names the files that register them, and nobody uses it
        let name = if stem == "builtin" { stem } else { &name };
        if name != "mod" {
            found.extend(upward(&SYSTEMS, file, name, &supers));
            found.extend(upward(&SYSTEMS, file, name, &names_after(&code, "crate::systems::")));
        }
    }
    assert!(found.is_empty(), "upward arrows:\n{}", found.join("\n"));
}

#[test]
fn an_upward_arrow_is_seen() {
    let file = Path::new("src/config/task.rs");
    let code = "use crate::app::Sim;\nuse crate::{files, blocks};\nlet x = crate::bounds::MAX;";
    let used = names_after(code, "crate::");
    assert_eq!(used, ["app", "files", "blocks", "bounds"]);
    assert_eq!(upward(&ROOMS, file, "config", &used).len(), 2);
    assert_eq!(names_after("use super::{ControlStep, physics};", "super::"), ["ControlStep", "physics"]);
    assert!(names_after("use super::super::physics;", "super::").iter().all(|name| name != "physics"));
}
