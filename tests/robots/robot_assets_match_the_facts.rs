//! The built-in robots are what their makers' descriptions say, as read by other means
//! (tests/data/robot_facts.json).

use std::collections::BTreeMap;

use glam::DVec3;
use polypod::config::Library;
use polypod::dynamics::math::Spatial;
use polypod::dynamics::{Parameters, Scalar, Workspace, point_motion};
use polypod::morphology::MorphologyModel;
use polypod::robot::{CANONICAL_JOINT_NAMES, LEGS, ROLES};
use serde::Deserialize;

use crate::common::facts::{LinkFacts, Tolerances, assert_links, assert_near};
use crate::common::{ROBOTS, noise};

#[derive(Deserialize)]
struct Facts {
    robots: BTreeMap<String, RobotFacts>,
}

#[derive(Deserialize)]
struct RobotFacts {
    total_mass: f64,
    root_link: String,
    joint_order: Vec<String>,
    canonical_joints: BTreeMap<String, String>,
    default_pose: BTreeMap<String, f64>,
    feet: BTreeMap<String, FootFacts>,
    links: Vec<LinkFacts>,
}

#[derive(Deserialize)]
struct FootFacts {
    link: String,
    radius: f64,
    center_in_base: [f64; 3],
}

/// Every robot with its facts.
fn robots() -> Vec<(MorphologyModel, RobotFacts)> {
    let mut facts: Facts = serde_json::from_str(include_str!("../data/robot_facts.json")).unwrap();
    let library = Library::new(Vec::new());
    let robots: Vec<_> = ROBOTS
        .into_iter()
        .map(|name| (MorphologyModel::new(&library.robot(name).unwrap()).unwrap(), facts.robots.remove(name).unwrap()))
        .collect();
    assert!(facts.robots.is_empty());
    robots
}

#[test]
fn masses_and_inertias() {
    for (robot, facts) in robots() {
        let (name, model) = (robot.name(), &robot.model);
        assert_near([model.total_mass()], &[facts.total_mass], 1e-6, &format!("{name}: total mass"));
        let engine = f64::from(robot.nominal.total_mass());
        assert_near([engine], &[facts.total_mass], 1e-6 * facts.total_mass, &format!("{name}: engine's mass"));
        assert_eq!(model.links[0].name, facts.root_link, "{name}");
        assert_links(model, &facts.links, &Tolerances { mass: 1e-6, com: 1e-6, inertia: 1e-6 });
    }
}

#[test]
fn joints_and_feet_of_the_default_pose() {
    for (robot, facts) in robots() {
        let (name, model, roles) = (robot.name(), &robot.model, &robot.roles);
        let joints: Vec<&str> = model.joints.iter().map(|joint| joint.name.as_str()).collect();
        assert_eq!(joints, facts.joint_order, "{name}");
        let pose: Vec<f64> = joints.iter().map(|joint| facts.default_pose[*joint]).collect();
        for ((joint, &ours), &fact) in joints.iter().zip(&robot.stance.default_position).zip(&pose) {
            assert_near([f64::from(ours)], &[fact], 1e-6, &format!("{name}: default position of {joint}"));
        }
        let links = model.forward_kinematics(&pose);
        for (leg, leg_name) in LEGS.into_iter().enumerate() {
            let (body, fact) = (&model.bodies[roles.foot_body[leg]], &facts.feet[leg_name]);
            let what = format!("{name}: foot {leg_name}");
            let link = &model.links[body.link];
            assert!(link.name == fact.link || link.merged.contains(&fact.link), "{what} is on {}", link.name);
            assert_near([roles.foot_radius[leg]], &[fact.radius], 1e-6, &format!("{what}: radius"));
            let centre = links[body.link].transform_point(roles.foot_point[leg]);
            assert_near([(centre - DVec3::from_array(fact.center_in_base)).length()], &[0.0], 1e-6, &what);
        }
    }
}

#[test]
fn joint_roles_follow_from_geometry() {
    for (robot, facts) in robots() {
        let roles = serde_json::to_value(&robot.config.joint_roles).unwrap();
        assert!(roles.as_object().is_none_or(serde_json::Map::is_empty), "{}: roles must not be told", robot.name());
        assert_eq!(facts.canonical_joints.len(), LEGS.len() * ROLES.len());
        for (canonical, joint) in CANONICAL_JOINT_NAMES.into_iter().zip(robot.joint_names_by_slot()) {
            assert_eq!(facts.canonical_joints[canonical], joint, "{}: {canonical}", robot.name());
        }
    }
}

/// The engine's base-aligned view puts the feet where the URDF's frames put them, at any joint
/// positions.
fn assert_engine_agrees<S: Scalar + Into<f64>>(robot: &MorphologyModel, trial: usize, tolerance: f64) {
    let (model, topology) = (&robot.model, &robot.topology);
    let turn = |joint: usize| f64::from(noise(1, trial, 0, joint)) * std::f64::consts::PI;
    let q: Vec<f64> = (0..model.joints.len()).map(turn).collect();
    let parameters = Parameters::<S>::from_scalars(topology, &robot.nominal);
    let mut work = Workspace::new(topology);
    let positions: Vec<S> = q.iter().map(|&x| S::splat(x)).collect();
    let still = vec![S::zero(); q.len()];
    S::forward_kinematics(topology, &parameters, &positions, &still, &Spatial::zero(), &mut work);
    let links = model.forward_kinematics(&q);
    assert_eq!(topology.sites.len(), LEGS.len());
    for (leg, &link) in topology.sites.iter().enumerate() {
        let (centre, _) = point_motion(&work.links[link], &parameters.site_position[leg]);
        let expected = links[link].transform_point(robot.roles.foot_point[leg]);
        let distance = (DVec3::from_array(centre.map(Into::into)) - expected).length();
        assert!(distance < tolerance, "{}: foot {} is {distance} m away, trial {trial}", robot.name(), LEGS[leg]);
    }
}

#[test]
fn the_engine_puts_the_feet_where_the_urdf_does() {
    for (robot, _) in robots() {
        for trial in 0..50 {
            // the nominal parameters are f32 already
            assert_engine_agrees::<f64>(&robot, trial, 1e-6);
            assert_engine_agrees::<f32>(&robot, trial, 1e-5);
        }
    }
}
