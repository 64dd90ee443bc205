//! Parser from TOML tables to typed configs, with helpful errors in place of serde's.

use serde::de::{DeserializeOwned, Deserializer, Error};
use toml::{Table, Value};

use super::error::{ConfigError, ConfigErrorKind};
use super::suggest::{did_you_mean, is_slip};
use crate::bounds::{LARGEST, Shown};

/// The parameters of a term as the type `T` that the term's code reads. `T` should carry
/// `#[serde(deny_unknown_fields)]` and may use the checks of [`values`](super::values). `element`
/// is the dotted key of the term, such as `rewards.trot.gait`; `file` the config's file or name.
///
/// # Errors
/// Unknown or missing keys, values of the wrong type, not finite or of a magnitude that no
/// simulation can use: file, key and remedy are named.
pub fn parse_params<T: DeserializeOwned>(file: &str, element: &str, params: &Table) -> Result<T, ConfigError> {
    let join = |path: &str| match (element, path) {
        (_, "") => element.to_owned(),
        ("", _) => path.to_owned(),
        _ => format!("{element}.{path}"),
    };
    let is_finite = |_: &str, value: &Value| value.as_float().is_none_or(f64::is_finite);
    if let Some((path, _)) = find_number(params, is_finite) {
        return Err(ConfigError::invalid(
            file,
            join(&path),
            "the number is not finite",
            "write a finite number; leave the key out where no limit is meant",
        ));
    }
    let mut track = serde_path_to_error::Track::new();
    // Erased, so that the compiler does not repeat what follows the path for every type of every
    // term.
    let mut erased =
        <dyn erased_serde::Deserializer>::erase(serde_path_to_error::Deserializer::new(params.clone(), &mut track));
    let parsed = erased_serde::deserialize(&mut erased);
    drop(erased);
    let parsed = parsed.map_err(|error| {
        // A path of no segments is shown as a lone dot.
        let path = track.path().to_string();
        let path = if path == "." { "" } else { path.as_str() };
        // the first line is the problem; the others say where, as the path does
        let message = error.to_string();
        let message = message.lines().next().unwrap_or_default();
        let (kind, problem, remedy) = explain(message, find(params, path).as_ref());
        let element = if path.is_empty() && element.is_empty() { "top level".to_owned() } else { join(path) };
        ConfigError::invalid(file, element, problem, remedy).of_kind(kind)
    })?;
    // the bounds of a quantity, which its type knows, come before those of all numbers
    let magnitude =
        |value: &Value| value.as_float().or_else(|| value.as_integer().map(|x| x as f64)).map_or(0.0, f64::abs);
    // seeds are bits
    let is_usable = |key: &str, value: &Value| key == SEED || magnitude(value) <= LARGEST;
    match find_number(params, is_usable) {
        Some((path, value)) => {
            let problem = format!("{} is beyond all that a simulation can use", Shown(magnitude(value)));
            let remedy = format!("write a number from -{LARGEST:e} to {LARGEST:e}");
            Err(ConfigError::invalid(file, join(&path), problem, remedy))
        }
        None => Ok(parsed),
    }
}

/// Keys of a table other than those that its type names (`own`): the parameters of a term. A near
/// miss of an own key is an error here, since it would otherwise pass for a parameter.
pub(super) fn params_beside<'de, D: Deserializer<'de>>(deserializer: D, own: &[&str]) -> Result<Table, D::Error> {
    let params: Table = serde::Deserialize::deserialize(deserializer)?;
    for key in params.keys() {
        if let Some(meant) = own.iter().find(|meant| is_slip(key, meant)) {
            return Err(D::Error::custom(format!("unknown key `{key}`; did you mean `{meant}`?")));
        }
    }
    Ok(params)
}

