//! What a simulation keeps of each env, and how the engine reads and writes it.

use serde::{Deserialize, Serialize};
use smallvec::{SmallVec, smallvec};

use super::rows::Rows;
use crate::dynamics::lanes::{Real, prefetch};
use crate::dynamics::{Drive, Report, State, Topology};
use crate::engine::{Contacts, RobotRows, RowFamily, get, put};
use crate::workers::SplitRows;

/// Numbers of a base's pose: position and quaternion.
const POSE: usize = 7;
/// Numbers of a base's velocity: linear and angular.
const TWIST: usize = 6;

/// State and report of one env. Lists have room in place for a robot of 12 joints.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Env {
    /// Generalised positions, see [`Simulation`](super::Simulation).
    pub(super) qpos: SmallVec<[f64; POSE + 12]>,
    /// Generalised velocities.
    pub(super) qvel: SmallVec<[f64; TWIST + 12]>,
    /// Impulses of joint limits and dry friction in the last physics step, N m s, `[joints]`.
    pub(super) bounds: SmallVec<[f64; 12]>,
    /// Contact impulses of the last physics step.
    pub(super) contacts: Contacts<f64>,
    /// Effort of each actuator in the last physics step, N m or N.
    pub(super) effort: SmallVec<[f64; 12]>,
    /// Net force on each contact body in the last physics step, N, world axes.
    pub(super) force: SmallVec<[[f64; 3]; 16]>,
}

impl Env {
    /// At rest at the world's origin, all joints zero.
    pub(super) fn zeros(topology: &Topology) -> Self {
        let joints = topology.num_joints();
        let base: &[f64] = if topology.floating { &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0] } else { &[] };
        let mut qpos = SmallVec::from_slice(base);
        qpos.resize(base.len() + joints, 0.0);
        Self {
            qpos,
            qvel: smallvec![0.0; joints + if topology.floating { TWIST } else { 0 }],
            bounds: smallvec![0.0; joints],
            contacts: Contacts::new(),
            effort: smallvec![0.0; joints],
            force: smallvec![[0.0; 3]; topology.num_bodies],
        }
    }

    /// Whether this can take the place of `present`, of a robot of this topology.
    pub(super) fn fits(&self, present: &Self, topology: &Topology) -> bool {
        self.qpos.len() == present.qpos.len()
            && self.qvel.len() == present.qvel.len()
            && self.bounds.len() == present.bounds.len()
            && self.effort.len() == present.effort.len()
            && self.force.len() == present.force.len()
            && self.contacts.iter().all(|c| (c.contact as usize) < topology.num_impulses())
    }

    /// Forgets the impulses of the last physics step.
    pub(super) fn forget_impulses(&mut self) {
        self.contacts.clear();
        self.bounds.fill(0.0);
    }

    /// Reads pose and velocity into a lane. A fixed base stays as it is there.
    #[inline]
    pub(super) fn read<L: Real>(&self, state: &mut State<L>, lane: usize) {
        let (pose, positions) = self.qpos.split_at(self.qpos.len() - self.bounds.len());
        let (twist, velocities) = self.qvel.split_at(self.qvel.len() - self.bounds.len());
        put(&mut state.position, pose, lane);
        put(&mut state.rotation, pose.get(3..).unwrap_or_default(), lane);
        put(&mut state.linear_velocity, twist, lane);
        put(&mut state.angular_velocity, twist.get(3..).unwrap_or_default(), lane);
        put(&mut state.joint_position, positions, lane);
        put(&mut state.joint_velocity, velocities, lane);
    }

    #[inline]
    fn write<L: Real>(&mut self, state: &State<L>, lane: usize) {
        let (nq, nv, joints) = (self.qpos.len(), self.qvel.len(), self.bounds.len());
        let (pose, positions) = self.qpos.split_at_mut(nq - joints);
        let (twist, velocities) = self.qvel.split_at_mut(nv - joints);
        get(&state.position, pose, lane);
        get(&state.rotation, pose.get_mut(3..).unwrap_or_default(), lane);
        get(&state.linear_velocity, twist, lane);
        get(&state.angular_velocity, twist.get_mut(3..).unwrap_or_default(), lane);
        get(&state.joint_position, positions, lane);
        get(&state.joint_velocity, velocities, lane);
    }
}

/// What the actuators are asked for.
#[derive(Clone, Copy)]
pub(super) enum Actuation<'a> {
    /// These targets, by the gains.
    Targets(Rows<'a>),
    /// These efforts alone.
    Effort(Rows<'a>),
}

/// Rows of a simulation, in double precision whatever the engine computes in.
pub(super) struct Envs;

impl RowFamily for Envs {
    type Number = f64;
    type Rows<'a> = EnvRows<'a>;
}

/// Envs from `first` on.
pub(super) struct EnvRows<'a> {
    pub(super) envs: &'a mut [Env],
    pub(super) first: usize,
    pub(super) actuation: Actuation<'a>,
}

impl SplitRows for EnvRows<'_> {
    fn split_rows(self, n: usize) -> (Self, Self) {
        let Self { envs, first, actuation } = self;
        let (envs, rest) = envs.split_at_mut(n);
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
        let (asked, to, other) = match self.actuation {
            Actuation::Targets(asked) => (asked, &mut drive.targets[0], &mut drive.feedforward),
            Actuation::Effort(asked) => (asked, &mut drive.feedforward, &mut drive.targets[0]),
        };
        for (joint, (x, none)) in to.iter_mut().zip(other).enumerate() {
            x.set_lane(lane, asked.get(self.first + row, joint));
            none.set_lane(lane, 0.0);
        }
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
        get(&report.joint_effort, effort, lane);
        force.fill([0.0; 3]);
        for &body in touching {
            get(&report.body_force[body], &mut force[body], lane);
        }
    }

    #[inline]
    fn prefetch(&self, row: usize) {
        prefetch(&self.envs[row]);
    }
}
