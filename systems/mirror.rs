//! Avian's world follows the robots, once per control step.
//!
//! Before Avian steps, each mirror gets the velocity that takes it from its old pose to the new
//! one, so that it pushes bodies in its way as a moving body does. Afterwards it gets the link's
//! own velocity. A robot that begins a new episode jumps to its pose, and pushes nothing.

use avian3d::collider_tree::update_moved_collider_aabbs;
use avian3d::prelude::{
    AngularInertia, AngularVelocity, CenterOfMass, Collider, LinearVelocity, Mass, Position, Rotation,
};
use bevy_app::{App, Plugin};
use bevy_ecs::message::message_update_system;
use bevy_ecs::prelude::*;
use bevy_ecs::system::SystemParam;
use bevy_math::{Quat, Vec3};
use bevy_transform::components::Transform;

use super::faults;
use super::terms::CompiledTask;
use super::{ControlStep, PipelineSet, ResetSet, Setup, SetupSet, Share, for_both};
use crate::blocks::{Block, BlockSizes, Blocks};
use crate::components::{BasePose, BaseVelocity, Body, Env, EnvId, EnvOrigin, Episode, JointState, Morphology, Robot};
use crate::dynamics::Parameters;
use crate::error::Error;
use crate::mirrors::{LinkMirror, LinkMirrors, LinkMotion, mass_properties};
use crate::morphology::Morphologies;
use crate::workers::Workers;
use crate::world::step_world;

/// Lets Avian's world follow the robots, with `physics.mirror_links`.
#[derive(Default)]
pub struct MirrorPlugin;

impl Plugin for MirrorPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(Setup, spawn_mirrors.in_set(SetupSet::Mirror));
        app.add_systems(
            ControlStep,
            (read_bodies, aim_mirrors, step_avian, settle_mirrors)
                .chain()
                .run_if(resource_exists::<LinkMirrors>)
                .in_set(PipelineSet::Mirror),
        );
        for_both(app, || mirror_resets.run_if(resource_exists::<LinkMirrors>).in_set(ResetSet::Mirror));
    }
}

/// Spawns the mirrors, where the task asks for them.
fn spawn_mirrors(world: &mut World) {
    let config = &world.resource::<CompiledTask>().config;
    if config.physics.mirror_links {
        let config = config.clone();
        let counts = world.resource::<BlockSizes>().0.clone();
        let Share { envs, num_envs, .. } = world.resource::<Share>().clone();
        world.resource_scope(|world, morphologies: Mut<Morphologies>| {
            LinkMirrors::spawn(world, &config, &morphologies, &counts, (envs, num_envs));
        });
    }
}

/// Components of a mirror that moves.
type Moving = (
    &'static EnvId,
    &'static LinkMirror,
    &'static CenterOfMass,
    &'static mut Position,
    &'static mut Rotation,
    &'static mut LinearVelocity,
    &'static mut AngularVelocity,
);

/// Components that are set when a mirror is placed.
type Placed = (
    &'static mut Position,
    &'static mut Rotation,
    &'static mut LinearVelocity,
    &'static mut AngularVelocity,
    &'static mut Transform,
);

/// The states of the robots.
#[derive(SystemParam)]
pub(super) struct States<'w, 's> {
    robots: Blocks<'w, 's, (&'static BasePose, &'static BaseVelocity, &'static JointState), Robot>,
    envs: Blocks<'w, 's, (&'static EnvOrigin, &'static Episode), Env>,
}

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
    states: States,
    mut links: Query<Moving>,
) -> Result {
    follow(&workers, &morphologies, &mut mirrors, &states, |_| true)?;
    let rate = (1.0 / task.config.sim.step_dt()) as f32;
    for (env, mirror, com, position, rotation, mut linear, mut angular) in &mut links {
        let Some(to) = motion(&mirrors, *env, *mirror) else {
            continue;
        };
        linear.0 = (to.position + to.rotation * com.0 - position.0 - rotation.0 * com.0) * rate;
        angular.0 = shortest(to.rotation * rotation.0.inverse()) * rate;
    }
    Ok(())
}

/// One step of Avian's world. Messages of the step before last are forgotten.
pub(super) fn step_avian(world: &mut World) -> Result {
    faults::outcome(world.run_system_cached(message_update_system))?;
    let seconds = world.resource::<CompiledTask>().config.sim.step_dt();
    step_world(world, seconds);
    Ok(())
}

