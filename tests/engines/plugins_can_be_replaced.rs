//! A user's systems run in the pipeline, in place of polypod's or in addition to them; their
//! failures are errors.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use bevy_app::{App, AppLabel, Plugin, PluginGroup, SubApp, SubApps, Update};
use bevy_ecs::prelude::*;
use bevy_time::TimePlugin;
use polypod::batch::Batch;
use polypod::blocks::Blocks;
use polypod::components::{BasePose, EnvId, Robot};
use polypod::systems::{
    ControlStep, FinitePlugin, NonFinite, PipelineSet, PolypodPlugins, RewardPlugin, SensePlugin, Setup, SetupSet,
};
use polypod::{Error, Sim, SimOptions};

use crate::common::{assert_all_same, busy, step};

fn app(options: SimOptions) -> App {
    let mut app = App::empty();
    app.insert_resource(options).add_plugins(PolypodPlugins);
    app
}

fn zeros(sim: &Sim) -> Vec<f32> {
    vec![0.0; sim.batch().actions.len()]
}

/// One plugin for all rewards: the height of the base.
struct HeightReward;

impl Plugin for HeightReward {
    fn build(&self, app: &mut App) {
        app.add_systems(ControlStep, reward_height.in_set(PipelineSet::Reward));
    }
}

fn reward_height(mut batch: ResMut<Batch>, robots: Blocks<&'static BasePose, Robot>) -> Result {
    for block in robots.read()? {
        for (env, pose) in block.envs.zip(block.rows) {
            batch.rewards[env] = pose.position[2];
        }
    }
    Ok(())
}

#[test]
fn an_app_of_all_plugins_is_the_simulation() {
    let options = busy(&["spot", "unitree_a1"], 20);
    let (mut one, mut other) = (Sim::new(&options).unwrap(), Sim::from_app(app(options)).unwrap());
    for t in 0..30 {
        step(&mut one, t);
        step(&mut other, t);
    }
    assert_all_same(&mut one, &mut other, "of an app");
}

#[test]
fn rewards_are_anothers() {
    let mut app = App::empty();
    app.insert_resource(SimOptions { robots: Some(vec!["spot".into()]), ..SimOptions::new("velocity_flat", 8) });
    app.add_plugins(PolypodPlugins.build().disable::<RewardPlugin>().add(HeightReward));
    let mut sim = Sim::from_app(app).unwrap();
    sim.step(&zeros(&sim)).unwrap();
    assert!(sim.batch().rewards.iter().all(|reward| (0.3..0.8).contains(reward)), "{:?}", sim.batch().rewards);
}

#[derive(AppLabel, Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Recorder;

/// Rewards that a sub-app has copied.
#[derive(Resource, Default)]
struct Copied(Vec<f32>);

/// Frames of the app so far.
#[derive(Resource, Default)]
struct Frames(u32);

/// A plugin with a sub-app, a system in the app's own schedule, and something that lives as long as
/// it does.
struct RecorderPlugin {
    _alive: Arc<()>,
}

impl Plugin for RecorderPlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<Frames>();
        app.add_systems(Update, |mut frames: ResMut<Frames>| frames.0 += 1);
        let mut recorder = SubApp::new();
        recorder.init_resource::<Copied>();
        recorder.set_extract(|from, to| to.resource_mut::<Copied>().0.clone_from(&from.resource::<Batch>().rewards));
        app.insert_sub_app(Recorder, recorder);
    }
}

/// Failures that the app's own handler was told.
static FAILURES: AtomicU32 = AtomicU32::new(0);

#[test]
fn an_app_stays_whole() {
    let alive = Arc::new(());
    let mut app = App::new();
    app.set_error_handler(|_, _| {
        FAILURES.fetch_add(1, Ordering::Relaxed);
    });
    app.add_systems(Update, || -> Result { Err("the recorder is full".into()) });
    let recorder = RecorderPlugin { _alive: alive.clone() };
    app.insert_resource(busy(&["spot"], 4)).add_plugins((TimePlugin, PolypodPlugins, recorder));
    let mut sim = Sim::from_app(app).unwrap();
    assert_eq!(Arc::strong_count(&alive), 2);
    // a simulation may go on in another thread
    std::thread::scope(|scope| {
        scope.spawn(|| {
            sim.step(&zeros(&sim)).unwrap();
            sim.with_app(SubApps::update);
            sim.step(&zeros(&sim)).unwrap();
        });
    });
    assert_eq!(sim.world().resource::<Frames>().0, 1);
    sim.with_app(SubApps::update);
    let rewards = sim.batch().rewards.clone();
    sim.with_app(|app| {
        assert!(app.main.is_plugin_added::<RecorderPlugin>());
        assert_eq!(app.main.world().resource::<Frames>().0, 2);
        let (_, recorder) = app.sub_apps.iter().next().unwrap();
        assert_eq!(recorder.world().resource::<Copied>().0, rewards);
    });
    assert_eq!(FAILURES.load(Ordering::Relaxed), 2);
    drop(sim);
    assert_eq!(Arc::strong_count(&alive), 1);
}

/// Counts how often its app is finished; it is not ready before the world says so.
struct LatePlugin(Arc<AtomicU32>);

#[derive(Resource)]
struct IsReady;

impl Plugin for LatePlugin {
    fn build(&self, _: &mut App) {}

    fn ready(&self, app: &App) -> bool {
        app.world().contains_resource::<IsReady>()
    }

