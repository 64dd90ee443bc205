//! Links as kinematic bodies in Avian's world, with `physics.mirror_links`, for other bodies, rays
//! and events of that world.
//!
//! The engine moves the robots. Avian moves their mirrors along, from the old poses to the new
//! ones, while it steps its world once per control step. Its rays hit them and its bodies bounce
//! off them, but no robot feels that.
//!
//! Envs lie on a square grid in that world, [`LinkMirrors::origin`], `sim.env_spacing` apart, each
//! with its own copies of the obstacles. An entity with an [`EnvId`] touches nothing of another
//! env, wherever it is. An entity without one, such as the ground, touches all.

use std::ops::Range;

use avian3d::prelude::{
    AngularInertia, AngularVelocity, CenterOfMass, CoefficientCombine, Collider, CollisionLayers, Friction, LayerMask,
    LinearVelocity, Mass, NoAutoAngularInertia, NoAutoCenterOfMass, NoAutoMass, Position, Restitution, RigidBody,
    Rotation, SleepingDisabled,
};
use bevy_ecs::prelude::*;
use bevy_math::{Mat3, Quat, Vec3};
use bevy_transform::components::{GlobalTransform, Transform};
use glam::{DMat3, DQuat, DVec3};

use crate::components::{BasePose, BaseVelocity, EnvId, EnvOrigin, JointState, Morphology};
use crate::config::{MaterialConfig, Placement, TaskConfig};
use crate::dynamics::{Parameters, State, Topology, Workspace};
use crate::engine::avian::{forward, link_colliders};
use crate::morphology::{Morphologies, MorphologyModel};
use crate::world::ObstacleCollider;

/// Collision layer of mirrors: their memberships.
pub const LINK_LAYER: LayerMask = LayerMask(1 << 30);

/// Distance from its env's origin beyond which no mirror follows, m.
const FARTHEST: f64 = 1e5;

/// Marks the mirror of a link.
#[derive(Component, Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct LinkMirror {
    /// Link of its robot: 0 is the base, `j + 1` the link that joint `j` carries.
    pub link: u16,
}

/// Target pose and velocity of a link in Avian's world.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LinkMotion {
    /// Position of the link's URDF frame.
    pub(crate) position: Vec3,
    pub(crate) rotation: Quat,
    /// Velocity of the centre of mass, m/s.
    pub(crate) linear: Vec3,
    /// Angular velocity, world axes, rad/s.
    pub(crate) angular: Vec3,
}

/// The mirrors of one robot.
#[derive(Debug)]
pub(crate) struct MirroredRobot {
    pub(crate) parameters: Parameters<f64>,
    /// Place of the env on the grid of worlds, m; and its origin, which is there or on terrain that
    /// all share.
    place: [f32; 2],
    origin: [f32; 2],
    state: State<f64>,
    work: Workspace<f64>,
    /// Motions of the last finite state, `[links]`.
    pub(crate) motions: Vec<LinkMotion>,
}

/// The mirrors of all robots.
#[derive(Resource, Debug)]
pub struct LinkMirrors {
    pub(crate) robots: Vec<MirroredRobot>,
    /// Mirrors, `[env][link]`.
    entities: Vec<Vec<Entity>>,
}

impl LinkMirrors {
    /// Spawns the mirrors of all robots, `counts[m]` of morphology `m`, and every env's obstacles,
    /// without poses. The envs lie at the places of `envs` among `of` on the grid.
    pub(crate) fn spawn(
        world: &mut World,
        config: &TaskConfig,
        morphologies: &Morphologies,
        counts: &[usize],
        (envs, of): (Range<usize>, usize),
    ) {
        let num_envs = envs.len();
        // envs have separate origins on ground that all share
        let shared = config.scene.terrain.is_some() || config.scene.placement == Placement::Global;
        let places = grid(envs, of, if shared { 0.0 } else { config.sim.env_spacing as f32 });
        hide_links_from_scene(world);
        copy_obstacles(world, &places);
        let surface = surface(&config.robot_material);
        let (mut robots, mut entities) = (Vec::with_capacity(num_envs), Vec::with_capacity(num_envs));
        for (tag, (model, &count)) in morphologies.0.iter().zip(counts).enumerate() {
            let colliders = link_colliders(&model.model);
            let parameters = Parameters::from_scalars(&model.topology, &model.nominal);
            for _ in 0..count {
                let tags = (EnvId(robots.len() as u32), Morphology(tag as u16));
                let links = colliders.iter().enumerate();
                entities.push(
                    links
                        .map(|(link, collider)| {
                            spawn_link(world, tags, link, collider.clone(), surface, model, &parameters)
                        })
                        .collect(),
                );
                robots.push(MirroredRobot::new(&model.topology, parameters.clone(), places[robots.len()]));
            }
        }
        world.insert_resource(Self { robots, entities });
    }

