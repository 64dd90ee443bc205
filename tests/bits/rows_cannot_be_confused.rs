//! An env's numbers never reach another env, whatever a plugin does to its entities: it works, or
//! it is refused by name.

use bevy_ecs::prelude::*;
use polypod::components::{BasePose, ContactSensor, EnvId, Imu, Morphology, MountedOn, Robot, Sensors};
use polypod::{Error, Sim};

use crate::common::{ROBOTS, assert_all_same, busy, step};

/// A component in the tables of entities.
#[derive(Component, Default)]
struct Marker;

/// Marker in a sparse set.
#[derive(Component, Default)]
#[component(storage = "SparseSet")]
struct SparseMarker;

const ENVS: usize = 64;

/// Two simulations under way, of which one is going to be disturbed.
fn twins() -> (Sim, Sim) {
    let make = || {
        let mut sim = Sim::new(&busy(&ROBOTS, ENVS)).unwrap();
        (0..5).for_each(|t| step(&mut sim, t));
        sim
    };
    (make(), make())
}

fn entity_of<K: Component>(sim: &mut Sim, env: u32) -> Entity {
    let world = sim.world_mut();
    let mut query = world.query_filtered::<(Entity, &EnvId), With<K>>();
    query.iter(world).find(|(_, id)| id.0 == env).unwrap().0
}

fn assert_same_after_steps(mut disturbed: Sim, mut calm: Sim) {
    for t in 5..40 {
        step(&mut disturbed, t);
        step(&mut calm, t);
    }
    assert_all_same(&mut disturbed, &mut calm, "a disturbed simulation");
}

/// Steps once; returns what was wrong with the rows.
#[track_caller]
fn refusal(sim: &mut Sim) -> String {
    let actions = vec![0.0; sim.batch().actions.len()];
    match sim.step(&actions).unwrap_err() {
        error @ Error::Rows { .. } => error.to_string(),
        other => panic!("{other}"),
    }
}

#[test]
fn a_component_that_is_inserted_and_removed_changes_nothing() {
    let (mut disturbed, calm) = twins();
    for env in [3, 17, 3, 63, 0] {
        let robot = entity_of::<Robot>(&mut disturbed, env);
        disturbed.world_mut().entity_mut(robot).insert(Marker);
        disturbed.world_mut().entity_mut(robot).remove::<Marker>();
    }
    let imu = entity_of::<Imu>(&mut disturbed, 8);
    disturbed.world_mut().entity_mut(imu).insert(Marker).remove::<Marker>();
    let mut robots = disturbed.world_mut().query_filtered::<(&EnvId, &Morphology), With<Robot>>();
    let of_first = robots.iter(disturbed.world()).filter(|(_, tag)| tag.0 == 0).map(|(env, _)| env.0);
    assert!(!of_first.is_sorted(), "the order of the rows was not disturbed");
    assert_same_after_steps(disturbed, calm);
}

#[test]
fn so_it_is_between_a_step_and_a_reset() {
    let (mut disturbed, mut calm) = twins();
    let robot = entity_of::<Robot>(&mut disturbed, 3);
    disturbed.world_mut().entity_mut(robot).insert(Marker).remove::<Marker>();
    let mask: Vec<bool> = (0..ENVS).map(|env| env % 3 == 0).collect();
    for sim in [&mut disturbed, &mut calm] {
        sim.reset(None, Some(&mask)).unwrap();
    }
    assert_same_after_steps(disturbed, calm);
}

#[test]
fn a_component_on_one_robot_alone_is_refused_by_name() {
    let (mut disturbed, calm) = twins();
    let robot = entity_of::<Robot>(&mut disturbed, 3);
    disturbed.world_mut().entity_mut(robot).insert(Marker);
    let error = refusal(&mut disturbed);
    assert!(error.contains(&format!("entity {robot} of env 3 has other components")), "{error}");
    assert!(error.contains("SparseSet"), "{error}");
    // without it all is as before
    disturbed.world_mut().entity_mut(robot).remove::<Marker>();
    assert_same_after_steps(disturbed, calm);
}

#[test]
fn a_sparse_component_on_one_robot_and_any_on_all_are_allowed() {
    let (mut disturbed, calm) = twins();
    let robot = entity_of::<Robot>(&mut disturbed, 3);
    disturbed.world_mut().entity_mut(robot).insert(SparseMarker);
    for env in (0..ENVS as u32).rev() {
        let robot = entity_of::<Robot>(&mut disturbed, env);
        disturbed.world_mut().entity_mut(robot).insert(Marker);
    }
    assert_same_after_steps(disturbed, calm);
}

#[test]
fn a_robot_that_is_despawned_is_missed_with_its_sensors() {
    let (mut disturbed, _) = twins();
    let robot = entity_of::<Robot>(&mut disturbed, 5);
    assert_eq!(disturbed.world().get::<Sensors>(robot).unwrap().len(), 2);
    disturbed.world_mut().despawn(robot);
    let error = refusal(&mut disturbed);
    assert_eq!(error, "rows of the robots: env 5 has none any more; keep the entities that the simulation has spawned");
    let world = disturbed.world_mut();
    assert_eq!(world.query::<&MountedOn>().iter(world).count(), 2 * (ENVS - 1));
}

#[test]
fn an_entity_that_is_spawned_in_between_is_left_out_or_refused() {
    let (mut disturbed, calm) = twins();
    // it has an env and a pose, but is no robot; the other is a robot by name alone
    let pose = BasePose { position: [9.0; 3], rotation: [1.0, 0.0, 0.0, 0.0] };
    disturbed.world_mut().spawn((EnvId(3), pose, Marker));
    disturbed.world_mut().spawn((EnvId(3), Robot));
    assert_same_after_steps(disturbed, calm);
    let (mut disturbed, _) = twins();
    for (env, words) in [(3, "both of env 3"), (ENVS as u32, "there are 64 envs")] {
        let sensor = disturbed.world_mut().spawn((EnvId(env), ContactSensor::default())).id();
        let error = refusal(&mut disturbed);
        assert!(error.starts_with("rows of the contact sensors: "), "{error}");
        assert!(error.contains(&format!("{sensor}")) && error.contains(words), "{error}");
        disturbed.world_mut().despawn(sensor);
    }
}
