//! The terrain curriculum reads how an episode ended: a reset is no end, and no robot is asked for
//! more than it had time for.

use polypod::components::{BasePose, EnvId, EnvOrigin, Episode};
use polypod::{Autoreset, Sim, SimOptions};

use crate::common;

const ENVS: usize = 40;

fn rough(autoreset: Autoreset, more: &[&str]) -> Sim {
    rough_with(autoreset, "", more)
}

/// The rough task with these lines, every robot in the middle of its tile and told to go at 1 m/s.
fn rough_with(autoreset: Autoreset, lines: &str, more: &[&str]) -> Sim {
    let mut overrides: Vec<String> =
        ["events.reset_base.x=[0.0, 0.0]", "events.reset_base.y=[0.0, 0.0]"].map(String::from).to_vec();
    overrides.extend(more.iter().map(|text| text.to_string()));
    let robots = Some(vec!["unitree_go2".into()]);
    let task = common::extended_task("levels", "velocity_rough", lines);
    let mut sim = Sim::new(&SimOptions { autoreset, overrides, robots, ..SimOptions::new(task, ENVS) }).unwrap();
    sim.set_commands(Some(&[1.0, 0.0, 0.0].repeat(ENVS))).unwrap();
    sim
}

fn levels(sim: &mut Sim) -> Vec<u32> {
    let world = sim.world_mut();
    let mut levels: Vec<_> =
        world.query::<(&EnvId, &EnvOrigin)>().iter(world).map(|(env, origin)| (*env, origin.terrain_level)).collect();
    levels.sort_unstable();
    levels.into_iter().map(|(_, level)| level).collect()
}

fn step(sim: &mut Sim) {
    sim.step(&[0.0; ENVS * 12]).unwrap();
}

fn lowered(levels: &[u32]) -> Vec<u32> {
    levels.iter().map(|level| level.saturating_sub(1)).collect()
}

#[test]
fn a_reset_in_mid_episode_changes_no_level() {
    for autoreset in [Autoreset::SameStep, Autoreset::NextStep, Autoreset::Disabled] {
        let mut sim = rough(autoreset, &[]);
        let before = levels(&mut sim);
        for _ in 0..3 {
            step(&mut sim);
            sim.reset(None, None).unwrap();
            step(&mut sim);
            let mask: Vec<bool> = (0..ENVS).map(|env| env % 3 == 0).collect();
            sim.reset(None, Some(&mask)).unwrap();
        }
        // long enough that its end would say something
        (0..60).for_each(|_| step(&mut sim));
        let now = levels(&mut sim);
        sim.reset(None, None).unwrap();
        assert_eq!(levels(&mut sim), now, "{autoreset:?}");
        assert_eq!(now, before, "{autoreset:?}");
    }
}

#[test]
fn a_termination_after_one_step_changes_no_level() {
    let mut sim = rough(Autoreset::Disabled, &[]);
    let before = levels(&mut sim);
    for _ in 0..3 {
        step(&mut sim);
        sim.terminate(&[true; ENVS]).unwrap();
        sim.reset(None, Some(&[true; ENVS])).unwrap();
    }
    assert_eq!(levels(&mut sim), before, "a caller's");
    // the same by a termination of the task, in all ways to reset
    for autoreset in [Autoreset::SameStep, Autoreset::NextStep] {
        let mut sim = rough_with(autoreset, "[terminations.root_height_below_minimum]\nminimum_height = 9.0", &[]);
        let before = levels(&mut sim);
        (0..6).for_each(|_| step(&mut sim));
        assert_eq!(levels(&mut sim), before, "{autoreset:?}");
    }
}

#[test]
fn a_late_start_is_asked_for_less() {
    // 100 of 1000 steps left, in which a robot told to go at 1 m/s has 2 s
    let after = |walked: f32| {
        let mut sim = rough(Autoreset::SameStep, &["terminations.base_contact.threshold=1e6"]);
        let before = levels(&mut sim);
        let last = i64::from(sim.task().max_episode_length);
        sim.set_episode_lengths(&[last - 100; ENVS]).unwrap();
        (0..99).for_each(|_| step(&mut sim));
        let world = sim.world_mut();
        for mut pose in world.query::<&mut BasePose>().iter_mut(world) {
            (pose.position[0], pose.position[1]) = (walked, 0.0);
        }
        step(&mut sim);
        assert!(sim.batch().truncated.iter().all(|ended| *ended));
        (before, levels(&mut sim))
    };
    let (before, now) = after(1.3);
    assert_eq!(now, before, "more than half of 2 m");
    let (before, now) = after(0.3);
    assert_eq!(now, lowered(&before), "less than half of 2 m");
}

#[test]
fn a_fall_is_asked_for_the_whole_episode_in_all_ways_to_reset() {
    for autoreset in [Autoreset::SameStep, Autoreset::NextStep, Autoreset::Disabled] {
        let mut sim = rough_with(autoreset, "[terminations.bad_orientation]\nlimit_angle = 1.0", &[]);
        let before = levels(&mut sim);
        (0..60).for_each(|_| step(&mut sim));
        assert!(!sim.batch().terminated.contains(&true));
        let world = sim.world_mut();
        for mut pose in world.query::<&mut BasePose>().iter_mut(world) {
            // it walked as it was told for 1.2 s, and fell over
            (pose.position[0], pose.position[1], pose.rotation) = (1.2, 0.0, [0.0, 1.0, 0.0, 0.0]);
            pose.position[2] += 1.0;
        }
        step(&mut sim);
        assert!(sim.batch().terminated.iter().all(|ended| *ended));
        match autoreset {
            Autoreset::SameStep => {}
            Autoreset::NextStep => step(&mut sim),
            Autoreset::Disabled => sim.reset(None, None).unwrap(),
        }
        assert_eq!(levels(&mut sim), lowered(&before), "{autoreset:?}");
        let world = sim.world_mut();
        assert!(world.query::<&Episode>().iter(world).all(|episode| episode.fresh && episode.lived == 0));
    }
}
