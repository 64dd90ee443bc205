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
