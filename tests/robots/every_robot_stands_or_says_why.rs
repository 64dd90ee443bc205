//! Every robot of the library holds its default pose for 20 s of zero actions, or its config says
//! that a policy has to balance it.

use polypod::config::Library;
use polypod::{Autoreset, Sim, SimOptions};

#[test]
fn for_twenty_seconds() {
    let library = Library::new(Vec::new());
    let robots = library.robots().unwrap();
    let names: Vec<String> = robots.iter().map(|robot| robot.name.clone()).collect();
    assert!(names.len() >= 25);
    let mut sim = Sim::new(&SimOptions {
        robots: Some(names.clone()),
        seed: 1,
        autoreset: Autoreset::Disabled,
        overrides: vec!["sim.episode_length_s=30.0".into()],
        ..SimOptions::new("velocity_flat_legged_play", names.len())
    })
    .unwrap();
    let still = vec![0.0; sim.batch().actions.len()];
    for _ in 0..1000 {
        sim.step(&still).unwrap();
    }
    for (env, robot) in robots.iter().enumerate() {
        let fell = sim.batch().terminated[env];
        let verb = if fell { "falls" } else { "stands" };
        assert_eq!(fell, robot.needs_policy.is_some(), "{}: it {verb}; `needs_policy` in its config", robot.name);
    }
}
