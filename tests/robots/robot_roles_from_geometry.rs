//! Legs, joint roles and feet are found from geometry alone: no name and no joint frame matters.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use polypod::robot::{
    BodyGroup, CANONICAL_JOINT_NAMES, LEGS, LoadOptions, Model, ROLES, RobotError, Roles, body_groups, detect, load_str,
};

/// Corner of each of the generated robot's legs, in its file's order: x and y sign.
const CORNERS: [(f64, f64); 4] = [(1.0, -1.0), (1.0, 1.0), (-1.0, -1.0), (-1.0, 1.0)];

const FOOT: &str = "<collision><origin xyz='0 0 -0.3'/><geometry><sphere radius='0.02'/></geometry></collision>";

/// How a generated quadruped differs from the plain one.
struct Quadruped {
    /// Roll of the hip joints' frames, and yaw of the thigh joints' ones, undone in their axes.
    twisted: bool,
    /// Collision shapes on the foot link below each knee.
    foot: &'static str,
    legs: usize,
    /// Appended to the URDF.
    extra: &'static str,
}

impl Default for Quadruped {
    fn default() -> Self {
        Self { twisted: false, foot: FOOT, legs: 4, extra: "" }
    }
}

impl Quadruped {
    fn urdf(&self) -> String {
        let mut text = format!(
            "<robot name='q'>{}",
            link("trunk", "<collision><geometry><box size='0.6 0.2 0.1'/></geometry></collision>")
        );
        for (leg, (x, y)) in CORNERS.iter().take(self.legs).enumerate() {
            let (roll, yaw, flexion) =
                if self.twisted { (2.6 * y, std::f64::consts::FRAC_PI_2, "-1 0 0") } else { (0.0, 0.0, "0 1 0") };
            // undo the roll, then yaw, so that the leg hangs straight down all the same
            let hip = format!("<origin xyz='{} {} 0' rpy='{roll} 0 0'/><axis xyz='1 0 0'/>", 0.3 * x, 0.1 * y);
            let unroll = format!("u{leg}");
            let _ = write!(
                text,
                "{}{}{}{}{}{}{}{}{}{}",
                link(&format!("a{leg}"), ""),
                link(&unroll, ""),
                link(&format!("b{leg}"), ""),
                link(&format!("c{leg}"), "<collision><geometry><box size='0.02 0.02 0.3'/></geometry></collision>"),
                link(&format!("d{leg}"), self.foot),
                joint(&format!("w{leg}"), "revolute", "trunk", &format!("a{leg}"), &hip),
                joint(
                    &format!("v{leg}"),
                    "fixed",
                    &format!("a{leg}"),
                    &unroll,
                    &format!("<origin rpy='{} 0 0'/>", -roll)
                ),
                joint(
                    &format!("y{leg}"),
                    "revolute",
                    &unroll,
                    &format!("b{leg}"),
                    &format!("<origin xyz='0 {} 0' rpy='0 0 {yaw}'/><axis xyz='{flexion}'/>", 0.05 * y),
                ),
                joint(
                    &format!("z{leg}"),
                    "continuous",
                    &format!("b{leg}"),
                    &format!("c{leg}"),
                    &format!("<origin xyz='0 0 -0.3'/><axis xyz='{flexion}'/>"),
                ),
                joint(&format!("f{leg}"), "fixed", &format!("c{leg}"), &format!("d{leg}"), ""),
            );
        }
        text + self.extra + "</robot>"
    }

    fn model(&self) -> Model {
        load_str(&self.urdf(), Path::new("q.urdf"), &LoadOptions::default()).unwrap()
    }
}

fn link(name: &str, inside: &str) -> String {
    format!(
        "<link name='{name}'><inertial><mass value='1'/><inertia ixx='0.01' ixy='0' ixz='0' iyy='0.01' \
         iyz='0' izz='0.01'/></inertial>{inside}</link>"
    )
}

fn joint(name: &str, kind: &str, parent: &str, child: &str, inside: &str) -> String {
    format!(
        "<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>{inside}\
         <limit lower='-1' upper='1' effort='9' velocity='9'/></joint>"
    )
}

