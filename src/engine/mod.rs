#![doc = include_str!("README.md")]

pub(crate) mod articulated;
pub(crate) mod avian;
mod cuda;
pub(crate) mod device;
mod divergence;
mod limits;
mod registry;
mod rows;

use std::sync::Arc;

use glam::DMat3;

use crate::blocks::BlockList;
use crate::dynamics::lanes::{Simd, SimdToken};
use crate::dynamics::{
    ActuatorNetwork, HeightGrid, Kernels, Parameters, State, StepSettings, Topology, WithKernels, with_kernels,
};
use crate::morphology::MorphologyModel;
use crate::obstacles::Part;
use crate::robot::{BodyGroup, Model};
use crate::workers::Workers;
use articulated::Packs;
use avian::{AvianRobots, EngineError};

pub use cuda::{BrokenRobot, OnDevice, WholeSteps, describe_card, open_update_card, search_packages};
pub use divergence::{DivergenceRecord, Motion};
pub(crate) use limits::StateNumbers;
pub use limits::{Quantity, StateLimits, Violation};
pub use polypod_cuda::{DeviceRows, RowSizes, RowsMemory, RowsOf};
pub use registry::{EngineFactory, EngineSetup, Engines};
pub use rows::RobotSlices;
pub(crate) use rows::{Components, Contacts, RobotColumns, RobotRows, RowFamily, clear_drive};

/// Steps the bodies of a task's robots.
///
/// The pipeline keeps the robots' states in components and hands them over in blocks: slices of one
/// morphology's robots, in the order of their envs. An engine reads states, targets and wrenches
/// there, makes the physics steps of a control step, and writes states and reports. It may keep
/// more between control steps, such as the same columns in a device's memory.
///
/// A robot's motion depends on its own row and numbers alone, and no bit depends on the number of
/// threads. A state that is not finite stays in its row: the pipeline ends the episode.
pub trait Engine: Send + Sync {
    /// Takes over the parameters of an env's robot (masses, lengths, gains, friction): of all
    /// robots before the first step, and then of those that have changed.
    fn upload(&mut self, env: usize, parameters: &Parameters<f32>);

    /// Makes the physics steps of a control step. For each morphology that `run` watches, returns
    /// the record of the first env whose new state is beyond the limits. States of an engine that
    /// returns no records are not dumped.
    fn step(&mut self, workers: &Workers, robots: BlockList<RobotSlices<'_>>, run: Run) -> Vec<DivergenceRecord>;

    /// Forgets what it keeps of an env beyond its components, such as the contacts of the last
    /// step: a caller has set the env's state. Default: nothing is kept.
    fn restart(&mut self, _env: usize) {}

    /// Bytes of each env that decide how it goes on, beyond its components. Default: empty.
    ///
    /// # Errors
    /// Why it cannot be written.
    fn save(&self) -> Result<Vec<Vec<u8>>, String> {
        Ok(Vec::new())
    }

    /// Checks bytes of a snapshot, and changes nothing. Default: there must be no bytes.
    ///
    /// # Errors
    /// An error says what is wrong with the bytes.
    fn check(&self, envs: &[Vec<u8>]) -> Result<(), String> {
        if envs.is_empty() { Ok(()) } else { Err("the engine keeps nothing".into()) }
    }

    /// Restores what [`save`](Self::save) returned, once components and parameters are set; bytes
    /// that [`check`](Self::check) refuses change nothing.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    fn load(&mut self, envs: &[Vec<u8>]) -> Result<(), String> {
        self.check(envs)
    }

    /// The engine's device, where that makes whole control steps. Default: there is none.
    fn whole_steps(&mut self) -> Option<&mut dyn WholeSteps> {
        None
    }
}

/// An engine of rows as an [`Engine`] of the pipeline.
struct TaskEngine(Box<dyn RowEngine<Components>>);

impl Engine for TaskEngine {
    fn upload(&mut self, env: usize, parameters: &Parameters<f32>) {
        self.0.upload(env, parameters);
    }

    fn step(&mut self, workers: &Workers, robots: BlockList<RobotSlices<'_>>, run: Run) -> Vec<DivergenceRecord> {
        self.0.step(workers, robots, run)
    }

    fn restart(&mut self, env: usize) {
        self.0.forget(env);
    }

    fn save(&self) -> Result<Vec<Vec<u8>>, String> {
        self.0.save().map_err(|error| error.to_string())
    }

    fn check(&self, envs: &[Vec<u8>]) -> Result<(), String> {
        self.0.check(envs).map_err(|error| error.to_string())
    }

    fn load(&mut self, envs: &[Vec<u8>]) -> Result<(), String> {
        self.0.load(envs).map_err(|error| error.to_string())
    }
}

