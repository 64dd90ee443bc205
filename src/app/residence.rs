//! Residence of the state of the envs between control steps: the components, or a device.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::Sim;
use super::stepping::{check_actions, take_step};
use crate::batch::Batch;
use crate::bounds::MAX_ACTION;
use crate::components::{Command, EnvId};
use crate::engine::DeviceRows;
use crate::error::Error;
use crate::morphology::Morphologies;
use crate::systems::{
    CompiledTask, EpisodeStats, Logs, OnDevice, device_rows, enter_device, fetch_from_device, flow_on_device,
    given_actions, lacks_on_device, leave_device, may_share_on_device, settle_device, share_with_device,
    show_on_device, step_on_device,
};

/// Control steps in a row between which nobody looks at the components, after which the state goes
/// to the device: to take it there and back takes longer than a control step.
const QUIET: u32 = 2;

/// Control steps that are timed where nobody knows what is faster: of the CPU, then of the device.
/// As many before them are not.
const TIMED: usize = 10;
/// Least ratio of the CPU's time to the device's for which the device is used.
const LEAST_GAIN: f64 = 1.05;

/// Maker of the control steps.
#[derive(Default, PartialEq)]
enum Place {
    /// Not chosen: nobody has asked the engine.
    #[default]
    Open,
    /// Steps of both are being timed.
    Trial { of_cpu: Vec<Duration>, of_device: Vec<Duration> },
    /// The device, where it can.
    Device,
    /// CPU and device, as the engine shares the robots.
    Shared,
}

/// Whether the device is faster, and the times in words.
fn verdict(of_cpu: &[Duration], of_device: &[Duration]) -> (bool, String) {
    let median = |times: &[Duration]| {
        let mut last = times.get(TIMED..).unwrap_or_default().to_vec();
        last.sort_unstable();
        last.get(last.len() / 2).map_or(f64::INFINITY, Duration::as_secs_f64)
    };
    let (cpu, device) = (median(of_cpu), median(of_device));
    let is_faster = cpu > LEAST_GAIN * device;
    let who =
        if is_faster { "the card makes the steps" } else { "the CPU makes the steps, or shares them with the card" };
    let times = format!("{:.2} ms on the CPU and {:.2} ms as a whole on the card", 1e3 * cpu, 1e3 * device);
    (is_faster, format!("{who}: a control step takes {times}"))
}

/// Whether the state may be on the device, and whether it is.
#[derive(Default)]
pub(super) struct Residence {
    wanted: bool,
    is_on_device: bool,
    place: Place,
    /// Control steps since somebody looked at the components.
    quiet: u32,
    /// Control steps that the device made alone.
    steps: u64,
    /// Whether steps have flowed since the batch was up to date.
    is_behind: bool,
    /// An env whose actions were refused in a step that flowed.
    refused: Option<usize>,
    /// Reason of the choice between the CPU and the device.
    choice: Option<String>,
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
    /// up to date; the [`batch`](Self::batch) always is, but for
    /// [`step_device`](Self::step_device).
    pub fn stay_on_device(&mut self, stay: bool) {
        self.residence.wanted = stay;
        if !stay {
            self.return_to_host();
            self.residence.place = Place::Open;
            share_with_device(&mut self.world, true);
        }
    }

    /// Begins to find out what is faster, where the engine leaves that open.
    fn choose_place(&mut self) {
        if self.residence.place != Place::Open {
            return;
        }
        self.residence.place = if !may_share_on_device(&mut self.world) {
            Place::Device
        } else if let Some(lacks) = lacks_on_device(&mut self.world) {
            let choice =
                format!("the CPU makes the steps, or shares them with the card: no form on the card has {lacks}");
            tracing::info!("physics.engine auto: {choice}");
            self.residence.choice = Some(choice);
            Place::Shared
        } else {
            share_with_device(&mut self.world, false);
            Place::Trial { of_cpu: Vec::new(), of_device: Vec::new() }
        };
    }

    /// Whether the next step is one that the device makes, if it can.
    fn is_turn_of_device(&self) -> bool {
        match &self.residence.place {
            Place::Open | Place::Shared => false,
            Place::Trial { of_cpu, .. } => of_cpu.len() >= 2 * TIMED,
            Place::Device => self.residence.quiet >= QUIET,
        }
    }

