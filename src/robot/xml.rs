//! XML of strangers: parsed only where that costs no more than its length.

use roxmltree::{Document, ParsingOptions};

/// Attributes of one element. The parser compares each with all before it.
const MAX_ATTRIBUTES: usize = 256;
/// Namespaces that a document declares. The parser copies those in scope for each element that
/// declares one.
const MAX_NAMESPACES: usize = 256;
/// Elements, comments and pieces of text of a document. A node takes about 100 bytes.
const MAX_NODES: u32 = 4 << 20;

/// Place at which a text is no XML that is read, and the reason.
pub(super) struct Fault {
    pub line: usize,
    pub column: usize,
    /// Problem as a clause, without a full stop.
    pub problem: String,
    pub remedy: &'static str,
}

/// Parses a document without a document type definition.
///
/// # Errors
/// The first place where it is not well-formed, or goes beyond what is read.
pub(super) fn parse(text: &str) -> Result<Document<'_>, Fault> {
    check_sizes(text)?;
    let options = ParsingOptions { nodes_limit: MAX_NODES, ..ParsingOptions::default() };
    Document::parse_with_options(text, options).map_err(|error| {
        let at = error.pos();
        Fault {
            line: at.row as usize,
            column: at.col as usize,
            problem: format!("not well-formed XML ({error})"),
            remedy: "correct the XML there",
        }
    })
}

/// Counts attributes and namespaces in one pass, since the parser takes time that grows with their
/// square.
fn check_sizes(text: &str) -> Result<(), Fault> {
    let bytes = text.as_bytes();
    let mut namespaces = 0;
    let mut at = 0;
    while let Some(start) = find(bytes, at, b"<") {
        let closing: &[u8] = match &bytes[start..] {
            [b'<', b'!', b'-', b'-', ..] => b"-->",
            [b'<', b'!', b'[', b'C', b'D', b'A', b'T', b'A', b'[', ..] => b"]]>",
            [b'<', b'?', ..] => b"?>",
            _ => {
                let tag = Tag::read(bytes, start);
                namespaces += tag.namespaces;
                let (count, most, what) = if tag.attributes > MAX_ATTRIBUTES {
                    (tag.attributes, MAX_ATTRIBUTES, "attributes of one element")
                } else {
                    (namespaces, MAX_NAMESPACES, "declared namespaces")
                };
                if count > most {
                    return Err(Fault {
                        line: 1 + bytes[..start].iter().filter(|byte| **byte == b'\n').count(),
                        column: 1 + start - bytes[..start].iter().rposition(|byte| *byte == b'\n').map_or(0, |n| n + 1),
                        problem: format!("{count} {what}, of which {most} are read"),
                        remedy: "remove what is no part of the robot",
                    });
                }
                at = tag.end;
                continue;
            }
        };
        // the parser says what is wrong with one that does not end
        match find(bytes, start, closing) {
            Some(end) => at = end + closing.len(),
            None => break,
        }
    }
    Ok(())
}

/// Place of `wanted` at or after `from`.
fn find(bytes: &[u8], from: usize, wanted: &[u8]) -> Option<usize> {
    bytes.get(from..)?.windows(wanted.len()).position(|window| window == wanted).map(|place| from + place)
}

/// Counts of a tag.
struct Tag {
    attributes: usize,
    namespaces: usize,
    /// Place after its last byte.
    end: usize,
}

impl Tag {
    /// The tag that begins at `start`.
    fn read(bytes: &[u8], start: usize) -> Self {
        let mut tag = Self { attributes: 0, namespaces: 0, end: bytes.len() };
        let mut quote = None;
        let mut word = start + 1;
        for (at, &byte) in bytes.iter().enumerate().skip(start + 1) {
            match (quote, byte) {
                (Some(open), _) if byte == open => {
                    quote = None;
                    word = at + 1;
                }
                (Some(_), _) => {}
                (None, b'"' | b'\'') => quote = Some(byte),
                (None, b'=') => {
                    tag.attributes += 1;
                    tag.namespaces += usize::from(bytes[word..at].starts_with(b"xmlns"));
                }
                (None, b'>') => {
                    tag.end = at + 1;
                    break;
                }
                (None, _) if byte.is_ascii_whitespace() => word = at + 1,
                (None, _) => {}
            }
        }
        tag
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problem(text: &str) -> String {
        parse(text).err().map(|fault| fault.problem).unwrap_or_default()
    }

    #[test]
    fn many_attributes_are_refused_in_one_pass() {
        let attributes = |count: usize| (0..count).map(|i| format!(" a{i}='=>'")).collect::<String>();
        assert_eq!(problem(&format!("<robot{}/>", attributes(MAX_ATTRIBUTES))), "");
        let fault = parse(&format!("<robot>\n  <link{}/></robot>", attributes(300_000))).err().unwrap();
        assert_eq!((fault.line, fault.column), (2, 3));
        assert!(fault.problem.contains("300000 attributes"), "{}", fault.problem);
        // text that only resembles attributes
        assert_eq!(problem(&format!("<r><!-- <a{0}/> --><![CDATA[<a{0}/>]]></r>", attributes(1000))), "");
    }

    #[test]
    fn many_namespaces_are_refused() {
        let nested = |count: usize| {
            let open: String = (0..count).map(|i| format!("<a xmlns:n{i}='u{i}'>")).collect();
            format!("{open}{}", "</a>".repeat(count))
        };
        assert_eq!(problem(&nested(MAX_NAMESPACES)), "");
        assert!(problem(&nested(MAX_NAMESPACES + 1)).contains("declared namespaces"));
    }
}
