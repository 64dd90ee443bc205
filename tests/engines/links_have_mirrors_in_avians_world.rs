//! With `physics.mirror_links` rays, events and bodies of Avian's world meet the robots, each env
//! its own, and the robots do not notice.

use avian3d::prelude::*;
use bevy_ecs::prelude::*;
use bevy_ecs::system::SystemState;
use bevy_math::{Dir3, Vec3};
use polypod::components::{BasePose, BaseVelocity, Body, EnvId, EnvOrigin, Episode, JointState, Morphology, Robot};
use polypod::mirrors::{LinkMirror, LinkMirrors};
use polypod::world::ObstacleCollider;
use polypod::{Sim, SimOptions};

use crate::common::{self, assert_all_same, busy, step};

fn mirrored(mut options: SimOptions, spacing: f64) -> SimOptions {
    options.overrides.push("physics.mirror_links=true".into());
    options.overrides.push(format!("sim.env_spacing={spacing}"));
    options
}

/// Robots of one kind at rest in their default pose, one in each env.
fn calm(robot: &str, num_envs: usize, spacing: f64) -> Sim {
    let overrides = [
        "events.reset_base.x=[0.0, 0.0]",
        "events.reset_base.y=[0.0, 0.0]",
        "events.reset_base.yaw=[0.0, 0.0]",
        "events.reset_joints.enabled=false",
        "events.push_robot.enabled=false",
    ];
    let options = SimOptions {
        robots: Some(vec![robot.into()]),
        threads: Some(1),
        overrides: overrides.map(String::from).to_vec(),
        ..SimOptions::new("velocity_flat", num_envs)
    };
    let mut sim = Sim::new(&mirrored(options, spacing)).unwrap();
    for mut velocity in sim.world_mut().query::<&mut BaseVelocity>().iter_mut(sim.world_mut()) {
        *velocity = BaseVelocity::default();
    }
    sim
}

fn hold(sim: &mut Sim, steps: usize) {
    let actions = vec![0.0; sim.batch().actions.len()];
    (0..steps).for_each(|_| sim.step(&actions).unwrap());
}

fn links(sim: &Sim, env: u32) -> Vec<Entity> {
    sim.world().resource::<LinkMirrors>().links(EnvId(env)).to_vec()
}

fn origin(sim: &Sim, env: u32) -> Vec3 {
    sim.world().resource::<LinkMirrors>().origin(EnvId(env)).unwrap()
}

fn get<C: Component + Clone>(sim: &Sim, entity: Entity) -> C {
    sim.world().get::<C>(entity).unwrap().clone()
}

/// A ball of 1 kg without weight.
fn ball(sim: &mut Sim, env: u32, at: Vec3, velocity: Vec3) -> Entity {
    let tags = (EnvId(env), RigidBody::Dynamic, Collider::sphere(0.1), Mass(1.0), GravityScale(0.0));
    let surface = Restitution::new(1.0).with_combine_rule(CoefficientCombine::Max);
    sim.world_mut().spawn((tags, Position(at), LinearVelocity(velocity), surface, SleepingDisabled)).id()
}

/// Hit of a ray downwards from 3 m above a place: entity and height.
fn below(sim: &mut Sim, at: Vec3) -> (Entity, f32) {
    let mut rays: SystemState<SpatialQuery> = SystemState::new(sim.world_mut());
    let query = rays.get(sim.world()).unwrap();
    let hit = query.cast_ray(at + 3.0 * Vec3::Z, Dir3::NEG_Z, 10.0, true, &SpatialQueryFilter::default()).unwrap();
    (hit.entity, at.z + 3.0 - hit.distance)
}

/// Largest distance (m) and turn (rad) of any mirror from its link's pose in the model.
fn farthest(sim: &mut Sim) -> (f32, f32) {
    let world = sim.world_mut();
    let robots: Vec<(EnvId, Morphology, BasePose, JointState)> = world
        .query_filtered::<(&EnvId, &Morphology, &BasePose, &JointState), With<Robot>>()
        .iter(world)
        .map(|(env, tag, pose, joints)| (*env, *tag, *pose, joints.clone()))
        .collect();
    let (mut apart, mut turned) = (0.0_f32, 0.0_f32);
    for (env, tag, pose, joints) in robots {
        let q: Vec<f64> = joints.position.iter().map(|&q| f64::from(q)).collect();
        let [w, x, y, z] = pose.rotation;
        let base = bevy_math::Quat::from_xyzw(x, y, z, w);
        let model = sim.morphologies()[usize::from(tag.0)].model.clone();
        for (link, (at, entity)) in model.forward_kinematics(&q).iter().zip(links(sim, env.0)).enumerate() {
            let mirror: LinkMirror = get(sim, entity);
            assert_eq!((usize::from(mirror.link), get::<EnvId>(sim, entity)), (link, env));
            let there = origin(sim, env.0) + Vec3::from(pose.position) + base * at.translation.as_vec3();
            let rotation = base * glam::DQuat::from_mat3(&at.rotation).as_quat();
            apart = apart.max(get::<Position>(sim, entity).0.distance(there));
            turned = turned.max(get::<Rotation>(sim, entity).0.angle_between(rotation));
        }
    }
    (apart, turned)
}

