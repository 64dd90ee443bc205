//! The pipeline: the systems of a control step, and their order.
//!
//! [`PolypodPlugins`] is the whole pipeline, one plugin per concern. A user leaves one out and adds
//! another, or adds systems to a [`PipelineSet`]:
//!
//! ```
//! use bevy_app::{App, Plugin, PluginGroup};
//! use polypod::batch::Batch;
//! use polypod::systems::{ControlStep, PipelineSet, PolypodPlugins, RewardPlugin};
//! use polypod::{Sim, SimOptions};
//! use bevy_ecs::prelude::*;
//!
//! struct StayUpright;
//!
//! impl Plugin for StayUpright {
//!     fn build(&self, app: &mut App) {
//!         let reward = |mut batch: ResMut<Batch>| batch.rewards.fill(1.0);
//!         app.add_systems(ControlStep, reward.in_set(PipelineSet::Reward));
//!     }
//! }
//!
//! let mut app = App::empty();
//! app.add_plugins(PolypodPlugins::default().build().disable::<RewardPlugin>().add(StayUpright));
//! app.insert_resource(SimOptions::new("velocity_flat", 16));
//! let mut sim = Sim::from_app(app)?;
//! sim.step(&vec![0.0; sim.batch().actions.len()])?;
//! assert!(sim.batch().rewards.iter().all(|reward| *reward == 1.0));
//! # Ok::<(), polypod::Error>(())
//! ```

mod act;
mod broken;
mod command;
mod commanded;
mod curriculum;
mod disturb;
mod faults;
mod finite;
mod gather;
mod groups;
mod load;
mod logs;
mod mirror;
mod observe;
mod physics;
mod place;
mod privileged;
mod reset;
mod reward;
mod sampling;
mod saved;
mod scene;
mod sense;
mod spawn;
mod startup;
mod terminate;
mod terms;
mod view;
mod views;
mod whole;

use bevy_app::{App, Plugin, plugin_group};
use bevy_ecs::prelude::*;
use bevy_ecs::schedule::{LogLevel, ScheduleBuildSettings, ScheduleLabel, SingleThreadedExecutor};
use bevy_ecs::system::ScheduleSystem;

use crate::blocks::{BlockMarker, restore_order, separate_morphologies};
use crate::engine::Engines;
use crate::options::Autoreset;

pub use act::ActPlugin;
pub use broken::{BrokenState, BrokenStates};
pub use command::CommandPlugin;
pub use commanded::{CommandKind, CommandSpec, CommandTerm, CommandView, CommandedRobot};
pub use curriculum::place_envs;
pub use disturb::DisturbPlugin;
pub(crate) use faults::{outcome, run};
pub use finite::{FinitePlugin, NonFinite, NonFiniteNumber};
pub use gather::StateField;
pub(crate) use gather::gather_state;
pub(crate) use load::{InstructionSet, Loaded};
pub use load::{LoadPlugin, Share, distribute};
pub use logs::{EpisodeStats, Logs, LogsPlugin, RobotLog};
pub use mirror::MirrorPlugin;
pub(crate) use mirror::mirror_all;
pub(crate) use observe::observe_external;
pub use observe::{ObservePlugin, add_observation};
pub use physics::{PhysicsEngine, PhysicsPlugin, add_engine};
pub(crate) use physics::{check_engine, load_engine, restart_engine, run_physics, save_engine};
pub use reset::ResetPlugin;
pub use reward::RewardPlugin;
pub(crate) use saved::{HeldRows, SavedColumn, SavedComponents};
pub use saved::{Place, Saved, save_component};
pub use scene::WorldPlugin;
pub use sense::{ScanRays, SensePlugin, SensedRobot, Sensor, SensorSettings, add_sensor};
pub use spawn::SpawnPlugin;
pub use startup::randomise_at_startup;
pub use terminate::TerminatePlugin;
pub(crate) use terms::{ACTION_DELAY, PHYSICS_MATERIAL};
pub use terms::{
    Block, CompiledTask, EpisodeEnd, JointMirror, ObservationGroup, ObservationTerm, Per, Registry, RewardTerm,
    TermKind, TermSource, TermSpec, TerminationTerm,
};
pub use view::{EventBody, NewBody, NewState, RobotView};
pub(crate) use whole::{
    OnDevice, device_rows, enter_device, fetch_from_device, flow_on_device, given_actions, lacks_on_device,
    leave_device, may_share_on_device, settle_device, share_with_device, show_on_device, step_on_device,
};

