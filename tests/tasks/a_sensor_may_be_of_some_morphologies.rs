//! A component, a sensor and a term may be of some morphologies alone: the others are as they would
//! be without.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use polypod::app::snapshot::join;
use polypod::batch::Batch;
use polypod::blocks::{BlockMarker, Blocks};
use polypod::components::{EnvId, ExternalWrench, JointState, Morphology, MountedOn, Robot};
use polypod::config::TaskConfig;
use polypod::morphology::MorphologyModel;
use polypod::robot::LimbKind;
use polypod::systems::{
    ControlStep, PipelineSet, Place, PolypodPlugins, Saved, SensedRobot, Sensor, TermKind, TermSpec, add_observation,
    add_sensor,
};
use polypod::{Sim, SimOptions};
use serde::{Deserialize, Serialize};

use crate::common::{assert_all_same, env_bits, step};

/// Humanoids are not next to each other, and not at an end.
const ROBOTS: [&str; 4] = ["unitree_go2", "unitree_g1", "phantomx", "unitree_h1"];
const HAS: [bool; 4] = [false, true, false, true];
const ENVS: usize = 13;

/// Speed of the arms' joints in a control step, rad/s, and its sum over the episode.
#[derive(Component, Clone, Default, Serialize, Deserialize)]
struct ArmSwing {
    now: f32,
    sum: f32,
}

impl BlockMarker for ArmSwing {
    const NAME: &'static str = "arm sensor";

    fn is_on(morphology: &MorphologyModel, _: &TaskConfig) -> bool {
        morphology.roles.class() == "humanoid"
    }
}

impl Saved for ArmSwing {
    fn fits(&self, _: &Self, _: &Place) -> bool {
        true
    }
}

fn swing(morphology: &MorphologyModel, joints: &JointState) -> f32 {
    let arms = morphology.roles.limbs.iter().filter(|limb| limb.kind == LimbKind::Arm);
    arms.flat_map(|limb| &limb.joints).map(|joint| joints.velocity[joint.joint].abs()).sum()
}

impl Sensor for ArmSwing {
    type Settings = ();

    fn settings(_: &TaskConfig) -> Option<()> {
        Some(())
    }

    fn new((): &(), _: &MorphologyModel) -> Self {
        Self::default()
    }

    fn measure(&mut self, (): &(), robot: &SensedRobot) {
        self.now = swing(robot.morphology, robot.joints);
        self.sum += self.now;
    }

    fn begin(&mut self, (): &(), _: &SensedRobot) {
        *self = Self::default();
    }
}

struct ArmPlugin;

impl Plugin for ArmPlugin {
    fn build(&self, app: &mut App) {
        add_sensor::<ArmSwing>(app);
        let spec = TermSpec::new(TermKind::Scalar, "rad/s", "speed of the arms' joints");
        add_observation::<ArmSwing, ArmSwing>(app, "arm_swing", 1, spec, |arms, out| out[0] = arms.now);
        app.add_systems(ControlStep, punish.after(PipelineSet::Reward).before(PipelineSet::Reset));
    }
}

/// A reward of those that have the sensor.
fn punish(mut batch: ResMut<Batch>, sensors: Blocks<&'static ArmSwing, ArmSwing>) -> Result {
    for block in sensors.read_some()?.zip_envs(&mut batch.rewards[..]) {
        let (arms, rewards) = block.rows;
        arms.iter().zip(rewards).for_each(|(arms, reward)| *reward -= 0.01 * arms.now);
    }
    Ok(())
}

fn options(terms: &str) -> SimOptions {
    SimOptions {
        robots: Some(ROBOTS.map(String::from).to_vec()),
        threads: Some(1),
        seed: 7,
        overrides: vec!["sim.episode_length_s=0.5".into(), format!("observations.policy=[{terms}]")],
        ..SimOptions::new("velocity_flat_legged", ENVS)
    }
}

fn with_arms() -> SimOptions {
    options("{term=\"joint_pos_rel\"}, {term=\"arm_swing\", history_length=2}, {term=\"base_ang_vel\"}")
}

fn sim_of(options: SimOptions) -> Sim {
    let mut app = App::empty();
    app.insert_resource(options).add_plugins((PolypodPlugins, ArmPlugin));
    Sim::from_app(app).unwrap()
}

fn robot_of(sim: &Sim, env: usize) -> usize {
    (0..ROBOTS.len()).find(|&robot| sim.env_ids(robot).contains(&env)).unwrap()
}

