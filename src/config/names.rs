//! Names: what the library lists, tasks made for one robot, and what to say about unknown names.

use toml::Value;

use super::document::{Document, DocumentKind};
use super::error::{ConfigError, ConfigErrorKind};
use super::layer::{parse, string_key};
use super::library::PATH_VARIABLE;
use super::suggest::nearest;

/// Parts of a task's name that stand for "many robots"; put a robot's title in its place to get
/// that robot's own task. Quadrupeds of twelve joints are made from tasks of the first family, all
/// other bodies from those of the second.
const FAMILIES: [&str; 2] = ["HeteroQuadruped", "Legged"];

/// A robot in the library's list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RobotEntry {
    /// Name.
    pub name: String,
    /// Name for people.
    pub title: String,
    /// File.
    pub file: String,
    /// Whether all joints of its default pose are those of a quadruped's legs.
    pub is_quadruped: bool,
    /// Reason of its config why it cannot stand in its default pose without a policy.
    pub needs_policy: Option<String>,
}

/// A task in the library's list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TaskEntry {
    /// Full name.
    pub name: String,
    /// Short names, the file's stem among them if it is not the name itself.
    pub aliases: Vec<String>,
    /// File; for a task made for one robot, the file it is made from.
    pub file: String,
    /// Names of its robots; empty for a file that names none and is only there to be extended.
    pub robots: Vec<String>,
}

/// A training config in the library's list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrainEntry {
    /// Name.
    pub name: String,
    /// File.
    pub file: String,
    /// The comment in its first line; empty where there is none.
    pub title: String,
}

/// Names in a task file.
pub(super) struct TaskNames {
    /// Full name.
    pub name: String,
    /// Short names, as of [`TaskEntry`].
    pub aliases: Vec<String>,
}

/// The names of a task file.
pub(super) fn task_names(document: &Document) -> Result<TaskNames, ConfigError> {
    let table = parse(document)?;
    let name = string_key(document, &table, "name")?.unwrap_or(&document.stem).to_owned();
    let listed = table.get("aliases").and_then(Value::as_array).into_iter().flatten();
    let mut aliases: Vec<String> = listed.filter_map(Value::as_str).map(str::to_owned).collect();
    if document.stem != name && !aliases.contains(&document.stem) {
        aliases.push(document.stem.clone());
    }
    Ok(TaskNames { name, aliases })
}

/// The name of the task that the task called `task` makes for one robot, if it is one for many of
/// its kind: robot `big_dog` makes `Walk-Big-Dog-v0` of `Walk-HeteroQuadruped-v0`.
pub(super) fn single_robot_name(task: &str, robot: &str, is_quadruped: bool) -> Option<String> {
    let family = FAMILIES[usize::from(!is_quadruped)];
    if !task.contains(family) {
        return None;
    }
    let capitalised = |word: &str| {
        let mut letters = word.chars();
        letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect::<String>())
    };
    let title = robot.split('_').map(capitalised).collect::<Vec<_>>().join("-");
    Some(task.replace(family, &title))
}

/// The error about an unknown name. Near names are sought among `known` and `made`, which is too
/// long to be listed. Files that are `broken` may have the name.
pub(super) fn unknown_name(
    kind: DocumentKind,
    name: &str,
    known: &[String],
    made: &[String],
    broken: &[ConfigError],
) -> ConfigError {
    let noun = kind.noun();
    let made = made.iter().filter(|name| !known.contains(name));
    let near = nearest(name, known.iter().chain(made).map(String::as_str));
    let remedy = match near[..] {
        [] => format!("known: {}", known.join(", ")),
        _ => format!("did you mean `{}`? The command `list` shows all names", near.join("`, `")),
    };
    let mut problem = format!("there is no {noun} `{name}`");
    for error in broken {
        let ConfigError { file, element, problem: why, .. } = error;
        problem += &format!(", unless it is in {file}, which is broken ({element}: {why})");
    }
    let folder = format!("configs/{}", kind.folder());
    let own = format!("one of your own: the path of its .toml, or {folder} in a folder that {PATH_VARIABLE} names");
    ConfigError::invalid(folder, format!("{noun} `{name}`"), problem, format!("{remedy}; {own}"))
        .of_kind(ConfigErrorKind::UnknownName)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_task_for_many_makes_one_for_each() {
        let made = single_robot_name("Walk-HeteroQuadruped-Play-v0", "big_dog_2", true);
        assert_eq!(made.as_deref(), Some("Walk-Big-Dog-2-Play-v0"));
        assert_eq!(single_robot_name("Walk-v0", "big_dog", true), None);
        assert_eq!(single_robot_name("Walk-HeteroQuadruped-v0", "strider", false), None);
        assert_eq!(single_robot_name("Walk-Legged-v0", "strider", false).as_deref(), Some("Walk-Strider-v0"));
    }
}
