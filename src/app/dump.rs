//! Dumps of broken states: files that hold all that is needed to step there again, and the replay
//! of one.
//!
//! A dump depends on no other file: it holds the resolved task and robot, the URDF's text and the
//! robot's own numbers.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use bevy_ecs::prelude::*;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use toml::Table;

use super::Sim;
use crate::components::{
    ActuatorDelay, ActuatorMemory, BasePose, BaseVelocity, Body, ConstraintImpulses, JointEffort, JointState,
    JointTargets, LinkForces,
};
use crate::config::{ConfigError, Layers, LoadedRobot, LoadedTask, NetworkFile, RobotConfig, TaskConfig, parse_params};
use crate::dynamics::lanes::Simd;
use crate::engine::{Engines, Motion, Violation};
use crate::error::Error;
use crate::files;
use crate::hash::fnv1a;
use crate::morphology::MorphologyModel;
use crate::options::SimOptions;
use crate::sealed::{self, Header};
use crate::systems::{ACTION_DELAY, BrokenState, BrokenStates, Loaded, PHYSICS_MATERIAL, Place, Saved, run_physics};
use crate::world::Ground;

const KIND: &str = "polypod dump of a broken state";
/// Changes whenever the layout of a dump does.
const FORMAT: u32 = 9;

/// A control step that broke a state, and the robot and task it happened to.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Dump {
    /// Version of polypod that wrote it.
    pub version: String,
    /// Instruction set of the physics.
    pub simd: String,
    /// Seed of the simulation.
    pub seed: u64,
    /// The resolved task, TOML.
    pub task: String,
    /// Name of the robot.
    pub robot: String,
    /// The resolved config of the robot, TOML.
    pub robot_config: String,
    /// Text of the robot's URDF.
    pub urdf: String,
    /// Origin of the URDF.
    pub urdf_path: String,
    /// The files of its actuator networks, by group.
    pub networks: BTreeMap<String, NetworkFile>,
    /// The control step.
    pub state: BrokenState,
}

/// Result of stepping a dumped state again.
pub struct Replay {
    /// The robot's model, for the names of joints and links.
    pub morphology: MorphologyModel,
    /// Instruction set of the replay.
    pub simd: Simd,
    /// The robot after each physics step.
    pub steps: Vec<Motion>,
    /// The first physics step that broke the state, counted from 0, and the number that shows it.
    pub broken: Option<(usize, Violation)>,
    /// Whether the last physics step gave the dumped state, bit for bit.
    pub same_bits: bool,
}

impl Dump {
    /// Reads a file.
    ///
    /// # Errors
    /// It cannot be read, is no dump, is damaged, or of another format.
    pub fn read(file: &Path) -> Result<Self, Error> {
        let failure = |problem: String, remedy: &str| Error::file(file, problem, remedy);
        let bytes = files::read(file)
            .map_err(|error| failure(format!("cannot be read: {error}"), "check the path and its permissions"))?;
        let Some(header) = sealed::header(&bytes, KIND) else {
            return Err(failure("is no dump of a broken state".into(), "pass a broken_*.polypod file"));
        };
        if header.format != FORMAT {
            let problem = format!("its format is {}, not {FORMAT}", header.format);
            return Err(failure(problem, "replay it with the version of polypod that wrote it"));
        }
        sealed::open(&bytes).ok_or_else(|| {
            failure("is damaged: its checksum does not fit".into(), "copy it again from where it was written")
        })
    }

    /// Writes a file `broken_<robot>_env<id>_step<n>.polypod`, whole or not at all, and makes the
    /// directory if need be.
    ///
    /// # Errors
    /// The directory cannot be written to, or has a file of that name.
    pub fn write(&self, dir: &Path) -> Result<PathBuf, Error> {
        let name = format!("broken_{}_env{}_step{}.polypod", self.robot, self.state.env.0, self.state.step);
        let file = dir.join(&name);
        let remedy = "the run goes on without it; choose another directory for the next one";
        let failure = |problem: String| Error::file(&file, problem, remedy);
        // a link that leads nowhere is there, too
        if fs::symlink_metadata(&file).is_ok() {
            return Err(failure("is there already, of an earlier run, and is left as it is".into()));
        }
        let header = Header::new(KIND, FORMAT, self.robot.clone(), 0, 1);
        let bytes = sealed::seal(&header, self).map_err(|error| failure(format!("cannot be encoded: {error}")))?;
        let written = fs::create_dir_all(dir).and_then(|()| files::write(&file, &bytes));
        written.map_err(|error| failure(format!("cannot be written: {error}")))?;
        Ok(file)
    }

