//! Exact snapshots: everything that decides what happens next, as bytes.

use serde::{Deserialize, Serialize};

use super::Simulation;
use super::options::{Precision, SimulationError};
use super::robot::Robot;
use crate::config::EngineKind;
use crate::config::fnv1a;
use crate::dynamics::{Parameters, State, StepSettings, Topology};

/// Changes whenever the layout of a snapshot does.
const FORMAT: u32 = 4;
/// Length of the checksum after the encoded snapshot: FNV-1a over it, little endian.
const CHECKSUM: usize = size_of::<u64>();

#[derive(Serialize, Deserialize, PartialEq, Debug)]
struct Header {
    format: u32,
    version: String,
    robot: String,
    fingerprint: u64,
    double: bool,
    num_envs: usize,
}

#[derive(Serialize, Deserialize)]
struct Snapshot {
    header: Header,
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

/// Lengths of the lists of an [`Env`].
#[derive(PartialEq)]
struct Sizes {
    joints: [usize; 4],
    impulse: usize,
    force: usize,
    parameters: [usize; 23],
}

impl Sizes {
    fn of(topology: &Topology) -> Self {
        Self {
            joints: [topology.num_joints(); 4],
            impulse: State::<f64>::zeros(topology).impulse.len(),
            force: topology.num_bodies,
            parameters: lengths(&Parameters::<f64>::zeros(topology)),
        }
    }
}

impl Env {
    fn sizes(&self) -> Sizes {
        Sizes {
            joints: [&self.joint_position, &self.joint_velocity, &self.bound_impulse, &self.effort].map(Vec::len),
            impulse: self.impulse.len(),
            force: self.force.len(),
            parameters: lengths(&self.parameters),
        }
    }
}

/// Lengths of all lists of a body's numbers.
pub(crate) fn lengths<S>(parameters: &Parameters<S>) -> [usize; 23] {
    // whole, so that a list that is added is not forgotten here
    let Parameters {
        joint_offset,
        mass,
        com,
        inertia,
        stiffness,
        damping,
        effort_limit,
        saturation_effort,
        motor_velocity_limit,
        armature,
        joint_damping,
        joint_friction,
        lower,
        upper,
        velocity_limit,
        contact_position,
        contact_radius,
        contact_rim,
        link_box,
        collider_centre,
        collider_half,
        collider_radius,
        site_position,
        static_friction: _,
        dynamic_friction: _,
        restitution: _,
    } = parameters;
    [
        joint_offset.len(),
        mass.len(),
        com.len(),
        inertia.len(),
        stiffness.len(),
        damping.len(),
        effort_limit.len(),
        saturation_effort.len(),
        motor_velocity_limit.len(),
        armature.len(),
        joint_damping.len(),
        joint_friction.len(),
        lower.len(),
        upper.len(),
        velocity_limit.len(),
        contact_position.len(),
        contact_radius.len(),
        contact_rim.len(),
        link_box.len(),
        collider_centre.len(),
        collider_half.len(),
        collider_radius.len(),
        site_position.len(),
    ]
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
        Header {
            format: FORMAT,
            version: env!("CARGO_PKG_VERSION").to_string(),
            robot: self.robot.model.name.clone(),
            fingerprint: self.fingerprint,
            double: self.precision == Precision::Double,
            num_envs: self.num_envs,
        }
    }

    /// State, time, contact warm starts and all numbers of all envs: restoring them and stepping gives, bit for bit, what
    /// going on would have given, for any number of threads and on any instruction set.
    ///
    /// # Errors
    /// When it cannot be encoded.
    pub fn snapshot(&self) -> Result<Vec<u8>, SimulationError> {
        let unwritable = |error: postcard::Error| SimulationError::Snapshot(error.to_string());
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
        let snapshot = Snapshot { header: self.header(), steps: self.steps, envs };
        let mut bytes = postcard::to_stdvec(&snapshot).map_err(unwritable)?;
        bytes.extend(fnv1a(&bytes).to_le_bytes());
        Ok(bytes)
    }

    /// Goes back to a snapshot of a simulation with the same robot, options and number of envs.
    ///
    /// # Errors
    /// When the bytes are no snapshot, a damaged one or one of another simulation; the simulation is then as it was.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<(), SimulationError> {
        let unreadable = |error: postcard::Error| {
            SimulationError::Snapshot(format!(
                "not a snapshot of a polypod simulation ({error}); pass what snapshot() gave"
            ))
        };
        let (theirs, _) = postcard::take_from_bytes::<Header>(bytes).map_err(unreadable)?;
        let ours = self.header();
        if theirs != ours {
            return Err(SimulationError::Snapshot(format!(
                "it is of another simulation ({theirs:?}) than this one ({ours:?}); restore it where it was taken"
            )));
        }
        let intact = bytes.split_last_chunk::<CHECKSUM>().filter(|(data, sum)| fnv1a(data).to_le_bytes() == **sum);
        let Some((data, _)) = intact else {
            return Err(SimulationError::Snapshot("it is damaged: its checksum does not fit; take it again".into()));
        };
        let snapshot = postcard::from_bytes::<Snapshot>(data).map_err(unreadable)?;
        // nothing is written before all is checked
        let sizes = Sizes::of(&self.robot.topology);
        // steps are counted on from there
        let too_many = snapshot.steps > u64::MAX / 2;
        if too_many || snapshot.envs.len() != self.num_envs || snapshot.envs.iter().any(|env| env.sizes() != sizes) {
            let problem = "its parts are not those of this simulation; pass what snapshot() gave";
            return Err(SimulationError::Snapshot(problem.into()));
        }
        let engine: Vec<&[u8]> = snapshot.envs.iter().map(|env| &env.engine[..]).collect();
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
