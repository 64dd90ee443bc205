//! Layers: a config file on top of the files that it `extends`.

use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::{Table, Value};

use super::document::Document;
use super::error::{ConfigError, ConfigErrorKind};
use super::overrides;
use super::parse::{parse_params, segments};
use super::scene::embed_meshes;
use super::suggest::did_you_mean;

/// The key that names the config below.
pub(super) const EXTENDS: &str = "extends";

/// Keys that tell one config from another and are therefore never inherited.
pub(super) const IDENTITY: [&str; 3] = ["name", "aliases", "title"];

/// A config's files, the one that extends no other first; empty for a config that was not read from
/// files.
#[derive(Clone, Debug, Default)]
pub(crate) struct Layers(pub(super) Vec<Layer>);

/// One file, parsed, or a few keys on top of it.
#[derive(Clone, Debug)]
pub(super) struct Layer {
    pub document: Document,
    pub table: Table,
}

impl Layers {
    /// All layers in one table, each put on top of those below by [`merge`].
    ///
    /// # Errors
    /// A layer changes an element of an array that is not there; blamed on the layer's file.
    pub(super) fn merged(&self) -> Result<Table, ConfigError> {
        let mut merged = Table::new();
        for layer in &self.0 {
            IDENTITY.iter().for_each(|key| drop(merged.remove(*key)));
            merge(&mut merged, layer.table.clone()).map_err(|error| error.in_file(layer.document.file.clone()))?;
        }
        merged.remove(EXTENDS);
        Ok(merged)
    }

    /// Layers and `overrides` as a checked `T`, and the same as a table with all defaults spelled
    /// out.
    ///
    /// # Errors
    /// Converts to a type; blames an objection of the type, of `validate` or of an override on the
    /// file that caused it.
    pub(super) fn typed<T: DeserializeOwned + Serialize>(
        &self,
        overrides: &[String],
        validate: impl Fn(&T) -> Result<(), ConfigError>,
    ) -> Result<(T, Table), ConfigError> {
        let mut config: T = parse_params("", "", &self.merged()?).map_err(|error| self.locate(error, &[]))?;
        let mut resolved = self.table_of(&config)?;
        let mut overridden = Vec::new();
        for text in overrides {
            overridden.push(overrides::apply(&mut resolved, text)?);
        }
        if !overrides.is_empty() {
            embed_meshes(&mut resolved, Path::new("")).map_err(|error| error.in_file(OVERRIDE))?;
            config = parse_params("", "", &resolved).map_err(|error| self.locate(error, &overridden))?;
            resolved = self.table_of(&config)?;
        }
        validate(&config).map_err(|error| self.locate(error, &overridden))?;
        Ok((config, resolved))
    }

    /// `config` as TOML, with all its defaults.
    fn table_of<T: Serialize>(&self, config: &T) -> Result<Table, ConfigError> {
        Table::try_from(config).map_err(|error| {
            let problem = format!("cannot be written as TOML: {}", error.to_string().trim());
            let error = ConfigError::invalid("", "top level", problem, "correct the value");
            self.locate(error, &[])
        })
    }

    /// The files with what the config takes from each of them, the one that extends no other first.
    /// A layer that the library makes on top of a file is called by both.
    pub(super) fn named(&self) -> Vec<(String, Table)> {
        let mut named: Vec<(String, Table)> = Vec::with_capacity(self.0.len());
        for layer in &self.0 {
            named.iter_mut().for_each(|(_, table)| IDENTITY.iter().for_each(|key| drop(table.remove(*key))));
            let file = layer.document.file.clone();
            let is_made = named.iter().any(|(other, _)| *other == file);
            let name = if is_made { format!("made by the library from {file}") } else { file };
            named.push((name, layer.table.clone()));
        }
        named
    }

