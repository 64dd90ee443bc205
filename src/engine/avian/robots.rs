//! The control step on Avian's rigid bodies.
//!
//! The engine keeps the robots between control steps. What a reset or a push has written into a robot's components is set
//! there first, and the robot's contacts begin anew; a robot whose components are as the engine left them goes on.

use super::super::{DivergenceRecord, Engine, PhysicsRows, StateLimits, get, get_arrays, state_numbers};
use super::{EngineError, JointField, Settings};
use crate::components::PerFoot;
use crate::config::TaskConfig;
use crate::dynamics::{Parameters, Plane, Report, Scalar, State, Topology, Workspace};
use crate::morphology::{Morphologies, MorphologyModel};
use crate::obstacles::{self, Part};
use crate::workers::{SplitRows, Workers};
use crate::world::Ground;

/// Robots of all kinds.
pub(crate) struct AvianRobots {
    decimation: usize,
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
    /// Joint velocities before the last physics step, `[count * joints]`.
    before: Vec<f64>,
    /// The contact bodies that are feet, and those that are not.
    feet: PerFoot<usize>,
    others: Vec<usize>,
    /// Normal forces on the contact bodies, N: `normal[(row * physics steps + physics step) * bodies + body]`.
    normal: Vec<f32>,
    decimation: usize,
    dt: f64,
}

impl AvianRobots {
    /// Robots of these kinds, `counts[m]` of kind `m` in contiguous blocks.
    pub(crate) fn new(
        config: &TaskConfig,
        morphologies: &Morphologies,
        counts: &[usize],
        ground: &Ground,
        workers: &Workers,
    ) -> Result<Self, EngineError> {
        let settings = Settings {
            dt: config.sim.dt,
            substeps: config.physics.avian_substeps as usize,
            gravity: ground.gravity,
            ground: ground.layout.is_none().then(|| Plane::level(ground.height)),
        };
        let mut statics: Vec<Part> = config.scene.obstacles.iter().flat_map(obstacles::parts).collect();
        statics.extend(config.scene.terrain.as_ref().and_then(obstacles::terrain));
        let decimation = config.sim.decimation as usize;
        let mut first_env = 0;
        let mut blocks = Vec::new();
        for (model, &count) in morphologies.0.iter().zip(counts) {
            blocks.push(Block::new(model, &settings, &statics, first_env, count, decimation, workers.num_chunks())?);
            first_env += count;
        }
        Ok(Self { decimation, blocks })
    }
}

impl Engine for AvianRobots {
    fn save(&self) -> Result<Vec<Vec<u8>>, postcard::Error> {
        let robots = self.blocks.iter().flat_map(|block| (0..block.count).map(|env| block.engine.save(env)));
        robots.collect()
    }

    fn check(&self, mut envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        for block in &self.blocks {
            let (mine, rest) = envs.split_at_checked(block.count).ok_or(postcard::Error::DeserializeUnexpectedEnd)?;
            block.engine.saved(mine.iter().map(Vec::as_slice))?;
            envs = rest;
        }
        if envs.is_empty() { Ok(()) } else { Err(postcard::Error::DeserializeBadEncoding) }
    }

    fn load(&mut self, mut envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        self.check(envs)?;
        for block in &mut self.blocks {
            let (mine, rest) = envs.split_at_checked(block.count).ok_or(postcard::Error::DeserializeUnexpectedEnd)?;
            block.engine.load(mine)?;
            envs = rest;
        }
        Ok(())
    }

    fn upload(&mut self, env: usize, parameters: &Parameters<f32>) {
        let at = self.blocks.partition_point(|block| block.first_env + block.count <= env);
        if let Some(block) = self.blocks.get_mut(at) {
            let parameters = Parameters::from_scalars(&block.topology, parameters);
            block.engine.set_parameters(env - block.first_env, &parameters);
        }
    }

    fn step(
        &mut self,
        _morphologies: &Morphologies,
        workers: &Workers,
        mut rows: PhysicsRows,
        limits: &StateLimits,
        watched: &[bool],
    ) -> Vec<DivergenceRecord> {
        let mut found = Vec::new();
        for (morphology, block) in self.blocks.iter_mut().enumerate() {
            let (mut mine, more) = rows.split_rows(block.count);
            rows = more;
            block.gather(&mine);
            for substep in 0..self.decimation {
                block.aim(&mine, substep, self.decimation);
                if substep + 1 == self.decimation {
                    block.remember_velocities();
                }
                block.engine.step(workers, &block.explicit, true, 1);
                block.note_forces(substep);
            }
            let broken = if watched[morphology] { block.first_broken(limits) } else { None };
            let first_env = block.first_env;
            let write = |rows: &mut PhysicsRows| block.scatter(rows);
            found.extend(DivergenceRecord::of_writing(broken, morphology, first_env, &mut mine, write));
        }
        found
    }
}

