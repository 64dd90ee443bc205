//! Each termination of a task is counted by a separate bit, and a task with more terms than bits is
//! refused.

use bevy_ecs::prelude::*;
use polypod::morphology::Morphologies;
use polypod::systems::{CompiledTask, Logs, Registry, RobotView};
use polypod::{Sim, SimOptions};
use serde::Deserialize;

use crate::common;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoParams {}

/// The flat task with terms of one's own, none of which ends an episode but the last.
fn with_terms(count: usize) -> Result<Sim, polypod::Error> {
    let mut registry = Registry::builtin();
    let robots = Some(vec!["anymal_d".into()]);
    let mut lines = String::new();
    for k in 0..count {
        // names of terms live as long as the program
        let name: &'static str = Box::leak(format!("zz_term_{k:02}").into_boxed_str());
        let ends: fn(&NoParams, &RobotView, &polypod::components::Episode, u32) -> bool = match k + 1 == count {
            true => |_, _, _, _| true,
            false => |_, _, _, _| false,
        };
        registry.termination(name, false, ends);
        lines += &format!("[terminations.{name}]\n");
    }
    let task = common::extended_task(&format!("terms_{count}"), "velocity_flat", &lines);
    Sim::with_registry(&SimOptions { robots, ..SimOptions::new(task, 2) }, registry)
}

#[test]
fn the_last_of_as_many_terms_as_there_are_bits_is_counted() {
    let own = with_terms(1).unwrap().task().terminations.len() - 1;
    let most = 31 - own;
    let mut sim = with_terms(most).unwrap();
    assert_eq!(sim.task().terminations.len(), 31);
    sim.step(&vec![0.0; sim.batch().actions.len()]).unwrap();
    assert_eq!(sim.batch().terminated, [true; 2]);
    let name = format!("Episode_Termination/anymal_d/zz_term_{:02}", most - 1);
    let log = sim.world_mut().resource_scope(|world, mut logs: Mut<Logs>| {
        logs.take(world.resource::<CompiledTask>(), world.resource::<Morphologies>())
    });
    // both envs
    assert_eq!(log.get(&name), Some(&2.0), "{log:?}");
    assert!(log.iter().all(|(key, value)| !key.contains("illegal_state") || *value == 0.0), "{log:?}");
    let error = with_terms(most + 1).err().unwrap().to_string();
    assert!(error.contains("terminations: there are 32 terms") && error.contains("31 at most"), "{error}");
}