    /// The same error, blamed on the override or on the uppermost file that sets its element.
    pub(super) fn locate(&self, error: ConfigError, overridden: &[String]) -> ConfigError {
        if overridden.iter().any(|path| is_within(&error.element, path)) {
            return error.in_file(OVERRIDE);
        }
        let merged = self.merged().unwrap_or_default();
        let depth = |layer: &Layer| known_depth(&layer.table, &merged, &error.element);
        // max_by_key returns the last of equals, which is the uppermost layer.
        let culprit = self.0.iter().max_by_key(|layer| depth(layer));
        match culprit {
            Some(layer) => error.in_file(layer.document.file.clone()),
            None => error,
        }
    }
}

/// Name that stands for the file in errors about overrides.
pub(super) const OVERRIDE: &str = "--set";

/// Puts `above` on top of `below`. Tables are merged. A table in the place of an array changes the
/// elements that it names (see [`element_name`]). Everything else is replaced.
///
/// # Errors
/// A name that no element has.
pub(super) fn merge(below: &mut Table, above: Table) -> Result<(), ConfigError> {
    merge_at(below, above, "")
}

/// Merges tables at `path`.
fn merge_at(below: &mut Table, above: Table, path: &str) -> Result<(), ConfigError> {
    for (key, value) in above {
        let here = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        match (below.get_mut(&key), value) {
            (Some(Value::Table(old)), Value::Table(new)) => merge_at(old, new, &here)?,
            (Some(Value::Array(old)), Value::Table(new)) => {
                for (name, change) in new {
                    let element = format!("{here}.{name}");
                    let Some(index) = element_index(old, &name) else {
                        return Err(unknown_element(old, &element, &name));
                    };
                    match (&mut old[index], change) {
                        (Value::Table(old), Value::Table(new)) => merge_at(old, new, &element)?,
                        (old, new) => *old = new,
                    }
                }
            }
            (_, value) => {
                below.insert(key, value);
            }
        }
    }
    Ok(())
}

/// Name of an element of an array: its `name`, or its `term`.
fn element_name(item: &Value) -> Option<&str> {
    ["name", "term"].iter().find_map(|key| item.get(key)?.as_str())
}

/// The index of an element of an array, by its number or its [`element_name`].
pub(super) fn element_index(items: &[Value], key: &str) -> Option<usize> {
    let index = key.parse().ok().or_else(|| items.iter().position(|item| element_name(item) == Some(key)));
    index.filter(|index| *index < items.len())
}

/// Error about an array that has no such element.
pub(super) fn unknown_element(items: &[Value], element: &str, key: &str) -> ConfigError {
    let known: Vec<String> = items
        .iter()
        .enumerate()
        .map(|(index, item)| element_name(item).map_or_else(|| index.to_string(), str::to_owned))
        .collect();
    let remedy = did_you_mean(key, known.iter().map(String::as_str), "elements");
    ConfigError::invalid("", element, format!("there is no element `{key}`"), remedy)
        .of_kind(ConfigErrorKind::UnknownKey)
}

/// The TOML of `document`.
///
/// # Errors
/// A file that cannot be read; a syntax error, with line and column.
pub(super) fn parse(document: &Document) -> Result<Table, ConfigError> {
    let text = document.text()?;
    text.parse::<Table>().map_err(|error| {
        let start = error.span().map_or(0, |span| span.start);
        let before = text.get(..start).unwrap_or(text);
        let line = before.matches('\n').count() + 1;
        let column = before.rsplit('\n').next().map_or(0, |rest| rest.chars().count()) + 1;
        ConfigError::invalid(
            document.file.clone(),
            format!("line {line}, column {column}"),
            format!("not valid TOML: {}", error.message().trim()),
            "correct the syntax there (https://toml.io)",
        )
        .of_kind(ConfigErrorKind::Syntax)
    })
}

