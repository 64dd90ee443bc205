//! Robots of one morphology as a device has them, and the way between them and the types of
//! `polypod-dynamics`: drive, state and report in rows, parameters and scratch memory in tiles of
//! columns, `[tile][number][robot of the tile]`.

use std::ops::Range;

use polypod_dynamics::{Drive, Parameters, Report, State, StepSettings, Topology};

use crate::layout::*;
use crate::tables::{Scene, Tables, Unsupported};

/// Tables of a morphology, the number of its robots, and the room of their lists of impulses.
#[derive(Clone, Debug)]
pub struct Shape {
    /// Tables of the morphology.
    pub tables: Tables,
    /// Number of robots, at least one.
    pub robots: usize,
    /// Contacts that the list of a robot's impulses has room for.
    pub capacity: usize,
    /// Robots of a tile of parameters and scratch memory.
    pub tile: usize,
}

impl Shape {
    /// The shape of a block; its lists have room for some contacts, or for all that there can be.
    ///
    /// # Errors
    /// A feature that the device lacks.
    pub fn new(
        topology: &Topology,
        settings: &StepSettings,
        scene: &Scene,
        robots: usize,
        capacity: usize,
    ) -> Result<Self, Unsupported> {
        let tables = Tables::new(topology, settings, scene)?;
        let capacity = capacity.min(tables.sizes.impulses);
        Ok(Self { tables, robots: robots.max(1), capacity, tile: TILE_OF_HOST })
    }

    /// The same shape with more or less room in its lists.
    #[must_use]
    pub fn with_capacity(&self, capacity: usize) -> Self {
        Self { capacity: capacity.min(self.tables.sizes.impulses), ..self.clone() }
    }

    /// The same shape with tiles of another size.
    #[must_use]
    pub fn with_tile(self, tile: usize) -> Self {
        Self { tables: self.tables.with_tile(self.tile, tile), tile, ..self }
    }

    /// Number of tiles.
    pub fn tiles(&self) -> usize {
        self.robots.div_ceil(self.tile)
    }

    /// Numbers of a robot's state with its list.
    pub fn state_size(&self) -> usize {
        self.tables.sizes.state + LISTED_SIZE * self.capacity
    }

    /// Ranges of drive, state and report in the memory that the host and the device exchange.
    pub fn ranges(&self) -> [Range<usize>; 3] {
        let [drive, state, report] =
            [self.tables.sizes.drive, self.state_size(), self.tables.sizes.report].map(|size| size * self.robots);
        [0..drive, drive..drive + state, drive + state..drive + state + report]
    }

    /// Numbers that the host and the device exchange.
    pub fn exchanged(&self) -> usize {
        self.ranges()[2].end
    }

    /// Numbers that are kept of a robot that is watched: its rows of drive, state and report before
    /// the physics of a control step and after it, the length of its episode, whether they are
    /// those of a broken state, which stay, and the numbers of its body that resets change.
    pub fn kept(&self) -> usize {
        2 * self.of_one().exchanged() + 2 + BODY_JOINTS + BODY_LISTS * self.tables.at(JOINTS)
    }

    /// The shape of one robot.
    #[must_use]
    pub fn of_one(&self) -> Self {
        Self { robots: 1, ..self.clone() }
    }

    /// Numbers of scratch memory, and integers.
    pub fn scratch(&self) -> [usize; 2] {
        [self.tables.sizes.work, self.tables.sizes.work_integers].map(|size| size * self.tile * self.tiles())
    }

    /// Physics steps of a control step.
    pub fn decimation(&self) -> usize {
        self.tables.at(DECIMATION)
    }

    /// The rows of a block.
    pub fn exchange<'a>(&'a self, exchanged: &'a mut [f32]) -> Exchange<'a> {
        let [drive, state, _] = self.ranges().map(|range| range.len());
        let (drive, rest) = exchanged.split_at_mut(drive);
        let (state, report) = rest.split_at_mut(state);
        Exchange { shape: self, drive, state, report }
    }

