//! Episodes may begin with the base in any direction and the joints anywhere within their limits;
//! the tasks of getting up do, and nothing but time ends their episodes.

use glam::{DQuat, DVec3};
use polypod::components::{BasePose, Body, ContactSensor, EnvId, EpisodeSums, Imu, JointState, Robot};
use polypod::{Sim, SimOptions};

use crate::common;

fn getup(task: &str, robots: &[&str], num_envs: usize, overrides: &[&str]) -> Sim {
    let robots = Some(robots.iter().map(|robot| robot.to_string()).collect());
    let overrides = overrides.iter().map(|text| text.to_string()).collect();
    Sim::new(&SimOptions { robots, overrides, threads: Some(1), ..SimOptions::new(task, num_envs) }).unwrap()
}

fn poses(sim: &mut Sim) -> Vec<BasePose> {
    let world = sim.world_mut();
    world.query::<&BasePose>().iter(world).copied().collect()
}

#[test]
fn bases_point_in_all_directions() {
    let mut sim = getup("getup_flat", &["unitree_go1"], 600, &[]);
    let mut octants = [0; 8];
    for pose in poses(&mut sim) {
        let [w, x, y, z] = pose.rotation.map(f64::from);
        let rotation = DQuat::from_xyzw(x, y, z, w);
        assert!((rotation.length() - 1.0).abs() < 1e-5, "{pose:?}");
        let up = rotation.inverse() * DVec3::Z;
        octants[(0..3).map(|k| usize::from(up[k] > 0.0) << k).sum::<usize>()] += 1;
    }
    assert!(octants.iter().all(|count| *count > 40), "{octants:?}");
}

#[test]
fn roll_pitch_and_yaw_turn_as_in_isaac_lab() {
    let angles =
        ["roll=[0.5, 0.5]", "pitch=[-0.7, -0.7]", "yaw=[0.3, 0.3]"].map(|range| format!("events.reset_base.{range}"));
    let mut sim = getup("velocity_flat", &["unitree_go1"], 2, &angles.each_ref().map(String::as_str));
    let wanted = DQuat::from_rotation_z(0.3) * DQuat::from_rotation_y(-0.7) * DQuat::from_rotation_x(0.5);
    for pose in poses(&mut sim) {
        let [w, x, y, z] = pose.rotation.map(f64::from);
        assert!((DQuat::from_xyzw(x, y, z, w).dot(wanted) - 1.0).abs() < 1e-6, "{pose:?}");
    }
}

#[test]
fn joints_are_anywhere_within_their_limits() {
    for robot in ["unitree_go1", "unitree_g1"] {
        let task = if robot == "unitree_g1" { "getup_flat_humanoid" } else { "getup_flat" };
        let mut sim = getup(task, &[robot], 64, &[]);
        let share = f64::from(sim.morphologies()[0].config.reset.soft_limit_factor as f32);
        let joints = sim.morphologies()[0].topology.num_joints();
        let world = sim.world_mut();
        let mut reached = vec![[1.0_f64, 0.0]; joints];
        let mut robots = world.query_filtered::<(&JointState, &Body), bevy_ecs::prelude::With<Robot>>();
        for (state, body) in robots.iter(world) {
            for j in 0..joints {
                let [lower, upper] = [body.0.lower[j], body.0.upper[j]].map(f64::from);
                let (middle, half) = (0.5 * (lower + upper), 0.5 * (upper - lower) * share);
                let at = (f64::from(state.position[j]) - middle + half) / (2.0 * half);
                assert!((-1e-5..=1.0 + 1e-5).contains(&at), "joint {j} of {robot} is at {at} of its range");
                reached[j] = [reached[j][0].min(at), reached[j][1].max(at)];
                assert_eq!(state.velocity[j], 0.0);
            }
        }
        assert!(reached.iter().all(|[low, high]| *low < 0.15 && *high > 0.85), "{robot}: {reached:?}");
    }
}

