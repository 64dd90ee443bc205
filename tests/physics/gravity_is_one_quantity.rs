//! Gravity is what the task says, in physics, sensors and terms.

use polypod::components::{BaseVelocity, EnvId, Imu};
use polypod::systems::StateField;
use polypod::{Sim, SimOptions};

use crate::common;

fn still(task: &str, gravity: [f64; 3], more: &[&str]) -> Sim {
    let mut overrides: Vec<String> =
        ["observations.enable_noise=false", "events.push_robot.enabled=false", "events.reset_base.yaw=[0.0, 0.0]"]
            .map(String::from)
            .to_vec();
    overrides.push(format!("sim.gravity={gravity:?}"));
    overrides.extend(more.iter().map(|text| text.to_string()));
    let options = SimOptions { robots: Some(vec!["unitree_go2".into()]), overrides, ..SimOptions::new(task, 2) };
    Sim::new(&options).unwrap()
}

fn sensed(sim: &mut Sim) -> [f32; 3] {
    let mut rows = vec![0.0; 6];
    sim.state(StateField::ProjectedGravity, &mut rows).unwrap();
    let observed = &sim.batch().observations[6..9];
    assert_eq!(observed, &rows[..3], "the observation is the sensor's");
    [rows[0], rows[1], rows[2]]
}

fn assert_near(found: [f32; 3], expected: [f32; 3]) {
    let far = found.iter().zip(expected).any(|(x, y)| (x - y).abs() > 1e-4);
    assert!(!far, "{found:?}, not {expected:?}");
}

#[test]
fn the_sensor_points_where_bodies_fall() {
    let tilted = [1.7035, 0.0, -9.661];
    assert_near(sensed(&mut still("velocity_flat", tilted, &[])), [0.1736, 0.0, -0.9848]);
    let turned = "events.reset_base.yaw=[1.5707963, 1.5707963]";
    assert_near(sensed(&mut still("velocity_flat", tilted, &[turned])), [0.0, -0.1736, -0.9848]);
    assert_near(sensed(&mut still("velocity_flat", [0.0, 0.0, 9.81], &[])), [0.0, 0.0, 1.0]);
    assert_near(sensed(&mut still("velocity_flat", [0.0, -3.0, -4.0], &[])), [0.0, -0.6, -0.8]);
    assert_near(sensed(&mut still("velocity_flat", [0.0, 0.0, -1.62], &[])), [0.0, 0.0, -1.0]);
    assert_eq!(sensed(&mut still("velocity_flat", [0.0; 3], &[])).map(f32::abs), [0.0; 3]);
}

#[test]
fn a_fall_is_along_the_sensed_direction() {
    let mut sim = still("velocity_flat", [3.0, 2.0, 6.0], &["terminations.base_contact.threshold=1e6"]);
    let down = sensed(&mut sim);
    let actions = vec![0.0; sim.batch().actions.len()];
    for _ in 0..2 {
        sim.step(&actions).unwrap();
    }
    let world = sim.world_mut();
    for velocity in world.query::<&BaseVelocity>().iter(world) {
        let v = velocity.linear;
        let length = v.iter().map(|x| x * x).sum::<f32>().sqrt();
        let along: f32 = v.iter().zip(down).map(|(v, g)| v * g).sum();
        assert!((length - 7.0 * 0.04).abs() < 0.03 && along > 0.98 * length, "{v:?} along {down:?}");
    }
}

#[test]
fn usual_gravity_keeps_its_bits() {
    let mut sim = still("velocity_flat", [0.0, 0.0, -9.81], &["events.reset_base.yaw=[0.4, 0.4]"]);
    let actions = vec![0.3; sim.batch().actions.len()];
    sim.step(&actions).unwrap();
    let world = sim.world_mut();
    let mut imus = world.query::<(&EnvId, &Imu)>();
    let gravity: Vec<_> = imus.iter(world).sort::<&EnvId>().map(|(_, imu)| imu.projected_gravity).collect();
    let mut poses = world.query::<(&EnvId, &polypod::components::BasePose)>();
    for ((_, pose), gravity) in poses.iter(world).sort::<&EnvId>().zip(gravity) {
        let up = polypod::dynamics::math::quat_to_mat(&pose.rotation)[2];
        assert_eq!(gravity.map(f32::to_bits), up.map(|x| (-x).to_bits()));
    }
}

#[test]
fn weights_are_those_of_the_task() {
    let authority = |gravity: f64| {
        let sim = still("velocity_flat_universal", [0.0, 0.0, -gravity], &[]);
        let layout: Vec<_> = sim.task().observations.iter().map(|term| (term.name.clone(), term.size)).collect();
        let start: usize = layout.iter().take_while(|(name, _)| name != "morphology").map(|(_, size)| size).sum();
        [0, 1, 2].map(|role| sim.batch().observations[start + 7 + 5 * role + 4])
    };
    let (earth, moon, nowhere) = (authority(9.81), authority(1.62), authority(0.0));
    for role in 0..3 {
        assert!((moon[role] / earth[role] - 9.81 / 1.62).abs() < 1e-4, "{earth:?} {moon:?}");
    }
    assert_eq!(nowhere, [0.0; 3]);
}

#[test]
fn upright_is_against_gravity() {
    let ends = |gravity: [f64; 3]| {
        let task =
            common::extended_task("upright", "velocity_flat", "[terminations.bad_orientation]\nlimit_angle = 0.5");
        let mut sim = still(&task, gravity, &[]);
        let actions = vec![0.0; sim.batch().actions.len()];
        sim.step(&actions).unwrap();
        sim.batch().terminated.clone()
    };
    assert_eq!(ends([0.0, 0.0, -9.81]), [false; 2]);
    assert_eq!(ends([0.0, 0.0, 9.81]), [true; 2]);
    assert_eq!(ends([9.81, 0.0, -9.81]), [true; 2], "45 degrees");
    assert_eq!(ends([0.0; 3]), [false; 2], "without gravity no orientation is bad");
}
