//! polypod in an app that keeps its runner, its clock and its plugins:
//! `cargo run --release --example hosted`.
//!
//! Bevy's runner runs the app, and its clock the control steps: 50 in each second of the clock. A
//! plugin of the host lets the robots swing their legs, counts steps and ends the app.

use std::time::Duration;

use bevy_app::{App, AppExit, FixedUpdate, Plugin, ScheduleRunnerPlugin, Update};
use bevy_ecs::prelude::*;
use bevy_time::{Fixed, Time, TimePlugin};
use polypod::batch::Batch;
use polypod::components::{BasePose, EnvId, Robot};
use polypod::systems::PolypodPlugins;
use polypod::{HostedStep, SimOptions};

/// Control steps after which the app ends.
const STEPS: u32 = 50;

#[derive(Resource, Default)]
struct StepsTaken(u32);

struct SwingPlugin;

impl Plugin for SwingPlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<StepsTaken>();
        app.add_systems(FixedUpdate, (swing.before(HostedStep), count.after(HostedStep)));
        app.add_systems(Update, end_after_a_second);
    }
}

fn swing(mut batch: ResMut<Batch>, time: Res<Time>) {
    let wave = 0.3 * (8.0 * time.elapsed_secs()).sin();
    batch.actions.fill(wave);
}

fn count(mut taken: ResMut<StepsTaken>) {
    taken.0 += 1;
}

fn end_after_a_second(
    taken: Res<StepsTaken>,
    robots: Query<(&EnvId, &BasePose), With<Robot>>,
    mut exit: MessageWriter<AppExit>,
) {
    if taken.0 >= STEPS {
        for (env, pose) in &robots {
            println!("env {}: the base is {:.2} m high", env.0, pose.position[2]);
        }
        exit.write(AppExit::Success);
    }
}

fn main() -> AppExit {
    let mut app = App::new();
    app.insert_resource(SimOptions {
        robots: Some(vec!["unitree_go2".into(), "anymal_d".into()]),
        ..SimOptions::new("velocity_flat_play", 4)
    });
    app.insert_resource(Time::<Fixed>::from_seconds(0.02));
    app.add_plugins((ScheduleRunnerPlugin::run_loop(Duration::from_millis(5)), TimePlugin));
    app.add_plugins((PolypodPlugins::in_schedule(FixedUpdate), SwingPlugin));
    app.run()
}
