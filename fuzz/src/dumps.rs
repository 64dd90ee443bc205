//! Input: a way to read the rest (one byte); then edits of a sound dump, or changes `task
//! KEY=VALUE` and `robot KEY=VALUE` of its configs, one on each line.

use std::path::PathBuf;
use std::sync::OnceLock;

use polypod::components::BaseVelocity;
use polypod::dump::Dump;
use polypod::engine::Motion;
use polypod::{Sim, SimOptions};

use super::edits::{edited, sealed, unsealed};
use super::folder::{folder, put};

/// Bytes of a sound dump.
fn base() -> &'static [u8] {
    static BASE: OnceLock<Vec<u8>> = OnceLock::new();
    BASE.get_or_init(|| {
        let dir: PathBuf = folder().join("dumps");
        let _ = std::fs::remove_dir_all(&dir);
        let mut sim = Sim::new(&SimOptions {
            robots: Some(vec!["unitree_a1".into()]),
            threads: Some(1),
            dump_dir: Some(dir.clone()),
            ..SimOptions::new("velocity_flat", 1)
        })
        .unwrap();
        let actions = vec![0.0; sim.batch().actions.len()];
        sim.step(&actions).unwrap();
        let world = sim.world_mut();
        world.query::<&mut BaseVelocity>().single_mut(world).unwrap().linear[0] = 900.0;
        sim.step(&actions).unwrap();
        let file = std::fs::read_dir(&dir).unwrap().next().unwrap().unwrap().path();
        std::fs::read(file).unwrap()
    })
}

/// Reads and replays the dump.
pub fn run(data: &[u8]) -> bool {
    let Some((&mode, rest)) = data.split_first() else {
        return false;
    };
    let dump = match mode {
        b'+' => changed(&String::from_utf8_lossy(rest)),
        b'=' => Dump::read(&put("dump.polypod", Some(rest))).ok(),
        _ => Dump::read(&put("dump.polypod", Some(&sealed(edited(unsealed(base()), rest))))).ok(),
    };
    let Some(dump) = dump else {
        return false;
    };
    match dump.replay(None) {
        Ok(replayed) => {
            let joints = replayed.morphology.model.joints.len();
            // `polypod-sim replay` prints these
            let state = &dump.state;
            printable(&state.before, joints);
            replayed.steps.iter().for_each(|step| printable(step, joints));
            assert!(state.targets.history[0].len() == joints && state.delay.0.len() == joints);
            true
        }
        Err(error) => {
            assert!(!error.to_string().is_empty());
            false
        }
    }
}

fn printable(motion: &Motion, joints: usize) {
    let lists = [&motion.joints.position, &motion.joints.velocity, &motion.effort.applied];
    assert!(lists.iter().all(|list| list.len() == joints), "{motion:?}");
}

/// A sound dump whose configs have other values.
fn changed(changes: &str) -> Option<Dump> {
    let mut dump = Dump::read(&put("dump.polypod", Some(base()))).ok()?;
    for change in changes.lines() {
        let (which, change) = change.split_once(' ')?;
        let (key, value) = change.split_once('=')?;
        let config = match which {
            "task" => &mut dump.task,
            "robot" => &mut dump.robot_config,
            _ => return None,
        };
        *config = with(config, key.trim(), value.trim());
    }
    Some(dump)
}

/// The text, with another value for the first key of that name.
fn with(config: &str, key: &str, value: &str) -> String {
    let mut done = false;
    let lines = config.lines().map(|line| {
        let is_it = !done && line.split_once('=').is_some_and(|(name, _)| name.trim() == key);
        done |= is_it;
        if is_it { format!("{key} = {value}\n") } else { format!("{line}\n") }
    });
    lines.collect()
}