    /// Columns in which a robot's parameters differ from others: a bit for each.
    pub fn differing(&self, parameters: &[f32], others: &[f32]) -> u32 {
        let columns = (P_OFFSET..=P_ROLLING_FRICTION).map(|name| {
            let next = if name < P_ROLLING_FRICTION { self.tables.at(name + 1) } else { parameters.len() };
            let column = self.tables.at(name)..next;
            let bits = |numbers: &[f32]| numbers[column.clone()].iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            u32::from(bits(parameters) != bits(others)) << (name - P_OFFSET)
        });
        columns.fold(0, |all, bit| all | bit)
    }

    /// Tiles of the parameters of all robots, where all have the same ones.
    pub fn spread(&self, parameters: &[f32]) -> Vec<f32> {
        let tile = parameters.iter().flat_map(|&number| std::iter::repeat_n(number, self.tile));
        std::iter::repeat_n(tile, self.tiles()).flatten().collect()
    }

    /// The part of separate parameters that holds a robot's tile.
    pub fn parameters_of_tile(&self, tile: usize) -> Range<usize> {
        let size = self.tables.sizes.parameters * self.tile;
        tile * size..(tile + 1) * size
    }

    /// Writes a robot's parameters among those of all robots.
    pub fn write_parameters(&self, all: &mut [f32], robot: usize, parameters: &[f32]) {
        let columns = &mut all[self.parameters_of_tile(robot / self.tile)][robot % self.tile..];
        columns.iter_mut().step_by(self.tile).zip(parameters).for_each(|(place, number)| *place = *number);
    }
}

#[inline]
fn write<'a>(to: &mut [f32], numbers: impl IntoIterator<Item = &'a f32>) {
    to.iter_mut().zip(numbers).for_each(|(place, number)| *place = *number);
}

#[inline]
fn read<'a>(from: &[f32], numbers: impl IntoIterator<Item = &'a mut f32>) {
    numbers.into_iter().zip(from).for_each(|(number, place)| *number = *place);
}

/// Rows of neighbouring robots of a block: drive and state, which the device reads, and state and
/// report, which it writes.
pub struct Exchange<'a> {
    shape: &'a Shape,
    drive: &'a mut [f32],
    state: &'a mut [f32],
    report: &'a mut [f32],
}

/// Motion of a robot.
pub struct Motion<P, J> {
    /// Position of the base, m.
    pub position: P,
    /// Rotation of the base.
    pub rotation: J,
    /// Velocity of the base, m/s and rad/s.
    pub velocity: [P; 2],
    /// Positions of the joints, rad or m.
    pub joints: J,
    /// Velocities of the joints.
    pub joint_velocities: J,
    /// Impulses of limits and dry friction, N m s.
    pub bounds: J,
}

impl<'a> Exchange<'a> {
    /// The first robots, and the rest.
    #[must_use]
    pub fn split_at(self, robots: usize) -> (Self, Self) {
        let Self { shape, drive, state, report } = self;
        let (drive, drives) = drive.split_at_mut(robots * shape.tables.sizes.drive);
        let (state, states) = state.split_at_mut(robots * shape.state_size());
        let (report, reports) = report.split_at_mut(robots * shape.tables.sizes.report);
        (Self { shape, drive, state, report }, Self { shape, drive: drives, state: states, report: reports })
    }

    #[inline]
    fn state_place(&self, robot: usize, name: usize) -> usize {
        robot * self.shape.state_size() + self.shape.tables.at(name)
    }

    #[inline]
    fn drive_place(&self, robot: usize, name: usize) -> usize {
        robot * self.shape.tables.sizes.drive + self.shape.tables.at(name)
    }

    #[inline]
    fn report_place(&self, robot: usize, name: usize, at: usize) -> usize {
        robot * self.shape.tables.sizes.report + self.shape.tables.at(name) + at
    }

    /// Writes a robot's motion.
    #[inline]
    pub fn write_motion(&mut self, robot: usize, motion: &Motion<&[f32], &[f32]>) {
        for (name, numbers) in [
            (S_POSITION, motion.position),
            (S_ROTATION, motion.rotation),
            (S_LINEAR, motion.velocity[0]),
            (S_ANGULAR, motion.velocity[1]),
            (S_JOINT, motion.joints),
            (S_JOINT_VELOCITY, motion.joint_velocities),
            (S_BOUND, motion.bounds),
        ] {
            let at = self.state_place(robot, name);
            write(&mut self.state[at..], numbers);
        }
    }