    /// Notes the time of a step, and chooses when all are known.
    fn note_time(&mut self, time: Duration) {
        let Place::Trial { of_cpu, of_device } = &mut self.residence.place else { return };
        let times = if self.residence.is_on_device { &mut *of_device } else { &mut *of_cpu };
        times.push(time);
        // a device that cannot is no faster
        let failed = of_cpu.len() > 2 * TIMED;
        if of_device.len() < 2 * TIMED && !failed {
            return;
        }
        let (is_faster, choice) = verdict(of_cpu, of_device);
        tracing::info!("physics.engine auto: {choice}");
        self.residence.choice = Some(choice);
        self.residence.place = if is_faster { Place::Device } else { Place::Shared };
        if !is_faster {
            self.return_to_host();
            share_with_device(&mut self.world, true);
        }
    }

    /// Finds out what is faster before the first step of a caller, who finds the state as it was.
    fn try_both(&mut self) -> Result<(), Error> {
        if !matches!(self.residence.place, Place::Trial { .. }) {
            return Ok(());
        }
        let (saved, steps) = (self.snapshot()?, self.residence.steps);
        while matches!(self.residence.place, Place::Trial { .. }) {
            self.world.resource_mut::<Batch>().actions.fill(0.0);
            self.step_where_the_state_is()?;
        }
        self.residence.steps = steps;
        self.restore(&saved)
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

    /// The arrays of all envs in the device's memory, for [`step_device`](Self::step_device);
    /// `None` where the device does not make whole control steps. The state goes there.
    ///
    /// # Errors
    /// A device that is lost.
    pub fn device_rows(&mut self) -> Result<Option<DeviceRows>, Error> {
        self.check_residence()?;
        self.choose_place();
        self.try_both()?;
        if !self.residence.is_on_device && self.residence.place == Place::Device {
            self.go_to_device()?;
        }
        Ok(if self.residence.is_on_device { device_rows(&mut self.world) } else { None })
    }

    /// Begins a control step of all envs with the actions that are given in
    /// [`device_rows`](Self::device_rows), and does not wait for it. Work that the caller's queue
    /// `stream` of the device has is done before; what it gets afterwards finds the outcome in the
    /// arrays. The [`batch`](Self::batch) is up to date after [`fetch_batch`](Self::fetch_batch),
    /// and after each method that reads or writes components.
    ///
    /// # Errors
    /// As [`step`](Self::step), where actions are refused some steps later: their env has acted
    /// with zeros instead. There are no arrays on the device.
    pub fn step_device(&mut self, stream: u64) -> Result<(), Error> {
        self.check_external()?;
        self.check_residence()?;
        if device_rows(&mut self.world).is_none() {
            let remedy = "call device_rows() first, which says whether there are any";
            return Err(Error::argument("step_device", "there are no arrays on a device", remedy));
        }
        if !self.residence.is_on_device {
            self.go_to_device()?;
        }
        if !self.residence.is_on_device {
            let actions = given_actions(&mut self.world, stream)?;
            check_actions(&self.world, &actions)?;
            self.world.resource_mut::<Batch>().actions.copy_from_slice(&actions);
            take_step(&mut self.world)?;
            show_on_device(&mut self.world)?;
        } else {
            self.residence.quiet = self.residence.quiet.saturating_add(1);
            self.residence.steps += 1;
            self.residence.is_behind = true;
            let flows = flow_on_device(&mut self.world, stream);
            self.residence.refused = self.unless_lost(flows)?.or(self.residence.refused);
        }
        self.dump_broken_states();
        self.tell_refused()
    }

    /// Brings the batch up to date, after steps that the host did not wait for.
    ///
    /// # Errors
    /// A device that is lost; actions of such a step that are refused.
    pub fn fetch_batch(&mut self) -> Result<(), Error> {
        self.fetch()?;
        self.tell_refused()
    }

    fn fetch(&mut self) -> Result<(), Error> {
        if std::mem::take(&mut self.residence.is_behind) {
            let fetched = fetch_from_device(&mut self.world);
            self.residence.refused = self.unless_lost(fetched)?.or(self.residence.refused);
            self.dump_broken_states();
        }
        Ok(())
    }

    /// Whether the batch is that of an earlier step.
    pub fn is_batch_behind(&self) -> bool {
        self.residence.is_behind
    }

    /// The outcome, with a state that is lost noted.
    fn unless_lost<T>(&mut self, outcome: Result<T, Error>) -> Result<T, Error> {
        if outcome.is_err() {
            (self.residence.is_on_device, self.residence.is_behind, self.residence.is_lost) = (false, false, true);
        }
        outcome
    }

    /// The error of actions that were refused, once.
    fn tell_refused(&mut self) -> Result<(), Error> {
        let Some(env) = self.residence.refused.take() else { return Ok(()) };
        let problem = format!("an action of env {env} was not a number within {MAX_ACTION}, in an earlier step");
        Err(Error::argument("actions", problem, "pass finite numbers; a policy that gives others has diverged"))
    }

    fn check_residence(&self) -> Result<(), Error> {
        if self.residence.is_lost {
            let problem = "the card failed in the middle of a simulation, with the states of all envs";
            return Err(Error::argument("physics.engine", problem, "make the simulation anew, or restore a snapshot"));
        }
        Ok(())
    }

    /// Choice between the CPU and the device, where the engine leaves that open, with its reason;
    /// `None` while nobody knows.
    pub fn choice_of_engine(&self) -> Option<&str> {
        self.residence.choice.as_deref()
    }

    /// Brings the components and the batch up to date. A failure is the error of each further step.
    pub(super) fn return_to_host(&mut self) {
        self.residence.quiet = 0;
        self.fetch_quietly();
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
        self.check_residence()?;
        if self.residence.wanted {
            self.choose_place();
            if !self.residence.is_on_device && self.is_turn_of_device() {
                self.go_to_device()?;
            }
        }
        self.residence.quiet = self.residence.quiet.saturating_add(1);
        let begun = Instant::now();
        if self.residence.is_on_device {
            self.residence.steps += 1;
            let stepped = step_on_device(&mut self.world);
            self.unless_lost(stepped)?;
        } else {
            take_step(&mut self.world)?;
        }
        self.note_time(begun.elapsed());
        Ok(())
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
        self.fetch_quietly();
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

    /// Fetches the batch; a failure is the error of the next step.
    fn fetch_quietly(&mut self) {
        if let Err(error) = self.fetch() {
            tracing::warn!("{error}");
        }
    }

    /// Waits for what steps tell of ended episodes.
    pub(super) fn settle(&mut self) {
        if self.residence.is_behind {
            let settled = settle_device(&mut self.world);
            match self.unless_lost(settled) {
                Ok(refused) => self.residence.refused = refused.or(self.residence.refused),
                Err(error) => tracing::warn!("{error}"),
            }
            self.dump_broken_states();
        }
    }

    fn with_logs<T>(&mut self, f: impl FnOnce(&mut Logs, &CompiledTask, &Morphologies) -> T) -> T {
        self.settle();
        self.world.resource_scope(|world, mut logs: bevy_ecs::prelude::Mut<Logs>| {
            f(&mut logs, world.resource::<CompiledTask>(), world.resource::<Morphologies>())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_device_makes_the_steps_where_its_last_ones_are_clearly_faster() {
        let ms = |first: u64, last: u64| {
            [first, last].iter().flat_map(|&ms| [Duration::from_millis(ms); TIMED]).collect::<Vec<_>>()
        };
        assert!(verdict(&ms(30, 30), &ms(900, 20)).0);
        assert!(!verdict(&ms(90, 20), &ms(5, 30)).0);
        assert!(!verdict(&ms(30, 100), &ms(30, 99)).0);
        let (_, words) = verdict(&ms(30, 30), &ms(90, 20));
        assert!(words.ends_with("takes 30.00 ms on the CPU and 20.00 ms as a whole on the card"), "{words}");
        // a device that made no step is no faster
        assert!(!verdict(&ms(30, 30), &[]).0);
    }
}
