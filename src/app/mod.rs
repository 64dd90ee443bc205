//! A simulation of many envs: a headless Bevy app that is stepped by its caller.

mod changes;
pub mod dump;
mod external;
mod host;
mod learning;
mod links;
mod residence;
mod sim_queries;
pub mod snapshot;
mod stepping;
mod viewing;

use std::mem::{swap, take};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use bevy_app::{App, PluginsState, SubApps};
use bevy_ecs::prelude::*;

use crate::batch::Batch;
use crate::blocks::BlockSizes;
use crate::config::{LoadedRobot, LoadedTask, VelocityCommandConfig};
use crate::dynamics::lanes::Simd;
use crate::engine::Engines;
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::options::SimOptions;
use crate::systems::{BrokenStates, CompiledTask, InstructionSet, Loaded, PolypodPlugins, Registry, Share};
use crate::workers::Workers;

use residence::Residence;
use stepping::{check_actions, set_up};

pub use changes::{ForceRows, ParameterRows, StateRows};
pub use host::{HostPlugin, HostedStep};
pub use links::LinkRows;
pub use sim_queries::RobotStates;

/// A headless Bevy app of many envs, ready to step.
///
/// Its world holds the options, the schedules and whatever plugins have added. The plugins, the
/// sub-apps and the schedules of the app stay: see [`with_app`](Self::with_app).
pub struct Sim {
    /// World of the main app.
    world: World,
    /// The app, without the world above and without its runner. Threads share a simulation: a
    /// runner cannot be sent to another thread, and an extraction cannot be shared.
    app: Mutex<SubApps>,
    seed: u64,
    dump_dir: Option<PathBuf>,
    /// Whether the terms that the caller computes are still those of the step before.
    lacks_external: bool,
    residence: Residence,
}

impl Sim {
    /// Loads the task and its robots, spawns everything and resets all envs.
    ///
    /// # Errors
    /// Any fault of the options, the configs or the URDFs.
    pub fn new(options: &SimOptions) -> Result<Self, Error> {
        Self::with_registry(options, Registry::builtin())
    }

    /// Like [`Sim::new`], with a user's terms.
    ///
    /// # Errors
    /// As [`Sim::new`].
    pub fn with_registry(options: &SimOptions, registry: Registry) -> Result<Self, Error> {
        Self::with_resource(options, registry)
    }

    /// Like [`Sim::new`], with a resource that is inserted before the plugins: terms, or a task and
    /// robots that are loaded.
    fn with_resource(options: &SimOptions, resource: impl Resource) -> Result<Self, Error> {
        let mut app = App::empty();
        app.insert_resource(resource).insert_resource(options.clone()).add_plugins(PolypodPlugins);
        Self::from_app(app)
    }

    /// Makes a simulation of an app that has [`PolypodPlugins`], maybe some of them replaced, and
    /// [`SimOptions`] as a resource. The simulation owns the app from here on. Its runner is not
    /// called: the caller of [`step`](Self::step) takes its place. An app that goes on by itself
    /// takes [`PolypodPlugins::in_schedule`].
    ///
    /// Systems that are added to the [`PipelineSet`](crate::systems::PipelineSet)s of
    /// [`ControlStep`](crate::systems::ControlStep) run in each step.
    ///
    /// # Errors
    /// Any fault of the options, the configs, the URDFs or the plugins; a plugin that is not ready.
    pub fn from_app(mut app: App) -> Result<Self, Error> {
        let options = SimOptions::of(app.world())?;
        match app.plugins_state() {
            PluginsState::Adding => {
                let remedy = "wait until App::plugins_state() is Ready";
                return Err(Error::argument("plugins", "a plugin of the app is not ready", remedy));
            }
            PluginsState::Ready => {
                app.finish();
                app.cleanup();
            }
            PluginsState::Finished => app.cleanup(),
            PluginsState::Cleaned => (),
        }
        let mut world = take(app.world_mut());
        set_up(&mut world, options.seed)?;
        let mut sim = Self {
            world,
            app: Mutex::new(take(app.sub_apps_mut())),
            seed: options.seed,
            dump_dir: None,
            lacks_external: false,
            residence: Residence::default(),
        };
        sim.lacks_external = !sim.task().external_terms().is_empty();
        sim.set_dump_dir(options.dump_dir)?;
        Ok(sim)
    }