    /// Reads a robot's motion.
    #[inline]
    pub fn read_motion(&self, robot: usize, motion: Motion<&mut [f32], &mut [f32]>) {
        let [linear, angular] = motion.velocity;
        for (name, numbers) in [
            (S_POSITION, motion.position),
            (S_ROTATION, motion.rotation),
            (S_LINEAR, linear),
            (S_ANGULAR, angular),
            (S_JOINT, motion.joints),
            (S_JOINT_VELOCITY, motion.joint_velocities),
            (S_BOUND, motion.bounds),
        ] {
            read(&self.state[self.state_place(robot, name)..], numbers);
        }
    }

    /// Writes the memory of a robot's actuator networks, see
    /// [`NetworkStep`](polypod_dynamics::NetworkStep).
    #[inline]
    pub fn write_memory(&mut self, robot: usize, memory: &[f32]) {
        let at = self.state_place(robot, S_MEMORY);
        write(&mut self.state[at..], memory);
    }

    /// Reads the memory of a robot's actuator networks.
    #[inline]
    pub fn read_memory(&self, robot: usize, memory: &mut [f32]) {
        read(&self.state[self.state_place(robot, S_MEMORY)..], memory);
    }

    /// Writes the impulses from which the solver starts, as many as the list has room for.
    #[inline]
    pub fn write_impulses(&mut self, robot: usize, impulses: impl Iterator<Item = (u32, [f32; 3])>) {
        let first = self.state_place(robot, S_PRESSING);
        let mut count = 0;
        for (contact, [x, y, z]) in impulses.take(self.shape.capacity) {
            write(&mut self.state[first + 1 + LISTED_SIZE * count..], &[contact as f32, x, y, z]);
            count += 1;
        }
        self.state[first] = count as f32;
    }

    /// Number of contacts that press; more than the list's room if it was too small.
    #[inline]
    pub fn num_impulses(&self, robot: usize) -> usize {
        self.state[self.state_place(robot, S_PRESSING)] as usize
    }

