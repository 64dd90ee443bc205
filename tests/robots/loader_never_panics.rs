//! Whatever the text, loading gives a model that can be simulated or an error that names the file:
//! no panic, no overflow of the stack, no endless loop. `PROPTEST_CASES` raises the number of
//! cases.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use polypod::dynamics::{MAX_DEPTH, Parameters};
use polypod::robot::{Articulation, Geometry, LoadOptions, Model, RobotError, Site, check, detect, load, load_str};
use proptest::prelude::*;
use proptest::sample::{Index, select};
use proptest::strategy::ValueTree;
use proptest::test_runner::TestRunner;

use crate::common::{fall, size};

/// Values that a number, a name or a type is replaced by.
const VALUES: [&str; 34] = [
    "",
    " ",
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e-308",
    "1e999",
    "0",
    "-0",
    "-1",
    "1",
    "0.5",
    "0 0 0",
    "1 2",
    "0 1 0",
    "1e308 1e308 1e308",
    "1 2 3 4",
    "1e9 0 0",
    "1e-9 1e-9 1e-9",
    "3.2e5 0 0",
    "x",
    "0x1p3",
    "١",
    "日本",
    "base",
    "fixed",
    "revolute",
    "continuous",
    "prismatic",
    "floating",
    "package://a/b.stl",
    "&lt;&amp;",
];
/// Elements that are put in anywhere.
const ELEMENTS: [&str; 8] = [
    "<origin xyz='1e308 0 0' rpy='1 1e300 1'/>",
    "<mimic joint='elbow'/>",
    "<collision><geometry><mesh filename='nowhere.stl' scale='1 1 -1'/></geometry></collision>",
    "<collision><origin xyz='1e300 0 0'/><geometry><capsule radius='1e-300' length='1e300'/></geometry></collision>",
    "<inertial><mass value='1e-300'/><inertia ixx='1e-300' ixy='0' ixz='0' iyy='1e-300' iyz='0' izz='1e-300'/></inertial>",
    "<dynamics damping='1e300' friction='1e300'/>",
    "<limit lower='1e300' upper='1e301' effort='0' velocity='0'/>",
    "<link name='base'/>",
];

fn config(cases: u32) -> ProptestConfig {
    let asked = std::env::var("PROPTEST_CASES").ok().and_then(|text| text.parse().ok());
    ProptestConfig { cases: asked.unwrap_or(cases), failure_persistence: None, ..ProptestConfig::default() }
}

/// The robots that ship with polypod, and those of the tests.
fn urdfs() -> &'static [(PathBuf, String)] {
    static FILES: OnceLock<Vec<(PathBuf, String)>> = OnceLock::new();
    FILES.get_or_init(|| {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let robots =
            std::fs::read_dir(root.join("assets/robots")).unwrap().map(|e| e.unwrap().path().join("robot.urdf"));
        let own = std::fs::read_dir(root.join("tests/data/urdf")).unwrap().map(|e| e.unwrap().path());
        let mut paths: Vec<_> = robots.chain(own).filter(|path| path.extension() == Some("urdf".as_ref())).collect();
        paths.sort();
        assert!(paths.len() >= 10, "{paths:?}");
        paths.into_iter().map(|path| (path.clone(), std::fs::read_to_string(path).unwrap())).collect()
    })
}

/// Loads `text`; what comes out must be a sound model, or an error that says where and what to do.
fn exercise(text: &str, source: &Path) -> Result<(), TestCaseError> {
    match load_str(text, source, &LoadOptions::default()) {
        Ok(model) => sound(&model),
        Err(error) => {
            prop_assert!(!matches!(error, RobotError::Parser(_)), "{error}");
            prop_assert!(error.to_string().starts_with(&source.display().to_string()), "{error}");
            prop_assert!(!error.diagnosis().remedy.is_empty(), "{error}");
            Ok(())
        }
    }
}

