//! The observation term `joint_descriptors` says of each joint where it is, how it turns, what
//! drives it and what hangs on it: the body's own numbers, on any body.

use std::path::Path;

use glam::{DMat3, DVec3};
use polypod::components::{Body, EnvId, Stance};
use polypod::morphology::MorphologyModel;
use polypod::{Sim, SimOptions};

use crate::common;

const COUNT: usize = 19;

fn options(robots: &[&str], num_envs: usize) -> SimOptions {
    let mut options = common::busy(robots, num_envs);
    options.roots = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/bodies")];
    options.overrides.push("observations.policy=[{term=\"joint_descriptors\"}]".into());
    options
}

/// `[number][slot]` of an env.
fn described(sim: &Sim, env: usize) -> Vec<Vec<f32>> {
    let batch = sim.batch();
    assert_eq!(batch.num_obs, COUNT * batch.num_actions);
    let row = &batch.observations[env * batch.num_obs..][..batch.num_obs];
    row.chunks(batch.num_actions).map(<[f32]>::to_vec).collect()
}

fn near(found: f32, expected: f64, what: &str) {
    assert!((f64::from(found) - expected).abs() < 1e-4 * (1.0 + expected.abs()), "{what}: {found}, not {expected}");
}

/// Against the URDF's own frames.
fn assert_is_of(model: &MorphologyModel, numbers: &[Vec<f32>]) {
    let urdf = &model.model;
    let q: Vec<f64> = model.stance.default_position.iter().map(|&q| f64::from(q)).collect();
    let links = urdf.forward_kinematics(&q);
    let total = urdf.total_mass();
    for slot in &model.slots {
        let (j, sign, column) = (slot.joint(), f64::from(slot.sign), slot.column());
        let what = format!("{} {}", model.name(), slot.slot);
        let (joint, link) = (&urdf.joints[j], &links[j + 1]);
        let axis = link.rotation * joint.axis * sign;
        let (mut mass, mut inertia) = (0.0, 0.0);
        for (below, pose) in links.iter().enumerate() {
            let above = std::iter::successors(Some(below), |link| urdf.parent(*link));
            if below == 0 || !above.into_iter().any(|link| link == j + 1) {
                continue;
            }
            let arm = pose.transform_point(urdf.links[below].com) - link.translation;
            let turned: DMat3 = pose.rotation * urdf.links[below].inertia * pose.rotation.transpose();
            mass += urdf.links[below].mass;
            inertia += axis.dot(turned * axis) + urdf.links[below].mass * axis.cross(arm).length_squared();
        }
        let at = |number: usize| numbers[number][column];
        for (k, (position, axis)) in link.translation.to_array().into_iter().zip(axis.to_array()).enumerate() {
            near(at(k), position, &format!("{what} position {k}"));
            near(at(3 + k), axis, &format!("{what} axis {k}"));
        }
        near(at(6), sign * q[j], &format!("{what} default"));
        let limits = [joint.lower, joint.upper].map(|x| (sign * x).clamp(-std::f64::consts::PI, std::f64::consts::PI));
        near(at(7), limits[0].min(limits[1]), &format!("{what} lower limit"));
        near(at(8), limits[0].max(limits[1]), &format!("{what} upper limit"));
        near(at(11), f64::from(model.nominal.stiffness[j]) / 100.0, &format!("{what} stiffness"));
        near(at(13), f64::from(model.nominal.armature[j]) * 10.0, &format!("{what} armature"));
        near(at(15), inertia, &format!("{what} inertia"));
        near(at(16), mass / total, &format!("{what} mass"));
        near(at(18), total / 50.0, &format!("{what} total mass"));
    }
}

#[test]
fn numbers_are_those_of_the_urdf_and_the_config() {
    let robots = ["small_biped", "unitree_go2", "small_hexapod", "small_humanoid", "small_quadruped", "anymal_d"];
    let mut options = options(&robots, robots.len());
    for event in ["physics_material", "add_base_mass", "base_com"] {
        options.overrides.push(format!("events.{event}.enabled=false"));
    }
    let sim = Sim::new(&options).unwrap_or_else(|error| panic!("{error}"));
    for (index, model) in sim.morphologies().iter().enumerate() {
        let numbers = described(&sim, index);
        assert_is_of(model, &numbers);
        let mask = model.action_mask(sim.batch().num_actions);
        assert!(numbers.iter().all(|row| row.iter().zip(&mask).all(|(x, has)| *has || x.to_bits() == 0)));
    }
}

#[test]
fn a_mirrored_body_is_the_body() {
    for robot in ["unitree_go2", "small_hexapod", "small_humanoid", "small_biped", "small_quadruped"] {
        let mut options = options(&[robot], 1);
        options.overrides.push("events.base_com.enabled=false".into());
        let sim = Sim::new(&options).unwrap();
        let numbers = &sim.batch().observations;
        for (at, (index, sign)) in sim.task().mirrored_observation(&sim.morphologies()[0]).into_iter().enumerate() {
            let (image, own) = (sign * numbers[index], numbers[at]);
            // the URDF's left and right legs differ a little
            assert!((image - own).abs() < 2e-3, "{robot}: number {at} is {own}, its image {image}");
        }
    }
}

#[test]
fn a_varied_body_describes_itself_from_its_episode_on() {
    let mut options = options(&["unitree_go2"], 4);
    for change in ["enabled=true", "mode=\"reset\"", "size=[0.8, 1.2]"] {
        options.overrides.push(format!("events.body_variation.{change}"));
    }
    let mut sim = Sim::new(&options).unwrap();
    for t in 0..80 {
        common::step(&mut sim, t);
    }
    let numbers: Vec<_> = (0..4).map(|env| described(&sim, env)).collect();
    assert_ne!(numbers[0][0], numbers[1][0]);
    let slots = sim.morphologies()[0].slots.clone();
    let world = sim.world_mut();
    for (id, body, stance) in world.query::<(&EnvId, &Body, &Stance)>().iter(world) {
        let of = &numbers[id.0 as usize];
        for slot in &slots {
            near(of[11][slot.column()], f64::from(body.0.stiffness[slot.joint()]) / 100.0, "stiffness");
            near(of[6][slot.column()], f64::from(slot.sign * stance.default_position[slot.joint()]), "default");
        }
        near(of[18][0], f64::from(body.0.total_mass()) / 50.0, "mass");
        let hip = DVec3::from_array([0, 1, 2].map(|k| f64::from(of[k][0])));
        let offset = DVec3::from_array(body.0.joint_offset[slots[0].joint()].map(f64::from));
        assert!((hip - offset).length() < 1e-5, "{hip} {offset}");
    }
    let snapshot = sim.snapshot().unwrap();
    let mut other = Sim::new(&options).unwrap();
    other.restore(&snapshot).unwrap();
    common::step(&mut sim, 80);
    common::step(&mut other, 80);
    common::assert_all_same(&mut sim, &mut other, "after a snapshot");
}

#[test]
fn quadrupeds_alone_have_the_term_morphology() {
    let mut options = options(&["unitree_go2", "small_biped"], 2);
    options.overrides.push("observations.policy=[{term=\"morphology\"}]".into());
    let error = Sim::new(&options).err().unwrap().to_string();
    for words in ["observations.policy[0]", "small_biped is none", "joint_descriptors"] {
        assert!(error.contains(words), "{error}");
    }
}
