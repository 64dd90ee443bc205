//! Assembles the Bevy app from a task and its robots, spawns envs, robots and sensors, and steps them.

use std::path::{Path, PathBuf};

use bevy_app::App;
use bevy_ecs::prelude::*;
use smallvec::smallvec;

use crate::batch::Batch;
use crate::bounds::{BYTES_PER_ENV, MAX_ACTION, check_num_envs};
use crate::components::{
    Action, ActuatorDelay, BasePose, BaseVelocity, Body, Command, ConstraintImpulses, ContactForces, ContactSensor,
    Env, EnvId, EnvOrigin, EnvRng, Episode, EpisodeSums, EventTimers, ExternalWrench, Feet, HeightScan, Imu,
    JointEffort, JointState, JointTargets, Morphology, MountedOn, PerJoint, Robot, StartupBody,
};
use crate::config::{ConfigError, EngineKind, Library, LoadedRobot, LoadedTask};
use crate::dump::DumpError;
use crate::dynamics::Simd;
use crate::dynamics::lanes::SimdError;
use crate::mirrors::LinkMirrors;
use crate::morphology::{Morphologies, MorphologyError, MorphologyModel};
use crate::robot::CANONICAL_JOINT_NAMES;
use crate::rows::{Workers, packs_of};
use crate::systems::{
    Autoreset, BlockSizes, BrokenStates, CompiledTask, ControlStep, Logs, PhysicsEngine, PipelinePlugin, Registry,
    ResetEnvs, ResetRequest, ScanRays, TermError, history_length, place_envs, randomise_at_startup,
};
use crate::world::{WorldError, WorldPlugin};

