//! One of Avian's worlds: robots of one morphology as rigid bodies on a plane.
//!
//! Robots touch the ground, obstacles and themselves only. Every robot is in the frame of its env,
//! at the same place as all others. There is no broad phase: each collider forms a permanent pair
//! with the ground, with each part of an obstacle, and with each other collider of the robot that
//! it may meet. A robot's motion depends neither on the other robots of its world nor on its
//! earlier contacts.

use std::time::Duration;

use avian3d::collision::collider::EnlargedAabb;
use avian3d::collision::contact_types::ContactId;
use avian3d::collision::narrow_phase::ContactStatusChangeQueue;
use avian3d::dynamics::integrator::IntegrationSystems;
use avian3d::dynamics::joints::joint_graph::{JointGraph, JointGraphChange, JointGraphPlugin};
use avian3d::dynamics::rigid_body::body_size_metrics::BodySizeMetricsPlugin;
use avian3d::dynamics::solver::constraint_graph::ConstraintGraph;
use avian3d::dynamics::solver::contact::ContactConstraint;
use avian3d::dynamics::solver::schedule::SubstepSolverSystems;
use avian3d::dynamics::solver::solver_body::{SolverBodies, SolverBodyIndex};
use avian3d::prelude::*;
use bevy_app::{App, PluginGroup};
use bevy_ecs::prelude::*;
use bevy_ecs::query::ArchetypeFilter;
use bevy_ecs::schedule::ScheduleLabel;
use bevy_math::{Mat3, Quat, Vec2, Vec3};
use bevy_time::Time;
use bevy_transform::components::GlobalTransform;

use super::joints::{Joints, LinkMass, LinkPose};
use super::shapes::LinkCollider;
use crate::dynamics::Plane;
use crate::obstacles::Part;

/// Colliders nearer to the ground than this are looked at even when they stand still, m.
const CONTACT_TOLERANCE: f32 = 0.002;
/// Half edge of a box that holds all that can be, m: every collider may touch the ground.
const EVERYWHERE: f32 = 1e30;

/// Schedule of the systems that Avian runs before a step. The engine never runs it: it sets that
/// data itself.
#[derive(ScheduleLabel, Clone, Debug, PartialEq, Eq, Hash)]
struct Unused;

/// The body that carries a collider, and the collider's frame in the body's.
#[derive(Component)]
struct Attached {
    body: Entity,
    translation: Vec3,
    rotation: Quat,
}

/// Whether the next substep is the first one of its physics step.
#[derive(Resource, Default)]
struct FirstSubstep(bool);

/// Impulses of the contact constraints on their robots, in the order of the constraint graph.
#[derive(Resource, Default)]
struct Impulses {
    /// Impulses over the physics step, N s.
    sum: Vec<Vec3>,
    /// Impulses in the last substep, N s.
    last: Vec<Vec3>,
}

/// Entities of a world, robot after robot.
pub(super) struct Bodies {
    pub(super) links: Vec<Entity>,
    pub(super) colliders: Vec<Entity>,
    /// Number of partners of each collider: the ground and the obstacles' parts.
    pub(super) statics: usize,
}

/// Contents of a world.
pub(super) struct Contents<'a> {
    pub(super) robots: usize,
    /// Links of each robot.
    pub(super) links: usize,
    /// Whether bases move.
    pub(super) floating: bool,
    /// Colliders of each robot.
    pub(super) colliders: &'a [LinkCollider],
    /// Colliders of a robot that touch each other.
    pub(super) self_pairs: &'a [[usize; 2]],
    pub(super) ground: Option<Plane>,
    /// Parts of obstacles.
    pub(super) statics: &'a [Part],
}