fn found(model: &Model) -> Result<Roles, RobotError> {
    detect(model, &BTreeMap::new(), &BTreeMap::new())
}

fn overrides(pairs: &[(&str, &str)]) -> BTreeMap<String, String> {
    pairs.iter().map(|(key, value)| (key.to_string(), value.to_string())).collect()
}

fn joint_names<'a>(model: &'a Model, roles: &Roles) -> Vec<&'a str> {
    roles.joint_of_slot.iter().map(|joint| model.joints[*joint].name.as_str()).collect()
}

#[test]
fn canonical_names_are_role_major() {
    let names: Vec<String> =
        ROLES.iter().flat_map(|role| LEGS.iter().map(move |leg| format!("{leg}_{role}"))).collect();
    assert_eq!(names, CANONICAL_JOINT_NAMES);
}

#[test]
fn corners_and_axes_give_the_roles() {
    for twisted in [false, true] {
        let model = Quadruped { twisted, ..Quadruped::default() }.model();
        let roles = found(&model).unwrap();
        assert_eq!(
            joint_names(&model, &roles),
            ["w1", "w3", "w0", "w2", "y1", "y3", "y0", "y2", "z1", "z3", "z0", "z2"]
        );
        let feet: Vec<&str> = roles.foot_body.iter().map(|body| model.bodies[*body].name.as_str()).collect();
        assert_eq!(feet, ["d1", "d3", "d0", "d2"]);
        assert_eq!(roles.foot_radius, [0.02; 4]);
        assert_eq!(roles.foot_point[0].to_array(), [0.0, 0.0, -0.3]);
        let groups = body_groups(&model, &roles);
        assert_eq!(groups[..3], [BodyGroup::Base, BodyGroup::Shank, BodyGroup::Foot]);
    }
}

#[test]
fn arms_and_wheels_are_no_knees() {
    let extra = [
        link("arm", "<collision><geometry><sphere radius='0.1'/></geometry></collision>"),
        link("elbow", ""),
        link("wrist", ""),
        link("wheel", ""),
        joint("turn", "revolute", "trunk", "arm", "<origin xyz='0.2 0 0.1'/><axis xyz='0 0 1'/>"),
        joint("bend", "revolute", "arm", "elbow", "<origin xyz='0.2 0 0.3'/><axis xyz='0 1 0'/>"),
        joint("twist", "revolute", "elbow", "wrist", "<origin xyz='0.2 0 0'/><axis xyz='1 0 0'/>"),
        joint("roll", "continuous", "c0", "wheel", "<origin xyz='0 0 -0.3'/><axis xyz='0 1 0'/>"),
    ]
    .concat();
    let model = Quadruped { extra: extra.leak(), ..Quadruped::default() }.model();
    let roles = found(&model).unwrap();
    assert_eq!(joint_names(&model, &roles)[8..12], ["z1", "z3", "z0", "z2"]);
    let arm = model.bodies.iter().position(|body| body.name == "arm").unwrap();
    assert_eq!(body_groups(&model, &roles)[arm], BodyGroup::Arm);
    let slots: Vec<String> = roles.slots[12..].iter().map(ToString::to_string).collect();
    assert_eq!(slots, ["RF_WHEEL", "ARM_YAW", "ARM_ROLL", "ARM_PITCH"]);
}

#[test]
fn a_capsule_touches_with_its_end_and_a_box_with_its_lowest_face() {
    let foot =
        "<collision><origin xyz='0 0 -0.2'/><geometry><capsule radius='0.01' length='0.2'/></geometry></collision>";
    let capsule = found(&Quadruped { foot, ..Quadruped::default() }.model()).unwrap();
    assert!((capsule.foot_point[0].z + 0.3).abs() < 1e-15);
    assert_eq!(capsule.foot_radius[0], 0.01);
    let foot = "<collision><origin xyz='0 0 -0.2'/><geometry><box size='0.1 0.1 0.3'/></geometry></collision>";
    let block = found(&Quadruped { foot, ..Quadruped::default() }.model()).unwrap();
    assert!((block.foot_point[0] - glam::DVec3::new(0.0, 0.0, -0.35)).length() < 1e-12);
    assert_eq!(block.foot_radius[0], 0.0);
}

