//! The control step on Avian's rigid bodies.
//!
//! The engine keeps the robots between control steps. A state that a reset or a push has written
//! into a robot's row is set first, and the robot's contacts start without memory. A robot whose
//! row is as the engine left it goes on.

use glam::DVec2;

use super::super::{
    DivergenceRecord, MorphologySetup, RobotRows, RowEngine, RowFamily, Run, StateLimits, clear_drive, history_length,
    state_numbers,
};
use super::{EngineError, Env, Settings, Worlds};
use crate::blocks::BlockList;
use crate::dynamics::lanes::{Real, read_lane, write_lane};
use crate::dynamics::{
    ActuatorNetwork, Drive, NetworkStep, Parameters, Report, Scalar, State, StepSettings, Topology, Workspace,
};
use crate::obstacles::Part;
use crate::workers::Workers;

/// Robots of all morphologies.
pub(crate) struct AvianRobots {
    blocks: Vec<Block>,
}

/// The robots of one morphology.
struct Block {
    first_env: usize,
    count: usize,
    worlds: Worlds,
    topology: Topology,
    explicit: Vec<bool>,
    work: Workspace<f64>,
    report: Report<f64>,
    state: State<f64>,
    /// Drive of each robot.
    drives: Vec<Drive<f64>>,
    networks: Vec<ActuatorNetwork>,
    /// Memory of each robot's actuator networks.
    memories: Vec<Vec<f64>>,
    /// Scratch memory of the networks.
    features: Vec<f64>,
    settings: StepSettings,
    /// Joint velocities before the last physics step, `[count * joints]`.
    before: Vec<f64>,
    /// The contact bodies that are feet, and those that are not.
    feet: Vec<usize>,
    others: Vec<usize>,
    /// Normal forces on the contact bodies, N: `normal[(row * physics steps + physics step) *
    /// bodies + body]`.
    normal: Vec<f32>,
    decimation: usize,
    dt: f64,
}

impl AvianRobots {
    /// Robots of these morphologies, in contiguous blocks, on the plane of the settings and among
    /// `statics`.
    pub(crate) fn new<T: Real>(
        settings: &StepSettings,
        substeps: usize,
        statics: &[Part],
        setups: &[MorphologySetup<T>],
        workers: &Workers,
    ) -> Result<Self, EngineError> {
        let mut first_env = 0;
        let mut blocks = Vec::new();
        for setup in setups {
            blocks.push(Block::new(setup, settings, substeps, statics, first_env, workers.num_chunks())?);
            first_env += setup.count;
        }
        Ok(Self { blocks })
    }

    /// The block of an env, and the robot's place in it.
    fn at(&self, env: usize) -> (usize, usize) {
        let block = self.blocks.partition_point(|block| block.first_env + block.count <= env);
        (block, env - self.blocks.get(block).map_or(0, |block| block.first_env))
    }
}

impl<F: RowFamily> RowEngine<F> for AvianRobots {
    fn save(&self) -> Result<Vec<Vec<u8>>, postcard::Error> {
        let robots = self.blocks.iter().flat_map(|block| (0..block.count).map(|env| block.worlds.save(env)));
        robots.collect()
    }

    fn check(&self, mut envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        for block in &self.blocks {
            let (mine, rest) = envs.split_at_checked(block.count).ok_or(postcard::Error::DeserializeUnexpectedEnd)?;
            block.worlds.saved(mine)?;
            envs = rest;
        }
        if envs.is_empty() { Ok(()) } else { Err(postcard::Error::DeserializeBadEncoding) }
    }

    fn load(&mut self, mut envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        RowEngine::<F>::check(self, envs)?;
        for block in &mut self.blocks {
            let (mine, rest) = envs.split_at_checked(block.count).ok_or(postcard::Error::DeserializeUnexpectedEnd)?;
            block.worlds.load(mine)?;
            envs = rest;
        }
        Ok(())
    }

    fn upload(&mut self, env: usize, parameters: &Parameters<F::Number>) {
        let (block, row) = self.at(env);
        if let Some(block) = self.blocks.get_mut(block) {
            let parameters = Parameters::from_scalars(&block.topology, parameters);
            block.worlds.set_parameters(row, &parameters);
        }
    }

    fn set_explicit(&mut self, morphology: usize, explicit: &[bool]) {
        self.blocks[morphology].explicit.copy_from_slice(explicit);
    }