#[test]
fn mirrors_are_where_the_links_are() {
    let mut sim = Sim::new(&mirrored(busy(&common::ROBOTS, 24), 4.0)).unwrap();
    let mut ended = 0;
    for k in 0..120 {
        let (apart, turned) = farthest(&mut sim);
        assert!(apart < 1e-4 && turned < 2e-3, "before step {k}: {apart} m, {turned} rad");
        step(&mut sim, k);
        ended += common::ended(&sim);
    }
    assert!(ended > 20, "{ended} episodes ended only");
    let snapshot = sim.snapshot().unwrap();
    (0..10).for_each(|k| step(&mut sim, k));
    sim.restore(&snapshot).unwrap();
    let (apart, turned) = farthest(&mut sim);
    assert!(apart < 1e-4 && turned < 2e-3, "restored: {apart} m, {turned} rad");
}

#[test]
fn mirrors_on_terrain_are_on_their_robots_tiles() {
    let options = SimOptions {
        robots: Some(vec!["anymal_c".into()]),
        overrides: ["sim.episode_length_s=0.6", "scene.terrain.num_rows=3", "scene.terrain.num_cols=4"]
            .map(String::from)
            .to_vec(),
        ..SimOptions::new("velocity_rough", 8)
    };
    let mut sim = Sim::new(&mirrored(options, 4.0)).unwrap();
    for k in 0..40 {
        let (apart, turned) = farthest(&mut sim);
        assert!(apart < 1e-4 && turned < 2e-3, "before step {k}: {apart} m, {turned} rad");
        step(&mut sim, k);
    }
    let world = sim.world_mut();
    let origins: Vec<(EnvId, EnvOrigin)> =
        world.query::<(&EnvId, &EnvOrigin)>().iter(world).map(|(env, origin)| (*env, *origin)).collect();
    assert!(origins.iter().any(|(_, origin)| origin.position != origins[0].1.position), "all on one tile");
    for (env, place) in origins {
        assert_eq!(origin(&sim, env.0).truncate().to_array(), place.position);
        // robots of other envs may be on this tile, too
        let base = links(&sim, env.0)[0];
        let at = get::<Position>(&sim, base).0;
        let mut rays: SystemState<SpatialQuery> = SystemState::new(sim.world_mut());
        let query = rays.get(sim.world()).unwrap();
        let hits = query.ray_hits(at + 3.0 * Vec3::Z, Dir3::NEG_Z, 10.0, 100, true, &SpatialQueryFilter::default());
        assert!(hits.iter().any(|hit| hit.entity == base), "env {}", env.0);
    }
}

#[test]
fn robots_are_the_same_bit_for_bit_with_and_without_mirrors() {
    for engine in ["articulated", "avian"] {
        let with_engine = |mut options: SimOptions| {
            options.overrides.push(format!("physics.engine={engine}"));
            options
        };
        let mut without = Sim::new(&with_engine(busy(&common::ROBOTS, 24))).unwrap();
        let mut with = Sim::new(&mirrored(with_engine(busy(&common::ROBOTS, 24)), 0.5)).unwrap();
        for k in 0..70 {
            step(&mut without, k);
            step(&mut with, k);
        }
        assert_all_same(&mut without, &mut with, engine);
    }
}

