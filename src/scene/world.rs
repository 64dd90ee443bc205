//! The world that robots stand in: Avian's static colliders, materials and gravity.
//!
//! The articulated engine does not search for contacts among colliders inside a step. A [`Ground`]
//! holds what it needs of them, baked once by Avian's own rays.

use std::sync::Arc;
use std::time::Duration;

use avian3d::collider_tree::ColliderTreeOptimization;
use avian3d::prelude::{
    ActiveCollisionHooks, CoefficientCombine, Collider, ColliderOf, CollisionHooks, Friction, Gravity, PhysicsPlugins,
    Position, Restitution, RigidBody, SimpleCollider, SpatialQuery, SpatialQueryFilter,
};
use bevy_app::{App, PluginGroup};
use bevy_ecs::prelude::*;
use bevy_ecs::schedule::ScheduleLabel;
use bevy_ecs::system::{SystemParam, SystemState};
use bevy_math::{Dir3, Vec3};
use bevy_tasks::{ComputeTaskPool, TaskPoolBuilder};
use bevy_time::Time;
use bevy_transform::components::GlobalTransform;

use crate::components::{EnvId, EnvOrigin};
use crate::config::{FrictionCombine, GroundConfig, SceneConfig, TaskConfig, TerrainConfig};
use crate::dynamics::HeightGrid;
use crate::error::Error;
use crate::obstacles;
use crate::terrain::{self, Mesh, TerrainLayout};

/// The world cannot be baked.
#[derive(Debug, thiserror::Error)]
enum WorldError {
    /// A ray found nothing to stand on.
    #[error("scene: no ground below the origin of the envs; add a ground to the task's [scene]")]
    NoGround,
    /// An obstacle has no shape.
    #[error("scene.obstacles[{0}]: no collider can be made of it; give it a volume, or a heightfield distinct heights")]
    NoShape(usize),
    /// A tile has no shape.
    #[error(
        "scene.terrain: no collider can be made of the tile in row {0}, column {1}; change its sub-terrain's numbers"
    )]
    NoTile(u32, u32),
    /// An obstacle has no part above the ground.
    #[error(
        "scene.obstacles[{0}]: all of it is below the ground, which covers it; raise it, or make pits with a heightfield"
    )]
    Buried(usize),
    /// The terrain is too large or the obstacles are too far apart for one grid.
    #[error(
        "scene: a grid of {0} x {1} heights would be needed for terrain and obstacles; make it smaller or move them \
         together, or raise scene.grid_cell"
    )]
    TooLarge(usize, usize),
}

impl From<WorldError> for Error {
    fn from(error: WorldError) -> Self {
        Self::Scene(error.to_string())
    }
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
    /// Place of the obstacle in the task's list.
    pub index: usize,
    /// Radius of the ball about the obstacle's position that holds the collider, m.
    reach: f32,
    /// Height of the collider's highest point, m.
    top: f32,
}

impl ObstacleCollider {
    /// Whether the collider, which is `at` its position, may be seen through an opening of the
    /// plane.
    fn reaches(&self, at: Vec3, [low, high]: &[[f64; 2]; 2]) -> bool {
        let place = [at.x, at.y].map(f64::from);
        let reach = f64::from(self.reach);
        (0..2).all(|axis| low[axis] <= place[axis] + reach && place[axis] - reach <= high[axis])
    }
}

/// Marks the colliders of generated terrain.
#[derive(Component, Clone, Copy, Debug, PartialEq, Eq)]
pub enum TerrainCollider {
    /// A tile.
    Tile {
        /// Level of difficulty.
        row: u32,
        /// Place along y.
        column: u32,
    },
    /// The flat border.
    Border,
}

/// Adds Avian to an app.
pub fn add_avian(app: &mut App) {
    app.init_resource::<bevy_ecs::reflect::AppTypeRegistry>();
    app.init_resource::<Time>();
    app.add_plugins(PhysicsPlugins::new(UpdateWorld).with_collision_hooks::<SameEnv>().build());
}

