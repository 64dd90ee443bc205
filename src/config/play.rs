//! Play variants: tasks for watching and measuring a policy, without noise, pushes, randomisation
//! and curriculum.
//!
//! A task may have a file for it: `Walk-Play-v0` belongs to `Walk-v0`. For all others the library
//! makes one by the rule that the built-in files follow.

use std::path::Path;

use toml::{Table, Value};

use super::document::is_toml;
use super::task::TaskConfig;

/// Events that say how an episode begins and which bodies the envs have. All others disturb or
/// randomise.
const BEGINNINGS: [&str; 4] = ["reset_base", "reset_joints", "reset_joints_within_limits_range", "body_variation"];
/// Most levels and columns of a made variant's terrain, and its highest level at the beginning:
/// those of the built-in files.
const ROWS: i64 = 5;
const COLUMNS: i64 = 10;

/// Name of a Play variant: `Walk-Play-v0` of `Walk-v0`, `walk_play` of `walk`, `walk_play.toml` of
/// `walk.toml`. A name of a Play variant stays as it is.
pub(super) fn play_name(task: &str) -> String {
    if training_name(task).is_some() {
        return task.to_owned();
    }
    if let Some(stem) = path_stem(task) {
        return format!("{stem}_play.toml");
    }
    match versioned(task) {
        Some((stem, version)) => format!("{stem}-Play-v{version}"),
        None => format!("{task}_play"),
    }
}

/// The name of the task that a Play variant belongs to; none for a name of another form.
pub(super) fn training_name(play: &str) -> Option<String> {
    if let Some(stem) = path_stem(play) {
        return stem.strip_suffix("_play").filter(|stem| !stem.is_empty()).map(|stem| format!("{stem}.toml"));
    }
    if let Some((stem, version)) = versioned(play) {
        return stem.strip_suffix("-Play").map(|stem| format!("{stem}-v{version}"));
    }
    play.strip_suffix("_play").filter(|stem| !stem.is_empty()).map(str::to_owned)
}

/// The path of a `.toml` without its extension.
fn path_stem(task: &str) -> Option<&str> {
    is_toml(Path::new(task)).then(|| task.strip_suffix(".toml")).flatten()
}

/// Name and version of `Walk-v0`.
fn versioned(task: &str) -> Option<(&str, &str)> {
    task.rsplit_once("-v").filter(|(_, version)| !version.is_empty() && version.bytes().all(|b| b.is_ascii_digit()))
}

/// Changes of a made Play variant to a task, whose layers are `merged`.
pub(super) fn changes(name: &str, merged: &Table) -> Table {
    let mut changes = Table::new();
    changes.insert("name".into(), name.into());
    changes.insert("observations".into(), Value::Table(switch("enable_noise")));
    let events = keys_of(merged, "events").filter(|event| !BEGINNINGS.contains(event));
    changes.insert("events".into(), Value::Table(switched_off(events)));
    if merged.contains_key("curriculum") {
        changes.insert("curriculum".into(), Value::Table(switched_off(keys_of(merged, "curriculum"))));
    }
    if let Some(terrain) = merged.get("scene").and_then(|scene| scene.get("terrain")) {
        let number = |key: &str| terrain.get(key).and_then(Value::as_integer);
        let types = terrain.get("sub_terrains").and_then(Value::as_array).map_or(0, Vec::len) as i64;
        let rows = number("num_rows").unwrap_or(ROWS).min(ROWS);
        let mut smaller = Table::new();
        smaller.insert("num_rows".into(), rows.into());
        smaller.insert("num_cols".into(), number("num_cols").unwrap_or(COLUMNS).min(COLUMNS.max(types)).into());
        smaller.insert("max_init_terrain_level".into(), (rows - 1).max(0).into());
        let mut scene = Table::new();
        scene.insert("terrain".into(), Value::Table(smaller));
        changes.insert("scene".into(), Value::Table(scene));
    }
    changes
}

fn keys_of<'a>(table: &'a Table, key: &str) -> impl Iterator<Item = &'a str> {
    table.get(key).and_then(Value::as_table).into_iter().flat_map(Table::keys).map(String::as_str)
}

fn switch(key: &str) -> Table {
    std::iter::once((key.to_owned(), Value::Boolean(false))).collect()
}

fn switched_off<'a>(names: impl Iterator<Item = &'a str>) -> Table {
    names.map(|name| (name.to_owned(), Value::Table(switch("enabled")))).collect()
}

impl TaskConfig {
    /// Keys that switch off the noise, the pushes and the randomisation of this task, of those that
    /// are on: set to `false`, they leave a task that only draws how episodes begin and what is
    /// commanded. Empty for a Play variant.
    #[must_use]
    pub fn disturbances(&self) -> Vec<String> {
        let observations = &self.observations;
        let is_noisy = observations.enable_noise
            && observations.groups().any(|(_, terms)| terms.iter().any(|t| t.noise > 0.0 || t.error > 0.0));
        let events = self.events.iter().filter(|(name, event)| event.enabled && !BEGINNINGS.contains(&name.as_str()));
        is_noisy
            .then(|| "observations.enable_noise".to_owned())
            .into_iter()
            .chain(events.map(|(name, _)| format!("events.{name}.enabled")))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_variants_and_of_their_tasks_belong_together() {
        let pairs = [
            ("Walk-v0", "Walk-Play-v0"),
            ("Walk-Very-v12", "Walk-Very-Play-v12"),
            ("walk", "walk_play"),
            ("my/walk.toml", "my/walk_play.toml"),
            ("Walk-vast", "Walk-vast_play"),
        ];
        for (task, play) in pairs {
            assert_eq!(play_name(task), play);
            assert_eq!(play_name(play), play);
            assert_eq!(training_name(play).as_deref(), Some(task));
            assert_eq!(training_name(task), None);
        }
    }
}