    /// One control step of all envs with these actions, row-major `[num_envs, num_actions]`, in the
    /// columns of [`slots`](Self::slots). An action for a joint that a robot lacks does nothing.
    ///
    /// # Errors
    /// The wrong number of actions, or one that is not finite or beyond
    /// [`MAX_ACTION`](crate::bounds::MAX_ACTION); the simulation is then as it was. Or a system
    /// failed: the sets of the pipeline after it have not run then.
    pub fn step(&mut self, actions: &[f32]) -> Result<(), Error> {
        self.check_external()?;
        self.fetch_batch()?;
        check_actions(&self.world, actions)?;
        self.world.resource_mut::<Batch>().actions.copy_from_slice(actions);
        self.step_where_the_state_is()?;
        self.lacks_external = !self.task().external_terms().is_empty();
        self.dump_broken_states();
        Ok(())
    }

    /// Refuses steps without the numbers of terms that the caller computes.
    fn check_external(&self) -> Result<(), Error> {
        if self.lacks_external {
            let terms = self.task().external_terms().join(", ");
            let problem = format!("the terms {terms} are computed by the simulation's caller, who gave no numbers");
            let remedy = "in Python: name their file, --terms FILE or polypod.make(..., terms=FILE); in Rust: call \
                          Sim::observe_external after each step and reset";
            return Err(Error::argument("observations", problem, remedy));
        }
        Ok(())
    }

    /// Mask of the actions that each env's robot has a joint for, row-major `[num_envs,
    /// num_actions]`.
    pub fn action_mask(&self) -> Vec<bool> {
        let (blocks, width) = (&self.world.resource::<BlockSizes>().0, self.batch().num_actions);
        let masks =
            self.morphologies().iter().zip(blocks).map(|(robot, &count)| robot.action_mask(width).repeat(count));
        masks.flatten().collect()
    }

    /// Begins new episodes: in the envs of the mask, or in all.
    ///
    /// A seed restarts the random streams and repeats the startup events, as a new simulation with
    /// that seed does.
    ///
    /// # Errors
    /// A mask of the wrong length, or a seed together with a mask.
    pub fn reset(&mut self, seed: Option<u64>, mask: Option<&[bool]>) -> Result<(), Error> {
        stepping::reset(self.world_mut(), seed, mask)?;
        self.seed = seed.unwrap_or(self.seed);
        self.lacks_external = !self.task().external_terms().is_empty();
        Ok(())
    }

    /// The dense arrays of the last control step, see [`step_device`](Self::step_device) too.
    pub fn batch(&self) -> &Batch {
        self.world.resource::<Batch>()
    }

    /// The task as it runs.
    pub fn task(&self) -> &CompiledTask {
        self.world.resource::<CompiledTask>()
    }

    /// The task as it was loaded.
    pub fn loaded_task(&self) -> &LoadedTask {
        &self.world.resource::<Loaded>().task
    }

    /// The robots as they were loaded, in the order of their blocks.
    pub fn loaded_robots(&self) -> &[LoadedRobot] {
        &self.world.resource::<Loaded>().robots
    }

    /// Task and robots after layers, overrides and defaults, as TOML.
    pub fn resolved_config(&self) -> String {
        self.config_with(|_| ())
    }

    /// The resolved config, equal for engines with the same bits: it names the engine whose bits
    /// they are.
    fn config_of_bits(&self) -> String {
        let engine =
            self.world.get_resource::<Engines>().and_then(|engines| engines.of(&self.task().config).ok()?.bits_of());
        self.config_with(|task| {
            if let (Some(engine), Some(toml::Value::Table(physics))) = (engine, task.get_mut("physics")) {
                physics.insert("engine".into(), engine.into());
            }
        })
    }

    fn config_with(&self, edit: impl FnOnce(&mut toml::Table)) -> String {
        let robots = self.loaded_robots().iter().map(|r| (r.config.name.clone(), r.resolved.clone().into())).collect();
        let mut task = self.loaded_task().resolved.clone();
        edit(&mut task);
        let mut all = toml::Table::new();
        all.insert("task".into(), task.into());
        all.insert("robots".into(), toml::Value::Table(robots));
        all.to_string()
    }