/// Spawns a task's ground and obstacles in Avian's world and sets its gravity, once the app's
/// plugins are finished. `legs` are the leg lengths of the task's robots, m, which scale terrain.
///
/// # Errors
/// There is no ground, a tile or an obstacle has no shape, or they need too large a grid.
pub fn build(world: &mut World, config: &TaskConfig, legs: &[f64]) -> Result<Ground, Error> {
    if config.physics.mirror_links {
        prepare(world);
    }
    world.insert_resource(Gravity(Vec3::from_array(config.sim.gravity.map(|x| x as f32))));
    let scene = &config.scene;
    let ground = &scene.ground;
    let layout = scene.terrain.as_ref().map(|terrain| TerrainLayout::for_robots(terrain, legs));
    if let (Some(terrain), Some(layout)) = (&scene.terrain, &layout) {
        for (tag, collider, position) in terrain_colliders(terrain, layout) {
            world.spawn((
                (tag, GroundCollider),
                RigidBody::Static,
                collider,
                position,
                surface(ground),
                GlobalTransform::IDENTITY,
            ));
        }
    } else {
        world.spawn((
            GroundCollider,
            RigidBody::Static,
            obstacles::floor(&scene.pits()).map_or_else(|| Collider::half_space(Vec3::Z), |part| part.collider),
            surface(ground),
            // a collider takes its scale from this component, and zero without it
            GlobalTransform::IDENTITY,
        ));
    }
    for (index, obstacle) in scene.obstacles.iter().enumerate() {
        for part in obstacles::parts(obstacle) {
            let top = part.collider.aabb(part.position.0, part.rotation, 0.0).max.z + FLUSH;
            world.spawn((
                ObstacleCollider { index, reach: part.reach, top },
                RigidBody::Static,
                part.collider,
                part.position,
                part.rotation,
                surface(ground),
                GlobalTransform::IDENTITY,
            ));
        }
    }
    Ok(bake_ground(world, scene, layout)?)
}