    /// Origin of an env in Avian's world, m; `None` for an env that does not exist.
    pub fn origin(&self, env: EnvId) -> Option<Vec3> {
        self.robots.get(env.0 as usize).map(|robot| Vec3::new(robot.origin[0], robot.origin[1], 0.0))
    }

    /// The mirrors of a robot's links: the base, then the link of each joint. Empty for an env that
    /// does not exist.
    pub fn links(&self, env: EnvId) -> &[Entity] {
        self.entities.get(env.0 as usize).map_or(&[], Vec::as_slice)
    }
}

/// Origins of `envs` among `of`, row by row on a square grid that begins at the world's origin.
fn grid(envs: Range<usize>, of: usize, spacing: f32) -> Vec<[f32; 2]> {
    let side = (of as f64).sqrt().ceil().max(1.0) as usize;
    envs.map(|env| [(env % side) as f32 * spacing, (env / side) as f32 * spacing]).collect()
}

/// Leaves pairs of a mirror with something static out: the engine itself handles robots on the
/// ground.
fn hide_links_from_scene(world: &mut World) {
    let all: Vec<(Entity, RigidBody)> = world
        .query_filtered::<(Entity, &RigidBody), With<Collider>>()
        .iter(world)
        .map(|(e, body)| (e, *body))
        .collect();
    for (entity, _) in all.into_iter().filter(|(_, body)| body.is_static()) {
        world.entity_mut(entity).insert(CollisionLayers::new(LayerMask::DEFAULT, LayerMask::ALL & !LINK_LAYER));
    }
}

/// Copies the obstacles to every env but the first, whose origin is the world's.
fn copy_obstacles(world: &mut World, origins: &[[f32; 2]]) {
    if origins.iter().all(|origin| *origin == [0.0; 2]) {
        return;
    }
    type Parts = (
        Entity,
        &'static ObstacleCollider,
        &'static Collider,
        &'static Position,
        &'static Rotation,
        &'static Friction,
        &'static Restitution,
        &'static CollisionLayers,
    );
    let originals: Vec<_> = world
        .query::<Parts>()
        .iter(world)
        .map(|(e, tag, collider, at, turned, friction, restitution, layers)| {
            (e, (*tag, collider.clone(), *turned, *friction, *restitution, *layers), at.0)
        })
        .collect();
    for (entity, parts, at) in originals {
        world.entity_mut(entity).insert(EnvId(0));
        for (env, [x, y]) in origins.iter().enumerate().skip(1) {
            let position = Position(at + Vec3::new(*x, *y, 0.0));
            let whole = (EnvId(env as u32), RigidBody::Static, position, parts.clone());
            world.spawn((whole, GlobalTransform::IDENTITY));
        }
    }
}

fn surface(material: &MaterialConfig) -> (Friction, Restitution) {
    let friction = Friction {
        static_coefficient: material.static_friction as f32,
        dynamic_coefficient: material.dynamic_friction as f32,
        combine_rule: CoefficientCombine::Average,
    };
    (friction, Restitution::new(material.restitution as f32))
}