impl Block {
    fn new(
        model: &MorphologyModel,
        settings: &Settings,
        statics: &[Part],
        first_env: usize,
        count: usize,
        decimation: usize,
        chunks: usize,
    ) -> Result<Self, EngineError> {
        let topology = model.topology.clone();
        let nominal = Parameters::from_scalars(&topology, &model.nominal);
        Ok(Self {
            first_env,
            count,
            engine: super::Engine::new(
                &model.model,
                &model.align,
                &model.shape_pairs,
                &topology,
                &nominal,
                settings,
                statics,
                count,
                chunks,
            )?,
            explicit: topology.joints.iter().map(|joint| joint.explicit).collect(),
            work: Workspace::new(&topology),
            report: Report::zeros(&topology, decimation),
            state: State::zeros(&topology),
            before: vec![0.0; count * topology.num_joints()],
            feet: model.feet,
            others: (0..topology.num_bodies).filter(|body| !model.feet.contains(body)).collect(),
            normal: vec![0.0; count * decimation * topology.num_bodies],
            decimation,
            topology,
            dt: settings.dt,
        })
    }

    /// Sets the robots whose components are not what the engine left.
    fn gather(&mut self, rows: &PhysicsRows) {
        for row in 0..self.count {
            let state = self.engine.state(row);
            let (pose, velocity, joints) = (&rows.poses[row], &rows.velocities[row], &rows.joints[row]);
            let same = equal(&state.position, &pose.position)
                && equal(&state.rotation, &pose.rotation)
                && equal(&state.linear_velocity, &velocity.linear)
                && equal(&state.angular_velocity, &velocity.angular)
                && equal(&state.joint_position, &joints.position)
                && equal(&state.joint_velocity, &joints.velocity)
                && self.engine.origin(row) == rows.origins[row].position;
            if !same {
                self.engine.set_origin(row, rows.origins[row].position);
                rows.read_motion(row, &mut self.state, 0);
                self.engine.set_state(row, &self.state);
            }
            let wrench = &rows.wrenches[row];
            self.engine.set_wrench(row, wrench.force, wrench.torque);
        }
    }

    /// Gives every actuator the target from its delay ago.
    fn aim(&mut self, rows: &PhysicsRows, substep: usize, decimation: usize) {
        for row in 0..self.count {
            let (history, delay) = (&rows.targets[row].history, &rows.delays[row].0);
            for joint in 0..self.topology.num_joints() {
                // a target of this age is seen by delays beyond `substep + (age - 1) decimation`
                let late = delay[joint].round() as usize;
                let age = (1..history.len()).rev().find(|age| substep + (age - 1) * decimation < late).unwrap_or(0);
                self.engine.set_joint(row, joint, JointField::Target, f64::from(history[age][joint]));
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

    fn scatter(&mut self, rows: &mut PhysicsRows) {
        let joints = self.topology.num_joints();
        for row in 0..self.count {
            let state = self.engine.state(row);
            rows.write_motion(row, state, 0);
            get(self.engine.effort(row), &mut rows.efforts[row].applied, 0);
            let before = &self.before[row * joints..(row + 1) * joints];
            for ((to, new), old) in rows.efforts[row].acceleration.iter_mut().zip(&state.joint_velocity).zip(before) {
                *to = ((new - old) / self.dt) as f32;
            }
            let force = self.engine.force(row);
            let net = |body: usize| force[body].map(|x| x as f32);
            let first = |step: usize| (row * self.decimation + step) * self.topology.num_bodies;
            let normal = |step: usize, body: usize| self.normal[first(step) + body];
            rows.forces[row].set(&self.feet, &self.others, net, normal);
            f64::report_sites(&self.topology, self.engine.parameters(row), state, &mut self.report, &mut self.work);
            get_arrays(&self.report.site_position, &mut rows.feet[row].position, 0);
            get_arrays(&self.report.site_velocity, &mut rows.feet[row].velocity, 0);
        }
    }
}

/// Whether numbers are those that were written out before.
fn equal(wide: &[f64], narrow: &[f32]) -> bool {
    wide.iter().zip(narrow).all(|(&x, &y)| x as f32 == y)
}
