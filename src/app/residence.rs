//! Where the state of the envs is between control steps: in the components, or on a device.

use std::collections::BTreeMap;

use super::Sim;
use super::stepping::take_step;
use crate::components::{Command, EnvId};
use crate::error::Error;
use crate::morphology::Morphologies;
use crate::systems::{
    CompiledTask, EpisodeStats, Logs, OnDevice, enter_device, lacks_on_device, leave_device, step_on_device,
};

/// Control steps in a row between which nobody looks at the components, after which the state goes
/// to the device: to take it there and back takes longer than a control step.
const QUIET: u32 = 2;

/// Whether the state may be on the device, and whether it is.
#[derive(Default)]
pub(super) struct Residence {
    wanted: bool,
    is_on_device: bool,
    /// Control steps since somebody looked at the components.
    quiet: u32,
    /// Control steps that the device made alone.
    steps: u64,
    /// Why it does not, as the log has said.
    lacks: Option<String>,
    /// Whether the device failed with the state.
    is_lost: bool,
}

impl Sim {
    /// Lets the state of all envs stay on the device between control steps, where the engine has
    /// one and all that the task uses has a form there: then the device makes the whole control
    /// step, with the same bits. Default: the components are up to date after each step.
    ///
    /// Components that [`world`](Self::world) shows may then be those of an earlier step.
    /// [`world_mut`](Self::world_mut), and each method that reads or writes components, brings them
    /// up to date; the [`batch`](Self::batch) always is.
    pub fn stay_on_device(&mut self, stay: bool) {
        self.residence.wanted = stay;
        if !stay {
            self.return_to_host();
        }
    }

    /// Number of control steps that the device has made alone.
    pub fn steps_on_device(&self) -> u64 {
        self.residence.steps
    }

    /// Why the device does not make whole control steps; `None` if it does, or would when
    /// [`stay_on_device`](Self::stay_on_device) lets it.
    pub fn lacks_on_device(&mut self) -> Option<String> {
        lacks_on_device(&mut self.world)
    }

    /// Brings the components up to date. A failure is the error of each further step.
    pub(super) fn return_to_host(&mut self) {
        self.residence.quiet = 0;
        if std::mem::take(&mut self.residence.is_on_device)
            && let Err(error) = leave_device(&mut self.world)
        {
            tracing::warn!("{error}");
            self.residence.is_lost = true;
        }
    }

    /// Forgets that a state was lost: another one has replaced it.
    pub(super) fn forget_lost_state(&mut self) {
        self.residence.is_lost = false;
    }

    /// One control step with the actions of the batch, where the state is.
    ///
    /// # Errors
    /// A system failed, or the device.
    pub(super) fn step_where_the_state_is(&mut self) -> Result<(), Error> {
        if self.residence.is_lost {
            let problem = "the card failed in the middle of a simulation, with the states of all envs";
            return Err(Error::argument("physics.engine", problem, "make the simulation anew, or restore a snapshot"));
        }
        if self.residence.wanted && !self.residence.is_on_device && self.residence.quiet >= QUIET {
            self.go_to_device()?;
        }
        self.residence.quiet = self.residence.quiet.saturating_add(1);
        if !self.residence.is_on_device {
            return take_step(&mut self.world);
        }
        self.residence.steps += 1;
        let stepped = step_on_device(&mut self.world);
        if stepped.is_err() {
            (self.residence.is_on_device, self.residence.is_lost) = (false, true);
        }
        stepped
    }

    fn go_to_device(&mut self) -> Result<(), Error> {
        let lacks = lacks_on_device(&mut self.world);
        if lacks.is_none() {
            self.residence.is_on_device = enter_device(&mut self.world)?;
        }
        // asks again when somebody has looked, and maybe changed something
        if !self.residence.is_on_device {
            self.residence.quiet = 0;
        }
        if lacks != self.residence.lacks {
            if let Some(lacks) = &lacks {
                tracing::info!("the step runs on the CPU beside the card: {lacks}: no form on the device");
            }
            self.residence.lacks = lacks;
        }
        Ok(())
    }

    /// Writes the velocity commands of all envs, `[num_envs, 3]`: forward and left velocity, m/s,
    /// and yaw rate, rad/s.
    ///
    /// # Panics
    /// If there is no room for three numbers of each env.
    pub fn write_commands(&mut self, out: &mut [f32]) {
        if self.residence.is_on_device
            && let Some(known) = self.world.get_resource::<OnDevice>()
        {
            out[..known.commands.len()].copy_from_slice(&known.commands);
            return;
        }
        for (env, command) in self.world.query::<(&EnvId, &Command)>().iter(&self.world) {
            let at = 3 * env.0 as usize;
            out[at..at + 3].copy_from_slice(&command.velocity);
        }
    }

    /// Log entries over the episodes that ended since the last call, see [`Logs::take`].
    pub fn take_log(&mut self) -> BTreeMap<String, f64> {
        self.with_logs(|logs, task, morphologies| logs.take(task, morphologies))
    }

    /// Statistics of each robot over the episodes that ended, see [`Logs::stats`].
    pub fn episode_stats(&mut self, clear: bool) -> Vec<(String, EpisodeStats)> {
        self.with_logs(|logs, task, morphologies| logs.stats(task, morphologies, clear))
    }

    fn with_logs<T>(&mut self, f: impl FnOnce(&mut Logs, &CompiledTask, &Morphologies) -> T) -> T {
        self.world.resource_scope(|world, mut logs: bevy_ecs::prelude::Mut<Logs>| {
            f(&mut logs, world.resource::<CompiledTask>(), world.resource::<Morphologies>())
        })
    }
}
