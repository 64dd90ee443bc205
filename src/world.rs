//! The world that robots stand in: Avian's static colliders, materials and gravity.
//!
//! The articulated engine does not search for contacts among colliders inside a step. What it needs of them is baked once,
//! by Avian's own rays, into a [`Ground`].

use avian3d::prelude::{
    CoefficientCombine, Collider, Friction, Gravity, PhysicsPlugins, Restitution, RigidBody, SpatialQuery,
    SpatialQueryFilter,
};
use bevy_app::{App, Plugin, PluginGroup};
use bevy_ecs::prelude::*;
use bevy_ecs::schedule::ScheduleLabel;
use bevy_ecs::system::SystemState;
use bevy_math::{Dir3, Vec3};
use bevy_time::Time;
use bevy_transform::components::GlobalTransform;

use crate::config::{FrictionCombine, GroundConfig, TaskConfig};

/// The world cannot be baked.
#[derive(Debug, thiserror::Error)]
pub enum WorldError {
    /// A ray found nothing to stand on.
    #[error("scene: no ground below the origin of the envs; add a ground to the task's [scene]")]
    NoGround,
}

/// Runs Avian's pipeline: colliders become known to its rays.
#[derive(ScheduleLabel, Clone, Debug, PartialEq, Eq, Hash)]
struct UpdateWorld;

/// Marks the collider that robots stand on.
#[derive(Component, Clone, Copy, Debug, Default)]
pub struct GroundCollider;

/// Adds Avian with a task's ground and gravity.
pub struct WorldPlugin {
    ground: GroundConfig,
    gravity: Vec3,
}

impl WorldPlugin {
    /// For a task.
    pub fn new(config: &TaskConfig) -> Self {
        let gravity = Vec3::from_array(config.sim.gravity.map(|x| x as f32));
        Self { ground: config.scene.ground.clone(), gravity }
    }
}

impl Plugin for WorldPlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<bevy_ecs::reflect::AppTypeRegistry>();
        app.insert_resource(Time::<()>::default());
        app.add_plugins(PhysicsPlugins::new(UpdateWorld).build());
        app.insert_resource(Gravity(self.gravity));
        let combine = match self.ground.friction_combine {
            FrictionCombine::Multiply => CoefficientCombine::Multiply,
            FrictionCombine::Average => CoefficientCombine::Average,
            FrictionCombine::Min => CoefficientCombine::Min,
            FrictionCombine::Max => CoefficientCombine::Max,
        };
        app.world_mut().spawn((
            GroundCollider,
            RigidBody::Static,
            Collider::half_space(Vec3::Z),
            Friction {
                static_coefficient: self.ground.static_friction as f32,
                dynamic_coefficient: self.ground.dynamic_friction as f32,
                combine_rule: combine,
            },
            Restitution::new(self.ground.restitution as f32),
            // a collider takes its scale from this component, and zero without it
            GlobalTransform::IDENTITY,
        ));
    }
}

/// What the articulated engine knows of the world.
#[derive(Resource, Clone, Debug)]
pub struct Ground {
    /// Height of the plane, m.
    pub height: f64,
    /// m/s^2, world axes.
    pub gravity: [f64; 3],
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

/// Reads ground and gravity from Avian's world, once the app's plugins are finished.
///
/// # Errors
/// There is no ground.
pub fn bake_ground(world: &mut World) -> Result<Ground, WorldError> {
    world.run_schedule(UpdateWorld);
    let mut rays: SystemState<SpatialQuery> = SystemState::new(world);
    let hit = rays
        .get(world)
        .ok()
        .and_then(|query| {
            let origin = Vec3::Z * RAY_START;
            query.cast_ray(origin, Dir3::NEG_Z, 2.0 * RAY_START, true, &SpatialQueryFilter::default())
        })
        .ok_or(WorldError::NoGround)?;
    let (friction, restitution) = world
        .query::<(&Friction, &Restitution)>()
        .get(world, hit.entity)
        .map(|(friction, restitution)| (*friction, *restitution))
        .map_err(|_| WorldError::NoGround)?;
    Ok(Ground {
        height: f64::from(RAY_START - hit.distance),
        gravity: world.resource::<Gravity>().0.to_array().map(f64::from),
        friction,
        restitution,
    })
}
