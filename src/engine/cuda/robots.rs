//! The robots of a morphology on a device: components into the rows that it reads, and back.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use polypod_cuda::{Device, DeviceBlock, DeviceError, Exchange, Heights, Motion, Scene, Shape, TaskTables, list};
use smallvec::{SmallVec, smallvec};

use super::super::{DivergenceRecord, RobotRows, RobotSlices, Run, StateLimits, history_length};
use super::whole::BrokenRobot;
use crate::blocks::Block;
use crate::components::{
    ActuatorDelay, ActuatorMemory, BasePose, BaseVelocity, ConstraintImpulses, ContactImpulse, ExternalWrench,
    JointEffort, JointState, JointTargets, LinkForce, LinkForces, PerJoint,
};
use crate::dynamics::{ActuatorNetwork, Parameters, StepSettings, Topology};
use crate::morphology::MorphologyModel;
use crate::workers::{SplitRows, Workers};

/// Contacts that lists of impulses have room for at first: those of a standing quadruped. Room that
/// robots do not use is transferred too.
const FIRST_CAPACITY: usize = 4;
/// Robots between the one that is copied and the one whose components are prefetched.
const PREFETCHED: usize = 4;
/// Fewest robots that a thread copies at a time.
const MIN_ROBOTS: usize = 64;

/// Device, settings, heights and threads of an engine, which all steps need.
pub(super) struct Means<'a> {
    pub(super) device: &'a dyn Device,
    pub(super) settings: &'a StepSettings,
    pub(super) heights: Option<&'a Heights>,
    pub(super) workers: &'a Workers,
}

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
    /// Tiles of the robots' parameters; empty while all have the morphology's.
    parameters: Vec<f32>,
    /// The morphology's parameters.
    common: Vec<f32>,
    /// Columns of parameters in which a robot differs from its morphology, a bit for each: the
    /// device reads the other ones once for all robots.
    own: u32,
    /// Tiles whose parameters the device does not have yet; while there are none, any tile.
    changed: Vec<bool>,
    /// Contact bodies that are feet, and the others.
    feet: Vec<usize>,
    others: Vec<usize>,
    block: Box<dyn DeviceBlock>,
    /// The task that the block has.
    task: Option<TaskTables>,
    needs: Needs,
}

/// Facts about the robots whose rows threads copy.
#[derive(Clone, Copy)]
struct Common<'a> {
    ages: usize,
    forces: &'a [(usize, bool)],
    feet: &'a [usize],
    others: &'a [usize],
    needs: &'a Needs,
    first_env: usize,
}

/// Needs of a control step beyond the memory of its block.
#[derive(Default)]
struct Needs {
    /// Most contacts of a robot.
    contacts: AtomicUsize,
    /// Whether a force acts that the tables lack.
    forces: AtomicBool,
}

/// Robots of a morphology, and their components in a control step.
pub(super) type Pair<'a, 'b> = (&'a mut Robots, &'a mut Block<RobotSlices<'b>>);

/// A thread's rows: components, and those of the device.
struct Part<'a, 'b> {
    morphology: usize,
    first: usize,
    rows: RobotSlices<'b>,
    exchange: Exchange<'a>,
    common: Common<'a>,
}

/// Parts of all robots, so that threads meet once for all morphologies.
fn parts<'a>(workers: &Workers, pairs: Vec<Pair<'a, '_>>) -> Vec<Part<'a, 'a>> {
    let all: usize = pairs.iter().map(|(robots, _)| robots.envs.len()).sum();
    let most = workers.share(all, MIN_ROBOTS);
    let mut parts = Vec::new();
    for (robots, block) in pairs {
        parts.extend(robots.parts(usize::from(block.morphology.0), block.rows.reborrow(), most));
    }
    parts
}

/// Copies the components of all robots into the rows of the device.
pub(super) fn read_rows(workers: &Workers, pairs: Vec<Pair<'_, '_>>) {
    workers.for_each(parts(workers, pairs).into_iter(), Part::read);
}