#[test]
fn rays_see_a_robot_at_once_and_after_steps_resets_and_snapshots() {
    let mut sim = calm("anymal_c", 5, 4.0);
    let seen = |sim: &mut Sim, when: &str| {
        for env in 0..5 {
            let base = links(sim, env)[0];
            let at = get::<Position>(sim, base).0;
            let (hit, height) = below(sim, at);
            assert_eq!(hit, base, "env {env}, {when}");
            assert!((0.02..0.4).contains(&(height - at.z)), "env {env}, {when}: {height} m over {} m", at.z);
            // nobody stands between the envs
            let (ground, height) = below(sim, origin(sim, env) + Vec3::new(2.0, 2.0, 0.0));
            assert!(height.abs() < 1e-5 && sim.world().get::<LinkMirror>(ground).is_none(), "env {env}, {when}");
        }
    };
    seen(&mut sim, "made");
    let snapshot = sim.snapshot().unwrap();
    hold(&mut sim, 25);
    seen(&mut sim, "stepped");
    for mut pose in sim.world_mut().query::<&mut BasePose>().iter_mut(sim.world_mut()) {
        pose.position[0] += 1.5;
    }
    hold(&mut sim, 1);
    seen(&mut sim, "put elsewhere");
    sim.reset(None, Some(&[true, false, true, false, true])).unwrap();
    seen(&mut sim, "reset");
    assert!(get::<Position>(&sim, links(&sim, 0)[0]).0.x.abs() < 0.01);
    sim.restore(&snapshot).unwrap();
    seen(&mut sim, "restored");
}

#[test]
fn a_ball_bounces_off_the_robot_of_its_env_only() {
    // all envs at one place: only their ids tell them apart
    for spacing in [0.0, 4.0] {
        let mut sim = calm("anymal_c", 2, spacing);
        let at = |sim: &Sim, env: u32| get::<Position>(sim, links(sim, env)[0]).0;
        let side = Vec3::new(0.0, 1.2, 0.05);
        let speed = Vec3::new(0.0, -3.0, 0.0);
        let from = at(&sim, 0) + side;
        let hits = ball(&mut sim, 0, from, speed);
        // a ball of the other env, thrown at the same robot
        let misses = ball(&mut sim, 1, from, speed);
        let robots = [0, 1].map(|env| links(&sim, env));
        let mut met = 0;
        for _ in 0..40 {
            hold(&mut sim, 1);
            for pair in sim.world().resource::<ContactGraph>().active_pairs() {
                let envs = [pair.collider1, pair.collider2].map(|e| sim.world().get::<EnvId>(e).copied());
                let [Some(a), Some(b)] = envs else { continue };
                assert_eq!(a, b, "a pair across envs, {spacing} m apart");
                let others = [pair.collider1, pair.collider2];
                met += usize::from(others.contains(&hits) && others.iter().any(|e| robots[0].contains(e)));
                assert!(!others.contains(&misses) || spacing == 0.0);
            }
        }
        assert!(met > 0, "the ball and the robot were no pair");
        let (back, on) = (get::<LinearVelocity>(&sim, hits).0, get::<LinearVelocity>(&sim, misses).0);
        println!("{spacing} m apart: {back} m/s bounced, {on} m/s of the other env");
        assert!(back.y > 1.0, "{back}");
        if spacing > 0.0 {
            assert!((on - speed).length() < 1e-4, "{on}");
        } else {
            // here it met the robot of the same env
            assert!(on.y > 1.0, "{on}");
        }
    }
}

#[test]
fn a_robot_that_moves_pushes_what_is_in_its_way() {
    let mut sim = calm("anymal_c", 1, 4.0);
    let base = links(&sim, 0)[0];
    let start = get::<Position>(&sim, base).0;
    // in front of the trunk, clear of the legs
    let resting = ball(&mut sim, 0, start + Vec3::new(0.75, 0.0, 0.05), Vec3::ZERO);
    hold(&mut sim, 5);
    assert!(get::<LinearVelocity>(&sim, resting).0.length() < 1e-5);
    for _ in 0..10 {
        for mut velocity in sim.world_mut().query::<&mut BaseVelocity>().iter_mut(sim.world_mut()) {
            velocity.linear = [2.0, 0.0, 0.0];
        }
        hold(&mut sim, 1);
    }
    let pushed = get::<LinearVelocity>(&sim, resting).0;
    println!("pushed: {pushed} m/s");
    assert!(pushed.x > 1.0, "{pushed}");
    // a robot that is put there by a reset pushes nothing
    let mut sim = calm("anymal_c", 1, 4.0);
    for mut pose in sim.world_mut().query::<&mut BasePose>().iter_mut(sim.world_mut()) {
        pose.position[0] -= 2.0;
    }
    hold(&mut sim, 2);
    let between = ball(&mut sim, 0, start + Vec3::new(-1.0, 0.0, 0.05), Vec3::ZERO);
    sim.reset(None, Some(&[true])).unwrap();
    hold(&mut sim, 2);
    assert!(get::<LinearVelocity>(&sim, between).0.length() < 1e-5);
}

