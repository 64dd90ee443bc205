//! Avian's world follows the robots, once per control step.
//!
//! Before Avian steps, each mirror gets the velocity that takes it from its old pose to the new one, so that what it meets on
//! the way is pushed as by a moving body; afterwards it gets the link's own velocity. A robot that begins a new episode is
//! put where it is, and meets nothing on the way.

use avian3d::collider_tree::update_moved_collider_aabbs;
use avian3d::prelude::{
    AngularInertia, AngularVelocity, CenterOfMass, Collider, LinearVelocity, Mass, Position, Rotation,
};
use bevy_ecs::message::message_update_system;
use bevy_ecs::prelude::*;
use bevy_math::{Quat, Vec3};
use bevy_transform::components::Transform;

use super::terms::CompiledTask;
use crate::components::{BasePose, BaseVelocity, Body, EnvId, EnvOrigin, Episode, JointState, Morphology, Robot};
use crate::dynamics::Parameters;
use crate::mirrors::{LinkMirror, LinkMirrors, LinkMotion, mass_properties};
use crate::morphology::Morphologies;
use crate::rows::{Workers, read_rows};
use crate::world::step_world;

/// What moves of a mirror.
type Moving = (
    &'static EnvId,
    &'static LinkMirror,
    &'static CenterOfMass,
    &'static mut Position,
    &'static mut Rotation,
    &'static mut LinearVelocity,
    &'static mut AngularVelocity,
);

/// What is set of a mirror that is put somewhere.
type Placed = (
    &'static mut Position,
    &'static mut Rotation,
    &'static mut LinearVelocity,
    &'static mut AngularVelocity,
    &'static mut Transform,
);

/// The states of the robots.
type RobotRows<'w, 's> = (
    Query<'w, 's, &'static Morphology, With<Robot>>,
    Query<'w, 's, &'static BasePose>,
    Query<'w, 's, &'static BaseVelocity>,
    Query<'w, 's, &'static JointState>,
    Query<'w, 's, &'static EnvOrigin>,
);

/// Masses and lengths of robots that were randomised.
pub(super) fn read_bodies(
    morphologies: Res<Morphologies>,
    mut mirrors: ResMut<LinkMirrors>,
    bodies: Query<(&EnvId, &Morphology, &Body), (With<Robot>, Changed<Body>)>,
    mut links: Query<(&mut Mass, &mut CenterOfMass, &mut AngularInertia), With<LinkMirror>>,
) {
    for (env, tag, body) in &bodies {
        let model = morphologies.get(*tag);
        let parameters = Parameters::from_scalars(&model.topology, &body.0);
        for (link, &entity) in mirrors.links(*env).iter().enumerate() {
            if let Ok((mut mass, mut com, mut inertia)) = links.get_mut(entity) {
                (*mass, *com, *inertia) = mass_properties(&parameters, &model.align[link], link);
            }
        }
        if let Some(robot) = mirrors.robots.get_mut(env.0 as usize) {
            robot.parameters = parameters;
        }
    }
}

/// Gives each mirror the velocity that takes it to its link within a control step.
pub(super) fn aim_mirrors(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    mut mirrors: ResMut<LinkMirrors>,
    robots: RobotRows,
    mut links: Query<Moving>,
) {
    follow(&workers, &morphologies, &mut mirrors, &robots, |_| true);
    let rate = (1.0 / task.config.sim.step_dt()) as f32;
    for (env, mirror, com, position, rotation, mut linear, mut angular) in &mut links {
        let Some(to) = motion(&mirrors, *env, *mirror) else {
            continue;
        };
        linear.0 = (to.position + to.rotation * com.0 - position.0 - rotation.0 * com.0) * rate;
        angular.0 = shortest(to.rotation * rotation.0.inverse()) * rate;
    }
}

/// One step of Avian's world. What it told in the step before last is forgotten.
pub(super) fn step_avian(world: &mut World) {
    if let Err(error) = world.run_system_cached(message_update_system) {
        tracing::error!("Avian's events of former steps were kept: {error}");
    }
    let seconds = world.resource::<CompiledTask>().config.sim.step_dt();
    step_world(world, seconds);
}

