//! Each robot, holding its default pose, keeps standing for 10 s, and its contact forces add up to
//! its weight.

use polypod::components::{BasePose, BaseVelocity, Body, ContactForces, EnvId};
use polypod::config::Library;
use polypod::morphology::MorphologyModel;
use polypod::{Sim, SimOptions};

use crate::common::upward_force;

/// The flat task's Play variant, one env per robot, all at rest in the default pose.
fn calm() -> Sim {
    let options = SimOptions {
        overrides: [
            "events.reset_base.x=[0.0, 0.0]",
            "events.reset_base.y=[0.0, 0.0]",
            "events.reset_joints.enabled=false",
        ]
        .map(String::from)
        .to_vec(),
        ..SimOptions::new("velocity_flat_play", 8)
    };
    let mut sim = Sim::new(&options).unwrap();
    for mut velocity in sim.world_mut().query::<&mut BaseVelocity>().iter_mut(sim.world_mut()) {
        *velocity = BaseVelocity::default();
    }
    sim
}

#[test]
fn every_robot_stands_for_ten_seconds_and_weighs_what_it_weighs() {
    let mut sim = calm();
    let actions = vec![0.0; sim.batch().actions.len()];
    // on gains this soft some robots sway for 8 s before the forces settle (in MuJoCo too)
    for _ in 0..500 {
        sim.step(&actions).unwrap();
        assert!(!sim.batch().terminated.contains(&true), "a robot's base touched the ground");
    }
    let robots = sim.morphologies().to_vec();
    let gravity = 9.81;
    let world = sim.world_mut();
    let mut failures = Vec::new();
    for (env, pose, velocity, forces, body) in
        world.query::<(&EnvId, &BasePose, &BaseVelocity, &ContactForces, &Body)>().iter(world)
    {
        let robot = &robots[env.0 as usize];
        let weight = f64::from(body.0.total_mass()) * gravity;
        let up = upward_force(forces);
        let feet: Vec<f64> = forces.feet.iter().map(|f| f64::from(f[2]) / weight).collect();
        let speed = velocity.linear.iter().map(|v| v * v).sum::<f32>().sqrt();
        let [w, x, y, _] = pose.rotation;
        println!(
            "{:<12} height {:.4} of {:.4} m, roll {:+.4} pitch {:+.4} rad, speed {speed:.4} m/s, force / weight {:.6}, feet {feet:.3?}",
            robot.name(),
            pose.position[2],
            robot.describe().base_height,
            2.0 * (w * x).asin(),
            2.0 * (w * y).asin(),
            up / weight
        );
        let mut check = |holds: bool, what: &str| {
            if !holds {
                failures.push(format!("{}: {what}", robot.name()));
            }
        };
        check((up / weight - 1.0).abs() < 1e-3, "forces do not add up to the weight");
        check((feet.iter().sum::<f64>() - up / weight).abs() < 1e-6, "touches the ground with more than its feet");
        check(feet.iter().all(|&share| share > 0.05), "a foot carries next to nothing");
        check(speed < 0.05, "has not come to rest");
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

#[test]
fn a_base_has_sunk_to_a_share_of_its_height_or_of_the_hips() {
    let library = Library::new(Vec::new());
    for entry in library.robots().unwrap() {
        let robot = MorphologyModel::new(&library.robot(&entry.name).unwrap()).unwrap();
        let height = robot.describe().base_height;
        // to the bit: known robots have their frame well above the soles
        assert_eq!(robot.least_height(0.5, height), 0.5 * height, "{}", entry.name);
        // the same robot with a frame that lies 1 m lower sinks by half of the height of its hips
        let hips = height + robot.hip_height;
        let below = MorphologyModel { hip_height: robot.hip_height + 1.0, ..robot };
        let least = below.least_height(0.5, height - 1.0);
        assert!((least - (height - 1.0 - 0.5 * hips)).abs() < 1e-6, "{}: {least}", entry.name);
    }
}
