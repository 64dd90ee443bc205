//! Writes the layout of tables and columns, as `device/tables.h` states it, as constants of Rust,
//! and the text of the device without comments, which is what the wheel ships.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;
use std::{env, fs};

/// Value of an enumerator's expression: a sum of numbers and earlier names.
fn value(expression: &str, known: &BTreeMap<String, i64>) -> Option<i64> {
    expression.split('+').map(str::trim).map(|term| term.parse().ok().or_else(|| known.get(term).copied())).sum()
}

/// C without its comments and indentation.
fn without_comments(text: &str) -> String {
    let mut text = text.to_owned();
    while let Some((before, (_, after))) = text.split_once("/*").and_then(|(b, rest)| Some((b, rest.split_once("*/")?)))
    {
        text = format!("{before}{after}");
    }
    text.lines().map(str::trim).filter(|line| !line.is_empty()).flat_map(|line| [line, "\n"]).collect()
}

/// Constants of all enumerators of a C header that has no other braces than those of enums.
fn constants(header: &str) -> Option<String> {
    let text = without_comments(header);
    let mut known = BTreeMap::new();
    let mut out = String::new();
    for part in text.split("enum ").skip(1) {
        let (name, body) = part.split_once('{')?;
        let (body, _) = body.split_once('}')?;
        let mut next = 0;
        let mut all = String::new();
        for enumerator in body.split(',').map(str::trim).filter(|text| !text.is_empty()) {
            let (name, number) = match enumerator.split_once('=') {
                Some((name, expression)) => (name.trim(), value(expression, &known)?),
                None => (enumerator, next),
            };
            writeln!(out, "pub const {name}: usize = {number};").ok()?;
            write!(all, "(\"{name}\", {number}), ").ok()?;
            known.insert(name.to_owned(), number);
            next = number + 1;
        }
        writeln!(out, "pub const {}_PLACES: &[(&str, usize)] = &[{all}];", name.trim().to_uppercase()).ok()?;
    }
    Some(out)
}

/// FNV-1a hash of all texts and their names, as `tools/ptx.py` computes it: kernels that a package
/// ships are taken where they were made of the same text.
fn hash(texts: &BTreeMap<String, Vec<u8>>) -> u64 {
    let bytes = texts.iter().flat_map(|(name, text)| name.bytes().chain(text.iter().copied()));
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=device");
    let header = fs::read_to_string("device/tables.h").unwrap_or_default();
    let out = env::var("OUT_DIR").unwrap_or_default();
    let written = constants(&header).map(|text| fs::write(Path::new(&out).join("layout.rs"), text));
    let files = fs::read_dir("device").into_iter().flatten().flatten();
    let read = files.map(|file| {
        let text = fs::read_to_string(file.path())?;
        fs::write(Path::new(&out).join(file.file_name()), without_comments(&text))?;
        Ok((file.file_name().to_string_lossy().into_owned(), text.into_bytes()))
    });
    match read.collect::<std::io::Result<BTreeMap<_, _>>>() {
        Ok(texts) => println!("cargo::rustc-env=POLYPOD_DEVICE_TEXT={:016x}", hash(&texts)),
        Err(error) => println!("cargo::error=device: {error}"),
    }
    if !matches!(written, Some(Ok(()))) {
        println!("cargo::error=device/tables.h: an enumerator is no sum of numbers and earlier names");
    }
}