/// Warnings of what became of meshes. Points that may be millimetres draw another one.
fn said_of_the_mesh(model: &Model) -> usize {
    let said = model.warnings.iter().map(ToString::to_string);
    said.filter(|text| text.contains("is taken as") || text.contains("left out")).count()
}

/// SharedArray are finite, also to the engine; parents come first; the articulation can be built
/// and stepped.
fn sound(model: &Model) -> Result<(), TestCaseError> {
    prop_assert_eq!(model.links.len(), model.joints.len() + 1);
    let finite = |numbers: &[f64]| numbers.iter().all(|number| (*number as f32).is_finite());
    for link in &model.links {
        prop_assert!(link.mass > 0.0 && finite(&[link.mass]), "{link:?}");
        prop_assert!(finite(&link.com.to_array()) && finite(&link.inertia.to_cols_array()), "{link:?}");
    }
    for (j, joint) in model.joints.iter().enumerate() {
        prop_assert!(joint.parent <= j, "{joint:?}");
        prop_assert!(finite(&joint.origin.translation.to_array()), "{joint:?}");
        prop_assert!(finite(&joint.origin.rotation.to_cols_array()), "{joint:?}");
        prop_assert!((joint.axis.length() - 1.0).abs() < 1e-9, "{joint:?}");
        prop_assert!(joint.lower <= joint.upper && joint.effort >= 0.0 && joint.velocity >= 0.0, "{joint:?}");
        prop_assert!(joint.damping >= 0.0 && joint.friction >= 0.0, "{joint:?}");
    }
    for body in &model.bodies {
        prop_assert!(body.link < model.links.len() && !body.shapes.is_empty(), "{body:?}");
        for shape in &body.shapes {
            prop_assert!(finite(&shape.origin.translation.to_array()), "{shape:?}");
            let sizes = match &shape.geometry {
                Geometry::Sphere { radius } => vec![*radius],
                Geometry::Box { size } => size.to_array().into(),
                Geometry::Cylinder { radius, length } | Geometry::Capsule { radius, length } => vec![*radius, *length],
                Geometry::Hull { points } => points.iter().flat_map(|point| point.to_array()).collect(),
            };
            prop_assert!(!sizes.is_empty() && finite(&sizes), "{shape:?}");
        }
    }
    let _ = detect(model, &Default::default(), &Default::default());
    for floating in [true, false] {
        let sites = [Site { link: model.links.len() - 1, position: glam::DVec3::Z }];
        // the search for pairs that can meet takes its time: small models only
        let still = vec![0.0; model.joints.len()];
        let self_collision = (floating && model.joints.len() <= 2).then_some(&still[..]);
        step(&Articulation::new(model, floating, &sites, self_collision))?;
    }
    Ok(())
}

fn step(articulation: &Articulation) -> Result<(), TestCaseError> {
    let topology = &articulation.topology;
    prop_assert!(topology.max_depth() <= MAX_DEPTH);
    let parameters = Parameters::<f32>::from_scalars(topology, &articulation.parameters);
    let mut probe = parameters.clone();
    // a limit that is absent is infinite, and nothing else is
    for limits in [
        &mut probe.lower,
        &mut probe.upper,
        &mut probe.effort_limit,
        &mut probe.saturation_effort,
        &mut probe.motor_velocity_limit,
    ] {
        prop_assert!(limits.iter().all(|limit| !limit.is_nan()), "{parameters:?}");
        limits.fill(0.0);
    }
    let present = probe.clone();
    let mut all_finite = true;
    probe.zip_with(&present, |_, number| all_finite &= number.is_finite());
    prop_assert!(all_finite, "{parameters:?}");
    fall(topology, &parameters, 1.0, 1);
    Ok(())
}

/// An XML element, to be changed.
#[derive(Clone, Debug)]
struct Element {
    tag: String,
    attributes: Vec<(String, String)>,
    children: Vec<Element>,
}

