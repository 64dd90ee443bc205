//! A batch of different bodies has the slots of all of them. A robot's missing slots are zero
//! wherever they are seen, an action for them does nothing, and no robot notices which others are
//! there.

use std::path::Path;

use polypod::dynamics::lanes::Simd;
use polypod::robot::Slot;
use polypod::systems::StateField;
use polypod::{Sim, SimOptions};

use crate::common::{self, busy, env_bits};

/// Bodies on two, four and six legs, with 8 to 20 joints.
const BODIES: [&str; 6] = ["small_biped", "unitree_go2", "small_hexapod", "small_humanoid", "small_quadruped", "spot"];
const EACH: usize = 5;
const STEPS: usize = 60;

fn options(robots: &[&str]) -> SimOptions {
    let mut options = busy(robots, EACH * robots.len());
    options.roots = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/bodies")];
    options
}

fn sim(robots: &[&str]) -> Sim {
    Sim::new(&options(robots)).unwrap_or_else(|error| panic!("{error}"))
}

/// Actions that depend on the robot's name, the env's place in its block and the slot's name alone;
/// those of absent slots are drawn from another stream.
fn actions(sim: &Sim, t: usize, absent: u64) -> Vec<f32> {
    let width = sim.batch().num_actions;
    let number = |slot: Slot| 100 * slot.role as usize + 10 * slot.place as usize + usize::from(slot.nth);
    let mut actions = vec![0.0; sim.batch().actions.len()];
    for (index, robot) in sim.morphologies().iter().enumerate() {
        let mask = robot.action_mask(width);
        for env in sim.env_ids(index) {
            for (column, &slot) in sim.slots().joints.iter().enumerate() {
                let (stream, scale) = if mask[column] { (0, 1.0) } else { (absent, 100.0) };
                let place = env - sim.env_ids(index).start;
                actions[env * width + column] = scale * common::noise(stream, place, t, number(slot));
            }
        }
    }
    actions
}

/// The bits of the envs of a robot, without what its observations lack.
fn own_bits(sim: &mut Sim, index: usize) -> Vec<Vec<u32>> {
    let (envs, width) = (sim.env_ids(index), sim.batch().num_obs);
    let mask = sim.task().observation_mask(&sim.morphologies()[index]);
    let final_at = width + 4;
    let has_final: Vec<bool> = envs.clone().map(|env| sim.batch().has_final[env]).collect();
    let kept = |at: usize, has_final: bool| match at {
        _ if at < width => mask[at],
        _ if has_final && (final_at..final_at + width).contains(&at) => mask[at - final_at],
        _ => true,
    };
    let all = env_bits(sim);
    let rows = all[envs].iter().zip(has_final);
    rows.map(|(row, has_final)| {
        row.iter().enumerate().filter(|(at, _)| kept(*at, has_final)).map(|(_, bits)| *bits).collect()
    })
    .collect()
}

#[test]
fn columns_are_the_union_of_the_robots_slots() {
    let quadrupeds = sim(&["unitree_go2", "spot"]);
    assert_eq!(quadrupeds.slots().joint_names(), polypod::robot::CANONICAL_JOINT_NAMES);
    assert_eq!(quadrupeds.slots().feet_names(), polypod::robot::LEGS);
    assert!(quadrupeds.action_mask().iter().all(|has| *has));

    let mixed = sim(&BODIES);
    let names = mixed.slots().joint_names();
    assert_eq!(names[..12], polypod::robot::CANONICAL_JOINT_NAMES);
    assert_eq!(names.len(), 12 + 18 + 20);
    assert_eq!(mixed.slots().feet_names(), ["LF", "LM", "LH", "RF", "RM", "RH", "L", "R"]);
    let mask = mixed.action_mask();
    let joints: Vec<usize> = (0..BODIES.len())
        .map(|index| mask[index * EACH * names.len()..][..names.len()].iter().filter(|has| **has).count())
        .collect();
    assert_eq!(joints, [8, 12, 18, 20, 8, 12]);
    // the biped's slots are some of the humanoid's
    let slots = |index: usize| &mixed.morphologies()[index].roles.slots;
    assert!(slots(0).iter().all(|slot| slots(3).contains(slot)));
}

#[test]
fn an_action_in_a_padded_slot_changes_nothing() {
    let (mut a, mut b) = (sim(&BODIES), sim(&BODIES));
    for t in 0..STEPS {
        let (left, right) = (actions(&a, t, 1), actions(&b, t, 2));
        assert_ne!(left, right);
        a.step(&left).unwrap();
        b.step(&right).unwrap();
        assert_eq!(a.batch().actions, b.batch().actions);
    }
    assert!(a.snapshot().unwrap() == b.snapshot().unwrap());
}

