//! The robots of a morphology on a device: rows into columns and back.

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use polypod_cuda::{Columns, Device, DeviceBlock, DeviceError, Motion, ROBOTS_OF_TILE, Scene, Shape, list};
use smallvec::SmallVec;

use super::super::{DivergenceRecord, RobotRows, RobotSlices, StateLimits, history_length};
use crate::components::ContactImpulse;
use crate::dynamics::{ActuatorNetwork, HeightGrid, Parameters, StepSettings, Topology};
use crate::morphology::MorphologyModel;
use crate::workers::{SplitRows, Workers};

/// Contacts that lists of impulses have room for at first: those of a standing quadruped. Room that
/// robots do not use is transferred too.
const FIRST_CAPACITY: usize = 4;
/// Fewest tiles that a thread copies at a time.
const MIN_TILES: usize = 2;

/// Robots of one morphology.
pub(super) struct Robots {
    envs: Range<usize>,
    topology: Topology,
    networks: Vec<ActuatorNetwork>,
    /// Control steps whose targets are remembered.
    ages: usize,
    /// Links and frames of the forces from outside so far, in rising order.
    forces: Vec<(usize, bool)>,
    nominal: Parameters<f32>,
    /// One list while all robots have the morphology's parameters, then the tiles of all robots.
    parameters: Vec<f32>,
    shared: bool,
    /// Tiles whose parameters the device does not have yet; for shared ones, any tile.
    changed: Vec<bool>,
    /// Contact bodies that are feet, and the others.
    feet: Vec<usize>,
    others: Vec<usize>,
    block: Box<dyn DeviceBlock>,
}

/// A thread's rows, with their columns.
struct Part<'a, 'b> {
    first: usize,
    rows: RobotSlices<'b>,
    columns: Columns<'a>,
}

/// Shares rows and columns out among threads, whole tiles each.
fn share_out<'a, 'b>(
    workers: &Workers,
    rows: RobotSlices<'b>,
    columns: Columns<'a>,
    count: usize,
) -> Vec<Part<'a, 'b>> {
    let tiles = workers.share(count.div_ceil(ROBOTS_OF_TILE), MIN_TILES);
    let (mut rest, mut parts) = (Some((rows, columns)), Vec::new());
    let mut first = 0;
    while let Some((rows, columns)) = rest.take() {
        let n = (tiles * ROBOTS_OF_TILE).min(count - first);
        let (rows, more) = rows.split_rows(n);
        let (columns, further) = columns.split_at(n.div_ceil(ROBOTS_OF_TILE));
        parts.push(Part { first, rows, columns });
        first += n;
        rest = (first < count).then_some((more, further));
    }
    parts
}

impl Robots {
    /// `count` robots of a morphology.
    ///
    /// # Errors
    /// A feature that the device lacks, or too little memory.
    pub(super) fn new(
        device: &dyn Device,
        morphology: &MorphologyModel,
        settings: &StepSettings,
        terrain: Option<&HeightGrid>,
        first_env: usize,
        count: usize,
    ) -> Result<Self, DeviceError> {
        let ages = history_length(morphology.max_delay(), settings.decimation);
        let MorphologyModel { topology, networks, nominal, feet, .. } = morphology;
        let scene = Scene { terrain, networks, ages, link_forces: &[] };
        let shape = Shape::new(topology, settings, &scene, count, FIRST_CAPACITY)?;
        let tiles = shape.tiles();
        let block = device.allocate(shape)?;
        Ok(Self {
            envs: first_env..first_env + count,
            topology: topology.clone(),
            networks: networks.to_vec(),
            ages,
            forces: Vec::new(),
            nominal: nominal.clone(),
            parameters: list(nominal),
            shared: true,
            changed: vec![true; tiles],
            feet: feet.to_vec(),
            others: (0..topology.num_bodies).filter(|body| !feet.contains(body)).collect(),
            block,
        })
    }

    /// The envs of the robots.
    pub(super) fn envs(&self) -> Range<usize> {
        self.envs.clone()
    }

    /// Impulses that a robot may have.
    pub(super) fn num_impulses(&self) -> usize {
        self.topology.num_impulses()
    }

    /// See [`DeviceBlock::seconds`].
    pub(super) fn seconds(&self) -> Option<[f64; 3]> {
        self.block.seconds()
    }

    /// Takes over the parameters of an env's robot.
    pub(super) fn upload(&mut self, env: usize, parameters: &Parameters<f32>) {
        let differs = |own: &f32, common: &f32| own.to_bits() != common.to_bits();
        if self.shared && !parameters.any_with(&self.nominal, differs) {
            return;
        }
        let shape = self.block.shape();
        if self.shared {
            self.parameters = shape.spread(&self.parameters);
            self.shared = false;
            self.changed.fill(true);
        }
        let robot = env - self.envs.start;
        shape.write_parameters(&mut self.parameters, robot, &list(parameters));
        self.changed[robot / ROBOTS_OF_TILE] = true;
    }