/// Steps the bodies of all robots. The caller keeps them in rows of one family.
pub(crate) trait RowEngine<F: RowFamily>: Send + Sync {
    /// Bytes of each env that decide how it goes on, beyond its rows.
    fn save(&self) -> Result<Vec<Vec<u8>>, postcard::Error> {
        Ok(Vec::new())
    }
    /// Whether the bytes are those of [`save`](Self::save) for this engine.
    fn check(&self, envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        if envs.is_empty() { Ok(()) } else { Err(postcard::Error::DeserializeBadEncoding) }
    }
    /// Restores the bytes, once the rows and the robots' parameters are set; bytes that
    /// [`RowEngine::check`] refuses change nothing.
    fn load(&mut self, _envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        Ok(())
    }
    /// Takes over a robot's parameters.
    fn upload(&mut self, env: usize, parameters: &Parameters<F::Number>);
    /// Sets the joints of a morphology's robots whose gains are explicit: they act on the beginning
    /// of each physics step.
    fn set_explicit(&mut self, morphology: usize, explicit: &[bool]);
    /// Writes state and report of a [resident](RowFamily::RESIDENT) robot to the first of these
    /// rows.
    fn fetch(&self, env: usize, rows: F::Rows<'_>);
    /// Sets state and report of a resident robot to those of the first row.
    fn restart(&mut self, env: usize, rows: F::Rows<'_>);
    /// Forgets what it keeps of a robot that lives in rows beyond its row.
    fn forget(&mut self, _env: usize) {}
    /// Makes `run.steps` physics steps of all robots, one block for each morphology. For each
    /// morphology that `run` watches, returns the record of the first env whose new state is
    /// broken.
    fn step(&mut self, workers: &Workers, blocks: BlockList<F::Rows<'_>>, run: Run) -> Vec<DivergenceRecord>;
    /// Largest distance of the links' origins from those of forward kinematics, m.
    fn link_drift(&self, _env: usize) -> f64 {
        0.0
    }
}

/// Task of one [`Engine::step`].
#[derive(Clone, Copy)]
pub struct Run<'a> {
    /// Number of physics steps.
    pub steps: usize,
    /// Whether the gains pull to the targets, as in a task. Without them the feed-forward efforts
    /// act alone.
    pub gains: bool,
    /// Limits beyond which a state is broken.
    pub limits: &'a StateLimits,
    /// Whether to look for broken states, `[morphologies]`.
    pub watched: &'a [bool],
}

/// An engine's view of one morphology; `T` is the type of its rows' numbers.
pub(crate) struct MorphologySetup<'a, T> {
    pub(crate) model: &'a Model,
    pub(crate) topology: &'a Topology,
    /// Turns a link's URDF axes into those of the engine, `[links]`.
    pub(crate) align: &'a [DMat3],
    /// Collision shapes that may touch each other, counted body after body.
    pub(crate) shape_pairs: &'a [[usize; 2]],
    /// Initial parameters of every robot.
    pub(crate) nominal: &'a Parameters<T>,
    /// Group of each contact body, by which robots are sorted into packs. Resident robots are not
    /// sorted and need none.
    pub(crate) body_groups: &'a [BodyGroup],
    /// Contact bodies whose forces are reported in every physics step.
    pub(crate) feet: &'a [usize],
    /// Networks that drive joints.
    pub(crate) networks: &'a [ActuatorNetwork],
    /// Largest delay of a target, physics steps.
    pub(crate) max_delay: u32,
    /// Number of robots.
    pub(crate) count: usize,
}

impl<'a> MorphologySetup<'a, f32> {
    /// `count` robots of a morphology.
    pub(crate) fn of_morphology(morphology: &'a MorphologyModel, count: usize) -> Self {
        let MorphologyModel { model, topology, align, shape_pairs, nominal, body_groups, feet, networks, .. } =
            morphology;
        let max_delay = morphology.max_delay();
        Self { model, topology, align, shape_pairs, nominal, body_groups, feet, networks, max_delay, count }
    }
}

/// Engine, and the precision in which it computes.
pub(crate) enum EngineChoice {
    /// Articulated bodies in single precision on an instruction set. Robots stand on the terrain,
    /// or else on the plane of the settings.
    Articulated(Simd, Option<Arc<HeightGrid>>),
    /// Articulated bodies in double precision, one robot at a time.
    ArticulatedDouble,
    /// Avian with a number of substeps, and with the parts of obstacles on the plane of the
    /// settings.
    Avian(usize, Vec<Part>),
}

/// The engine of a choice for robots of some morphologies, which are in contiguous blocks of rows.
///
/// # Errors
/// A feature that Avian's engine cannot simulate.
pub(crate) fn make<F: RowFamily>(
    choice: EngineChoice,
    settings: StepSettings,
    setups: &[MorphologySetup<F::Number>],
    workers: &Workers,
) -> Result<Box<dyn RowEngine<F>>, EngineError> {
    let (resident, threads) = (F::RESIDENT, workers.threads());
    Ok(match choice {
        EngineChoice::Avian(substeps, statics) => {
            Box::new(AvianRobots::new(&settings, substeps, &statics, setups, workers)?)
        }
        EngineChoice::ArticulatedDouble => {
            Box::new(Packs::<f64, F::Number>::new(settings, None, setups, resident, threads))
        }
        EngineChoice::Articulated(simd, terrain) => {
            // `Simd::choose` refuses one that the machine lacks
            let simd = simd.token().unwrap_or(SimdToken::Portable);
            with_kernels(simd, MakePacks::<F> { settings, terrain, setups, threads })
        }
    })
}

/// Makes [`Packs`] of an instruction set.
struct MakePacks<'a, F: RowFamily> {
    settings: StepSettings,
    terrain: Option<Arc<HeightGrid>>,
    setups: &'a [MorphologySetup<'a, F::Number>],
    threads: usize,
}

impl<F: RowFamily> WithKernels for MakePacks<'_, F> {
    type Output = Box<dyn RowEngine<F>>;

    fn run<L: Kernels>(self) -> Self::Output {
        Box::new(Packs::<L, F::Number>::new(self.settings, self.terrain, self.setups, F::RESIDENT, self.threads))
    }
}

/// Number of control steps whose targets an actuator can still see.
pub(crate) fn history_length(max_delay: u32, decimation: usize) -> usize {
    1 + (max_delay as usize).div_ceil(decimation)
}

/// The numbers of a state that have a limit.
#[inline]
pub(crate) fn state_numbers<'a, L>(state: &'a State<L>, effort: &'a [L]) -> StateNumbers<'a, L> {
    [
        &state.position,
        &state.rotation,
        &state.linear_velocity,
        &state.angular_velocity,
        &state.joint_position,
        &state.joint_velocity,
        effort,
    ]
}
