//! Terms: the named pieces of which a task's rewards, observations, terminations and events are made.
//!
//! A term is one function and one line in a registry; its parameters come from the task's TOML and are checked when the
//! task is compiled for the robots of a run. A term that no robot of the run uses is never made.

use std::collections::BTreeMap;

use bevy_ecs::prelude::Resource;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use toml::Table;

use super::view::RobotView;
use super::{curriculum, disturb, observe, reset, reward, startup, terminate};
use crate::components::{BaseVelocity, EnvRng, Episode, ExternalWrench};
use crate::config::{ConfigError, ConfigErrorKind, EngineKind, EventMode, TaskConfig, did_you_mean, parse_params};
use crate::dynamics::Simd;
use crate::dynamics::lanes::{Entry, Kernel};
use crate::morphology::{Morphologies, MorphologyModel};

/// A term of a task cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum TermError {
    /// Its config is wrong.
    #[error(transparent)]
    Config(#[from] ConfigError),
}

/// The parameters of a term that has none.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NoParams {}

type Builder<T> = Box<dyn Fn(&str, &str, &Table) -> Result<T, ConfigError> + Send + Sync>;
type RewardFn = Box<dyn Fn(&RobotView, Entry) -> f32 + Send + Sync>;
type ObservationFn = Box<dyn Fn(&RobotView, &mut [f32]) + Send + Sync>;
type TerminationFn = Box<dyn Fn(&RobotView, &Episode, u32) -> bool + Send + Sync>;
type BodyFn = Box<dyn Fn(&mut startup::NewBody, &mut EnvRng) + Send + Sync>;
type ResetFn = Box<dyn Fn(&mut reset::NewState, &mut EnvRng) + Send + Sync>;
type CurriculumFn = Box<dyn Fn(&mut curriculum::EpisodeEnd, &mut EnvRng) + Send + Sync>;
type SizeFn = Box<dyn Fn(&TaskConfig) -> Result<usize, (String, String)> + Send + Sync>;
type IntervalFn = Box<dyn Fn(&mut EventBody, &mut EnvRng) + Send + Sync>;

/// What an interval event may change.
pub struct EventBody<'a> {
    /// What kind of robot it is.
    pub morphology: &'a MorphologyModel,
    /// Force and torque from outside; hold until the next reset or event.
    pub wrench: &'a mut ExternalWrench,
    /// Velocity of the base.
    pub velocity: &'a mut BaseVelocity,
}

/// All terms that tasks may name. Plugins may add their own before the task is compiled.
#[derive(Default)]
pub struct Registry {
    rewards: BTreeMap<&'static str, Builder<RewardFn>>,
    observations: BTreeMap<&'static str, (SizeFn, Builder<ObservationFn>)>,
    terminations: BTreeMap<&'static str, (bool, Builder<TerminationFn>)>,
    body: Events<BodyFn>,
    reset: Events<ResetFn>,
    interval: Events<IntervalFn>,
    curriculum: BTreeMap<&'static str, Builder<CurriculumFn>>,
}

/// Events by name, each with its place in the order of registration.
type Events<T> = BTreeMap<&'static str, (usize, Builder<T>)>;

impl Registry {
    /// The built-in terms.
    pub fn builtin() -> Self {
        let mut registry = Self::default();
        reward::register(&mut registry);
        observe::register(&mut registry);
        terminate::register(&mut registry);
        startup::register(&mut registry);
        reset::register(&mut registry);
        disturb::register(&mut registry);
        curriculum::register(&mut registry);
        registry
    }