/// Copies the rows of the device into the components of all robots. Returns the record of the first
/// env of each watched morphology whose new state is beyond the limits.
pub(super) fn write_rows(workers: &Workers, pairs: Vec<Pair<'_, '_>>, run: &Run) -> Vec<DivergenceRecord> {
    let found = Mutex::new(Vec::new());
    workers.for_each(parts(workers, pairs).into_iter(), |part| {
        let limits = run.watched[part.morphology].then_some(run.limits);
        if let Some(record) = part.write(limits) {
            found.lock().unwrap_or_else(PoisonError::into_inner).push(record);
        }
    });
    let mut found = found.into_inner().unwrap_or_else(PoisonError::into_inner);
    found.sort_by_key(|record| record.env);
    found.dedup_by_key(|record| record.morphology);
    found
}

/// Copies the drives of the device into the components of all robots: targets, delays and wrenches,
/// which the device has changed in whole control steps.
pub(super) fn write_drives(workers: &Workers, pairs: Vec<Pair<'_, '_>>) {
    workers.for_each(parts(workers, pairs).into_iter(), Part::write_drive);
}

/// Copies the efforts of all robots into the rows of the device, which reports them in the next
/// control step: they are part of the record of a state that breaks there.
pub(super) fn read_efforts(workers: &Workers, pairs: Vec<Pair<'_, '_>>) {
    workers.for_each(parts(workers, pairs).into_iter(), Part::read_effort);
}

impl Part<'_, '_> {
    fn read_effort(self) {
        let Self { rows, mut exchange, .. } = self;
        for (row, effort) in rows.efforts.iter().enumerate() {
            exchange.write_joints(row, &effort.applied, &effort.acceleration);
        }
    }

    fn write_drive(self) {
        let Self { rows, exchange, common: Common { ages, .. }, .. } = self;
        for row in 0..rows.poses.len() {
            let delays: &mut [f32] = if ages > 1 { &mut rows.delays[row].0 } else { &mut [] };
            exchange.read_targets(row, rows.targets[row].history.iter_mut().take(ages).flatten(), delays);
            let wrench = &mut rows.wrenches[row];
            exchange.read_wrench(row, &mut wrench.force, &mut wrench.torque);
        }
    }