/// Gives each mirror the velocity of its link.
pub(super) fn settle_mirrors(mirrors: Res<LinkMirrors>, mut links: Query<Moving>) {
    for (env, mirror, _, _, _, mut linear, mut angular) in &mut links {
        if let Some(to) = motion(&mirrors, *env, *mirror) {
            (linear.0, angular.0) = (to.linear, to.angular);
        }
    }
}

/// Moves the mirrors of robots that begin a new episode to these robots, for Avian's rays too.
pub(super) fn mirror_resets(world: &mut World) -> Result {
    Ok(run(world, place_new)?)
}

/// Puts all mirrors at their links, if there are any.
pub(crate) fn mirror_all(world: &mut World) -> Result<(), Error> {
    if world.contains_resource::<LinkMirrors>() { run(world, place_all) } else { Ok(()) }
}

fn run<M>(world: &mut World, place: impl IntoSystem<(), bool, M> + 'static) -> Result<(), Error> {
    faults::outcome(world.run_system_cached(read_bodies))?;
    if faults::outcome(world.run_system_cached(place))? {
        // a ray looks for colliders in trees, which Avian updates in its steps
        faults::outcome(world.run_system_cached(update_moved_collider_aabbs::<Collider>))?;
    }
    Ok(())
}

fn place_new(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    mirrors: ResMut<LinkMirrors>,
    states: States,
    links: Query<Placed, With<LinkMirror>>,
) -> Result<bool> {
    let envs = states.envs.read()?;
    let is_fresh = |env| envs.at(env).is_some_and(|((_, episodes), row)| episodes[row].fresh);
    Ok(place(&workers, &morphologies, mirrors, &states, links, is_fresh)?)
}

fn place_all(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    mirrors: ResMut<LinkMirrors>,
    states: States,
    links: Query<Placed, With<LinkMirror>>,
) -> Result<bool> {
    Ok(place(&workers, &morphologies, mirrors, &states, links, |_| true)?)
}

/// Places mirrors; returns whether there were any.
fn place(
    workers: &Workers,
    morphologies: &Morphologies,
    mut mirrors: ResMut<LinkMirrors>,
    states: &States,
    mut links: Query<Placed, With<LinkMirror>>,
    due: impl Fn(usize) -> bool + Sync,
) -> Result<bool, Error> {
    if !(0..mirrors.robots.len()).any(&due) {
        return Ok(false);
    }
    follow(workers, morphologies, &mut mirrors, states, &due)?;
    for env in (0..mirrors.robots.len()).filter(|env| due(*env)) {
        let entities = mirrors.links(EnvId(env as u32));
        for (to, &entity) in mirrors.robots[env].motions.iter().zip(entities) {
            if let Ok((mut position, mut rotation, mut linear, mut angular, mut transform)) = links.get_mut(entity) {
                (position.0, rotation.0) = (to.position, to.rotation);
                (linear.0, angular.0) = (to.linear, to.angular);
                // Avian would take an old transform for a request
                (transform.translation, transform.rotation) = (to.position, to.rotation);
            }
        }
    }
    Ok(true)
}

/// Updates the link poses of robots that are due.
fn follow(
    workers: &Workers,
    morphologies: &Morphologies,
    mirrors: &mut LinkMirrors,
    states: &States,
    due: impl Fn(usize) -> bool + Sync,
) -> Result<(), Error> {
    let blocks = states.robots.read()?.zip(states.envs.read()?).zip_envs(mirrors.robots.as_mut_slice());
    blocks.for_each_chunk(workers, |Block { morphology, envs, rows }| {
        let (((poses, velocities, joints), (origins, _)), robots) = rows;
        let morphology = morphologies.get(morphology);
        for (i, _) in envs.enumerate().filter(|(_, env)| due(*env)) {
            robots[i].follow(morphology, &origins[i], &poses[i], &velocities[i], &joints[i]);
        }
    });
    Ok(())
}

fn motion(mirrors: &LinkMirrors, env: EnvId, mirror: LinkMirror) -> Option<&LinkMotion> {
    mirrors.robots.get(env.0 as usize)?.motions.get(usize::from(mirror.link))
}

/// The turn as an axis times its angle, at most half a turn.
fn shortest(turn: Quat) -> Vec3 {
    let turn = if turn.w < 0.0 { -turn } else { turn };
    turn.to_scaled_axis()
}
