//! States and parameters of a simulation's envs, which live in the engine.

use serde::{Deserialize, Serialize};

use super::rows::Rows;
use crate::dynamics::lanes::{Real, read_lane, write_lane};
use crate::dynamics::{Drive, Report, State, Topology};
use crate::engine::{Contacts, RobotRows, RowFamily};
use crate::workers::SplitRows;

/// Numbers of a base's pose: position and quaternion.
const POSE: usize = 7;
/// Numbers of a base's velocity: linear and angular.
const TWIST: usize = 6;

/// State and report of one env.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Env {
    /// Generalised positions, see [`Simulation`](super::Simulation).
    pub(super) qpos: Vec<f64>,
    /// Generalised velocities.
    pub(super) qvel: Vec<f64>,
    /// Impulses of joint limits and dry friction in the last physics step, N m s, `[joints]`.
    bounds: Vec<f64>,
    /// Contact impulses of the last physics step.
    contacts: Contacts<f64>,
    /// Memory of the actuator networks.
    pub(super) memory: Vec<f64>,
    /// Effort of each actuator in the last physics step, N m or N.
    pub(super) effort: Vec<f64>,
    /// Net force on each contact body in the last physics step, N, world axes.
    pub(super) force: Vec<[f64; 3]>,
}

impl Env {
    /// An env with zeros, for reading into it.
    pub(super) fn zeros(topology: &Topology, remembered: usize) -> Self {
        let joints = topology.num_joints();
        let (pose, twist) = if topology.floating { (POSE, TWIST) } else { (0, 0) };
        Self {
            qpos: vec![0.0; pose + joints],
            qvel: vec![0.0; twist + joints],
            bounds: vec![0.0; joints],
            contacts: Contacts::new(),
            memory: vec![0.0; remembered],
            effort: vec![0.0; joints],
            force: vec![[0.0; 3]; topology.num_bodies],
        }
    }

    /// Whether the lists are as long as those of `other`, and contacts are a robot's of this
    /// topology.
    pub(super) fn fits(&self, other: &Self, topology: &Topology) -> bool {
        self.qpos.len() == other.qpos.len()
            && self.qvel.len() == other.qvel.len()
            && self.bounds.len() == other.bounds.len()
            && self.memory.len() == other.memory.len()
            && self.effort.len() == other.effort.len()
            && self.force.len() == other.force.len()
            && self.contacts.iter().all(|c| (c.contact as usize) < topology.num_impulses())
    }

    /// Forgets the impulses of the last physics step, and what networks remember.
    pub(super) fn forget(&mut self) {
        self.contacts.clear();
        self.bounds.fill(0.0);
        self.memory.fill(0.0);
    }

    /// Reads pose and velocity into a lane. A fixed base stays as it is there.
    #[inline]
    pub(super) fn read<L: Real>(&self, state: &mut State<L>, lane: usize) {
        let (pose, positions) = self.qpos.split_at(self.qpos.len() - self.bounds.len());
        let (twist, velocities) = self.qvel.split_at(self.qvel.len() - self.bounds.len());
        write_lane(&mut state.position, pose, lane);
        write_lane(&mut state.rotation, pose.get(3..).unwrap_or_default(), lane);
        write_lane(&mut state.linear_velocity, twist, lane);
        write_lane(&mut state.angular_velocity, twist.get(3..).unwrap_or_default(), lane);
        write_lane(&mut state.joint_position, positions, lane);
        write_lane(&mut state.joint_velocity, velocities, lane);
    }

    #[inline]
    fn write<L: Real>(&mut self, state: &State<L>, lane: usize) {
        let (nq, nv, joints) = (self.qpos.len(), self.qvel.len(), self.bounds.len());
        let (pose, positions) = self.qpos.split_at_mut(nq - joints);
        let (twist, velocities) = self.qvel.split_at_mut(nv - joints);
        read_lane(&state.position, pose, lane);
        read_lane(&state.rotation, pose.get_mut(3..).unwrap_or_default(), lane);
        read_lane(&state.linear_velocity, twist, lane);
        read_lane(&state.angular_velocity, twist.get_mut(3..).unwrap_or_default(), lane);
        read_lane(&state.joint_position, positions, lane);
        read_lane(&state.joint_velocity, velocities, lane);
    }
}