#[test]
fn nothing_but_time_ends_an_episode_of_getting_up() {
    for (task, robots, seconds) in [
        ("getup_flat", &["anymal_d", "unitree_go1", "spot"][..], 6.0),
        ("getup_flat_humanoid", &["unitree_g1", "unitree_h1", "booster_t1"][..], 1.0),
    ] {
        let length = format!("sim.episode_length_s={seconds:?}");
        let mut sim = getup(task, robots, 12, &[&length]);
        let steps = (seconds / 0.02_f64).round() as usize;
        for t in 0..steps {
            common::step(&mut sim, t);
            let batch = sim.batch();
            assert!(!batch.terminated.contains(&true), "{task} at step {t}");
            assert!(batch.truncated.iter().all(|ends| *ends == (t + 1 == steps)), "{task} at step {t}");
        }
    }
}

#[test]
fn rewards_are_worth_what_was_worked_out() {
    let mut sim = getup(
        "hind_legs_flat",
        &["unitree_go1"],
        16,
        &[
            "events.reset_base.pitch=[-1.5, 0.5]",
            "rewards.hind_legs.posture={weight=1.0, std=0.5}",
            "rewards.hind_legs.level={term=\"upright\", weight=1.0, std=0.5}",
        ],
    );
    common::step(&mut sim, 0);
    let model = &sim.morphologies()[0];
    let height = f64::from(model.stance.spawn_height) - model.config.reset.spawn_margin;
    let (hips, feet) = (height + f64::from(model.hip_height), [model.feet[0], model.feet[2]]);
    let default: Vec<f64> = model.stance.default_position.iter().map(|q| f64::from(*q)).collect();
    let legs: Vec<_> = model.roles.legs.iter().map(|place| place.name()).collect();
    assert_eq!(legs, ["LF", "LH", "RF", "RH"]);
    let terms: Vec<_> = sim.task().rewards[0].iter().map(|term| (term.name.clone(), f64::from(term.weight))).collect();
    let world = sim.world_mut();
    let mut sums: Vec<_> =
        world.query::<(&EnvId, &EpisodeSums)>().iter(world).map(|(env, sums)| (*env, sums.terms.clone())).collect();
    sums.sort_by_key(|(env, _)| *env);
    let mut imus: Vec<_> =
        world.query::<(&EnvId, &Imu)>().iter(world).map(|(env, imu)| (*env, imu.projected_gravity)).collect();
    imus.sort_by_key(|(env, _)| *env);
    let mut sensors: Vec<_> = world
        .query::<(&EnvId, &ContactSensor)>()
        .iter(world)
        .map(|(env, sensor)| (*env, sensor.peak_force.clone()))
        .collect();
    sensors.sort_by_key(|(env, _)| *env);
    let mut checked = 0;
    for (env, pose, joints) in world.query::<(&EnvId, &BasePose, &JointState)>().iter(world) {
        let env = env.0 as usize;
        let g = imus[env].1.map(f64::from);
        let squares = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>();
        let lacking = (1.5 * height - f64::from(pose.position[2])).max(0.0);
        let mean = joints.position.iter().zip(&default).map(|(q, q0)| (f64::from(*q) - q0).powi(2)).sum::<f64>() / 12.0;
        for ((name, weight), sum) in terms.iter().zip(&sums[env].1) {
            let expected = match name.as_str() {
                "upright" => (-squares([g[0] + 1.0, g[1], g[2]]) / 0.64).exp(),
                "level" => (-squares([g[0], g[1], g[2] + 1.0]) / 0.25).exp(),
                "torso_height" => (-(lacking / (0.4 * hips)).powi(2)).exp(),
                "posture" => (0.5 * (1.0 - g[2])).powi(2) * (-mean / 0.25).exp(),
                "feet_off_ground" => feet.iter().filter(|foot| sensors[env].1[**foot] <= 1.0).count() as f64 / 2.0,
                _ => continue,
            };
            let found = f64::from(*sum) / 0.02 / weight;
            assert!((found - expected).abs() < 1e-4, "{name} of env {env} is {found}, not {expected}");
            checked += 1;
        }
    }
    assert_eq!(checked, 5 * 16);
    let refused = |change: &str, said: &str| {
        let options = SimOptions { overrides: vec![change.into()], ..SimOptions::new("hind_legs_flat", 4) };
        let error = Sim::new(&options).err().unwrap().to_string();
        assert!(error.contains(said), "{error}");
    };
    refused("rewards.hind_legs.feet_off_ground.feet=[\"LFF\"]", "unitree_go1 has no foot `LFF`");
    refused("rewards.hind_legs.upright.up=[0.0, 0.0, 0.0]", "rewards.hind_legs.upright.up");
}
