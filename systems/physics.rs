//! Physics: makes the engine that the task names, and steps the robots with it.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;

use super::broken::{BrokenStates, describe_broken_states};
use super::load::InstructionSet;
use super::terms::CompiledTask;
use super::{ControlStep, PipelineSet, Setup, SetupSet, faults};
use crate::blocks::{BlockSizes, Blocks};
use crate::components::{Body, Env, EnvId, EnvOrigin, LinkForces, Robot};
use crate::engine::{Engine, EngineFactory, EngineSetup, Engines, RobotColumns, RobotSlices, Run};
use crate::error::Error;
use crate::morphology::Morphologies;
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
            (upload_bodies, step_physics, end_forces, describe_broken_states).chain().in_set(PipelineSet::Physics),
        );
    }
}

/// The engine that steps the robots of a simulation, by the name in its task.
#[derive(Resource)]
pub struct PhysicsEngine(pub(super) Box<dyn Engine>);

/// Adds an engine, in a plugin's `build`. Tasks name it in `physics.engine`.
pub fn add_engine(app: &mut App, name: &'static str, factory: impl EngineFactory) {
    app.world_mut().get_resource_or_init::<Engines>().add(name, factory);
}

fn make_engine(
    mut commands: Commands,
    engines: Res<Engines>,
    simd: Res<InstructionSet>,
    task: Res<CompiledTask>,
    morphologies: Res<Morphologies>,
    blocks: Res<BlockSizes>,
    ground: Res<Ground>,
    workers: Res<Workers>,
) -> Result {
    let setup = EngineSetup {
        task: &task.config,
        morphologies: &morphologies.0,
        blocks: &blocks,
        ground: &ground,
        simd: simd.0,
        workers: &workers,
    };
    let engine = engines.of(&task.config).map_err(Error::from)?.make(&setup)?;
    commands.insert_resource(PhysicsEngine(engine));
    commands.insert_resource(BrokenStates::new(blocks.0.len()));
    Ok(())
}

/// Lets the engine forget what it keeps of these envs beyond their components, which were set.
pub(crate) fn restart_engine(world: &mut World, envs: &[usize]) {
    if let Some(mut engine) = world.get_resource_mut::<PhysicsEngine>() {
        envs.iter().for_each(|&env| engine.0.restart(env));
    }
}

/// Engine state of each env beyond its components, as bytes.
pub(crate) fn save_engine(world: &World) -> Result<Vec<Vec<u8>>, Error> {
    let saved = world.get_resource::<PhysicsEngine>().map_or_else(|| Ok(Vec::new()), |engine| engine.0.save());
    saved.map_err(Error::Snapshot)
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
    mut robots: Blocks<RobotColumns, Robot>,
    envs: Blocks<&'static EnvOrigin, Env>,
) -> Result {
    let blocks =
        robots.write()?.zip(envs.read()?).map(|_, (robots, origins)| RobotSlices::new(robots, origins)).collect();
    let steps = task.config.sim.decimation as usize;
    let run = Run { steps, gains: true, limits: &task.limits, watched: broken.watched() };
    let records = engine.0.step(&workers, blocks, run);
    broken.note(records);
    Ok(())
}

/// Counts the control steps of the forces on links, and ends those that have acted long enough.
pub(super) fn end_forces(mut robots: Blocks<&'static mut LinkForces, Robot>) -> Result {
    // most steps have none: nothing is marked as changed then
    if robots.read()?.into_iter().all(|block| block.rows.iter().all(|forces| forces.0.is_empty())) {
        return Ok(());
    }
    for block in robots.write()? {
        for LinkForces(forces) in block.rows {
            if !forces.is_empty() {
                forces.iter_mut().for_each(|force| force.steps -= 1);
                forces.retain(|force| force.steps > 0);
            }
        }
    }
    Ok(())
}

/// The physics of one control step alone, for replays.
pub(crate) fn run_physics(world: &mut World) -> Result<(), Error> {
    faults::outcome(world.run_system_cached(upload_bodies))?;
    faults::outcome(world.run_system_cached(step_physics))
}
