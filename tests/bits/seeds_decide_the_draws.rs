//! The seed, the robot and the env's place among that robot's envs decide what is drawn for it.

use polypod::components::{Command, EnvId};
use polypod::{Error, Sim, SimOptions};

use crate::common::{ROBOTS, assert_all_same, assert_same, busy, env_bits, step};

/// Heading commands: drawn at every reset.
fn headings(sim: &mut Sim) -> Vec<f32> {
    let world = sim.world_mut();
    world.query::<(&EnvId, &Command)>().iter(world).sort::<&EnvId>().map(|(_, command)| command.heading).collect()
}

fn seeded(seed: u64) -> Sim {
    Sim::new(&SimOptions { seed, ..busy(&ROBOTS, 24) }).unwrap()
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let (mut a, mut b) = (seeded(3), seeded(3));
    assert!(a.snapshot().unwrap() == b.snapshot().unwrap());
    for t in 0..80 {
        assert_all_same(&mut a, &mut b, &format!("step {t}"));
        step(&mut a, t);
        step(&mut b, t);
    }
    assert!(a.snapshot().unwrap() == b.snapshot().unwrap());
}

#[test]
fn another_seed_gives_other_draws_in_every_env() {
    let (mut a, mut b) = (seeded(3), seeded(4));
    for (env, (x, y)) in env_bits(&mut a).iter().zip(&env_bits(&mut b)).enumerate() {
        assert_ne!(x, y, "env {env}");
    }
    let (of_a, of_b) = (headings(&mut a), headings(&mut b));
    assert!(of_a.iter().zip(&of_b).all(|(x, y)| x != y));
    let mut distinct = of_a;
    distinct.sort_by(f32::total_cmp);
    distinct.dedup();
    assert_eq!(distinct.len(), 24, "two envs share their draws");
}

#[test]
fn a_seeded_reset_is_a_new_simulation() {
    let (mut old, mut new) = (seeded(3), seeded(4));
    (0..25).for_each(|t| step(&mut old, t));
    old.set_commands(Some(&[0.5; 3 * 24])).unwrap();
    old.reset(Some(4), None).unwrap();
    assert_eq!(old.seed(), 4);
    for t in 0..80 {
        step(&mut old, t);
        step(&mut new, t);
        assert_all_same(&mut old, &mut new, &format!("step {t}"));
    }
}

#[test]
fn a_reset_without_a_seed_goes_on_with_the_streams() {
    let (mut sim, mut anew) = (seeded(3), seeded(3));
    sim.reset(None, None).unwrap();
    assert!(env_bits(&mut sim).iter().zip(&env_bits(&mut anew)).all(|(a, b)| a != b));

    let mut twin = seeded(3);
    twin.reset(None, None).unwrap();
    assert_all_same(&mut sim, &mut twin, "after a second reset");

    let mut mask = [false; 24];
    mask[7] = true;
    sim.reset(None, Some(&mask)).unwrap();
    let (before, after) = (headings(&mut twin), headings(&mut sim));
    for env in 0..24 {
        assert_eq!(before[env] != after[env], mask[env], "env {env}");
    }
    assert!(matches!(sim.reset(Some(1), Some(&mask)), Err(Error::Argument { element: "seed", .. })));
}

#[test]
fn a_further_env_or_robot_leaves_the_draws_of_the_others() {
    let (mut eight, mut nine) =
        (Sim::new(&busy(&["unitree_a1"], 8)).unwrap(), Sim::new(&busy(&["unitree_a1"], 9)).unwrap());
    let (mut seven_robots, mut eight_robots) =
        (Sim::new(&busy(&ROBOTS[..7], 14)).unwrap(), Sim::new(&busy(&ROBOTS, 16)).unwrap());
    for t in 0..40 {
        assert_same(&mut eight, 0..8, &mut nine, 0..8, &format!("an env more, step {t}"));
        assert_same(&mut seven_robots, 0..14, &mut eight_robots, 0..14, &format!("a robot more, step {t}"));
        for sim in [&mut eight, &mut nine, &mut seven_robots, &mut eight_robots] {
            step(sim, t);
        }
    }
}

#[test]
fn a_robot_added_in_front_leaves_the_draws_of_the_others() {
    // a ninth robot: a copy of another under its own name, first in the list
    let folder = std::env::temp_dir().join(format!("polypod-ninth-robot-{}", std::process::id()));
    std::fs::create_dir_all(folder.join("configs/robots")).unwrap();
    let config = "extends = \"unitree_go2\"\nname = \"ninth\"\ntitle = \"Ninth\"\n";
    std::fs::write(folder.join("configs/robots/ninth.toml"), config).unwrap();
    let nine: Vec<&str> = std::iter::once("ninth").chain(ROBOTS).collect();
    let mut before = Sim::new(&busy(&ROBOTS, 24)).unwrap();
    let mut after = Sim::new(&SimOptions { roots: vec![folder.clone()], ..busy(&nine, 27) }).unwrap();
    std::fs::remove_dir_all(folder).unwrap();
    assert_same(&mut before, 0..24, &mut after, 3..27, "made");
    for t in 0..3 {
        before.reset(None, None).unwrap();
        after.reset(None, None).unwrap();
        assert_same(&mut before, 0..24, &mut after, 3..27, &format!("reset {t}"));
    }
}
