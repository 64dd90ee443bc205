//! A state that is not finite, or runs away, ends the episode of its env and touches no other.

use bevy_ecs::prelude::Mut;
use polypod::components::{BasePose, BaseVelocity, EnvId, Episode, JointState};
use polypod::morphology::Morphologies;
use polypod::systems::{CompiledTask, Logs};
use polypod::{Sim, SimOptions};

use crate::common::{assert_same, busy, step};

const NUM_ENVS: usize = 40;
const ROBOTS: [&str; 2] = ["anymal_d", "spot"];

/// Changes what it wants of a robot's state.
type Change = fn(&mut BasePose, &mut BaseVelocity, &mut JointState);

/// Two robots; no episode ends by itself within the test, so that what ends is known.
fn options() -> SimOptions {
    let mut options = busy(&ROBOTS, NUM_ENVS);
    options
        .overrides
        .extend(["sim.episode_length_s=20.0", "terminations.base_contact.threshold=1e6"].map(String::from));
    options
}

fn damage(sim: &mut Sim, broken: usize, change: Change) {
    let world = sim.world_mut();
    let mut query = world.query::<(&EnvId, &mut BasePose, &mut BaseVelocity, &mut JointState)>();
    for (env, mut pose, mut velocity, mut joints) in query.iter_mut(world) {
        if env.0 as usize == broken {
            change(&mut pose, &mut velocity, &mut joints);
        }
    }
}

fn log(sim: &mut Sim, key: &str) -> f64 {
    sim.world_mut().resource_scope(|world, mut logs: Mut<Logs>| {
        logs.take(world.resource::<CompiledTask>(), world.resource::<Morphologies>()).get(key).copied().unwrap_or(0.0)
    })
}

/// In either robot's block, in the middle of a pack.
fn check(what: &str, change: Change) {
    check_env(what, 5, ROBOTS[0], change);
    check_env(what, 33, ROBOTS[1], change);
}

fn check_env(what: &str, broken: usize, robot: &str, change: Change) {
    let (mut sim, mut twin) = (Sim::new(&options()).unwrap(), Sim::new(&options()).unwrap());
    for t in 0..10 {
        step(&mut sim, t);
        step(&mut twin, t);
    }
    damage(&mut sim, broken, change);
    for t in 10..60 {
        step(&mut sim, t);
        step(&mut twin, t);
        let when = format!("{what} of env {broken}, step {t}");
        assert_same(&mut sim, 0..broken, &mut twin, 0..broken, &when);
        assert_same(&mut sim, broken + 1..NUM_ENVS, &mut twin, broken + 1..NUM_ENVS, &when);
        let batch = sim.batch();
        let finite =
            [&batch.observations, &batch.final_observations, &batch.rewards].map(|x| x.iter().all(|x| x.is_finite()));
        assert_eq!(finite, [true; 3], "{when}");
        let at_once = t == 10;
        assert_eq!((batch.terminated[broken], batch.has_final[broken]), (at_once, at_once), "{when}");
        assert!(!batch.truncated[broken], "{when}");
        if at_once {
            assert_eq!(batch.rewards[broken], 0.0, "{when}");
            let (from, to) = (broken * batch.num_obs, (broken + 1) * batch.num_obs);
            assert!(batch.final_observations[from..to].iter().all(|&x| x == 0.0), "{when}");
            assert!(batch.observations[from..to].iter().any(|&x| x != 0.0), "{when}: the new episode is not observed");
        }
    }
    let world = sim.world_mut();
    let length = world.query::<(&EnvId, &Episode)>().iter(world).find(|(env, _)| env.0 as usize == broken);
    assert_eq!(length.map(|(_, episode)| episode.length), Some(49), "{what}");
    let key = format!("Episode_Termination/{robot}/illegal_state");
    assert_eq!((log(&mut sim, &key), log(&mut twin, &key)), (1.0, 0.0), "{what}");
}

#[test]
fn a_velocity_that_is_not_finite() {
    check("NaN base velocity", |_, velocity, _| velocity.linear[1] = f32::NAN);
    check("infinite base turn", |_, velocity, _| velocity.angular[2] = f32::INFINITY);
    check("NaN joint velocity", |_, _, joints| joints.velocity[4] = f32::NAN);
}

#[test]
fn a_pose_that_is_not_finite() {
    check("NaN height", |pose, _, _| pose.position[2] = f32::NAN);
    check("NaN orientation", |pose, _, _| pose.rotation = [f32::NAN; 4]);
    check("infinite joint position", |_, _, joints| joints.position[0] = f32::NEG_INFINITY);
}

#[test]
fn a_state_that_runs_away() {
    check("base as fast as a bullet", |_, velocity, _| velocity.linear = [900.0, 0.0, 0.0]);
    check("base beyond all numbers", |_, velocity, _| velocity.linear = [f32::MAX; 3]);
    check("base turning madly", |_, velocity, _| velocity.angular = [1e6, -1e6, 1e6]);
    check("joint beyond all numbers", |_, _, joints| joints.velocity[7] = f32::MAX);
}
