//! The engines that tasks may name, and the inputs of their factories.

use std::collections::BTreeMap;
use std::sync::Arc;

use bevy_ecs::prelude::Resource;

use super::{Engine, EngineChoice, MorphologySetup, OnDevice, TaskEngine, make};
use crate::blocks::BlockSizes;
use crate::config::{ConfigError, ConfigErrorKind, TaskConfig, did_you_mean};
use crate::dynamics::lanes::Simd;
use crate::dynamics::{ContactSettings, Plane, StepSettings};
use crate::error::Error;
use crate::morphology::MorphologyModel;
use crate::obstacles;
use crate::workers::{Workers, packs_of};
use crate::world::Ground;

/// Inputs from which an engine of a task is made.
#[derive(Clone, Copy)]
pub struct EngineSetup<'a> {
    /// The task: physics steps, gravity, scene and the `[physics]` table.
    pub task: &'a TaskConfig,
    /// The robots' morphologies.
    pub morphologies: &'a [MorphologyModel],
    /// Number of envs of each, in contiguous blocks.
    pub blocks: &'a BlockSizes,
    /// Ground that the robots stand on, and gravity.
    pub ground: &'a Ground,
    /// The instruction set that was asked for.
    pub simd: Simd,
    /// The threads that will step.
    pub workers: &'a Workers,
}

impl EngineSetup<'_> {
    /// Physics step (s), steps in a control step, gravity (m/s^2) and contacts of the task, with
    /// robots that stand on this plane.
    pub fn step_settings(&self, plane: Option<Plane>) -> StepSettings {
        let (sim, physics) = (&self.task.sim, &self.task.physics);
        StepSettings {
            dt: sim.dt,
            decimation: sim.decimation as usize,
            gravity: self.ground.gravity,
            contact: ContactSettings {
                iterations: physics.solver_iterations as usize,
                correction: physics.depenetration_rate,
                max_depenetration_velocity: physics.max_depenetration_velocity,
                ground: plane,
                ..ContactSettings::default()
            },
        }
    }

    /// The plane of the ground, under the terrain if there is some.
    pub(super) fn plane(&self) -> Option<Plane> {
        Some(Plane::level(self.ground.height))
    }

    /// The articulated engine on the CPU.
    pub(super) fn make_articulated(&self) -> Result<Box<dyn Engine>, Error> {
        self.make(EngineChoice::Articulated(self.simd, self.ground.terrain.clone()), self.plane())
    }

    fn make(&self, choice: EngineChoice, plane: Option<Plane>) -> Result<Box<dyn Engine>, Error> {
        let blocks = self.morphologies.iter().zip(&self.blocks.0);
        let setups: Vec<MorphologySetup<f32>> =
            blocks.map(|(morphology, &count)| MorphologySetup::of_morphology(morphology, count)).collect();
        match make(choice, self.step_settings(plane), &setups, self.workers) {
            Ok(engine) => Ok(Box::new(TaskEngine(engine))),
            Err(error) => {
                let remedy = "use \"articulated\", or another sim.dt or robot";
                Err(Error::argument("physics.engine", error.to_string(), remedy))
            }
        }
    }
}

/// Makes engines of one name.
pub trait EngineFactory: Send + Sync + 'static {
    /// Whether links may have other lengths in each env and episode, by the event `body_variation`.
    /// Default: no.
    fn varies_shapes(&self) -> bool {
        false
    }

    /// Whether torsional and rolling friction act. Default: no.
    fn has_spin_friction(&self) -> bool {
        false
    }

    /// The engine whose bits this one has: snapshots and checkpoints of one are the other's.
    /// Default: no other.
    fn bits_of(&self) -> Option<&'static str> {
        None
    }

    /// Number of pieces of work that threads can share; no more threads than pieces are made.
    /// Default: one for each env.
    fn pieces(&self, blocks: &BlockSizes) -> usize {
        blocks.num_envs()
    }

    /// The engine of a task.
    ///
    /// # Errors
    /// A feature of the task or its robots that the engine cannot simulate, with a remedy.
    fn make(&self, setup: &EngineSetup) -> Result<Box<dyn Engine>, Error>;
}

/// The engines that a task may name as `physics.engine`. Plugins add their own to it in `build`: it
/// is a resource of the app.
#[derive(Resource, Clone)]
pub struct Engines(BTreeMap<&'static str, Arc<dyn EngineFactory>>);

impl Default for Engines {
    /// The built-in ones.
    fn default() -> Self {
        let mut engines = Self(BTreeMap::new());
        engines.add("articulated", Articulated);
        engines.add("avian", Avian);
        engines.add("cuda", OnDevice::new(OnDevice::open_card));
        engines.add("auto", OnDevice::if_faster(OnDevice::open_card));
        engines
    }
}

impl Engines {
    /// Adds an engine, or replaces the engine of that name.
    pub fn add(&mut self, name: &'static str, factory: impl EngineFactory) {
        self.0.insert(name, Arc::new(factory));
    }

    /// The engine that a task names.
    ///
    /// # Errors
    /// An engine that no plugin has added.
    pub fn of(&self, task: &TaskConfig) -> Result<&dyn EngineFactory, ConfigError> {
        let name = task.physics.engine.as_str();
        self.0.get(name).map(Arc::as_ref).ok_or_else(|| {
            let remedy = did_you_mean(name, self.0.keys().copied(), "engines");
            ConfigError::invalid(task.name.as_str(), "physics.engine", format!("there is no engine `{name}`"), remedy)
                .of_kind(ConfigErrorKind::UnknownName)
        })
    }
}

/// Reduced coordinates, many robots in SIMD lanes.
struct Articulated;

impl EngineFactory for Articulated {
    fn varies_shapes(&self) -> bool {
        true
    }

    fn has_spin_friction(&self) -> bool {
        true
    }

    fn pieces(&self, blocks: &BlockSizes) -> usize {
        blocks.0.iter().map(|&count| packs_of(count)).sum()
    }

    fn make(&self, setup: &EngineSetup) -> Result<Box<dyn Engine>, Error> {
        setup.make_articulated()
    }
}

/// Links as Avian's rigid bodies.
struct Avian;

impl EngineFactory for Avian {
    fn make(&self, setup: &EngineSetup) -> Result<Box<dyn Engine>, Error> {
        let (scene, ground) = (&setup.task.scene, setup.ground);
        let obstacles = scene.obstacles.iter().flat_map(obstacles::parts);
        let terrain = scene.terrain.as_ref().zip(ground.layout.as_ref());
        let terrain = terrain.and_then(|(terrain, layout)| obstacles::terrain(terrain, layout));
        let floor = obstacles::floor(&scene.pits());
        let plane = Some(Plane::level(ground.height)).filter(|_| ground.layout.is_none() && floor.is_none());
        let statics = obstacles.chain(terrain).chain(floor).collect();
        setup.make(EngineChoice::Avian(setup.task.physics.avian_substeps as usize, statics), plane)
    }
}
