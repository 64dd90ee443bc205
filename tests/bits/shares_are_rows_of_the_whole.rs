//! Shares of the envs, each in a separate process, are rows of the whole batch, bit for bit: after
//! resets, randomisation and curricula too; and their snapshots are the snapshot of the whole.

use std::ops::Range;

use polypod::components::{EnvId, EnvOrigin};
use polypod::snapshot::join;
use polypod::{Sim, SimOptions};

use crate::common::{ROBOTS, busy, env_bits, noise};

/// One control step whose actions depend on the env's number in the whole batch.
fn step(sim: &mut Sim, t: usize) {
    let (first, width) = (sim.share().envs.start, sim.batch().num_actions);
    let actions: Vec<f32> = (0..sim.batch().actions.len()).map(|i| noise(0, first + i / width, t, i % width)).collect();
    sim.step(&actions).unwrap();
}

/// The bits of each env, and its tile.
fn bits_of(sim: &mut Sim) -> Vec<Vec<u32>> {
    let mut bits = env_bits(sim);
    let world = sim.world_mut();
    for (env, origin) in world.query::<(&EnvId, &EnvOrigin)>().iter(world) {
        let row = &mut bits[env.0 as usize];
        row.extend([origin.terrain_level, origin.terrain_column]);
        row.extend(origin.position.map(f32::to_bits));
    }
    bits
}

fn shares_of(options: &SimOptions, cuts: &[usize]) -> Vec<Sim> {
    let ends: Vec<usize> = [&[0][..], cuts, &[options.num_envs]].concat();
    let share = |ends: &[usize]| Sim::new(&SimOptions { share: Some(ends[0]..ends[1]), ..options.clone() }).unwrap();
    ends.windows(2).map(share).collect()
}

/// Steps the whole and its shares; `cuts` are where shares end.
fn check(options: &SimOptions, cuts: &[usize], steps: Range<usize>) {
    let (mut whole, mut shares) = (Sim::new(options).unwrap(), shares_of(options, cuts));
    let same = |whole: &mut Sim, shares: &mut [Sim], when: &str| {
        let joined: Vec<_> = shares.iter_mut().flat_map(bits_of).collect();
        assert!(bits_of(whole) == joined, "{when}");
    };
    same(&mut whole, &mut shares, "at the start");
    for t in steps.clone() {
        step(&mut whole, t);
        shares.iter_mut().for_each(|share| step(share, t));
        same(&mut whole, &mut shares, &format!("step {t}"));
    }
    let snapshots: Vec<_> = shares.iter_mut().map(|share| share.snapshot().unwrap()).collect();
    let joined = join(&snapshots).unwrap();
    assert!(joined == whole.snapshot().unwrap(), "the snapshots");

    // other shares go on with it
    let mut others = shares_of(options, &[options.num_envs / 2]);
    others.iter_mut().for_each(|share| share.restore(&joined).unwrap());
    for t in steps.end..steps.end + 10 {
        step(&mut whole, t);
        others.iter_mut().for_each(|share| step(share, t));
        same(&mut whole, &mut others, &format!("step {t} after restoring"));
    }
    let logs: Vec<_> = others.iter_mut().map(|share| share.take_logs().unwrap()).collect();
    others[0].add_logs(&logs[0]).unwrap();
    others[0].add_logs(&logs[1]).unwrap();
    let joined = join(&others.iter_mut().map(|share| share.snapshot().unwrap()).collect::<Vec<_>>()).unwrap();
    assert!(joined == whole.snapshot().unwrap(), "statistics that the first share has of all");
}

#[test]
fn shares_cut_robots_blocks_in_two() {
    // the last share has one robot, and some have no env of a robot
    let mut options = busy(&ROBOTS, 53);
    options.overrides.push("events.physics_material.mode=startup".into());
    check(&options, &[17, 20, 48], 0..70);
}

#[test]
fn shares_of_a_terrain_keep_their_tiles() {
    let overrides = ["sim.episode_length_s=1.2", "scene.terrain.num_rows=4", "scene.terrain.num_cols=8"];
    let options = SimOptions {
        robots: Some(vec!["anymal_d".to_string(), "unitree_go2".to_string(), "spot".to_string()]),
        seed: 11,
        threads: Some(1),
        overrides: overrides.map(String::from).to_vec(),
        ..SimOptions::new("velocity_rough", 31)
    };
    check(&options, &[9, 14], 0..80);
    let mut contiguous = options;
    contiguous.overrides.push("scene.terrain.columns=contiguous".into());
    check(&contiguous, &[16], 0..3);
}

#[test]
fn shares_of_avians_world_too() {
    let mut options = busy(&["unitree_a1", "spot"], 10);
    options.overrides.extend(["physics.engine=avian", "scene.placement=global"].map(String::from));
    check(&options, &[3, 7], 0..12);
}

#[test]
fn a_reset_with_a_seed_is_the_same_for_shares() {
    let options = busy(&ROBOTS, 24);
    let (mut whole, mut shares) = (Sim::new(&options).unwrap(), shares_of(&options, &[10]));
    for t in 0..5 {
        step(&mut whole, t);
        shares.iter_mut().for_each(|share| step(share, t));
    }
    whole.reset(Some(99), None).unwrap();
    shares.iter_mut().for_each(|share| share.reset(Some(99), None).unwrap());
    let joined: Vec<_> = shares.iter_mut().flat_map(bits_of).collect();
    assert!(bits_of(&mut whole) == joined);
}

#[test]
fn what_is_no_share_is_refused() {
    let options = busy(&["spot"], 8);
    for share in [3..3, 5..9, Range { start: 6, end: 2 }] {
        let refused = Sim::new(&SimOptions { share: Some(share), ..options.clone() }).err().unwrap();
        assert!(refused.to_string().contains("share"), "{refused}");
    }
    let mut shares = shares_of(&options, &[3]);
    let snapshots: Vec<_> = shares.iter_mut().map(|share| share.snapshot().unwrap()).collect();
    assert!(join(&[&snapshots[1], &snapshots[0]]).unwrap_err().to_string().contains("in order"));
    assert!(join(&[] as &[Vec<u8>]).is_err() && join(&[[1, 2, 3]]).is_err());
    let refused = shares[0].restore(&snapshots[1]).unwrap_err().to_string();
    assert!(refused.contains("from env 3 on"), "{refused}");
    assert!(shares[0].add_logs(&[7; 40]).is_err());
}