    /// Contacts that press, in rising order, and their impulses, as many as the list has room for.
    #[inline]
    pub fn impulses(&self, robot: usize) -> impl Iterator<Item = (u32, [f32; 3])> + '_ {
        let first = self.state_place(robot, S_PRESSING);
        (0..self.num_impulses(robot).min(self.shape.capacity)).map(move |i| {
            let mut entry = [0.0; LISTED_SIZE];
            read(&self.state[first + 1 + LISTED_SIZE * i..], &mut entry);
            (entry[0] as u32, [entry[1], entry[2], entry[3]])
        })
    }

    /// Writes the targets of a control step, the newest first, and their delays, physics steps.
    #[inline]
    pub fn write_targets<'b>(&mut self, robot: usize, targets: impl Iterator<Item = &'b f32>, delays: &[f32]) {
        let at = self.drive_place(robot, D_TARGET);
        write(&mut self.drive[at..], targets);
        let at = self.drive_place(robot, D_DELAY);
        write(&mut self.drive[at..], delays);
    }

    /// Reads the targets, the newest first, and their delays.
    #[inline]
    pub fn read_targets<'b>(&self, robot: usize, targets: impl Iterator<Item = &'b mut f32>, delays: &mut [f32]) {
        read(&self.drive[self.drive_place(robot, D_TARGET)..], targets);
        read(&self.drive[self.drive_place(robot, D_DELAY)..], delays);
    }

    /// Reads the force and torque on the base.
    #[inline]
    pub fn read_wrench(&self, robot: usize, force: &mut [f32; 3], torque: &mut [f32; 3]) {
        read(&self.drive[self.drive_place(robot, D_FORCE)..], force.iter_mut().chain(torque));
    }

    /// Writes efforts that are added to those of the gains, N m.
    #[inline]
    pub fn write_feedforward(&mut self, robot: usize, efforts: &[f32]) {
        let at = self.drive_place(robot, D_FEEDFORWARD);
        write(&mut self.drive[at..], efforts);
    }

    /// Writes the force and torque on the base, and where the env's origin is in the grid's frame.
    #[inline]
    pub fn write_surroundings(&mut self, robot: usize, force: &[f32; 3], torque: &[f32; 3], origin: &[f32; 2]) {
        let at = self.drive_place(robot, D_FORCE);
        write(&mut self.drive[at..], force.iter().chain(torque).chain(origin));
    }

    /// Writes the force on a link: the place of its key in the [`Scene`], whether it acts, its
    /// point, force and torque.
    #[inline]
    pub fn write_link_force(&mut self, robot: usize, key: usize, acts: f32, vectors: [&[f32; 3]; 3]) {
        let at = self.drive_place(robot, D_LINK_FORCE) + LINK_FORCE_SIZE * key;
        write(&mut self.drive[at..], std::iter::once(&acts).chain(vectors.into_iter().flatten()));
    }

    /// Reads efforts and accelerations of the joints.
    #[inline]
    pub fn read_joints(&self, robot: usize, efforts: &mut [f32], accelerations: &mut [f32]) {
        read(&self.report[self.report_place(robot, R_EFFORT, 0)..], efforts);
        read(&self.report[self.report_place(robot, R_ACCELERATION, 0)..], accelerations);
    }

    /// Writes efforts and accelerations of the joints.
    #[inline]
    pub fn write_joints(&mut self, robot: usize, efforts: &[f32], accelerations: &[f32]) {
        let at = [R_EFFORT, R_ACCELERATION].map(|name| self.report_place(robot, name, 0));
        write(&mut self.report[at[0]..], efforts);
        write(&mut self.report[at[1]..], accelerations);
    }

    /// The force on a body in the last physics step, world axes, N.
    #[inline]
    pub fn body_force(&self, robot: usize, body: usize) -> [f32; 3] {
        let mut force = [0.0; 3];
        read(&self.report[self.report_place(robot, R_BODY_FORCE, 3 * body)..], &mut force);
        force
    }

    /// The sum of the normal forces on a body in a physics step, N.
    #[inline]
    pub fn normal_force(&self, robot: usize, step: usize, body: usize) -> f32 {
        self.report[self.report_place(robot, R_NORMAL_FORCE, step * self.shape.tables.at(BODIES) + body)]
    }

    /// Reads positions, m, and velocities of the sites, m/s.
    #[inline]
    pub fn read_sites(&self, robot: usize, positions: &mut [[f32; 3]], velocities: &mut [[f32; 3]]) {
        read(&self.report[self.report_place(robot, R_SITE_POSITION, 0)..], positions.as_flattened_mut());
        read(&self.report[self.report_place(robot, R_SITE_VELOCITY, 0)..], velocities.as_flattened_mut());
    }
}

/// Robots of one morphology in the memory of the host, as the device sees them.
#[derive(Clone, Debug)]
pub struct Block {
    shape: Shape,
    parameters: Vec<f32>,
    common: Vec<f32>,
    own: u32,
    exchanged: Vec<f32>,
    work: Vec<f32>,
    work_integers: Vec<i32>,
}

/// Arrays of a block, in the order of the kernel's arguments.
pub struct Parts<'a> {
    /// Table of integers.
    pub integers: &'a [i32],
    /// Table of numbers.
    pub numbers: &'a [f32],
    /// Tiles of each robot's parameters; empty while all robots have the same ones.
    pub parameters: &'a [f32],
    /// The parameters of all robots.
    pub common: &'a [f32],
    /// Rows of the drive.
    pub drive: &'a mut [f32],
    /// Rows of the state.
    pub state: &'a mut [f32],
    /// Rows of the report.
    pub report: &'a mut [f32],
    /// Heights of the ground; empty on a plane.
    pub grid: &'a [f32],
    /// Tiles of scratch memory.
    pub work: &'a mut [f32],
    /// Tiles of integers of scratch memory.
    pub work_integers: &'a mut [i32],
    /// Number of robots.
    pub robots: usize,
    /// Columns of parameters of which each robot reads its own: a bit for each.
    pub own: u32,
    /// Contacts that the list of impulses has room for.
    pub capacity: usize,
}

