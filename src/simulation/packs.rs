//! Envs side by side in lanes: the part of a simulation that knows in which type it computes.

use super::rows::{EnvIds, Rows};
use crate::dynamics::lanes::{self, Real, Simd};
use crate::dynamics::{ControlStep, Drive, Kernels, Parameters, Report, State, StepSettings, Topology, Workspace};
pub(super) use crate::engine::avian::JointField;
use crate::workers::Workers;

/// Physics steps that packs make in one go; their contact reports grow with it.
const MAX_RUN: usize = 32;

/// What the actuators are asked for.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Actuation {
    /// The targets, by the gains.
    Targets,
    /// The efforts alone.
    Effort,
}

/// Envs in some type of number. At this boundary all are `f64`.
pub(super) trait Packs: Send + Sync {
    fn read_state(&self, env: usize, state: &mut State<f64>);
    fn write_state(&mut self, env: usize, state: &State<f64>);
    /// Stiffness and damping are the stored gains, whatever the last step used.
    fn read_parameters(&self, env: usize, parameters: &mut Parameters<f64>);
    fn write_parameters(&mut self, env: usize, parameters: &Parameters<f64>);
    /// A number of every joint in some envs.
    fn write_joints(&mut self, envs: &EnvIds, field: JointField, rows: &Rows);
    /// Effort of each joint and force on each contact body in the last physics step.
    fn read_report(&self, env: usize, effort: &mut [f64], force: &mut [[f64; 3]]);
    fn write_report(&mut self, env: usize, effort: &[f64], force: &[[f64; 3]]);
    /// `n` physics steps of all envs.
    fn step(&mut self, topology: &Topology, settings: &StepSettings, workers: &Workers, actuation: Actuation, n: usize);
    /// What else decides how an env goes on, as bytes.
    fn save(&self, _env: usize) -> Result<Vec<u8>, postcard::Error> {
        Ok(Vec::new())
    }
    /// Whether [`load`](Self::load) can take these bytes of all envs up; changes nothing.
    fn check_saved(&self, envs: &[&[u8]]) -> Result<(), postcard::Error> {
        if envs.iter().all(|bytes| bytes.is_empty()) { Ok(()) } else { Err(postcard::Error::DeserializeBadEncoding) }
    }
    /// Takes that up in all envs, once their states and numbers are set.
    fn load(&mut self, _envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        Ok(())
    }
    /// How far the links' origins are from where forward kinematics has them, at most, m.
    fn link_drift(&self, _env: usize) -> f64 {
        0.0
    }
}

/// Packs in single precision on an instruction set.
pub(super) fn single(
    simd: Simd,
    topology: &Topology,
    nominal: &Parameters<f64>,
    num_envs: usize,
    chunks: usize,
) -> Box<dyn Packs> {
    match simd {
        #[cfg(target_arch = "x86_64")]
        Simd::Avx512 => Box::new(LanePacks::<lanes::Avx512>::new(topology, nominal, num_envs, chunks)),
        #[cfg(target_arch = "x86_64")]
        Simd::Avx2 => Box::new(LanePacks::<lanes::Avx2>::new(topology, nominal, num_envs, chunks)),
        #[cfg(target_arch = "aarch64")]
        Simd::Neon => Box::new(LanePacks::<lanes::Neon>::new(topology, nominal, num_envs, chunks)),
        _ => Box::new(LanePacks::<lanes::Portable>::new(topology, nominal, num_envs, chunks)),
    }
}

/// Packs of one env in double precision.
pub(super) fn double(topology: &Topology, nominal: &Parameters<f64>, num_envs: usize, chunks: usize) -> Box<dyn Packs> {
    Box::new(LanePacks::<f64>::new(topology, nominal, num_envs, chunks))
}

/// Up to `L::LANES` envs side by side.
struct Pack<L> {
    count: usize,
    parameters: Parameters<L>,
    stiffness: Vec<L>,
    damping: Vec<L>,
    state: State<L>,
    drive: Drive<L>,
    report: Report<L>,
}

