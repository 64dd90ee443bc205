//! The registry of all terms that tasks may name, with their builders.

use std::collections::{BTreeMap, BTreeSet};

use bevy_ecs::prelude::Resource;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use toml::Table;

use super::super::commanded::{CommandKind, CommandSpec};
use super::super::view::{EventBody, NewBody, NewState, RobotView};
use super::episode_end::EpisodeEnd;
use super::spec::TermSpec;
use crate::components::{EnvRng, Episode};
use crate::config::{ConfigError, TaskConfig, parse_params};
use crate::dynamics::lanes::{Kernel, SimdDispatch};
use crate::engine::device::{Form, FormKind};
use crate::morphology::{BatchSlots, MorphologyModel};

/// The parameters of a term that has none.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct NoParams {}

/// Makes a reward term from its parameters, for a robot.
type RewardBuilder = Box<dyn Fn(&str, &str, &Table, &MorphologyModel) -> Result<RewardFn, ConfigError> + Send + Sync>;
type Builder<T> = Box<dyn Fn(&str, &str, &Table) -> Result<T, ConfigError> + Send + Sync>;
pub(super) type RewardFn = Box<dyn Fn(&RobotView, SimdDispatch) -> f32 + Send + Sync>;
/// Writes an observation; absent where a separate system does so, see
/// [`add_observation`](super::super::add_observation).
pub(super) type ObservationFn = Option<Box<dyn Fn(&RobotView, &mut [f32]) + Send + Sync>>;
pub(super) type TerminationFn = Box<dyn Fn(&RobotView, &Episode, u32) -> bool + Send + Sync>;
pub(super) type BodyFn = Box<dyn Fn(&mut NewBody, &mut EnvRng) + Send + Sync>;
pub(super) type ResetFn = Box<dyn Fn(&mut NewState, &mut EnvRng) + Send + Sync>;
pub(super) type CurriculumFn = Box<dyn Fn(&mut EpisodeEnd, &mut EnvRng) + Send + Sync>;
/// Makes a kind of command from its parameters, for a robot.
pub(super) type CommandBuilder =
    Box<dyn Fn(&str, &str, &Table, &MorphologyModel) -> Result<Box<dyn CommandKind>, ConfigError> + Send + Sync>;
/// Numbers of a term in a task and a batch of these slots.
pub(super) type SizeFn = Box<dyn Fn(&TaskConfig, &BatchSlots) -> Result<usize, (String, String)> + Send + Sync>;
pub(super) type IntervalFn = Box<dyn Fn(&mut EventBody, &mut EnvRng) + Send + Sync>;

/// Makes the form of a term on a device from the parameters of a task, for a robot.
type FormBuilder = Box<dyn Fn(&Table, &MorphologyModel) -> Option<Form> + Send + Sync>;
/// Numbers and integers of a form, see [`Form::new`].
pub(in crate::systems) type FormLists = (Vec<f32>, Option<Vec<i32>>);

/// All terms that tasks may name. Plugins add their own to it in `build`: it is a resource of the
/// app.
#[derive(Resource, Default)]
pub struct Registry {
    pub(super) rewards: BTreeMap<&'static str, RewardBuilder>,
    pub(super) observations: BTreeMap<&'static str, RegisteredObservation>,
    pub(super) terminations: BTreeMap<&'static str, (bool, Builder<TerminationFn>)>,
    pub(super) body: Events<BodyFn>,
    pub(super) reset: Events<ResetFn>,
    pub(super) interval: Events<IntervalFn>,
    pub(super) curriculum: BTreeMap<&'static str, Builder<CurriculumFn>>,
    pub(super) commands: BTreeMap<&'static str, RegisteredCommand>,
    /// Commands that reward and observation terms follow, unless their `command_name` names
    /// another.
    pub(super) needs: BTreeMap<&'static str, Vec<&'static str>>,
    /// Forms on a device.
    forms: BTreeMap<(FormKind, &'static str), FormBuilder>,
    /// Observations that change with the robot's body alone.
    of_bodies: BTreeSet<&'static str>,
}

/// A kind of command, and how it is made; the velocity has a place of its own in a task.
pub(super) struct RegisteredCommand {
    pub(super) spec: CommandSpec,
    pub(super) build: Option<CommandBuilder>,
}

/// An observation term: what it is, how many numbers it has in a task, and how it is made.
pub(super) struct RegisteredObservation {
    pub(super) spec: TermSpec,
    pub(super) size: SizeFn,
    pub(super) build: Builder<BuiltObservation>,
    /// Whether a morphology has the term in a task.
    pub(super) is_on: fn(&MorphologyModel, &TaskConfig) -> bool,
}

/// An observation term with the parameters of a task.
pub(super) struct BuiltObservation {
    /// Number that it takes off its source.
    pub(super) offset: f32,
    pub(super) write: ObservationFn,
}

/// Events by name, each with its place in the order of registration.
type Events<T> = BTreeMap<&'static str, (usize, Builder<T>)>;

impl Registry {
    /// The form that a built-in term has in `device/env.h` of `polypod-cuda`. `lists` makes its
    /// numbers and integers of the task's parameters. Registering another term of that name takes
    /// it away.
    pub(in crate::systems) fn on_device<P: DeserializeOwned + 'static>(
        &mut self,
        kind: FormKind,
        name: &'static str,
        lists: fn(P, &MorphologyModel) -> Option<FormLists>,
    ) {
        let build: FormBuilder = Box::new(move |table, robot| {
            let (numbers, integers) = lists(parse_params("", "", table).ok()?, robot)?;
            Form::new(kind, name, numbers, integers)
        });
        self.forms.insert((kind, name), build);
    }

