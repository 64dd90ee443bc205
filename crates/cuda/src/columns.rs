//! Columns of a block of robots, `[number][env]`, and the way between them and the types of
//! `polypod-dynamics`.

use std::ops::Range;

use polypod_dynamics::{Drive, Parameters, Report, State, StepSettings, Topology};

use crate::layout::*;
use crate::tables::{Scene, Sizes, Tables, Unsupported};

/// Robots of one morphology, as the device sees them.
#[derive(Clone, Debug)]
pub struct Block {
    tables: Tables,
    robots: usize,
    parameters: Vec<f32>,
    shared: bool,
    state: Vec<f32>,
    drive: Vec<f32>,
    report: Vec<f32>,
    touched: Vec<i32>,
    work: Vec<f32>,
    work_integers: Vec<i32>,
}

/// Arrays of a block, in the order of the kernel's arguments.
pub struct Parts<'a> {
    /// Table of integers.
    pub integers: &'a [i32],
    /// Table of numbers.
    pub numbers: &'a [f32],
    /// Parameters: a column each, or one list for all robots.
    pub parameters: &'a [f32],
    /// Columns of the state.
    pub state: &'a mut [f32],
    /// Columns of the drive.
    pub drive: &'a [f32],
    /// Heights of the ground; empty on a plane.
    pub grid: &'a [f32],
    /// Columns of the report.
    pub report: &'a mut [f32],
    /// Whether each body has touched something, a column each.
    pub touched: &'a mut [i32],
    /// Columns of scratch memory.
    pub work: &'a mut [f32],
    /// Columns of integers of scratch memory.
    pub work_integers: &'a mut [i32],
    /// Number of robots.
    pub robots: usize,
    /// Whether all robots read one list of parameters.
    pub shared: bool,
}

/// Writes a robot's numbers into columns.
fn write<'a, T: Copy + 'a>(columns: &mut [T], robots: usize, env: usize, numbers: impl IntoIterator<Item = &'a T>) {
    for (column, number) in columns.chunks_exact_mut(robots).zip(numbers) {
        column[env] = *number;
    }
}

/// Reads a robot's numbers out of columns.
fn read<'a, T: Copy + 'a>(columns: &[T], robots: usize, env: usize, numbers: impl IntoIterator<Item = &'a mut T>) {
    for (column, number) in columns.chunks_exact(robots).zip(numbers) {
        *number = column[env];
    }
}

impl Block {
    /// Robots at rest at the origin, with all numbers zero. `robots` is at least one.
    ///
    /// # Errors
    /// A feature that the device lacks.
    pub fn new(
        topology: &Topology,
        settings: &StepSettings,
        scene: &Scene,
        robots: usize,
    ) -> Result<Self, Unsupported> {
        let tables = Tables::new(topology, settings, scene)?;
        let robots = robots.max(1);
        let Sizes { state, drive, report, touched, work, work_integers, .. } = tables.sizes;
        let mut block = Self {
            robots,
            parameters: Vec::new(),
            shared: false,
            state: vec![0.0; state * robots],
            drive: vec![0.0; drive * robots],
            report: vec![0.0; report * robots],
            touched: vec![0; touched * robots],
            work: vec![0.0; work * robots],
            work_integers: vec![0; work_integers * robots],
            tables,
        };
        (0..robots).for_each(|env| block.write_state(env, &State::zeros(topology)));
        Ok(block)
    }

    /// Number of robots.
    pub fn robots(&self) -> usize {
        self.robots
    }

    /// Gives all robots the same parameters, which are held once.
    pub fn share_parameters(&mut self, parameters: &Parameters<f32>) {
        self.parameters = list(parameters);
        self.shared = true;
    }

    /// Gives a robot its own parameters.
    pub fn write_parameters(&mut self, env: usize, parameters: &Parameters<f32>) {
        if self.shared || self.parameters.is_empty() {
            let size = self.tables.sizes.parameters;
            let common = if self.shared { std::mem::take(&mut self.parameters) } else { vec![0.0; size] };
            self.parameters = common.iter().flat_map(|&number| std::iter::repeat_n(number, self.robots)).collect();
            self.shared = false;
        }
        write(&mut self.parameters, self.robots, env, &list(parameters));
    }