/// The tiles and the border; a tile of which no collider can be made is left out.
fn terrain_colliders(config: &TerrainConfig, layout: &TerrainLayout) -> Vec<(TerrainCollider, Collider, Position)> {
    let collider = |mesh: Mesh| {
        let vertices = mesh.vertices.into_iter().map(Vec3::from_array).collect();
        Collider::try_trimesh(vertices, mesh.triangles).ok()
    };
    let tiles = terrain::generate_in(config, layout).into_iter().filter_map(|tile| {
        let [x, y] = tile.origin;
        let tag = TerrainCollider::Tile { row: tile.row, column: tile.column };
        Some((tag, collider(tile.mesh)?, Position(Vec3::new(x, y, 0.0))))
    });
    let border =
        collider(terrain::border(config, layout)).map(|border| (TerrainCollider::Border, border, Position::default()));
    tiles.chain(border).collect()
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

/// The articulated engine's view of the world.
#[derive(Resource, Clone, Debug)]
pub struct Ground {
    /// Height of the plane, m.
    pub height: f64,
    /// Gravity, m/s^2, world axes.
    pub gravity: [f64; 3],
    /// Unit vector of [`gravity`](Self::gravity), world axes; zeros without gravity.
    pub down: [f32; 3],
    /// Heights where there is terrain or obstacles stand, in the frame in which envs have their
    /// [`EnvOrigin`].
    pub terrain: Option<Arc<HeightGrid>>,
    /// The tiles of generated terrain.
    pub layout: Option<TerrainLayout>,
    friction: Friction,
    restitution: Restitution,
    /// Coefficients of torsional and rolling friction, m. Avian knows neither.
    spin_friction: [f32; 2],
}

impl Ground {
    /// Acceleration of free fall, m/s^2.
    pub fn free_fall(&self) -> f32 {
        length(&self.gravity) as f32
    }

    /// Height below a place about an env's origin, m.
    #[inline(always)]
    pub fn height_at(&self, origin: &EnvOrigin, place: [f32; 2]) -> f32 {
        let mut height = [0.0];
        self.heights_at(origin, std::iter::once(place), &mut height);
        height[0]
    }

    /// Heights below places about an env's origin, m, as many as there is room for.
    #[inline(always)]
    pub fn heights_at(&self, origin: &EnvOrigin, places: impl Iterator<Item = [f32; 2]>, heights: &mut [f32]) {
        let [x0, y0] = origin.position;
        match &self.terrain {
            Some(grid) => grid.heights_at(places.map(|[x, y]| [x0 + x, y0 + y]), heights),
            None => heights.fill(self.height as f32),
        }
    }

    /// Rows in the order of their tiles: those on the same tile in turn, which finds its heights in
    /// the cache. `None` on ground without tiles.
    pub(crate) fn order_of_tiles(&self, origins: &[EnvOrigin]) -> Option<Vec<u32>> {
        self.layout.as_ref()?;
        let tile = |origin: &EnvOrigin| u64::from(origin.terrain_level) << 16 | u64::from(origin.terrain_column);
        let mut order: Vec<u64> = (0..).zip(origins).map(|(row, origin)| tile(origin) << 32 | row).collect();
        order.sort_unstable();
        Some(order.into_iter().map(|row| row as u32).collect())
    }

    /// The ground's own friction, static, dynamic, torsional and rolling, and the rule that
    /// combines the first two with a robot's.
    pub(crate) fn own_friction(&self) -> ([f32; 4], CoefficientCombine) {
        let Friction { static_coefficient, dynamic_coefficient, combine_rule } = self.friction;
        let [torsional, rolling] = self.spin_friction;
        ([static_coefficient, dynamic_coefficient, torsional, rolling], combine_rule)
    }

    /// Static and dynamic friction of a robot's surface on the ground, by the ground's combine
    /// rule.
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

    /// Coefficients of torsional and rolling friction of a robot's surface on the ground, m: the
    /// larger of the two surfaces', as MuJoCo combines them.
    pub fn spin_friction_with(&self, of_robot: [f32; 2]) -> [f32; 2] {
        [0, 1].map(|i| self.spin_friction[i].max(of_robot[i]))
    }

    /// Restitution of a robot's surface on the ground: the product.
    pub fn restitution_with(&self, of_robot: f32) -> f32 {
        self.restitution.coefficient * of_robot
    }
}

/// Steps what lives in Avian's world by `seconds`.
pub(crate) fn step_world(world: &mut World, seconds: f64) {
    let Ok(step) = Duration::try_from_secs_f64(seconds) else {
        return;
    };
    // Avian reads the step off the clock, which may be a host app's
    let clock = *world.resource::<Time>();
    world.resource_mut::<Time>().advance_by(step);
    world.run_schedule(UpdateWorld);
    world.insert_resource(clock);
}

/// An obstacle whose top is below the ground by no more than this is level with it, m.
const FLUSH: f32 = 1e-5;

/// Height from which rays look for the ground, m.
const RAY_START: f32 = 100.0;

/// Points that a grid may have, and that it may have along a side.
const MOST_POINTS: usize = 64_000_000;
const LONGEST_SIDE: usize = 4_000_000;

/// The ground of a task, without robots; `legs` are those of [`build`].
///
/// # Errors
/// As [`build`].
pub fn load(config: &TaskConfig, legs: &[f64]) -> Result<Ground, Error> {
    let mut app = App::empty();
    add_avian(&mut app);
    app.finish();
    app.cleanup();
    build(app.world_mut(), config, legs)
}

/// Reads ground, obstacles and gravity from Avian's world, once the app's plugins are finished.
///
/// # Errors
/// There is no ground, a tile or an obstacle has no shape, or they need too large a grid.
fn bake_ground(world: &mut World, scene: &SceneConfig, layout: Option<TerrainLayout>) -> Result<Ground, WorldError> {
    world.run_schedule(UpdateWorld);
    let obstacles: Vec<(Entity, ObstacleCollider, Vec3)> =
        world.query::<(Entity, &ObstacleCollider, &Position)>().iter(world).map(|(e, o, p)| (e, *o, p.0)).collect();
    if let Some(index) = (0..scene.obstacles.len()).find(|i| obstacles.iter().all(|(_, o, _)| o.index != *i)) {
        return Err(WorldError::NoShape(index));
    }
    let tiles: Vec<(Mesh, [f32; 2])> = world
        .query::<(&TerrainCollider, &Collider, &Position)>()
        .iter(world)
        // beyond the tiles the grid goes on as its edge: level, as the border is
        .filter(|(tag, ..)| **tag != TerrainCollider::Border)
        .filter_map(|(_, collider, position)| Some((Mesh::of_collider(collider)?, position.0.truncate().to_array())))
        .collect();
    if let Some(layout) = &layout {
        let tags: Vec<_> = world.query::<&TerrainCollider>().iter(world).copied().collect();
        let places = (0..layout.num_rows).flat_map(|row| (0..layout.num_cols).map(move |column| (row, column)));
        let missing = places
            .filter(|_| tags.len() <= (layout.num_rows * layout.num_cols) as usize)
            .find(|&(row, column)| !tags.contains(&TerrainCollider::Tile { row, column }));
        if let Some((row, column)) = missing {
            return Err(WorldError::NoTile(row, column));
        }
    }
    let mut rays: SystemState<SpatialQuery> = SystemState::new(world);
    let query = rays.get(world).map_err(|_| WorldError::NoGround)?;
    let bare = SpatialQueryFilter::from_excluded_entities(obstacles.iter().map(|(entity, ..)| *entity));
    // a plane that is open somewhere is not open at its corners
    let is_whole = scene.pits().is_empty();
    let place = if is_whole { [0.0; 2] } else { [-0.9 * obstacles::FLOOR; 2] };
    let (hit, height) = below(&query, place, &bare).ok_or(WorldError::NoGround)?;
    // triangles are at height 0: those of a plane with pits, and the border of terrain with what
    // lies beyond
    let height = if layout.is_none() && is_whole { height } else { 0.0 };
    let plane = layout.is_none().then_some((hit, height));
    if let Some((_, ground)) = plane {
        let is_seen = |index: usize| {
            let mut parts = obstacles.iter().filter(|(_, of, _)| of.index == index);
            parts.any(|(_, of, at)| of.top >= ground || scene.pits().iter().any(|pit| of.reaches(*at, pit)))
        };
        if let Some(index) = (0..scene.obstacles.len()).find(|index| !is_seen(*index)) {
            return Err(WorldError::Buried(index));
        }
    }
    let terrain = bake_terrain(&query, &tiles, &obstacles, scene.grid_cell as f32, height, plane)?;
    let (friction, restitution) = world
        .query::<(&Friction, &Restitution)>()
        .get(world, hit)
        .map(|(friction, restitution)| (*friction, *restitution))
        .map_err(|_| WorldError::NoGround)?;
    let gravity = world.resource::<Gravity>().0.to_array().map(f64::from);
    Ok(Ground {
        height: f64::from(height),
        gravity,
        down: direction(&gravity),
        terrain: terrain.map(Arc::new),
        layout,
        friction,
        restitution,
        spin_friction: [scene.ground.torsional_friction as f32, scene.ground.rolling_friction as f32],
    })
}

fn length(vector: &[f64; 3]) -> f64 {
    vector.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Unit vector along a vector; zeros for zeros.
fn direction(vector: &[f64; 3]) -> [f32; 3] {
    let length = length(vector);
    vector.map(|x| if length > 0.0 { (x / length) as f32 } else { 0.0 })
}

/// The highest collider at a place, and its height, m.
pub fn below(query: &SpatialQuery, [x, y]: [f32; 2], filter: &SpatialQueryFilter) -> Option<(Entity, f32)> {
    let hit = query.cast_ray(Vec3::new(x, y, RAY_START), Dir3::NEG_Z, 2.0 * RAY_START, true, filter)?;
    Some((hit.entity, RAY_START - hit.distance))
}

/// The heights of tiles, from the triangles of their colliders, and of obstacles, by rays. `plane`
/// are the plane and its exact height, if the ground is one.
fn bake_terrain(
    query: &SpatialQuery,
    tiles: &[(Mesh, [f32; 2])],
    obstacles: &[(Entity, ObstacleCollider, Vec3)],
    cell: f32,
    ground: f32,
    plane: Option<(Entity, f32)>,
) -> Result<Option<HeightGrid>, WorldError> {
    if tiles.is_empty() && obstacles.is_empty() {
        return Ok(None);
    }
    let around = |axis: usize| {
        let of_tiles =
            tiles.iter().flat_map(move |(mesh, origin)| mesh.vertices.iter().map(move |v| origin[axis] + v[axis]));
        let of_obstacles = obstacles.iter().flat_map(move |(_, o, at)| [at[axis] - o.reach, at[axis] + o.reach]);
        of_tiles.chain(of_obstacles).fold((f32::MAX, f32::MIN), |(low, high), x| (low.min(x), high.max(x)))
    };
    let side = |axis: usize| {
        let (low, high) = around(axis);
        // at its edge the grid is as high as the ground, and a point at zero keeps it where it is
        // when obstacles are added
        let first = (low / cell).floor() - 2.0;
        (first * cell, ((high / cell).ceil() - first) as usize + 3)
    };
    let ((x, rows), (y, columns)) = (side(0), side(1));
    if rows.saturating_mul(columns) > MOST_POINTS || rows.max(columns) > LONGEST_SIDE {
        return Err(WorldError::TooLarge(rows, columns));
    }
    let mut grid = HeightGrid::level([x, y], cell, [rows, columns], if tiles.is_empty() { ground } else { f32::MIN });
    for (mesh, origin) in tiles {
        mesh.rasterise(*origin, &mut grid);
    }
    // where no tile is
    grid.replace(f32::MIN, ground);
    let all = SpatialQueryFilter::default();
    for (_, obstacle, at) in obstacles {
        let span = |axis: usize| {
            let of = |x: f32| ((x - grid.origin[axis]) / cell).clamp(0.0, (grid.size[axis] - 1) as f32);
            of(at[axis] - obstacle.reach).floor() as usize..of(at[axis] + obstacle.reach).ceil() as usize + 1
        };
        let (rows, columns) = (span(0), span(1));
        for i in rows {
            for j in columns.clone() {
                let place = [x + i as f32 * cell, y + j as f32 * cell];
                if let Some((hit, height)) = below(query, place, &all) {
                    let exact = plane.filter(|(plane, _)| *plane == hit).map_or(height, |(_, exact)| exact);
                    grid.set_height(i, j, exact);
                }
            }
        }
    }
    grid.note_squares();
    Ok(Some(grid))
}

/// Lets colliders of different envs pass through each other.
#[derive(SystemParam)]
struct SameEnv<'w, 's> {
    envs: Query<'w, 's, &'static EnvId>,
    bodies: Query<'w, 's, &'static ColliderOf>,
}

impl SameEnv<'_, '_> {
    /// The env of a collider, or of the body that carries it.
    fn env(&self, collider: Entity) -> Option<EnvId> {
        let own = self.envs.get(collider).ok();
        own.or_else(|| self.envs.get(self.bodies.get(collider).ok()?.body).ok()).copied()
    }
}

impl CollisionHooks for SameEnv<'_, '_> {
    fn filter_pairs(&self, a: Entity, b: Entity, _: &mut Commands) -> bool {
        match (self.env(a), self.env(b)) {
            (Some(a), Some(b)) => a == b,
            _ => true,
        }
    }
}

/// Makes Avian's world one that is stepped and holds many envs; before anything is in it.
fn prepare(world: &mut World) {
    // Avian asks for a pool even where it does not use it
    ComputeTaskPool::get_or_init(|| TaskPoolBuilder::new().num_threads(1).build());
    world.resource_mut::<ColliderTreeOptimization>().use_compute_task = false;
    let hooks = world
        .try_register_required_components_with::<Collider, ActiveCollisionHooks>(|| ActiveCollisionHooks::FILTER_PAIRS);
    if let Err(error) = hooks {
        tracing::error!("envs are not kept apart in Avian's world: {error}");
    }
}
