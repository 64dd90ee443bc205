//! The world that robots stand in.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;

use super::terms::CompiledTask;
use super::{Setup, SetupSet};
use crate::morphology::{Morphologies, MorphologyModel};
use crate::world;

/// Adds Avian with the task's ground, terrain, obstacles and gravity.
#[derive(Default)]
pub struct WorldPlugin;

impl Plugin for WorldPlugin {
    fn build(&self, app: &mut App) {
        world::add_avian(app);
        app.add_systems(Setup, build_world.in_set(SetupSet::World));
    }
}

fn build_world(world: &mut World) -> Result {
    let config = world.resource::<CompiledTask>().config.clone();
    let legs: Vec<f64> = world.resource::<Morphologies>().0.iter().map(MorphologyModel::leg_length).collect();
    let ground = world::build(world, &config, &legs)?;
    world.insert_resource(ground);
    Ok(())
}
