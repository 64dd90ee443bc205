//! Every robot of the library holds its default pose for 20 s of zero actions, or its config says that a policy has to
//! balance it.

use std::path::Path;

use polypod::config::Library;
use polypod::{Autoreset, Sim, SimOptions};

/// What a config says of a robot that falls.
const FALLS: &str = "It does not stand by itself";

#[test]
fn for_twenty_seconds() {
    let library = Library::new(Vec::new());
    let names: Vec<String> = library.robots().unwrap().into_iter().map(|robot| robot.name).collect();
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
    for (env, name) in names.iter().enumerate() {
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("configs/robots/{name}.toml"));
        let says = std::fs::read_to_string(config).unwrap().contains(FALLS);
        let fell = sim.batch().terminated[env];
        assert_eq!(fell, says, "{name}: {}", if fell { "it falls" } else { "it stands" });
    }
}
