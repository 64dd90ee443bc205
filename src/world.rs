//! The world that robots stand in: Avian's static colliders, materials and gravity.
//!
//! The articulated engine does not search for contacts among colliders inside a step. What it needs of them is baked once,
//! by Avian's own rays, into a [`Ground`].

use avian3d::prelude::{
    CoefficientCombine, Collider, Friction, Gravity, PhysicsPlugins, Position, Restitution, RigidBody, SpatialQuery,
    SpatialQueryFilter,
};
use bevy_app::{App, Plugin, PluginGroup};
use bevy_ecs::prelude::*;
use bevy_ecs::schedule::ScheduleLabel;
use bevy_ecs::system::SystemState;
use bevy_math::{Dir3, Vec3};
use bevy_time::Time;
use bevy_transform::components::GlobalTransform;

use crate::config::{FrictionCombine, GroundConfig, SceneConfig, TaskConfig};
use crate::dynamics::HeightGrid;
use crate::obstacles;

/// The world cannot be baked.
#[derive(Debug, thiserror::Error)]
pub enum WorldError {
    /// A ray found nothing to stand on.
    #[error("scene: no ground below the origin of the envs; add a ground to the task's [scene]")]
    NoGround,
    /// An obstacle has no shape.
    #[error("scene.obstacles[{0}]: no collider can be made of it; give it a volume, or a heightfield distinct heights")]
    NoShape(usize),
    /// The obstacles are too far apart for one grid.
    #[error(
        "scene: a grid of {0} x {1} heights would be needed for the obstacles; move them together, or raise \
         scene.grid_cell"
    )]
    TooLarge(usize, usize),
}

/// Runs Avian's pipeline: colliders become known to its rays.
#[derive(ScheduleLabel, Clone, Debug, PartialEq, Eq, Hash)]
struct UpdateWorld;

/// Marks the collider that robots stand on.
#[derive(Component, Clone, Copy, Debug, Default)]
pub struct GroundCollider;

/// Marks the colliders of an obstacle.
#[derive(Component, Clone, Copy, Debug)]
pub struct ObstacleCollider {
    /// Its place in the task's list.
    pub index: usize,
    /// Radius about its position that holds the collider, m.
    reach: f32,
}

/// Adds Avian with a task's ground, obstacles and gravity.
pub struct WorldPlugin {
    scene: SceneConfig,
    gravity: Vec3,
}

impl WorldPlugin {
    /// For a task.
    pub fn new(config: &TaskConfig) -> Self {
        let gravity = Vec3::from_array(config.sim.gravity.map(|x| x as f32));
        Self { scene: config.scene.clone(), gravity }
    }
}

impl Plugin for WorldPlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<bevy_ecs::reflect::AppTypeRegistry>();
        app.insert_resource(Time::<()>::default());
        app.add_plugins(PhysicsPlugins::new(UpdateWorld).build());
        app.insert_resource(Gravity(self.gravity));
        let ground = &self.scene.ground;
        app.world_mut().spawn((
            GroundCollider,
            RigidBody::Static,
            Collider::half_space(Vec3::Z),
            surface(ground),
            // a collider takes its scale from this component, and zero without it
            GlobalTransform::IDENTITY,
        ));
        for (index, obstacle) in self.scene.obstacles.iter().enumerate() {
            for part in obstacles::parts(obstacle) {
                app.world_mut().spawn((
                    ObstacleCollider { index, reach: part.reach },
                    RigidBody::Static,
                    part.collider,
                    part.position,
                    part.rotation,
                    surface(ground),
                    GlobalTransform::IDENTITY,
                ));
            }
        }
    }
}

/// Avian's material of the ground and of what stands on it.
fn surface(ground: &GroundConfig) -> (Friction, Restitution) {
    let combine_rule = match ground.friction_combine {
        FrictionCombine::Multiply => CoefficientCombine::Multiply,
        FrictionCombine::Average => CoefficientCombine::Average,
        FrictionCombine::Min => CoefficientCombine::Min,
        FrictionCombine::Max => CoefficientCombine::Max,
    };
    let friction = Friction {
        static_coefficient: ground.static_friction as f32,
        dynamic_coefficient: ground.dynamic_friction as f32,
        combine_rule,
    };
    (friction, Restitution::new(ground.restitution as f32))
}

/// What the articulated engine knows of the world.
#[derive(Resource, Clone, Debug)]
pub struct Ground {
    /// Height of the plane, m.
    pub height: f64,
    /// m/s^2, world axes.
    pub gravity: [f64; 3],
    /// Heights where obstacles stand, the same in every env.
    pub terrain: Option<HeightGrid>,
    friction: Friction,
    restitution: Restitution,
}