impl Element {
    fn read(node: roxmltree::Node<'_, '_>) -> Self {
        Self {
            tag: node.tag_name().name().to_string(),
            attributes: node.attributes().map(|a| (a.name().to_string(), escape(a.value()))).collect(),
            children: node.children().filter(roxmltree::Node::is_element).map(Self::read).collect(),
        }
    }

    fn write(&self, out: &mut String) {
        let _ = write!(out, "<{}", self.tag);
        for (name, value) in &self.attributes {
            let _ = write!(out, " {name}=\"{value}\"");
        }
        out.push('>');
        self.children.iter().for_each(|child| child.write(out));
        let _ = write!(out, "</{}>", self.tag);
    }

    fn count(&self) -> usize {
        1 + self.children.iter().map(Self::count).sum::<usize>()
    }

    /// Calls `f` on the `n`th element, parents before children.
    fn visit(&mut self, n: &mut usize, f: &mut dyn FnMut(&mut Element)) {
        if *n == 0 {
            f(self);
        }
        *n = n.wrapping_sub(1);
        self.children.iter_mut().for_each(|child| child.visit(n, f));
    }
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

#[derive(Clone, Debug)]
enum Edit {
    /// Removes a child, repeats it, moves it, or lets children change places.
    Remove(Index, Index),
    Repeat(Index, Index),
    Swap(Index, Index, Index),
    /// Puts a child elsewhere in the document.
    Graft(Index, Index, Index),
    Insert(Index, &'static str),
    /// Gives an attribute another value: a nasty one, a number, or one from elsewhere in the
    /// document.
    Set(Index, Index, &'static str),
    SetNumber(Index, Index, f64),
    Copy(Index, Index, Index, Index),
    RemoveAttribute(Index, Index),
    Rename(Index, &'static str),
}

fn edits() -> impl Strategy<Value = Vec<Edit>> {
    let i = any::<Index>;
    let tags = vec!["link", "joint", "inertial", "collision", "origin", "limit", "axis", "mesh", "sphere", "x"];
    let edit = prop_oneof![
        2 => (i(), i()).prop_map(|(a, b)| Edit::Remove(a, b)),
        1 => (i(), i()).prop_map(|(a, b)| Edit::Repeat(a, b)),
        2 => (i(), i(), i()).prop_map(|(a, b, c)| Edit::Swap(a, b, c)),
        1 => (i(), i(), i()).prop_map(|(a, b, c)| Edit::Graft(a, b, c)),
        1 => (i(), select(&ELEMENTS[..])).prop_map(|(a, b)| Edit::Insert(a, b)),
        4 => (i(), i(), select(&VALUES[..])).prop_map(|(a, b, c)| Edit::Set(a, b, c)),
        3 => (i(), i(), any::<f64>()).prop_map(|(a, b, c)| Edit::SetNumber(a, b, c)),
        3 => (i(), i(), i(), i()).prop_map(|(a, b, c, d)| Edit::Copy(a, b, c, d)),
        1 => (i(), i()).prop_map(|(a, b)| Edit::RemoveAttribute(a, b)),
        1 => (i(), select(tags)).prop_map(|(a, b)| Edit::Rename(a, b)),
    ];
    prop::collection::vec(edit, 1..6)
}

/// `at`, of as many things as there are.
fn pick<T>(at: Index, things: &[T]) -> Option<usize> {
    (!things.is_empty()).then(|| at.index(things.len()))
}

fn apply(root: &mut Element, edit: Edit) {
    let count = root.count();
    let mut at = |index: Index, f: &mut dyn FnMut(&mut Element)| root.visit(&mut index.index(count), f);
    match edit {
        Edit::Remove(e, c) => at(e, &mut |e| {
            pick(c, &e.children).map(|c| e.children.remove(c));
        }),
        Edit::Repeat(e, c) => at(e, &mut |e| {
            if let Some(c) = pick(c, &e.children) {
                e.children.insert(c, e.children[c].clone());
            }
        }),
        Edit::Swap(e, a, b) => at(e, &mut |e| {
            if let (Some(a), Some(b)) = (pick(a, &e.children), pick(b, &e.children)) {
                e.children.swap(a, b);
            }
        }),
        Edit::Graft(from, c, to) => {
            let mut moved = None;
            at(from, &mut |e| moved = pick(c, &e.children).map(|c| e.children[c].clone()));
            at(to, &mut |e| e.children.extend(moved.clone()));
        }
        Edit::Insert(e, text) => {
            let element = Element::read(roxmltree::Document::parse(text).unwrap().root_element());
            at(e, &mut |e| e.children.push(element.clone()));
        }
        Edit::Set(e, a, value) => at(e, &mut |e| {
            if let Some(a) = pick(a, &e.attributes) {
                e.attributes[a].1 = value.to_string();
            }
        }),
        Edit::SetNumber(e, a, value) => at(e, &mut |e| {
            if let Some(a) = pick(a, &e.attributes) {
                // one number of the attribute's
                let mut parts: Vec<String> = e.attributes[a].1.split_whitespace().map(String::from).collect();
                if let Some(last) = parts.last_mut() {
                    *last = format!("{value:?}");
                }
                e.attributes[a].1 = parts.join(" ");
            }
        }),
        Edit::Copy(from, b, to, a) => {
            let mut value = None;
            at(from, &mut |e| value = pick(b, &e.attributes).map(|b| e.attributes[b].1.clone()));
            at(to, &mut |e| {
                if let (Some(a), Some(value)) = (pick(a, &e.attributes), &value) {
                    e.attributes[a].1.clone_from(value);
                }
            });
        }
        Edit::RemoveAttribute(e, a) => at(e, &mut |e| {
            pick(a, &e.attributes).map(|a| e.attributes.remove(a));
        }),
        Edit::Rename(e, tag) => at(e, &mut |e| e.tag = tag.to_string()),
    }
}

/// One of the robots, changed.
fn changed(which: Index, edits: Vec<Edit>) -> (PathBuf, String) {
    let (path, text) = which.get(urdfs());
    let mut root = Element::read(roxmltree::Document::parse(text).unwrap().root_element());
    edits.into_iter().for_each(|edit| apply(&mut root, edit));
    let mut text = String::new();
    root.write(&mut text);
    (path.clone(), text)
}

/// A value for any attribute; mostly a plain number.
fn value() -> impl Strategy<Value = String> {
    prop_oneof![
        4 => (-2.0..2.0f64).prop_map(|x| x.to_string()),
        2 => prop::array::uniform3(-1.0..1.0f64).prop_map(|[x, y, z]| format!("{x} {y} {z}")),
        1 => any::<f64>().prop_map(|x| format!("{x:?}")),
        2 => select(&VALUES[..]).prop_map(String::from),
        3 => (0..6u32).prop_map(|i| format!("n{i}")),
    ]
}

/// Elements of a URDF's names, anywhere in each other.
fn document() -> impl Strategy<Value = Element> {
    let tag = select(vec![
        "link",
        "joint",
        "inertial",
        "mass",
        "inertia",
        "origin",
        "collision",
        "geometry",
        "sphere",
        "box",
        "cylinder",
        "capsule",
        "mesh",
        "parent",
        "child",
        "axis",
        "limit",
        "dynamics",
        "mimic",
        "gazebo",
        "xacro:macro",
        "日本",
    ]);
    let name = select(vec![
        "name", "type", "link", "joint", "value", "xyz", "rpy", "ixx", "ixy", "ixz", "iyy", "iyz", "izz", "radius",
        "length", "size", "filename", "scale", "lower", "upper", "effort", "velocity", "damping", "friction", "xmlns",
    ]);
    let attributes = prop::collection::btree_map(name, value(), 0..5)
        .prop_map(|map| map.into_iter().map(|(name, value)| (name.to_string(), value)).collect::<Vec<_>>());
    let element = |children: Vec<Element>| {
        move |(tag, attributes): (&str, Vec<(String, String)>)| Element {
            tag: tag.to_string(),
            attributes,
            children: children.clone(),
        }
    };
    let leaf = (tag, attributes).boxed();
    let tree = leaf.clone().prop_map(element(Vec::new())).prop_recursive(4, 40, 6, move |inner| {
        (prop::collection::vec(inner, 0..6), leaf.clone()).prop_map(move |(children, head)| element(children)(head))
    });
    prop::collection::vec(tree, 0..8).prop_map(|children| Element {
        tag: "robot".to_string(),
        attributes: Vec::new(),
        children,
    })
}

/// A robot whose links and joints form a tree, or nearly, with any numbers.
fn robot() -> impl Strategy<Value = String> {
    // a few of a robot's many numbers are odd at most, or none would load
    let number = || {
        prop_oneof![
            2000 => -2.0..2.0f64,
            6 => (-12.0..8.0f64).prop_map(|exponent| 10f64.powf(exponent)),
            1 => any::<f64>(),
        ]
    };
    let kind = select(vec!["fixed", "revolute", "continuous", "prismatic", "revolute", "revolute"]);
    let shape = prop_oneof![
        Just(String::new()),
        number().prop_map(|r| format!("<sphere radius='{:?}'/>", r.abs())),
        [number(), number(), number()].prop_map(|s| format!(
            "<box size='{:?} {:?} {:?}'/>",
            s[0].abs(),
            s[1].abs(),
            s[2].abs()
        )),
        [number(), number()].prop_map(|s| format!("<cylinder radius='{:?}' length='{:?}'/>", s[0].abs(), s[1].abs())),
        [number(), number()].prop_map(|s| format!("<capsule radius='{:?}' length='{:?}'/>", s[0].abs(), s[1].abs())),
    ];
    let part = (kind, any::<Index>(), prop::collection::vec(number(), 20), shape, any::<bool>());
    prop::collection::vec(part, 1..90).prop_map(|parts| {
        let mut text = String::from("<robot name='r'>");
        let chain = parts[0].4;
        for (i, (kind, parent, n, shape, massive)) in parts.iter().enumerate() {
            let _ = write!(text, "<link name='l{i}'>");
            if *massive || *kind != "fixed" || i == 0 {
                let _ = write!(
                    text,
                    "<inertial><origin xyz='{:?} {:?} {:?}' rpy='{:?} 0 0'/><mass value='{:?}'/>\
                     <inertia ixx='{:?}' ixy='0' ixz='0' iyy='{:?}' iyz='{:?}' izz='{:?}'/></inertial>",
                    n[0], n[1], n[2], n[3], n[4].abs(), n[5].abs() + 1e-3, n[6].abs() + 1e-3, n[7] * 1e-4, n[8].abs() + 1e-3
                );
            }
            if !shape.is_empty() {
                let _ = write!(text, "<collision><origin xyz='0 {:?} 0'/><geometry>{shape}</geometry></collision>", n[9]);
            }
            text.push_str("</link>");
            if i > 0 {
                let parent = if chain { i - 1 } else { parent.index(i) };
                let _ = write!(
                    text,
                    "<joint name='j{i}' type='{kind}'><parent link='l{parent}'/><child link='l{i}'/>\
                     <origin xyz='{:?} {:?} {:?}' rpy='0 {:?} {:?}'/><axis xyz='{:?} {:?} {:?}'/>\
                     <limit lower='{:?}' upper='{:?}' effort='{:?}' velocity='{:?}'/><dynamics damping='{:?}' friction='{:?}'/></joint>",
                    n[10], n[11], n[12], n[13], n[14], n[15], n[16], n[17],
                    -n[18].abs(), n[19].abs(), n[0].abs(), n[1].abs(), n[2].abs(), n[3].abs()
                );
            }
        }
        text + "</robot>"
    })
}

/// A separate folder for one test, removed at its end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("polypod-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

proptest! {
    #![proptest_config(config(size(192, 1920)))]

    #[test]
    fn changed_robots(which in any::<Index>(), edits in edits(), end in prop::option::weighted(0.1, any::<Index>())) {
        let (path, mut text) = changed(which, edits);
        if let Some(end) = end {
            let end = (0..=end.index(text.len())).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0);
            text.truncate(end);
        }
        exercise(&text, &path)?;
    }

    #[test]
    fn documents_of_any_elements(document in document()) {
        let mut text = String::new();
        document.write(&mut text);
        exercise(&text, Path::new("any.urdf"))?;
    }

    #[test]
    fn trees_of_any_numbers(text in robot()) {
        exercise(&text, Path::new("tree.urdf"))?;
    }

    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..400), text in ".{0,80}") {
        let folder = Folder::new("bytes");
        let path = folder.0.join("robot.urdf");
        std::fs::write(&path, &bytes).unwrap();
        prop_assert!(load(&path, &LoadOptions::default()).is_err());
        prop_assert!(check(&path, &LoadOptions::default()).is_err());
        exercise(&String::from_utf8_lossy(&bytes), Path::new("bytes.urdf"))?;
        exercise(&text, Path::new("text.urdf"))?;
    }

