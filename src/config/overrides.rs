//! Overrides: `rewards.trot.gait.weight=5.0`, as given to `--set`.

use toml::{Table, Value};

use super::error::{ConfigError, ConfigErrorKind};
use super::layer::{OVERRIDE, element_index, merge, unknown_element};
use super::suggest::did_you_mean;

/// Tables whose keys are not known beforehand: robots, with a task's changes of their configs and
/// their shares of the envs. Missing tables on the way into them are made; they are checked where
/// the robots are read.
const OPEN: [&str; 2] = ["robot_overrides", "env_shares"];

/// Tables that a task may lack: they are then absent from the keys of its resolved config.
const OPTIONAL: [&str; 3] = ["scene.terrain", "sensors.height_scanner", "sensors.ray_caster_camera"];

/// A table that the resolved config lacks where all its keys are at their defaults, and the table
/// in it. Both are made on the way to a key.
const IMPLIED: [&str; 2] = ["actions", "joint_pos"];

/// Key of the place after the last element of an array.
const APPEND: &str = "+";

/// Writes one override into `resolved`, the config with all its defaults spelled out, and returns
/// the path it wrote to. Every table on the way must exist; whether a new last key is a known one
/// is left to the types. Elements of an array are named by index, `name` or `term`; `+` appends
/// one. The value is TOML, or a bare word, which is a string; `null` or `~` removes the key.
///
/// # Errors
/// No `=`, an unknown key, a value that is not TOML.
pub fn apply(resolved: &mut Table, text: &str) -> Result<String, ConfigError> {
    let Some((path, value)) = text.split_once('=') else {
        return Err(ConfigError::invalid(
            OVERRIDE,
            text,
            "there is no `=` in it",
            "write key=value, as in sim.dt=0.002",
        ));
    };
    let path = path.trim();
    let value = parse_value(path, value.trim())?;
    let keys: Vec<&str> = path.split('.').map(str::trim).collect();
    let Some((last, parents)) = keys.split_last().filter(|_| !keys.contains(&"")) else {
        return Err(ConfigError::invalid(
            OVERRIDE,
            text,
            "the key is incomplete",
            "write key=value, as in sim.dt=0.002",
        ));
    };
    let mut walked: Vec<String> = Vec::with_capacity(keys.len());
    // One value type on the way down; taken back at the end, unless something fails.
    let mut root = Value::Table(resolved.clone());
    let written =
        descend(&mut root, parents, last, &mut walked).and_then(|parent| write(parent, last, value, &mut walked));
    written?;
    if let Value::Table(table) = root {
        *resolved = table;
    }
    Ok(walked.join("."))
}

/// A TOML value, a bare word as a string, or `None` for `null` and `~`.
fn parse_value(path: &str, text: &str) -> Result<Option<Value>, ConfigError> {
    if text == "null" || text == "~" {
        return Ok(None);
    }
    let parsed = format!("value = {text}").parse::<Table>().ok();
    if let Some(value) = parsed.filter(|table| table.len() == 1).and_then(|mut t| t.remove("value")) {
        return Ok(Some(value));
    }
    let is_bare = |letter: char| letter.is_alphanumeric() || matches!(letter, '_' | '-' | '.' | '/' | '+');
    if !text.is_empty() && text.chars().all(is_bare) {
        return Ok(Some(Value::String(text.to_owned())));
    }
    Err(ConfigError::invalid(
        OVERRIDE,
        path,
        format!("`{text}` is neither a TOML value nor a bare word"),
        "write a TOML value such as 0.5, [0.0, 1.0], true or \"text\"; quote it for the shell",
    ))
}

/// Follows `keys` down from `node`.
///
/// A command that the task lacks is made, and so is a group of observations where `last` appends a
/// term to it.
fn descend<'a>(
    mut node: &'a mut Value,
    keys: &[&str],
    last: &str,
    walked: &mut Vec<String>,
) -> Result<&'a mut Value, ConfigError> {
    for key in keys {
        node = match node {
            Value::Table(table) => {
                if OPEN.contains(&walked.first().map_or(*key, String::as_str)) {
                    table.entry(*key).or_insert_with(|| Value::Table(Table::new()));
                }
                if walked.is_empty() && *key == IMPLIED[0] {
                    let within = Table::from_iter([(IMPLIED[1].to_owned(), Value::Table(Table::new()))]);
                    table.entry(*key).or_insert(Value::Table(within));
                }
                if *walked == ["commands"] {
                    table.entry(*key).or_insert_with(|| Value::Table(Table::new()));
                }
                if *walked == ["observations"] && last == APPEND {
                    table.entry(*key).or_insert_with(|| Value::Array(Vec::new()));
                }
                if !table.contains_key(*key) {
                    let here = dotted(walked, key);
                    let missing = OPTIONAL.contains(&here.as_str()).then(|| no_such_table(&here));
                    return Err(missing.unwrap_or_else(|| unknown(key, table.keys().map(String::as_str), walked)));
                }
                walked.push((*key).to_owned());
                &mut table[*key]
            }
            Value::Array(items) => {
                let index = index_of(items, key, walked)?;
                walked.push(index.to_string());
                &mut items[index]
            }
            other => return Err(not_a_table(key, other, walked)),
        };
    }
    Ok(node)
}