impl Ground {
    /// Static and dynamic friction of a robot's surface on the ground, by the ground's combine rule.
    pub fn friction_with(&self, of_robot: [f32; 2]) -> [f32; 2] {
        let ground = [self.friction.static_coefficient, self.friction.dynamic_coefficient];
        [0, 1].map(|i| {
            let (a, b) = (ground[i], of_robot[i]);
            match self.friction.combine_rule {
                CoefficientCombine::Average => 0.5 * (a + b),
                CoefficientCombine::GeometricMean => (a * b).sqrt(),
                CoefficientCombine::Min => a.min(b),
                CoefficientCombine::Multiply => a * b,
                CoefficientCombine::Max => a.max(b),
            }
        })
    }

    /// Restitution of a robot's surface on the ground: the product.
    pub fn restitution_with(&self, of_robot: f32) -> f32 {
        self.restitution.coefficient * of_robot
    }
}

/// Height from which rays look for the ground, m.
const RAY_START: f32 = 100.0;

/// Points that a grid may have.
const MOST_POINTS: usize = 16_000_000;

/// Reads ground, obstacles and gravity from Avian's world, once the app's plugins are finished.
///
/// # Errors
/// There is no ground, an obstacle has no shape, or the obstacles are too far apart for one grid.
pub fn bake_ground(world: &mut World, scene: &SceneConfig) -> Result<Ground, WorldError> {
    world.run_schedule(UpdateWorld);
    let obstacles: Vec<(Entity, ObstacleCollider, Vec3)> =
        world.query::<(Entity, &ObstacleCollider, &Position)>().iter(world).map(|(e, o, p)| (e, *o, p.0)).collect();
    if let Some(index) = (0..scene.obstacles.len()).find(|i| obstacles.iter().all(|(_, o, _)| o.index != *i)) {
        return Err(WorldError::NoShape(index));
    }
    let mut rays: SystemState<SpatialQuery> = SystemState::new(world);
    let query = rays.get(world).map_err(|_| WorldError::NoGround)?;
    let bare = SpatialQueryFilter::from_excluded_entities(obstacles.iter().map(|(entity, ..)| *entity));
    let (hit, height) = below(&query, [0.0; 2], &bare).ok_or(WorldError::NoGround)?;
    let terrain = bake_terrain(&query, &obstacles, scene.grid_cell as f32, height)?;
    let (friction, restitution) = world
        .query::<(&Friction, &Restitution)>()
        .get(world, hit)
        .map(|(friction, restitution)| (*friction, *restitution))
        .map_err(|_| WorldError::NoGround)?;
    Ok(Ground {
        height: f64::from(height),
        gravity: world.resource::<Gravity>().0.to_array().map(f64::from),
        terrain,
        friction,
        restitution,
    })
}

/// The highest collider at a place, and its height, m.
pub fn below(query: &SpatialQuery, [x, y]: [f32; 2], filter: &SpatialQueryFilter) -> Option<(Entity, f32)> {
    let hit = query.cast_ray(Vec3::new(x, y, RAY_START), Dir3::NEG_Z, 2.0 * RAY_START, true, filter)?;
    Some((hit.entity, RAY_START - hit.distance))
}

/// A ray for every point of a grid that the obstacles lie on.
fn bake_terrain(
    query: &SpatialQuery,
    obstacles: &[(Entity, ObstacleCollider, Vec3)],
    cell: f32,
    ground: f32,
) -> Result<Option<HeightGrid>, WorldError> {
    if obstacles.is_empty() {
        return Ok(None);
    }
    // at its edge the grid is as high as the ground
    let side = |axis: usize| {
        let low = obstacles.iter().map(|(_, o, at)| at[axis] - o.reach).fold(f32::MAX, f32::min) - 2.0 * cell;
        let high = obstacles.iter().map(|(_, o, at)| at[axis] + o.reach).fold(f32::MIN, f32::max) + 2.0 * cell;
        // a point at zero keeps the grid where it is when obstacles are added
        let first = (low / cell).floor();
        (first * cell, ((high / cell).ceil() - first) as usize + 1)
    };
    let ((x, rows), (y, columns)) = (side(0), side(1));
    if rows.saturating_mul(columns) > MOST_POINTS {
        return Err(WorldError::TooLarge(rows, columns));
    }
    let all = SpatialQueryFilter::default();
    let heights: Vec<f32> = (0..rows * columns)
        .map(|k| [x + (k / columns) as f32 * cell, y + (k % columns) as f32 * cell])
        .map(|place| below(query, place, &all).map_or(ground, |(_, height)| height))
        .collect();
    let highest = heights.iter().copied().fold(ground, f32::max);
    Ok(Some(HeightGrid { origin: [x, y], cell, size: [rows, columns], heights, highest }))
}
