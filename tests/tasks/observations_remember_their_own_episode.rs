//! A term that remembers holds its env's last numbers, oldest first, and restarts with each
//! episode; a further group next to the policy's changes none of its bits.

use std::ops::Range;

use polypod::{Sim, SimOptions};

use crate::common::ROBOTS;

const ENVS: usize = 16;
const TERM: &str = "joint_pos_rel";
const STEPS: usize = 3;
const SHORT: &str = "sim.episode_length_s=0.2";

fn sim(overrides: &[&str], threads: usize) -> Sim {
    let overrides = overrides.iter().map(|text| (*text).to_owned()).collect();
    Sim::new(&SimOptions {
        overrides,
        threads: Some(threads),
        ..SimOptions::new("velocity_flat", ENVS.max(ROBOTS.len()))
    })
    .unwrap()
}

fn columns(sim: &Sim) -> Range<usize> {
    let terms = &sim.task().observations;
    let at = terms.iter().position(|term| term.name == TERM).unwrap();
    let start = terms[..at].iter().map(|term| term.size).sum();
    start..start + terms[at].size
}

fn numbers(sim: &Sim, rows: &[f32], env: usize) -> Vec<f32> {
    let width = sim.batch().num_obs;
    rows[env * width..(env + 1) * width][columns(sim)].to_vec()
}

fn actions(sim: &Sim, step: usize) -> Vec<f32> {
    (0..sim.batch().actions.len()).map(|i| (((i * 37 + step * 11) % 19) as f32 - 9.0) / 9.0).collect()
}

#[test]
fn what_is_remembered_is_what_was_observed() {
    let quiet = "observations.enable_noise=false";
    let history = format!("observations.policy.{TERM}.history_length={STEPS}");
    let mut plain = sim(&[quiet, SHORT], 1);
    let mut remembers = sim(&[quiet, SHORT, &history], 2);
    let observed = |sim: &Sim, env| numbers(sim, &sim.batch().observations, env);
    let mut past: Vec<_> = (0..ENVS).map(|env| vec![observed(&plain, env); STEPS]).collect();
    let mut ends = 0;
    for step in 0..40 {
        for sim in [&mut plain, &mut remembers] {
            let actions = actions(sim, step);
            sim.step(&actions).unwrap();
        }
        for (env, past) in past.iter_mut().enumerate() {
            if plain.batch().has_final[env] {
                ends += 1;
                past.remove(0);
                past.push(numbers(&plain, &plain.batch().final_observations, env));
                let last = numbers(&remembers, &remembers.batch().final_observations, env);
                assert_eq!(last, past.concat(), "step {step}, env {env}: the last observation");
                *past = vec![observed(&plain, env); STEPS];
            } else {
                past.remove(0);
                past.push(observed(&plain, env));
            }
            assert_eq!(observed(&remembers, env), past.concat(), "step {step}, env {env}");
        }
    }
    assert!(ends >= 3 * ENVS, "{ends} episodes have ended");
}

#[test]
fn another_group_changes_nothing_of_the_policys() {
    let critic = "observations.critic=[{term=\"base_lin_vel\", noise=0.0}, {term=\"feet_contact_force\"}]";
    let mut plain = sim(&[SHORT], 1);
    let mut more = sim(&[SHORT, critic], 2);
    assert_eq!(more.task().groups[1].name, "critic");
    let policy = more.task().groups[0].columns.clone();
    assert_eq!(policy, 0..plain.batch().num_obs);
    for step in 0..20 {
        for sim in [&mut plain, &mut more] {
            let actions = actions(sim, step);
            sim.step(&actions).unwrap();
        }
        let (own, width) = (plain.batch(), more.batch().num_obs);
        for (env, row) in own.observations.chunks(own.num_obs).enumerate() {
            assert_eq!(row, &more.batch().observations[env * width..][policy.clone()], "step {step}, env {env}");
        }
        assert_eq!(own.rewards, more.batch().rewards);
    }
}