/// Gives each mirror the velocity of its link.
pub(super) fn settle_mirrors(mirrors: Res<LinkMirrors>, mut links: Query<Moving>) {
    for (env, mirror, _, _, _, mut linear, mut angular) in &mut links {
        if let Some(to) = motion(&mirrors, *env, *mirror) {
            (linear.0, angular.0) = (to.linear, to.angular);
        }
    }
}

/// Puts the mirrors of robots that begin a new episode where these are, for Avian's rays too.
pub(super) fn mirror_resets(world: &mut World) {
    run(world, place_new);
}

/// Puts all mirrors where the links are, if there are any.
pub(crate) fn mirror_all(world: &mut World) {
    if world.contains_resource::<LinkMirrors>() {
        run(world, place_all);
    }
}

fn run<M>(world: &mut World, place: impl IntoSystem<(), bool, M> + 'static) {
    if let Err(error) = world.run_system_cached(read_bodies) {
        tracing::error!("mirrors keep the masses of their links: {error}");
    }
    match world.run_system_cached(place) {
        // a ray looks for colliders in trees, which Avian updates in its steps
        Ok(true) => {
            if let Err(error) = world.run_system_cached(update_moved_collider_aabbs::<Collider>) {
                tracing::error!("Avian's rays do not see where links are: {error}");
            }
        }
        Ok(false) => {}
        Err(error) => tracing::error!("mirrors do not follow their links: {error}"),
    }
}

fn place_new(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    mirrors: ResMut<LinkMirrors>,
    robots: RobotRows,
    episodes: Query<&'static Episode>,
    links: Query<Placed, With<LinkMirror>>,
) -> bool {
    let new: Vec<bool> = read_rows(&episodes).iter().map(|episode| episode.fresh).collect();
    place(&workers, &morphologies, mirrors, &robots, links, |env| new.get(env) == Some(&true))
}

fn place_all(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    mirrors: ResMut<LinkMirrors>,
    robots: RobotRows,
    links: Query<Placed, With<LinkMirror>>,
) -> bool {
    place(&workers, &morphologies, mirrors, &robots, links, |_| true)
}

/// Whether there was any to be placed.
fn place(
    workers: &Workers,
    morphologies: &Morphologies,
    mut mirrors: ResMut<LinkMirrors>,
    robots: &RobotRows,
    mut links: Query<Placed, With<LinkMirror>>,
    due: impl Fn(usize) -> bool + Sync,
) -> bool {
    if !(0..mirrors.robots.len()).any(&due) {
        return false;
    }
    follow(workers, morphologies, &mut mirrors, robots, &due);
    for env in (0..mirrors.robots.len()).filter(|env| due(*env)) {
        let entities = mirrors.links(EnvId(env as u32));
        for (to, &entity) in mirrors.robots[env].motions.iter().zip(entities) {
            if let Ok((mut position, mut rotation, mut linear, mut angular, mut transform)) = links.get_mut(entity) {
                (position.0, rotation.0) = (to.position, to.rotation);
                (linear.0, angular.0) = (to.linear, to.angular);
                // Avian would take the old one for a wish
                (transform.translation, transform.rotation) = (to.position, to.rotation);
            }
        }
    }
    true
}

/// Where the links of robots that are due are.
fn follow(
    workers: &Workers,
    morphologies: &Morphologies,
    mirrors: &mut LinkMirrors,
    robots: &RobotRows,
    due: impl Fn(usize) -> bool + Sync,
) {
    let (tags, poses, velocities, joints, origins) = robots;
    let robots = mirrors.robots.as_mut_slice();
    let n = robots.len();
    let states = (read_rows(poses), read_rows(velocities), read_rows(joints));
    let rows = (robots, read_rows(origins), read_rows(tags), states);
    workers.for_each_chunk(rows, n, |first, n, (robots, origins, tags, (poses, velocities, joints))| {
        for i in (0..n).filter(|i| due(first + i)) {
            robots[i].follow(morphologies.get(tags[i]), &origins[i], &poses[i], &velocities[i], &joints[i]);
        }
    });
}

fn motion(mirrors: &LinkMirrors, env: EnvId, mirror: LinkMirror) -> Option<&LinkMotion> {
    mirrors.robots.get(env.0 as usize)?.motions.get(usize::from(mirror.link))
}

/// The turn as an axis times its angle, at most half a turn.
fn shortest(turn: Quat) -> Vec3 {
    let turn = if turn.w < 0.0 { -turn } else { turn };
    turn.to_scaled_axis()
}