/// Makes a simulation: loads the task and its robots and spawns everything. Runs once.
#[derive(ScheduleLabel, Clone, Debug, PartialEq, Eq, Hash)]
pub struct Setup;

/// One control step of all envs.
#[derive(ScheduleLabel, Clone, Debug, PartialEq, Eq, Hash)]
pub struct ControlStep;

/// Resets the envs that ask for it and observes all, without stepping.
#[derive(ScheduleLabel, Clone, Debug, PartialEq, Eq, Hash)]
pub struct ResetEnvs;

/// The sets of [`Setup`], in this order.
#[derive(SystemSet, Clone, Debug, PartialEq, Eq, Hash)]
pub enum SetupSet {
    /// The task and its robots are read.
    Load,
    /// Ground and obstacles.
    World,
    /// Envs, robots and sensors.
    Spawn,
    /// The engine that steps the bodies.
    Engine,
    /// The robots' mirrors in Avian's world.
    Mirror,
}

/// The sets of a control step, in this order. Nothing else orders systems across sets.
///
/// When a system returns an error, the sets after its own are left out and
/// [`Sim::step`](crate::Sim::step) returns the error.
#[derive(SystemSet, Clone, Debug, PartialEq, Eq, Hash)]
pub enum PipelineSet {
    /// Actions become joint targets.
    Act,
    /// Commands are sampled; a velocity follows its heading, a gait its clock.
    Command,
    /// Interval events, such as pushes.
    Disturb,
    /// `decimation` physics steps.
    Physics,
    /// Avian's world follows, where links have mirrors in it.
    Mirror,
    /// Sensors read the new state.
    Sense,
    /// Terminations: ends of episodes.
    Terminate,
    /// Rewards of the step, of ended episodes too.
    Reward,
    /// Final observations; then curriculum and the reset of ended episodes: see [`ResetSet`].
    Reset,
    /// Observations of all envs.
    Observe,
}

/// The sets within [`PipelineSet::Reset`], in this order.
#[derive(SystemSet, Clone, Debug, PartialEq, Eq, Hash)]
pub enum ResetSet {
    /// Final observations of ended episodes.
    Observe,
    /// Ended episodes are counted.
    Log,
    /// Bodies of the envs that are reset are sampled.
    Bodies,
    /// States, targets, commands and sums of these envs.
    Envs,
    /// Lifts the robots above the ground, and places their feet.
    Place,
    /// Resets the sensors.
    Sensors,
    /// Draws the mirrors.
    Mirror,
}

/// The entities of each block are put in the order of their env ids, before all else.
#[derive(SystemSet, Clone, Debug, PartialEq, Eq, Hash)]
struct RowOrder;

/// Whether the caller asked for the resets of the running schedule ([`ResetEnvs`]), or the pipeline
/// did.
#[derive(Resource, Clone, Copy, Debug, Default)]
pub struct ResetRequest(pub bool);

/// Whether [`ResetEnvs`] computes what follows from states that a caller has written, of robots
/// that stay where they are, rather than from resets.
#[derive(Resource, Clone, Copy, Debug, Default)]
pub struct StateWritten(pub bool);

