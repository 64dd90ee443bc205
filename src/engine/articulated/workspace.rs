//! Packs between rows and kernel: robots are read into lanes and written back.

use std::ops::Range;

use super::super::{MorphologySetup, RobotRows, StateLimits, StateNumbers, clear_drive, history_length, state_numbers};
use crate::components::ContactImpulse;
use crate::dynamics::lanes::{Kernel, Lanes, Real, read_lane, write_lane};
use crate::dynamics::{ActuatorNetwork, Drive, Parameters, Report, State, Workspace};

/// One pack: robots side by side in lanes. Their bodies' parameters are in [`PackWorkspace`].
#[derive(Clone)]
pub(super) struct Pack<L: Real> {
    /// Origins of the envs on the terrain, m.
    pub(super) origin: [L; 2],
    pub(super) state: State<L>,
    pub(super) drive: Drive<L>,
    /// Memory of the actuator networks.
    pub(super) memory: Vec<L>,
    pub(super) report: Report<L>,
    /// Whether each of the state's contacts presses.
    presses: Vec<bool>,
    /// The contact bodies that are feet.
    feet: Vec<usize>,
    /// Other contact bodies that touch something in any lane.
    touching: Vec<usize>,
}

/// A thread's memory for stepping the packs of a morphology, one after the other.
pub(super) struct PackWorkspace<L: Real> {
    /// Parameters of the morphology.
    pub(super) nominal: Parameters<L>,
    /// Parameters of the morphology without gains.
    pub(super) without_gains: Parameters<L>,
    pub(super) work: Workspace<L>,
    /// Inputs of the actuator networks.
    pub(super) features: Vec<L>,
    /// The pack of robots that live in rows; its contents mean nothing between two packs.
    pub(super) pack: Pack<L>,
}

impl<L: Lanes> PackWorkspace<L> {
    /// Memory for a morphology whose parameters are `nominal` in every lane.
    pub(super) fn new<T>(setup: &MorphologySetup<T>, nominal: &Parameters<L>, decimation: usize) -> Self {
        Self {
            nominal: nominal.clone(),
            without_gains: nominal.clone(),
            work: Workspace::new(setup.topology),
            features: Vec::new(),
            pack: Pack::new(setup, decimation),
        }
    }
}

impl<L: Lanes> Pack<L> {
    /// Robots at rest at the world's origin.
    pub(super) fn new<T>(setup: &MorphologySetup<T>, decimation: usize) -> Self {
        let topology = setup.topology;
        Self {
            origin: [L::zero(); 2],
            state: State::zeros(topology),
            drive: Drive::zeros(topology, history_length(setup.max_delay, decimation)),
            memory: vec![L::zero(); ActuatorNetwork::num_remembered_by(setup.networks)],
            report: Report::zeros(topology, decimation),
            presses: vec![false; topology.num_impulses()],
            feet: setup.feet.to_vec(),
            touching: Vec::new(),
        }
    }

    /// Reads rows into the lanes; lanes beyond them shadow the last row, so that they cost and
    /// break nothing.
    pub(super) fn gather(&mut self, rows: &impl RobotRows, order: &[usize]) {
        for &contact in &self.state.pressing {
            self.state.impulse[contact as usize] = [L::zero(); 3];
        }
        self.presses.fill(false);
        self.state.pressing.clear();
        clear_drive(&mut self.drive);
        order.iter().for_each(|&row| rows.prefetch_read(row));
        for lane in 0..L::LANES {
            let row = order[lane.min(order.len() - 1)];
            self.read_row(rows, row, lane);
            rows.read_drive(row, &mut self.drive, lane);
        }
        self.state.pressing.sort_unstable();
    }

    /// Reads the drives of robots from their rows, without states.
    pub(super) fn gather_drive(&mut self, rows: &impl RobotRows, order: &[usize]) {
        clear_drive(&mut self.drive);
        for lane in 0..L::LANES {
            rows.read_drive(order[lane.min(order.len() - 1)], &mut self.drive, lane);
        }
    }