/// A world with these contents; all poses and masses are still to be set. `None` when Avian keeps
/// the links in another order than they were made in.
pub(super) fn build(contents: Contents, gravity: [f64; 3], substeps: usize) -> Option<(World, Bodies)> {
    let mut app = App::empty();
    app.init_resource::<bevy_ecs::reflect::AppTypeRegistry>();
    app.insert_resource(Time::<()>::default());
    let plugins = PhysicsPlugins::new(Unused)
        .build()
        .disable::<CcdPlugin>()
        .disable::<BodySizeMetricsPlugin<Collider>>()
        .disable::<IslandPlugin>()
        .disable::<IslandSleepingPlugin>()
        .disable::<JointPlugin>()
        .disable::<JointGraphPlugin<FixedJoint>>()
        .disable::<JointGraphPlugin<RevoluteJoint>>()
        .disable::<JointGraphPlugin<PrismaticJoint>>()
        .disable::<JointGraphPlugin<DistanceJoint>>()
        .disable::<JointGraphPlugin<SphericalJoint>>()
        .disable::<ForcePlugin>()
        .disable::<MassPropertyPlugin>()
        .disable::<ColliderTransformPlugin>()
        .disable::<ColliderTreePlugin<Collider>>()
        .disable::<BroadPhaseCorePlugin>()
        .disable::<BvhBroadPhasePlugin>()
        .disable::<SpatialQueryPlugin>()
        .disable::<PhysicsTransformPlugin>()
        .disable::<PhysicsInterpolationPlugin>();
    app.add_plugins(plugins);
    app.insert_resource(Gravity(Vec3::from_array(gravity.map(|x| x as f32))));
    app.insert_resource(SubstepCount(u32::try_from(substeps).unwrap_or(u32::MAX)));
    // contacts are found again in every step: a robot's motion depends on its state alone
    let config = NarrowPhaseConfig::default();
    app.insert_resource(NarrowPhaseConfig { contact_tolerance: CONTACT_TOLERANCE, recycle_distance: 0.0, ..config });
    app.init_resource::<JointGraph>();
    app.add_message::<JointGraphChange>();
    app.init_resource::<Joints>();
    app.init_resource::<Impulses>();
    app.init_resource::<Tangents>();
    app.init_resource::<FirstSubstep>();
    app.add_systems(
        PhysicsSchedule,
        (
            place_colliders.in_set(PhysicsStepSystems::First).ambiguous_with_all(),
            order_contacts
                .after(PhysicsStepSystems::NarrowPhase)
                .before(PhysicsStepSystems::Solver)
                .ambiguous_with_all(),
            prepare_joints.in_set(SolverSystems::PrepareJoints).ambiguous_with_all(),
            reclose_joints.in_set(SolverSystems::PostSubstep).ambiguous_with_all(),
            keep_tangents.in_set(PhysicsStepSystems::Finalize).ambiguous_with_all(),
            finish_joints.in_set(PhysicsStepSystems::Finalize).ambiguous_with_all(),
        ),
    );
    app.add_systems(
        SubstepSchedule,
        (
            begin_joints
                .after(IntegrationSystems::Velocity)
                .before(SubstepSolverSystems::WarmStart)
                .ambiguous_with_all(),
            solve_joints
                .after(SubstepSolverSystems::WarmStart)
                .before(SubstepSolverSystems::SolveConstraints)
                .ambiguous_with_all(),
            close_joints
                .after(SubstepSolverSystems::SolveConstraints)
                .before(IntegrationSystems::Position)
                .ambiguous_with_all(),
            relax_joints.after(IntegrationSystems::Position).before(SubstepSolverSystems::Relax).ambiguous_with_all(),
            sum_impulses.after(SubstepSolverSystems::Relax).before(SubstepSolverSystems::Damping).ambiguous_with_all(),
        ),
    );
    app.finish();
    app.cleanup();
    let mut world = std::mem::take(app.world_mut());
    let bodies = spawn(&mut world, contents);
    let mut order = world.query_filtered::<Entity, With<SolverBodyIndex>>();
    let in_order = order.iter(&world).eq(bodies.links.iter().copied())
        && world.get_resource::<SolverBodies>().is_some_and(|all| all.entities() == bodies.links);
    in_order.then_some((world, bodies))
}