    #[test]
    fn changed_meshes(
        which in any::<Index>(),
        bytes in prop::collection::vec((any::<Index>(), any::<u8>()), 0..12),
        numbers in prop::collection::vec((any::<Index>(), select(&VALUES[..])), 0..4),
        end in prop::option::weighted(0.2, any::<Index>()),
    ) {
        let meshes = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/urdf/meshes");
        let name = which.get(&["cube.stl", "cube_ascii.stl", "cube.obj", "cube.dae"]);
        let mut mesh = std::fs::read(meshes.join(name)).unwrap();
        for (at, value) in numbers {
            // instead of one word
            let start = at.index(mesh.len());
            let length = mesh[start..].iter().position(u8::is_ascii_whitespace).unwrap_or(0);
            mesh.splice(start..start + length, value.bytes());
        }
        for (at, byte) in bytes {
            let at = at.index(mesh.len());
            mesh[at] = byte;
        }
        if let Some(end) = end {
            mesh.truncate(end.index(mesh.len()));
        }
        let folder = Folder::new("mesh");
        std::fs::write(folder.0.join(name), mesh).unwrap();
        let text = format!(
            "<robot name='r'><link name='l'><inertial><mass value='1'/>\
             <inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/></inertial>\
             <collision><geometry><mesh filename='{name}'/></geometry></collision></link></robot>"
        );
        let source = folder.0.join("robot.urdf");
        let model = load_str(&text, &source, &LoadOptions::default()).unwrap();
        prop_assert_eq!(said_of_the_mesh(&model), 1, "{:?}", model.warnings);
        sound(&model)?;
    }