    /// A hash of [`resolved_config`](Self::resolved_config) and the robots' URDFs. It covers all
    /// that decides the simulation, except the seed and the number of envs.
    pub fn config_hash(&self) -> u64 {
        let urdfs = self.loaded_robots().iter().map(|robot| robot.urdf_text.as_str());
        let text: String = std::iter::once(self.config_of_bits().as_str()).chain(urdfs).collect();
        crate::hash::fnv1a(text.as_bytes())
    }

    /// The robots' models, in the order of their blocks.
    pub fn morphologies(&self) -> &[MorphologyModel] {
        &self.world.resource::<Morphologies>().0
    }

    /// The velocity commands of each robot, in the order of their blocks: the task's, within the
    /// robot's limits.
    pub fn velocity_commands(&self) -> &[VelocityCommandConfig] {
        &self.task().commands
    }

    /// The ECS world, for queries and for a user's plugins.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// The ECS world.
    ///
    /// A component may be given to all entities of a kind and morphology, or to some where it has
    /// `#[component(storage = "SparseSet")]`; the next step is refused otherwise, see
    /// [`blocks`](crate::blocks).
    pub fn world_mut(&mut self) -> &mut World {
        self.return_to_host();
        &mut self.world
    }

    /// Reads or changes the app: its plugins, its sub-apps and its worlds.
    ///
    /// A step runs [`ControlStep`](crate::systems::ControlStep) and nothing else of the app.
    /// `sim.with_app(SubApps::update)` does what [`App::update`] does: it runs the app's own
    /// schedules, then extraction and schedules of each sub-app. Errors of these systems reach the
    /// app's own handler. Avian has systems in them, which read the clock of
    /// [`TimePlugin`](bevy_time::TimePlugin).
    pub fn with_app<T>(&mut self, f: impl FnOnce(&mut SubApps) -> T) -> T {
        self.return_to_host();
        let app = self.app.get_mut().unwrap_or_else(PoisonError::into_inner);
        swap(app.main.world_mut(), &mut self.world);
        let done = f(app);
        swap(app.main.world_mut(), &mut self.world);
        done
    }

    /// Number of envs that are simulated here.
    pub fn num_envs(&self) -> usize {
        self.world.resource::<BlockSizes>().num_envs()
    }

    /// Range of these envs within the whole batch.
    pub fn share(&self) -> &Share {
        self.world.resource::<Share>()
    }

    /// The rows of the robot at place `index`, `start..end`.
    pub fn env_ids(&self, index: usize) -> std::ops::Range<usize> {
        let blocks = self.world.resource::<BlockSizes>();
        blocks.iter().nth(index).map_or(blocks.num_envs()..blocks.num_envs(), |(_, envs)| envs)
    }

    /// Threads at work.
    pub fn threads(&self) -> usize {
        self.world.resource::<Workers>().threads()
    }

    /// Seed of the random streams.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Instruction set of the physics.
    pub fn simd(&self) -> Simd {
        self.world.resource::<InstructionSet>().0
    }

    /// Folder for dumps of broken states, if they are dumped.
    pub fn dump_dir(&self) -> Option<&Path> {
        self.dump_dir.as_deref()
    }

    /// Sets the directory for dumps: one file for the first broken state of each robot. None
    /// switches dumps off. A robot with a dump is not dumped again.
    ///
    /// # Errors
    /// A path that names no possible folder.
    pub fn set_dump_dir(&mut self, dump_dir: Option<PathBuf>) -> Result<(), Error> {
        if dump_dir.as_ref().is_some_and(|dir| dir.as_os_str().as_encoded_bytes().contains(&0)) {
            return Err(Error::argument("dump_dir", "the path has a zero byte", "name a folder"));
        }
        if let Some(mut broken) = self.world_mut().get_resource_mut::<BrokenStates>() {
            broken.watch(dump_dir.is_some());
        }
        self.dump_dir = dump_dir;
        Ok(())
    }
}