#[test]
fn what_a_robot_lacks_is_zero() {
    let mut sim = sim(&BODIES);
    let (num_obs, num_actions) = (sim.batch().num_obs, sim.batch().num_actions);
    let mask = sim.action_mask();
    let observed: Vec<Vec<bool>> = sim.morphologies().iter().map(|robot| sim.task().observation_mask(robot)).collect();
    let mut finals = 0;
    for t in 0..STEPS {
        let actions = actions(&sim, t, 1);
        sim.step(&actions).unwrap();
        let batch = sim.batch();
        for env in 0..batch.num_envs {
            let observed = &observed[env / EACH];
            let rows = [(&batch.observations, true), (&batch.final_observations, batch.has_final[env])];
            finals += usize::from(batch.has_final[env]);
            for (rows, _) in rows.into_iter().filter(|(_, valid)| *valid) {
                for (at, value) in rows[env * num_obs..][..num_obs].iter().enumerate() {
                    assert!(observed[at] || value.to_bits() == 0, "env {env}: number {at} is {value}");
                }
            }
            let actions = &batch.actions[env * num_actions..][..num_actions];
            assert!(actions.iter().zip(&mask[env * num_actions..]).all(|(x, has)| *has || *x == 0.0));
        }
        for field in StateField::ALL {
            let width = sim.state_width(field);
            let mut out = vec![f32::NAN; width * sim.num_envs()];
            sim.state(field, &mut out).unwrap();
            assert!(out.iter().all(|x| x.is_finite()), "{}", field.name());
            if width == num_actions {
                let absent = out.iter().zip(&mask).filter(|(_, has)| !**has);
                assert!(absent.clone().all(|(x, _)| x.to_bits() == 0), "{}", field.name());
            }
        }
    }
    assert!(finals > 10, "{finals} episodes ended");
    // feet, while no robot has restarted
    let mut sim = self::sim(&BODIES);
    sim.step(&vec![0.0; sim.batch().actions.len()]).unwrap();
    let width = sim.state_width(StateField::FeetPos);
    let mut feet = vec![0.0; width * sim.num_envs()];
    sim.state(StateField::FeetPos, &mut feet).unwrap();
    let present = |env: usize| feet[env * width..][..width].chunks(3).map(|p| p[2] != 0.0).collect::<Vec<_>>();
    assert_eq!(present(0), [false, false, false, false, false, false, true, true]);
    assert_eq!(present(EACH), [true, false, true, true, false, true, false, false]);
}

#[test]
fn a_robot_does_not_notice_which_others_are_there() {
    let mut mixed = sim(&BODIES);
    let mut alone: Vec<Sim> = BODIES.iter().map(|robot| sim(&[robot])).collect();
    let mut reversed = sim(&BODIES.into_iter().rev().collect::<Vec<_>>());
    for t in 0..STEPS {
        for sim in alone.iter_mut().chain([&mut mixed, &mut reversed]) {
            let actions = actions(sim, t, 3);
            sim.step(&actions).unwrap();
        }
        for (index, alone) in alone.iter_mut().enumerate() {
            let (alone, name) = (own_bits(alone, 0), BODIES[index]);
            assert!(own_bits(&mut mixed, index) == alone, "{name}, step {t}");
            assert!(own_bits(&mut reversed, BODIES.len() - 1 - index) == alone, "{name}, step {t}, reversed");
        }
    }
}

#[test]
fn slots_of_no_robot_change_nothing() {
    let mut alone = sim(&["small_biped"]);
    let known = SimOptions { slots: sim(&BODIES).slots().joint_names(), ..options(&["small_biped"]) };
    let mut wide = Sim::new(&known).unwrap();
    assert_eq!((wide.batch().num_actions, alone.batch().num_actions), (50, 8));
    for t in 0..STEPS {
        for sim in [&mut alone, &mut wide] {
            let actions = actions(sim, t, 3);
            sim.step(&actions).unwrap();
        }
        assert!(own_bits(&mut wide, 0) == own_bits(&mut alone, 0), "step {t}");
    }
    let snapshot = wide.snapshot().unwrap();
    assert!(alone.restore(&snapshot).is_err());
    wide.restore(&snapshot).unwrap();
    let unknown = SimOptions { slots: vec!["L_TOOTH".into()], ..options(&["small_biped"]) };
    let error = Sim::new(&unknown).err().unwrap().to_string();
    assert!(error.contains("L_TOOTH"), "{error}");
}

#[test]
fn threads_and_instruction_sets_change_no_bits() {
    let mut first: Option<Vec<Vec<u32>>> = None;
    for (threads, simd) in [(1, None), (3, None), (1, Some(Simd::Portable))] {
        let mut sim = Sim::new(&SimOptions { threads: Some(threads), simd, ..options(&BODIES) }).unwrap();
        for t in 0..STEPS {
            let actions = actions(&sim, t, 1);
            sim.step(&actions).unwrap();
        }
        let bits = env_bits(&mut sim);
        assert!(first.get_or_insert_with(|| bits.clone()) == &bits, "{threads} threads, {simd:?}");
    }
}

#[test]
fn a_snapshot_of_a_mixed_batch_goes_on_exactly() {
    let mut sim = sim(&BODIES);
    for t in 0..20 {
        let actions = actions(&sim, t, 1);
        sim.step(&actions).unwrap();
    }
    let snapshot = sim.snapshot().unwrap();
    let mut runs = (0..2).map(|_| {
        sim.restore(&snapshot).unwrap();
        for t in 20..STEPS {
            let actions = actions(&sim, t, 1);
            sim.step(&actions).unwrap();
        }
        sim.snapshot().unwrap()
    });
    let (first, second) = (runs.next().unwrap(), runs.next().unwrap());
    drop(runs);
    assert!(first == second);
    // another simulation continues with the same bits
    let mut other = self::sim(&BODIES);
    other.restore(&snapshot).unwrap();
    for t in 20..STEPS {
        let actions = actions(&other, t, 1);
        other.step(&actions).unwrap();
    }
    assert!(other.snapshot().unwrap() == first);
}