    /// Writes a robot's state.
    pub fn write_state(&mut self, env: usize, state: &State<f32>) {
        let base = state.position.iter().chain(&state.rotation).chain(&state.linear_velocity);
        let joints = state.joint_position.iter().chain(&state.joint_velocity);
        let impulses = state.impulse.as_flattened().iter().chain(&state.bound_impulse);
        let numbers = base.chain(&state.angular_velocity).chain(joints).chain(impulses);
        write(&mut self.state, self.robots, env, numbers);
    }

    /// Reads a robot's state.
    pub fn read_state(&self, env: usize, state: &mut State<f32>) {
        let base = state.position.iter_mut().chain(&mut state.rotation).chain(&mut state.linear_velocity);
        let joints = state.joint_position.iter_mut().chain(&mut state.joint_velocity);
        let impulses = state.impulse.as_flattened_mut().iter_mut().chain(&mut state.bound_impulse);
        let numbers = base.chain(&mut state.angular_velocity).chain(joints).chain(impulses);
        read(&self.state, self.robots, env, numbers);
        state.find_pressing();
    }

    /// Writes a robot's drive, and where the origin of its env is in the grid's frame, m. Its
    /// forces on links are those with the keys of the block's [`Scene`], in their order.
    pub fn write_drive(&mut self, env: usize, drive: &Drive<f32>, origin: [f32; 2]) {
        let targets = drive.targets.iter().flatten().chain(&drive.delay).chain(&drive.feedforward);
        let base = drive.base_force.iter().chain(&drive.base_torque).chain(&origin);
        let forces = drive.link_forces.iter().flat_map(|force| {
            std::iter::once(&force.acts).chain(&force.point).chain(&force.force).chain(&force.torque)
        });
        write(&mut self.drive, self.robots, env, targets.chain(base).chain(forces));
    }

    /// Reads a robot's report.
    pub fn read_report(&self, env: usize, report: &mut Report<f32>) {
        let joints = report.joint_effort.iter_mut().chain(&mut report.joint_acceleration);
        let forces = report.body_force.as_flattened_mut().iter_mut().chain(report.normal_force.iter_mut().flatten());
        let sites = report.site_position.as_flattened_mut().iter_mut().chain(report.site_velocity.as_flattened_mut());
        let numbers = joints.chain(forces).chain(&mut report.demands).chain(sites);
        read(&self.report, self.robots, env, numbers);
        for (body, touched) in report.touched.iter_mut().enumerate() {
            *touched = self.touched[body * self.robots + env] != 0;
        }
    }

    /// The arrays of the block.
    pub fn parts(&mut self) -> Parts<'_> {
        Parts {
            integers: &self.tables.integers,
            numbers: &self.tables.numbers,
            parameters: &self.parameters,
            state: &mut self.state,
            drive: &self.drive,
            grid: &self.tables.grid,
            report: &mut self.report,
            touched: &mut self.touched,
            work: &mut self.work,
            work_integers: &mut self.work_integers,
            robots: self.robots,
            shared: self.shared,
        }
    }

    /// Whether these are physics steps of a control step, and the robots have parameters: else a
    /// kernel would read beyond its arrays.
    pub fn may_step(&self, substeps: &Range<usize>) -> bool {
        let decimation = usize::try_from(self.tables.integers[DECIMATION]).unwrap_or(0);
        substeps.end <= decimation && !self.parameters.is_empty()
    }
}

/// All numbers of parameters, in the order in which they are visited.
fn list(parameters: &Parameters<f32>) -> Vec<f32> {
    let (mut numbers, mut visited) = (Vec::new(), parameters.clone());
    visited.zip_with(parameters, |_, number| numbers.push(*number));
    numbers
}
