//! A reward term of one's own: `cargo run --release --example own_term`.
//!
//! Two kinds of robots hold their default pose for two seconds; printed is what the term gave each
//! of them.

use polypod::components::{EnvId, EpisodeSums};
use polypod::systems::{Registry, RobotView};
use polypod::{Error, Sim, SimOptions};
use serde::Deserialize;

/// Parameters, read from the term's table in the task.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BaseHeight {
    /// Height above the ground that is asked for, m.
    target_height: f32,
}

/// Squared deviation of the base's height, m^2.
fn base_height_squared(p: &BaseHeight, robot: &RobotView) -> f32 {
    let error = robot.base_height() - p.target_height;
    error * error
}

fn main() -> Result<(), Error> {
    let mut registry = Registry::builtin();
    registry.reward("base_height_squared", base_height_squared);

    let options = SimOptions {
        robots: Some(vec!["unitree_a1".into(), "unitree_go2".into()]),
        overrides: vec!["rewards.unitree.base_height_squared={weight=-10.0, target_height=0.3}".into()],
        ..SimOptions::new("velocity_flat_play", 64)
    };
    let mut sim = Sim::with_registry(&options, registry)?;
    let actions = vec![0.0; sim.batch().actions.len()];
    for _ in 0..100 {
        sim.step(&actions)?;
    }

    for robot in 0..sim.morphologies().len() {
        let Some(term) = sim.task().rewards[robot].iter().position(|term| term.name == "base_height_squared") else {
            continue;
        };
        let envs = sim.env_ids(robot);
        let world = sim.world_mut();
        let mut query = world.query::<(&EnvId, &EpisodeSums)>();
        let of_robot = query.iter(world).filter(|(env, _)| envs.contains(&(env.0 as usize)));
        let sum: f32 = of_robot.map(|(_, sums)| sums.terms[term]).sum();
        let mean = sum / envs.len() as f32;
        println!("{:<12} base_height_squared {mean:.5} in this episode so far", sim.morphologies()[robot].name());
    }
    Ok(())
}