    /// Makes room for the normal forces of `steps` physics steps.
    pub(super) fn make_room(&mut self, steps: usize) {
        let Report { normal_force, body_force, .. } = &mut self.report;
        if normal_force.len() < steps {
            normal_force.resize(steps, vec![L::zero(); body_force.len()]);
        }
    }

    /// Reads state and report of a row into some lanes, and leaves the others as they are.
    pub(super) fn restart(&mut self, rows: &impl RobotRows, row: usize, lanes: Range<usize>) {
        self.presses.fill(false);
        for &contact in &self.state.pressing {
            self.presses[contact as usize] = true;
            for lane in lanes.clone() {
                write_lane(&mut self.state.impulse[contact as usize], &[0.0; 3], lane);
            }
        }
        for lane in lanes {
            self.read_row(rows, row, lane);
            rows.read_report(row, &mut self.report, lane);
        }
        self.state.pressing.sort_unstable();
        self.find_touching();
    }

    #[inline]
    fn read_row(&mut self, rows: &impl RobotRows, row: usize, lane: usize) {
        let state = &mut self.state;
        rows.read_motion(row, state, lane);
        write_lane(&mut self.origin, &rows.origin(row), lane);
        write_lane(&mut self.memory, rows.memory(row), lane);
        let (contacts, bounds) = rows.impulses(row);
        for ContactImpulse { contact, impulse } in contacts {
            let contact = *contact as usize;
            if let (Some(all), Some(presses)) = (state.impulse.get_mut(contact), self.presses.get_mut(contact)) {
                write_lane(all, impulse, lane);
                if !std::mem::replace(presses, true) {
                    state.pressing.push(contact as u32);
                }
            }
        }
        write_lane(&mut state.bound_impulse, bounds, lane);
    }

    /// The first of the lanes' rows whose new state is not finite or beyond the limits.
    pub(super) fn first_broken(&self, limits: &StateLimits, order: &[usize]) -> Option<usize> {
        let numbers = state_numbers(&self.state, &self.report.joint_effort);
        // all lanes at once, and only then one by one
        let broken = L::vectorize(BrokenAnywhere { limits, numbers });
        let breaks = |lane: usize| limits.violation(numbers, |x| x.lane_f32(lane)).is_some();
        let rows = order.iter().enumerate().filter(|&(lane, _)| broken && breaks(lane));
        rows.map(|(_, &row)| row).min()
    }

    /// Finds the bodies that [`write_row`](Self::write_row) reports, after a step.
    pub(super) fn find_touching(&mut self) {
        let Self { report, feet, touching, .. } = self;
        touching.clear();
        touching.extend((0..report.touched.len()).filter(|body| report.touched[*body] && !feet.contains(body)));
    }

    /// Writes the lanes to rows.
    pub(super) fn scatter(&self, rows: &mut impl RobotRows, order: &[usize]) {
        order.iter().for_each(|&row| rows.prefetch_written(row));
        for (lane, &row) in order.iter().enumerate() {
            self.write_row(rows, row, lane);
        }
    }

    /// Writes a lane to a row.
    #[inline]
    pub(super) fn write_row<R: RobotRows>(&self, rows: &mut R, row: usize, lane: usize) {
        let state = &self.state;
        rows.write_motion(row, state, lane);
        read_lane(&self.memory, rows.memory_mut(row), lane);
        let (contacts, bounds) = rows.impulses_mut(row);
        contacts.clear();
        for &contact in &state.pressing {
            let mut impulse = [R::Number::zero(); 3];
            read_lane(&state.impulse[contact as usize], &mut impulse, lane);
            // write the contacts of this lane alone
            if impulse.iter().any(|x| x.lane(0) != 0.0) {
                contacts.push(ContactImpulse { contact, impulse });
            }
        }
        read_lane(&state.bound_impulse, bounds, lane);
        rows.write_report(row, &self.report, &self.feet, &self.touching, lane);
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