    /// Begins a control step of the robots in these rows.
    ///
    /// # Errors
    /// A device that is lost, or whose memory is too small for more contacts.
    pub(super) fn start(
        &mut self,
        device: &dyn Device,
        settings: &StepSettings,
        terrain: Option<&HeightGrid>,
        workers: &Workers,
        rows: &mut RobotSlices<'_>,
    ) -> Result<(), DeviceError> {
        let contacts = self.read_rows(workers, rows);
        let forces = self.forces_of(rows);
        if contacts > self.block.shape().capacity || forces.len() > self.forces.len() {
            self.forces = forces;
            self.allocate(device, settings, terrain, contacts)?;
            self.read_rows(workers, rows);
        }
        if self.changed.contains(&true) {
            let changed: Vec<usize> = (0..self.changed.len()).filter(|&tile| self.changed[tile]).collect();
            self.block.set_parameters(&self.parameters, self.shared, &changed)?;
            self.changed.fill(false);
        }
        self.block.start()
    }

    /// Waits for the end of the step. Where a robot has more contacts than there was room for, the
    /// step is made again: its inputs are in the rows as they were.
    ///
    /// # Errors
    /// As [`start`](Self::start).
    pub(super) fn finish(
        &mut self,
        device: &dyn Device,
        settings: &StepSettings,
        terrain: Option<&HeightGrid>,
        workers: &Workers,
        rows: &mut RobotSlices<'_>,
    ) -> Result<(), DeviceError> {
        loop {
            self.block.finish()?;
            let columns = self.block.columns();
            let contacts = (0..self.envs.len()).map(|robot| columns.num_impulses(robot)).max().unwrap_or(0);
            if contacts <= self.block.shape().capacity {
                return Ok(());
            }
            self.allocate(device, settings, terrain, contacts)?;
            self.start(device, settings, terrain, workers, rows)?;
        }
    }

    /// Memory with more room: for more contacts, or for forces on more links.
    fn allocate(
        &mut self,
        device: &dyn Device,
        settings: &StepSettings,
        terrain: Option<&HeightGrid>,
        contacts: usize,
    ) -> Result<(), DeviceError> {
        let capacity = contacts.next_power_of_two().max(self.block.shape().capacity);
        let scene = Scene { terrain, networks: &self.networks, ages: self.ages, link_forces: &self.forces };
        let shape = Shape::new(&self.topology, settings, &scene, self.envs.len(), capacity)?;
        self.block = device.allocate(shape)?;
        self.changed.fill(true);
        Ok(())
    }

    /// Links and frames of the forces so far, and of those in these rows.
    fn forces_of(&self, rows: &RobotSlices<'_>) -> Vec<(usize, bool)> {
        let mut forces = self.forces.clone();
        for force in rows.link_forces.iter().flat_map(|forces| &forces.0) {
            let key = (force.link as usize, force.in_world);
            if let Err(place) = forces.binary_search(&key) {
                forces.insert(place, key);
            }
        }
        forces
    }

    /// Copies rows into columns. Returns the most contacts of a robot.
    fn read_rows(&mut self, workers: &Workers, rows: &mut RobotSlices<'_>) -> usize {
        let count = self.envs.len();
        let parts = share_out(workers, rows.reborrow(), self.block.columns(), count);
        let (most, ages, forces) = (AtomicUsize::new(0), self.ages, &self.forces);
        workers.for_each(parts.into_iter(), |Part { rows, mut columns, .. }| {
            let mut contacts = 0;
            for row in 0..rows.poses.len() {
                let (pose, velocity, joints) = (&rows.poses[row], &rows.velocities[row], &rows.joints[row]);
                let impulses = &rows.impulses[row];
                columns.write_motion(
                    row,
                    &Motion {
                        position: &pose.position,
                        rotation: &pose.rotation,
                        velocity: [&velocity.linear, &velocity.angular],
                        joints: &joints.position,
                        joint_velocities: &joints.velocity,
                        bounds: &impulses.bounds,
                    },
                );
                contacts = contacts.max(impulses.contacts.len());
                columns.write_impulses(row, impulses.contacts.iter().map(|of| (of.contact, of.impulse)));
                // without a history no actuator sees a delay
                let delays: &[f32] = if ages > 1 { &rows.delays[row].0 } else { &[] };
                columns.write_targets(row, rows.targets[row].history.iter().take(ages).flatten(), delays);
                let wrench = &rows.wrenches[row];
                columns.write_surroundings(row, &wrench.force, &wrench.torque, &rows.origins[row].position);
                for (key, &(link, in_world)) in forces.iter().enumerate() {
                    let own = &rows.link_forces[row].0;
                    let of_key = own.iter().rfind(|force| (force.link as usize, force.in_world) == (link, in_world));
                    let (acts, vectors) = match of_key {
                        Some(force) => (1.0, [&force.point, &force.force, &force.torque]),
                        None => (0.0, [&[0.0; 3]; 3]),
                    };
                    columns.write_link_force(row, key, acts, vectors);
                }
            }
            most.fetch_max(contacts, Ordering::Relaxed);
        });
        most.into_inner()
    }

