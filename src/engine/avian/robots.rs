//! The control step on Avian's rigid bodies.
//!
//! The engine keeps the robots between control steps. What a reset or a push has written into a robot's row is set
//! there first, and the robot's contacts begin anew; a robot whose row is as the engine left it goes on.

use super::super::{DivergenceRecord, Engine, Kind, RobotRows, RowFamily, Run, StateLimits, state_numbers};
use super::{EngineError, Settings};
use crate::dynamics::{Drive, Parameters, Real, Report, Scalar, State, StepSettings, Topology, Workspace};
use crate::obstacles::Part;
use crate::workers::{SplitRows, Workers};

/// Robots of all kinds.
pub(crate) struct AvianRobots {
    blocks: Vec<Block>,
}

/// The robots of one kind.
struct Block {
    first_env: usize,
    count: usize,
    engine: super::Engine,
    topology: Topology,
    explicit: Vec<bool>,
    work: Workspace<f64>,
    report: Report<f64>,
    state: State<f64>,
    /// Of each robot.
    drives: Vec<Drive<f64>>,
    /// Joint velocities before the last physics step, `[count * joints]`.
    before: Vec<f64>,
    /// The contact bodies that are feet, and those that are not.
    feet: Vec<usize>,
    others: Vec<usize>,
    /// Normal forces on the contact bodies, N: `normal[(row * physics steps + physics step) * bodies + body]`.
    normal: Vec<f32>,
    decimation: usize,
    dt: f64,
}

impl AvianRobots {
    /// Robots of these kinds, in contiguous blocks, on the plane of the settings and among `statics`.
    pub(crate) fn new<T: Real>(
        settings: &StepSettings,
        substeps: usize,
        statics: &[Part],
        kinds: &[Kind<T>],
        workers: &Workers,
    ) -> Result<Self, EngineError> {
        let mut first_env = 0;
        let mut blocks = Vec::new();
        for kind in kinds {
            blocks.push(Block::new(kind, settings, substeps, statics, first_env, workers.num_chunks())?);
            first_env += kind.count;
        }
        Ok(Self { blocks })
    }

    /// The block of an env, and the robot's place in it.
    fn at(&self, env: usize) -> (usize, usize) {
        let block = self.blocks.partition_point(|block| block.first_env + block.count <= env);
        (block, env - self.blocks.get(block).map_or(0, |block| block.first_env))
    }
}

impl<F: RowFamily> Engine<F> for AvianRobots {
    fn save(&self) -> Result<Vec<Vec<u8>>, postcard::Error> {
        let robots = self.blocks.iter().flat_map(|block| (0..block.count).map(|env| block.engine.save(env)));
        robots.collect()
    }

    fn check(&self, mut envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        for block in &self.blocks {
            let (mine, rest) = envs.split_at_checked(block.count).ok_or(postcard::Error::DeserializeUnexpectedEnd)?;
            block.engine.saved(mine)?;
            envs = rest;
        }
        if envs.is_empty() { Ok(()) } else { Err(postcard::Error::DeserializeBadEncoding) }
    }

    fn load(&mut self, mut envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        Engine::<F>::check(self, envs)?;
        for block in &mut self.blocks {
            let (mine, rest) = envs.split_at_checked(block.count).ok_or(postcard::Error::DeserializeUnexpectedEnd)?;
            block.engine.load(mine)?;
            envs = rest;
        }
        Ok(())
    }

    fn upload(&mut self, env: usize, parameters: &Parameters<F::Number>) {
        let (block, row) = self.at(env);
        if let Some(block) = self.blocks.get_mut(block) {
            let parameters = Parameters::from_scalars(&block.topology, parameters);
            block.engine.set_parameters(row, &parameters);
        }
    }

    fn set_explicit(&mut self, morphology: usize, explicit: &[bool]) {
        self.blocks[morphology].explicit.copy_from_slice(explicit);
    }

    fn restart(&mut self, env: usize, rows: F::Rows<'_>) {
        let (block, row) = self.at(env);
        let (_, rows) = rows.split_rows(env - row);
        self.blocks[block].place(row, &rows);
    }

    fn step(&mut self, workers: &Workers, mut rows: F::Rows<'_>, run: Run) -> Vec<DivergenceRecord> {
        let mut found = Vec::new();
        for (morphology, block) in self.blocks.iter_mut().enumerate() {
            let (mut mine, more) = rows.split_rows(block.count);
            rows = more;
            block.gather(&mine);
            block.step(workers, run);
            let broken = if run.watched[morphology] { block.first_broken(run.limits) } else { None };
            found.extend(mine.record(broken, morphology, block.first_env, |rows| block.scatter(rows)));
        }
        found
    }

    fn link_drift(&self, env: usize) -> f64 {
        let (block, row) = self.at(env);
        self.blocks[block].engine.drift(row)
    }
}