#[test]
fn humanoids_have_a_sensor_and_the_others_are_as_without() {
    let mut arms = sim_of(with_arms());
    let mut bare = Sim::new(&options("{term=\"joint_pos_rel\"}, {term=\"base_ang_vel\"}")).unwrap();
    let world = arms.world_mut();
    let mut owners: Vec<(u32, u16)> =
        world.query_filtered::<(&EnvId, &Morphology), With<ArmSwing>>().iter(world).map(|(e, m)| (e.0, m.0)).collect();
    owners.sort_unstable();
    let humanoids = (0..ENVS).map(|env| (env as u32, robot_of(&arms, env) as u16));
    assert_eq!(owners, humanoids.filter(|(_, robot)| HAS[usize::from(*robot)]).collect::<Vec<_>>());
    assert_eq!(arms.world_mut().query::<&MountedOn>().iter(arms.world()).count(), 2 * ENVS + owners.len());

    let first = arms.task().observations[0].size;
    for (robot, has) in HAS.into_iter().enumerate() {
        let mask = arms.task().observation_mask(&arms.morphologies()[robot]);
        assert_eq!(mask[first..first + 2], [has; 2], "{}", ROBOTS[robot]);
        assert_eq!(mask[first + 2..], [true; 3]);
    }
    let mut swung = 0;
    for t in 0..40 {
        step(&mut arms, t);
        step(&mut bare, t);
        let world = arms.world_mut();
        let mut sensors = vec![None; ENVS];
        for (env, sensor) in world.query::<(&EnvId, &ArmSwing)>().iter(world) {
            sensors[env.0 as usize] = Some(sensor.clone());
        }
        let mut speeds = [0.0; ENVS];
        for (env, tag, joints) in world.query::<(&EnvId, &Morphology, &JointState)>().iter(world) {
            let models = world.resource::<polypod::morphology::Morphologies>();
            speeds[env.0 as usize] = swing(models.get(*tag), joints);
        }
        let (ours, theirs) = (arms.batch(), bare.batch());
        for env in 0..ENVS {
            let (row, other) = (&ours.observations[env * ours.num_obs..], &theirs.observations[env * theirs.num_obs..]);
            let ended = ours.terminated[env] || ours.truncated[env];
            let seen = sensors[env].as_ref().map_or(0.0, |sensor| sensor.now);
            assert_eq!(row[first + 1].to_bits(), seen.to_bits(), "env {env}, step {t}");
            assert_eq!(row[..first], other[..first]);
            assert_eq!(row[first + 2..first + 5], other[first..first + 3]);
            if !ended {
                let has = sensors[env].is_some();
                assert_eq!(seen, if has { speeds[env] } else { 0.0 }, "env {env}, step {t}");
                let expected = if has { theirs.rewards[env] - 0.01 * seen } else { theirs.rewards[env] };
                assert_eq!(ours.rewards[env], expected, "env {env}, step {t}");
                swung += usize::from(seen > 0.1);
            }
        }
    }
    assert!(swung > 100, "the arms moved in {swung} rows");
}

#[test]
fn snapshots_and_shares_hold_it_where_it_is() {
    let mut whole = sim_of(with_arms());
    // one cut within humanoids, one at the end of a robot's envs, and shares without any
    let cuts = [0, 2, 5, 7, ENVS];
    let share = |ends: &[usize]| sim_of(SimOptions { share: Some(ends[0]..ends[1]), ..with_arms() });
    let mut shares: Vec<Sim> = cuts.windows(2).map(share).collect();
    let step_share = |sim: &mut Sim, t: usize| {
        let (first, width) = (sim.share().envs.start, sim.batch().num_actions);
        let actions: Vec<f32> =
            (0..sim.batch().actions.len()).map(|i| crate::common::noise(0, first + i / width, t, i % width)).collect();
        sim.step(&actions).unwrap();
    };
    for t in 0..10 {
        step(&mut whole, t);
        shares.iter_mut().for_each(|sim| step_share(sim, t));
    }
    let snapshot = whole.snapshot().unwrap();
    let parts: Vec<Vec<u8>> = shares.iter_mut().map(|sim| sim.snapshot().unwrap()).collect();
    assert!(join(&parts).unwrap() == snapshot, "the shares' snapshots are not the whole's");
    for t in 10..20 {
        step(&mut whole, t);
    }
    let mut again = sim_of(with_arms());
    again.restore(&snapshot).unwrap();
    let mut others: Vec<Sim> = [0, 6, ENVS].windows(2).map(share).collect();
    others.iter_mut().for_each(|sim| sim.restore(&snapshot).unwrap());
    for t in 10..20 {
        step(&mut again, t);
        others.iter_mut().for_each(|sim| step_share(sim, t));
    }
    assert_all_same(&mut whole, &mut again, "after a restore");
    let joined: Vec<_> = others.iter_mut().flat_map(env_bits).collect();
    assert!(joined == env_bits(&mut whole), "shares after a restore");
}

/// A table's component, of one morphology's robots.
#[derive(Component)]
struct Payload(f32);

#[test]
fn a_component_on_one_morphology_is_its_block() {
    let mut sim = sim_of(with_arms());
    let mut bare = sim_of(with_arms());
    let world = sim.world_mut();
    let mut robots = world.query_filtered::<(Entity, &EnvId, &Morphology), With<Robot>>();
    let mut loaded: Vec<(Entity, u32)> =
        robots.iter(world).filter(|(.., tag)| tag.0 == 2).map(|(entity, env, _)| (entity, env.0)).collect();
    // in another order than that of the envs, which is restored in the next step
    loaded.reverse();
    for &(entity, env) in &loaded {
        world.entity_mut(entity).insert(Payload(env as f32));
    }
    for t in 0..20 {
        step(&mut sim, t);
        step(&mut bare, t);
    }
    assert_all_same(&mut sim, &mut bare, "with a payload that weighs nothing");

    let load = |mut robots: Blocks<(&'static Payload, &'static mut ExternalWrench), Robot>| {
        let mut count = 0;
        for block in robots.write_some().unwrap() {
            let (payloads, wrenches) = block.rows;
            for ((env, payload), wrench) in block.envs.zip(payloads).zip(wrenches) {
                assert_eq!((block.morphology.0, env as f32), (2, payload.0));
                wrench.force[2] = -payload.0;
                count += 1;
            }
        }
        count
    };
    assert_eq!(sim.world_mut().run_system_cached(load).unwrap(), loaded.len());
    let all = |robots: Blocks<&'static Payload, Robot>| robots.read().map(|_| ()).unwrap_err().to_string();
    let error = sim.world_mut().run_system_cached(all).unwrap();
    assert!(error.starts_with("rows of the robots: entity ") && error.contains("lacks a component"), "{error}");
    assert!(error.contains("read_some()"), "{error}");
}
