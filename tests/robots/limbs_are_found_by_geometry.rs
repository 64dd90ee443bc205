//! Limbs, roles and their signs are found by geometry for bodies on two, four and six legs, with
//! and without arms.
//!
//! `tests/data/limbs.json` holds axes, origins and collision shapes of twenty published robot
//! descriptions, and which joint is which, as their makers' names say.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use glam::DVec3;
use polypod::robot::{
    BodyGroup, LimbKind, LoadOptions, Model, Place, Roles, Side, Slot, body_groups, detect, load_str,
};
use serde::Deserialize;

/// Name, type, parent, child, origin (m), roll, pitch and yaw (rad), axis.
#[derive(Deserialize)]
struct Joint(String, String, String, String, [f64; 3], [f64; 3], [f64; 3]);

/// Link, type, sizes (m), origin (m), roll, pitch and yaw (rad).
#[derive(Deserialize)]
struct Shape(String, String, Vec<f64>, [f64; 3], [f64; 3]);

#[derive(Deserialize)]
struct Body {
    root: String,
    /// Yaw of the root in a frame that looks along x, rad.
    turn: f64,
    joints: Vec<Joint>,
    shapes: Vec<Shape>,
    /// Joint of each slot, and whether its axis is turned round.
    slots: BTreeMap<String, (String, f64)>,
}

fn bodies() -> BTreeMap<String, Body> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/limbs.json");
    serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap()
}

impl Body {
    fn model(&self) -> Model {
        let origin = |[x, y, z]: &[f64; 3], [roll, pitch, yaw]: &[f64; 3]| {
            format!("<origin xyz='{x} {y} {z}' rpy='{roll} {pitch} {yaw}'/>")
        };
        let link = |name: &str| {
            let mut text = format!(
                "<link name='{name}'><inertial><mass value='1'/><inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/></inertial>"
            );
            for Shape(_, kind, size, xyz, rpy) in self.shapes.iter().filter(|shape| shape.0 == name) {
                let geometry = match kind.as_str() {
                    "sphere" => format!("<sphere radius='{}'/>", size[0]),
                    "box" => format!("<box size='{} {} {}'/>", size[0], size[1], size[2]),
                    _ => format!("<{kind} radius='{}' length='{}'/>", size[0], size[1]),
                };
                let _ = write!(text, "<collision>{}<geometry>{geometry}</geometry></collision>", origin(xyz, rpy));
            }
            text + "</link>"
        };
        let mut text = format!("<robot name='r'>{}", link(&self.root));
        if self.turn != 0.0 {
            let turn = origin(&[0.0; 3], &[0.0, 0.0, self.turn]);
            let root = &self.root;
            let _ = write!(
                text,
                "<link name='front'/><joint name='turn' type='fixed'><parent link='front'/><child link='{root}'/>{turn}</joint>"
            );
        }
        for Joint(name, kind, parent, child, xyz, rpy, axis) in &self.joints {
            let _ = write!(
                text,
                "{}<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>{}\
                 <axis xyz='{} {} {}'/><limit lower='-1' upper='1' effort='9' velocity='9'/></joint>",
                link(child),
                origin(xyz, rpy),
                axis[0],
                axis[1],
                axis[2]
            );
        }
        load_str(&(text + "</robot>"), Path::new("r.urdf"), &LoadOptions::default()).unwrap()
    }

    fn roles(&self, model: &Model) -> Roles {
        detect(model, &BTreeMap::new(), &BTreeMap::new()).unwrap_or_else(|error| panic!("{error}"))
    }
}

