//! Exact snapshots: everything that decides what happens next, as bytes.

use serde::{Deserialize, Serialize};

use super::Simulation;
use super::options::Precision;
use super::robot::Robot;
use crate::config::EngineKind;
use crate::dynamics::{Parameters, State, StepSettings, Topology};
use crate::error::Error;
use crate::hash::fnv1a;
use crate::sealed::{self, Header};

const KIND: &str = "polypod snapshot of a simulation";
/// Changes whenever the layout of a snapshot does.
const FORMAT: u32 = 5;

#[derive(Serialize, Deserialize)]
struct Snapshot {
    steps: u64,
    envs: Vec<Env>,
}

#[derive(Serialize, Deserialize)]
struct Env {
    position: [f64; 3],
    rotation: [f64; 4],
    linear_velocity: [f64; 3],
    angular_velocity: [f64; 3],
    joint_position: Vec<f64>,
    joint_velocity: Vec<f64>,
    impulse: Vec<[f64; 3]>,
    bound_impulse: Vec<f64>,
    parameters: Parameters<f64>,
    effort: Vec<f64>,
    force: Vec<[f64; 3]>,
    /// What the engine has beyond that.
    engine: Vec<u8>,
}

impl Env {
    /// Whether all lists are as long as a robot's of this topology.
    fn fits(&self, topology: &Topology, state: &State<f64>, parameters: &Parameters<f64>) -> bool {
        let joints = [&self.joint_position, &self.joint_velocity, &self.bound_impulse, &self.effort];
        joints.into_iter().all(|list| list.len() == topology.num_joints())
            && self.impulse.len() == state.impulse.len()
            && self.force.len() == topology.num_bodies
            && self.parameters.has_sizes_of(parameters)
    }
}

/// A hash of what decides a step but for the state and the envs' own numbers. `substeps` are those of the engine `avian`.
pub(super) fn fingerprint(robot: &Robot, settings: &StepSettings, engine: EngineKind, substeps: usize) -> u64 {
    let mut text = format!("{:?} {:?} {settings:?}", robot.topology, robot.nominal);
    if engine == EngineKind::Avian {
        text += &format!(" avian {substeps}");
    }
    fnv1a(text.as_bytes())
}

impl Simulation {
    fn header(&self) -> Header {
        let precision = if self.precision == Precision::Double { "double" } else { "single" };
        let robots = format!("{}, {precision} precision", self.robot.model.name);
        Header::new(KIND, FORMAT, robots, self.fingerprint, self.num_envs)
    }

    /// State, time, contact warm starts and all numbers of all envs: restoring them and stepping gives, bit for bit, what
    /// going on would have given, for any number of threads and on any instruction set.
    ///
    /// # Errors
    /// When it cannot be encoded.
    pub fn snapshot(&self) -> Result<Vec<u8>, Error> {
        let unwritable = |error: postcard::Error| Error::Snapshot(error.to_string());
        let topology = &self.robot.topology;
        let mut state = State::zeros(topology);
        let envs = (0..self.num_envs)
            .map(|env| {
                self.packs.read_state(env, &mut state);
                let mut parameters = Parameters::zeros(topology);
                self.packs.read_parameters(env, &mut parameters);
                let (mut effort, mut force) = (vec![0.0; topology.num_joints()], vec![[0.0; 3]; topology.num_bodies]);
                self.packs.read_report(env, &mut effort, &mut force);
                let State { position, rotation, linear_velocity, angular_velocity, .. } = state;
                Ok(Env {
                    position,
                    rotation,
                    linear_velocity,
                    angular_velocity,
                    joint_position: state.joint_position.clone(),
                    joint_velocity: state.joint_velocity.clone(),
                    impulse: state.impulse.clone(),
                    bound_impulse: state.bound_impulse.clone(),
                    parameters,
                    effort,
                    force,
                    engine: self.packs.save(env)?,
                })
            })
            .collect::<Result<_, postcard::Error>>()
            .map_err(unwritable)?;
        sealed::seal(&self.header(), &Snapshot { steps: self.steps, envs }).map_err(unwritable)
    }

    /// Goes back to a snapshot of a simulation with the same robot, options and number of envs.
    ///
    /// # Errors
    /// When the bytes are no snapshot, a damaged one or one of another simulation; the simulation is then as it was.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<(), Error> {
        let snapshot: Snapshot = sealed::open_as(bytes, &self.header()).map_err(Error::Snapshot)?;
        // nothing is written before all is checked
        let topology = &self.robot.topology;
        let (state, parameters) = (State::zeros(topology), Parameters::zeros(topology));
        let fits = |env: &Env| env.fits(topology, &state, &parameters);
        // steps are counted on from there
        let too_many = snapshot.steps > u64::MAX / 2;
        if too_many || snapshot.envs.len() != self.num_envs || !snapshot.envs.iter().all(fits) {
            let problem = "its lists are of other lengths than this simulation's; pass what snapshot() gave";
            return Err(Error::Snapshot(problem.into()));
        }
        let engine: Vec<&[u8]> = snapshot.envs.iter().map(|env| &env.engine[..]).collect();
        let unreadable = |error: postcard::Error| Error::Snapshot(format!("its engine's part cannot be read: {error}"));
        self.packs.check_saved(&engine).map_err(unreadable)?;
        let mut engine = Vec::with_capacity(snapshot.envs.len());
        for (env, from) in snapshot.envs.into_iter().enumerate() {
            let mut state = State {
                position: from.position,
                rotation: from.rotation,
                linear_velocity: from.linear_velocity,
                angular_velocity: from.angular_velocity,
                joint_position: from.joint_position,
                joint_velocity: from.joint_velocity,
                impulse: from.impulse,
                pressing: Vec::new(),
                bound_impulse: from.bound_impulse,
            };
            state.find_pressing();
            self.packs.write_state(env, &state);
            self.packs.write_parameters(env, &from.parameters);
            self.packs.write_report(env, &from.effort, &from.force);
            engine.push(from.engine);
        }
        self.packs.load(&engine).map_err(unreadable)?;
        self.steps = snapshot.steps;
        Ok(())
    }
}
