//! Physics: the engines, what they read and write of the robots' components, and the system that has one step them.

use bevy_ecs::prelude::*;
use bevy_ecs::system::RegisteredSystemError;

use super::broken::{BrokenStates, Evidence, Motion};
use super::packs::Packs;
use super::physics_avian::AvianRobots;
use super::terminate::{StateLimits, StateNumbers};
use super::terms::CompiledTask;
use crate::app::SimError;
use crate::avian::EngineError;
use crate::components::{
    ActuatorDelay, BasePose, BaseVelocity, Body, ConstraintImpulses, ContactForces, EnvId, EnvOrigin, ExternalWrench,
    Feet, JointEffort, JointState, JointTargets, Robot,
};
use crate::config::EngineKind;
use crate::dynamics::lanes::{self, Real, Simd, prefetch};
use crate::dynamics::{ContactSettings, Parameters, Plane, State, StepSettings};
use crate::morphology::Morphologies;
use crate::rows::{SplitRows, Workers, read_rows, write_rows};
use crate::world::Ground;

/// The engine that steps the robots of a simulation: the articulated one, on the instruction set it was made for, or Avian's.
#[derive(Resource)]
pub struct PhysicsEngine(Box<dyn Engine>);

pub(super) trait Engine: Send + Sync {
    /// What decides how the envs go on, beyond their components, as bytes; of each env.
    fn save(&self) -> Result<Vec<Vec<u8>>, postcard::Error> {
        Ok(Vec::new())
    }
    /// Whether these bytes are such.
    fn check(&self, _envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        Ok(())
    }
    /// Takes them up, once the components and the robots' numbers are set; bytes that [`Engine::check`] refuses change nothing.
    fn load(&mut self, _envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        Ok(())
    }
    /// Takes over a robot's numbers.
    fn upload(&mut self, env: usize, parameters: &Parameters<f32>);
    /// One control step of all robots. Of each morphology in `watched` the first env whose new state is broken is
    /// returned.
    fn step(
        &mut self,
        morphologies: &Morphologies,
        workers: &Workers,
        rows: PhysicsRows,
        limits: &StateLimits,
        watched: &[bool],
    ) -> Vec<Evidence>;
}

/// The components that the engine reads and writes, row `i` belonging to env `i`.
pub(super) struct PhysicsRows<'a> {
    pub(super) origins: &'a [EnvOrigin],
    pub(super) poses: &'a mut [BasePose],
    pub(super) velocities: &'a mut [BaseVelocity],
    pub(super) joints: &'a mut [JointState],
    pub(super) targets: &'a mut [JointTargets],
    pub(super) delays: &'a mut [ActuatorDelay],
    pub(super) wrenches: &'a mut [ExternalWrench],
    pub(super) efforts: &'a mut [JointEffort],
    pub(super) impulses: &'a mut [ConstraintImpulses],
    pub(super) forces: &'a mut [ContactForces],
    pub(super) feet: &'a mut [Feet],
}

impl SplitRows for PhysicsRows<'_> {
    fn split_rows(self, n: usize) -> (Self, Self) {
        let (origins, origins2) = self.origins.split_at(n);
        let (poses, poses2) = self.poses.split_at_mut(n);
        let (velocities, velocities2) = self.velocities.split_at_mut(n);
        let (joints, joints2) = self.joints.split_at_mut(n);
        let (targets, targets2) = self.targets.split_at_mut(n);
        let (delays, delays2) = self.delays.split_at_mut(n);
        let (wrenches, wrenches2) = self.wrenches.split_at_mut(n);
        let (efforts, efforts2) = self.efforts.split_at_mut(n);
        let (impulses, impulses2) = self.impulses.split_at_mut(n);
        let (forces, forces2) = self.forces.split_at_mut(n);
        let (feet, feet2) = self.feet.split_at_mut(n);
        (
            Self { origins, poses, velocities, joints, targets, delays, wrenches, efforts, impulses, forces, feet },
            Self {
                origins: origins2,
                poses: poses2,
                velocities: velocities2,
                joints: joints2,
                targets: targets2,
                delays: delays2,
                wrenches: wrenches2,
                efforts: efforts2,
                impulses: impulses2,
                forces: forces2,
                feet: feet2,
            },
        )
    }
}

