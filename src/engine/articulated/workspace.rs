//! Packs between components and kernel: robots are gathered into lanes and scattered back.

use super::super::{Kind, RobotRows, StateLimits, StateNumbers, get, history_length, put, state_numbers};
use crate::components::ContactImpulse;
use crate::dynamics::lanes::Kernel;
use crate::dynamics::{Drive, Lanes, Parameters, Real, Report, State, Workspace};

/// Where a thread steps one pack of a morphology after the other; its contents mean nothing between two.
pub(super) struct PackWorkspace<L: Real> {
    /// Where the envs' origins are on the terrain, m.
    pub(super) origin: [L; 2],
    /// Of a body as the morphology has it.
    pub(super) nominal: Parameters<L>,
    /// The same without gains.
    pub(super) without_gains: Parameters<L>,
    pub(super) state: State<L>,
    pub(super) drive: Drive<L>,
    pub(super) report: Report<L>,
    pub(super) work: Workspace<L>,
    /// Which of the state's impulses are pressing.
    presses: Vec<bool>,
    /// The contact bodies that are feet.
    feet: Vec<usize>,
    /// The others that the pack had touched something with.
    touching: Vec<usize>,
}

impl<L: Lanes> PackWorkspace<L> {
    /// For a kind whose numbers are `nominal` in every lane.
    pub(super) fn new<T>(kind: &Kind<T>, nominal: &Parameters<L>, decimation: usize) -> Self {
        let topology = kind.topology;
        let state = State::zeros(topology);
        Self {
            origin: [L::zero(); 2],
            nominal: nominal.clone(),
            without_gains: nominal.clone(),
            presses: vec![false; state.impulse.len()],
            feet: kind.feet.to_vec(),
            touching: Vec::new(),
            state,
            drive: Drive::zeros(topology, history_length(kind.max_delay, decimation)),
            report: Report::zeros(topology, decimation),
            work: Workspace::new(topology),
        }
    }

    /// Reads rows into the lanes; lanes beyond them shadow the last row.
    pub(super) fn gather(&mut self, rows: &impl RobotRows, order: &[usize]) {
        for &contact in &self.state.pressing {
            self.state.impulse[contact as usize] = [L::zero(); 3];
        }
        self.presses.fill(false);
        self.state.pressing.clear();
        for lane in 0..L::LANES {
            // idle lanes shadow the last robot
            let row = order[lane.min(order.len() - 1)];
            let state = &mut self.state;
            rows.read_motion(row, state, lane);
            put(&mut self.origin, &rows.origin(row), lane);
            let (contacts, bounds) = rows.impulses(row);
            for ContactImpulse { contact, impulse } in contacts {
                let contact = *contact as usize;
                if let (Some(all), Some(presses)) = (state.impulse.get_mut(contact), self.presses.get_mut(contact)) {
                    put(all, impulse, lane);
                    if !std::mem::replace(presses, true) {
                        state.pressing.push(contact as u32);
                    }
                }
            }
            put(&mut state.bound_impulse, bounds, lane);
            rows.read_drive(row, &mut self.drive, lane);
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
    pub(super) fn scatter<R: RobotRows>(&mut self, rows: &mut R, order: &[usize]) {
        let Self { state, report, feet, touching, .. } = self;
        touching.clear();
        touching.extend((0..report.touched.len()).filter(|body| report.touched[*body] && !feet.contains(body)));
        for (lane, &row) in order.iter().enumerate() {
            rows.write_motion(row, state, lane);
            let (contacts, bounds) = rows.impulses_mut(row);
            contacts.clear();
            for &contact in &state.pressing {
                let impulse = state.impulse[contact as usize].map(|x| x.lane(lane));
                // those of the lane's own alone
                if impulse != [0.0; 3] {
                    contacts.push(ContactImpulse { contact, impulse: impulse.map(R::Number::splat) });
                }
            }
            get(&state.bound_impulse, bounds, lane);
            rows.write_report(row, report, feet, touching, lane);
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