    #[test]
    fn meshes_of_any_points(
        points in prop::collection::vec(
            [0, 1, 2].map(|_| prop_oneof![4 => -1.0..1.0f32, 2 => select(vec![0.0f32, 1.0, -1.0, 1e-7]), 1 => any::<f32>()]),
            3..120,
        ),
        flat in prop::option::of(0..3usize),
    ) {
        let mut text = String::new();
        for mut point in points.clone() {
            if let Some(axis) = flat {
                point[axis] = 0.5;
            }
            let _ = writeln!(text, "v {} {} {}", point[0], point[1], point[2]);
        }
        (2..points.len()).for_each(|i| { let _ = writeln!(text, "f {} {} {}", i - 1, i, i + 1); });
        let folder = Folder::new("points");
        std::fs::write(folder.0.join("m.obj"), text).unwrap();
        let urdf = "<robot name='r'><link name='l'><inertial><mass value='1'/>\
             <inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/></inertial>\
             <collision><geometry><mesh filename='m.obj'/></geometry></collision></link></robot>";
        let model = load_str(urdf, &folder.0.join("robot.urdf"), &LoadOptions::default()).unwrap();
        prop_assert_eq!(said_of_the_mesh(&model), 1, "{:?}", model.warnings);
        sound(&model)?;
        let inside = |axis: usize| points.iter().all(|p| p[axis].abs() <= 1e3);
        if (0..3).all(|axis| flat == Some(axis) || inside(axis)) {
            let Geometry::Hull { points } = &model.bodies[0].shapes[0].geometry else { panic!("{:?}", model.bodies) };
            prop_assert!(points.len() <= 32);
        }
    }
}

#[test]
fn unchanged_robots_are_sound() {
    for (path, text) in urdfs() {
        let model = load_str(text, path, &LoadOptions::default()).unwrap_or_else(|error| panic!("{error}"));
        sound(&model).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    }
}

/// Robots that never load, or always do, would test nothing.
#[test]
fn both_outcomes_are_reached() {
    let mut runner = TestRunner::deterministic();
    let mut loaded = [0; 2];
    for _ in 0..200 {
        let text = robot().new_tree(&mut runner).unwrap().current();
        let (path, other) =
            (any::<Index>(), edits()).prop_map(|(i, e)| changed(i, e)).new_tree(&mut runner).unwrap().current();
        let loads = |text: &str, path: &Path| load_str(text, path, &LoadOptions::default()).is_ok();
        loaded[0] += usize::from(loads(&text, Path::new("tree.urdf")));
        loaded[1] += usize::from(loads(&other, &path));
    }
    assert!(loaded.iter().all(|n| (20..180).contains(n)), "{loaded:?} of 200 load");
}

/// A hundred thousand elements in each other overflow the stack of whoever recurses.
#[test]
fn deep_nesting() {
    let deep = |tag: &str| format!("<{tag}>").repeat(100_000) + &format!("</{tag}>").repeat(100_000);
    for text in [
        deep("robot"),
        deep("robot").replacen("<robot>", "<robot name='r'><link name='l'>", 1),
        format!("<robot name='r'>{}</robot>", deep("link")),
        format!("<robot name='r'>{}</robot>", deep("gazebo")),
        format!(
            "<robot name='r'><link name='l'><collision><geometry>{}</geometry></collision></link></robot>",
            deep("box")
        ),
        "<robot>".repeat(100_000),
    ] {
        assert!(load_str(&text, Path::new("deep.urdf"), &LoadOptions::default()).is_err());
    }
    let entities: String = (1..40).map(|i| format!("<!ENTITY e{i} '&e{};&e{};'>", i - 1, i - 1)).collect();
    let text = format!("<!DOCTYPE robot [<!ENTITY e0 'x'>{entities}]><robot name='&e39;'/>");
    assert!(load_str(&text, Path::new("entities.urdf"), &LoadOptions::default()).is_err());
}

#[test]
fn deep_meshes() {
    let folder = Folder::new("deep");
    let nodes = "<node>".repeat(100_000) + &"</node>".repeat(100_000);
    let itself = "<node id='n'><instance_node url='#n'/></node>";
    for inside in [nodes.as_str(), itself] {
        let scene = format!("<visual_scene id='s'>{inside}</visual_scene>");
        std::fs::write(folder.0.join("m.dae"), format!("<COLLADA>{scene}</COLLADA>")).unwrap();
        let urdf = "<robot name='r'><link name='l'><inertial><mass value='1'/>\
             <inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/></inertial>\
             <collision><geometry><mesh filename='m.dae'/></geometry></collision></link></robot>";
        let model = load_str(urdf, &folder.0.join("robot.urdf"), &LoadOptions::default()).unwrap();
        assert!(model.bodies.is_empty());
        assert!(model.warnings[0].to_string().contains("left out"), "{}", model.warnings[0]);
    }
}