#[test]
fn a_sphere_at_the_knee_is_no_foot() {
    let foot = "<collision><geometry><sphere radius='0.05'/></geometry></collision>\
        <collision><origin xyz='0 0 -0.2'/><geometry><cylinder radius='0.01' length='0.2'/></geometry></collision>";
    let roles = found(&Quadruped { foot, ..Quadruped::default() }.model()).unwrap();
    assert!((roles.foot_point[0].z + 0.3).abs() < 1e-12);
}

#[test]
fn other_animals_are_refused_with_what_was_found() {
    let tripod = Quadruped { legs: 3, ..Quadruped::default() }.model();
    let error = found(&tripod).unwrap_err();
    assert!(matches!(error, RobotError::Roles(_)));
    let message = error.to_string();
    for words in
        ["q.urdf: ", "3 legs were found instead of 2, 4 or 6", "w0 about (1.00, 0.00, 0.00) -> y0", "joint_roles"]
    {
        assert!(message.contains(words), "{message:?} lacks {words:?}");
    }
    let rock = Quadruped { legs: 0, ..Quadruped::default() }.model();
    assert!(found(&rock).unwrap_err().to_string().contains("0 legs were found"));
    // the same legs, all on the left
    let aside = Quadruped::default().urdf().replace("-0.1 0' rpy", "0.1 0' rpy").replace("-0.05 0' rpy", "0.05 0' rpy");
    let aside = load_str(&aside, Path::new("q.urdf"), &LoadOptions::default()).unwrap();
    let message = found(&aside).unwrap_err().to_string();
    assert!(message.contains("not one at each corner"), "{message}");
}

#[test]
fn a_leg_needs_a_foot() {
    let text = Quadruped { foot: "", ..Quadruped::default() }.urdf().replace("0.02 0.02 0.3", "1 1 1");
    let box_feet = load_str(&text, Path::new("q.urdf"), &LoadOptions::default()).unwrap();
    assert!(found(&box_feet).is_ok());
    let bare = text.replace("<collision>", "<visual>").replace("</collision>", "</visual>");
    let bare = load_str(&bare, Path::new("q.urdf"), &LoadOptions::default()).unwrap();
    let message = found(&bare).unwrap_err().to_string();
    assert!(message.contains("link \"c1\": leg LF has no collision shape"), "{message}");
}

#[test]
fn overrides_overrule_geometry() {
    let model = Quadruped::default().model();
    let none = BTreeMap::new();
    // front and hind exchanged on the left; the named legs leave their corners to the others
    let swapped = overrides(&[
        ("LF_HAA", "w3"),
        ("LF_HFE", "y3"),
        ("LF_KFE", "z3"),
        ("LH_HAA", "w1"),
        ("LH_HFE", "y1"),
        ("LH_KFE", "z1"),
    ]);
    let roles = detect(&model, &swapped, &none).unwrap();
    assert_eq!(joint_names(&model, &roles)[..4], ["w3", "w1", "w0", "w2"]);
    let shank_feet = detect(&model, &none, &overrides(&[("RF", "c0")])).unwrap();
    assert_eq!(model.bodies[shank_feet.foot_body[2]].name, "c0");

    let refused = |joints: &[(&str, &str)], feet: &[(&str, &str)], words: &str| {
        let message = detect(&model, &overrides(joints), &overrides(feet)).unwrap_err().to_string();
        assert!(message.contains(words), "{message:?} lacks {words:?}");
    };
    refused(&[("LF_HHA", "w1")], &[], "did you mean \"LF_HAA\"");
    refused(&[("LF_HAA", "w9")], &[], "\"w9\", which is no moving joint");
    refused(&[("LF_HAA", "w0")], &[], "is both LF_HAA and RF_HAA");
    refused(&[], &[("FL", "d1")], "feet.FL: is no leg");
    refused(&[], &[("LF", "d")], "which is no link with collision shapes");
    refused(&[], &[("LF", "d0")], "\"d0\" is not on this leg");
}