/// Input of the actuators.
#[derive(Clone, Copy)]
pub(super) enum Actuation<'a> {
    /// Targets that the gains follow.
    Targets(Rows<'a>),
    /// Efforts alone.
    Effort(Rows<'a>),
}

/// Rows of a simulation, in double precision whatever the engine computes in.
pub(super) struct Envs;

impl RowFamily for Envs {
    const RESIDENT: bool = true;
    type Number = f64;
    type Rows<'a> = EnvRows<'a>;
}

/// Inputs of all envs in a step, from env `first` on, without envs; or one env that is read or set.
pub(super) struct EnvRows<'a> {
    envs: &'a mut [Env],
    first: usize,
    actuation: Actuation<'a>,
}

impl<'a> EnvRows<'a> {
    /// Rows of the inputs of a step.
    pub(super) fn asking(actuation: Actuation<'a>) -> Self {
        Self { envs: &mut [], first: 0, actuation }
    }

    /// Rows of a single env, whose state is read or set.
    pub(super) fn of(env: &'a mut Env) -> Self {
        Self { envs: std::slice::from_mut(env), first: 0, actuation: Actuation::Effort(Rows::zero()) }
    }
}

impl SplitRows for EnvRows<'_> {
    fn split_rows(self, n: usize) -> (Self, Self) {
        let Self { envs, first, actuation } = self;
        let (envs, rest) = envs.split_at_mut(n.min(envs.len()));
        (Self { envs, first, actuation }, Self { envs: rest, first: first + n, actuation })
    }
}

impl RobotRows for EnvRows<'_> {
    type Number = f64;

    #[inline]
    fn origin(&self, _row: usize) -> [f32; 2] {
        [0.0; 2]
    }

    #[inline]
    fn read_motion<L: Real>(&self, row: usize, state: &mut State<L>, lane: usize) {
        self.envs[row].read(state, lane);
    }

    #[inline]
    fn write_motion<L: Real>(&mut self, row: usize, state: &State<L>, lane: usize) {
        self.envs[row].write(state, lane);
    }

    #[inline]
    fn read_drive<L: Real>(&self, row: usize, drive: &mut Drive<L>, lane: usize) {
        let (asked, to) = match self.actuation {
            Actuation::Targets(asked) => (asked, &mut drive.targets[0]),
            Actuation::Effort(asked) => (asked, &mut drive.feedforward),
        };
        match asked.row(self.first + row) {
            &[same] => to.iter_mut().for_each(|x| x.set_lane(lane, same)),
            row => write_lane(to, row, lane),
        }
    }

    #[inline]
    fn memory(&self, row: usize) -> &[f64] {
        &self.envs[row].memory
    }

    #[inline]
    fn memory_mut(&mut self, row: usize) -> &mut [f64] {
        &mut self.envs[row].memory
    }

    #[inline]
    fn impulses(&self, row: usize) -> (&Contacts<f64>, &[f64]) {
        (&self.envs[row].contacts, &self.envs[row].bounds)
    }

    #[inline]
    fn impulses_mut(&mut self, row: usize) -> (&mut Contacts<f64>, &mut [f64]) {
        let Env { contacts, bounds, .. } = &mut self.envs[row];
        (contacts, bounds)
    }

    #[inline]
    fn write_report<L: Real>(
        &mut self,
        row: usize,
        report: &Report<L>,
        _feet: &[usize],
        touching: &[usize],
        lane: usize,
    ) {
        let Env { effort, force, .. } = &mut self.envs[row];
        read_lane(&report.joint_effort, effort, lane);
        force.fill([0.0; 3]);
        for &body in touching {
            read_lane(&report.body_force[body], &mut force[body], lane);
        }
    }

    fn read_report<L: Real>(&self, row: usize, report: &mut Report<L>, lane: usize) {
        let Env { effort, force, .. } = &self.envs[row];
        write_lane(&mut report.joint_effort, effort, lane);
        for (body, force) in force.iter().enumerate() {
            write_lane(&mut report.body_force[body], force, lane);
            report.touched[body] |= *force != [0.0; 3];
        }
    }
}
