//! Reads the docstrings of `python/polypod/_core.pyi` for `docstring!`, so that editors and `help`
//! show one text.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::{env, fs};

/// Quotes around a docstring.
const QUOTES: &str = "\"\"\"";
/// Indentation of a class's attributes.
const BODY: usize = 4;
/// The constructor's docstring follows that of its class: Python shows them as one.
const CONSTRUCTOR: &str = ".__init__";

fn main() -> Result<(), Box<dyn Error>> {
    let stub = Path::new(&env::var("CARGO_MANIFEST_DIR")?).join("../../python/polypod/_core.pyi");
    println!("cargo::rerun-if-changed={}", stub.display());
    let out = PathBuf::from(env::var("OUT_DIR")?);
    let text = fs::read_to_string(&stub).map_err(|error| format!("cannot read {}: {error}", stub.display()))?;
    let docstrings = docstrings(&text);
    for (name, text) in &docstrings {
        let of_constructor = docstrings.iter().find(|(other, _)| *other == format!("{name}{CONSTRUCTOR}"));
        let more = of_constructor.map_or_else(String::new, |(_, text)| format!("\n\n{text}"));
        fs::write(out.join(name), format!("{text}{more}"))?;
    }
    Ok(())
}

/// Names, such as `VecSim.step`, and docstrings without their indentation. The module's docstring
/// has the name `_core`.
fn docstrings(stub: &str) -> Vec<(String, String)> {
    let mut found: Vec<(String, String)> = Vec::new();
    let (mut class, mut name) = (String::new(), Some("_core".to_owned()));
    let mut lines = stub.lines();
    while let Some(line) = lines.next() {
        let indent = line.len() - line.trim_start().len();
        let statement = line.trim_start();
        if let Some(rest) = statement.strip_prefix("class ") {
            class = word(rest);
            name = Some(class.clone());
        } else if let Some(rest) = statement.strip_prefix("def ") {
            name = Some(if indent == 0 { word(rest) } else { format!("{class}.{}", word(rest)) });
            if statement.ends_with('(') {
                lines.by_ref().find(|line| line.trim_start().starts_with(')'));
            }
        } else if let Some(rest) = statement.strip_prefix(QUOTES) {
            let mut text = vec![rest.to_owned()];
            while text.last().is_some_and(|line| !line.ends_with(QUOTES)) {
                match lines.next() {
                    Some(line) => text.push(line.get(indent..).unwrap_or_default().to_owned()),
                    None => break,
                }
            }
            let text = text.join("\n").trim_end_matches(QUOTES).trim_end().to_owned();
            if let Some(name) = name.take().filter(|name| !found.iter().any(|(other, _)| other == name)) {
                found.push((name, text));
            }
        } else if indent == BODY && statement.split_once(": ").is_some_and(|(before, _)| before == word(statement)) {
            name = Some(format!("{class}.{}", word(statement)));
        }
    }
    found
}

/// The name at the beginning of a text.
fn word(text: &str) -> String {
    text.chars().take_while(|character| character.is_alphanumeric() || *character == '_').collect()
}
