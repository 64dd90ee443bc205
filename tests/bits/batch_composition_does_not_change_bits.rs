//! An env depends on the seed, its robot, its place among that robot's envs and its actions, and on
//! no other env or robot.

use bevy_ecs::component::{Component, Mutable};
use polypod::components::{Body, EnvId, EnvRng};
use polypod::dynamics::Parameters;
use polypod::{Sim, SimOptions};

use crate::common::{self, assert_same, busy, env_bits, step, step_with, turning};

const STEPS: usize = 120;

fn sim(robots: &[&str], num_envs: usize) -> Sim {
    Sim::new(&busy(robots, num_envs)).unwrap()
}

#[test]
fn more_envs_of_the_same_robot_change_nothing() {
    let (mut many, mut few) = (sim(&["spot"], 40), sim(&["spot"], 23));
    for t in 0..STEPS {
        step(&mut many, t);
        step(&mut few, t);
        assert_same(&mut many, 0..23, &mut few, 0..23, &format!("step {t}"));
    }
}

#[test]
fn an_env_alone_is_the_first_of_many() {
    for robot in ["spot", "anymal_d"] {
        let (mut alone, mut many) = (sim(&[robot], 1), sim(&[robot], 37));
        for t in 0..STEPS {
            step(&mut alone, t);
            step(&mut many, t);
            assert_same(&mut alone, 0..1, &mut many, 0..1, &format!("{robot}, step {t}"));
        }
    }
}

/// Every third env, whose neighbours differ.
fn is_watched(env: usize) -> bool {
    env.is_multiple_of(3)
}

/// The watched envs are the same.
fn assert_watched_same(a: &mut Sim, b: &mut Sim, t: usize) {
    let (a, b) = (env_bits(a), env_bits(b));
    for env in (0..a.len()).filter(|&env| is_watched(env)) {
        assert!(a[env] == b[env], "step {t}: env {env} differs");
    }
}

/// Steps two equal simulations, in one of which two of three envs act otherwise: the third does not
/// notice.
fn others_act_otherwise(options: &SimOptions) {
    let (mut a, mut b) = (Sim::new(options).unwrap(), Sim::new(options).unwrap());
    for t in 0..STEPS {
        step(&mut a, t);
        step_with(&mut b, t, |env| u64::from(!is_watched(env)));
        assert_watched_same(&mut a, &mut b, t);
    }
    assert_ne!(env_bits(&mut a)[1], env_bits(&mut b)[1], "the others' actions must have differed");
}

#[test]
fn the_actions_of_others_change_nothing() {
    others_act_otherwise(&busy(&["spot"], 40));
}

#[test]
fn the_actions_of_others_change_nothing_on_rough_ground() {
    // stairs, boxes and gaps of the hardest levels
    let overrides = ["scene.terrain.max_init_terrain_level=9", "sim.episode_length_s=1.2"];
    let options = SimOptions {
        robots: Some(vec!["anymal_d".to_string(), "unitree_go2".to_string()]),
        seed: 7,
        threads: Some(1),
        overrides: overrides.map(String::from).to_vec(),
        ..SimOptions::new("velocity_rough", 96)
    };
    others_act_otherwise(&options);
}

#[test]
fn other_robots_in_the_batch_change_nothing() {
    let (mut a, mut b) = (sim(&["anymal_c", "unitree_go2"], 32), sim(&["anymal_c", "spot"], 32));
    assert_eq!((a.env_ids(0), b.env_ids(0)), (0..16, 0..16));
    for t in 0..STEPS {
        step(&mut a, t);
        step(&mut b, t);
        assert_same(&mut a, 0..16, &mut b, 0..16, &format!("step {t}"));
    }
}

#[test]
fn robots_before_it_change_nothing() {
    // the same robot is first in one simulation and last in the other
    let (mut a, mut b) = (sim(&["spot", "unitree_a1"], 30), sim(&["unitree_a1", "anymal_d", "spot"], 45));
    assert_eq!((a.env_ids(0), b.env_ids(2)), (0..15, 30..45));
    for t in 0..STEPS {
        step_rows(&mut a, t, 0..15);
        step_rows(&mut b, t, 30..45);
        assert_same(&mut a, 0..15, &mut b, 30..45, &format!("step {t}"));
    }
}

