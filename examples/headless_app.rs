//! A Bevy app of one's own around the simulation: `cargo run --release --example headless_app`.
//!
//! A plugin gives every robot a motor temperature, a system warms it by the motors' efforts, and
//! the policy observes it.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use polypod::blocks::Blocks;
use polypod::components::{Episode, JointEffort, Robot};
use polypod::systems::{
    ControlStep, PipelineSet, PolypodPlugins, Setup, SetupSet, TermKind, TermSpec, add_observation,
};
use polypod::{Error, Sim, SimOptions};

/// Temperature of the motors above the air, K.
#[derive(Component, Default)]
struct MotorTemperature(f32);

struct TemperaturePlugin;

impl Plugin for TemperaturePlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(Setup, add_temperatures.after(SetupSet::Spawn).before(SetupSet::Engine));
        app.add_systems(ControlStep, warm_motors.in_set(PipelineSet::Sense));
        let spec = TermSpec::new(TermKind::Scalar, "100 K", "temperature of the motors above the air");
        add_observation::<MotorTemperature, Robot>(app, "motor_temperature", 1, spec, |temperature, out| {
            out[0] = 0.01 * temperature.0;
        });
    }
}

fn add_temperatures(mut commands: Commands, robots: Query<Entity, With<Robot>>) {
    for robot in &robots {
        commands.entity(robot).insert(MotorTemperature::default());
    }
}

/// Copper losses grow with the square of the effort; a new episode begins cold.
fn warm_motors(
    mut robots: Blocks<(&'static JointEffort, &'static mut MotorTemperature), Robot>,
    envs: Blocks<&'static Episode, polypod::components::Env>,
) -> Result {
    for block in robots.write()?.zip(envs.read()?) {
        let ((efforts, temperatures), episodes) = block.rows;
        for ((effort, temperature), episode) in efforts.iter().zip(temperatures).zip(episodes) {
            let losses: f32 = effort.applied.iter().map(|torque| torque * torque).sum();
            let before = if episode.fresh { 0.0 } else { temperature.0 };
            temperature.0 = 0.999 * before + 1e-5 * losses;
        }
    }
    Ok(())
}

fn main() -> std::result::Result<(), Error> {
    let mut app = App::empty();
    app.add_plugins((PolypodPlugins, TemperaturePlugin));
    app.insert_resource(SimOptions {
        robots: Some(vec!["unitree_go2".into(), "anymal_d".into()]),
        overrides: vec!["observations.policy=[{term=\"joint_pos_rel\"}, {term=\"motor_temperature\"}]".into()],
        ..SimOptions::new("velocity_flat_play", 8)
    });
    let mut sim = Sim::from_app(app)?;
    for _ in 0..100 {
        sim.step(&vec![0.0; sim.batch().actions.len()])?;
    }
    let batch = sim.batch();
    for (env, observation) in batch.observations.chunks(batch.num_obs).enumerate() {
        let robot = if sim.env_ids(0).contains(&env) { 0 } else { 1 };
        println!("env {env}: {:<12} {:.2} K", sim.morphologies()[robot].name(), 100.0 * observation[batch.num_obs - 1]);
    }
    Ok(())
}
