//! The pipeline: what happens to every env in one control step, and in which order.

mod act;
mod bench;
mod broken;
mod command;
mod curriculum;
mod disturb;
mod draw;
mod gather;
mod line_up;
mod logs;
mod mirror;
mod observe;
mod own_numbers;
mod packs;
mod physics;
mod physics_avian;
mod reset;
mod reward;
mod sense;
mod startup;
mod terminate;
mod terms;
mod view;

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use bevy_ecs::schedule::{LogLevel, ScheduleBuildSettings, ScheduleLabel, SingleThreadedExecutor};

use crate::app::SimError;
use crate::mirrors::LinkMirrors;

pub use broken::{BrokenState, BrokenStates, Motion};
pub use curriculum::{BlockSizes, EpisodeEnd, place_envs};
pub use gather::StateField;
pub(crate) use gather::gather_state;
pub use logs::{EpisodeStats, Logs, RobotLog};
pub(crate) use mirror::mirror_all;
pub use physics::PhysicsEngine;
pub(crate) use physics::{check_engine, history_length, load_engine, run_physics, save_engine};
pub(crate) use reset::ACTION_DELAY;
pub use reset::NewState;
pub use sense::ScanRays;
pub(crate) use sense::scan_heights;
pub use startup::{NewBody, randomise_at_startup};
pub use terminate::{Quantity, StateLimits, Violation};
pub use terms::{CompiledTask, EventBody, Registry, TermError};
pub use view::RobotView;

/// One control step of all envs.
#[derive(ScheduleLabel, Clone, Debug, PartialEq, Eq, Hash)]
pub struct ControlStep;

/// Resets the envs that ask for it and observes all, without stepping.
#[derive(ScheduleLabel, Clone, Debug, PartialEq, Eq, Hash)]
pub struct ResetEnvs;

/// The sets of a control step, in this order. Nothing else orders systems across sets; within a set a chain does.
#[derive(SystemSet, Clone, Debug, PartialEq, Eq, Hash)]
pub enum PipelineSet {
    /// Actions become joint targets.
    Act,
    /// Velocity commands are drawn anew and follow the heading.
    Command,
    /// Interval events, such as pushes.
    Disturb,
    /// `decimation` physics steps.
    Physics,
    /// Avian's world follows, where links have mirrors in it.
    Mirror,
    /// Sensors read the new state.
    Sense,
    /// Which episodes end.
    Terminate,
    /// Rewards of the step, of ended episodes too.
    Reward,
    /// Final observations; then curriculum, and ended episodes begin anew.
    Reset,
    /// Observations of all envs.
    Observe,
}

/// Who resets an env whose episode has ended.
#[derive(Resource, Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Autoreset {
    /// The control step in which it ended.
    #[default]
    SameStep,
    /// The next control step, which then does nothing else to this env.
    NextStep,
    /// Only the caller.
    Disabled,
}

impl std::str::FromStr for Autoreset {
    type Err = SimError;

    fn from_str(name: &str) -> Result<Self, SimError> {
        match name {
            "same_step" => Ok(Self::SameStep),
            "next_step" => Ok(Self::NextStep),
            "disabled" => Ok(Self::Disabled),
            _ => Err(SimError::Argument {
                element: "autoreset",
                problem: format!("there is no mode `{name}`"),
                remedy: "use same_step, next_step or disabled".into(),
            }),
        }
    }
}

/// Whether the caller asked for the resets of the running schedule ([`ResetEnvs`]), or the pipeline did.
#[derive(Resource, Clone, Copy, Debug, Default)]
pub struct ResetRequest(pub bool);

/// Adds the pipeline's schedules to an app.
pub struct PipelinePlugin;

impl Plugin for PipelinePlugin {
    fn build(&self, app: &mut App) {
        let mut step = schedule(ControlStep);
        step.configure_sets(
            (
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
                .chain(),
        );
        step.add_systems((
            act::apply_actions.in_set(PipelineSet::Act),
            command::update_commands.in_set(PipelineSet::Command),
            disturb::apply_interval_events.in_set(PipelineSet::Disturb),
            (physics::upload_bodies, physics::step_physics, broken::describe_broken_states)
                .chain()
                .in_set(PipelineSet::Physics),
            (mirror::read_bodies, mirror::aim_mirrors, mirror::step_avian, mirror::settle_mirrors)
                .chain()
                .run_if(resource_exists::<LinkMirrors>)
                .in_set(PipelineSet::Mirror),
            (sense::read_sensors, sense::look_down).chain().in_set(PipelineSet::Sense),
            terminate::end_episodes.in_set(PipelineSet::Terminate),
            reward::compute_rewards.in_set(PipelineSet::Reward),
        ));
        let mut reset = schedule(ResetEnvs);
        reset.configure_sets((PipelineSet::Reset, PipelineSet::Observe).chain());
        for schedule in [&mut step, &mut reset] {
            schedule.add_systems((
                (
                    observe::observe_final,
                    logs::collect_episodes,
                    startup::reset_bodies,
                    reset::reset_envs,
                    mirror::mirror_resets.run_if(resource_exists::<LinkMirrors>),
                )
                    .chain()
                    .in_set(PipelineSet::Reset),
                observe::observe.in_set(PipelineSet::Observe),
            ));
        }
        app.add_schedule(step).add_schedule(reset);
        app.init_resource::<Autoreset>().init_resource::<ResetRequest>();
    }
}

/// Systems run one after the other; each spreads its rows over the [`Workers`](crate::rows::Workers) itself.
fn schedule(label: impl ScheduleLabel) -> Schedule {
    let mut schedule = Schedule::new(label);
    schedule.set_executor(SingleThreadedExecutor::new());
    schedule.set_build_settings(ScheduleBuildSettings { ambiguity_detection: LogLevel::Error, ..Default::default() });
    schedule
}