/// Steps two equal simulations, in one of which two of three bodies are changed: the third does not
/// notice.
fn others_are_built_otherwise(options: &SimOptions, change: fn(&mut Parameters<f32>)) {
    let (mut a, mut b) = (Sim::new(options).unwrap(), Sim::new(options).unwrap());
    let world = b.world_mut();
    for (id, mut body) in world.query::<(&EnvId, &mut Body)>().iter_mut(world) {
        if !is_watched(id.0 as usize) {
            change(&mut body.0);
        }
    }
    for t in 0..STEPS {
        step(&mut a, t);
        step(&mut b, t);
        assert_watched_same(&mut a, &mut b, t);
    }
    assert_ne!(env_bits(&mut a)[1], env_bits(&mut b)[1], "the others must have moved otherwise");
}

#[test]
fn how_others_bounce_changes_nothing() {
    others_are_built_otherwise(&busy(&["spot"], 40), |body| body.restitution = 0.5);
}

#[test]
fn how_hard_others_are_to_turn_changes_nothing() {
    others_are_built_otherwise(&turning(busy(&["spot"], 40)), |body| {
        (body.torsional_friction, body.rolling_friction) = (0.0, 0.02);
    });
}

#[test]
fn how_long_others_legs_are_changes_nothing() {
    others_are_built_otherwise(&busy(&["spot"], 40), |body| {
        body.joint_offset.iter_mut().for_each(|offset| offset[2] *= 1.1)
    });
}

/// One control step in which the envs of `block` act by their place in it.
fn step_rows(sim: &mut Sim, t: usize, block: std::ops::Range<usize>) {
    let width = sim.batch().num_actions;
    let actions: Vec<f32> = (0..sim.batch().actions.len())
        .map(|i| {
            let env = i / width;
            let place = if block.contains(&env) { env - block.start } else { 1000 + env };
            common::noise(0, place, t, i % width)
        })
        .collect();
    sim.step(&actions).unwrap();
}

/// Gives env `to` the body and the random stream of env `from`, and begins new episodes.
fn transplant(sim: &mut Sim, from: usize, to: usize) {
    fn copy<C: Component<Mutability = Mutable> + Clone>(sim: &mut Sim, from: usize, to: usize) {
        let world = sim.world_mut();
        let mut query = world.query::<(&EnvId, &mut C)>();
        let found = query.iter(world).find(|(id, _)| id.0 as usize == from).map(|(_, c)| c.clone()).unwrap();
        let (_, mut target) = query.iter_mut(world).find(|(id, _)| id.0 as usize == to).unwrap();
        *target = found;
    }
    copy::<Body>(sim, from, to);
    copy::<EnvRng>(sim, from, to);
    sim.reset(None, None).unwrap();
}

#[test]
fn every_lane_gives_the_same_bits() {
    const MOST_LANES: usize = 16;
    // the first env's twin stands in each lane of the first pack, and in the second pack
    let mut sims: Vec<Sim> = (0..=MOST_LANES)
        .map(|place| {
            let mut sim = sim(&["spot"], MOST_LANES + 2);
            assert!(sim.simd().lanes() <= MOST_LANES);
            transplant(&mut sim, 0, place);
            sim
        })
        .collect();
    for t in 0..60 {
        for (place, sim) in sims.iter_mut().enumerate() {
            // both take the same actions, the others their own
            let width = sim.batch().num_actions;
            let actions: Vec<f32> = (0..sim.batch().actions.len())
                .map(|i| common::noise(0, if i / width == place { 0 } else { i / width }, t, i % width))
                .collect();
            sim.step(&actions).unwrap();
        }
        let (first, others) = sims.split_first_mut().unwrap();
        for (place, other) in (1..).zip(others) {
            assert_same(first, 0..1, other, place..place + 1, &format!("place {place}, step {t}"));
        }
    }
}
