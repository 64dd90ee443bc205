//! Packs between components and kernel: robots are gathered into lanes and scattered back.

use super::super::{PhysicsRows, StateLimits, StateNumbers, get, get_arrays, history_length, put, state_numbers};
use crate::components::{ContactImpulse, PerFoot};
use crate::dynamics::lanes::{Kernel, Lanes, Real};
use crate::dynamics::{Drive, Parameters, Report, State, Workspace};
use crate::morphology::MorphologyModel;

/// Where a thread steps one pack of a morphology after the other; its contents mean nothing between two.
pub(super) struct PackWorkspace<L: Real> {
    /// Where the envs' origins are on the terrain, m.
    pub(super) origin: [L; 2],
    /// Of a body as the morphology has it.
    pub(super) nominal: Parameters<L>,
    pub(super) state: State<L>,
    pub(super) drive: Drive<L>,
    pub(super) report: Report<L>,
    pub(super) work: Workspace<L>,
    /// Which of the state's impulses are pressing.
    presses: Vec<bool>,
    /// The contact bodies that are feet.
    feet: PerFoot<usize>,
    /// The others that the pack had touched something with.
    touching: Vec<usize>,
}

impl<L: Lanes> PackWorkspace<L> {
    /// For a morphology whose numbers are `nominal` in every lane.
    pub(super) fn new(model: &MorphologyModel, nominal: &Parameters<L>, decimation: usize) -> Self {
        let topology = &model.topology;
        let state = State::zeros(topology);
        Self {
            origin: [L::zero(); 2],
            nominal: nominal.clone(),
            presses: vec![false; state.impulse.len()],
            feet: model.feet,
            touching: Vec::new(),
            state,
            drive: Drive::zeros(topology, history_length(model.max_delay(), decimation)),
            report: Report::zeros(topology, decimation),
            work: Workspace::new(topology),
        }
    }

    /// Reads rows into the lanes; lanes beyond them shadow the last row.
    pub(super) fn gather(&mut self, rows: &PhysicsRows, order: &[usize]) {
        for &contact in &self.state.pressing {
            self.state.impulse[contact as usize] = [L::zero(); 3];
        }
        self.presses.fill(false);
        self.state.pressing.clear();
        for lane in 0..L::LANES {
            // idle lanes shadow the last robot
            let row = order[lane.min(order.len() - 1)];
            let (state, drive) = (&mut self.state, &mut self.drive);
            rows.read_motion(row, state, lane);
            put(&mut self.origin, &rows.origins[row].position, lane);
            for ContactImpulse { contact, impulse } in &rows.impulses[row].contacts {
                let contact = *contact as usize;
                if let (Some(all), Some(presses)) = (state.impulse.get_mut(contact), self.presses.get_mut(contact)) {
                    put(all, impulse, lane);
                    if !std::mem::replace(presses, true) {
                        state.pressing.push(contact as u32);
                    }
                }
            }
            put(&mut state.bound_impulse, &rows.impulses[row].bounds, lane);
            for (targets, from) in drive.targets.iter_mut().zip(&rows.targets[row].history) {
                put(targets, from, lane);
            }
            // without a history no actuator sees a delay
            if drive.targets.len() > 1 {
                put(&mut drive.delay, &rows.delays[row].0, lane);
            }
            put(&mut drive.base_force, &rows.wrenches[row].force, lane);
            put(&mut drive.base_torque, &rows.wrenches[row].torque, lane);
        }
        self.state.pressing.sort_unstable();
    }

    /// The first of the lanes' rows whose new state is not finite or beyond the limits.
    pub(super) fn first_broken(&self, limits: &StateLimits, order: &[usize]) -> Option<usize> {
        let numbers = state_numbers(&self.state, &self.report.joint_effort);
        // of all lanes at once, and only then one by one
        let broken = L::vectorize(BrokenAnywhere { limits, numbers });
        let breaks = |lane: usize| limits.violation(numbers, |x| x.lane_f32(lane)).is_some();
        let rows = order.iter().enumerate().filter(|&(lane, _)| broken && breaks(lane));
        rows.map(|(_, &row)| row).min()
    }

    /// Writes the lanes to rows.
    pub(super) fn scatter(&mut self, rows: &mut PhysicsRows, order: &[usize]) {
        let Self { state, report, feet, touching, .. } = self;
        touching.clear();
        touching.extend((0..report.touched.len()).filter(|body| report.touched[*body] && !feet.contains(body)));
        for (lane, &row) in order.iter().enumerate() {
            rows.write_motion(row, state, lane);
            let contacts = &mut rows.impulses[row].contacts;
            contacts.clear();
            for &contact in &state.pressing {
                let mut impulse = [0.0; 3];
                get(&state.impulse[contact as usize], &mut impulse, lane);
                // those of the lane's own alone
                if impulse != [0.0; 3] {
                    contacts.push(ContactImpulse { contact, impulse });
                }
            }
            get(&state.bound_impulse, &mut rows.impulses[row].bounds, lane);
            get(&report.joint_effort, &mut rows.efforts[row].applied, lane);
            get(&report.joint_acceleration, &mut rows.efforts[row].acceleration, lane);
            let net = |body: usize| report.body_force[body].map(|force| force.lane_f32(lane));
            let normal = |step: usize, body: usize| report.normal_force[step][body].lane_f32(lane);
            rows.forces[row].set(feet, touching, net, normal);
            get_arrays(&report.site_position, &mut rows.feet[row].position, lane);
            get_arrays(&report.site_velocity, &mut rows.feet[row].velocity, lane);
        }
    }
}

struct BrokenAnywhere<'a, L> {
    limits: &'a StateLimits,
    numbers: StateNumbers<'a, L>,
}

impl<L: Real> Kernel<L> for BrokenAnywhere<'_, L> {
    type Output = bool;

    #[inline(always)]
    fn run(self) -> bool {
        self.limits.broken_anywhere(self.numbers)
    }
}
