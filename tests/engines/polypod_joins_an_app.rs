//! polypod joins an app that keeps its runner, its clock, its error handler and its plugins.

use std::sync::Mutex;
use std::time::Duration;

use bevy_app::{App, AppExit, FixedUpdate, Plugin, ScheduleRunnerPlugin, Startup, Update};
use bevy_ecs::error::{BevyError, ErrorContext, FallbackErrorHandler};
use bevy_ecs::prelude::*;
use bevy_time::{Fixed, Time, TimePlugin, TimeUpdateStrategy};
use polypod::batch::Batch;
use polypod::components::{JointState, Robot};
use polypod::systems::PolypodPlugins;
use polypod::{Autoreset, HostedStep, Sim, SimOptions};

use crate::common::busy;

/// A plugin of the host: it moves the robots, and looks at them before and after each step.
struct Conductor;

#[derive(Resource, Default)]
struct Seen {
    steps: usize,
    robots: usize,
    moved: usize,
}

/// Actions of a control step.
fn action(step: usize, at: usize) -> f32 {
    0.3 * ((step * 31 + at) as f32).sin()
}

impl Plugin for Conductor {
    fn build(&self, app: &mut App) {
        app.init_resource::<Seen>();
        app.add_systems(Startup, |mut seen: ResMut<Seen>, robots: Query<&Robot>| seen.robots = robots.iter().count());
    }
}

fn conduct(mut batch: ResMut<Batch>, seen: Res<Seen>) {
    for (at, number) in batch.actions.iter_mut().enumerate() {
        *number = action(seen.steps, at);
    }
}

fn look(mut seen: ResMut<Seen>, robots: Query<&JointState, With<Robot>>) {
    seen.steps += 1;
    seen.moved = robots.iter().filter(|joints| joints.velocity.iter().any(|v| *v != 0.0)).count();
}

fn options() -> SimOptions {
    busy(&["spot", "anymal_d"], 6)
}

/// An app with Bevy's main schedule.
fn host(options: SimOptions) -> App {
    let mut app = App::new();
    app.insert_resource(options);
    app.add_plugins((TimePlugin, Conductor, PolypodPlugins::in_schedule(Update)));
    app.add_systems(Update, (conduct.before(HostedStep), look.after(HostedStep)));
    // as a runner does
    app.finish();
    app.cleanup();
    app
}

#[test]
fn a_host_steps_as_a_simulation_does() {
    let mut app = host(options());
    let mut sim = Sim::new(&options()).unwrap();
    for step in 0..30 {
        app.update();
        let actions: Vec<f32> = (0..sim.batch().actions.len()).map(|at| action(step, at)).collect();
        sim.step(&actions).unwrap();
        let (hosted, own) = (app.world().resource::<Batch>(), sim.batch());
        let bits = |numbers: &[f32]| numbers.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&hosted.observations), bits(&own.observations), "step {step}");
        assert_eq!(bits(&hosted.rewards), bits(&own.rewards), "step {step}");
        assert_eq!(hosted.terminated, own.terminated, "step {step}");
    }
    let seen = app.world().resource::<Seen>();
    assert_eq!((seen.steps, seen.robots, seen.moved), (30, 6, 6));
}

#[test]
fn the_runner_and_the_clock_are_the_hosts() {
    let mut app = App::new();
    app.insert_resource(options()).insert_resource(Time::<Fixed>::from_seconds(0.02));
    // each frame takes 50 ms of the host's clock: two or three control steps
    app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_millis(50)));
    let runner = ScheduleRunnerPlugin::run_loop(Duration::ZERO);
    app.add_plugins((runner, TimePlugin, Conductor, PolypodPlugins::in_schedule(FixedUpdate)));
    app.add_systems(FixedUpdate, (conduct.before(HostedStep), look.after(HostedStep)));
    let stop = |seen: Res<Seen>, time: Res<Time>, mut exit: MessageWriter<AppExit>| {
        if seen.steps >= 24 {
            assert!((0.4..0.7).contains(&time.elapsed_secs()), "{:?}", time.elapsed());
            exit.write(AppExit::Success);
        }
    };
    app.add_systems(Update, stop);
    assert_eq!(app.run(), AppExit::Success);
}

#[test]
fn failures_reach_the_handler_of_the_host() {
    static HEARD: Mutex<Vec<String>> = Mutex::new(Vec::new());
    fn hear(error: BevyError, _: ErrorContext) {
        HEARD.lock().unwrap().push(error.to_string().lines().next().unwrap_or_default().to_string());
    }
    let heard = || std::mem::take(&mut *HEARD.lock().unwrap());
    let mut app = host(options());
    app.insert_resource(FallbackErrorHandler(hear));
    app.update();
    assert_eq!(heard(), [""; 0]);
    // a system of the host fails
    let fails = |seen: Res<Seen>| -> Result { if seen.steps == 2 { Err("the host's own".into()) } else { Ok(()) } };
    app.add_systems(Update, fails.after(HostedStep).before(look));
    app.update();
    assert_eq!(heard(), [""; 0]);
    app.update();
    assert_eq!(heard(), ["the host's own"]);
    // a control step fails, and changes nothing
    let spoil = |mut batch: ResMut<Batch>, seen: Res<Seen>| {
        if seen.steps == 3 {
            batch.actions[7] = f32::NAN;
        }
    };
    app.add_systems(Update, spoil.after(conduct).before(HostedStep));
    let before = app.world().resource::<Batch>().observations.clone();
    app.update();
    let after = &app.world().resource::<Batch>().observations;
    assert_eq!(&before, after);
    let said = heard();
    assert!(matches!(&said[..], [error] if error.starts_with("actions: the action of env 0 for")), "{said:?}");
    app.update();
    assert_eq!(heard(), [""; 0]);
    assert_ne!(&before, &app.world().resource::<Batch>().observations);
}

#[test]
fn what_a_host_cannot_do_is_said() {
    static HEARD: Mutex<Vec<String>> = Mutex::new(Vec::new());
    fn hear(error: BevyError, _: ErrorContext) {
        HEARD.lock().unwrap().push(error.to_string().lines().next().unwrap_or_default().to_string());
    }
    let update = |mut app: App| {
        app.insert_resource(FallbackErrorHandler(hear));
        app.finish();
        app.cleanup();
        app.update();
        std::mem::take(&mut *HEARD.lock().unwrap())
    };
    let mut without = App::new();
    without.add_plugins((TimePlugin, PolypodPlugins::in_schedule(Update)));
    let said = update(without);
    assert!(said[0].starts_with("SimOptions: the app has none"), "{said:?}");
    assert!(said[1].starts_with("the host app: polypod is not set up"), "{said:?}");
    let mut dumps = App::new();
    dumps.insert_resource(SimOptions { dump_dir: Some("dumps".into()), ..options() });
    dumps.add_plugins((TimePlugin, PolypodPlugins::in_schedule(Update)));
    let said = update(dumps);
    assert!(said[0].starts_with("dump_dir: dumps are written by Sim alone"), "{said:?}");
    let mut never = App::new();
    never.insert_resource(SimOptions { autoreset: Autoreset::Disabled, ..options() });
    never.add_plugins((TimePlugin, PolypodPlugins::in_schedule(Update)));
    let said = update(never);
    assert!(said[0].starts_with("autoreset: a host app has no call that resets envs"), "{said:?}");
    assert!(said[1].starts_with("the host app: polypod is not set up"), "{said:?}");
}