impl Block {
    /// Robots at rest at the origin, with all numbers zero and room for all impulses. `robots` is
    /// at least one.
    ///
    /// # Errors
    /// A feature that the device lacks.
    pub fn new(
        topology: &Topology,
        settings: &StepSettings,
        scene: &Scene,
        robots: usize,
    ) -> Result<Self, Unsupported> {
        let shape = Shape::new(topology, settings, scene, robots, usize::MAX)?;
        let mut block = Self::of_shape(shape);
        (0..block.robots()).for_each(|robot| block.write_state(robot, &State::zeros(topology)));
        Ok(block)
    }

    /// Memory of a shape, all zero.
    pub fn of_shape(shape: Shape) -> Self {
        let [work, work_integers] = shape.scratch();
        Self {
            parameters: Vec::new(),
            common: Vec::new(),
            own: 0,
            exchanged: vec![0.0; shape.exchanged()],
            work: vec![0.0; work],
            work_integers: vec![0; work_integers],
            shape,
        }
    }

    /// Number of robots.
    pub fn robots(&self) -> usize {
        self.shape.robots
    }

    /// Tables and sizes.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// The rows of drive, state and report.
    pub fn exchange(&mut self) -> Exchange<'_> {
        self.shape.exchange(&mut self.exchanged)
    }

    /// Gives all robots the same parameters, which are held once.
    pub fn share_parameters(&mut self, parameters: &Parameters<f32>) {
        self.common = list(parameters);
        self.own = 0;
        self.parameters.clear();
    }

    /// Gives a robot its own parameters.
    pub fn write_parameters(&mut self, robot: usize, parameters: &Parameters<f32>) {
        let parameters = list(parameters);
        if self.common.is_empty() {
            self.common = vec![0.0; parameters.len()];
        }
        self.own |= self.shape.differing(&parameters, &self.common);
        if self.parameters.is_empty() {
            self.parameters = self.shape.spread(&self.common);
        }
        self.shape.write_parameters(&mut self.parameters, robot, &parameters);
    }

    /// Takes over parameters: those of all robots, the columns of which each robot reads its own,
    /// and the tiles that have these.
    pub fn set_parameters(&mut self, common: &[f32], own: u32, tiles: &[f32]) {
        (self.common, self.own, self.parameters) = (common.to_vec(), own, tiles.to_vec());
    }

    /// Writes a robot's state.
    pub fn write_state(&mut self, robot: usize, state: &State<f32>) {
        let mut rows = self.shape.exchange(&mut self.exchanged);
        rows.write_motion(
            robot,
            &Motion {
                position: &state.position,
                rotation: &state.rotation,
                velocity: [&state.linear_velocity, &state.angular_velocity],
                joints: &state.joint_position,
                joint_velocities: &state.joint_velocity,
                bounds: &state.bound_impulse,
            },
        );
        let impulses = state.impulse.iter().enumerate().filter(|(_, impulse)| impulse.iter().any(|&x| x != 0.0));
        rows.write_impulses(robot, impulses.map(|(contact, &impulse)| (contact as u32, impulse)));
    }

    /// Reads a robot's state.
    pub fn read_state(&mut self, robot: usize, state: &mut State<f32>) {
        let rows = self.shape.exchange(&mut self.exchanged);
        rows.read_motion(
            robot,
            Motion {
                position: &mut state.position,
                rotation: &mut state.rotation,
                velocity: [&mut state.linear_velocity, &mut state.angular_velocity],
                joints: &mut state.joint_position,
                joint_velocities: &mut state.joint_velocity,
                bounds: &mut state.bound_impulse,
            },
        );
        state.impulse.fill([0.0; 3]);
        rows.impulses(robot).for_each(|(contact, impulse)| state.impulse[contact as usize] = impulse);
        state.find_pressing();
    }

    /// Writes the memory of a robot's actuator networks, see
    /// [`NetworkStep`](polypod_dynamics::NetworkStep).
    pub fn write_memory(&mut self, robot: usize, memory: &[f32]) {
        self.exchange().write_memory(robot, memory);
    }

    /// Reads the memory of a robot's actuator networks.
    pub fn read_memory(&mut self, robot: usize, memory: &mut [f32]) {
        self.exchange().read_memory(robot, memory);
    }

    /// Writes a robot's drive, and where the origin of its env is in the grid's frame, m. Its
    /// forces on links are those with the keys of the block's [`Scene`], in their order.
    pub fn write_drive(&mut self, robot: usize, drive: &Drive<f32>, origin: [f32; 2]) {
        let mut rows = self.shape.exchange(&mut self.exchanged);
        rows.write_targets(robot, drive.targets.iter().flatten(), &drive.delay);
        rows.write_feedforward(robot, &drive.feedforward);
        rows.write_surroundings(robot, &drive.base_force, &drive.base_torque, &origin);
        for (key, force) in drive.link_forces.iter().enumerate() {
            rows.write_link_force(robot, key, force.acts, [&force.point, &force.force, &force.torque]);
        }
    }

    /// Writes a robot's report, as the device would, without demands and touched bodies.
    pub fn write_report(&mut self, robot: usize, report: &Report<f32>) {
        let rows = self.shape.exchange(&mut self.exchanged);
        let mut put = |name: usize, numbers: &[f32]| {
            let at = rows.report_place(robot, name, 0);
            write(&mut rows.report[at..], numbers);
        };
        put(R_EFFORT, &report.joint_effort);
        put(R_ACCELERATION, &report.joint_acceleration);
        put(R_BODY_FORCE, report.body_force.as_flattened());
        put(R_NORMAL_FORCE, &report.normal_force.concat());
        put(R_SITE_POSITION, report.site_position.as_flattened());
        put(R_SITE_VELOCITY, report.site_velocity.as_flattened());
    }

    /// Reads a robot's report.
    pub fn read_report(&mut self, robot: usize, report: &mut Report<f32>) {
        let Report { joint_effort, joint_acceleration, body_force, normal_force, touched, demands, .. } = report;
        let rows = self.shape.exchange(&mut self.exchanged);
        rows.read_joints(robot, joint_effort, joint_acceleration);
        for (body, force) in body_force.iter_mut().enumerate() {
            *force = rows.body_force(robot, body);
        }
        for (step, forces) in normal_force.iter_mut().enumerate() {
            for (body, force) in forces.iter_mut().enumerate() {
                *force = rows.normal_force(robot, step, body);
            }
        }
        rows.read_sites(robot, &mut report.site_position, &mut report.site_velocity);
        let Shape { tables, tile, .. } = &self.shape;
        let place = |size: usize, name: usize| (robot / tile * size + tables.at(name)) * tile + robot % tile;
        let of_work = self.work[place(tables.sizes.work, W_DEMANDS)..].iter().step_by(*tile);
        demands.iter_mut().zip(of_work).for_each(|(demand, place)| *demand = *place);
        let all = &self.work_integers[place(tables.sizes.work_integers, I_TOUCHED)..];
        for (touched, place) in touched.iter_mut().zip(all.iter().step_by(*tile)) {
            *touched = *place != 0;
        }
    }

    /// The arrays of the block.
    pub fn parts(&mut self) -> Parts<'_> {
        let Self { shape, parameters, common, own, exchanged, work, work_integers } = self;
        let Exchange { drive, state, report, .. } = shape.exchange(exchanged);
        let Tables { integers, numbers, grid, .. } = &shape.tables;
        let (robots, own, capacity) = (shape.robots, *own, shape.capacity);
        Parts {
            integers,
            numbers,
            parameters,
            common,
            drive,
            state,
            report,
            grid,
            work,
            work_integers,
            robots,
            own,
            capacity,
        }
    }

    /// Whether these are physics steps of a control step, and the robots have parameters: else a
    /// kernel would read beyond its arrays.
    pub fn may_step(&self, substeps: &Range<usize>) -> bool {
        let has_parameters = !self.common.is_empty() && (self.own == 0 || !self.parameters.is_empty());
        substeps.end <= self.shape.decimation() && has_parameters
    }
}

/// All numbers of parameters, in the order in which they are visited.
pub fn list(parameters: &Parameters<f32>) -> Vec<f32> {
    let mut numbers = Vec::new();
    parameters.any_with(parameters, |number, _| {
        numbers.push(*number);
        false
    });
    numbers
}