    fn finish(&self, _: &mut App) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

#[test]
fn plugins_are_finished_once_and_when_they_are_ready() {
    let finished = Arc::new(AtomicU32::new(0));
    let with_plugin = || {
        let mut app = app(busy(&["spot"], 4));
        app.add_plugins(LatePlugin(finished.clone()));
        app
    };
    let error = Sim::from_app(with_plugin()).map(|_| ()).unwrap_err().to_string();
    assert!(error.starts_with("plugins: a plugin of the app is not ready"), "{error}");
    assert_eq!(finished.load(Ordering::Relaxed), 0);
    let mut late = with_plugin();
    late.insert_resource(IsReady);
    late.finish();
    late.cleanup();
    Sim::from_app(late).unwrap();
    assert_eq!(finished.load(Ordering::Relaxed), 1);
}

/// Steps so far, of each robot.
#[derive(Component, Default)]
struct Steps(u32);

#[test]
fn a_component_of_ones_own_lives_on_the_robots() {
    let mut app = app(busy(&["spot"], 6));
    let give = |mut commands: Commands, robots: Query<Entity, With<Robot>>| {
        robots.iter().for_each(|robot| {
            commands.entity(robot).insert(Steps::default());
        });
    };
    app.add_systems(Setup, give.after(SetupSet::Spawn).before(SetupSet::Engine));
    let count = |mut robots: Query<&mut Steps>| robots.iter_mut().for_each(|mut steps| steps.0 += 1);
    app.add_systems(ControlStep, count.in_set(PipelineSet::Sense));
    let mut sim = Sim::from_app(app).unwrap();
    for _ in 0..7 {
        sim.step(&zeros(&sim)).unwrap();
    }
    let world = sim.world_mut();
    assert!(world.query::<&Steps>().iter(world).all(|steps| steps.0 == 7));
}

#[test]
fn what_fails_in_a_system_is_the_error_of_the_step() {
    let mut app = app(busy(&["spot"], 4));
    let fail = |batch: Res<Batch>| -> Result {
        if batch.actions[0] > 0.5 { Err("the first motor is off".into()) } else { Ok(()) }
    };
    app.add_systems(ControlStep, fail.in_set(PipelineSet::Terminate).ambiguous_with_all());
    let mut sim = Sim::from_app(app).unwrap();
    sim.step(&zeros(&sim)).unwrap();
    let error = sim.step(&vec![1.0; sim.batch().actions.len()]).unwrap_err();
    assert!(matches!(&error, Error::System { problem, .. } if problem == "the first motor is off"), "{error}");
    sim.step(&zeros(&sim)).unwrap();
}

#[test]
fn a_parameter_that_is_not_there_is_an_error() {
    #[derive(Resource)]
    struct Missing;
    let mut app = app(busy(&["spot"], 4));
    app.add_systems(ControlStep, (|_: Res<Missing>| {}).in_set(PipelineSet::Act));
    let mut sim = Sim::from_app(app).unwrap();
    let error = sim.step(&zeros(&sim)).unwrap_err().to_string();
    assert!(error.contains("Missing"), "{error}");
}

#[test]
fn systems_that_contradict_each_other_are_refused() {
    let mut app = app(busy(&["spot"], 4));
    app.add_systems(ControlStep, (|_: ResMut<Batch>| {}).in_set(PipelineSet::Reward));
    let error = Sim::from_app(app).map(|_| ()).unwrap_err().to_string();
    assert!(error.starts_with("plugins: ") && error.contains("ControlStep"), "{error}");
    let mut cycle = App::empty();
    cycle.insert_resource(busy(&["spot"], 4)).add_plugins(PolypodPlugins);
    cycle.configure_sets(ControlStep, PipelineSet::Observe.before(PipelineSet::Act));
    let error = Sim::from_app(cycle).map(|_| ()).unwrap_err().to_string();
    assert!(error.starts_with("plugins: "), "{error}");
}

#[test]
fn an_app_without_options_or_plugins_is_refused() {
    let mut bare = App::empty();
    bare.add_plugins(PolypodPlugins);
    let error = Sim::from_app(bare).map(|_| ()).unwrap_err().to_string();
    assert!(error.starts_with("SimOptions: the app has none"), "{error}");
    let mut empty = App::empty();
    empty.insert_resource(busy(&["spot"], 4));
    let error = Sim::from_app(empty).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("PipelinePlugin is missing"), "{error}");
    let mut blind = App::empty();
    blind.insert_resource(busy(&["spot"], 4)).add_plugins(PolypodPlugins.build().disable::<SensePlugin>());
    let error = Sim::from_app(blind).map(|_| ()).unwrap_err().to_string();
    assert!(error.starts_with("rows of the "), "{error}");
}

#[test]
fn who_wrote_a_number_that_is_not_finite_is_known() {
    let mut app = App::empty();
    app.insert_resource(busy(&["spot"], 6));
    // the plugin is part of the group in debug builds
    let plugins = PolypodPlugins.build();
    app.add_plugins(if cfg!(debug_assertions) { plugins } else { plugins.add(FinitePlugin) });
    let spoil = |mut robots: Query<(&EnvId, &mut polypod::components::JointTargets)>| {
        for (env, mut targets) in &mut robots {
            if env.0 == 2 {
                targets.history[0][4] = f32::NAN;
            }
        }
    };
    app.add_systems(ControlStep, spoil.in_set(PipelineSet::Disturb).ambiguous_with_all());
    let mut sim = Sim::from_app(app).unwrap();
    sim.step(&zeros(&sim)).unwrap();
    let found = &sim.world().resource::<NonFinite>().found;
    let [number] = &found[..] else { panic!("{found:?}") };
    assert_eq!((number.env, number.component, &number.set), (2, "JointTargets", &PipelineSet::Disturb));
    // pushes are in the same set and write no targets
    let [system] = &number.systems[..] else { panic!("{found:?}") };
    assert!(system.contains("who_wrote_a_number_that_is_not_finite_is_known"), "{system}");
}