/// The numbers of a state that have a limit.
#[inline]
pub(super) fn state_numbers<'a, L>(state: &'a State<L>, effort: &'a [L]) -> StateNumbers<'a, L> {
    [
        &state.position,
        &state.rotation,
        &state.linear_velocity,
        &state.angular_velocity,
        &state.joint_position,
        &state.joint_velocity,
        effort,
    ]
}

impl PhysicsRows<'_> {
    /// Reads poses and velocities of a row into a lane.
    #[inline]
    pub(super) fn read_motion<L: Real>(&self, row: usize, state: &mut State<L>, lane: usize) {
        put(&mut state.position, &self.poses[row].position, lane);
        put(&mut state.rotation, &self.poses[row].rotation, lane);
        put(&mut state.linear_velocity, &self.velocities[row].linear, lane);
        put(&mut state.angular_velocity, &self.velocities[row].angular, lane);
        put(&mut state.joint_position, &self.joints[row].position, lane);
        put(&mut state.joint_velocity, &self.joints[row].velocity, lane);
    }

    /// Writes poses and velocities of a lane into a row.
    #[inline]
    pub(super) fn write_motion<L: Real>(&mut self, row: usize, state: &State<L>, lane: usize) {
        get(&state.position, &mut self.poses[row].position, lane);
        get(&state.rotation, &mut self.poses[row].rotation, lane);
        get(&state.linear_velocity, &mut self.velocities[row].linear, lane);
        get(&state.angular_velocity, &mut self.velocities[row].angular, lane);
        get(&state.joint_position, &mut self.joints[row].position, lane);
        get(&state.joint_velocity, &mut self.joints[row].velocity, lane);
    }

    /// Asks for a row's memory.
    #[inline]
    pub(super) fn prefetch(&self, row: usize) {
        prefetch(&self.origins[row]);
        prefetch(&self.poses[row]);
        prefetch(&self.velocities[row]);
        prefetch(&self.joints[row]);
        prefetch(&self.targets[row]);
        prefetch(&self.delays[row]);
        prefetch(&self.wrenches[row]);
        prefetch(&self.efforts[row]);
        prefetch(&self.impulses[row]);
        prefetch(&self.forces[row]);
        prefetch(&self.feet[row]);
    }

    pub(super) fn motion(&self, row: usize) -> Motion {
        Motion {
            pose: self.poses[row],
            velocity: self.velocities[row],
            joints: self.joints[row].clone(),
            effort: self.efforts[row].clone(),
            impulses: self.impulses[row].clone(),
        }
    }
}

impl Evidence {
    /// Has new states written to the rows of a morphology, whose envs begin at `first_env`; what there is to be known of the row whose
    /// state is `broken`, if any is.
    pub(super) fn of_writing(
        broken: Option<usize>,
        morphology: usize,
        first_env: usize,
        rows: &mut PhysicsRows,
        write: impl FnOnce(&mut PhysicsRows),
    ) -> Option<Self> {
        let before = broken.map(|row| (row, rows.motion(row)));
        write(rows);
        before.map(|(row, before)| Self {
            morphology,
            env: first_env + row,
            before,
            targets: rows.targets[row].clone(),
            delay: rows.delays[row].clone(),
            wrench: rows.wrenches[row],
            after: rows.motion(row),
        })
    }
}

impl PhysicsEngine {
    /// An engine for robots of these kinds, `counts[m]` of kind `m` in contiguous blocks.
    ///
    /// # Errors
    /// What Avian's engine cannot simulate.
    pub(crate) fn new(
        simd: Simd,
        task: &CompiledTask,
        morphologies: &Morphologies,
        counts: &[usize],
        ground: &Ground,
        workers: &Workers,
    ) -> Result<Self, EngineError> {
        let config = &task.config;
        if config.physics.engine == EngineKind::Avian {
            return Ok(Self(Box::new(AvianRobots::new(config, morphologies, counts, ground, workers)?)));
        }
        let settings = StepSettings {
            dt: config.sim.dt,
            decimation: config.sim.decimation as usize,
            gravity: ground.gravity,
            contact: ContactSettings {
                iterations: config.physics.solver_iterations as usize,
                correction: config.physics.depenetration_rate,
                max_depenetration_velocity: config.physics.max_depenetration_velocity,
                ground: Some(Plane::level(ground.height)),
                ..ContactSettings::default()
            },
        };
        let (threads, terrain) = (workers.threads(), ground.terrain.clone());
        let engine: Box<dyn Engine> = match simd {
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => Box::new(Packs::<lanes::Avx512>::new(settings, terrain, morphologies, counts, threads)),
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => Box::new(Packs::<lanes::Avx2>::new(settings, terrain, morphologies, counts, threads)),
            #[cfg(target_arch = "aarch64")]
            Simd::Neon => Box::new(Packs::<lanes::Neon>::new(settings, terrain, morphologies, counts, threads)),
            _ => Box::new(Packs::<lanes::Portable>::new(settings, terrain, morphologies, counts, threads)),
        };
        Ok(Self(engine))
    }
}