fn spawn(world: &mut World, contents: Contents) -> Bodies {
    let Contents { robots, links, floating, colliders, self_pairs, ground, statics } = contents;
    let everywhere = || EnlargedAabb::new(ColliderAabb::new(Vec3::ZERO, Vec3::splat(EVERYWHERE)));
    let plane = ground.map(|plane| {
        let normal = Vec3::from_array(plane.normal.map(|x| x as f32));
        (Collider::half_space(normal), Position(normal * plane.offset as f32), Rotation::IDENTITY)
    });
    let parts = statics.iter().map(|part| (part.collider.clone(), part.position, part.rotation));
    let statics: Vec<(Entity, Entity)> = plane
        .into_iter()
        .chain(parts)
        .map(|(collider, position, rotation)| {
            let body = world.spawn((RigidBody::Static, position, rotation)).id();
            let of = ColliderOf { body };
            let place = (GlobalTransform::IDENTITY, everywhere(), position, rotation);
            (body, world.spawn((collider, of, place, surface(1.0, 1.0))).id())
        })
        .collect();
    let mut bodies = Bodies { links: Vec::new(), colliders: Vec::new(), statics: statics.len() };
    for _ in 0..robots {
        let first = bodies.links.len();
        for link in 0..links {
            let body = if link == 0 && !floating { RigidBody::Kinematic } else { RigidBody::Dynamic };
            let entity = world.spawn((
                body,
                Position(Vec3::ZERO),
                Rotation::IDENTITY,
                LinearVelocity::ZERO,
                AngularVelocity::ZERO,
                ComputedMass::INFINITY,
                ComputedAngularInertia::INFINITY,
                ComputedCenterOfMass::default(),
                // a foot that comes down fast is met before it is in the ground
                SpeculativeCcd::MAX,
            ));
            bodies.links.push(entity.id());
        }
        for c in colliders {
            let body = bodies.links[first + c.link];
            let mut collider = world.spawn((
                c.collider.clone(),
                // a collider takes its scale from this component, and zero without it
                GlobalTransform::IDENTITY,
                ColliderOf { body },
                everywhere(),
                Position(c.translation),
                Rotation(c.rotation),
                robot_surface(1.0, 0.0),
                Attached { body, translation: c.translation, rotation: c.rotation },
            ));
            if c.margin > 0.0 {
                collider.insert(CollisionMargin(c.margin));
            }
            bodies.colliders.push(collider.id());
        }
    }
    world.flush();
    if let Some(mut graph) = world.get_resource_mut::<ContactGraph>() {
        let mut add = |[first, second]: [(Entity, Entity); 2]| {
            let ((body1, collider1), (body2, collider2)) = (first, second);
            let mut edge = ContactEdge::new(collider1, collider2);
            (edge.body1, edge.body2) = (Some(body1), Some(body2));
            graph.add_edge_with(edge, |pair| {
                (pair.body1, pair.body2) = (Some(body1), Some(body2));
                pair.flags.insert(ContactPairFlags::GENERATE_CONSTRAINTS);
            });
        };
        for robot in 0..robots {
            let part = |i: usize| {
                (bodies.links[robot * links + colliders[i].link], bodies.colliders[robot * colliders.len() + i])
            };
            for i in 0..colliders.len() {
                statics.iter().for_each(|&of_world| add([part(i), of_world]));
            }
            self_pairs.iter().for_each(|pair| add(pair.map(part)));
        }
    }
    bodies
}

/// Friction and restitution coefficients that multiply.
pub(super) fn surface(friction: f32, restitution: f32) -> (Friction, Restitution) {
    let rule = CoefficientCombine::Multiply;
    (
        Friction { static_coefficient: friction, dynamic_coefficient: friction, combine_rule: rule },
        Restitution { coefficient: restitution, combine_rule: rule },
    )
}

/// Surface of a robot: its coefficients are combined with those of the ground, and count as they
/// are among its own links.
pub(super) fn robot_surface(friction: f32, restitution: f32) -> (Friction, Restitution) {
    let (friction, restitution) = surface(friction, restitution);
    let combine_rule = CoefficientCombine::GeometricMean;
    (Friction { combine_rule, ..friction }, Restitution { combine_rule, ..restitution })
}

/// One physics step; its length in substeps is that of the joints.
pub(super) fn step(world: &mut World, dt: Duration, h: Duration) {
    world.resource_mut::<Time<Physics>>().advance_by(dt);
    world.resource_mut::<Time<Substeps>>().advance_by(h);
    *world.resource_mut::<Time>() = world.resource::<Time<Physics>>().as_generic();
    world.run_schedule(PhysicsSchedule);
}

/// Adds what touched in the last physics step to `add(pair, impulse on its first body, its part
/// along the contact's normal)`. Pairs count robot after robot: collider after collider with all
/// that stands still, then the colliders that may touch each other.
pub(super) fn contact_impulses(world: &World, mut add: impl FnMut(usize, Vec3, f32)) {
    let (Some(constraints), Some(contacts), Some(impulses)) = (
        world.get_resource::<ConstraintGraph>(),
        world.get_resource::<ContactGraph>(),
        world.get_resource::<Impulses>(),
    ) else {
        return;
    };
    for (i, constraint) in all_constraints(constraints).enumerate() {
        let (Some(sum), Some(last), Some(pair)) =
            (impulses.sum.get(i), impulses.last.get(i), pair_index(contacts, constraint.contact_id))
        else {
            continue;
        };
        // restitution comes after the last substep
        let whole = *sum + impulse(constraint) - *last;
        add(pair, whole, whole.dot(constraint.normal).abs());
    }
}

