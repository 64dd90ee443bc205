//! Physics: the engines, what they read and write of the robots' components, and the system that has one step them.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;

use super::broken::{BrokenStates, describe_broken_states};
use super::load::InstructionSet;
use super::terms::CompiledTask;
use super::{ControlStep, PipelineSet, Setup, SetupSet, faults};
use crate::blocks::{BlockSizes, Blocks};
use crate::components::{
    ActuatorDelay, ActuatorMemory, BasePose, BaseVelocity, Body, ConstraintImpulses, ContactForces, Env, EnvId,
    EnvOrigin, ExternalWrench, Feet, JointEffort, JointState, JointTargets, Robot,
};
use crate::config::EngineKind;
use crate::dynamics::{ContactSettings, Plane, StepSettings};
use crate::engine::{self, ComponentRows, Components, Engine, EngineChoice, Kind, Run};
use crate::error::Error;
use crate::morphology::Morphologies;
use crate::obstacles;
use crate::workers::Workers;
use crate::world::Ground;

/// Makes the engine and steps it.
#[derive(Default)]
pub struct PhysicsPlugin;

impl Plugin for PhysicsPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(Setup, make_engine.in_set(SetupSet::Engine));
        app.add_systems(
            ControlStep,
            (upload_bodies, step_physics, describe_broken_states).chain().in_set(PipelineSet::Physics),
        );
    }
}

/// The engine that steps the robots of a simulation: the articulated one, on the instruction set it was made for, or Avian's.
#[derive(Resource)]
pub struct PhysicsEngine(Box<dyn Engine<Components>>);

fn make_engine(
    mut commands: Commands,
    simd: Res<InstructionSet>,
    task: Res<CompiledTask>,
    morphologies: Res<Morphologies>,
    blocks: Res<BlockSizes>,
    ground: Res<Ground>,
    workers: Res<Workers>,
) -> Result {
    let config = &task.config;
    let (on_plane, level) = (ground.layout.is_none(), Plane::level(ground.height));
    let (choice, plane) = match config.physics.engine {
        EngineKind::Articulated => (EngineChoice::Articulated(simd.0, ground.terrain.clone()), Some(level)),
        EngineKind::Avian => {
            let obstacles = config.scene.obstacles.iter().flat_map(obstacles::parts);
            let terrain = config.scene.terrain.as_ref().and_then(obstacles::terrain);
            let floor = obstacles::floor(&config.scene.pits());
            let plane = Some(level).filter(|_| on_plane && floor.is_none());
            let statics = obstacles.chain(terrain).chain(floor).collect();
            (EngineChoice::Avian(config.physics.avian_substeps as usize, statics), plane)
        }
    };
    let settings = StepSettings {
        dt: config.sim.dt,
        decimation: config.sim.decimation as usize,
        gravity: ground.gravity,
        contact: ContactSettings {
            iterations: config.physics.solver_iterations as usize,
            correction: config.physics.depenetration_rate,
            max_depenetration_velocity: config.physics.max_depenetration_velocity,
            ground: plane,
            ..ContactSettings::default()
        },
    };
    let kinds: Vec<Kind<f32>> =
        morphologies.0.iter().zip(&blocks.0).map(|(kind, &count)| Kind::of_morphology(kind, count)).collect();
    let engine = engine::make(choice, settings, &kinds, &workers).map_err(|error| {
        let remedy = "use \"articulated\", or another sim.dt or robot";
        Error::argument("physics.engine", error.to_string(), remedy)
    })?;
    commands.insert_resource(PhysicsEngine(engine));
    commands.insert_resource(BrokenStates::new(blocks.0.len()));
    Ok(())
}

/// What the engine knows of each env beyond its components, as bytes.
pub(crate) fn save_engine(world: &World) -> Result<Vec<Vec<u8>>, postcard::Error> {
    world.get_resource::<PhysicsEngine>().map_or_else(|| Ok(Vec::new()), |engine| engine.0.save())
}

/// Whether the engine can go on from these bytes.
pub(crate) fn check_engine(world: &World, envs: &[Vec<u8>]) -> Result<(), Error> {
    let checked = world.get_resource::<PhysicsEngine>().map_or(Ok(()), |engine| engine.0.check(envs));
    checked.map_err(|error| Error::Snapshot(format!("its engine's part cannot be read: {error}")))
}

/// Gives the engine what it knew when it was saved, after the components were set.
pub(crate) fn load_engine(world: &mut World, envs: &[Vec<u8>]) -> Result<(), Error> {
    if !world.contains_resource::<PhysicsEngine>() {
        return Ok(());
    }
    faults::outcome(world.run_system_cached(upload_bodies))?;
    let loaded = world.resource_mut::<PhysicsEngine>().0.load(envs);
    loaded.map_err(|error| Error::Snapshot(format!("its engine's part cannot be read: {error}")))
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
    task: Res<CompiledTask>,
    mut broken: ResMut<BrokenStates>,
    mut engine: ResMut<PhysicsEngine>,
    mut robots: Blocks<PhysicsColumns, Robot>,
    envs: Blocks<&'static EnvOrigin, Env>,
) -> Result {
    let blocks = robots.write()?.zip(envs.read()?).map(|_, (robots, origins)| {
        let (poses, velocities, joints, targets, delays, memories, wrenches, efforts, impulses, forces, feet) = robots;
        ComponentRows {
            origins,
            poses,
            velocities,
            joints,
            targets,
            delays,
            memories,
            wrenches,
            efforts,
            impulses,
            forces,
            feet,
        }
    });
    let steps = task.config.sim.decimation as usize;
    let run = Run { steps, gains: true, limits: &task.limits, watched: broken.watched() };
    let records = engine.0.step(&workers, blocks, run);
    broken.note(records);
    Ok(())
}

/// What physics reads and writes of robots.
type PhysicsColumns = (
    &'static mut BasePose,
    &'static mut BaseVelocity,
    &'static mut JointState,
    &'static mut JointTargets,
    &'static mut ActuatorDelay,
    &'static mut ActuatorMemory,
    &'static mut ExternalWrench,
    &'static mut JointEffort,
    &'static mut ConstraintImpulses,
    &'static mut ContactForces,
    &'static mut Feet,
);

/// The physics of one control step alone, for replays.
pub(crate) fn run_physics(world: &mut World) -> Result<(), Error> {
    faults::outcome(world.run_system_cached(upload_bodies))?;
    faults::outcome(world.run_system_cached(step_physics))
}