struct LanePacks<L: Kernels> {
    packs: Vec<Pack<L>>,
    kind: Parameters<f32>,
    /// Whether all bodies are [alike](Parameters::is_alike) that of their kind.
    alike: bool,
    /// One per chunk of work.
    workspaces: Vec<Workspace<L>>,
}

impl<L: Kernels> LanePacks<L> {
    fn new(topology: &Topology, nominal: &Parameters<f64>, num_envs: usize, chunks: usize) -> Self {
        let parameters = Parameters::<L>::from_scalars(topology, nominal);
        let packs = (0..num_envs)
            .step_by(L::LANES)
            .map(|first| Pack {
                count: L::LANES.min(num_envs - first),
                stiffness: parameters.stiffness.to_vec(),
                damping: parameters.damping.to_vec(),
                parameters: parameters.clone(),
                state: State::zeros(topology),
                drive: Drive::zeros(topology, 1),
                report: Report::zeros(topology, 1),
            })
            .collect();
        let kind = Parameters::from_scalars(topology, nominal);
        Self { packs, kind, alike: true, workspaces: (0..chunks).map(|_| Workspace::new(topology)).collect() }
    }

    fn at(&self, env: usize) -> (&Pack<L>, usize) {
        (&self.packs[env / L::LANES], env % L::LANES)
    }

    /// The pack of an env, and its lane; with it the idle lanes, which shadow the last env so that they cost and break
    /// nothing.
    fn at_mut(&mut self, env: usize) -> (&mut Pack<L>, std::ops::Range<usize>) {
        let (pack, lane) = (&mut self.packs[env / L::LANES], env % L::LANES);
        let end = if lane + 1 == pack.count { L::LANES } else { lane + 1 };
        (pack, lane..end)
    }
}

fn get<L: Real>(from: &[L], to: &mut [f64], lane: usize) {
    for (x, y) in to.iter_mut().zip(from) {
        *x = y.lane(lane);
    }
}

fn put<L: Real>(to: &mut [L], from: &[f64], lane: usize) {
    for (x, &y) in to.iter_mut().zip(from) {
        x.set_lane(lane, y);
    }
}

impl<L: Kernels> Packs for LanePacks<L> {
    fn read_state(&self, env: usize, state: &mut State<f64>) {
        let (pack, lane) = self.at(env);
        let from = &pack.state;
        get(&from.position, &mut state.position, lane);
        get(&from.rotation, &mut state.rotation, lane);
        get(&from.linear_velocity, &mut state.linear_velocity, lane);
        get(&from.angular_velocity, &mut state.angular_velocity, lane);
        get(&from.joint_position, &mut state.joint_position, lane);
        get(&from.joint_velocity, &mut state.joint_velocity, lane);
        get(from.impulse.as_flattened(), state.impulse.as_flattened_mut(), lane);
        state.pressing.clone_from(&from.pressing);
        get(&from.bound_impulse, &mut state.bound_impulse, lane);
    }

    fn write_state(&mut self, env: usize, state: &State<f64>) {
        let (pack, lanes) = self.at_mut(env);
        let to = &mut pack.state;
        to.pressing.extend(&state.pressing);
        to.pressing.sort_unstable();
        to.pressing.dedup();
        for lane in lanes {
            put(&mut to.position, &state.position, lane);
            put(&mut to.rotation, &state.rotation, lane);
            put(&mut to.linear_velocity, &state.linear_velocity, lane);
            put(&mut to.angular_velocity, &state.angular_velocity, lane);
            put(&mut to.joint_position, &state.joint_position, lane);
            put(&mut to.joint_velocity, &state.joint_velocity, lane);
            put(to.impulse.as_flattened_mut(), state.impulse.as_flattened(), lane);
            put(&mut to.bound_impulse, &state.bound_impulse, lane);
        }
    }

    fn read_parameters(&self, env: usize, parameters: &mut Parameters<f64>) {
        let (pack, lane) = self.at(env);
        parameters.zip_with(&pack.parameters, |x, y| *x = y.lane(lane));
        get(&pack.stiffness, &mut parameters.stiffness, lane);
        get(&pack.damping, &mut parameters.damping, lane);
    }

