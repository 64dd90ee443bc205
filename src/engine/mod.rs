#![doc = include_str!("README.md")]

pub(crate) mod articulated;
pub(crate) mod avian;
mod divergence;
mod limits;

use crate::components::{
    ActuatorDelay, BasePose, BaseVelocity, ConstraintImpulses, ContactForces, EnvOrigin, ExternalWrench, Feet,
    JointEffort, JointState, JointTargets,
};
use crate::config::{EngineKind, TaskConfig};
use crate::dynamics::lanes::{self, Real, Simd, prefetch};
use crate::dynamics::{ContactSettings, Parameters, Plane, State, StepSettings};
use crate::morphology::Morphologies;
use crate::workers::{SplitRows, Workers};
use crate::world::Ground;
use articulated::Packs;
use avian::{AvianRobots, EngineError};

pub(crate) use divergence::DivergenceRecord;
pub use divergence::Motion;
pub(crate) use limits::StateNumbers;
pub use limits::{Quantity, StateLimits, Violation};

pub(crate) trait Engine: Send + Sync {
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
    ) -> Vec<DivergenceRecord>;
}

/// The components that the engine reads and writes, row `i` belonging to env `i`.
pub(crate) struct PhysicsRows<'a> {
    pub(crate) origins: &'a [EnvOrigin],
    pub(crate) poses: &'a mut [BasePose],
    pub(crate) velocities: &'a mut [BaseVelocity],
    pub(crate) joints: &'a mut [JointState],
    pub(crate) targets: &'a mut [JointTargets],
    pub(crate) delays: &'a mut [ActuatorDelay],
    pub(crate) wrenches: &'a mut [ExternalWrench],
    pub(crate) efforts: &'a mut [JointEffort],
    pub(crate) impulses: &'a mut [ConstraintImpulses],
    pub(crate) forces: &'a mut [ContactForces],
    pub(crate) feet: &'a mut [Feet],
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
pub(crate) fn state_numbers<'a, L>(state: &'a State<L>, effort: &'a [L]) -> StateNumbers<'a, L> {
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
    pub(crate) fn read_motion<L: Real>(&self, row: usize, state: &mut State<L>, lane: usize) {
        put(&mut state.position, &self.poses[row].position, lane);
        put(&mut state.rotation, &self.poses[row].rotation, lane);
        put(&mut state.linear_velocity, &self.velocities[row].linear, lane);
        put(&mut state.angular_velocity, &self.velocities[row].angular, lane);
        put(&mut state.joint_position, &self.joints[row].position, lane);
        put(&mut state.joint_velocity, &self.joints[row].velocity, lane);
    }

    /// Writes poses and velocities of a lane into a row.
    #[inline]
    pub(crate) fn write_motion<L: Real>(&mut self, row: usize, state: &State<L>, lane: usize) {
        get(&state.position, &mut self.poses[row].position, lane);
        get(&state.rotation, &mut self.poses[row].rotation, lane);
        get(&state.linear_velocity, &mut self.velocities[row].linear, lane);
        get(&state.angular_velocity, &mut self.velocities[row].angular, lane);
        get(&state.joint_position, &mut self.joints[row].position, lane);
        get(&state.joint_velocity, &mut self.joints[row].velocity, lane);
    }

    /// Asks for a row's memory.
    #[inline]
    pub(crate) fn prefetch(&self, row: usize) {
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

    pub(crate) fn motion(&self, row: usize) -> Motion {
        Motion {
            pose: self.poses[row],
            velocity: self.velocities[row],
            joints: self.joints[row].clone(),
            effort: self.efforts[row].clone(),
            impulses: self.impulses[row].clone(),
        }
    }
}

/// The engine that a task asks for, on an instruction set, for `counts[m]` robots of kind `m`.
///
/// # Errors
/// What Avian's engine cannot simulate.
pub(crate) fn make(
    simd: Simd,
    config: &TaskConfig,
    morphologies: &Morphologies,
    counts: &[usize],
    ground: &Ground,
    workers: &Workers,
) -> Result<Box<dyn Engine>, EngineError> {
    if config.physics.engine == EngineKind::Avian {
        return Ok(Box::new(AvianRobots::new(config, morphologies, counts, ground, workers)?));
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
    Ok(engine)
}

/// Control steps of targets that an actuator can still see.
pub(crate) fn history_length(max_delay: u32, decimation: usize) -> usize {
    1 + (max_delay as usize).div_ceil(decimation)
}

#[inline]
pub(crate) fn put<L: Real>(to: &mut [L], from: &[f32], lane: usize) {
    for (x, &y) in to.iter_mut().zip(from) {
        x.set_lane_f32(lane, y);
    }
}

#[inline]
pub(crate) fn get<L: Real>(from: &[L], to: &mut [f32], lane: usize) {
    for (y, x) in from.iter().zip(to) {
        *x = y.lane_f32(lane);
    }
}

#[inline]
pub(crate) fn get_arrays<L: Real, const N: usize>(from: &[[L; N]], to: &mut [[f32; N]], lane: usize) {
    for (y, x) in from.iter().zip(to) {
        get(y, x, lane);
    }
}
