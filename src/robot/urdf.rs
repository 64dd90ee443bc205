//! Reads a file into a [`Model`]: the passes in their order, and the guard around the parser.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use super::canonical::{Canonical, canonical};
use super::error::{Diagnosis, RobotError};
use super::formats::recognised;
use super::merge::merge;
use super::model::Model;
use super::tree::Tree;
use crate::files;

/// Options that the URDF itself cannot hold.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LoadOptions {
    /// Directory of each package in `package://<package>/...` mesh names.
    pub package_dirs: BTreeMap<String, PathBuf>,
    /// Joints to hold at a position (rad or m): they become part of their parent link.
    pub locked_joints: BTreeMap<String, f64>,
    /// Treatment of joints that mimic others.
    pub coupled: Coupled,
    /// Keeps the root of the file as the base, also where it is an empty link: for a base that is
    /// fixed to the world, whose root says where it stands.
    pub keeps_root: bool,
}

/// Treatment of joints that mimic others, since coupled joints are not modelled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Coupled {
    /// Joints that mimic others are refused unless they are locked.
    #[default]
    Refused,
    /// Joints that mimic others are held where they are while the others are at rest, with a
    /// warning each.
    Held,
}

/// Reads the URDF file at `path`.
///
/// # Errors
/// A [`RobotError`] that names file, element and remedy; see the module documentation.
pub fn load(path: &Path, options: &LoadOptions) -> Result<Model, RobotError> {
    Ok(load_holding(path, options)?.0)
}

/// Loads like [`load`] and returns the positions of the joints that are held because they mimic
/// others ([`Coupled::Held`]), rad or m.
pub(crate) fn load_holding(path: &Path, options: &LoadOptions) -> Result<(Model, BTreeMap<String, f64>), RobotError> {
    let read_error = |problem: String, remedy: &str| RobotError::Read(Diagnosis::new(path, "file", problem, remedy));
    let bytes = files::read(path).map_err(|error| {
        let remedy = match error.kind() {
            std::io::ErrorKind::NotFound => "check the path",
            std::io::ErrorKind::FileTooLarge => "name a URDF file",
            _ => "make it a readable URDF file",
        };
        read_error(error.to_string(), remedy)
    })?;
    if let Some((format, remedy)) = recognised(&bytes) {
        return Err(read_error(format!("this is {format}, not a URDF"), remedy));
    }
    let text = String::from_utf8(bytes).map_err(|_| read_error("it is not UTF-8".to_string(), "save it as UTF-8"))?;
    read_text(&text, path, options)
}

/// Reads a URDF from `text`; `source` names it in errors and is where meshes are looked up.
///
/// # Errors
/// A [`RobotError`] that names file, element and remedy; see the module documentation.
pub fn load_str(text: &str, source: &Path, options: &LoadOptions) -> Result<Model, RobotError> {
    Ok(read_text(text, source, options)?.0)
}

fn read_text(text: &str, source: &Path, options: &LoadOptions) -> Result<(Model, BTreeMap<String, f64>), RobotError> {
    let mut canonical = canonical(text, source)?;
    let robot = parse(&canonical, source)?;
    let tree = Tree::build(&robot, source, &mut canonical.warnings)?;
    merge(&robot, &tree, source, options, canonical.warnings)
}

/// Runs the parser so that it can neither panic nor lose a link or joint unnoticed.
fn parse(canonical: &Canonical, file: &Path) -> Result<urdf_rs::Robot, RobotError> {
    let failure = |problem: String| {
        RobotError::Parser(Diagnosis::new(
            file,
            "<robot>",
            problem,
            "compare the file with the URDF specification, or reduce it to find the element",
        ))
    };
    let robot = catch_unwind(AssertUnwindSafe(|| urdf_rs::read_from_string(&canonical.text)))
        .map_err(|_| failure("the URDF parser panicked".to_string()))?
        .map_err(|error| failure(format!("the URDF parser refused it ({error})")))?;
    let links = robot.links.iter().map(|link| &link.name);
    let joints = robot.joints.iter().map(|joint| &joint.name);
    if !links.eq(&canonical.links) || !joints.eq(&canonical.joints) {
        return Err(failure(format!(
            "the URDF parser read {} links and {} joints of {} and {}, or renamed some",
            robot.links.len(),
            robot.joints.len(),
            canonical.links.len(),
            canonical.joints.len()
        )));
    }
    Ok(robot)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const ROBOT: &str = r#"<?xml version="1.0"?>
<robot name="two" xmlns:xacro="http://www.ros.org/wiki/xacro" version="1.1">
  <link name="base"><inertial><origin xyz="0 0  0.1" rpy="0.1 0 0"/><mass value="2"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
    <collision><geometry><box size="1 0.5 0.2"/></geometry></collision></link>
  <joint name="hip" type="revolute"><origin xyz="0.3 0 0" quat_xyzw="0 0 0 1"/><parent link="base"/>
    <child link="leg"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="10" velocity="5"/>
    <dynamics damping="0.1" friction="0.2"/></joint>
  <link name="leg"><inertial><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <joint name="sole" type="fixed"><parent link="leg"/><child link="foot"/></joint>
  <link name="foot"><collision><geometry><mesh filename="package://p/foot.stl"/></geometry></collision></link>
</robot>"#;

    fn load_text(text: &str) -> Result<Model, RobotError> {
        load_str(text, Path::new("two.urdf"), &LoadOptions::default())
    }

    #[test]
    fn the_unmangled_robot_loads() {
        let model = load_text(ROBOT).unwrap();
        assert_eq!((model.links.len(), model.joints.len()), (2, 1));
        assert_eq!(model.warnings.len(), 1, "{:?}", model.warnings);
    }

    /// Positions are taken modulo the text, and snapped to a character.
    fn splice(text: &mut String, from: usize, length: usize, insert: &str) {
        let mut start = from % (text.len() + 1);
        while !text.is_char_boundary(start) {
            start -= 1;
        }
        let mut end = (start + length).min(text.len());
        while !text.is_char_boundary(end) {
            end += 1;
        }
        text.replace_range(start..end, insert);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(512))]

        #[test]
        fn mangled_text_never_panics(
            edits in prop::collection::vec(
                (
                    any::<usize>(),
                    0_usize..40,
                    prop::sample::select(vec![
                        "", " ", "\"", "<", ">", "/>", "&", "&#0;", "-", "1e999", "nan", "e308", "0", "é",
                        "<link name=\"leg\"/>", "<!--", "-->", "base", "leg", "xmlns=\"u\" ", "type=\"floating\"",
                        "<mimic joint=\"hip\"/>", "${x}", "$(arg x)", "]]>", "\u{0}", "<?pi?>", "xacro:", "capsule",
                    ]),
                ),
                1..6,
            ),
        ) {
            let mut text = ROBOT.to_string();
            for (from, length, insert) in edits {
                splice(&mut text, from, length, insert);
            }
            if let Err(error) = load_text(&text) {
                prop_assert!(!matches!(error, RobotError::Parser(_)), "{error}");
                prop_assert!(error.to_string().starts_with("two.urdf: "));
            }
        }

        #[test]
        fn arbitrary_numbers_never_panic(number in any::<f64>(), which in 0_usize..40) {
            // replaces one of the quoted numbers of the file
            let places: Vec<_> = ROBOT.match_indices("=\"").map(|(at, _)| at + 2).collect();
            let start = places[which % places.len()];
            let end = start + ROBOT[start..].find('"').unwrap();
            let mut text = ROBOT.to_string();
            text.replace_range(start..end, &format!("{number:?}"));
            let _ = load_text(&text);
        }
    }
}