    /// Says that an observation changes with the robot's body alone: a device need not compute it.
    pub(in crate::systems) fn depends_on_body(&mut self, name: &'static str) {
        self.of_bodies.insert(name);
    }

    /// Whether an observation changes with the robot's body alone.
    pub(in crate::systems) fn is_of_body(&self, name: &str) -> bool {
        self.of_bodies.contains(name)
    }

    /// Terms that have a form on the device.
    #[cfg(test)]
    pub(super) fn with_forms(&self) -> impl Iterator<Item = (FormKind, &'static str)> {
        self.forms.keys().copied()
    }

    /// Gives a form on the device to a reward term that depends on numbers alone.
    pub(in crate::systems) fn reward_on_device<P: DeserializeOwned + 'static>(
        &mut self,
        name: &'static str,
        numbers: fn(P) -> Vec<f32>,
    ) {
        let build: FormBuilder = Box::new(move |table, _| {
            Form::new(FormKind::Reward, name, numbers(parse_params("", "", table).ok()?), Some(Vec::new()))
        });
        self.forms.insert((FormKind::Reward, name), build);
    }

    /// The form of a term with the parameters of a task, if it has one.
    pub(in crate::systems) fn form(
        &self,
        kind: FormKind,
        name: &str,
        params: &Table,
        robot: &MorphologyModel,
    ) -> Option<Form> {
        let (_, build) = self.forms.iter().find(|((of, known), _)| (*of, *known) == (kind, name))?;
        build(params, robot)
    }

    /// A reward term: its unweighted value per second. An `#[inline(always)]` function is compiled
    /// for each instruction set.
    pub fn reward<P>(&mut self, name: &'static str, f: impl Fn(&P, &RobotView) -> f32 + Copy + Send + Sync + 'static)
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        self.reward_for(name, |p: P, _| Ok(p), f);
    }

    /// A reward term that is prepared for each morphology. `prepare` turns the task's parameters
    /// into the term's data, such as the joints of patterns, or returns key, problem and remedy.
    pub fn reward_for<P, Q>(
        &mut self,
        name: &'static str,
        prepare: fn(P, &MorphologyModel) -> Result<Q, (String, String, String)>,
        f: impl Fn(&Q, &RobotView) -> f32 + Copy + Send + Sync + 'static,
    ) where
        P: DeserializeOwned + 'static,
        Q: Send + Sync + 'static,
    {
        let build: RewardBuilder = Box::new(move |file, element, table, robot| {
            let p: P = parse_params(file, element, table)?;
            let p = prepare(p, robot).map_err(|(key, problem, remedy)| {
                ConfigError::invalid(file, format!("{element}.{key}"), problem, remedy)
            })?;
            Ok(Box::new(move |view: &RobotView, simd: SimdDispatch| simd.vectorize(Reward { f: &f, p: &p, view })))
        });
        self.forms.remove(&(FormKind::Reward, name));
        self.rewards.insert(name, build);
    }

    /// An observation term of `size` numbers.
    pub fn observation<P>(&mut self, name: &'static str, size: usize, spec: TermSpec, f: fn(&P, &RobotView, &mut [f32]))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        self.observation_of(name, move |_| Ok(size), spec, |_| 0.0, f);
    }

    /// An observation term of `count` numbers for each joint. It is handed the robot's own joints,
    /// in the order of [`MorphologyModel::slots`](crate::morphology::MorphologyModel::slots): all
    /// joints' first number, then their next.
    pub fn joint_observation<P>(
        &mut self,
        name: &'static str,
        count: usize,
        spec: TermSpec,
        f: fn(&P, &RobotView, &mut [f32]),
    ) where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        self.observation_sized(name, move |_, slots| Ok(count * slots.joints.len()), spec, |_| 0.0, f);
    }

    /// An observation term of a number for each foot. It is handed the robot's own feet, in the
    /// order of its legs.
    pub fn foot_observation<P>(&mut self, name: &'static str, spec: TermSpec, f: fn(&P, &RobotView, &mut [f32]))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        self.observation_sized(name, |_, slots| Ok(slots.feet.len()), spec, |_| 0.0, f);
    }

    /// An observation term whose size depends on the task, and whose parameters hold a number that
    /// it takes off its source.
    ///
    /// `size` gives problem and remedy where the task does not fit; `offset` reads the number that
    /// is taken off.
    pub fn observation_of<P>(
        &mut self,
        name: &'static str,
        size: impl Fn(&TaskConfig) -> Result<usize, (String, String)> + Send + Sync + 'static,
        spec: TermSpec,
        offset: fn(&P) -> f32,
        f: fn(&P, &RobotView, &mut [f32]),
    ) where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        self.observation_sized(name, move |task, _| size(task), spec, offset, f);
    }

    /// An observation term without parameters that is read from a sensor. `size` is that of
    /// [`observation_of`](Self::observation_of); robots for which `is_on` is false have zeros.
    pub(in crate::systems) fn sensor_observation(
        &mut self,
        name: &'static str,
        size: fn(&TaskConfig) -> Result<usize, (String, String)>,
        spec: TermSpec,
        is_on: fn(&MorphologyModel, &TaskConfig) -> bool,
        f: fn(&RobotView, &mut [f32]),
    ) {
        let build: Builder<BuiltObservation> = Box::new(move |file, element, table| {
            let NoParams {} = parse_params(file, element, table)?;
            let write: ObservationFn = Some(Box::new(f));
            Ok(BuiltObservation { offset: 0.0, write })
        });
        let size: SizeFn = Box::new(move |task, _| size(task));
        self.forms.remove(&(FormKind::Observation, name));
        self.of_bodies.remove(name);
        self.observations.insert(name, RegisteredObservation { spec, size, build, is_on });
    }

    fn observation_sized<P>(
        &mut self,
        name: &'static str,
        size: impl Fn(&TaskConfig, &BatchSlots) -> Result<usize, (String, String)> + Send + Sync + 'static,
        spec: TermSpec,
        offset: fn(&P) -> f32,
        f: fn(&P, &RobotView, &mut [f32]),
    ) where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<BuiltObservation> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            let offset = offset(&p);
            let write: ObservationFn = Some(Box::new(move |view: &RobotView, out: &mut [f32]| f(&p, view, out)));
            Ok(BuiltObservation { offset, write })
        });
        self.forms.remove(&(FormKind::Observation, name));
        self.of_bodies.remove(name);
        let registered = RegisteredObservation { spec, size: Box::new(size), build, is_on: |_, _| true };
        self.observations.insert(name, registered);
    }

    /// An observation term that a separate system writes, for the morphologies for which `is_on` is
    /// true in a task.
    pub(in crate::systems) fn observation_by_system(
        &mut self,
        name: &'static str,
        size: usize,
        spec: TermSpec,
        is_on: fn(&MorphologyModel, &TaskConfig) -> bool,
    ) {
        let build: Builder<BuiltObservation> = Box::new(move |file, element, table| {
            let NoParams {} = parse_params(file, element, table)?;
            Ok(BuiltObservation { offset: 0.0, write: None })
        });
        let size: SizeFn = Box::new(move |_, _| Ok(size));
        self.forms.remove(&(FormKind::Observation, name));
        self.of_bodies.remove(name);
        self.observations.insert(name, RegisteredObservation { spec, size, build, is_on });
    }

    /// Names and descriptions of all observation terms.
    pub fn observation_specs(&self) -> impl Iterator<Item = (&'static str, &TermSpec)> {
        self.observations.iter().map(|(name, registered)| (*name, &registered.spec))
    }

    /// A termination term; `time_out` ones truncate an episode, others end it as failed. The last
    /// argument is the length of a full episode in control steps.
    pub fn termination<P>(&mut self, name: &'static str, time_out: bool, f: fn(&P, &RobotView, &Episode, u32) -> bool)
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<TerminationFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |view: &RobotView, episode: &Episode, most: u32| f(&p, view, episode, most)))
        });
        self.forms.remove(&(FormKind::End, name));
        self.terminations.insert(name, (time_out, build));
    }

    /// An event that changes a robot's body: once with `mode = "startup"`, at each reset with `mode
    /// = "reset"`. Events happen in the order in which they are registered.
    pub fn body_event<P>(&mut self, name: &'static str, f: fn(&P, &mut NewBody, &mut EnvRng))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<BodyFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |body: &mut NewBody, rng: &mut EnvRng| f(&p, body, rng)))
        });
        self.forms.remove(&(FormKind::BodyEvent, name));
        self.body.insert(name, (self.body.len(), build));
    }

    /// An event that changes the state in which an episode begins.
    pub fn reset_event<P>(&mut self, name: &'static str, f: fn(&P, &mut NewState, &mut EnvRng))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<ResetFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |state: &mut NewState, rng: &mut EnvRng| f(&p, state, rng)))
        });
        self.forms.remove(&(FormKind::Reset, name));
        self.reset.insert(name, (self.reset.len(), build));
    }

    /// An event that happens again and again within an episode.
    pub fn interval_event<P>(&mut self, name: &'static str, f: fn(&P, &mut EventBody, &mut EnvRng))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<IntervalFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |body: &mut EventBody, rng: &mut EnvRng| f(&p, body, rng)))
        });
        self.forms.remove(&(FormKind::Interval, name));
        self.interval.insert(name, (self.interval.len(), build));
    }

    /// A kind of command. `prepare` turns the task's parameters into the kind for a morphology, or
    /// returns key, problem and remedy.
    pub fn command<P, K>(
        &mut self,
        name: &'static str,
        spec: CommandSpec,
        prepare: fn(P, &MorphologyModel) -> Result<K, (String, String, String)>,
    ) where
        P: DeserializeOwned + 'static,
        K: CommandKind,
    {
        let build: CommandBuilder = Box::new(move |file, element, table, robot| {
            let p: P = parse_params(file, element, table)?;
            match prepare(p, robot) {
                Ok(kind) => Ok(Box::new(kind)),
                Err((key, problem, remedy)) => {
                    Err(ConfigError::invalid(file, format!("{element}.{key}"), problem, remedy))
                }
            }
        });
        self.forms.remove(&(FormKind::Command, name));
        self.commands.insert(name, RegisteredCommand { spec, build: Some(build) });
    }

    /// The kind whose numbers are a velocity of the base.
    pub(in crate::systems) fn velocity_command(&mut self, name: &'static str, spec: CommandSpec) {
        self.commands.insert(name, RegisteredCommand { spec, build: None });
    }

    /// Makes tasks that name a reward or observation term give the command that it follows. A
    /// `command_name` among the term's parameters names another command.
    pub fn needs_command(&mut self, term: &'static str, command: &'static str) {
        self.needs.entry(term).or_default().push(command);
    }

    /// Names and descriptions of all kinds of commands.
    pub fn command_specs(&self) -> impl Iterator<Item = (&'static str, &CommandSpec)> {
        self.commands.iter().map(|(name, registered)| (*name, &registered.spec))
    }

    /// A curriculum term: changes an env when its episode ends.
    pub fn curriculum<P>(&mut self, name: &'static str, f: fn(&P, &mut EpisodeEnd, &mut EnvRng))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<CurriculumFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |end: &mut EpisodeEnd, rng: &mut EnvRng| f(&p, end, rng)))
        });
        self.forms.remove(&(FormKind::Curriculum, name));
        self.curriculum.insert(name, build);
    }
}

/// A reward term's function with its arguments.
struct Reward<'a, P, F> {
    f: &'a F,
    p: &'a P,
    view: &'a RobotView<'a>,
}

impl<P, F: Fn(&P, &RobotView) -> f32> Kernel<f32> for Reward<'_, P, F> {
    type Output = f32;

    #[inline(always)]
    fn run(self) -> f32 {
        (self.f)(self.p, self.view)
    }
}