/// Kind, problem and remedy for serde's `message` about the value `at`.
fn explain(message: &str, at: Option<&Value>) -> (ConfigErrorKind, String, String) {
    use ConfigErrorKind::{InvalidValue, UnknownKey};
    let quoted = || message.split('`').skip(1).step_by(2);
    let subject = quoted().next().unwrap_or_default();
    if message.starts_with("unknown field") {
        let remedy = did_you_mean(subject, quoted().skip(1), "keys");
        return (UnknownKey, format!("unknown key `{subject}`"), remedy);
    }
    if message.starts_with("unknown variant") {
        let remedy = did_you_mean(subject, quoted().skip(1), "values");
        return (InvalidValue, format!("unknown value `{subject}`"), remedy);
    }
    if message.starts_with("missing field") {
        let slip = at.and_then(Value::as_table).and_then(|table| table.keys().find(|key| is_slip(key, subject)));
        return match slip {
            Some(key) => (UnknownKey, format!("unknown key `{key}`"), format!("did you mean `{subject}`?")),
            None => (InvalidValue, format!("key `{subject}` is missing"), format!("add `{subject}`")),
        };
    }
    if let Some((found, expected)) = ["invalid type: ", "invalid value: ", "invalid length "]
        .iter()
        .find_map(|start| message.strip_prefix(start)?.split_once(", expected "))
    {
        let found = if message.starts_with("invalid length") { format!("{found} elements") } else { found.to_owned() };
        let expected = type_in_words(expected);
        return (InvalidValue, format!("found {found} where {expected} is expected"), format!("write {expected}"));
    }
    let (problem, remedy) = message.split_once("; ").unwrap_or((message, "correct the value"));
    let kind = if problem.starts_with("unknown key") { UnknownKey } else { InvalidValue };
    (kind, problem.to_owned(), remedy.to_owned())
}

/// Name of a serde type in the words of TOML.
fn type_in_words(expected: &str) -> &str {
    match expected {
        "f32" | "f64" => "a number",
        "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number of 0 or above",
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
        "a boolean" => "true or false",
        "a sequence" => "an array",
        "a map" => "a table",
        "fewer elements in array" => "a shorter array",
        _ if expected.starts_with("struct ") => "a table",
        _ => expected,
    }
}

/// The value at a path as `serde_path_to_error` writes it: keys after dots, indices in brackets.
fn find(table: &Table, path: &str) -> Option<Value> {
    let mut at = Value::Table(table.clone());
    for segment in segments(path) {
        at = match at {
            Value::Table(mut inner) => inner.remove(segment)?,
            Value::Array(inner) => inner.into_iter().nth(segment.parse().ok()?)?,
            _ => return None,
        };
    }
    Some(at)
}

/// The keys and indices of a dotted path.
pub(super) fn segments(path: &str) -> impl Iterator<Item = &str> {
    path.split(['.', '[', ']']).filter(|segment| !segment.is_empty())
}

/// Key of terrain's seed.
const SEED: &str = "seed";

/// Path and value of the first number in `table` that is not `allowed` under its key.
fn find_number(table: &Table, allowed: impl Fn(&str, &Value) -> bool) -> Option<(String, &Value)> {
    // most numbers of a large config stand in lists, and a path is written only for the number that
    // is found
    enum Place<'a> {
        Key(&'a str),
        Index(usize),
    }
    fn search<'a>(
        key: &'a str,
        value: &'a Value,
        allowed: &impl Fn(&str, &Value) -> bool,
        path: &mut Vec<Place<'a>>,
    ) -> Option<&'a Value> {
        match value {
            Value::Float(_) | Value::Integer(_) => (!allowed(key, value)).then_some(value),
            Value::Array(items) => items.iter().enumerate().find_map(|(index, item)| {
                path.push(Place::Index(index));
                let found = search(key, item, allowed, path);
                if found.is_none() {
                    path.pop();
                }
                found
            }),
            Value::Table(inner) => search_table(inner, allowed, path),
            _ => None,
        }
    }
    fn search_table<'a>(
        table: &'a Table,
        allowed: &impl Fn(&str, &Value) -> bool,
        path: &mut Vec<Place<'a>>,
    ) -> Option<&'a Value> {
        table.iter().find_map(|(key, value)| {
            path.push(Place::Key(key));
            let found = search(key, value, allowed, path);
            if found.is_none() {
                path.pop();
            }
            found
        })
    }
    let mut path = Vec::new();
    let value = search_table(table, &allowed, &mut path)?;
    let mut text = String::new();
    for place in path {
        match place {
            Place::Key(key) if text.is_empty() => text.push_str(key),
            Place::Key(key) => text.extend([".", key]),
            Place::Index(index) => text.push_str(&format!("[{index}]")),
        }
    }
    Some((text, value))
}
