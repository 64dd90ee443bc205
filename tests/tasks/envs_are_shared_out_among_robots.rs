//! Envs are shared out evenly in contiguous blocks, and every entity is tagged with its env and its
//! kind of robot.

use std::collections::BTreeMap;

use bevy_ecs::component::{Component, Mutable};
use bevy_ecs::prelude::*;
use bevy_ecs::system::RunSystemOnce;
use polypod::Sim;
use polypod::blocks::{BlockMarker, BlockSizes, Blocks};
use polypod::components::{
    BasePose, ContactSensor, Env, EnvId, EnvRng, Episode, Imu, JointState, Morphology, MountedOn, Robot,
};
use polypod::systems::distribute;

use crate::common::{ROBOTS, busy, step};

#[test]
fn equal_shares_and_the_remainder_to_the_first() {
    assert_eq!(distribute(4096, &[1; 8]), [512; 8]);
    assert_eq!(distribute(4096, &[1; 7]), [586, 585, 585, 585, 585, 585, 585]);
    assert_eq!(distribute(11, &[1; 4]), [3, 3, 3, 2]);
    assert_eq!(distribute(3, &[5; 3]), [1; 3]);
    for (num_envs, robots) in [(8, 8), (203, 8), (1000, 7), (5, 1)] {
        assert_eq!(distribute(num_envs, &vec![1; robots]).iter().sum::<usize>(), num_envs);
    }
}

#[test]
fn a_task_may_give_a_robot_more_shares() {
    assert_eq!(distribute(12, &[1, 3, 2]), [2, 6, 4]);
    assert_eq!(distribute(13, &[1, 3, 2]), [3, 6, 4]);
    let with = |shares: &[&str], num_envs| {
        let mut options = busy(&ROBOTS, num_envs);
        options.overrides.extend(shares.iter().map(|&share| share.to_owned()));
        Sim::new(&options)
    };
    let sim = with(&["env_shares.spot=3", "env_shares.unitree_a1=2"], 22).unwrap();
    let counts = (0..ROBOTS.len()).map(|robot| sim.env_ids(robot).len());
    let expected = ROBOTS.iter().map(|&name| match name {
        "spot" => 6,
        "unitree_a1" => 4,
        _ => 2,
    });
    assert!(counts.eq(expected));

    let refusals = [
        (with(&["env_shares.spot=100"], 19), "none of 19 envs is left for anymal_b"),
        (with(&["env_shares.spot=0"], 19), "spot = 0: write a whole number from 1 to 1000"),
        (with(&["env_shares.sport=2"], 19), "spot"),
    ];
    for (refused, words) in refusals {
        let text = refused.err().unwrap().to_string();
        assert!(text.contains(words), "{text}");
    }
}

#[test]
fn blocks_are_contiguous_and_in_the_order_of_the_robots() {
    let sim = Sim::new(&busy(&ROBOTS, 19)).unwrap();
    let names: Vec<&str> = sim.morphologies().iter().map(|morphology| morphology.name()).collect();
    assert_eq!(names, ROBOTS);
    let mut next = 0;
    for (robot, share) in [3, 3, 3, 2, 2, 2, 2, 2].into_iter().enumerate() {
        let envs = sim.env_ids(robot);
        assert_eq!(envs, next..next + share, "{}", ROBOTS[robot]);
        next += share;
    }
    assert_eq!((next, sim.num_envs()), (19, 19));
}

/// Tags of all entities with component `C`, morphology by morphology, in the order in which systems
/// meet them.
fn tags<C: Component>(world: &mut World) -> Vec<(Entity, u32, usize)> {
    let mut query = world.query_filtered::<(Entity, &EnvId, &Morphology), With<C>>();
    let mut tags: Vec<(Entity, u32, usize)> =
        query.iter(world).map(|(entity, env, morphology)| (entity, env.0, usize::from(morphology.0))).collect();
    // a stable sort: envs of a morphology stay in the order of their table
    tags.sort_by_key(|(.., morphology)| *morphology);
    tags
}

fn check_tags(sim: &mut Sim) {
    let robots: Vec<usize> = (0..ROBOTS.len()).flat_map(|robot| sim.env_ids(robot).map(move |_| robot)).collect();
    let expected: Vec<(u32, usize)> = robots.iter().enumerate().map(|(env, &robot)| (env as u32, robot)).collect();
    let world = sim.world_mut();
    let all = [tags::<Env>(world), tags::<Robot>(world), tags::<ContactSensor>(world), tags::<Imu>(world)];
    let mut entities = Vec::new();
    for kind in &all {
        assert_eq!(kind.iter().map(|&(_, env, morphology)| (env, morphology)).collect::<Vec<_>>(), expected);
        entities.extend(kind.iter().map(|(entity, ..)| *entity));
    }
    assert_eq!(world.query::<&EnvId>().iter(world).count(), entities.len(), "there are other tagged entities");
    entities.sort();
    entities.dedup();
    assert_eq!(entities.len(), 4 * expected.len(), "an entity is two things at once");

    let robot_of: BTreeMap<u32, Entity> = all[1].iter().map(|&(entity, env, _)| (env, entity)).collect();
    let mut mounted = world.query::<(&EnvId, &MountedOn)>();
    assert_eq!(mounted.iter(world).count(), 2 * expected.len());
    for (env, robot) in mounted.iter(world) {
        assert_eq!(robot.0, robot_of[&env.0], "a sensor of env {} is mounted on another's robot", env.0);
    }
}

#[test]
fn every_entity_is_tagged_once_and_in_order() {
    let mut sim = Sim::new(&busy(&ROBOTS, 19)).unwrap();
    check_tags(&mut sim);
    // the order survives stepping and resets
    (0..80).for_each(|t| step(&mut sim, t));
    check_tags(&mut sim);
}

/// The blocks that systems read are the morphologies' envs, and hold all rows of `C`, one after the
/// other.
fn check_rows<C: Component<Mutability = Mutable>, K: BlockMarker>(world: &mut World, num_envs: usize) {
    let by_env: Vec<*const C> = {
        let mut rows: Vec<_> =
            world.query::<(&EnvId, &C)>().iter(world).map(|(e, c)| (e.0, std::ptr::from_ref(c))).collect();
        rows.sort_by_key(|(env, _)| *env);
        rows.into_iter().map(|(_, row)| row).collect()
    };
    assert_eq!(by_env.len(), num_envs);
    let expected = by_env.iter().map(|p| p.addr()).collect::<Vec<_>>();
    let found = world
        .run_system_once(|blocks: Blocks<&'static C, K>, sizes: Res<BlockSizes>| {
            let blocks = blocks.read().unwrap();
            let found: Vec<_> = blocks.iter().map(|block| (block.morphology, block.envs.clone())).collect();
            assert_eq!(found, sizes.iter().collect::<Vec<_>>());
            let rows = blocks.into_iter().flat_map(|block| block.rows);
            rows.map(|row| std::ptr::from_ref(row).addr()).collect::<Vec<_>>()
        })
        .unwrap();
    assert_eq!(found, expected);
}

#[test]
fn systems_read_components_as_rows_by_env() {
    let mut sim = Sim::new(&busy(&ROBOTS, 19)).unwrap();
    let world = sim.world_mut();
    check_rows::<EnvRng, Env>(world, 19);
    check_rows::<Episode, Env>(world, 19);
    check_rows::<BasePose, Robot>(world, 19);
    check_rows::<JointState, Robot>(world, 19);
    check_rows::<ContactSensor, ContactSensor>(world, 19);
    check_rows::<Imu, Imu>(world, 19);
}