    fn fetch(&self, env: usize, mut rows: F::Rows<'_>) {
        let (block, row) = self.at(env);
        let block = &self.blocks[block];
        let mut report = Report::zeros(&block.topology, 1);
        let env = block.worlds.env(row);
        report.joint_effort.copy_from_slice(&env.effort);
        report.body_force.copy_from_slice(&env.force);
        rows.write_motion(0, &env.state, 0);
        read_lane(&block.memories[row], rows.memory_mut(0), 0);
        rows.write_report(0, &report, &block.feet, &block.others, 0);
    }

    fn restart(&mut self, env: usize, rows: F::Rows<'_>) {
        let (block, row) = self.at(env);
        let block = &mut self.blocks[block];
        rows.read_motion(0, &mut block.state, 0);
        rows.read_report(0, &mut block.report, 0);
        write_lane(&mut block.memories[row], rows.memory(0), 0);
        block.worlds.set_state(row, &block.state);
        let env = block.worlds.env_mut(row);
        env.effort.copy_from_slice(&block.report.joint_effort);
        env.force.copy_from_slice(&block.report.body_force);
    }

    fn forget(&mut self, env: usize) {
        let (block, row) = self.at(env);
        let block = &mut self.blocks[block];
        block.state.clone_from(&block.worlds.env(row).state);
        block.worlds.set_state(row, &block.state);
    }

    fn step(&mut self, workers: &Workers, blocks: BlockList<F::Rows<'_>>, run: Run) -> Vec<DivergenceRecord> {
        let mut found = Vec::new();
        for of_morphology in blocks {
            let (morphology, mut mine) = (usize::from(of_morphology.morphology.0), of_morphology.rows);
            let block = &mut self.blocks[morphology];
            if !F::RESIDENT {
                block.gather(&mine);
            }
            block.gather_drive(&mine);
            block.step(workers, run);
            if !F::RESIDENT {
                let broken = if run.watched[morphology] { block.first_broken(run.limits) } else { None };
                found.extend(mine.record(broken, morphology, block.first_env, |rows| block.scatter(rows)));
            }
        }
        found
    }

    fn link_drift(&self, env: usize) -> f64 {
        let (block, row) = self.at(env);
        self.blocks[block].worlds.drift(row)
    }
}

impl Block {
    fn new<T: Real>(
        setup: &MorphologySetup<T>,
        settings: &StepSettings,
        substeps: usize,
        statics: &[Part],
        first_env: usize,
        chunks: usize,
    ) -> Result<Self, EngineError> {
        let topology = setup.topology.clone();
        let nominal = Parameters::from_scalars(&topology, setup.nominal);
        let &StepSettings { dt, decimation, gravity, .. } = settings;
        let of_worlds = Settings { dt, substeps, gravity, ground: settings.contact.ground };
        let (count, ages) = (setup.count, history_length(setup.max_delay, decimation));
        Ok(Self {
            first_env,
            count,
            worlds: Worlds::new(setup, &nominal, &of_worlds, statics, chunks)?,
            explicit: topology.joints.iter().map(|joint| joint.explicit).collect(),
            work: Workspace::new(&topology),
            report: Report::zeros(&topology, decimation),
            state: State::zeros(&topology),
            drives: vec![Drive::zeros(&topology, ages); count],
            networks: setup.networks.to_vec(),
            memories: vec![vec![0.0; ActuatorNetwork::num_remembered_by(setup.networks)]; count],
            features: Vec::new(),
            settings: *settings,
            before: vec![0.0; count * topology.num_joints()],
            feet: setup.feet.to_vec(),
            others: (0..topology.num_bodies).filter(|body| !setup.feet.contains(body)).collect(),
            normal: vec![0.0; count * decimation * topology.num_bodies],
            decimation,
            topology,
            dt,
        })
    }

    /// Sets the robots whose rows differ from the engine's state.
    fn gather<R: RobotRows>(&mut self, rows: &R) {
        for row in 0..self.count {
            write_lane(&mut self.memories[row], rows.memory(row), 0);
            rows.read_motion(row, &mut self.state, 0);
            let (Env { state: ours, origin: at, .. }, theirs) = (self.worlds.env(row), &self.state);
            let origin = DVec2::from_array(rows.origin(row).map(f64::from)).extend(0.0);
            let same = equal::<R::Number>(&ours.position, &theirs.position)
                && equal::<R::Number>(&ours.rotation, &theirs.rotation)
                && equal::<R::Number>(&ours.linear_velocity, &theirs.linear_velocity)
                && equal::<R::Number>(&ours.angular_velocity, &theirs.angular_velocity)
                && equal::<R::Number>(&ours.joint_position, &theirs.joint_position)
                && equal::<R::Number>(&ours.joint_velocity, &theirs.joint_velocity)
                && *at == origin;
            if !same {
                self.worlds.env_mut(row).origin = origin;
                self.worlds.set_state(row, &self.state);
            }
        }
    }