/// Clears the memory of contacts of some pairs.
pub(super) fn forget_contacts(world: &mut World, pairs: std::ops::Range<usize>) {
    let Some(mut graph) = world.get_resource_mut::<ContactGraph>() else {
        return;
    };
    for pair in graph.active_pairs_mut().get_mut(pairs).unwrap_or_default() {
        for point in pair.manifolds.iter_mut().flat_map(|manifold| &mut manifold.points) {
            point.warm_start_normal_impulse = 0.0;
            point.warm_start_tangent_impulse = Vec2::ZERO;
        }
    }
}

/// Pairs are never removed: their place is the order they were made in.
fn pair_index(contacts: &ContactGraph, id: ContactId) -> Option<usize> {
    contacts.get_edge_by_id(id).map(|edge| edge.pair_index)
}

fn all_constraints(graph: &ConstraintGraph) -> impl Iterator<Item = &ContactConstraint> {
    graph.colors.iter().flat_map(|color| &color.contact_constraints)
}

/// Impulse on the first body of a pair in the last substep.
fn impulse(constraint: &ContactConstraint) -> Vec3 {
    let tangents = constraint.tangent_directions();
    let on_ground = constraint.points.iter().map(|point| {
        let along = point.tangent_part.as_ref().map_or(Vec2::ZERO, |part| part.impulse);
        constraint.normal * point.normal_part.impulse + tangents[0] * along.x + tangents[1] * along.y
    });
    -on_ground.fold(Vec3::ZERO, |sum, p| sum + p)
}

fn place_colliders(
    mut colliders: Query<(&Attached, &mut Position, &mut Rotation), Without<RigidBody>>,
    bodies: Query<(&Position, &Rotation), With<RigidBody>>,
) {
    for (attached, mut position, mut rotation) in &mut colliders {
        if let Ok((at, turned)) = bodies.get(attached.body) {
            position.0 = at.0 + turned.0 * attached.translation;
            rotation.0 = (turned.0 * attached.rotation).normalize();
        }
    }
}

/// Tangents of each pair's contacts in the last physics step, in the order of the pairs.
#[derive(Resource, Default)]
pub(super) struct Tangents(pub(super) Vec<[Vec3; 2]>);

/// Tells the solver which contacts there are, after they were set from outside.
pub(super) fn push_contacts(world: &mut World) {
    world.resource_scope(|world, mut constraints: Mut<ConstraintGraph>| {
        let Some(mut contacts) = world.get_resource_mut::<ContactGraph>() else {
            return;
        };
        constraints.clear();
        let all: Vec<ContactId> = contacts.active_pairs().iter().map(|pair| pair.contact_id).collect();
        for id in all {
            if let Some((_, pair)) = contacts.get_mut_by_id(id) {
                for _ in 0..pair.manifolds.len() {
                    constraints.push_manifold(pair);
                }
            }
        }
    });
}

/// Solves contacts in an order that depends on nothing but which there are, and warm-starts
/// friction with the impulses of the last step.
///
/// Avian keeps them along tangents that it chooses again in every step, by the direction of a
/// velocity that is all but zero for feet that stand, and would apply them in another direction.
fn order_contacts(
    mut constraints: ResMut<ConstraintGraph>,
    mut contacts: ResMut<ContactGraph>,
    mut changes: ResMut<ContactStatusChangeQueue>,
    tangents: Res<Tangents>,
    velocities: Query<&LinearVelocity>,
) {
    constraints.clear();
    changes.0.clear();
    let touching: Vec<ContactId> = contacts.iter_active_touching().map(|pair| pair.contact_id).collect();
    for id in touching {
        if let Some((edge, pair)) = contacts.get_mut_by_id(id) {
            let of = |body: Option<Entity>| body.and_then(|body| velocities.get(body).ok()).map_or(Vec3::ZERO, |v| v.0);
            let velocity = of(pair.body1) - of(pair.body2);
            let [old, old_across] = tangents.0.get(edge.pair_index).copied().unwrap_or_default();
            for manifold in &mut pair.manifolds {
                let [new, new_across] = tangents_of(manifold.normal, velocity);
                for point in &mut manifold.points {
                    let impulse = point.warm_start_tangent_impulse;
                    let impulse = old * impulse.x + old_across * impulse.y;
                    point.warm_start_tangent_impulse = Vec2::new(impulse.dot(new), impulse.dot(new_across));
                }
            }
            for _ in 0..pair.manifolds.len() {
                constraints.push_manifold(pair);
            }
        }
    }
}

/// The tangents that Avian chooses for contacts of a body of this velocity relative to the other.
fn tangents_of(normal: Vec3, velocity: Vec3) -> [Vec3; 2] {
    let inward = -normal;
    let along = velocity - inward * inward.dot(velocity);
    let tangent = along.try_normalize().unwrap_or(inward.any_orthonormal_vector());
    [tangent, inward.cross(tangent)]
}