/// Sets, merges into or removes `key` of `node`.
fn write(node: &mut Value, key: &str, value: Option<Value>, walked: &mut Vec<String>) -> Result<(), ConfigError> {
    match (node, value) {
        (Value::Table(table), Some(value)) => {
            let mut above = Table::new();
            above.insert(key.to_owned(), value);
            merge(table, above).map_err(|error| {
                let element = dotted(walked, &error.element);
                ConfigError { element, ..error.in_file(OVERRIDE) }
            })?;
            walked.push(key.to_owned());
        }
        (Value::Table(table), None) => {
            let may_lack =
                (walked.is_empty() && OPEN.contains(&key)) || OPTIONAL.contains(&dotted(walked, key).as_str());
            if table.remove(key).is_none() && !may_lack {
                return Err(unknown(key, table.keys().map(String::as_str), walked));
            }
            walked.push(key.to_owned());
        }
        (Value::Array(items), Some(value)) if key == APPEND => {
            walked.push(items.len().to_string());
            items.push(value);
        }
        (Value::Array(items), value) => {
            let index = index_of(items, key, walked)?;
            match value {
                Some(value) => items[index] = value,
                None => {
                    items.remove(index);
                }
            }
            walked.push(index.to_string());
        }
        (other, _) => return Err(not_a_table(key, other, walked)),
    }
    Ok(())
}

/// The index that `key` means.
fn index_of(items: &[Value], key: &str, walked: &[String]) -> Result<usize, ConfigError> {
    element_index(items, key).ok_or_else(|| {
        let error = unknown_element(items, &dotted(walked, key), key).in_file(OVERRIDE);
        if walked != ["robots"] {
            return error;
        }
        // it is a list of names; the robots' own keys are elsewhere
        let remedy = format!("a robot's own config is changed by robot_overrides.{key}.<key>=<value>");
        ConfigError { remedy, ..error }
    })
}

fn unknown<'a>(key: &str, known: impl IntoIterator<Item = &'a str>, walked: &[String]) -> ConfigError {
    let remedy = did_you_mean(key, known, "keys");
    ConfigError::invalid(OVERRIDE, dotted(walked, key), format!("unknown key `{key}`"), remedy)
        .of_kind(ConfigErrorKind::UnknownKey)
}

/// Error about a task without a table which other tasks have.
fn no_such_table(table: &str) -> ConfigError {
    let remedy =
        format!("set all of it, as in {table}={{ ... }}, or begin with a task that has it, such as velocity_rough");
    ConfigError::invalid(OVERRIDE, table, "this task has none", remedy).of_kind(ConfigErrorKind::UnknownKey)
}

fn not_a_table(key: &str, found: &Value, walked: &[String]) -> ConfigError {
    ConfigError::invalid(
        OVERRIDE,
        dotted(walked, key),
        format!("`{}` is a {} and holds no keys", walked.join("."), found.type_str()),
        "end the key there",
    )
}

fn dotted(walked: &[String], key: &str) -> String {
    walked.iter().map(String::as_str).chain([key]).collect::<Vec<_>>().join(".")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(text: &str) -> Result<Table, ConfigError> {
        let mut table: Table =
            toml::from_str("engine = 'a'\n[sim]\ndt = 1\n[[policy]]\nterm = 'x'\n[[policy]]\nterm = 'y'").unwrap();
        apply(&mut table, text).map(|_| table)
    }

    #[test]
    fn values_are_toml_or_bare_words() {
        assert_eq!(set("sim.dt=0.5").unwrap()["sim"]["dt"].as_float(), Some(0.5));
        assert_eq!(set("engine=b").unwrap()["engine"].as_str(), Some("b"));
        assert_eq!(set("policy.+={ term = \"z\" }").unwrap()["policy"][2]["term"].as_str(), Some("z"));
        assert_eq!(set("policy.y.noise=[1]").unwrap()["policy"][1]["noise"][0].as_integer(), Some(1));
        assert!(set("sim.dt=[1,").is_err());
        assert!(set("sim.dt").is_err());
        assert!(set(".dt=1").is_err());
    }

    #[test]
    fn changes_of_robots_need_no_table_before_them() {
        let table = set("robot_overrides.dog.actuators.legs.stiffness=3").unwrap();
        assert_eq!(table["robot_overrides"]["dog"]["actuators"]["legs"]["stiffness"].as_integer(), Some(3));
        assert!(set("robot_overide.dog.mass=3").is_err());
    }

    #[test]
    fn null_removes() {
        assert!(!set("sim=null").unwrap().contains_key("sim"));
        assert!(set("env_shares=null").is_ok(), "which tasks need not have");
        assert!(set("env_share=null").is_err());
        assert!(set("policy.0=~").unwrap()["policy"].as_array().is_some_and(|a| a.len() == 1));
        assert_eq!(set("simm=~").unwrap_err().remedy, "did you mean `sim`?");
    }

    #[test]
    fn a_failed_override_changes_nothing() {
        let mut table: Table = toml::from_str("[sim]\ndt = 1").unwrap();
        let before = table.clone();
        assert!(apply(&mut table, "smi.dt=2").is_err());
        assert_eq!(table, before);
    }
}