impl Block {
    fn new<T: Real>(
        kind: &Kind<T>,
        settings: &StepSettings,
        substeps: usize,
        statics: &[Part],
        first_env: usize,
        chunks: usize,
    ) -> Result<Self, EngineError> {
        let topology = kind.topology.clone();
        let nominal = Parameters::from_scalars(&topology, kind.nominal);
        let &StepSettings { dt, decimation, gravity, .. } = settings;
        let of_worlds = Settings { dt, substeps, gravity, ground: settings.contact.ground };
        let (count, ages) = (kind.count, super::super::history_length(kind.max_delay, decimation));
        Ok(Self {
            first_env,
            count,
            engine: super::Engine::new(kind, &nominal, &of_worlds, statics, chunks)?,
            explicit: topology.joints.iter().map(|joint| joint.explicit).collect(),
            work: Workspace::new(&topology),
            report: Report::zeros(&topology, decimation),
            state: State::zeros(&topology),
            drives: vec![Drive::zeros(&topology, ages); count],
            before: vec![0.0; count * topology.num_joints()],
            feet: kind.feet.to_vec(),
            others: (0..topology.num_bodies).filter(|body| !kind.feet.contains(body)).collect(),
            normal: vec![0.0; count * decimation * topology.num_bodies],
            decimation,
            topology,
            dt,
        })
    }

    /// Puts a robot where its row has it.
    fn place(&mut self, row: usize, rows: &impl RobotRows) {
        self.engine.set_origin(row, rows.origin(row));
        rows.read_motion(row, &mut self.state, 0);
        self.engine.set_state(row, &self.state);
    }

    /// Places the robots whose rows are not what the engine left, and takes over what is asked of all.
    fn gather<R: RobotRows>(&mut self, rows: &R) {
        for row in 0..self.count {
            rows.read_motion(row, &mut self.state, 0);
            let (ours, theirs) = (self.engine.state(row), &self.state);
            let same = equal::<R::Number>(&ours.position, &theirs.position)
                && equal::<R::Number>(&ours.rotation, &theirs.rotation)
                && equal::<R::Number>(&ours.linear_velocity, &theirs.linear_velocity)
                && equal::<R::Number>(&ours.angular_velocity, &theirs.angular_velocity)
                && equal::<R::Number>(&ours.joint_position, &theirs.joint_position)
                && equal::<R::Number>(&ours.joint_velocity, &theirs.joint_velocity)
                && self.engine.origin(row) == rows.origin(row);
            if !same {
                self.place(row, rows);
            }
            let drive = &mut self.drives[row];
            rows.read_drive(row, drive, 0);
            let [force, torque] = [drive.base_force, drive.base_torque].map(|v| v.map(|x| x as f32));
            self.engine.set_wrench(row, force, torque);
        }
    }

    fn step(&mut self, workers: &Workers, run: Run) {
        for step in 0..run.steps {
            let substep = step % self.decimation;
            self.aim(substep);
            if step + 1 == run.steps {
                self.remember_velocities();
            }
            self.engine.step(workers, &self.explicit, run.gains, 1);
            self.note_forces(substep);
        }
    }

    /// Gives every actuator the target from its delay ago.
    fn aim(&mut self, substep: usize) {
        for (row, Drive { targets, delay, feedforward, .. }) in self.drives.iter().enumerate() {
            for joint in 0..self.topology.num_joints() {
                // a target of this age is seen by delays beyond `substep + (age - 1) decimation`
                let late = delay[joint].round() as usize;
                let seen = |age: &usize| substep + (age - 1) * self.decimation < late;
                let age = (1..targets.len()).rev().find(seen).unwrap_or(0);
                self.engine.set_drive(row, joint, targets[age][joint], feedforward[joint]);
            }
        }
    }

    fn remember_velocities(&mut self) {
        let joints = self.topology.num_joints();
        for (row, before) in self.before.chunks_exact_mut(joints.max(1)).enumerate() {
            before.copy_from_slice(&self.engine.state(row).joint_velocity);
        }
    }

    fn note_forces(&mut self, substep: usize) {
        for row in 0..self.count {
            let first = (row * self.decimation + substep) * self.topology.num_bodies;
            for (to, normal) in self.normal[first..].iter_mut().zip(self.engine.normal_force(row)) {
                *to = *normal as f32;
            }
        }
    }

    /// The first robot whose new state is not finite or beyond the limits.
    fn first_broken(&self, limits: &StateLimits) -> Option<usize> {
        (0..self.count).find(|&row| {
            let numbers = state_numbers(self.engine.state(row), self.engine.effort(row));
            limits.violation(numbers, |x| x as f32).is_some()
        })
    }

    fn scatter(&mut self, rows: &mut impl RobotRows) {
        let (joints, bodies) = (self.topology.num_joints(), self.topology.num_bodies);
        for row in 0..self.count {
            let (state, report) = (self.engine.state(row), &mut self.report);
            rows.write_motion(row, state, 0);
            report.joint_effort.copy_from_slice(self.engine.effort(row));
            let before = &self.before[row * joints..(row + 1) * joints];
            for ((to, new), old) in report.joint_acceleration.iter_mut().zip(&state.joint_velocity).zip(before) {
                *to = (new - old) / self.dt;
            }
            report.body_force.copy_from_slice(self.engine.force(row));
            for (step, normal) in report.normal_force.iter_mut().enumerate() {
                let first = (row * self.decimation + step) * bodies;
                for (to, &from) in normal.iter_mut().zip(&self.normal[first..]) {
                    *to = f64::from(from);
                }
            }
            f64::report_sites(&self.topology, self.engine.parameters(row), state, report, &mut self.work);
            rows.write_report(row, report, &self.feet, &self.others, 0);
        }
    }
}

/// Whether numbers are those that were written into a row of numbers `T` before.
fn equal<T: Real>(ours: &[f64], row: &[f64]) -> bool {
    ours.iter().zip(row).all(|(&x, &y)| T::splat(x).lane(0) == y)
}
