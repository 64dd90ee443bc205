//! Bodies other than the first eight robots are as their publishers' descriptions say, as read by
//! other means (tests/data/more_robot_facts.json).

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;
use polypod::robot::{Body, JointKind, LoadOptions, Model, load};
use serde::Deserialize;

use crate::common::ROBOTS;
use crate::common::facts::{LinkFacts, Tolerances, assert_links, assert_near};

#[derive(Deserialize)]
struct Facts {
    robots: BTreeMap<String, RobotFacts>,
}

#[derive(Deserialize)]
struct RobotFacts {
    total_mass: f64,
    root_link: String,
    default_pose: BTreeMap<String, f64>,
    feet: Vec<FootFacts>,
    links: Vec<LinkFacts>,
    joints: Vec<JointFacts>,
}

#[derive(Deserialize)]
struct FootFacts {
    link: String,
    /// The middles of the foot's shapes in that link's frame.
    shapes: Vec<[f64; 3]>,
    /// Their mean in the base frame, in the default pose.
    centre_in_base: [f64; 3],
}

#[derive(Deserialize)]
struct JointFacts {
    name: String,
    child: String,
    axis_in_base: [f64; 3],
    position_in_base: [f64; 3],
    lower: Option<f64>,
    upper: Option<f64>,
    effort: f64,
    velocity: f64,
}

fn robots() -> Vec<(String, Model, RobotFacts)> {
    let facts: Facts = serde_json::from_str(include_str!("../data/more_robot_facts.json")).unwrap();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/robots");
    let mut names: Vec<String> = std::fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| !ROBOTS.contains(&name.as_str()))
        .collect();
    names.sort();
    assert!(names.iter().eq(facts.robots.keys()), "{names:?} are not the robots of the facts");
    let read = |(name, facts): (String, RobotFacts)| {
        let model = load(&folder.join(&name).join("robot.urdf"), &LoadOptions::default()).unwrap();
        (name, model, facts)
    };
    facts.robots.into_iter().map(read).collect()
}

#[test]
fn each_has_a_licence_and_a_source() {
    for (name, model, _) in robots() {
        assert_eq!(model.warnings, [], "{name}");
        let folder = model.source.parent().unwrap();
        let licence = std::fs::read_to_string(folder.join("LICENSE")).unwrap();
        assert!(licence.contains("Copyright") || licence.contains("Apache License"), "{name}");
        let source = std::fs::read_to_string(folder.join("SOURCE.md")).unwrap();
        for part in ["## Origin", "<https://github.com/", "commit", "Licence: ", "## Known deviations"] {
            assert!(source.contains(part), "{name}: SOURCE.md does not say `{part}`");
        }
    }
}

#[test]
fn masses_and_inertias() {
    for (name, model, facts) in robots() {
        assert_near([model.total_mass()], &[facts.total_mass], 1e-6, &name);
        assert_eq!(model.links[0].name, facts.root_link, "{name}");
        assert_links(&model, &facts.links, &Tolerances { mass: 1e-9, com: 1e-9, inertia: 1e-8 });
    }
}

#[test]
fn joints() {
    for (name, model, facts) in robots() {
        assert_eq!(model.joints.len(), facts.joints.len(), "{name}");
        let links = model.forward_kinematics(&[]);
        for (index, (joint, fact)) in model.joints.iter().zip(&facts.joints).enumerate() {
            let what = format!("{name}, joint {}", fact.name);
            assert_eq!(joint.name, fact.name, "{name}");
            assert_eq!(model.links[index + 1].name, fact.child, "{what}");
            let pose = &links[index + 1];
            assert_near((pose.rotation * joint.axis).to_array(), &fact.axis_in_base, 1e-7, &what);
            assert_near(pose.translation.to_array(), &fact.position_in_base, 1e-7, &what);
            match (fact.lower, fact.upper) {
                (Some(lower), Some(upper)) => assert_near([joint.lower, joint.upper], &[lower, upper], 1e-9, &what),
                _ => assert_eq!(joint.kind, JointKind::Continuous, "{what}"),
            }
            assert_near([joint.effort, joint.velocity], &[fact.effort, fact.velocity], 1e-9, &what);
        }
    }
}

#[test]
fn feet_of_the_default_pose() {
    for (name, model, facts) in robots() {
        let pose: Vec<f64> = model.joints.iter().map(|joint| facts.default_pose[&joint.name]).collect();
        for (joint, &angle) in model.joints.iter().zip(&pose) {
            assert!((joint.lower..=joint.upper).contains(&angle), "{name}: {} is outside its range", joint.name);
        }
        let links = model.forward_kinematics(&pose);
        assert!(!facts.feet.is_empty(), "{name}");
        for foot in &facts.feet {
            let what = format!("{name}, foot on {}", foot.link);
            let link = model.links.iter().position(|link| link.name == foot.link).unwrap();
            let middles: Vec<DVec3> = foot.shapes.iter().map(|&middle| DVec3::from_array(middle)).collect();
            let centre =
                middles.iter().map(|&at| links[link].transform_point(at)).sum::<DVec3>() / middles.len() as f64;
            assert_near(centre.to_array(), &foot.centre_in_base, 1e-6, &what);
            // on that link, or on a massless one fixed to it
            let bodies = || model.bodies.iter().filter(|body| body.link == link);
            for middle in middles {
                let at = |body: &Body| body.shapes.iter().any(|shape| shape.origin.translation.distance(middle) < 1e-9);
                assert!(bodies().any(at), "{what}: no shape at {middle}");
            }
        }
    }
}
