//! Forces and torques from outside do what Newton and Euler say, on both engines, until the episode
//! or the next event ends them.

use polypod::components::{BaseVelocity, Body, EnvId, ExternalWrench, JointState};
use polypod::{Sim, SimOptions};

fn sim(engine: &str, more: &[&str]) -> Sim {
    let overrides = [
        format!("physics.engine={engine}"),
        "sim.gravity=[0.0, 0.0, 0.0]".into(),
        "events.push_robot.enabled=false".into(),
        "events.reset_base.enabled=false".into(),
        "events.reset_joints.enabled=false".into(),
        "events.base_com.enabled=false".into(),
        "terminations.base_contact=null".into(),
    ];
    let options = SimOptions {
        robots: Some(vec!["unitree_go2".into()]),
        threads: Some(1),
        overrides: overrides.into_iter().chain(more.iter().map(ToString::to_string)).collect(),
        ..SimOptions::new("velocity_flat", 3)
    };
    Sim::new(&options).unwrap()
}

fn pull(sim: &mut Sim, force: [f32; 3], torque: [f32; 3]) {
    let world = sim.world_mut();
    for mut wrench in world.query::<&mut ExternalWrench>().iter_mut(world) {
        *wrench = ExternalWrench { force, torque };
    }
}

#[test]
fn momentum_grows_by_the_force() {
    for engine in ["articulated", "avian"] {
        let mut sim = sim(engine, &[]);
        // up and forward, away from the ground
        let force = [6.0, -3.0, 20.0];
        pull(&mut sim, force, [0.0; 3]);
        let still = vec![0.0; sim.batch().actions.len()];
        for t in 1..=5 {
            sim.step(&still).unwrap();
            let seconds = 0.02 * t as f32;
            let world = sim.world_mut();
            let mut query = world.query::<(&Body, &BaseVelocity, &JointState)>();
            for (body, velocity, joints) in query.iter(world) {
                let mass: f32 = body.0.mass.iter().sum();
                // the legs hang on springs and swing a little: what is left of the base's velocity
                // is theirs
                let swing = joints.velocity.iter().map(|v| v.abs()).fold(0.0, f32::max);
                for axis in 0..3 {
                    let expected = force[axis] * seconds / mass;
                    let error = (velocity.linear[axis] - expected).abs();
                    let slack = 0.02 * seconds + 0.25 * swing;
                    assert!(
                        error < slack,
                        "{engine}, step {t}, axis {axis}: {} is not {expected}",
                        velocity.linear[axis]
                    );
                }
            }
        }
    }
}

#[test]
fn both_engines_agree_on_a_force_and_a_torque() {
    let (mut a, mut b) = (sim("articulated", &[]), sim("avian", &[]));
    for sim in [&mut a, &mut b] {
        pull(sim, [5.0, 8.0, 30.0], [1.0, -2.0, 1.5]);
        let still = vec![0.0; sim.batch().actions.len()];
        (0..5).for_each(|_| sim.step(&still).unwrap());
    }
    let read = |sim: &mut Sim| {
        let world = sim.world_mut();
        world.query::<&BaseVelocity>().iter(world).map(|v| (v.linear, v.angular)).collect::<Vec<_>>()
    };
    for ((linear, angular), (other_linear, other_angular)) in read(&mut a).into_iter().zip(read(&mut b)) {
        let turned = angular.iter().map(|w| w.abs()).fold(0.0, f32::max);
        assert!(turned > 0.1, "the torque did nothing: {angular:?}");
        for axis in 0..3 {
            assert!((linear[axis] - other_linear[axis]).abs() < 0.02, "{linear:?} {other_linear:?}");
            assert!((angular[axis] - other_angular[axis]).abs() < 0.1 * turned, "{angular:?} {other_angular:?}");
        }
    }
}

fn wrenches(sim: &mut Sim) -> Vec<ExternalWrench> {
    let world = sim.world_mut();
    let mut rows: Vec<_> = world.query::<(&EnvId, &ExternalWrench)>().iter(world).map(|(id, w)| (id.0, *w)).collect();
    rows.sort_by_key(|(id, _)| *id);
    rows.into_iter().map(|(_, wrench)| wrench).collect()
}

#[test]
fn a_wrench_holds_for_the_episode_or_until_the_next_one() {
    let on = "events.base_external_force_torque.enabled=true";
    let mut held = sim("articulated", &[on]);
    let still = vec![0.0; held.batch().actions.len()];
    let first = wrenches(&mut held);
    assert!(first.iter().all(|w| *w != ExternalWrench::default()));
    (0..10).for_each(|_| held.step(&still).unwrap());
    assert_eq!(wrenches(&mut held), first);
    held.reset(None, Some(&[false, true, false])).unwrap();
    let after = wrenches(&mut held);
    assert_eq!([0, 1, 2].map(|env| after[env] == first[env]), [true, false, true]);

    let often = [
        "events.base_external_force_torque.mode=interval",
        on,
        "events.base_external_force_torque.interval_range_s=[0.09, 0.09]",
    ];
    let mut changing = sim("articulated", &often);
    assert!(wrenches(&mut changing).iter().all(|w| *w == ExternalWrench::default()));
    let mut seen = vec![wrenches(&mut changing)[0]];
    for _ in 0..20 {
        changing.step(&still).unwrap();
        let now = wrenches(&mut changing)[0];
        if seen.last() != Some(&now) {
            seen.push(now);
        }
    }
    assert_eq!(seen.len(), 1 + 4, "drawn every fifth step of twenty");
    // a task's own range in place of the robot's
    let ranges = ["events.base_external_force_torque.force_range=[2.0, 3.0]", on];
    let mut own = sim("articulated", &ranges);
    assert!(wrenches(&mut own).iter().all(|w| w.force.iter().all(|f| (2.0..=3.0).contains(f))));
}