/// What the engine knows of each env beyond its components, as bytes.
pub(crate) fn save_engine(world: &World) -> Result<Vec<Vec<u8>>, postcard::Error> {
    world.resource::<PhysicsEngine>().0.save()
}

/// Whether the engine can go on from these bytes.
pub(crate) fn check_engine(world: &World, envs: &[Vec<u8>]) -> Result<(), SimError> {
    let checked = world.resource::<PhysicsEngine>().0.check(envs);
    checked.map_err(|error| SimError::Snapshot(format!("its engine's part cannot be read: {error}")))
}

/// Gives the engine what it knew when it was saved, after the components were set.
pub(crate) fn load_engine(world: &mut World, envs: &[Vec<u8>]) -> Result<(), SimError> {
    let uploaded = world.run_system_cached(upload_bodies);
    uploaded.map_err(|error| SimError::Snapshot(error.to_string()))?;
    let loaded = world.resource_mut::<PhysicsEngine>().0.load(envs);
    loaded.map_err(|error| SimError::Snapshot(format!("its engine's part cannot be read: {error}")))
}

/// Hands robots whose numbers have changed to the engine.
pub(super) fn upload_bodies(
    mut engine: ResMut<PhysicsEngine>,
    bodies: Query<(&EnvId, &Body), (With<Robot>, Changed<Body>)>,
) {
    for (env, body) in &bodies {
        engine.0.upload(env.0 as usize, &body.0);
    }
}

/// One control step of physics.
pub(super) fn step_physics(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    mut broken: ResMut<BrokenStates>,
    mut engine: ResMut<PhysicsEngine>,
    origins: Query<&'static EnvOrigin>,
    mut poses: Query<&'static mut BasePose>,
    mut velocities: Query<&'static mut BaseVelocity>,
    mut joints: Query<&'static mut JointState>,
    mut targets: Query<&'static mut JointTargets>,
    mut delays: Query<&'static mut ActuatorDelay>,
    mut wrenches: Query<&'static mut ExternalWrench>,
    mut efforts: Query<&'static mut JointEffort>,
    mut impulses: Query<&'static mut ConstraintImpulses>,
    mut forces: Query<&'static mut ContactForces>,
    mut feet: Query<&'static mut Feet>,
) {
    let rows = PhysicsRows {
        origins: read_rows(&origins),
        poses: write_rows(&mut poses),
        velocities: write_rows(&mut velocities),
        joints: write_rows(&mut joints),
        targets: write_rows(&mut targets),
        delays: write_rows(&mut delays),
        wrenches: write_rows(&mut wrenches),
        efforts: write_rows(&mut efforts),
        impulses: write_rows(&mut impulses),
        forces: write_rows(&mut forces),
        feet: write_rows(&mut feet),
    };
    let evidence = engine.0.step(&morphologies, &workers, rows, &task.limits, broken.watched());
    broken.note(evidence);
}

/// The physics of one control step alone, for replays.
pub(crate) fn run_physics(world: &mut World) -> Result<(), RegisteredSystemError> {
    world.run_system_cached(upload_bodies)?;
    world.run_system_cached(step_physics)
}

/// Control steps of targets that an actuator can still see.
pub(crate) fn history_length(max_delay: u32, decimation: usize) -> usize {
    1 + (max_delay as usize).div_ceil(decimation)
}

#[inline]
pub(super) fn put<L: Real>(to: &mut [L], from: &[f32], lane: usize) {
    for (x, &y) in to.iter_mut().zip(from) {
        x.set_lane_f32(lane, y);
    }
}

#[inline]
pub(super) fn get<L: Real>(from: &[L], to: &mut [f32], lane: usize) {
    for (y, x) in from.iter().zip(to) {
        *x = y.lane_f32(lane);
    }
}

#[inline]
pub(super) fn get_arrays<L: Real, const N: usize>(from: &[[L; N]], to: &mut [[f32; N]], lane: usize) {
    for (y, x) in from.iter().zip(to) {
        get(y, x, lane);
    }
}