    /// A reward term: its unweighted value per second. An `#[inline(always)]` function is compiled for each instruction set.
    pub fn reward<P>(&mut self, name: &'static str, f: impl Fn(&P, &RobotView) -> f32 + Copy + Send + Sync + 'static)
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<RewardFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |view: &RobotView, entry: Entry| entry.vectorize(Reward { f: &f, p: &p, view })))
        });
        self.rewards.insert(name, build);
    }

    /// An observation term of `size` numbers.
    pub fn observation<P>(&mut self, name: &'static str, size: usize, f: fn(&P, &RobotView, &mut [f32]))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        self.observation_of(name, move |_| Ok(size), f);
    }

    /// An observation term whose size depends on the task; `size` gives problem and remedy where the task does not fit.
    pub fn observation_of<P>(
        &mut self,
        name: &'static str,
        size: impl Fn(&TaskConfig) -> Result<usize, (String, String)> + Send + Sync + 'static,
        f: fn(&P, &RobotView, &mut [f32]),
    ) where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<ObservationFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |view: &RobotView, out: &mut [f32]| f(&p, view, out)))
        });
        self.observations.insert(name, (Box::new(size), build));
    }

    /// A termination term; `time_out` ones truncate an episode, others end it as failed. The last argument is the
    /// length of a full episode in control steps.
    pub fn termination<P>(&mut self, name: &'static str, time_out: bool, f: fn(&P, &RobotView, &Episode, u32) -> bool)
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<TerminationFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |view: &RobotView, episode: &Episode, most: u32| f(&p, view, episode, most)))
        });
        self.terminations.insert(name, (time_out, build));
    }

    /// An event that changes a robot's body: once with `mode = "startup"`, at each reset with `mode = "reset"`. Events
    /// happen in the order in which they are registered.
    pub fn body_event<P>(&mut self, name: &'static str, f: fn(&P, &mut startup::NewBody, &mut EnvRng))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<BodyFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |body: &mut startup::NewBody, rng: &mut EnvRng| f(&p, body, rng)))
        });
        self.body.insert(name, (self.body.len(), build));
    }

    /// An event that changes the state in which an episode begins.
    pub fn reset_event<P>(&mut self, name: &'static str, f: fn(&P, &mut reset::NewState, &mut EnvRng))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<ResetFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |state: &mut reset::NewState, rng: &mut EnvRng| f(&p, state, rng)))
        });
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
        self.interval.insert(name, (self.interval.len(), build));
    }

    /// A curriculum term: what changes for an env when its episode ends.
    pub fn curriculum<P>(&mut self, name: &'static str, f: fn(&P, &mut curriculum::EpisodeEnd, &mut EnvRng))
    where
        P: DeserializeOwned + Send + Sync + 'static,
    {
        let build: Builder<CurriculumFn> = Box::new(move |file, element, table| {
            let p: P = parse_params(file, element, table)?;
            Ok(Box::new(move |end: &mut curriculum::EpisodeEnd, rng: &mut EnvRng| f(&p, end, rng)))
        });
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

/// One term of a reward set.
pub struct RewardTerm {
    /// Its name.
    pub name: String,
    /// Factor of its value.
    pub weight: f32,
    pub(super) value: RewardFn,
}

impl RewardTerm {
    /// Its unweighted value per second for a robot.
    pub fn value(&self, robot: &RobotView) -> f32 {
        (self.value)(robot, Simd::Portable.entry())
    }
}

/// One term of the observation.
pub struct ObservationTerm {
    /// Its name.
    pub name: String,
    /// How many numbers it writes.
    pub size: usize,
    /// Half width of its uniform noise; 0 without.
    pub noise: f32,
    /// Limits of the noisy numbers.
    pub clip: Option<[f32; 2]>,
    /// Factor of the limited numbers.
    pub scale: f32,
    pub(super) write: ObservationFn,
}

/// One reason for an episode to end.
pub struct TerminationTerm {
    /// Its name.
    pub name: String,
    /// Whether it truncates the episode rather than failing it.
    pub time_out: bool,
    pub(super) ends: TerminationFn,
}

pub(super) struct IntervalEvent {
    pub(super) range_s: [f32; 2],
    pub(super) apply: IntervalFn,
}

/// A task made ready for the robots of a run.
#[derive(Resource)]
pub struct CompiledTask {
    /// The config it was made from.
    pub config: TaskConfig,
    /// Length of a control step, s.
    pub step_dt: f32,
    /// Control steps in a full episode.
    pub max_episode_length: u32,
    /// Terms of the policy's observation, in order.
    pub observations: Vec<ObservationTerm>,
    /// Terms of each morphology's reward set.
    pub rewards: Vec<Vec<RewardTerm>>,
    /// Reasons for an episode to end.
    pub terminations: Vec<TerminationTerm>,
    /// States beyond these end an episode whatever the task says.
    pub limits: terminate::StateLimits,
    pub(super) startup_events: Vec<BodyFn>,
    pub(super) reset_body_events: Vec<BodyFn>,
    pub(super) reset_events: Vec<ResetFn>,
    action_delay: Option<reset::ActionDelay>,
    pub(super) interval_events: Vec<IntervalEvent>,
    pub(super) curriculum: Vec<CurriculumFn>,
}

/// Name under which the guard against broken states appears among the terminations.
const ILLEGAL_STATE: &str = "illegal_state";

impl CompiledTask {
    /// Makes every term that the robots of the run use.
    ///
    /// # Errors
    /// A term is unknown or its parameters are wrong; a robot asks for a reward set that the task lacks.
    pub fn new(config: &TaskConfig, morphologies: &Morphologies, registry: &Registry) -> Result<Self, TermError> {
        let file = config.name.as_str();
        let step_dt = config.sim.step_dt() as f32;
        let mut observations = Vec::new();
        for (i, term) in config.observations.policy.iter().enumerate() {
            let element = format!("observations.policy[{i}]");
            let (size, build) = find(&registry.observations, &term.term, file, &element, "observation")?;
            let size = size(config)
                .map_err(|(problem, remedy)| ConfigError::invalid(file, element.as_str(), problem, remedy))?;
            observations.push(ObservationTerm {
                name: term.term.clone(),
                size,
                noise: if config.observations.enable_noise { term.noise as f32 } else { 0.0 },
                clip: term.clip.map(|range| range.map(|x| x as f32)),
                scale: term.scale as f32,
                write: build(file, &element, &term.params)?,
            });
        }
        let mut rewards = Vec::new();
        for morphology in &morphologies.0 {
            let set = &morphology.config.reward_set;
            let mut terms = Vec::new();
            for (name, term) in config.reward_set(morphology.name(), set)? {
                if term.weight == 0.0 {
                    continue;
                }
                let element = format!("rewards.{set}.{name}");
                let build = find(&registry.rewards, name, file, &element, "reward")?;
                let value = build(file, &element, &term.params)?;
                terms.push(RewardTerm { name: name.clone(), weight: term.weight as f32, value });
            }
            rewards.push(terms);
        }
        let mut terminations = Vec::new();
        let mut limits = terminate::StateLimits::default();
        for (name, params) in &config.terminations {
            let element = format!("terminations.{name}");
            if name == ILLEGAL_STATE {
                limits = parse_params(file, &element, params)?;
                continue;
            }
            let (time_out, build) = find(&registry.terminations, name, file, &element, "termination")?;
            let ends = build(file, &element, params)?;
            terminations.push(TerminationTerm { name: name.clone(), time_out: *time_out, ends });
        }
        let mut task = Self {
            step_dt,
            max_episode_length: config.sim.max_episode_length(),
            observations,
            rewards,
            terminations,
            limits,
            startup_events: Vec::new(),
            reset_body_events: Vec::new(),
            reset_events: Vec::new(),
            action_delay: None,
            interval_events: Vec::new(),
            curriculum: Vec::new(),
            config: config.clone(),
        };
        for (name, term) in config.curriculum.iter().filter(|(_, term)| term.enabled) {
            let element = format!("curriculum.{name}");
            let build = find(&registry.curriculum, name, file, &element, "curriculum")?;
            task.curriculum.push(build(file, &element, &term.params)?);
        }
        task.add_events(registry)?;
        Ok(task)
    }

    /// Makes the events that are switched on, those of a kind in the order of their registration.
    fn add_events(&mut self, registry: &Registry) -> Result<(), TermError> {
        let file = self.config.name.as_str();
        let (mut at_startup, mut on_body, mut at_reset, mut at_intervals) = (vec![], vec![], vec![], vec![]);
        for (name, event) in self.config.events.iter().filter(|(_, event)| event.enabled) {
            let element = format!("events.{name}");
            if name == startup::BODY_VARIATION && self.config.physics.engine == EngineKind::Avian {
                let problem = "the engine avian cannot change the shapes of links";
                let remedy = "set physics.engine = \"articulated\", or enabled = false";
                return Err(ConfigError::invalid(file, element, problem, remedy).into());
            }
            match event.mode {
                EventMode::Startup => {
                    let (place, build) = find(&registry.body, name, file, &element, "startup event")?;
                    at_startup.push((*place, build(file, &element, &event.params)?));
                }
                EventMode::Reset => {
                    if let Some((place, build)) = registry.body.get(name.as_str()) {
                        on_body.push((*place, build(file, &element, &event.params)?));
                    } else {
                        if name == reset::ACTION_DELAY {
                            self.action_delay = Some(parse_params(file, &element, &event.params)?);
                        }
                        let (place, build) = find(&registry.reset, name, file, &element, "reset event")?;
                        at_reset.push((*place, build(file, &element, &event.params)?));
                    }
                }
                EventMode::Interval => {
                    let (place, build) = find(&registry.interval, name, file, &element, "interval event")?;
                    let event = IntervalEvent {
                        range_s: event.interval_range_s.unwrap_or_default().map(|x| x as f32),
                        apply: build(file, &element, &event.params)?,
                    };
                    at_intervals.push((*place, event));
                }
            }
        }
        self.startup_events = in_order(at_startup);
        self.reset_body_events = in_order(on_body);
        self.reset_events = in_order(at_reset);
        self.interval_events = in_order(at_intervals);
        Ok(())
    }

    /// The most physics steps by which the task's events delay the targets of a robot, on top of its actuators' delays.
    pub fn max_action_delay(&self, morphology: &MorphologyModel) -> u32 {
        self.action_delay.as_ref().map_or(0, |event| event.range(morphology)[1])
    }

    /// Numbers in an observation.
    pub fn num_obs(&self) -> usize {
        self.observations.iter().map(|term| term.size).sum()
    }

    /// Interval events that each env keeps a timer for.
    pub fn num_interval_events(&self) -> usize {
        self.interval_events.len()
    }

    /// Names of the bits of [`Episode::causes`].
    pub fn cause_names(&self) -> impl Iterator<Item = &str> {
        std::iter::once(ILLEGAL_STATE).chain(self.terminations.iter().map(|term| term.name.as_str()))
    }
}

fn in_order<T>(mut events: Vec<(usize, T)>) -> Vec<T> {
    events.sort_by_key(|(place, _)| *place);
    events.into_iter().map(|(_, event)| event).collect()
}

fn find<'a, T>(
    terms: &'a BTreeMap<&'static str, T>,
    name: &str,
    file: &str,
    element: &str,
    kind: &str,
) -> Result<&'a T, ConfigError> {
    terms.get(name).ok_or_else(|| {
        let plural = format!("{kind} terms");
        let remedy = did_you_mean(name, terms.keys().copied(), &plural);
        ConfigError::invalid(file, element, format!("there is no {kind} term `{name}`"), remedy)
            .of_kind(ConfigErrorKind::UnknownName)
    })
}