    /// Steps the control step again, physics step by physics step.
    ///
    /// # Errors
    /// The dump's task or robot means something else to this version of polypod, or the instruction
    /// set is not there.
    pub fn replay(&self, simd: Option<Simd>) -> Result<Replay, Error> {
        let (mut sim, decimation) = self.sim(simd)?;
        let state = &self.state;
        set(&mut sim, state.body.clone());
        set(&mut sim, state.before.pose);
        set(&mut sim, state.before.velocity);
        set(&mut sim, state.before.joints.clone());
        set(&mut sim, state.before.impulses.clone());
        set(&mut sim, state.delay.clone());
        set(&mut sim, state.memory.clone());
        set(&mut sim, state.wrench);
        set(&mut sim, state.link_forces.clone());
        let mut steps = Vec::with_capacity(decimation);
        for substep in 0..decimation {
            let targets = self.targets_in(substep, decimation, get::<JointTargets>(&mut sim)?.history.len());
            set(&mut sim, targets);
            run_physics(sim.world_mut())?;
            steps.push(Motion {
                pose: get(&mut sim)?,
                velocity: get(&mut sim)?,
                joints: get(&mut sim)?,
                effort: get(&mut sim)?,
                impulses: get(&mut sim)?,
            });
        }
        let broken = steps.iter().enumerate().find_map(|(i, step)| Some((i, step.violation(&state.limits)?)));
        let same_bits = steps.last().is_some_and(|last| bits(last) == bits(&state.after));
        Ok(Replay { morphology: sim.morphologies()[0].clone(), simd: sim.simd(), steps, broken, same_bits })
    }

    /// A simulation of this robot alone with one physics step in a control step, and the number of
    /// physics steps that the task has.
    fn sim(&self, simd: Option<Simd>) -> Result<(Sim, usize), Error> {
        // a dump may come from anybody, so the checks that Library makes of a file are made here
        // too
        let mut config: TaskConfig = self.config(&self.task, TaskConfig::validate)?;
        let decimation = config.sim.decimation as usize;
        let robot = LoadedRobot {
            config: self.config(&self.robot_config, RobotConfig::validate)?,
            urdf_text: self.urdf.clone(),
            urdf_path: PathBuf::from(&self.urdf_path),
            networks: self.networks.clone(),
            resolved: self.table(&self.robot_config)?,
            layers: Layers::default(),
        };
        config.sim.decimation = 1;
        // a machine without the card steps the same bits
        if let Some(engine) = Engines::default().of(&config).ok().and_then(|engine| engine.bits_of()) {
            config.physics.engine = engine.into();
        }
        // physics knows no terms; those of the task may not even be registered here
        config.observations.policy.clear();
        config.observations.groups.clear();
        config.terminations.clear();
        // keep the events that make room for late targets and for friction against turning
        config.events.retain(|name, _| name == ACTION_DELAY || name == PHYSICS_MATERIAL);
        config.rewards = [(robot.config.reward_set.clone(), Default::default())].into();
        let resolved = self.table(&self.task)?;
        let task = LoadedTask { config, resolved, hash: fnv1a(self.task.as_bytes()) };
        let options = SimOptions { seed: self.seed, threads: Some(1), simd, ..SimOptions::new(self.robot.clone(), 1) };
        let mut sim = Sim::with_resource(&options, Loaded { task, robots: vec![robot] })?;
        self.check_sizes(&mut sim)?;
        Ok((sim, decimation))
    }

    fn table(&self, text: &str) -> Result<Table, Error> {
        text.parse().map_err(|error: toml::de::Error| self.foreign(format!("cannot be read: {}", error.message())))
    }

    /// A config, checked.
    fn config<T: DeserializeOwned>(
        &self,
        text: &str,
        validate: impl Fn(&T) -> Result<(), ConfigError>,
    ) -> Result<T, Error> {
        let config = parse_params("", "", &self.table(text)?);
        config
            .and_then(|config: T| validate(&config).map(|()| config))
            .map_err(|error| self.foreign(format!("cannot be read: {}: {}", error.element, error.problem)))
    }

