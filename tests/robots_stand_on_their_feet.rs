//! Each robot, holding its default pose, keeps standing for 5 s, and its contact forces add up to its weight.

use polypod::components::{BasePose, BaseVelocity, Body, ContactForces, EnvId};
use polypod::{Sim, SimOptions};

/// The flat task without anything random.
fn calm(robots: Option<Vec<String>>, num_envs: usize) -> Sim {
    let options = SimOptions {
        robots,
        overrides: [
            "events.reset_base.x=[0.0, 0.0]",
            "events.reset_base.y=[0.0, 0.0]",
            "events.reset_joints.enabled=false",
        ]
        .map(String::from)
        .to_vec(),
        ..SimOptions::new("velocity_flat_play", num_envs)
    };
    let mut sim = Sim::new(&options).unwrap();
    for mut velocity in sim.world_mut().query::<&mut BaseVelocity>().iter_mut(sim.world_mut()) {
        *velocity = BaseVelocity::default();
    }
    sim
}

#[test]
fn every_robot_stands_for_five_seconds_and_weighs_what_it_weighs() {
    let mut sim = calm(None, 8);
    let actions = vec![0.0; sim.batch().actions.len()];
    for _ in 0..250 {
        sim.step(&actions).unwrap();
        assert!(!sim.batch().terminated.contains(&true));
    }
    let robots = sim.morphologies().to_vec();
    let gravity = 9.81;
    let world = sim.world_mut();
    for (env, pose, forces, body) in world.query::<(&EnvId, &BasePose, &ContactForces, &Body)>().iter(world) {
        let robot = &robots[env.0 as usize];
        let weight = f64::from(body.0.total_mass()) * gravity;
        let up: f64 = forces.net.iter().map(|f| f64::from(f[2])).sum();
        let [w, x, y, _] = pose.rotation.map(f64::from);
        let pitch = 2.0 * (w * y).asin().abs();
        let roll = 2.0 * (w * x).asin().abs();
        println!(
            "{:<12} z {:.4} of {:.4} roll {roll:.4} pitch {pitch:.4} force {up:.3} weight {weight:.3} ratio {:.6}",
            robot.name(), pose.position[2], robot.spawn_height, up / weight
        );
        assert!((up / weight - 1.0).abs() < 1e-3, "{}: {up} N of {weight} N", robot.name());
        assert!(pose.position[2] > 0.8 * robot.spawn_height, "{} sank to {}", robot.name(), pose.position[2]);
        let feet: f64 = robot.feet.iter().map(|&b| f64::from(forces.net[b][2])).sum();
        assert!((feet / weight - 1.0).abs() < 1e-3, "{} stands on more than its feet", robot.name());
        for &foot in &robot.feet {
            assert!(forces.net[foot][2] > 0.05 * weight as f32, "{}: a foot is in the air", robot.name());
        }
    }
}