    /// Reads the drives of the robots.
    fn gather_drive(&mut self, rows: &impl RobotRows) {
        for (row, drive) in self.drives.iter_mut().enumerate() {
            clear_drive(drive);
            rows.read_drive(row, drive, 0);
            let [force, torque] = [drive.base_force, drive.base_torque].map(|v| v.map(|x| x as f32));
            self.worlds.set_wrench(row, force, torque);
            self.worlds.set_link_forces(row, &drive.link_forces);
        }
    }

    fn step(&mut self, workers: &Workers, run: Run) {
        for step in 0..run.steps {
            let substep = step % self.decimation;
            if run.gains {
                self.ask_networks(substep);
            }
            self.aim(substep);
            if step + 1 == run.steps {
                self.remember_velocities();
            }
            self.worlds.step(workers, &self.explicit, run.gains, 1);
            self.note_forces(substep);
        }
    }

    /// Evaluates the networks of all robots, whose efforts become feed-forward efforts.
    fn ask_networks(&mut self, substep: usize) {
        if self.networks.is_empty() {
            return;
        }
        for (row, (drive, memory)) in self.drives.iter_mut().zip(&mut self.memories).enumerate() {
            let step = NetworkStep {
                topology: &self.topology,
                settings: &self.settings,
                networks: &self.networks,
                substep,
                state: &self.worlds.env(row).state,
                drive,
                memory,
                features: &mut self.features,
                work: &mut self.work,
            };
            step.run();
        }
    }

    /// Gives every actuator the target of its delay.
    fn aim(&mut self, substep: usize) {
        for (row, Drive { targets, delay, feedforward, .. }) in self.drives.iter().enumerate() {
            for joint in 0..self.topology.num_joints() {
                // a target of this age is seen by delays beyond `substep + (age - 1) decimation`
                let late = delay[joint].round() as usize;
                let seen = |age: &usize| substep + (age - 1) * self.decimation < late;
                let age = (1..targets.len()).rev().find(seen).unwrap_or(0);
                self.worlds.set_drive(row, joint, targets[age][joint], feedforward[joint]);
            }
        }
    }

    fn remember_velocities(&mut self) {
        let joints = self.topology.num_joints();
        for (row, before) in self.before.chunks_exact_mut(joints.max(1)).enumerate() {
            before.copy_from_slice(&self.worlds.env(row).state.joint_velocity);
        }
    }

    fn note_forces(&mut self, substep: usize) {
        for row in 0..self.count {
            let first = (row * self.decimation + substep) * self.topology.num_bodies;
            for (to, normal) in self.normal[first..].iter_mut().zip(&self.worlds.env(row).normal_force) {
                *to = *normal as f32;
            }
        }
    }

    /// The first robot whose new state is not finite or beyond the limits.
    fn first_broken(&self, limits: &StateLimits) -> Option<usize> {
        (0..self.count).find(|&row| {
            let Env { state, effort, .. } = self.worlds.env(row);
            let numbers = state_numbers(state, effort);
            limits.violation(numbers, |x| x as f32).is_some()
        })
    }

    fn scatter(&mut self, rows: &mut impl RobotRows) {
        let (joints, bodies) = (self.topology.num_joints(), self.topology.num_bodies);
        for row in 0..self.count {
            let (Env { state, parameters, effort, force, .. }, report) = (self.worlds.env(row), &mut self.report);
            rows.write_motion(row, state, 0);
            read_lane(&self.memories[row], rows.memory_mut(row), 0);
            let before = &self.before[row * joints..(row + 1) * joints];
            for (joint, &effort) in effort.iter().enumerate() {
                report.set_joint(joint, effort, [before[joint], state.joint_velocity[joint]], self.dt);
            }
            report.body_force.copy_from_slice(force);
            for (step, normal) in report.normal_force.iter_mut().enumerate() {
                let first = (row * self.decimation + step) * bodies;
                for (to, &from) in normal.iter_mut().zip(&self.normal[first..]) {
                    *to = f64::from(from);
                }
            }
            f64::report_sites(&self.topology, parameters, state, report, &mut self.work);
            rows.write_report(row, report, &self.feet, &self.others, 0);
        }
    }
}

/// Whether `ours` equals the row of numbers `T` that was written before.
fn equal<T: Real>(ours: &[f64], row: &[f64]) -> bool {
    ours.iter().zip(row).all(|(&x, &y)| T::splat(x).lane(0) == y)
}