#[test]
fn a_zone_tells_who_is_in_it() {
    let mut sim = calm("anymal_c", 2, 4.0);
    let zone = |sim: &mut Sim, env: u32, at: Vec3| {
        let shape = (RigidBody::Static, Collider::cuboid(0.5, 0.5, 2.0), Sensor, CollidingEntities::default());
        sim.world_mut().spawn((EnvId(env), shape, CollisionEventsEnabled, Position(at))).id()
    };
    // above the ground, in which a zone would find it
    let here = origin(&sim, 1) + Vec3::new(0.0, 0.0, 1.2);
    let elsewhere = here + Vec3::new(1.8, 0.0, 0.0);
    let (full, empty) = (zone(&mut sim, 1, here), zone(&mut sim, 1, elsewhere));
    let other = zone(&mut sim, 0, here);
    hold(&mut sim, 3);
    let inside = get::<CollidingEntities>(&sim, full);
    assert!(inside.contains(&links(&sim, 1)[0]), "{inside:?}");
    assert!(get::<CollidingEntities>(&sim, empty).is_empty());
    assert!(get::<CollidingEntities>(&sim, other).is_empty(), "a zone of another env");
}

#[test]
fn every_env_has_obstacles_of_its_own() {
    let options = SimOptions { threads: Some(1), ..SimOptions::new("velocity_obstacles", 9) };
    let mut sim = Sim::new(&mirrored(options, 12.0)).unwrap();
    let envs: Vec<EnvId> = {
        let world = sim.world_mut();
        world.query_filtered::<&EnvId, With<ObstacleCollider>>().iter(world).copied().collect()
    };
    for env in 0..9 {
        assert_eq!(envs.iter().filter(|id| id.0 == env).count() * 9, envs.len());
        // the box behind the ramp
        let place = origin(&sim, env) + Vec3::new(3.75, 0.5, 0.0);
        assert!((below(&mut sim, place).1 - 0.2).abs() < 1e-4, "env {env}");
    }
    // one that falls on the box stays there
    let at = origin(&sim, 8) + Vec3::new(3.75, 0.5, 0.4);
    let falling = ball(&mut sim, 8, at, Vec3::ZERO);
    sim.world_mut().entity_mut(falling).insert((GravityScale(1.0), Restitution::new(0.0)));
    hold(&mut sim, 60);
    let height = get::<Position>(&sim, falling).0.z;
    assert!((height - 0.3).abs() < 0.01, "{height} m");
}

#[test]
fn a_broken_robot_leaves_its_mirrors_finite() {
    let mut sim = calm("anymal_c", 2, 4.0);
    let world = sim.world_mut();
    for (env, mut pose) in world.query::<(&EnvId, &mut BasePose)>().iter_mut(world) {
        if env.0 == 0 {
            pose.position[2] = f32::NAN;
        }
    }
    hold(&mut sim, 1);
    assert!(sim.batch().terminated[0] && !sim.batch().terminated[1]);
    hold(&mut sim, 3);
    let (apart, turned) = farthest(&mut sim);
    assert!(apart < 1e-4 && turned < 2e-3, "{apart} m, {turned} rad");
}

#[test]
fn mirrors_weigh_what_the_links_of_their_robot_do() {
    let options = SimOptions { threads: Some(1), ..SimOptions::new("velocity_flat", 16) };
    let mut sim = Sim::new(&mirrored(options, 4.0)).unwrap();
    let world = sim.world_mut();
    let masses: Vec<(EnvId, Vec<f32>)> =
        world.query::<(&EnvId, &Body)>().iter(world).map(|(env, body)| (*env, body.0.mass.to_vec())).collect();
    let bases: Vec<u32> = masses.iter().map(|(_, mass)| mass[0].to_bits()).collect();
    assert!(bases[0] != bases[1], "masses are not randomised here");
    for (env, mass) in masses {
        let mirrors = links(&sim, env.0);
        assert_eq!(mirrors.len(), mass.len());
        for (entity, mass) in mirrors.into_iter().zip(mass) {
            assert_eq!(get::<Mass>(&sim, entity).0, mass);
            assert!(get::<RigidBody>(&sim, entity).is_kinematic());
        }
    }
}

#[test]
fn without_the_setting_there_are_none() {
    let mut sim = Sim::new(&busy(&["spot"], 2)).unwrap();
    step(&mut sim, 0);
    let world = sim.world_mut();
    assert_eq!(world.query::<&LinkMirror>().iter(world).count(), 0);
    assert_eq!(world.query::<&Episode>().iter(world).count(), 2);
}