    fn read(self) {
        let Self { rows, mut exchange, common: Common { ages, forces, needs, .. }, .. } = self;
        let (mut contacts, mut unknown) = (0, false);
        for row in 0..rows.poses.len() {
            prefetch_after(&rows, row);
            let (pose, velocity, joints) = (&rows.poses[row], &rows.velocities[row], &rows.joints[row]);
            let impulses = &rows.impulses[row];
            exchange.write_motion(
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
            exchange.write_memory(row, &rows.memories[row].0);
            contacts = contacts.max(impulses.contacts.len());
            exchange.write_impulses(row, impulses.contacts.iter().map(|of| (of.contact, of.impulse)));
            // without a history no actuator sees a delay
            let delays: &[f32] = if ages > 1 { &rows.delays[row].0 } else { &[] };
            exchange.write_targets(row, rows.targets[row].history.iter().take(ages).flatten(), delays);
            let wrench = &rows.wrenches[row];
            exchange.write_surroundings(row, &wrench.force, &wrench.torque, &rows.origins[row].position);
            let own = &rows.link_forces[row].0;
            unknown |= own.iter().any(|force| forces.binary_search(&key_of(force)).is_err());
            for (key, of) in forces.iter().enumerate() {
                let (acts, vectors) = match own.iter().rfind(|force| key_of(force) == *of) {
                    Some(force) => (1.0, [&force.point, &force.force, &force.torque]),
                    None => (0.0, [&[0.0; 3]; 3]),
                };
                exchange.write_link_force(row, key, acts, vectors);
            }
        }
        needs.contacts.fetch_max(contacts, Ordering::Relaxed);
        needs.forces.fetch_or(unknown, Ordering::Relaxed);
    }

    fn write(self, limits: Option<&StateLimits>) -> Option<DivergenceRecord> {
        let Self { morphology, first, mut rows, exchange, common } = self;
        let broken = limits.and_then(|limits| first_broken(&rows, &exchange, limits));
        rows.record(broken, morphology, common.first_env + first, |rows| {
            for row in 0..rows.poses.len() {
                prefetch_after(rows, row);
                write_row(rows, row, &exchange, common.feet, common.others);
            }
        })
    }
}

/// Prefetches the components of a robot some rows on: there are more columns of them than a
/// processor follows.
fn prefetch_after(rows: &RobotSlices<'_>, row: usize) {
    if row + PREFETCHED < rows.poses.len() {
        rows.prefetch(row + PREFETCHED);
    }
}

/// The link and the frame of a force.
fn key_of(force: &LinkForce) -> (usize, bool) {
    (force.link as usize, force.in_world)
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
        heights: Option<&Heights>,
        first_env: usize,
        count: usize,
    ) -> Result<Self, DeviceError> {
        let ages = history_length(morphology.max_delay(), settings.decimation);
        let MorphologyModel { topology, networks, nominal, feet, .. } = morphology;
        let scene = Scene { terrain: heights, networks, ages, link_forces: &[] };
        let shape = Shape::new(topology, settings, &scene, count, FIRST_CAPACITY)?;
        let block = device.allocate(shape)?;
        Ok(Self {
            envs: first_env..first_env + count,
            topology: topology.clone(),
            networks: networks.to_vec(),
            ages,
            forces: Vec::new(),
            nominal: nominal.clone(),
            parameters: Vec::new(),
            common: list(nominal),
            own: 0,
            changed: vec![true; block.shape().tiles()],
            feet: feet.to_vec(),
            others: (0..topology.num_bodies).filter(|body| !feet.contains(body)).collect(),
            block,
            task: None,
            needs: Needs::default(),
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

    /// See [`DeviceBlock::is_ready`].
    pub(super) fn is_ready(&mut self) -> bool {
        self.block.is_ready()
    }

    /// Takes over the parameters of an env's robot.
    pub(super) fn upload(&mut self, env: usize, parameters: &Parameters<f32>) {
        let differs = |own: &f32, common: &f32| own.to_bits() != common.to_bits();
        if self.own == 0 && !parameters.any_with(&self.nominal, differs) {
            return;
        }
        let (shape, parameters) = (self.block.shape(), list(parameters));
        if self.parameters.is_empty() {
            self.parameters = shape.spread(&self.common);
            self.changed.fill(true);
        }
        self.own |= shape.differing(&parameters, &self.common);
        let robot = env - self.envs.start;
        shape.write_parameters(&mut self.parameters, robot, &parameters);
        self.changed[robot / shape.tile] = true;
    }

    /// The record of a robot whose state broke in the last whole control step.
    ///
    /// # Errors
    /// A device that is lost.
    pub(super) fn record(&mut self, robot: usize) -> Result<Option<BrokenRobot>, DeviceError> {
        let (shape, joints, ages) = (self.block.shape().of_one(), self.topology.num_joints(), self.ages);
        let kept = self.block.envs().map_or(Ok(None), |envs| envs.kept(robot))?;
        let Some(mut kept) = kept else { return Ok(None) };
        let (before, after) = kept.split_at_mut(shape.exchanged());
        let (after, more) = after.split_at_mut(shape.exchanged());
        let (before, after) = (shape.exchange(before), shape.exchange(after));
        let zeros: PerJoint = smallvec![0.0; joints];
        let mut targets = JointTargets { history: smallvec![zeros.clone(); ages], fresh: false };
        let (mut delay, mut wrench) = (ActuatorDelay(zeros), ExternalWrench::default());
        let delays: &mut [f32] = if ages > 1 { &mut delay.0 } else { &mut [] };
        before.read_targets(0, targets.history.iter_mut().flatten(), delays);
        before.read_wrench(0, &mut wrench.force, &mut wrench.torque);
        let mut memory = vec![0.0; ActuatorNetwork::num_remembered_by(&self.networks)];
        before.read_memory(0, &mut memory);
        let record = DivergenceRecord {
            morphology: 0,
            env: self.envs.start + robot,
            before: motion(&before, joints),
            targets,
            delay,
            memory: ActuatorMemory(memory.into()),
            wrench,
            link_forces: LinkForces::default(),
            after: motion(&after, joints),
        };
        let changes = self.task.as_ref().is_some_and(|task| task.own != 0);
        Ok(Some(BrokenRobot { record, length: more[0] as u32, body: changes.then(|| more[2..].to_vec()) }))
    }

    /// Parts of at most some robots each.
    fn parts<'a, 'b>(&'a mut self, morphology: usize, rows: RobotSlices<'b>, most: usize) -> Vec<Part<'a, 'b>> {
        let Self { envs, ages, forces, feet, others, block, needs, .. } = self;
        *needs = Needs::default();
        let common = Common { ages: *ages, forces, feet, others, needs, first_env: envs.start };
        let (mut rest, mut parts, mut first) = (Some((rows, block.exchange())), Vec::new(), 0);
        while let Some((rows, exchange)) = rest.take() {
            let n = most.min(envs.len() - first);
            let (rows, more) = rows.split_rows(n);
            let (exchange, further) = exchange.split_at(n);
            parts.push(Part { morphology, first, rows, exchange, common });
            first += n;
            rest = (first < envs.len()).then_some((more, further));
        }
        parts
    }

    /// Notes a control step of the robots in these rows, which have been read, for the next launch.
    ///
    /// # Errors
    /// A device that is lost, or whose memory is too small for more contacts.
    pub(super) fn start(&mut self, means: &Means<'_>, block: &mut Block<RobotSlices<'_>>) -> Result<(), DeviceError> {
        let contacts = self.needs.contacts.load(Ordering::Relaxed);
        if contacts > self.block.shape().capacity || self.needs.forces.load(Ordering::Relaxed) {
            let forces = self.forces_of(&block.rows);
            self.allocate(means, contacts, forces)?;
            read_rows(means.workers, vec![(&mut *self, &mut *block)]);
        }
        self.send_parameters()?;
        self.block.start()
    }

    /// Sends parameters that have changed.
    ///
    /// # Errors
    /// A device that is lost.
    pub(super) fn send_parameters(&mut self) -> Result<(), DeviceError> {
        if self.changed.contains(&true) {
            let changed: Vec<usize> = (0..self.changed.len()).filter(|&tile| self.changed[tile]).collect();
            self.block.set_parameters(&self.common, self.own, &self.parameters, &changed)?;
            self.changed.fill(false);
        }
        Ok(())
    }

    /// The robots' memory.
    pub(super) fn device_block(&mut self) -> &mut dyn DeviceBlock {
        &mut *self.block
    }

    /// Takes over a task for whole control steps, with room for all contacts: a step that the
    /// device makes alone is not made again.
    ///
    /// # Errors
    /// Too little memory, or a device that is lost.
    pub(super) fn place(&mut self, means: &Means<'_>, task: TaskTables) -> Result<(), DeviceError> {
        let all = self.topology.num_impulses();
        if self.block.shape().capacity < all || !self.forces.is_empty() {
            self.allocate(means, all, Vec::new())?;
            self.task = None;
        }
        if task.own & !self.own != 0 {
            if self.parameters.is_empty() {
                self.parameters = self.block.shape().spread(&self.common);
            }
            self.own |= task.own;
            self.changed.fill(true);
        }
        if self.task.as_ref() != Some(&task) {
            if let Some(envs) = self.block.envs() {
                envs.place(task.clone(), self.envs.start)?;
            }
            self.task = Some(task);
        }
        Ok(())
    }

    /// Whether the step has ended, so that its rows may be written. Where a robot has more contacts
    /// than there was room for, the step is made again: its inputs are still in the components.
    ///
    /// # Errors
    /// As [`start`](Self::start).
    pub(super) fn is_done(
        &mut self,
        means: &Means<'_>,
        block: &mut Block<RobotSlices<'_>>,
    ) -> Result<bool, DeviceError> {
        let Some(contacts) = self.block.contacts_if_done()? else { return Ok(false) };
        if contacts <= self.block.shape().capacity {
            return Ok(true);
        }
        self.allocate(means, contacts, self.forces.clone())?;
        read_rows(means.workers, vec![(&mut *self, &mut *block)]);
        self.start(means, block)?;
        means.device.launch()?;
        Ok(false)
    }

    /// Memory with more room: for more contacts, or for forces on more links.
    fn allocate(&mut self, means: &Means<'_>, contacts: usize, forces: Vec<(usize, bool)>) -> Result<(), DeviceError> {
        let known = self.block.shape();
        let capacity = contacts.next_power_of_two().max(known.capacity);
        let shape = if forces == self.forces {
            known.with_capacity(capacity)
        } else {
            let scene =
                Scene { terrain: means.heights, networks: &self.networks, ages: self.ages, link_forces: &forces };
            Shape::new(&self.topology, means.settings, &scene, self.envs.len(), capacity)?
        };
        self.block = means.device.allocate(shape)?;
        self.task = None;
        self.forces = forces;
        self.changed.fill(true);
        Ok(())
    }

    /// Links and frames of the forces so far, and of those in these rows.
    fn forces_of(&self, rows: &RobotSlices<'_>) -> Vec<(usize, bool)> {
        let mut forces = self.forces.clone();
        for force in rows.link_forces.iter().flat_map(|forces| &forces.0) {
            let key = key_of(force);
            if let Err(place) = forces.binary_search(&key) {
                forces.insert(place, key);
            }
        }
        forces
    }
}

/// The motion of the first robot of rows.
fn motion(exchange: &Exchange<'_>, joints: usize) -> super::super::Motion {
    let mut pose = BasePose { position: [0.0; 3], rotation: [0.0; 4] };
    let (mut velocity, mut state, mut effort) =
        (BaseVelocity::default(), JointState::zeros(joints), JointEffort::zeros(joints));
    let contacts = exchange.impulses(0).map(|(contact, impulse)| ContactImpulse { contact, impulse }).collect();
    let mut impulses = ConstraintImpulses { contacts, bounds: smallvec![0.0; joints] };
    exchange.read_motion(
        0,
        Motion {
            position: &mut pose.position,
            rotation: &mut pose.rotation,
            velocity: [&mut velocity.linear, &mut velocity.angular],
            joints: &mut state.position,
            joint_velocities: &mut state.velocity,
            bounds: &mut impulses.bounds,
        },
    );
    exchange.read_joints(0, &mut effort.applied, &mut effort.acceleration);
    super::super::Motion { pose, velocity, joints: state, effort, impulses }
}

/// The first row whose new state, which the device has written, is not finite or beyond the limits.
fn first_broken(rows: &RobotSlices<'_>, exchange: &Exchange<'_>, limits: &StateLimits) -> Option<usize> {
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
        exchange.read_motion(
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
        exchange.read_joints(row, efforts, accelerations);
        limits.violation([position, rotation, linear, angular, positions, velocities, efforts], |x| x).is_some()
    })
}

/// Writes the new state and the report of a robot to its row.
fn write_row(rows: &mut RobotSlices<'_>, row: usize, exchange: &Exchange<'_>, feet: &[usize], others: &[usize]) {
    let (pose, velocity, joints) = (&mut rows.poses[row], &mut rows.velocities[row], &mut rows.joints[row]);
    let impulses = &mut rows.impulses[row];
    exchange.read_motion(
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
    exchange.read_memory(row, &mut rows.memories[row].0);
    impulses.contacts.clear();
    impulses.contacts.extend(exchange.impulses(row).map(|(contact, impulse)| ContactImpulse { contact, impulse }));
    let effort = &mut rows.efforts[row];
    exchange.read_joints(row, &mut effort.applied, &mut effort.acceleration);
    let normal = |step: usize, body: usize| exchange.normal_force(row, step, body);
    rows.forces[row].set(feet, others, |body| exchange.body_force(row, body), normal);
    let feet = &mut rows.feet[row];
    exchange.read_sites(row, &mut feet.position, &mut feet.velocity);
}