    fn write_parameters(&mut self, env: usize, parameters: &Parameters<f64>) {
        self.alike &= parameters.is_alike(&self.kind);
        let (pack, lanes) = self.at_mut(env);
        for lane in lanes {
            pack.parameters.set_lane(lane, parameters);
            put(&mut pack.stiffness, &parameters.stiffness, lane);
            put(&mut pack.damping, &parameters.damping, lane);
        }
    }

    fn write_joints(&mut self, envs: &EnvIds, field: JointField, rows: &Rows) {
        self.alike &= matches!(field, JointField::Target | JointField::Effort);
        for row in 0..envs.len() {
            let (pack, lanes) = self.at_mut(envs.get(row));
            for (joint, x) in pack.joints_mut(field).iter_mut().enumerate() {
                let value = rows.get(row, joint);
                lanes.clone().for_each(|lane| x.set_lane(lane, value));
            }
        }
    }

    fn read_report(&self, env: usize, effort: &mut [f64], force: &mut [[f64; 3]]) {
        let (pack, lane) = self.at(env);
        get(&pack.report.joint_effort, effort, lane);
        get(pack.report.body_force.as_flattened(), force.as_flattened_mut(), lane);
    }

    fn write_report(&mut self, env: usize, effort: &[f64], force: &[[f64; 3]]) {
        let (pack, lanes) = self.at_mut(env);
        for lane in lanes {
            put(&mut pack.report.joint_effort, effort, lane);
            put(pack.report.body_force.as_flattened_mut(), force.as_flattened(), lane);
        }
    }

    fn step(
        &mut self,
        topology: &Topology,
        settings: &StepSettings,
        workers: &Workers,
        actuation: Actuation,
        n: usize,
    ) {
        let per_chunk = self.packs.len().div_ceil(self.workspaces.len()).max(1);
        let kind = Some(&self.kind).filter(|_| self.alike && actuation == Actuation::Targets);
        let tasks = self.packs.chunks_mut(per_chunk).zip(&mut self.workspaces);
        workers.for_each(tasks, |(packs, work)| {
            for pack in packs {
                pack.step(topology, kind, settings, work, actuation, n);
            }
        });
    }
}

impl<L: Kernels> Pack<L> {
    fn joints_mut(&mut self, field: JointField) -> &mut [L] {
        match field {
            JointField::Target => &mut self.drive.targets[0],
            JointField::Effort => &mut self.drive.feedforward,
            JointField::Stiffness => &mut self.stiffness,
            JointField::Damping => &mut self.damping,
            JointField::EffortLimit => &mut self.parameters.effort_limit,
            JointField::Armature => &mut self.parameters.armature,
        }
    }

    fn step(
        &mut self,
        topology: &Topology,
        kind: Option<&Parameters<f32>>,
        settings: &StepSettings,
        work: &mut Workspace<L>,
        actuation: Actuation,
        n: usize,
    ) {
        match actuation {
            Actuation::Targets => {
                self.parameters.stiffness.copy_from_slice(&self.stiffness);
                self.parameters.damping.copy_from_slice(&self.damping);
                self.drive.feedforward.fill(L::zero());
            }
            Actuation::Effort => {
                self.parameters.stiffness.fill(L::zero());
                self.parameters.damping.fill(L::zero());
                self.drive.targets[0].fill(L::zero());
            }
        }
        let longest = n.min(MAX_RUN);
        if self.report.normal_force.len() < longest {
            self.report.normal_force.resize(longest, vec![L::zero(); topology.num_bodies]);
        }
        let mut left = n;
        while left > 0 {
            let decimation = left.min(MAX_RUN);
            let step = ControlStep {
                topology,
                settings: &StepSettings { decimation, ..*settings },
                terrain: None,
                parameters: &self.parameters,
                kind,
                drive: &self.drive,
                state: &mut self.state,
                report: &mut self.report,
                work: &mut *work,
            };
            step.run();
            left -= decimation;
        }
    }
}