    /// Refuses a robot that this version of polypod makes with other joints or contacts.
    fn check_sizes(&self, sim: &mut Sim) -> Result<(), Error> {
        let state = &self.state;
        let (joints, effort): (JointState, JointEffort) = (get(sim)?, get(sim)?);
        let (impulses, delay, body): (ConstraintImpulses, ActuatorDelay, Body) = (get(sim)?, get(sim)?, get(sim)?);
        let memory: ActuatorMemory = get(sim)?;
        let place = Place { morphology: &sim.morphologies()[0], ground: sim.world().resource::<Ground>() };
        let moves = |motion: &Motion| {
            motion.joints.fits(&joints, &place)
                && motion.effort.fits(&effort, &place)
                && motion.impulses.fits(&impulses, &place)
        };
        let targets = &state.targets.history;
        if !(moves(&state.before)
            && moves(&state.after)
            && state.delay.fits(&delay, &place)
            && state.memory.fits(&memory, &place)
            && state.body.fits(&body, &place)
            && state.link_forces.fits(&LinkForces::default(), &place)
            && !targets.is_empty()
            && targets.iter().all(|list| list.len() == joints.position.len()))
        {
            return Err(self.foreign("its robot has other joints or contact points here".into()));
        }
        Ok(())
    }

    /// The targets of a physics step as a simulation with one physics step per control step holds
    /// them: `age` counts physics steps there, control steps in the dump.
    fn targets_in(&self, substep: usize, decimation: usize, ages: usize) -> JointTargets {
        let theirs = &self.state.targets.history;
        let history = (0..ages)
            .map(|age| {
                let before = age.saturating_sub(substep).div_ceil(decimation);
                theirs[before.min(theirs.len() - 1)].clone()
            })
            .collect();
        JointTargets { history, fresh: false }
    }

    fn foreign(&self, problem: String) -> Error {
        Error::file(
            format!("dump of {}", self.robot),
            format!("{problem} (it was written by polypod {})", self.version),
            "replay it with the version of polypod that wrote it",
        )
    }
}

impl Sim {
    /// Writes the broken states of the last control step. A dump that fails is reported and stops
    /// nothing.
    pub(crate) fn dump_broken_states(&mut self) {
        let Some(mut broken) = self.world.get_resource_mut::<BrokenStates>() else {
            return;
        };
        let found = broken.take();
        let Some(dir) = self.dump_dir() else {
            return;
        };
        let first_env = self.share().envs.start as u32;
        for (morphology, mut state) in found {
            state.env.0 += first_env;
            let robot = &self.loaded_robots()[morphology];
            let dump = Dump {
                version: env!("CARGO_PKG_VERSION").into(),
                simd: self.simd().name().into(),
                seed: self.seed(),
                task: self.loaded_task().resolved.to_string(),
                robot: robot.config.name.clone(),
                robot_config: robot.resolved.to_string(),
                urdf: robot.urdf_text.clone(),
                urdf_path: robot.urdf_path.display().to_string(),
                networks: robot.networks.clone(),
                state,
            };
            match dump.write(dir) {
                Ok(file) => {
                    let (robot, env, file) = (&dump.robot, dump.state.env.0, file.display());
                    tracing::warn!(
                        "the state of env {env} ({robot}) broke; `polypod-sim replay {file}` steps it again"
                    );
                }
                Err(error) => tracing::warn!("the dump of a broken state was not written: {error}"),
            }
        }
    }
}

/// The replay's only robot.
fn set<C: Component<Mutability = bevy_ecs::component::Mutable>>(sim: &mut Sim, value: C) {
    let world = sim.world_mut();
    if let Ok(mut component) = world.query::<&mut C>().single_mut(world) {
        *component = value;
    }
}

fn get<C: Component + Clone>(sim: &mut Sim) -> Result<C, Error> {
    let world = sim.world_mut();
    let component = world.query::<&C>().single(world).cloned();
    component.map_err(|error| Error::file("replay", error.to_string(), "this is a fault of polypod; please report it"))
}

/// The bits of a motion. IEEE 754 leaves the bits of a NaN open: all NaNs count as one.
fn bits(motion: &Motion) -> Vec<u32> {
    let Motion {
        pose: BasePose { position, rotation },
        velocity: BaseVelocity { linear, angular },
        joints,
        effort,
        impulses: ConstraintImpulses { contacts, bounds },
    } = motion;
    let (base, joint) = ([&position[..], rotation, linear, angular], [&joints.position, &joints.velocity]);
    let efforts = [&effort.applied, &effort.acceleration];
    let lists = base.into_iter().chain(joint.into_iter().chain(efforts).map(|list| &list[..]));
    let impulses = contacts.iter().flat_map(|c| c.impulse).chain(bounds.iter().copied());
    let numbers = lists.flatten().copied().chain(impulses);
    numbers.map(|x| if x.is_nan() { f32::NAN.to_bits() } else { x.to_bits() }).collect()
}