    /// Copies columns into rows. Where there are limits, returns the record of the first env whose
    /// new state is beyond them.
    pub(super) fn write_rows(
        &mut self,
        workers: &Workers,
        rows: &mut RobotSlices<'_>,
        morphology: usize,
        limits: Option<&StateLimits>,
    ) -> Option<DivergenceRecord> {
        let (count, first_env) = (self.envs.len(), self.envs.start);
        let (feet, others) = (&self.feet, &self.others);
        let columns = self.block.columns();
        let found = Mutex::new(Vec::new());
        let parts = share_out(workers, rows.reborrow(), columns, count);
        workers.for_each(parts.into_iter(), |Part { first, mut rows, columns }| {
            let broken = limits.and_then(|limits| first_broken(&rows, &columns, limits));
            let record = rows.record(broken, morphology, first_env + first, |rows| {
                (0..rows.poses.len()).for_each(|row| write_row(rows, row, &columns, feet, others));
            });
            if let Some(record) = record {
                found.lock().unwrap_or_else(PoisonError::into_inner).push(record);
            }
        });
        let found = found.into_inner().unwrap_or_else(PoisonError::into_inner);
        found.into_iter().min_by_key(|record| record.env)
    }
}

/// The first row whose new state, which is in the columns, is not finite or beyond the limits.
fn first_broken(rows: &RobotSlices<'_>, columns: &Columns<'_>, limits: &StateLimits) -> Option<usize> {
    let joints = rows.joints.first().map_or(0, |joints| joints.position.len());
    let mut numbers: SmallVec<[f32; 128]> = SmallVec::from_elem(0.0, 13 + 5 * joints);
    (0..rows.poses.len()).find(|&row| {
        let (position, rest) = numbers.split_at_mut(3);
        let (rotation, rest) = rest.split_at_mut(4);
        let (linear, rest) = rest.split_at_mut(3);
        let (angular, rest) = rest.split_at_mut(3);
        let (positions, rest) = rest.split_at_mut(joints);
        let (velocities, rest) = rest.split_at_mut(joints);
        let (bounds, rest) = rest.split_at_mut(joints);
        let (efforts, accelerations) = rest.split_at_mut(joints);
        columns.read_motion(
            row,
            Motion {
                position: &mut *position,
                rotation: &mut *rotation,
                velocity: [&mut *linear, &mut *angular],
                joints: &mut *positions,
                joint_velocities: &mut *velocities,
                bounds,
            },
        );
        columns.read_joints(row, efforts, accelerations);
        limits.violation([position, rotation, linear, angular, positions, velocities, efforts], |x| x).is_some()
    })
}

/// Writes the new state and the report of a robot to its row.
fn write_row(rows: &mut RobotSlices<'_>, row: usize, columns: &Columns<'_>, feet: &[usize], others: &[usize]) {
    let (pose, velocity, joints) = (&mut rows.poses[row], &mut rows.velocities[row], &mut rows.joints[row]);
    let impulses = &mut rows.impulses[row];
    columns.read_motion(
        row,
        Motion {
            position: &mut pose.position,
            rotation: &mut pose.rotation,
            velocity: [&mut velocity.linear, &mut velocity.angular],
            joints: &mut joints.position,
            joint_velocities: &mut joints.velocity,
            bounds: &mut impulses.bounds,
        },
    );
    impulses.contacts.clear();
    impulses.contacts.extend(columns.impulses(row).map(|(contact, impulse)| ContactImpulse { contact, impulse }));
    let effort = &mut rows.efforts[row];
    columns.read_joints(row, &mut effort.applied, &mut effort.acceleration);
    let normal = |step: usize, body: usize| columns.normal_force(row, step, body);
    rows.forces[row].set(feet, others, |body| columns.body_force(row, body), normal);
    let feet = &mut rows.feet[row];
    columns.read_sites(row, &mut feet.position, &mut feet.velocity);
}