fn spawn_link(
    world: &mut World,
    tags: (EnvId, Morphology),
    link: usize,
    collider: Option<Collider>,
    surface: (Friction, Restitution),
    model: &MorphologyModel,
    parameters: &Parameters<f64>,
) -> Entity {
    let mut entity = world.spawn((
        (tags, LinkMirror { link: link as u16 }),
        RigidBody::Kinematic,
        (Position(Vec3::ZERO), Rotation::IDENTITY, LinearVelocity::ZERO, AngularVelocity::ZERO),
        mass_properties(parameters, &model.align[link], link),
        (NoAutoMass, NoAutoAngularInertia, NoAutoCenterOfMass, SleepingDisabled),
        // a collider takes its scale from the global transform, and zero without one
        (Transform::IDENTITY, GlobalTransform::IDENTITY),
    ));
    if let Some(collider) = collider {
        entity.insert((collider, surface, CollisionLayers::new(LINK_LAYER, LayerMask::ALL & !LINK_LAYER)));
    }
    entity.id()
}

/// Mass properties of a link, in its URDF frame.
pub(crate) fn mass_properties(p: &Parameters<f64>, align: &DMat3, link: usize) -> (Mass, CenterOfMass, AngularInertia) {
    let [xx, yy, zz, xy, xz, yz] = p.inertia[link];
    let inertia = DMat3::from_cols_array_2d(&[[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]);
    let own: Mat3 = (align.transpose() * inertia * *align).as_mat3();
    (
        Mass(p.mass[link] as f32),
        CenterOfMass((align.transpose() * DVec3::from_array(p.com[link])).as_vec3()),
        AngularInertia::from_mat3_unchecked(own),
    )
}

impl MirroredRobot {
    fn new(topology: &Topology, parameters: Parameters<f64>, place: [f32; 2]) -> Self {
        Self {
            parameters,
            place,
            origin: place,
            state: State::zeros(topology),
            work: Workspace::new(topology),
            motions: vec![LinkMotion::default(); topology.num_links()],
        }
    }

    /// Takes over the state of the robot. A state that is not finite leaves the motions as they
    /// are, and the links at rest.
    pub(crate) fn follow(
        &mut self,
        model: &MorphologyModel,
        origin: &EnvOrigin,
        pose: &BasePose,
        velocity: &BaseVelocity,
        joints: &JointState,
    ) {
        self.origin = [0, 1].map(|axis| self.place[axis] + origin.position[axis]);
        let [x, y] = self.origin;
        let state = &mut self.state;
        let wide = |to: &mut [f64], from: &[f32]| to.iter_mut().zip(from).for_each(|(x, y)| *x = f64::from(*y));
        wide(&mut state.position, &pose.position);
        wide(&mut state.rotation, &pose.rotation);
        wide(&mut state.linear_velocity, &velocity.linear);
        wide(&mut state.angular_velocity, &velocity.angular);
        wide(&mut state.joint_position, &joints.position);
        wide(&mut state.joint_velocity, &joints.velocity);
        let (topology, p) = (&model.topology, &self.parameters);
        let turned = forward(topology, p, state, &mut self.work);
        let origin = DVec3::from_array(state.position) + DVec3::new(x.into(), y.into(), 0.0);
        let links = self.work.links.iter().zip(&model.align).enumerate();
        let motions = links.map(|(link, (at, align))| {
            let own = DMat3::from_cols_array_2d(&at.rotation).transpose();
            let com = DVec3::from_array(at.position) + own * DVec3::from_array(p.com[link]);
            let spin = DVec3::from_array(at.velocity.ang);
            LinkMotion {
                position: (origin + turned * DVec3::from_array(at.position)).as_vec3(),
                rotation: DQuat::from_mat3(&(turned * own * *align)).normalize().as_quat(),
                linear: (turned * (DVec3::from_array(at.velocity.lin) + spin.cross(com))).as_vec3(),
                angular: (turned * spin).as_vec3(),
            }
        });
        let all_there = DVec3::from_array(state.position).length() < FARTHEST;
        let new: Vec<LinkMotion> = motions.collect();
        if all_there && new.iter().all(LinkMotion::is_finite) {
            self.motions = new;
        } else {
            self.motions.iter_mut().for_each(|motion| (motion.linear, motion.angular) = (Vec3::ZERO, Vec3::ZERO));
        }
    }
}

impl LinkMotion {
    fn is_finite(&self) -> bool {
        self.position.is_finite() && self.rotation.is_finite() && self.linear.is_finite() && self.angular.is_finite()
    }
}
