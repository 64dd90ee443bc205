//! The pipeline within an app that has a runner, a clock and plugins besides it.

use bevy_app::{App, Plugin, PluginGroup, PluginGroupBuilder, PreStartup};
use bevy_ecs::prelude::*;
use bevy_ecs::schedule::{InternedScheduleLabel, ScheduleLabel};

use crate::batch::Batch;
use crate::error::Error;
use crate::options::{Autoreset, SimOptions};
use crate::systems::{CompiledTask, PolypodPlugins};

use super::stepping::{check_actions, set_up, take_step};

/// The control step within a schedule of the host. Systems that write
/// [`Batch::actions`](crate::batch::Batch::actions) come before it, those that read observations
/// and rewards after it.
#[derive(SystemSet, Clone, Debug, PartialEq, Eq, Hash)]
pub struct HostedStep;

/// Takes a control step each time that a schedule of the host runs; see
/// [`PolypodPlugins::in_schedule`].
#[derive(Clone, Copy, Debug)]
pub struct HostPlugin {
    schedule: InternedScheduleLabel,
}

impl PolypodPlugins {
    /// The plugins for an app that keeps its runner, its clock, its schedules and its plugins. The
    /// app takes a control step each time that `schedule` runs, such as
    /// [`FixedUpdate`](bevy_app::FixedUpdate).
    ///
    /// The app has [`SimOptions`] as a resource, and the clock of
    /// [`TimePlugin`](bevy_time::TimePlugin), which Avian reads. Envs, robots and sensors are there
    /// after [`PreStartup`]. A system before [`HostedStep`] writes the actions.
    ///
    /// ```
    /// use bevy_app::{App, Update};
    /// use bevy_ecs::prelude::*;
    /// use bevy_time::TimePlugin;
    /// use polypod::batch::Batch;
    /// use polypod::systems::PolypodPlugins;
    /// use polypod::{HostedStep, SimOptions};
    ///
    /// let mut app = App::new();
    /// app.insert_resource(SimOptions::new("velocity_flat", 16));
    /// app.add_plugins((TimePlugin, PolypodPlugins::in_schedule(Update)));
    /// app.add_systems(Update, (|mut batch: ResMut<Batch>| batch.actions.fill(0.1)).before(HostedStep));
    /// app.finish();
    /// app.cleanup();
    /// app.update();
    /// assert_eq!(app.world().resource::<Batch>().rewards.len(), 16);
    /// ```
    ///
    /// A step that fails is an error of the host's system, which the host's
    /// [`FallbackErrorHandler`](bevy_ecs::error::FallbackErrorHandler) gets. polypod brings Avian
    /// along, in separate schedules; the host adds no second one.
    pub fn in_schedule(schedule: impl ScheduleLabel) -> PluginGroupBuilder {
        Self.build().add(HostPlugin { schedule: schedule.intern() })
    }
}

impl Plugin for HostPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(PreStartup, set_up_in_host);
        app.add_systems(self.schedule, step_in_host.in_set(HostedStep));
    }
}

/// Present once the set-up has succeeded.
#[derive(Resource)]
struct IsSetUp;

fn set_up_in_host(world: &mut World) -> Result {
    let options = SimOptions::of(world)?;
    if options.autoreset == Autoreset::Disabled {
        let remedy = "use same_step or next_step";
        return Err(Error::argument("autoreset", "a host app has no call that resets envs", remedy).into());
    }
    if options.dump_dir.is_some() {
        let remedy = "leave it out; BrokenStates holds the states that broke";
        return Err(Error::argument("dump_dir", "dumps are written by Sim alone", remedy).into());
    }
    set_up(world, options.seed)?;
    let external = world.resource::<CompiledTask>().external_terms();
    if !external.is_empty() {
        let problem = format!("the terms {} are computed by the caller of a Sim", external.join(", "));
        return Err(Error::argument("observations", problem, "take another task, or step a Sim").into());
    }
    world.insert_resource(IsSetUp);
    Ok(())
}

fn step_in_host(world: &mut World) -> Result {
    if !world.contains_resource::<IsSetUp>() {
        let remedy = "run the app's Main schedule, in which PreStartup comes first, and mend the error of the set-up";
        return Err(Error::argument("the host app", "polypod is not set up", remedy).into());
    }
    check_actions(world, &world.resource::<Batch>().actions)?;
    Ok(take_step(world)?)
}