#[test]
fn every_joint_has_the_role_and_sign_that_its_maker_names() {
    let bodies = bodies();
    assert_eq!(bodies.len(), 20);
    let mut wrong = String::new();
    for (name, body) in &bodies {
        let model = body.model();
        let roles = body.roles(&model);
        let found: BTreeMap<String, (String, f64)> = roles
            .slots
            .iter()
            .enumerate()
            .map(|(at, slot)| {
                let joint = model.joints[roles.joint_of_slot[at]].name.clone();
                (slot.to_string(), (joint, roles.sign_of_slot[at]))
            })
            .collect();
        for (slot, joint) in &body.slots {
            if found.get(slot) != Some(joint) {
                let _ = writeln!(wrong, "{name}: {slot} is {joint:?}, found {:?}", found.get(slot));
            }
        }
        for slot in found.keys().filter(|slot| !body.slots.contains_key(*slot)) {
            let _ = writeln!(wrong, "{name}: {slot} {:?} is none", found[slot]);
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn a_slot_turns_the_same_way_on_every_body() {
    for (name, body) in &bodies() {
        let model = body.model();
        let roles = body.roles(&model);
        let links = model.forward_kinematics(&[]);
        for limb in roles.limbs.iter().filter(|limb| limb.kind == LimbKind::Leg) {
            let foot = limb.foot.unwrap();
            let carrier = model.bodies[foot.body].link;
            for joint in &limb.joints {
                let mut q = vec![0.0; model.joints.len()];
                q[joint.joint] = 1e-3 * joint.sign;
                let at = |links: &[polypod::robot::Pose]| links[carrier].transform_point(foot.point);
                let moved = at(&model.forward_kinematics(&q)) - at(&links);
                let slot = joint.slot.to_string();
                // the foot hangs below hips and knees, or points away from the body
                let (is_right, what) = match slot.split_once('_').unwrap().1 {
                    "HFE" | "KFE" | "HIP_PITCH" => (moved.x < 0.0, "to the rear"),
                    "HAA" | "HIP_ROLL" => (moved.y > 0.0, "to the left"),
                    "HIP_LIFT" | "KNEE" if roles.legs.len() == 6 => (moved.z < 0.0, "down"),
                    _ => continue,
                };
                assert!(is_right, "{name}: {slot} moves the foot by {moved}, not {what}");
            }
        }
    }
}

#[test]
fn every_leg_has_a_foot_and_every_limb_its_mirror_image() {
    for (name, body) in &bodies() {
        let model = body.model();
        let roles = body.roles(&model);
        assert_eq!(roles.foot_body.len(), roles.legs.len());
        assert!([2, 4, 6].contains(&roles.legs.len()), "{name}");
        let links = model.forward_kinematics(&[]);
        let feet: BTreeMap<Place, DVec3> = (0..roles.legs.len())
            .map(|leg| {
                let link = &links[model.bodies[roles.foot_body[leg]].link];
                (roles.legs[leg], link.transform_point(roles.foot_point[leg]))
            })
            .collect();
        for (place, foot) in &feet {
            let other = feet[&place.mirrored()];
            let apart = DVec3::new(foot.x - other.x, foot.y + other.y, foot.z - other.z).length();
            // the hexapod's feet are 3.3 mm from being mirror images, all others within 1 mm
            assert!(apart < 4e-3, "{name}: {place:?} at {foot}, {:?} at {other}", place.mirrored());
            assert_eq!(foot.y > other.y, place.side() == Side::Left, "{name}");
        }
        for slot in &roles.slots {
            assert!(roles.slots.contains(&slot.mirrored()), "{name}: {slot}");
        }
        let groups = body_groups(&model, &roles);
        for (leg, &foot) in roles.foot_body.iter().enumerate() {
            assert_eq!(groups[foot], BodyGroup::Foot, "{name}: {:?}", roles.legs[leg]);
        }
        assert!(groups.contains(&BodyGroup::Base), "{name}");
    }
}

#[test]
fn a_config_may_name_every_joint() {
    let bodies = bodies();
    for name in ["phantomx", "unitree_h1", "cassie"] {
        let body = &bodies[name];
        let model = body.model();
        let named = body.slots.iter().map(|(slot, (joint, _))| (slot.clone(), joint.clone())).collect();
        assert_eq!(detect(&model, &named, &BTreeMap::new()).unwrap(), body.roles(&model), "{name}");
    }
    // one of them, and the rest by geometry
    let body = &bodies["unitree_h1"];
    let model = body.model();
    let swapped: BTreeMap<String, String> = [
        ("L_HIP_YAW".to_owned(), "left_hip_roll_joint".to_owned()),
        ("L_HIP_ROLL".to_owned(), "left_hip_yaw_joint".to_owned()),
    ]
    .into();
    let roles = detect(&model, &swapped, &BTreeMap::new()).unwrap();
    let joint = |name: &str| model.joints[roles.joint(Slot::parse(name).unwrap()).unwrap()].name.as_str();
    assert_eq!((joint("L_HIP_YAW"), joint("R_HIP_YAW")), ("left_hip_roll_joint", "right_hip_yaw_joint"));
    let one = [("L_HIP_YAW".to_owned(), "left_hip_roll_joint".to_owned())].into();
    let error = detect(&model, &one, &BTreeMap::new()).unwrap_err().to_string();
    assert!(error.contains("are both L_HIP_YAW"), "{error}");
}

/// Links in a row: for each, its axis, its place from the one before (m) and its mass (kg).
fn row(name: &str, joints: &[(&str, [f64; 3], f64)], shape: &str) -> String {
    let mut text = String::new();
    let mut parent = "base".to_string();
    for (at, (axis, [x, y, z], mass)) in joints.iter().enumerate() {
        let own = format!("{name}_{at}");
        let shape = if at + 1 == joints.len() { shape } else { "" };
        let _ = write!(
            text,
            "<link name='{own}'><inertial><mass value='{mass}'/><inertia ixx='0.01' ixy='0' ixz='0' iyy='0.01' iyz='0' izz='0.01'/>\
             </inertial>{shape}</link><joint name='{own}_joint' type='revolute'><parent link='{parent}'/><child link='{own}'/>\
             <origin xyz='{x} {y} {z}'/><axis xyz='{axis}'/><limit lower='-1' upper='1' effort='9' velocity='9'/></joint>"
        );
        parent = own;
    }
    text
}

/// Two legs, arms whose joints are as heavy as given, and these limbs.
fn humanoid(left_arm: f64, right_arm: f64, others: &str) -> Roles {
    let sole = "<collision><origin xyz='0 0 -0.03'/><geometry><box size='0.2 0.08 0.02'/></geometry></collision>";
    let leg = |name: &str, y: f64| {
        let down = [0.0, 0.0, -0.35];
        let joints = [
            ("1 0 0", [0.0, y, -0.1], 1.0),
            ("0 1 0", [0.0, 0.0, -0.05], 2.0),
            ("0 1 0", down, 1.5),
            ("0 1 0", down, 0.5),
        ];
        row(name, &joints, sole)
    };
    let arm = |name: &str, y: f64, mass: f64| {
        let joints =
            [("0 1 0", [0.0, y, 0.4], mass), ("1 0 0", [0.0, 0.3 * y, 0.0], mass), ("0 1 0", [0.0, 0.0, -0.25], mass)];
        if mass > 0.0 { row(name, &joints, "") } else { String::new() }
    };
    let text = format!(
        "<robot name='r'><link name='base'><inertial><mass value='9'/><inertia ixx='0.1' ixy='0' ixz='0' iyy='0.1' iyz='0' izz='0.1'/>\
         </inertial></link>{}{}{others}{}{}</robot>",
        leg("left_leg", 0.1),
        leg("right_leg", -0.1),
        arm("left_arm", 0.15, left_arm),
        arm("right_arm", -0.15, right_arm)
    );
    let model = load_str(&text, Path::new("r.urdf"), &LoadOptions::default()).unwrap();
    let mut roles = detect(&model, &BTreeMap::new(), &BTreeMap::new()).unwrap();
    roles.limbs.retain(|limb| limb.kind != LimbKind::Leg);
    roles
}

/// Places of the limbs that are no legs, with the name of the first joint's slot.
fn places(roles: &Roles) -> Vec<(Place, LimbKind, String)> {
    roles.limbs.iter().map(|limb| (limb.place, limb.kind, limb.joints[0].slot.to_string())).collect()
}

#[test]
fn a_neck_beside_the_middle_plane_is_a_head() {
    let arms = [
        (Place::Left, LimbKind::Arm, "L_SHOULDER_PITCH".to_string()),
        (Place::Right, LimbKind::Arm, "R_SHOULDER_PITCH".to_string()),
    ];
    assert_eq!(places(&humanoid(1.0, 1.0, "")), arms);
    // 3 cm to either side, and back with the next joint; with three joints; with as many as an arm
    // and as heavy
    let head = |y: f64, joints: usize, mass: f64| {
        let all = [("0 1 0", [0.0, y, 0.5], mass), ("0 0 1", [0.0, -y, 0.05], mass), ("1 0 0", [0.0, 0.0, 0.05], mass)];
        row("head", &all[..joints], "")
    };
    for (y, joints, mass) in [(0.032, 2, 0.4), (-0.032, 2, 0.4), (0.04, 3, 0.3), (0.0, 3, 1.0), (-0.04, 1, 1.0)] {
        let roles = humanoid(1.0, 1.0, &head(y, joints, mass));
        let [left, right] = arms.clone();
        let expected = [left, right, (Place::Head, LimbKind::Head, "HEAD_PITCH".to_string())];
        assert_eq!(places(&roles), expected, "{y} {joints} {mass}");
    }
    // nor does it become an arm where only one side has one
    let roles = humanoid(0.0, 1.0, &head(0.032, 2, 0.4));
    assert_eq!(places(&roles)[1..], [(Place::Head, LimbKind::Head, "HEAD_PITCH".to_string())]);
}

#[test]
fn arms_that_differ_or_are_alone_stay_at_their_sides() {
    let limb_kinds =
        |roles: &Roles| -> Vec<(Place, LimbKind)> { roles.limbs.iter().map(|limb| (limb.place, limb.kind)).collect() };
    let (left, right) = ((Place::Left, LimbKind::Arm), (Place::Right, LimbKind::Arm));
    assert_eq!(limb_kinds(&humanoid(1.0, 3.0, "")), [left, right]);
    assert_eq!(limb_kinds(&humanoid(1.0, 0.0, "")), [left]);
    // two arms a side: each is the mirror image of the one that is like it, whatever their order in
    // the file
    let small = |name: &str, y: f64| row(name, &[("0 1 0", [0.1, y, 0.3], 0.2), ("0 1 0", [0.0, 0.0, -0.1], 0.1)], "");
    let roles = humanoid(1.0, 1.0, &(small("b", -0.15) + &small("a", 0.15)));
    assert_eq!(limb_kinds(&roles), [left, left, right, right]);
    for limb in &roles.limbs[..2] {
        let mirror =
            roles.limbs[2..].iter().find(|other| other.joints[0].slot == limb.joints[0].slot.mirrored()).unwrap();
        assert_eq!(limb.joints.len(), mirror.joints.len());
    }
}