/// A simulation could not be made or stepped.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// A task's or robot's config.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A robot's URDF or config.
    #[error(transparent)]
    Morphology(#[from] MorphologyError),
    /// A term of the task.
    #[error(transparent)]
    Term(#[from] TermError),
    /// The instruction set asked for.
    #[error(transparent)]
    Simd(#[from] SimdError),
    /// The world that the robots stand in.
    #[error(transparent)]
    World(#[from] WorldError),
    /// An argument.
    #[error("{element}: {problem}; {remedy}")]
    Argument {
        /// Which one.
        element: &'static str,
        /// What is wrong with it.
        problem: String,
        /// What to do.
        remedy: String,
    },
    /// A snapshot.
    #[error("snapshot: {0}")]
    Snapshot(String),
    /// The dump of a broken state.
    #[error(transparent)]
    Dump(#[from] DumpError),
}

pub(crate) fn argument(element: &'static str, problem: impl Into<String>, remedy: impl Into<String>) -> SimError {
    SimError::Argument { element, problem: problem.into(), remedy: remedy.into() }
}

/// What a simulation is made of.
#[derive(Clone, Debug)]
pub struct SimOptions {
    /// Name, alias or path of the task.
    pub task: String,
    /// Names or paths of the robots; the task's own list when absent.
    pub robots: Option<Vec<String>>,
    /// Number of envs, shared out among the robots.
    pub num_envs: usize,
    /// Seed of all random streams.
    pub seed: u64,
    /// Threads; all cores when absent. Only as many are made as there are packs of envs.
    pub threads: Option<usize>,
    /// `key=value` changes to the task.
    pub overrides: Vec<String>,
    /// Who resets ended episodes.
    pub autoreset: Autoreset,
    /// Directories laid out like the project in which configs and assets are looked for first.
    pub roots: Vec<PathBuf>,
    /// Instruction set of the physics; the fastest one, or what `POLYPOD_SIMD` says, when absent.
    pub simd: Option<Simd>,
    /// Directory for the dump of the first state of each robot that breaks; none is dumped when absent.
    pub dump_dir: Option<PathBuf>,
}

impl SimOptions {
    /// Defaults for a task: its robots, seed 0, all cores.
    pub fn new(task: impl Into<String>, num_envs: usize) -> Self {
        Self {
            task: task.into(),
            robots: None,
            num_envs,
            seed: 0,
            threads: None,
            overrides: Vec::new(),
            autoreset: Autoreset::SameStep,
            roots: Vec::new(),
            simd: None,
            dump_dir: None,
        }
    }
}

/// Envs per robot: equal shares, the remainder to the first ones, in contiguous blocks.
pub fn distribute(num_envs: usize, robots: usize) -> Vec<usize> {
    (0..robots).map(|r| num_envs / robots + usize::from(r < num_envs % robots)).collect()
}

/// A headless Bevy app of many envs, ready to step.
///
/// What it was made from and the schedules are in its world; plugins may have added more.
pub struct Sim {
    world: World,
    task: LoadedTask,
    robots: Vec<LoadedRobot>,
    counts: Vec<usize>,
    seed: u64,
    simd: Simd,
    dump_dir: Option<PathBuf>,
}

impl Sim {
    /// Loads the task and its robots, spawns everything and resets all envs.
    ///
    /// # Errors
    /// Whatever is wrong with the options, the configs or the URDFs.
    pub fn new(options: &SimOptions) -> Result<Self, SimError> {
        Self::with_registry(options, &Registry::builtin())
    }

    /// The same with terms of one's own.
    ///
    /// # Errors
    /// As [`Sim::new`].
    pub fn with_registry(options: &SimOptions, registry: &Registry) -> Result<Self, SimError> {
        let library = Library::new(options.roots.clone());
        let task = library.task(&options.task, &options.overrides)?;
        let names = options.robots.clone().unwrap_or_else(|| task.config.robots.clone());
        check_arguments(&names, options.num_envs, options.threads)?;
        let robots = names.iter().map(|name| library.robot_in(name, &task.config)).collect::<Result<Vec<_>, _>>()?;
        check_distinct(&robots)?;
        Self::assemble(options, task, robots, registry)
    }

    /// The same of a task and robots that are loaded.
    pub(crate) fn assemble(
        options: &SimOptions,
        task: LoadedTask,
        robots: Vec<LoadedRobot>,
        registry: &Registry,
    ) -> Result<Self, SimError> {
        let morphologies = robots.iter().map(MorphologyModel::new).collect::<Result<Vec<_>, _>>()?;
        for warning in morphologies.iter().flat_map(|m| &m.model.warnings) {
            tracing::warn!("{warning}");
        }
        let mut morphologies = Morphologies(morphologies);
        let compiled = CompiledTask::new(&task.config, &morphologies, registry)?;
        for morphology in &mut morphologies.0 {
            morphology.allow_action_delay(compiled.max_action_delay(morphology));
        }
        let counts = distribute(options.num_envs, robots.len());
        let simd = Simd::choose(options.simd)?;

        let mut app = App::empty();
        app.add_plugins((WorldPlugin::new(&task.config), PipelinePlugin));
        app.finish();
        app.cleanup();
        let world = app.world_mut();
        let ground = crate::world::bake_ground(world, &task.config.scene)?;
        // a robot at a time, or a pack of one kind
        let pieces = match task.config.physics.engine {
            EngineKind::Avian => options.num_envs,
            EngineKind::Articulated => counts.iter().map(|&count| packs_of(count)).sum(),
        };
        let workers = Workers::for_pieces(options.threads, pieces, simd);
        let engine =
            PhysicsEngine::new(simd, &compiled, &morphologies, &counts, &ground, &workers).map_err(|error| {
                argument("physics.engine", error.to_string(), "use \"articulated\", or another sim.dt or robot")
            })?;
        world.insert_resource(engine);
        world.insert_resource(workers);
        world.insert_resource(Batch::new(options.num_envs, compiled.num_obs(), CANONICAL_JOINT_NAMES.len()));
        world.insert_resource(Logs::new(&compiled));
        world.insert_resource(options.autoreset);
        world.insert_resource(BrokenStates::new(robots.len()));
        let rays = ScanRays::new(task.config.sensors.height_scanner.as_ref());
        spawn(world, &morphologies, &compiled, &counts, rays.len());
        world.insert_resource(rays);
        if task.config.physics.mirror_links {
            LinkMirrors::spawn(world, &task.config, &morphologies, &counts);
        }
        world.insert_resource(BlockSizes(counts.clone()));
        world.insert_resource(morphologies);
        world.insert_resource(compiled);
        world.insert_resource(ground);
        let world = std::mem::take(app.world_mut());
        let mut sim = Self { world, task, robots, counts, seed: options.seed, simd, dump_dir: None };
        sim.set_dump_dir(options.dump_dir.clone());
        sim.reset(Some(options.seed), None)?;
        Ok(sim)
    }

    /// One control step of all envs with these actions, row-major `[num_envs, 12]`, canonical order.
    ///
    /// # Errors
    /// The wrong number of actions, or one that is not finite or beyond [`MAX_ACTION`]; the simulation is then as it was.
    pub fn step(&mut self, actions: &[f32]) -> Result<(), SimError> {
        let mut batch = self.world.resource_mut::<Batch>();
        if actions.len() != batch.actions.len() {
            return Err(argument(
                "actions",
                format!("{} numbers for {} envs of {} actions", actions.len(), batch.num_envs, batch.num_actions),
                "pass one row of canonical actions per env",
            ));
        }
        // all of them at once, and only then one by one
        let within = |a: &f32| a.abs() <= MAX_ACTION;
        let all_within = actions.iter().fold(true, |all, a| all & within(a));
        if !all_within && let Some(at) = actions.iter().position(|a| !within(a)) {
            let (env, joint) = (at / batch.num_actions, CANONICAL_JOINT_NAMES[at % batch.num_actions]);
            return Err(argument(
                "actions",
                format!("the action of env {env} for {joint} is {}", actions[at]),
                format!("pass finite numbers within {MAX_ACTION}; a policy that gives others has diverged"),
            ));
        }
        batch.actions.copy_from_slice(actions);
        self.world.resource_mut::<ResetRequest>().0 = false;
        self.world.run_schedule(ControlStep);
        self.dump_broken_states();
        Ok(())
    }

    /// Begins new episodes: in the envs of the mask, or in all.
    ///
    /// With a seed everything is as if the simulation had been made anew with it: random streams, and what is randomised
    /// at startup.
    ///
    /// # Errors
    /// A mask of the wrong length, or a seed together with a mask.
    pub fn reset(&mut self, seed: Option<u64>, mask: Option<&[bool]>) -> Result<(), SimError> {
        let num_envs = self.num_envs();
        if let Some(mask) = mask {
            if mask.len() != num_envs {
                let problem = format!("{} entries for {num_envs} envs", mask.len());
                return Err(argument("mask", problem, "pass one entry per env"));
            }
            if seed.is_some() {
                return Err(argument("seed", "given together with a mask", "seed all envs at once, or reset some"));
            }
        }
        if let Some(seed) = seed {
            self.seed = seed;
            self.start_anew();
        }
        for (env, mut episode) in self.world.query::<(&EnvId, &mut Episode)>().iter_mut(&mut self.world) {
            episode.needs_reset = mask.is_none_or(|mask| mask[env.0 as usize]);
            episode.fresh = false;
        }
        self.world.resource_mut::<ResetRequest>().0 = true;
        self.world.run_schedule(ResetEnvs);
        Ok(())
    }

    fn start_anew(&mut self) {
        let names: Vec<String> = self.morphologies().iter().map(|m| m.name().to_string()).collect();
        let mut query = self.world.query::<(&EnvId, &Morphology, &mut EnvRng)>();
        let firsts: Vec<usize> = (0..names.len()).map(|index| self.env_ids(index).start).collect();
        for (env, tag, mut rng) in query.iter_mut(&mut self.world) {
            let robot = usize::from(tag.0);
            *rng = EnvRng::of_env(self.seed, &names[robot], env.0 as usize - firsts[robot]);
        }
        let nominal: Vec<_> = self.world.resource::<Morphologies>().0.iter().map(|m| m.nominal.clone()).collect();
        for (tag, mut body) in self.world.query::<(&Morphology, &mut Body)>().iter_mut(&mut self.world) {
            *body.0 = nominal[usize::from(tag.0)].clone();
        }
        for mut command in self.world.query::<&mut Command>().iter_mut(&mut self.world) {
            *command = Command::default();
        }
        for mut episode in self.world.query::<&mut Episode>().iter_mut(&mut self.world) {
            *episode = Episode::default();
        }
        // running a system once only fails when its parameters are missing, and all are inserted in `with_registry`
        let ran = self.world.run_system_cached(randomise_at_startup).and(self.world.run_system_cached(place_envs));
        if let Err(error) = ran {
            tracing::error!("startup randomisation did not run: {error}");
        }
    }

    /// The dense arrays.
    pub fn batch(&self) -> &Batch {
        self.world.resource::<Batch>()
    }

    /// The task as it runs.
    pub fn task(&self) -> &CompiledTask {
        self.world.resource::<CompiledTask>()
    }

    /// The task as it was loaded.
    pub fn loaded_task(&self) -> &LoadedTask {
        &self.task
    }

    /// The robots as they were loaded, in the order of their blocks.
    pub fn loaded_robots(&self) -> &[LoadedRobot] {
        &self.robots
    }

    /// Task and robots after layers, overrides and defaults, as TOML.
    pub fn resolved_config(&self) -> String {
        let robots = self.robots.iter().map(|r| (r.config.name.clone(), r.resolved.clone().into())).collect();
        let mut all = toml::Table::new();
        all.insert("task".into(), self.task.resolved.clone().into());
        all.insert("robots".into(), toml::Value::Table(robots));
        all.to_string()
    }

    /// A hash of [`resolved_config`](Self::resolved_config) and the robots' URDFs: of all that decides what the
    /// simulation does, but for the seed and the number of envs.
    pub fn config_hash(&self) -> u64 {
        let urdfs = self.robots.iter().map(|robot| robot.urdf_text.as_str());
        let text: String = std::iter::once(self.resolved_config().as_str()).chain(urdfs).collect();
        crate::config::fnv1a(text.as_bytes())
    }

    /// The robots' models, in the order of their blocks.
    pub fn morphologies(&self) -> &[MorphologyModel] {
        &self.world.resource::<Morphologies>().0
    }

    /// The ECS world, for queries and for plugins of one's own.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// The ECS world.
    ///
    /// Adding components to some entities of a kind but not to others would split their rows: add them to all or to new
    /// entities.
    pub fn world_mut(&mut self) -> &mut World {
        &mut self.world
    }

    /// Number of envs.
    pub fn num_envs(&self) -> usize {
        self.counts.iter().sum()
    }

    /// The envs of the robot at place `index`, `start..end`.
    pub fn env_ids(&self, index: usize) -> std::ops::Range<usize> {
        let start = self.counts.iter().take(index).sum();
        start..start + self.counts.get(index).copied().unwrap_or(0)
    }

    /// Place of an env in its robot's block.
    pub fn index_in_block(&self, env: usize) -> usize {
        let mut start = 0;
        for &count in &self.counts {
            if env < start + count {
                return env - start;
            }
            start += count;
        }
        env - start
    }

    /// Threads at work.
    pub fn threads(&self) -> usize {
        self.world.resource::<Workers>().threads()
    }

    /// Seed of the random streams.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// For a restored snapshot.
    pub(crate) fn set_seed(&mut self, seed: u64) {
        self.seed = seed;
    }

    /// Instruction set of the physics.
    pub fn simd(&self) -> Simd {
        self.simd
    }

    /// Where broken states are dumped, if they are.
    pub fn dump_dir(&self) -> Option<&Path> {
        self.dump_dir.as_deref()
    }

    /// From now on dumps the first state of each robot that breaks to a file in this directory, or none. A robot of which
    /// a state was dumped before is left out.
    pub fn set_dump_dir(&mut self, dump_dir: Option<PathBuf>) {
        self.world.resource_mut::<BrokenStates>().watch(dump_dir.is_some());
        self.dump_dir = dump_dir;
    }
}

fn check_arguments(robots: &[String], num_envs: usize, threads: Option<usize>) -> Result<(), SimError> {
    if robots.is_empty() {
        return Err(argument("robots", "the list is empty", "name at least one robot"));
    }
    if robots.len() > num_envs {
        return Err(argument(
            "num_envs",
            format!("{num_envs} envs for {} robots", robots.len()),
            format!("ask for at least {} envs, or for fewer robots", robots.len()),
        ));
    }
    check_num_envs(num_envs, BYTES_PER_ENV).map_err(|(problem, remedy)| argument("num_envs", problem, remedy))?;
    if threads == Some(0) {
        return Err(argument("threads", "0 threads", "ask for at least one, or leave it out for all cores"));
    }
    Ok(())
}

/// A name and a path may mean the same robot: what counts is the name in its config.
fn check_distinct(robots: &[LoadedRobot]) -> Result<(), SimError> {
    let name = |i: usize| robots[i].config.name.as_str();
    match (0..robots.len()).find(|&i| (0..i).any(|j| name(j) == name(i))) {
        Some(i) => {
            Err(argument("robots", format!("`{}` is listed twice, last at place {i}", name(i)), "name each robot once"))
        }
        None => Ok(()),
    }
}

/// Spawns envs, robots and sensors, each kind in the order of env ids and in one table.
fn spawn(world: &mut World, morphologies: &Morphologies, task: &CompiledTask, counts: &[usize], rays: usize) {
    let ids = counts.iter().enumerate().flat_map(|(m, &n)| std::iter::repeat_n(m, n)).enumerate();
    let tags: Vec<_> = ids.map(|(env, m)| (EnvId(env as u32), Morphology(m as u16))).collect();
    world.spawn_batch(tags.iter().map(|&(id, tag)| {
        (
            (
                id,
                tag,
                Env,
                EnvRng::new(0, u64::from(id.0)),
                Episode::default(),
                Command::default(),
                EnvOrigin::default(),
            ),
            EventTimers(smallvec![0.0; task.num_interval_events()]),
            EpisodeSums { terms: smallvec![0.0; task.rewards[usize::from(tag.0)].len()], ..EpisodeSums::default() },
        )
    }));
    let decimation = task.config.sim.decimation as usize;
    let robots: Vec<Entity> = tags
        .iter()
        .map(|&(id, tag)| world.spawn((id, tag, Robot, robot_components(morphologies.get(tag), decimation))).id())
        .collect();
    let mounted: Vec<_> = tags.iter().zip(&robots).map(|(&(id, tag), &robot)| (id, tag, MountedOn(robot))).collect();
    world.spawn_batch(mounted.iter().map(|&(id, tag, robot)| {
        let peak_force = smallvec![0.0; morphologies.get(tag).topology.num_bodies];
        (id, tag, robot, ContactSensor { peak_force, ..ContactSensor::default() })
    }));
    world.spawn_batch(mounted.iter().map(|&(id, tag, robot)| (id, tag, robot, Imu::default())));
    if rays > 0 {
        let scan = || HeightScan { hits: vec![0.0; rays].into() };
        world.spawn_batch(mounted.into_iter().map(|(id, tag, robot)| (id, tag, robot, scan())));
    }
}

fn robot_components(model: &MorphologyModel, decimation: usize) -> impl Bundle {
    let zeros: PerJoint = smallvec![0.0; model.topology.num_joints()];
    let slots: PerJoint = smallvec![0.0; CANONICAL_JOINT_NAMES.len()];
    let ages = history_length(model.max_delay(), decimation);
    (
        BasePose { position: [0.0; 3], rotation: [1.0, 0.0, 0.0, 0.0] },
        BaseVelocity::default(),
        JointState { position: zeros.clone(), velocity: zeros.clone() },
        Action { current: slots.clone(), previous: slots },
        JointTargets { history: smallvec![zeros.clone(); ages], fresh: true },
        ActuatorDelay(zeros.clone()),
        JointEffort { applied: zeros.clone(), acceleration: zeros.clone() },
        ConstraintImpulses { contacts: smallvec![], bounds: zeros },
        ContactForces::zeros(decimation),
        Feet::default(),
        (ExternalWrench::default(), model.stance.clone(), StartupBody::default()),
        Body(Box::new(model.nominal.clone())),
    )
}
