//! Every task runs unchanged on Avian's rigid bodies.

use polypod::components::{BasePose, BaseVelocity, ContactForces, EnvId, Feet};
use polypod::{Sim, SimOptions};

use crate::common::{self, assert_all_same, busy, step, upward_force};

fn on_avian(mut options: SimOptions) -> SimOptions {
    options.overrides.push("physics.engine=avian".into());
    options
}

#[test]
fn robots_stand_as_on_the_articulated_engine() {
    let heights = |avian: bool| -> Vec<(f32, f64, f32)> {
        let calm =
            ["events.reset_base.x=[0.0, 0.0]", "events.reset_base.y=[0.0, 0.0]", "events.reset_joints.enabled=false"];
        let options =
            SimOptions { overrides: calm.map(String::from).to_vec(), ..SimOptions::new("velocity_flat_play", 8) };
        let mut sim = Sim::new(&if avian { on_avian(options) } else { options }).unwrap();
        for mut velocity in sim.world_mut().query::<&mut BaseVelocity>().iter_mut(sim.world_mut()) {
            *velocity = BaseVelocity::default();
        }
        let actions = vec![0.0; sim.batch().actions.len()];
        for _ in 0..500 {
            sim.step(&actions).unwrap();
            assert!(!sim.batch().terminated.contains(&true), "a robot fell; on Avian: {avian}");
        }
        let world = sim.world_mut();
        let mut robots: Vec<_> = world
            .query::<(&EnvId, &BasePose, &ContactForces, &Feet)>()
            .iter(world)
            .map(|(env, pose, forces, feet)| {
                let up = upward_force(forces);
                let lowest = feet.position.iter().map(|p| p[2]).fold(f32::MAX, f32::min);
                (*env, (pose.position[2], up, lowest))
            })
            .collect();
        robots.sort_by_key(|(env, _)| *env);
        robots.into_iter().map(|(_, robot)| robot).collect()
    };
    let mut failures = Vec::new();
    for (name, (ours, avians)) in common::ROBOTS.iter().zip(heights(false).into_iter().zip(heights(true))) {
        println!(
            "{name}: base {:.4} m, on Avian {:.4}; {:.1} N, {:.1} N; foot {:.4} m, {:.4} m",
            ours.0, avians.0, ours.1, avians.1, ours.2, avians.2
        );
        let same = (ours.0 - avians.0).abs() < 0.005
            && (ours.1 / avians.1 - 1.0).abs() < 0.02
            && (ours.2 - avians.2).abs() < 0.002;
        if !same {
            failures.push(*name);
        }
    }
    assert!(failures.is_empty(), "{failures:?} do not stand on Avian as on the articulated engine");
}

#[test]
fn resets_pushes_and_delays_change_nothing_about_reproducibility() {
    let sim = |threads: usize| {
        let options = SimOptions { threads: Some(threads), ..busy(&common::ROBOTS, 24) };
        Sim::new(&on_avian(options)).unwrap()
    };
    let (mut one, mut two, mut again) = (sim(1), sim(2), sim(1));
    let mut ended = 0;
    for k in 0..90 {
        for sim in [&mut one, &mut two, &mut again] {
            step(sim, k);
        }
        ended += common::ended(&one);
        assert!(one.batch().observations.iter().all(|x| x.is_finite()), "not finite in step {k}");
    }
    assert!(ended > 20, "{ended} episodes ended only");
    assert_all_same(&mut one, &mut two, "one and two threads");
    assert_all_same(&mut one, &mut again, "twice the same");
}

#[test]
fn robots_stand_on_a_box_as_on_the_ground() {
    let heights = |task: &str, x: f32, lift: f32| -> Vec<f32> {
        let calm = ["events.reset_base.x=[0.0, 0.0]", "events.reset_base.y=[0.0, 0.0]"];
        let quiet = ["events.reset_joints.enabled=false", "events.push_robot.enabled=false"];
        let overrides = [calm, quiet, ["events.add_base_mass.enabled=false", "events.base_com.enabled=false"]];
        let mut options = on_avian(SimOptions::new(task, 8));
        options.overrides.extend(overrides.concat().into_iter().map(String::from));
        let mut sim = Sim::new(&options).unwrap();
        let world = sim.world_mut();
        for (mut pose, mut velocity) in world.query::<(&mut BasePose, &mut BaseVelocity)>().iter_mut(world) {
            pose.position[0] = x;
            pose.position[2] += lift;
            *velocity = BaseVelocity::default();
        }
        let actions = vec![0.0; sim.batch().actions.len()];
        for _ in 0..150 {
            sim.step(&actions).unwrap();
        }
        let world = sim.world_mut();
        let mut robots: Vec<(EnvId, f32)> =
            world.query::<(&EnvId, &BasePose)>().iter(world).map(|(env, pose)| (*env, pose.position[2])).collect();
        robots.sort_by_key(|(env, _)| *env);
        robots.into_iter().map(|(_, height)| height).collect()
    };
    let (flat, boxed) = (heights("velocity_flat_universal", 0.0, 0.0), heights("velocity_obstacles", 3.75, 0.2));
    for ((name, low), high) in common::ROBOTS.iter().zip(flat).zip(boxed) {
        println!("{name}: {:.4} m higher on the box", high - low);
        assert!((high - low - 0.2).abs() < 2e-3, "{name}: {low} m on the ground, {high} m on the box");
    }
}
