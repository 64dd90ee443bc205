//! First pass over the text: every element and number that matters is checked by hand, and a
//! canonical URDF of just these is written for the parser.
//!
//! The parser that follows fills gaps with zeros, skips tokens that are no numbers, forgets
//! elements it does not know and fails at ones that it need not read (materials, namespaces). On
//! the canonical text it can do none of this.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use roxmltree::{Document, Node};

use super::error::{Diagnosis, RobotError, Warning, nearest_name};
use super::formats;
use super::merge::MAX_EXTENT;
use super::reader::{Reader, line};
use super::shapes::LEFT_OUT;
use super::xml;
use crate::bounds::Shown;

/// Children of `<robot>` that say nothing about the body and are skipped silently.
const OTHER_ROOT_TAGS: [&str; 6] = ["material", "gazebo", "transmission", "ros2_control", "sensor", "mujoco"];
const LINK_TAGS: [&str; 3] = ["inertial", "visual", "collision"];
const JOINT_TAGS: [&str; 9] =
    ["origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "calibration", "safety_controller"];
const JOINT_TYPES: [&str; 7] = ["revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical"];
const SHAPES: [&str; 5] = ["sphere", "box", "cylinder", "capsule", "mesh"];

/// Largest number of links in a file. Searches in a robot's tree take time that grows with their
/// square.
const MAX_LINKS: usize = 4096;
/// Largest number of collision shapes in a file.
const MAX_SHAPES: usize = 4096;
/// Beginnings of unexpanded xacro, in any attribute.
const MACROS: [&str; 3] = ["${", "$(", "xacro:"];
const EXPAND: &str = "expand xacro first: `xacro robot.urdf.xacro > robot.urdf`";
/// Number of characters of an attribute that an error shows.
const SHOWN: usize = 80;

/// Result of the first pass.
pub(super) struct Canonical {
    /// URDF text holding only checked elements, with all defaults written out.
    pub text: String,
    /// Link names in the file's order.
    pub links: Vec<String>,
    /// Joint names in the file's order.
    pub joints: Vec<String>,
    pub warnings: Vec<Warning>,
}

/// Checks `text` and writes its canonical form.
///
/// # Errors
/// [`RobotError::Syntax`] when it is not XML, not a URDF or still xacro; [`RobotError::Value`] for
/// missing, repeated or meaningless elements and numbers.
pub(super) fn canonical(text: &str, file: &Path) -> Result<Canonical, RobotError> {
    let document = xml::parse(text).map_err(|fault| {
        let element = format!("line {}, column {}", fault.line, fault.column);
        // a prefix that is not declared
        let remedy = if text.contains("<xacro:") { EXPAND } else { fault.remedy };
        RobotError::Syntax(Diagnosis::new(file, element, fault.problem, remedy))
    })?;
    let root = document.root_element();
    let mut writer = Writer {
        read: Reader { file, namespace: root.tag_name().namespace() },
        quaternions: false,
        out: String::with_capacity(text.len() / 2),
        shapes: 0,
        unread: BTreeMap::new(),
        warnings: Vec::new(),
    };
    writer.robot(&document)
}

struct Writer<'a> {
    read: Reader<'a>,
    /// Whether `quat_xyzw` has a meaning (URDF 1.1 and later).
    quaternions: bool,
    out: String,
    /// Collision shapes so far.
    shapes: usize,
    /// Elements not read, by parent tag and tag: place of the first, and count.
    unread: BTreeMap<(&'static str, String), (String, usize)>,
    warnings: Vec<Warning>,
}

impl Writer<'_> {
    fn robot(&mut self, document: &Document<'_>) -> Result<Canonical, RobotError> {
        let root = document.root_element();
        self.refuse_foreign_documents(document)?;
        self.quaternions = self.version(root) >= (1, 1);
        // The parser gets 1.1 at most: additions of 1.2 are checked here, for every version.
        let version = if self.quaternions { "1.1" } else { "1.0" };
        let name = root.attribute("name").unwrap_or_default();
        self.open("robot", &[("name", name), ("version", version)], false);
        let (mut links, mut joints) = (Vec::new(), Vec::new());
        for node in root.children().filter(Node::is_element) {
            let tag = node.tag_name().name();
            if node.tag_name().namespace() != self.read.namespace {
                continue;
            }
            match tag {
                "link" if links.len() == MAX_LINKS => {
                    return Err(self.read.value_error(
                        "<robot>",
                        format!("it has more than {MAX_LINKS} links"),
                        "join links that do not move against each other",
                    ));
                }
                "link" => links.push(self.link(node)?),
                "joint" => joints.push(self.joint(node)?),
                _ if OTHER_ROOT_TAGS.contains(&tag) => {}
                _ => self.note_unread("robot", tag, "<robot>"),
            }
        }
        self.close("robot");
        for ((parent, tag), (first, count)) in std::mem::take(&mut self.unread) {
            self.warnings.push(Warning::new(
                self.read.file,
                first,
                format!("<{tag}> inside <{parent}> is not read ({count} in the file)"),
                "remove it if the simulation does not need it",
            ));
        }
        Ok(Canonical {
            text: std::mem::take(&mut self.out),
            links,
            joints,
            warnings: std::mem::take(&mut self.warnings),
        })
    }

    fn refuse_foreign_documents(&self, document: &Document<'_>) -> Result<(), RobotError> {
        let root = document.root_element();
        let tag = root.tag_name().name();
        if tag != "robot" {
            return Err(RobotError::Syntax(Diagnosis::new(
                self.read.file,
                format!("<{tag}>"),
                "the root element of a URDF is <robot>",
                formats::of_root(tag),
            )));
        }
        let refused = |element: String, problem: String| {
            Err(RobotError::Syntax(Diagnosis::new(self.read.file, element, problem, EXPAND)))
        };
        for node in root.descendants().filter(Node::is_element) {
            let element = || format!("<{}> on line {}", node.tag_name().name(), line(node));
            if node.tag_name().namespace().is_some_and(is_xacro) {
                return refused(element(), "the file holds xacro macros".to_string());
            }
            for attribute in node.attributes() {
                let (name, value) = (attribute.name(), attribute.value());
                let is_xacros = attribute.namespace().is_some_and(is_xacro);
                if is_xacros || MACROS.iter().any(|begin| value.contains(begin)) {
                    let shown: String = value.chars().take(SHOWN).collect();
                    return refused(element(), format!("{name}=\"{shown}\" is xacro that is not expanded"));
                }
            }
        }
        Ok(())
    }

    /// Major and minor of `<robot version>`; 1.0 when there is none.
    fn version(&mut self, root: Node<'_, '_>) -> (u32, u32) {
        let Some(text) = root.attribute("version") else {
            return (1, 0);
        };
        let version =
            text.trim().split_once('.').and_then(|(major, minor)| Some((major.parse().ok()?, minor.parse().ok()?)));
        if !matches!(version, Some((1, 0..=2))) {
            self.warnings.push(Warning::new(
                self.read.file,
                "<robot version>",
                format!("unknown URDF version \"{text}\""),
                "write 1.0, 1.1 or 1.2; it is read as the nearest of these",
            ));
        }
        version.unwrap_or((1, 0))
    }

    fn link(&mut self, node: Node<'_, '_>) -> Result<String, RobotError> {
        let name = self.read.name(node)?;
        let owner = format!("link \"{name}\"");
        self.note_unknown_children(node, "link", &LINK_TAGS, &owner);
        self.open("link", &[("name", name)], false);
        if let Some(inertial) = self.read.only_child(node, "inertial", &owner)? {
            self.inertial(inertial, &owner)?;
        }
        for collision in self.read.children(node, "collision") {
            self.collision(collision, &owner)?;
        }
        self.close("link");
        Ok(name.to_string())
    }

    fn inertial(&mut self, node: Node<'_, '_>, owner: &str) -> Result<(), RobotError> {
        self.open("inertial", &[], false);
        self.origin(node, &format!("{owner}, <inertial>"))?;
        let mass = self.read.required_child(node, "mass", owner)?;
        let [value] = self.read.required_numbers(mass, "value", owner)?;
        if value < 0.0 {
            return Err(self.read.value_error(
                format!("{owner}, <mass value>"),
                format!("negative mass {value}"),
                "write the mass in kg",
            ));
        }
        self.open("mass", &[("value", &number(value))], true);
        let inertia = self.read.required_child(node, "inertia", owner)?;
        let mut entries = Vec::with_capacity(6);
        for name in ["ixx", "ixy", "ixz", "iyy", "iyz", "izz"] {
            let [value] = self.read.required_numbers(inertia, name, owner)?;
            entries.push((name, number(value)));
        }
        let attributes: Vec<(&str, &str)> = entries.iter().map(|(n, v)| (*n, v.as_str())).collect();
        self.open("inertia", &attributes, true);
        self.close("inertial");
        Ok(())
    }

    fn collision(&mut self, node: Node<'_, '_>, owner: &str) -> Result<(), RobotError> {
        let owner = &format!("{owner}, <collision>");
        self.shapes += 1;
        if self.shapes > MAX_SHAPES {
            return Err(self.read.value_error(
                owner,
                format!("the file has more than {MAX_SHAPES} collision shapes"),
                "replace small shapes by a few that hold them",
            ));
        }
        let geometry = self.read.required_child(node, "geometry", owner)?;
        let mut shapes = geometry.children().filter(Node::is_element);
        let (shape, more) = (shapes.next(), shapes.next());
        let Some(shape) = shape.filter(|_| more.is_none()) else {
            return Err(self.read.value_error(
                format!("{owner}, <geometry>"),
                "holds no shape, or several",
                format!("give it one of <{}>", SHAPES.join(">, <")),
            ));
        };
        let tag = shape.tag_name().name();
        if let Some(attribute) = self.read.zero_length(shape, owner)? {
            self.warnings.push(Warning::new(
                self.read.file,
                format!("{owner}, <{tag} {attribute}>"),
                format!("a shape of length 0 touches nothing{LEFT_OUT}"),
                "remove it, or write positive lengths in metres",
            ));
            return Ok(());
        }
        self.open("collision", &[], false);
        self.origin(node, owner)?;
        self.open("geometry", &[], false);
        match tag {
            "sphere" => {
                let [radius] = self.read.lengths(shape, "radius", owner)?;
                self.open(tag, &[("radius", &number(radius))], true);
            }
            "box" => {
                let size: [f64; 3] = self.read.lengths(shape, "size", owner)?;
                self.open(tag, &[("size", &numbers(&size))], true);
            }
            "cylinder" | "capsule" => {
                let [radius] = self.read.lengths(shape, "radius", owner)?;
                let [length] = self.read.lengths(shape, "length", owner)?;
                let attributes = [("radius", &*number(radius)), ("length", &*number(length))];
                self.open(tag, &attributes, true);
            }
            "mesh" => self.mesh(shape, owner)?,
            _ => {
                return Err(self.read.value_error(
                    format!("{owner}, <geometry>"),
                    format!("unknown shape <{tag}>"),
                    nearest_name(tag, SHAPES),
                ));
            }
        }
        self.close("geometry");
        self.close("collision");
        Ok(())
    }

    fn mesh(&mut self, node: Node<'_, '_>, owner: &str) -> Result<(), RobotError> {
        let filename = self.read.required_text(node, "filename", owner)?;
        let scale = self.read.optional_numbers(node, "scale", owner)?.unwrap_or([1.0; 3]);
        if scale.contains(&0.0) {
            return Err(self.read.value_error(
                format!("{owner}, <mesh scale>"),
                "a factor of 0 flattens the mesh",
                "write three factors that are not 0",
            ));
        }
        let attributes = [("filename", filename), ("scale", &numbers(&scale))];
        self.open("mesh", &attributes, true);
        Ok(())
    }

    fn joint(&mut self, node: Node<'_, '_>) -> Result<String, RobotError> {
        let name = self.read.name(node)?;
        let owner = &format!("joint \"{name}\"");
        let kind = self.read.required_text(node, "type", owner)?;
        if !JOINT_TYPES.contains(&kind) {
            return Err(self.read.value_error(
                format!("{owner}, type"),
                format!("unknown joint type \"{kind}\""),
                nearest_name(kind, JOINT_TYPES),
            ));
        }
        self.note_unknown_children(node, "joint", &JOINT_TAGS, owner);
        self.open("joint", &[("name", name), ("type", kind)], false);
        self.origin(node, owner)?;
        for tag in ["parent", "child"] {
            let end = self.read.required_child(node, tag, owner)?;
            let link = self.read.required_text(end, "link", owner)?;
            self.open(tag, &[("link", link)], true);
        }
        if matches!(kind, "revolute" | "continuous" | "prismatic") {
            self.motion(node, owner)?;
        }
        self.close("joint");
        Ok(name.to_string())
    }

    /// The elements that only mean something on a joint that moves.
    fn motion(&mut self, node: Node<'_, '_>, owner: &str) -> Result<(), RobotError> {
        let axis = match self.read.only_child(node, "axis", owner)? {
            Some(axis) => self.read.required_numbers(axis, "xyz", owner)?,
            None => [1.0, 0.0, 0.0],
        };
        self.open("axis", &[("xyz", &numbers(&axis))], true);

        // A limit that is left out is no limit, as in URDF 1.2; merging warns about it.
        let mut limits = [
            ("lower", f64::NEG_INFINITY),
            ("upper", f64::INFINITY),
            ("effort", f64::INFINITY),
            ("velocity", f64::INFINITY),
        ];
        if let Some(limit) = self.read.only_child(node, "limit", owner)? {
            for (name, value) in &mut limits {
                if let Some([given]) = self.read.parse_numbers(limit, name, owner, true)? {
                    *value = given;
                }
            }
        }
        let limits = limits.map(|(name, value)| (name, number(value)));
        let attributes = limits.each_ref().map(|(name, value)| (*name, value.as_str()));
        self.open("limit", &attributes, true);

        if let Some(dynamics) = self.read.only_child(node, "dynamics", owner)? {
            let [damping] = self.read.optional_numbers(dynamics, "damping", owner)?.unwrap_or([0.0]);
            let [friction] = self.read.optional_numbers(dynamics, "friction", owner)?.unwrap_or([0.0]);
            let attributes = [("damping", &*number(damping)), ("friction", &*number(friction))];
            self.open("dynamics", &attributes, true);
        }
        if let Some(mimic) = self.read.only_child(node, "mimic", owner)? {
            let joint = self.read.required_text(mimic, "joint", owner)?;
            let [multiplier] = self.read.optional_numbers(mimic, "multiplier", owner)?.unwrap_or([1.0]);
            let [offset] = self.read.optional_numbers(mimic, "offset", owner)?.unwrap_or([0.0]);
            let attributes = [("joint", joint), ("multiplier", &number(multiplier)), ("offset", &number(offset))];
            self.open("mimic", &attributes, true);
        }
        Ok(())
    }

    /// The `<origin>` of `node`; the identity is written where there is none.
    fn origin(&mut self, node: Node<'_, '_>, owner: &str) -> Result<(), RobotError> {
        let Some(origin) = self.read.only_child(node, "origin", owner)? else {
            self.open("origin", &[("xyz", "0 0 0"), ("rpy", "0 0 0")], true);
            return Ok(());
        };
        let xyz: [f64; 3] = self.read.optional_numbers(origin, "xyz", owner)?.unwrap_or_default();
        if let Some(far) = xyz.iter().find(|x| x.abs() > MAX_EXTENT) {
            return Err(self.read.value_error(
                format!("{owner}, <origin xyz>"),
                format!("{} m is no length of a robot, which measures up to {MAX_EXTENT} m", Shown(*far)),
                "write metres",
            ));
        }
        let rpy: Option<[f64; 3]> = self.read.optional_numbers(origin, "rpy", owner)?;
        let quaternion: Option<[f64; 4]> = self.read.optional_numbers(origin, "quat_xyzw", owner)?;
        let rotation = match (rpy, quaternion) {
            (rpy, None) => ("rpy", numbers(&rpy.unwrap_or_default())),
            (None, Some(q)) if self.quaternions && q.iter().any(|v| *v != 0.0) => ("quat_xyzw", numbers(&q)),
            _ => {
                return Err(self.read.value_error(
                    format!("{owner}, <origin quat_xyzw>"),
                    "a quaternion needs URDF 1.1, must not be 0 and excludes rpy",
                    "write the rotation as rpy, or version=\"1.1\" on <robot>",
                ));
            }
        };
        self.open("origin", &[("xyz", &numbers(&xyz)), (rotation.0, &rotation.1)], true);
        Ok(())
    }

    fn note_unknown_children(&mut self, node: Node<'_, '_>, parent: &'static str, known: &[&str], owner: &str) {
        for child in node.children().filter(Node::is_element) {
            let tag = child.tag_name();
            if tag.namespace() == self.read.namespace && !known.contains(&tag.name()) {
                self.note_unread(parent, tag.name(), owner);
            }
        }
    }

    fn note_unread(&mut self, parent: &'static str, tag: &str, owner: &str) {
        self.unread.entry((parent, tag.to_string())).or_insert_with(|| (owner.to_string(), 0)).1 += 1;
    }

    fn open(&mut self, tag: &str, attributes: &[(&str, &str)], empty: bool) {
        let _ = write!(self.out, "<{tag}");
        for (name, value) in attributes {
            let _ = write!(self.out, " {name}=\"{}\"", escape(value));
        }
        self.out.push_str(if empty { "/>" } else { ">" });
    }

    fn close(&mut self, tag: &str) {
        let _ = write!(self.out, "</{tag}>");
    }
}

fn is_xacro(namespace: &str) -> bool {
    namespace.ends_with("/xacro") || namespace.contains("/xacro#")
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;").replace('\'', "&apos;")
}

/// Shortest text that reads back as the same number.
fn number(value: f64) -> String {
    format!("{value:?}")
}

fn numbers(values: &[f64]) -> String {
    values.iter().map(|value| number(*value)).collect::<Vec<_>>().join(" ")
}
