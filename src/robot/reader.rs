//! Checked access to the elements and attributes of a URDF document.

use std::collections::BTreeSet;
use std::path::Path;

use roxmltree::Node;

use super::error::{Diagnosis, RobotError};
use super::merge::MAX_EXTENT;
use crate::bounds::Shown;

/// Longest name, bytes.
const MAX_NAME: usize = 256;

/// Reads from one document; `owner` in its methods is the element that errors name.
#[derive(Clone, Copy)]
pub(super) struct Reader<'a> {
    pub file: &'a Path,
    /// Namespace of the root; elements of other namespaces are not URDF.
    pub namespace: Option<&'a str>,
}

impl Reader<'_> {
    pub fn name<'n>(&self, node: Node<'n, '_>) -> Result<&'n str, RobotError> {
        let name = node.attribute("name").unwrap_or_default();
        if name.trim().is_empty() {
            return Err(self.value_error(
                format!("<{}> on line {}", node.tag_name().name(), line(node)),
                "has no name",
                "give it a name of its own",
            ));
        }
        if name.len() > MAX_NAME {
            return Err(self.value_error(
                format!("<{}> on line {}", node.tag_name().name(), line(node)),
                format!("its name has {} bytes, of which {MAX_NAME} are read", name.len()),
                "give it a shorter name",
            ));
        }
        Ok(name)
    }

    pub fn children<'n, 'd>(&self, node: Node<'n, 'd>, tag: &'static str) -> Vec<Node<'n, 'd>> {
        let namespace = self.namespace;
        let wanted =
            |n: &Node<'_, '_>| n.is_element() && n.tag_name().name() == tag && n.tag_name().namespace() == namespace;
        node.children().filter(wanted).collect()
    }

    pub fn only_child<'n, 'd>(
        &self,
        node: Node<'n, 'd>,
        tag: &'static str,
        owner: &str,
    ) -> Result<Option<Node<'n, 'd>>, RobotError> {
        match self.children(node, tag)[..] {
            [] => Ok(None),
            [child] => Ok(Some(child)),
            [first, ref others @ ..] if others.iter().all(|other| says_the_same(first, *other)) => Ok(Some(first)),
            _ => Err(self.value_error(format!("{owner}, <{tag}>"), "is there more than once", "keep one")),
        }
    }

    pub fn required_child<'n, 'd>(
        &self,
        node: Node<'n, 'd>,
        tag: &'static str,
        owner: &str,
    ) -> Result<Node<'n, 'd>, RobotError> {
        self.only_child(node, tag, owner)?.ok_or_else(|| {
            let inside = node.tag_name().name();
            self.value_error(owner, format!("<{inside}> lacks <{tag}>"), "add it")
        })
    }

    pub fn required_text<'n>(&self, node: Node<'n, '_>, attribute: &str, owner: &str) -> Result<&'n str, RobotError> {
        node.attribute(attribute)
            .filter(|text| !text.trim().is_empty())
            .ok_or_else(|| self.missing(node, attribute, owner))
    }

    pub fn required_numbers<const N: usize>(
        &self,
        node: Node<'_, '_>,
        attribute: &str,
        owner: &str,
    ) -> Result<[f64; N], RobotError> {
        self.optional_numbers(node, attribute, owner)?.ok_or_else(|| self.missing(node, attribute, owner))
    }

    pub fn lengths<const N: usize>(
        &self,
        node: Node<'_, '_>,
        attribute: &str,
        owner: &str,
    ) -> Result<[f64; N], RobotError> {
        let lengths = self.required_numbers(node, attribute, owner)?;
        match lengths.iter().find(|length| **length <= 0.0 || **length > MAX_EXTENT) {
            None => Ok(lengths),
            Some(length) => Err(self.value_error(
                format!("{owner}, <{} {attribute}>", node.tag_name().name()),
                format!("{} is no length of a robot", Shown(*length)),
                format!("write positive lengths in metres, of at most {MAX_EXTENT}"),
            )),
        }
    }

    /// The attribute of a sphere, box, cylinder or capsule that makes it flat: a length of 0.
    pub fn zero_length(&self, shape: Node<'_, '_>, owner: &str) -> Result<Option<&'static str>, RobotError> {
        let attributes: &[&'static str] = match shape.tag_name().name() {
            "sphere" | "capsule" => &["radius"],
            "cylinder" => &["radius", "length"],
            "box" if self.optional_numbers::<3>(shape, "size", owner)?.is_some_and(|size| size.contains(&0.0)) => {
                return Ok(Some("size"));
            }
            _ => &[],
        };
        for attribute in attributes {
            if self.optional_numbers(shape, attribute, owner)? == Some([0.0]) {
                return Ok(Some(attribute));
            }
        }
        Ok(None)
    }

    pub fn optional_numbers<const N: usize>(
        &self,
        node: Node<'_, '_>,
        attribute: &str,
        owner: &str,
    ) -> Result<Option<[f64; N]>, RobotError> {
        self.parse_numbers(node, attribute, owner, false)
    }

    pub fn parse_numbers<const N: usize>(
        &self,
        node: Node<'_, '_>,
        attribute: &str,
        owner: &str,
        infinite: bool,
    ) -> Result<Option<[f64; N]>, RobotError> {
        let Some(text) = node.attribute(attribute) else {
            return Ok(None);
        };
        let values: Option<Vec<f64>> = text.split_whitespace().map(|t| t.parse().ok()).collect();
        let fits = |v: &f64| v.is_finite() || (infinite && v.is_infinite());
        match values.and_then(|values| <[f64; N]>::try_from(values).ok()) {
            Some(values) if values.iter().all(fits) => Ok(Some(values)),
            _ => Err(self.value_error(
                format!("{owner}, <{} {attribute}>", node.tag_name().name()),
                format!("\"{text}\" is not {N} finite number(s)"),
                "write plain decimal numbers, separated by spaces",
            )),
        }
    }

    pub fn missing(&self, node: Node<'_, '_>, attribute: &str, owner: &str) -> RobotError {
        let tag = node.tag_name().name();
        self.value_error(owner, format!("<{tag}> lacks \"{attribute}\""), "add it")
    }

    pub fn value_error(
        &self,
        element: impl Into<String>,
        problem: impl Into<String>,
        remedy: impl Into<String>,
    ) -> RobotError {
        RobotError::Value(Diagnosis::new(self.file, element, problem, remedy))
    }
}

/// The line `node` starts on.
pub(super) fn line(node: Node<'_, '_>) -> u32 {
    node.document().text_pos_at(node.range().start).row
}

/// Whether two elements have the same attributes and neither holds another element.
fn says_the_same(one: Node<'_, '_>, other: Node<'_, '_>) -> bool {
    let holds_none = |node: Node<'_, '_>| !node.children().any(|child| child.is_element());
    let attributes = |node: &Node<'_, '_>| {
        node.attributes().map(|own| (own.name().to_owned(), own.value().to_owned())).collect::<BTreeSet<_>>()
    };
    holds_none(one) && holds_none(other) && attributes(&one) == attributes(&other)
}
