//! What happens in an env depends on the seed, the env's number, its robot and its actions, and on no other env.

mod common;

use common::{assert_same, busy, step, step_with};
use polypod::Sim;

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

#[test]
fn the_actions_of_others_change_nothing() {
    let (mut a, mut b) = (sim(&["spot"], 40), sim(&["spot"], 40));
    let is_watched = |env: usize| env.is_multiple_of(3);
    for t in 0..STEPS {
        step(&mut a, t);
        step_with(&mut b, t, |env| u64::from(!is_watched(env)));
        for env in (0..40).filter(|&env| is_watched(env)) {
            assert_same(&mut a, env..env + 1, &mut b, env..env + 1, &format!("step {t}"));
        }
    }
    assert_ne!(common::env_bits(&mut a)[1], common::env_bits(&mut b)[1], "the others' actions must have differed");
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
fn the_place_in_the_pack_changes_nothing() {
    // env 20 is the sixth of its robot in one simulation and the first in the other
    let (mut a, mut b) = (sim(&["unitree_a1", "spot"], 30), sim(&["unitree_a1", "anymal_d", "spot"], 30));
    assert_eq!((a.index_in_block(20), b.index_in_block(20)), (5, 0));
    for t in 0..STEPS {
        step(&mut a, t);
        step(&mut b, t);
        assert_same(&mut a, 20..30, &mut b, 20..30, &format!("step {t}"));
    }
}

#[test]
fn every_lane_gives_the_same_bits() {
    const ENV: usize = 39;
    const MOST_LANES: usize = 16;
    // the fewer envs there are, the later in its robot's block is this one
    let mut sims: Vec<Sim> = (0..MOST_LANES).map(|place| sim(&["unitree_a1", "spot"], 2 * (ENV - place))).collect();
    for (place, sim) in sims.iter().enumerate() {
        assert!(sim.env_ids(1).contains(&ENV) && sim.simd().lanes() <= MOST_LANES);
        assert_eq!(sim.index_in_block(ENV), place);
    }
    for t in 0..60 {
        let (first, others) = sims.split_first_mut().unwrap();
        step(first, t);
        for (place, other) in (1..).zip(others) {
            step(other, t);
            assert_same(first, ENV..ENV + 1, other, ENV..ENV + 1, &format!("place {place}, step {t}"));
        }
    }
}