plugin_group! {
    /// A simulation of many envs. [`Sim::from_app`](crate::Sim::from_app) makes it of an app that
    /// has these plugins and [`SimOptions`](crate::SimOptions) as a resource. An app with a runner
    /// and plugins of its own takes them by
    /// [`PolypodPlugins::in_schedule`](crate::systems::PolypodPlugins::in_schedule).
    ///
    /// | plugin | what it does |
    /// |---|---|
    /// | [`PipelinePlugin`] | schedules, their sets and the registry of terms |
    /// | [`LoadPlugin`] | reads the task and its robots |
    /// | [`WorldPlugin`] | Avian with ground, terrain and obstacles |
    /// | [`SpawnPlugin`] | spawns envs and robots |
    /// | [`ActPlugin`] | actions become joint targets |
    /// | [`CommandPlugin`] | commands |
    /// | [`DisturbPlugin`] | interval events, such as pushes |
    /// | [`PhysicsPlugin`] | the engine and its steps; dumps of broken states |
    /// | [`MirrorPlugin`] | robots in Avian's world, with `physics.mirror_links` |
    /// | [`SensePlugin`] | contact sensors, IMUs, height scanners |
    /// | [`TerminatePlugin`] | which episodes end |
    /// | [`RewardPlugin`] | rewards |
    /// | [`ResetPlugin`] | randomisation, curriculum, new episodes |
    /// | [`ObservePlugin`] | observations |
    /// | [`LogsPlugin`] | statistics of ended episodes |
    /// | [`FinitePlugin`] | says which systems may have written a number that is not finite; in debug builds |
    #[derive(Clone, Copy, Debug, Default)]
    pub struct PolypodPlugins {
        :PipelinePlugin,
        :LoadPlugin,
        :WorldPlugin,
        :SpawnPlugin,
        :ActPlugin,
        :CommandPlugin,
        :DisturbPlugin,
        :PhysicsPlugin,
        :MirrorPlugin,
        :SensePlugin,
        :TerminatePlugin,
        :RewardPlugin,
        :ResetPlugin,
        :ObservePlugin,
        :LogsPlugin,
        #[custom(cfg(debug_assertions))]
        :FinitePlugin,
    }
}

/// Adds the schedules and the registry of built-in terms.
#[derive(Default)]
pub struct PipelinePlugin;

impl Plugin for PipelinePlugin {
    fn build(&self, app: &mut App) {
        let mut setup = schedule(Setup);
        setup.configure_sets(
            (SetupSet::Load, SetupSet::World, SetupSet::Spawn, SetupSet::Engine, SetupSet::Mirror)
                .chain()
                .distributive_run_if(faults::none),
        );
        let mut step = schedule(ControlStep);
        step.configure_sets(
            (
                RowOrder,
                PipelineSet::Act,
                PipelineSet::Command,
                PipelineSet::Disturb,
                PipelineSet::Physics,
                PipelineSet::Mirror,
                PipelineSet::Sense,
                PipelineSet::Terminate,
                PipelineSet::Reward,
                PipelineSet::Reset,
                PipelineSet::Observe,
            )
                .chain()
                .distributive_run_if(faults::none),
        );
        let mut reset = schedule(ResetEnvs);
        reset.configure_sets(
            (RowOrder, PipelineSet::Reset, PipelineSet::Observe).chain().distributive_run_if(faults::none),
        );
        for schedule in [&mut step, &mut reset] {
            schedule.configure_sets(
                (
                    ResetSet::Observe,
                    ResetSet::Log,
                    ResetSet::Bodies,
                    ResetSet::Envs,
                    ResetSet::Place,
                    ResetSet::Sensors,
                    ResetSet::Mirror,
                )
                    .chain()
                    .in_set(PipelineSet::Reset),
            );
        }
        app.add_schedule(setup).add_schedule(step).add_schedule(reset);
        app.init_resource::<Engines>()
            .init_resource::<Autoreset>()
            .init_resource::<ResetRequest>()
            .init_resource::<StateWritten>()
            .init_resource::<SavedComponents>();
        if !app.world().contains_resource::<Registry>() {
            app.insert_resource(Registry::builtin());
        }
    }
}

/// Systems run one after the other; each spreads its rows over the
/// [`Workers`](crate::workers::Workers) itself.
fn schedule(label: impl ScheduleLabel) -> Schedule {
    let mut schedule = Schedule::new(label);
    schedule.set_executor(SingleThreadedExecutor::new());
    schedule.set_build_settings(ScheduleBuildSettings { ambiguity_detection: LogLevel::Error, ..Default::default() });
    schedule
}

/// Adds systems to both [`ControlStep`] and [`ResetEnvs`].
fn for_both<M, S: IntoScheduleConfigs<ScheduleSystem, M>>(app: &mut App, systems: impl Fn() -> S) {
    app.add_systems(ControlStep, systems()).add_systems(ResetEnvs, systems());
}

/// Keeps the entities of a kind in blocks: one table per morphology, in the order of their env ids.
pub fn keep_blocks<K: BlockMarker>(app: &mut App) {
    app.add_observer(separate_morphologies::<K>);
    for_both(app, || restore_order::<K>.in_set(RowOrder).ambiguous_with_all());
}