fn keep_tangents(mut tangents: ResMut<Tangents>, constraints: Res<ConstraintGraph>, contacts: Res<ContactGraph>) {
    tangents.0.resize(contacts.active_pairs().len(), [Vec3::ZERO; 2]);
    for constraint in all_constraints(&constraints) {
        if let Some(kept) = pair_index(&contacts, constraint.contact_id).and_then(|pair| tangents.0.get_mut(pair)) {
            *kept = constraint.tangent_directions();
        }
    }
}

fn prepare_joints(
    mut joints: ResMut<Joints>,
    mut impulses: ResMut<Impulses>,
    mut first: ResMut<FirstSubstep>,
    positions: Query<&'static Position, With<SolverBodyIndex>>,
    rotations: Query<&'static Rotation, With<SolverBodyIndex>>,
    bodies: Res<SolverBodies>,
) {
    first.0 = true;
    impulses.sum.clear();
    impulses.last.clear();
    joints.masses.clear();
    joints.masses.extend(bodies.inertias().iter().map(|inertia| {
        let i = inertia.effective_inv_angular_inertia();
        let inverse = Mat3::from_cols(
            Vec3::new(i.m00, i.m01, i.m02),
            Vec3::new(i.m01, i.m11, i.m12),
            Vec3::new(i.m02, i.m12, i.m22),
        );
        LinkMass { mass: 1.0 / inertia.effective_inv_mass().x, inertia: inverse.inverse() }
    }));
    let poses: Vec<LinkPose> = read_rows(&positions)
        .iter()
        .zip(read_rows(&rotations))
        .map(|(position, rotation)| LinkPose { position: position.0, rotation: rotation.0 })
        .collect();
    joints.prepare(&poses);
}

fn begin_joints(mut joints: ResMut<Joints>, mut first: ResMut<FirstSubstep>, mut bodies: ResMut<SolverBodies>) {
    let bodies = bodies.bodies_mut();
    joints.begin(bodies, first.0);
    joints.push(bodies);
    first.0 = false;
}

fn solve_joints(mut joints: ResMut<Joints>, mut bodies: ResMut<SolverBodies>) {
    joints.solve(bodies.bodies_mut(), true);
}

fn close_joints(mut joints: ResMut<Joints>, mut bodies: ResMut<SolverBodies>) {
    let bodies = bodies.bodies_mut();
    joints.solve(bodies, true);
    joints.advance(bodies);
}

fn relax_joints(mut joints: ResMut<Joints>, mut bodies: ResMut<SolverBodies>) {
    let bodies = bodies.bodies_mut();
    joints.solve(bodies, false);
    joints.add_efforts(bodies);
}

/// The joints hold in what is reported, too.
fn reclose_joints(mut joints: ResMut<Joints>, mut bodies: ResMut<SolverBodies>) {
    joints.solve(bodies.bodies_mut(), false);
}

fn sum_impulses(mut impulses: ResMut<Impulses>, constraints: Res<ConstraintGraph>) {
    let Impulses { sum, last } = &mut *impulses;
    last.clear();
    last.extend(all_constraints(&constraints).map(impulse));
    if sum.is_empty() {
        sum.extend(&*last);
    } else {
        sum.iter_mut().zip(&*last).for_each(|(sum, p)| *sum += *p);
    }
}

fn finish_joints(
    mut joints: ResMut<Joints>,
    rotations: Query<&'static Rotation, With<SolverBodyIndex>>,
    velocities: Query<&'static AngularVelocity, With<SolverBodyIndex>>,
) {
    let rotations: Vec<Quat> = read_rows(&rotations).iter().map(|rotation| rotation.0).collect();
    let velocities: Vec<Vec3> = read_rows(&velocities).iter().map(|velocity| velocity.0).collect();
    joints.finish(&rotations, &velocities);
}

impl Joints {
    /// Sets the lengths of a physics step and of its substeps.
    pub(super) fn set_step(&mut self, h: Duration, substeps: usize) {
        self.h = h.as_secs_f32();
        self.substeps = substeps;
    }
}

/// One component of all entities that a query matches, which lie in one table in the order in which
/// they were made.
fn read_rows<'w, C: Component, F: ArchetypeFilter>(query: &'w Query<'_, '_, &'static C, F>) -> &'w [C] {
    query.contiguous_iter().ok().and_then(|mut tables| tables.next()).unwrap_or_default()
}
