#![doc = include_str!("README.md")]

pub(crate) mod articulated;
pub(crate) mod avian;
mod divergence;
mod limits;
mod rows;

use std::sync::Arc;

use glam::DMat3;

use crate::blocks::BlockList;
use crate::dynamics::lanes::{self, Simd};
use crate::dynamics::{ActuatorNetwork, HeightGrid, Parameters, State, StepSettings, Topology};
use crate::morphology::MorphologyModel;
use crate::obstacles::Part;
use crate::robot::{BodyGroup, Model};
use crate::workers::Workers;
use articulated::Packs;
use avian::{AvianRobots, EngineError};

pub(crate) use divergence::DivergenceRecord;
pub use divergence::Motion;
pub(crate) use limits::StateNumbers;
pub use limits::{Quantity, StateLimits, Violation};
pub(crate) use rows::{ComponentRows, Components, Contacts, RobotRows, RowFamily, ask_nothing, get, put};

/// What steps the bodies of all robots; its caller keeps their states in rows.
pub(crate) trait Engine<F: RowFamily>: Send + Sync {
    /// What decides how the envs go on, beyond their rows, as bytes; of each env.
    fn save(&self) -> Result<Vec<Vec<u8>>, postcard::Error> {
        Ok(Vec::new())
    }
    /// Whether these bytes are such.
    fn check(&self, envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        if envs.is_empty() { Ok(()) } else { Err(postcard::Error::DeserializeBadEncoding) }
    }
    /// Takes them up, once the rows and the robots' numbers are set; bytes that [`Engine::check`] refuses change nothing.
    fn load(&mut self, _envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        Ok(())
    }
    /// Takes over a robot's numbers.
    fn upload(&mut self, env: usize, parameters: &Parameters<F::Number>);
    /// Sets which joints of a morphology's robots have their gains act on the beginning of each physics step.
    fn set_explicit(&mut self, morphology: usize, explicit: &[bool]);
    /// Writes state and report of a [resident](RowFamily::RESIDENT) robot to the first of these rows.
    fn fetch(&self, env: usize, rows: F::Rows<'_>);
    /// Sets state and report of a resident robot to those of the first row.
    fn restart(&mut self, env: usize, rows: F::Rows<'_>);
    /// `run.steps` physics steps of all robots, those of each morphology a block. Of each morphology that `run` watches the first env whose new state is broken is returned.
    fn step(&mut self, workers: &Workers, blocks: BlockList<F::Rows<'_>>, run: Run) -> Vec<DivergenceRecord>;
    /// How far the links' origins are from where forward kinematics has them, at most, m.
    fn link_drift(&self, _env: usize) -> f64 {
        0.0
    }
}

/// What one [`Engine::step`] does.
#[derive(Clone, Copy)]
pub(crate) struct Run<'a> {
    /// Number of physics steps.
    pub(crate) steps: usize,
    /// Whether the gains pull to the targets. Without them the feed-forward efforts act alone.
    pub(crate) gains: bool,
    /// When a state is broken.
    pub(crate) limits: &'a StateLimits,
    /// Whether broken states are looked for, `[morphologies]`.
    pub(crate) watched: &'a [bool],
}

/// What an engine knows of one kind of robot; `T` is the type of its rows' numbers.
pub(crate) struct Kind<'a, T> {
    pub(crate) model: &'a Model,
    pub(crate) topology: &'a Topology,
    /// Turns a link's URDF axes into those of the engine, `[links]`.
    pub(crate) align: &'a [DMat3],
    /// Collision shapes that may touch each other, counted body after body.
    pub(crate) shape_pairs: &'a [[usize; 2]],
    /// The numbers of every robot to begin with.
    pub(crate) nominal: &'a Parameters<T>,
    /// Group of each contact body, by which robots are put side by side. Resident robots stay where they are and need none.
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

impl<'a> Kind<'a, f32> {
    /// `count` robots of a morphology.
    pub(crate) fn of_morphology(morphology: &'a MorphologyModel, count: usize) -> Self {
        let MorphologyModel { model, topology, align, shape_pairs, nominal, body_groups, feet, networks, .. } =
            morphology;
        let max_delay = morphology.max_delay();
        Self { model, topology, align, shape_pairs, nominal, body_groups, feet, networks, max_delay, count }
    }
}

/// Which engine, and in which numbers it computes.
pub(crate) enum EngineChoice {
    /// In single precision on an instruction set; robots stand on the terrain, or else on the plane of the settings.
    Articulated(Simd, Option<Arc<HeightGrid>>),
    /// In double precision, one robot at a time.
    ArticulatedDouble,
    /// With so many substeps, and with what stands on the plane of the settings.
    Avian(usize, Vec<Part>),
}

/// The engine of a choice for robots of some kinds, which are in contiguous blocks of rows.
///
/// # Errors
/// What Avian's engine cannot simulate.
pub(crate) fn make<F: RowFamily>(
    choice: EngineChoice,
    settings: StepSettings,
    kinds: &[Kind<F::Number>],
    workers: &Workers,
) -> Result<Box<dyn Engine<F>>, EngineError> {
    let (resident, threads) = (F::RESIDENT, workers.threads());
    Ok(match choice {
        EngineChoice::Avian(substeps, statics) => {
            Box::new(AvianRobots::new(&settings, substeps, &statics, kinds, workers)?)
        }
        EngineChoice::ArticulatedDouble => {
            Box::new(Packs::<f64, F::Number>::new(settings, None, kinds, resident, threads))
        }
        EngineChoice::Articulated(simd, terrain) => match simd {
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => {
                Box::new(Packs::<lanes::Avx512, F::Number>::new(settings, terrain, kinds, resident, threads))
            }
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => Box::new(Packs::<lanes::Avx2, F::Number>::new(settings, terrain, kinds, resident, threads)),
            #[cfg(target_arch = "aarch64")]
            Simd::Neon => Box::new(Packs::<lanes::Neon, F::Number>::new(settings, terrain, kinds, resident, threads)),
            _ => Box::new(Packs::<lanes::Portable, F::Number>::new(settings, terrain, kinds, resident, threads)),
        },
    })
}

/// Control steps of targets that an actuator can still see.
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