/// The value of a string key at the top of `table`, if it is there.
///
/// # Errors
/// The value is not a string.
pub(super) fn string_key<'a>(document: &Document, table: &'a Table, key: &str) -> Result<Option<&'a str>, ConfigError> {
    match table.get(key) {
        None => Ok(None),
        Some(Value::String(text)) => Ok(Some(text)),
        Some(other) => Err(ConfigError::invalid(
            document.file.clone(),
            key,
            format!("found {} where a string is expected", other.type_str()),
            "write a string in quotes",
        )),
    }
}

/// A string, or the strings of an array, at the top of `table`; none if the key is not there.
///
/// # Errors
/// The value is something else.
pub(super) fn string_list<'a>(document: &Document, table: &'a Table, key: &str) -> Result<Vec<&'a str>, ConfigError> {
    let Some(Value::Array(values)) = table.get(key) else {
        return Ok(string_key(document, table, key)?.into_iter().collect());
    };
    let strings = values.iter().map(|value| {
        value.as_str().ok_or_else(|| {
            let problem = format!("found {} where a string is expected", value.type_str());
            ConfigError::invalid(document.file.clone(), key, problem, "write strings in quotes")
        })
    });
    strings.collect()
}

/// Number of leading segments of `path` that exist in `table`, a layer of `merged`.
fn known_depth(table: &Table, merged: &Table, path: &str) -> usize {
    let (mut at, mut whole): (Option<&Value>, Option<&Value>) = (None, None);
    let mut depth = 0;
    for (i, segment) in segments(path).enumerate() {
        let next = match (at, whole) {
            _ if i == 0 => table.get(segment),
            // an array of elements may be, in a layer, a table of their names
            (Some(Value::Table(inner)), Some(Value::Array(items))) => element_index(items, segment)
                .and_then(|index| inner.get(element_name(&items[index]).unwrap_or(segment))),
            (Some(value), _) => element(value, segment),
            (None, _) => None,
        };
        if next.is_none() {
            break;
        }
        whole = if i == 0 { merged.get(segment) } else { whole.and_then(|value| element(value, segment)) };
        at = next;
        depth += 1;
    }
    depth
}

/// Value under a key of a table or an array.
fn element<'a>(value: &'a Value, key: &str) -> Option<&'a Value> {
    match value {
        Value::Table(inner) => inner.get(key),
        Value::Array(items) => items.get(element_index(items, key)?),
        _ => None,
    }
}

/// Whether one of two paths lies within the other.
fn is_within(element: &str, path: &str) -> bool {
    segments(element).zip(segments(path)).all(|(a, b)| a == b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_merge_and_arrays_are_replaced() {
        let mut below: Table = toml::from_str("a = [1, 2]\n[t]\nx = 1\ny = 2").unwrap();
        merge(&mut below, toml::from_str("a = [3]\n[t]\ny = 3\nz = 4").unwrap()).unwrap();
        let expected: Table = toml::from_str("a = [3]\n[t]\nx = 1\ny = 3\nz = 4").unwrap();
        assert_eq!(below, expected);
    }

    #[test]
    fn a_table_changes_the_elements_that_it_names() {
        let below: Table = toml::from_str("t = [{ name = 'a', x = 1 }, { term = 'b', x = 1, y = 2 }, 3]").unwrap();
        let merged = |above: &str| {
            let mut table = below.clone();
            merge(&mut table, toml::from_str(above).unwrap()).map(|()| table)
        };
        let expected: Table =
            toml::from_str("t = [{ name = 'a', x = 5 }, { term = 'b', x = 1, y = 7, z = 8 }, 4]").unwrap();
        assert_eq!(merged("t = { b = { y = 7, z = 8 }, a = { x = 5 }, 2 = 4 }").unwrap(), expected);
        let error = merged("[t.c]\nx = 1").unwrap_err();
        assert_eq!((error.element.as_str(), error.problem.as_str()), ("t.c", "there is no element `c`"));
        assert!(error.remedy.contains("a, b, 2"), "{}", error.remedy);
    }
}
