//! The device makes whole control steps with the bits of the systems: actions, commands, pushes,
//! sensors, ends, rewards, resets and observations. The host stands for the card.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bevy_app::App;
use bevy_ecs::prelude::*;
use polypod::components::{Body, CommandNumbers, CurriculumProgress, EnvId, EnvOrigin, LinkForce, LinkForces};
use polypod::dump::Dump;
use polypod::engine::{DeviceRows, OnDevice, RowsOf};
use polypod::systems::{ControlStep, PipelineSet, PolypodPlugins, add_engine};
use polypod::{Autoreset, Sim, SimOptions};
use polypod_cuda::{Device, DeviceBlock, DeviceError, EnvBlock, EnvHost, Exchange, RowSizes, Shape, TaskTables, Told};
use polypod_cuda_host::Host;

use crate::common::{ROBOTS, busy, ended, size, step};
use crate::driven::driven;

fn on(mut options: SimOptions, open: impl Fn() -> Result<Arc<dyn Device>, DeviceError> + Send + Sync + 'static) -> Sim {
    options.overrides.push("physics.engine=cuda".into());
    let mut app = App::empty();
    app.insert_resource(options).add_plugins(PolypodPlugins);
    add_engine(&mut app, "cuda", OnDevice::new(open));
    let mut sim = Sim::from_app(app).unwrap();
    sim.stay_on_device(true);
    sim
}

fn on_host(options: SimOptions) -> Sim {
    on(options, || Ok(Arc::new(Host::default())))
}

fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|x| x.to_bits()).collect()
}

/// The batches are the same, to the last bit.
fn assert_same_batch(cpu: &Sim, device: &Sim, what: &str) {
    let (one, other) = (cpu.batch(), device.batch());
    let width = one.num_obs;
    for env in 0..one.num_envs {
        let row = env * width..(env + 1) * width;
        let of = |batch: &polypod::batch::Batch| {
            (
                bits(&batch.observations[row.clone()]),
                batch.rewards[env].to_bits(),
                [batch.terminated[env], batch.truncated[env], batch.has_final[env]],
                bits(&batch.final_observations[row.clone()]),
            )
        };
        assert_eq!(of(one), of(other), "{what}, env {env}");
    }
    assert_eq!(bits(&one.actions), bits(&other.actions), "{what}: actions");
}

/// Both make the same steps, to the last bit of their snapshots. From time to time somebody looks,
/// which brings the state back to the host.
fn compare(options: SimOptions, steps: usize, least_ended: usize, what: &str) {
    compare_and(options, steps, least_ended, what, |_| {});
}

/// The same; `watch` sees the one on the CPU after each step.
fn compare_and(options: SimOptions, steps: usize, least_ended: usize, what: &str, mut watch: impl FnMut(&mut Sim)) {
    let (mut cpu, mut device) = (Sim::new(&options).unwrap(), on_host(options));
    assert_eq!(device.lacks_on_device(), None, "{what}");
    let mut all_ended = 0;
    for t in 0..steps {
        step(&mut cpu, t);
        step(&mut device, t);
        all_ended += ended(&cpu);
        watch(&mut cpu);
        assert_same_batch(&cpu, &device, &format!("{what}, step {t}"));
        let mut commands = [vec![0.0; 3 * cpu.num_envs()], vec![0.0; 3 * cpu.num_envs()]];
        cpu.write_commands(&mut commands[0]);
        device.write_commands(&mut commands[1]);
        assert_eq!(bits(&commands[0]), bits(&commands[1]), "{what}, step {t}: commands");
        if t % 31 == 30 {
            assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap(), "{what}, step {t}: a component differs");
            assert_eq!(bits(&cpu.height_scan()), bits(&device.height_scan()), "{what}, step {t}: height scan");
        }
    }
    assert!(all_ended >= least_ended, "{what}: {all_ended} episodes ended");
    assert_eq!(cpu.take_log(), device.take_log(), "{what}");
    assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap(), "{what}: a component differs");
    let alone = device.steps_on_device();
    assert!(alone >= steps as u64 * 8 / 10, "{what}: {alone} of {steps} steps");
}

/// The device, and the simulation on it, for steps that flow.
fn flowing(options: SimOptions) -> (Host, Sim, DeviceRows) {
    let host = Host::default();
    let device = host.clone();
    let mut sim = on(options, move || Ok(Arc::new(device.clone())));
    let rows = sim.device_rows().unwrap().unwrap();
    (host, sim, rows)
}

/// One control step whose actions are given on the device, and which the host does not wait for.
fn flow(host: &Host, sim: &mut Sim, actions: &[f32]) {
    host.write_rows(RowsOf::Given, actions).unwrap();
    sim.step_device(0).unwrap();
}

#[test]
fn that_flow_while_nobody_looks() {
    let mut legged = SimOptions { seed: 3, threads: Some(1), ..SimOptions::new("velocity_flat_legged", 48) };
    legged.overrides.push("sim.episode_length_s=0.8".into());
    for options in [SimOptions { threads: Some(2), ..busy(&ROBOTS, 70) }, legged] {
        let mut cpu = Sim::new(&options).unwrap();
        let (host, mut device, rows) = flowing(options);
        let (mut ended_in_all, sizes) = (0, rows.sizes);
        assert_eq!([sizes.envs, sizes.observations], [cpu.num_envs(), cpu.batch().num_obs]);
        for t in 0..120 {
            step(&mut cpu, t);
            flow(&host, &mut device, &cpu.batch().actions.clone());
            ended_in_all += ended(&cpu);
            // a learner on the device reads these
            let batch = cpu.batch();
            let read = |of: RowsOf| {
                let mut numbers = vec![0.0; sizes.part(of).len()];
                host.read_rows(of, &mut numbers).unwrap();
                bits(&numbers)
            };
            assert_eq!(read(RowsOf::Observations), bits(&batch.observations), "step {t}");
            assert_eq!(read(RowsOf::Rewards), bits(&batch.rewards), "step {t}");
            assert_eq!(host.ends().unwrap(), [&batch.terminated[..], &batch.truncated].concat(), "step {t}");
            match t % 40 {
                // the logs know of all steps, without the batch
                13 => {
                    assert_eq!(cpu.take_log(), device.take_log(), "step {t}");
                    assert!(device.is_batch_behind());
                }
                17 | 18 => {
                    device.fetch_batch().unwrap();
                    assert_same_batch(&cpu, &device, &format!("step {t}"));
                }
                // actions of the host and of the device take turns
                25 => [&mut cpu, &mut device].into_iter().for_each(|sim| step(sim, t)),
                // somebody looks at components, after which the device goes on
                39 => assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap(), "step {t}: a component differs"),
                _ => {}
            }
        }
        assert!(ended_in_all > 50, "{ended_in_all}");
        assert_eq!(cpu.take_log(), device.take_log());
        assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap());
        assert_eq!(device.steps_on_device(), 123);
        assert_eq!(device.device_rows().unwrap().unwrap().numbers, rows.numbers, "arrays stay where they are");
    }
}

/// Bodies that change at resets in a way that has no form on the device.
const CHANGING: &str = "events.randomize_actuator_gains={mode=\"reset\", enabled=true, \
                        distribution=\"log_uniform\", stiffness_distribution_params=[0.8, 1.2]}";

/// All events of a body that have a form there, at resets.
const BODIES: [&str; 6] = [
    "events.physics_material.mode=reset",
    "events.add_base_mass.mode=reset",
    "events.base_com.mode=reset",
    "events.randomize_actuator_gains={mode=\"reset\", enabled=true}",
    "events.randomize_joint_parameters={mode=\"reset\", enabled=true}",
    "events.randomize_motor_strength={mode=\"reset\", enabled=true}",
];

/// A simulation whose engine is to find out what is fastest.
fn undecided(mut options: SimOptions) -> Sim {
    options.overrides.push("physics.engine=auto".into());
    let mut app = App::empty();
    app.insert_resource(options).add_plugins(PolypodPlugins);
    add_engine(&mut app, "auto", OnDevice::if_faster(|| Ok(Arc::new(Host::default()))));
    let mut sim = Sim::from_app(app).unwrap();
    sim.stay_on_device(true);
    sim
}

#[test]
fn that_are_timed_where_nobody_knows_what_is_fastest() {
    let options = SimOptions { threads: Some(1), ..busy(&["unitree_a1", "spot"], 64) };
    let (mut cpu, mut either) = (Sim::new(&options).unwrap(), undecided(options.clone()));
    assert_eq!(either.lacks_on_device(), None);
    for t in 0..120 {
        step(&mut cpu, t);
        step(&mut either, t);
        assert_same_batch(&cpu, &either, &format!("step {t}"));
        // twenty on the CPU, then twenty on the device, which the host stands for and is no faster
        let on_device = u64::try_from(t).unwrap().saturating_sub(19).min(20);
        assert_eq!(either.steps_on_device(), on_device, "step {t}");
    }
    assert!(cpu.snapshot().unwrap() == either.snapshot().unwrap());
    // a caller who wants arrays on the device gets them if it is faster, and the state as it was
    let (cpu, mut either) = (Sim::new(&options).unwrap(), undecided(options.clone()));
    assert!(either.device_rows().unwrap().is_none());
    assert_same_batch(&cpu, &either, "the first step");
    assert_eq!(either.steps_on_device(), 0);
    let mut cpu = cpu;
    for t in 0..30 {
        step(&mut cpu, t);
        step(&mut either, t);
    }
    assert_eq!(either.steps_on_device(), 0, "it is known by now");
    assert!(cpu.snapshot().unwrap() == either.snapshot().unwrap());
    // one thing without a form on the device is known before any step
    let mut changing = SimOptions { threads: Some(1), ..SimOptions::new("velocity_flat", 24) };
    changing.overrides.push(CHANGING.into());
    let mut either = undecided(changing);
    for t in 0..50 {
        step(&mut either, t);
    }
    assert_eq!(either.steps_on_device(), 0);
}

/// Pushes a link of each robot for nine physics steps, as a caller does.
fn push_links(sim: &mut Sim) {
    let force = LinkForce {
        link: 3,
        in_world: true,
        point: [0.01, 0.0, -0.05],
        force: [8.0, -3.0, 5.0],
        torque: [0.1, 0.2, -0.3],
        steps: 9,
    };
    let world = sim.world_mut();
    world.query::<&mut LinkForces>().iter_mut(world).for_each(|mut forces| forces.0 = vec![force]);
}

#[test]
fn that_flow_with_the_host_where_the_device_cannot() {
    let options = busy(&["unitree_a1"], 34);
    let mut cpu = Sim::new(&options).unwrap();
    let (host, mut device, _) = flowing(options);
    for t in 0..40 {
        if t == 12 {
            // forces of a caller are the host's
            [&mut cpu, &mut device].into_iter().for_each(push_links);
        }
        step(&mut cpu, t);
        flow(&host, &mut device, &cpu.batch().actions.clone());
        let mut numbers = vec![0.0; cpu.batch().observations.len()];
        host.read_rows(RowsOf::Observations, &mut numbers).unwrap();
        assert_eq!(bits(&numbers), bits(&cpu.batch().observations), "step {t}");
    }
    assert_eq!(device.steps_on_device(), 31);
    assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap());
}

#[test]
fn that_flow_and_refuse_actions_that_are_no_numbers() {
    let options = busy(&["unitree_a1"], 20);
    let mut cpu = Sim::new(&options).unwrap();
    let (host, mut device, rows) = flowing(options);
    let width = rows.sizes.actions;
    let mut actions = vec![0.3; rows.sizes.part(RowsOf::Given).len()];
    flow(&host, &mut device, &actions);
    cpu.step(&actions).unwrap();
    // the env acts with zeros instead, and all others as they are told
    for bad in [f32::NAN, f32::NEG_INFINITY, -1e7] {
        actions[7 * width..8 * width].fill(0.0);
        cpu.step(&actions).unwrap();
        actions[7 * width..8 * width].fill(0.3);
        actions[7 * width + 3] = bad;
        flow(&host, &mut device, &actions);
        let error = device.fetch_batch().unwrap_err().to_string();
        assert!(error.contains("an action of env 7 was not a number within 1000000"), "{error}");
        assert_same_batch(&cpu, &device, &format!("after {bad}"));
    }
    // once; the simulation goes on
    device.fetch_batch().unwrap();
    actions.fill(0.0);
    for _ in 0..3 {
        cpu.step(&actions).unwrap();
        flow(&host, &mut device, &actions);
        device.fetch_batch().unwrap();
        assert_same_batch(&cpu, &device, "the steps after it");
    }
    assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap());
    // without anybody who looks the error comes with a later step
    actions[19 * rows.sizes.actions] = 1e7;
    flow(&host, &mut device, &actions);
    let mut told = 0;
    for _ in 0..6 {
        actions.fill(0.0);
        host.write_rows(RowsOf::Given, &actions).unwrap();
        told += usize::from(device.step_device(0).is_err());
    }
    assert_eq!(told, 1);
    // without arrays on the device there is nothing to step
    let error = Sim::new(&busy(&["unitree_a1"], 20)).unwrap().step_device(0).unwrap_err().to_string();
    assert!(error.contains("there are no arrays on a device"), "{error}");
}

#[test]
fn of_a_flat_task_with_resets_and_pushes() {
    let mut options = busy(&ROBOTS, 70);
    options.threads = Some(2);
    compare(options, size(140, 600), 100, "flat");
}

#[test]
fn of_all_robots_of_the_legged_task() {
    let mut options = SimOptions { seed: 3, threads: Some(1), ..SimOptions::new("velocity_flat_legged", 72) };
    options.overrides.push("sim.episode_length_s=0.8".into());
    compare(options, size(100, 400), 60, "legged");
}

#[test]
fn of_robots_whose_joints_networks_drive() {
    let mut options = driven(70);
    options.threads = Some(2);
    options.overrides.extend(BODIES.map(String::from));
    // networks have no gains, whatever is added at resets
    options.overrides.push(
        "events.randomize_actuator_gains={mode=\"reset\", enabled=true, operation=\"add\", \
         stiffness_distribution_params=[5.0, 9.0], damping_distribution_params=[0.1, 0.2]}"
            .into(),
    );
    let delays = ["events.action_delay.enabled=true", "events.action_delay.delay_range=[0, 6]"];
    options.overrides.extend(delays.map(String::from));
    compare(options, size(200, 600), 100, "networks");
}

#[test]
fn with_networks_between_both_sides() {
    let options = driven(36);
    let (mut cpu, mut device) = (Sim::new(&options).unwrap(), on_host(options.clone()));
    for t in 0..25 {
        step(&mut cpu, t);
        step(&mut device, t);
    }
    assert_eq!(device.steps_on_device(), 23);
    let (from_cpu, from_device) = (cpu.snapshot().unwrap(), device.snapshot().unwrap());
    let (mut new_cpu, (host, mut new_device, _)) = (Sim::new(&options).unwrap(), flowing(options));
    new_cpu.restore(&from_device).unwrap();
    new_device.restore(&from_cpu).unwrap();
    for t in 25..60 {
        step(&mut cpu, t);
        step(&mut new_cpu, t);
        flow(&host, &mut new_device, &cpu.batch().actions.clone());
    }
    let expected = cpu.snapshot().unwrap();
    assert!(expected == new_cpu.snapshot().unwrap() && expected == new_device.snapshot().unwrap());
}

/// A task on generated terrain, with pushes so strong that robots leave their tiles.
fn rough(task: &str, num_envs: usize) -> SimOptions {
    let mut options = SimOptions { seed: 11, threads: Some(2), ..SimOptions::new(task, num_envs) };
    let overrides = [
        "sim.episode_length_s=1.1",
        "commands.base_velocity.resampling_time_s=0.3",
        "events.push_robot.interval_range_s=[0.1, 0.3]",
        "events.push_robot.velocity_range=[-9.0, 9.0]",
        "scene.terrain.max_init_terrain_level=9",
    ];
    options.overrides.extend(overrides.map(String::from));
    options
}

/// Levels of all envs.
fn levels(sim: &mut Sim) -> Vec<u32> {
    let world = sim.world_mut();
    let mut of_envs: Vec<(u32, u32)> =
        world.query::<(&EnvId, &EnvOrigin)>().iter(world).map(|(env, at)| (env.0, at.terrain_level)).collect();
    of_envs.sort_unstable();
    of_envs.into_iter().map(|(_, level)| level).collect()
}

#[test]
fn of_a_rough_task_whose_levels_change() {
    let (mut before, mut changes) = (Vec::new(), [0; 3]);
    compare_and(rough("velocity_rough", 120), size(150, 600), 150, "rough", |sim| {
        let now = levels(sim);
        for (&was, &is) in before.iter().zip(&now) {
            let which = if is > was { 0 } else { 1 };
            if was == 9 && is + 1 < was {
                // beyond the hardest one
                changes[2] += 1;
            } else if was != is {
                changes[which] += 1;
            }
        }
        before = now;
    });
    assert!(changes[0] > 50 && changes[1] > 3 && changes[2] > 3, "up, down, anywhere: {changes:?}");
}

#[test]
fn of_other_uneven_ground() {
    compare(rough("velocity_rough_legged", 48), 80, 48, "legged");
    compare(rough("velocity_rough_blind", 24), 80, 24, "blind");
    let mut obstacles = SimOptions { seed: 2, threads: Some(1), ..SimOptions::new("velocity_obstacles", 32) };
    let overrides = [
        "sim.episode_length_s=0.8",
        "observations.policy=[{term=\"feet_height\", noise=0.02}, {term=\"base_ang_vel\"}]",
        "rewards.unitree.base_height_l2={weight=-2.0, target_height=0.3}",
        "rewards.spot.foot_clearance={weight=0.5, std=0.05, tanh_mult=2.0, target_height=0.1}",
    ];
    obstacles.overrides.extend(overrides.map(String::from));
    compare(obstacles, 80, 32, "obstacles");
    // a scanner above a plane, with heights of the past
    let mut flat = busy(&["unitree_a1", "anymal_c"], 24);
    flat.overrides.extend(
        [
            "sensors.height_scanner={size=[0.4, 0.3], resolution=0.1}",
            "observations.policy=[{term=\"height_scan\", history_length=2, offset=0.3}]",
            "terminations.root_height_below_minimum={minimum_height=0.1}",
        ]
        .map(String::from),
    );
    compare(flat, 60, 12, "flat");
}

#[test]
fn of_bodies_that_describe_themselves_joint_by_joint() {
    let options = |task: &str| {
        let overrides = ["sim.episode_length_s=0.8", "events.push_robot.interval_range_s=[0.2, 0.4]"];
        SimOptions {
            seed: 5,
            threads: Some(1),
            overrides: overrides.map(String::from).to_vec(),
            ..SimOptions::new(task, 48)
        }
    };
    compare(options("velocity_flat_any_legged"), 80, 40, "any legged");
    compare(options("velocity_flat_universal"), 80, 40, "universal");
    let mut with_error = options("velocity_flat_joints");
    let joints = "observations.policy=[{term=\"joint_descriptors\", error=0.1}, {term=\"morphology\"}, \
                  {term=\"feet_height\", noise=0.02}, {term=\"base_com_offset\"}, {term=\"base_mass_offset\"}]";
    with_error.overrides.push(joints.into());
    compare(with_error, 60, 30, "joints");
}

#[test]
fn of_a_policy_that_drives_some_joints_alone() {
    let overrides = [
        "sim.episode_length_s=0.8",
        "events.push_robot={mode=\"interval\", enabled=true, interval_range_s=[0.2, 0.4]}",
        "actions.joint_pos.joint_names=[\"*_HIP_*\", \"*_KNEE\", \"*_HFE\"]",
    ];
    for task in ["velocity_flat_legged", "velocity_flat_any_legged"] {
        let overrides = overrides.map(String::from).to_vec();
        let options = SimOptions { seed: 5, threads: Some(1), overrides, ..SimOptions::new(task, 48) };
        compare(options, 80, 40, task);
    }
}

/// Scales the mass of a link of each robot, as a caller does.
fn scale_mass(sim: &mut Sim, link: usize, factor: f32) {
    let world = sim.world_mut();
    world.query::<&mut Body>().iter_mut(world).for_each(|mut body| body.0.mass[link] *= factor);
}

#[test]
fn of_bodies_that_a_caller_changes_in_the_middle_of_episodes() {
    let mut options = SimOptions { seed: 5, threads: Some(1), ..SimOptions::new("velocity_flat_joints", 24) };
    options.overrides.push("sim.episode_length_s=1.0".into());
    let (mut cpu, mut device) = (Sim::new(&options).unwrap(), on_host(options));
    for t in 0..120 {
        for sim in [&mut cpu, &mut device] {
            if t == 20 {
                scale_mass(sim, 2, 1.5);
            }
            step(sim, t);
        }
        assert_same_batch(&cpu, &device, &format!("step {t}"));
    }
    assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap());
    // not before all episodes have begun with these bodies
    assert!((40..=90).contains(&device.steps_on_device()), "{}", device.steps_on_device());
}

/// Numbers of bodies that differ from one episode to the next, over all robots.
fn drawn_masses(sim: &mut Sim) -> Vec<(u32, u32)> {
    let world = sim.world_mut();
    let mut all: Vec<(u32, u32)> =
        world.query::<(&EnvId, &Body)>().iter(world).map(|(env, body)| (env.0, body.0.mass[0].to_bits())).collect();
    all.sort_unstable();
    all
}

#[test]
fn of_bodies_that_change_at_resets() {
    let mut options = SimOptions { threads: Some(2), ..busy(&ROBOTS, 70) };
    options.overrides.extend(BODIES.map(String::from));
    let mut drawn = HashSet::new();
    compare_and(options, size(140, 600), 100, "flat", |sim| drawn.extend(drawn_masses(sim)));
    assert!(drawn.len() > 150, "{}", drawn.len());
    // the same on uneven ground, next to levels that draw from the same numbers
    let mut uneven = rough("velocity_rough", 40);
    uneven.overrides.extend(BODIES.map(String::from));
    compare(uneven, 100, 40, "rough");
    // numbers that a critic sees of them, other rules, draws of the task, torsional and rolling
    // friction
    let mut other = busy(&["unitree_go2", "anymal_c"], 40);
    other.overrides.extend(BODIES.map(String::from));
    other.overrides.extend(
        [
            "scene.ground.friction_combine=average",
            "scene.ground.torsional_friction=0.003",
            "events.physics_material={mode=\"reset\", num_buckets=5, torsional_friction_range=[0.0, 0.02], \
             rolling_friction_range=[0.0, 0.004]}",
            "events.add_base_mass={mode=\"reset\", recompute_inertia=false, mass_scale_range=[0.7, 1.4]}",
            "events.randomize_actuator_gains={mode=\"reset\", enabled=true, operation=\"add\", \
             stiffness_distribution_params=[-9.0, 9.0]}",
            "events.randomize_joint_parameters={mode=\"reset\", enabled=true, operation=\"add_effort_share\", \
             armature_distribution_params=[0.0, 1e-3], viscous_friction_distribution_params=[0.0, 0.01]}",
            "events.randomize_motor_strength={mode=\"reset\", enabled=true, strength_range=[0.7, 1.0]}",
            "observations.policy=[{term=\"base_ang_vel\", noise=0.2}, {term=\"contact_friction\"}, \
             {term=\"base_mass_offset\"}, {term=\"base_com_offset\", noise=0.1}]",
            "rewards.unitree.scaled_torques_l2={weight=-5.0}",
        ]
        .map(String::from),
    );
    compare(other, 100, 30, "other");
    for rule in ["min", "max"] {
        let mut options = busy(&["unitree_a1"], 20);
        options.overrides.extend(
            [
                &format!("scene.ground.friction_combine={rule}"),
                "events.physics_material.mode=reset",
                "events.physics_material.num_buckets=1",
                "events.randomize_joint_parameters={mode=\"reset\", enabled=true, operation=\"abs\", \
                 friction_distribution_params=[0.0, 0.2]}",
            ]
            .map(String::from),
        );
        compare(options, 60, 12, rule);
    }
}

#[test]
fn of_changing_bodies_that_a_caller_changes_too() {
    let mut options = SimOptions { threads: Some(1), ..busy(&["unitree_a1", "spot"], 34) };
    options.overrides.extend(BODIES.map(String::from));
    let (mut cpu, mut device) = (Sim::new(&options).unwrap(), on_host(options));
    for t in 0..80 {
        for sim in [&mut cpu, &mut device] {
            if t == 20 {
                // a number that a reset draws, and another one, which it takes back
                scale_mass(sim, 0, 1.2);
            }
            if t == 40 {
                scale_mass(sim, 2, 1.2);
            }
            step(sim, t);
        }
        assert_same_batch(&cpu, &device, &format!("step {t}"));
    }
    assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap());
    // between the first change and the second, and after all episodes of the second have ended
    assert!((15..70).contains(&device.steps_on_device()), "{}", device.steps_on_device());
}

#[test]
fn with_curricula_of_commands_and_weights() {
    let widens = "curriculum.command_curriculum={reward_terms=[\"track_lin_vel_xy_exp\", \"base_linear_velocity\"], \
                  threshold=0.02, step=0.2, lin_vel_x=[-2.0, 2.0], ang_vel_z=[-1.5, 1.5]}";
    let stages = "curriculum.commands_vel={velocity_stages=[{step=0, lin_vel_x=[-0.2, 0.2]}, \
                  {step=25, lin_vel_x=[-0.6, 0.5], lin_vel_y=[-0.1, 0.1]}, {step=60, ang_vel_z=[-0.3, 0.3]}]}";
    let weights = [
        "curriculum.first={term=\"modify_reward_weight\", term_name=\"lin_vel_z_l2\", weight=-4.0, num_steps=30}",
        "curriculum.second={term=\"modify_reward_weight\", term_name=\"lin_vel_z_l2\", weight=0.5, num_steps=55}",
        "curriculum.third={term=\"modify_reward_weight\", term_name=\"track_lin_vel_xy_exp\", weight=3.0, num_steps=40}",
    ];
    for (what, lines) in [("widening", vec![widens]), ("stages", vec![stages, widens]), ("weights", weights.to_vec())] {
        let mut options = SimOptions { threads: Some(1), ..busy(&ROBOTS, 40) };
        options.overrides.extend(lines.into_iter().map(String::from));
        options.overrides.push("commands.base_velocity.rel_heading_envs=0.5".into());
        let mut widened = false;
        compare_and(options, 120, 30, what, |sim| {
            let world = sim.world_mut();
            widened |= world.query::<&CurriculumProgress>().iter(world).any(|progress| progress.widening > 0.3);
        });
        assert_eq!(widened, what != "weights", "{what}");
    }
}

#[test]
fn with_commands_other_than_the_velocity() {
    let commands = [
        "commands.pose={height_share=[0.7, 1.1], roll=[-0.3, 0.3], pitch=[-0.2, 0.4], resampling_time_s=0.3}",
        "commands.heading={resampling_time_s=0.4}",
        "commands.position={pos_x=[-2.0, 2.0], pos_y=[-1.0, 3.0], resampling_time_s=0.5}",
        "commands.gait={frequency=[1.5, 3.5], phase=[0.2, 0.8], offset=[0.0, 0.5], bound=[0.0, 0.4], \
         duration=[0.3, 0.7], resampling_time_s=0.35}",
        "commands.foot_placement={stance_width=[0.8, 1.3], stance_length=[0.9, 1.1], resampling_time_s=0.45}",
        "commands.jump={time=[0.1, 0.4], length=[-0.3, 0.6]}",
        "observations.policy=[{term=\"pose_commands\", noise=0.01}, {term=\"heading_commands\"}, \
         {term=\"position_commands\", history_length=2}, {term=\"gait_commands\"}, {term=\"clock_inputs\", noise=0.1}, \
         {term=\"foot_placement_commands\"}, {term=\"jump_commands\", scale=2.0}, {term=\"velocity_commands\"}]",
    ];
    let rewards = [
        "track_base_height_exp={weight=1.0, std=0.2}",
        "orientation_control={weight=-1.0}",
        "heading_command_error_abs={weight=-0.3}",
        "other_heading={term=\"heading_command_error_abs\", weight=-0.2, command_name=\"position\"}",
        "position_command_error_tanh={weight=0.5, std=2.0}",
        "tracking_contacts_shaped_force={weight=1.0, gait_force_sigma=60.0}",
        "tracking_contacts_shaped_vel={weight=1.0}",
        "jump_height_exp={weight=1.0, std=0.3}",
        "jump_velocity_exp={weight=1.0, std=0.5}",
        "jump_contacts={weight=0.4}",
        "raibert_heuristic={weight=-2.0}",
        "feet_clearance_cmd_linear={weight=-8.0}",
    ];
    let lines: Vec<String> = commands.into_iter().map(String::from).collect();
    let of_set = |set: &str| rewards.map(|reward| format!("rewards.{set}.{reward}"));
    let mut options = SimOptions { threads: Some(2), ..busy(&["unitree_go2", "anymal_c"], 40) };
    options.overrides.extend(lines.iter().cloned().chain(of_set("unitree")).chain(of_set("anymal")));
    compare(options, size(120, 500), 30, "commands");
    // legs of another number, a simple heading, uneven ground, and no velocity at all
    let mut other = SimOptions { seed: 5, threads: Some(1), ..SimOptions::new("velocity_rough_legged", 24) };
    other.robots = Some(vec!["phantomx".into(), "unitree_h1".into()]);
    other.overrides.extend(lines);
    other.overrides.push("commands.position.simple_heading=true".into());
    other.overrides.push("sim.episode_length_s=0.7".into());
    compare(other, 80, 24, "legged");
}

#[test]
fn with_commands_that_a_caller_sets() {
    let mut options = SimOptions { threads: Some(1), ..busy(&["unitree_a1"], 20) };
    options.overrides.extend(
        [
            "commands.heading={resampling_time_s=0.2}",
            "commands.gait={frequency=[1.5, 3.5], resampling_time_s=0.3}",
            "observations.policy=[{term=\"heading_commands\"}, {term=\"gait_commands\"}, {term=\"clock_inputs\"}]",
        ]
        .map(String::from),
    );
    let (mut cpu, mut device) = (Sim::new(&options).unwrap(), on_host(options));
    for t in 0..60 {
        for sim in [&mut cpu, &mut device] {
            if t == 20 {
                let world = sim.world_mut();
                world.query::<(&EnvId, &mut CommandNumbers)>().iter_mut(world).for_each(|(env, mut numbers)| {
                    numbers.numbers[0] = 0.25;
                    numbers.pinned = env.0 % 4;
                });
            }
            step(sim, t);
        }
        assert_same_batch(&cpu, &device, &format!("step {t}"));
        if t % 13 == 12 {
            let [one, other] = [&mut cpu, &mut device].map(|sim| sim.command_numbers("gait").unwrap());
            assert_eq!(bits(&one), bits(&other), "step {t}");
        }
    }
    assert!(device.steps_on_device() > 40);
    assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap());
}

#[test]
fn of_robots_that_get_up_and_stand_on_hind_legs() {
    for (task, robots) in [("getup_flat", 40), ("getup_flat_humanoid", 24), ("hind_legs_flat", 24)] {
        let mut options = SimOptions { seed: 4, threads: Some(2), ..SimOptions::new(task, robots) };
        options.overrides.push("sim.episode_length_s=0.9".into());
        if task == "getup_flat" {
            options.overrides.push("curriculum.action_rate.num_steps=50".into());
        }
        compare(options, 100, 24, task);
    }
}

#[test]
fn of_all_tasks_of_the_library_but_those_that_show_motions() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/tasks");
    let mut count = 0;
    for file in fs::read_dir(folder).unwrap() {
        let task = file.unwrap().path().file_stem().unwrap().to_str().unwrap().to_owned();
        let lacks = on_host(SimOptions { threads: Some(1), ..SimOptions::new(&task, 24) }).lacks_on_device();
        if task.starts_with("tracking") {
            assert_eq!(lacks.as_deref(), Some("the observation `motion_command`"), "{task}");
        } else {
            assert_eq!(lacks, None, "{task}");
        }
        count += 1;
    }
    assert!(count >= 40, "{count}");
}

#[test]
fn with_delays_wrenches_histories_and_other_commands() {
    let mut options = busy(&["unitree_go2", "spot"], 40);
    options.overrides.extend(
        [
            "events.action_delay.enabled=true",
            "events.action_delay.delay_range=[0, 6]",
            "events.base_external_force_torque.enabled=true",
            "events.base_external_force_torque.force_range=[-9.0, 9.0]",
            "commands.base_velocity.rel_heading_envs=0.4",
            "commands.base_velocity.rel_turning_envs=0.3",
            "commands.base_velocity.rel_sideways_envs=0.3",
            "observations.policy=[{term=\"base_ang_vel\", noise=0.2, history_length=3, clip=[-0.5, 0.5], scale=2.0}, \
             {term=\"joint_vel_rel\", noise=1.5, history_length=2}, {term=\"last_action\"}]",
            "events.reset_base={mode=\"reset\", x=[-0.5, 0.5], y=[-0.5, 0.5], yaw=[-3.0, 3.0], roll=[-0.3, 0.3]}",
        ]
        .map(String::from),
    );
    compare(options, 100, 30, "delays");
}

#[test]
fn with_terms_that_few_tasks_use() {
    let mut options = busy(&["unitree_go2", "unitree_a1"], 40);
    let rewards = [
        "scaled_torques_l2={weight=-5.0}",
        "scaled_acc_l2={weight=-0.003}",
        "joint_vel_l2={weight=-0.1, joints=[\"*_KFE\"], mean=true}",
        "stand_still_joint_deviation_l1={weight=-0.4, command_threshold=0.5}",
        "joint_deviation_l1={weight=-0.2, joints=[\"*_HAA\"]}",
        "joint_pos_limits={weight=-1.0}",
        "base_height_l2={weight=-2.0, target_height=0.3}",
        "feet_slide={weight=-0.2}",
        "desired_contacts={weight=-0.5}",
        "gait_symmetry={weight=-3.0}",
        "is_alive={weight=1.0}",
        "action_rate_l2={weight=-0.01, mean=true}",
    ];
    options.overrides.extend(rewards.map(|reward| format!("rewards.unitree.{reward}")));
    options.overrides.extend(
        [
            "events.reset_joints_within_limits_range={mode=\"reset\", position_range=[0.3, 0.6]}",
            "events.base_external_force_torque={mode=\"interval\", enabled=true, interval_range_s=[0.1, 0.3]}",
            "terminations.root_height_below_minimum={minimum_height=0.1}",
            "terminations.bad_orientation={limit_angle=0.9}",
            "terminations.illegal_contact={threshold=1.0, bodies=[\"thigh\"]}",
        ]
        .map(String::from),
    );
    compare(options, 100, 30, "terms");
}

#[test]
fn whatever_resets_the_envs() {
    for (autoreset, options) in [
        (Autoreset::NextStep, busy(&["unitree_a1"], 40)),
        (Autoreset::Disabled, busy(&["unitree_a1"], 40)),
        (Autoreset::NextStep, rough("velocity_rough", 40)),
    ] {
        let options = SimOptions { autoreset, ..options };
        let (mut cpu, mut device) = (Sim::new(&options).unwrap(), on_host(options));
        for t in 0..80 {
            for sim in [&mut cpu, &mut device] {
                step(sim, t);
                let batch = sim.batch();
                let over = batch.terminated.iter().zip(&batch.truncated).map(|(failed, late)| failed | late);
                let over: Vec<bool> = over.collect();
                if autoreset == Autoreset::Disabled && t % 9 == 8 {
                    sim.reset(None, Some(&over)).unwrap();
                }
            }
            assert_same_batch(&cpu, &device, &format!("{autoreset:?}, step {t}"));
        }
        assert!(device.steps_on_device() > 40);
        assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap(), "{autoreset:?}");
    }
}

#[test]
fn between_changes_that_a_caller_makes() {
    let options = busy(&["unitree_a1"], 34);
    let (mut cpu, mut device) = (Sim::new(&options).unwrap(), on_host(options));
    for t in 0..60 {
        for sim in [&mut cpu, &mut device] {
            if t == 10 {
                let world = sim.world_mut();
                let mut bodies = world.query::<(&EnvId, &mut Body)>();
                bodies.iter_mut(world).for_each(|(env, mut body)| body.0.mass[1] *= 1.0 + 0.01 * env.0 as f32);
            }
            if t == 20 {
                push_links(sim);
            }
            if t == 35 {
                sim.set_commands(Some(&[0.4, 0.1, -0.2].repeat(34))).unwrap();
                sim.set_reward_weight(0, "lin_vel_z_l2", -3.0).unwrap();
            }
            if t == 45 {
                sim.reset(Some(9), None).unwrap();
            }
            step(sim, t);
        }
        assert_same_batch(&cpu, &device, &format!("step {t}"));
    }
    assert!(device.steps_on_device() > 25);
    assert!(cpu.snapshot().unwrap() == device.snapshot().unwrap());
}

#[test]
fn only_where_all_that_a_task_uses_has_a_form_there() {
    let lacks = |task: &str, overrides: &[&str]| {
        let mut options = SimOptions { threads: Some(1), ..SimOptions::new(task, 24) };
        options.overrides.extend(overrides.iter().map(|line| (*line).to_owned()));
        let mut sim = on_host(options);
        for t in 0..4 {
            step(&mut sim, t);
        }
        assert_eq!(sim.steps_on_device(), 0, "{task}");
        sim.lacks_on_device().unwrap()
    };
    assert_eq!(lacks("velocity_flat", &[CHANGING]), "the event `randomize_actuator_gains`");
    let varies = "events.body_variation={mode=\"reset\", enabled=true}";
    assert_eq!(lacks("velocity_flat", &[varies]), "the event `body_variation`");
    let descriptions = "at resets that change bodies, the observation `joint_descriptors`";
    assert_eq!(lacks("velocity_flat_joints", &[BODIES[1]]), descriptions);
    // a user's system sees the components of every step
    let mut app = App::empty();
    let options = SimOptions { overrides: vec!["physics.engine=cuda".into()], ..SimOptions::new("velocity_flat", 16) };
    app.insert_resource(options).add_plugins(PolypodPlugins);
    add_engine(&mut app, "cuda", OnDevice::new(|| Ok(Arc::new(Host::default()))));
    app.add_systems(ControlStep, (|| {}).in_set(PipelineSet::Reward));
    let mut sim = Sim::from_app(app).unwrap();
    assert_eq!(sim.lacks_on_device().as_deref(), Some("systems of a plugin"));
}

#[test]
fn a_state_that_breaks_there_is_dumped_as_on_the_cpu() {
    dumped("bodies", busy(&["unitree_a1", "spot"], 40), 0.9, 2);
    // with what networks remember
    dumped("networks", driven(40), 2.0, 4);
}

/// Both dump the first state of each morphology that is faster than allowed, after pushes of at
/// most that speed, m/s.
fn dumped(what: &str, mut options: SimOptions, push: f32, morphologies: usize) {
    let dir = |side: &str| {
        let name = format!("whole_{what}_{side}_{}", std::process::id());
        let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        let _ = fs::remove_dir_all(&dir);
        dir
    };
    let (on_cpu, on_device) = (dir("cpu"), dir("device"));
    options.overrides.extend(BODIES.map(String::from));
    // a speed that robots reach
    options.overrides.push("terminations.illegal_state.max_lin_vel=1.2".into());
    options.overrides.push(format!("events.push_robot.velocity_range=[-{push:?}, {push:?}]"));
    let (of_cpu, of_flow) = (options.clone(), options.clone());
    let mut cpu = Sim::new(&SimOptions { dump_dir: Some(on_cpu.clone()), ..options.clone() }).unwrap();
    let mut device = on_host(SimOptions { dump_dir: Some(on_device.clone()), ..options });
    for t in 0..40 {
        step(&mut cpu, t);
        step(&mut device, t);
        assert_same_batch(&cpu, &device, &format!("step {t}"));
    }
    let states = |dir: &Path| {
        let mut files: Vec<_> = fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        let state = |file: &PathBuf| format!("{:?}", Dump::read(file).unwrap().state);
        files.iter().map(|file| (file.file_name().unwrap().to_owned(), state(file))).collect::<Vec<_>>()
    };
    let (expected, found) = (states(&on_cpu), states(&on_device));
    assert_eq!(expected.len(), morphologies);
    assert_eq!(expected, found);
    assert_eq!(device.steps_on_device(), 38);
    // and where the steps flow, though the host reads of them later
    let flowed = dir("flowed");
    let (host, mut device, _) = flowing(SimOptions { dump_dir: Some(flowed.clone()), ..of_flow });
    let mut cpu = Sim::new(&of_cpu).unwrap();
    for t in 0..40 {
        step(&mut cpu, t);
        flow(&host, &mut device, &cpu.batch().actions.clone());
    }
    device.fetch_batch().unwrap();
    assert_eq!(expected, states(&flowed));
}

/// A host that is lost after some control steps.
struct Lost(Host, Arc<AtomicUsize>);

struct LostBlock(Box<dyn DeviceBlock>, Arc<AtomicUsize>);

impl Device for Lost {
    fn name(&self) -> &str {
        "lost"
    }

    fn allocate(&self, shape: Shape) -> Result<Box<dyn DeviceBlock>, DeviceError> {
        Ok(Box::new(LostBlock(self.0.allocate(shape)?, self.1.clone())))
    }

    fn place_rows(&self, sizes: RowSizes) -> Result<(), DeviceError> {
        self.0.place_rows(sizes)
    }

    fn rows(&self) -> Option<DeviceRows> {
        self.0.rows()
    }

    fn read_rows(&self, of: RowsOf, to: &mut [f32]) -> Result<(), DeviceError> {
        self.0.read_rows(of, to)
    }

    fn write_rows(&self, of: RowsOf, from: &[f32]) -> Result<(), DeviceError> {
        self.0.write_rows(of, from)
    }

    fn write_ends(&self, ends: &[u8]) -> Result<(), DeviceError> {
        self.0.write_ends(ends)
    }
}

impl DeviceBlock for LostBlock {
    fn shape(&self) -> &Shape {
        self.0.shape()
    }

    fn exchange(&mut self) -> Exchange<'_> {
        self.0.exchange()
    }

    fn set_parameters(
        &mut self,
        common: &[f32],
        own: u32,
        tiles: &[f32],
        changed: &[usize],
    ) -> Result<(), DeviceError> {
        self.0.set_parameters(common, own, tiles, changed)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        self.0.start()
    }

    fn contacts_if_done(&mut self) -> Result<Option<usize>, DeviceError> {
        self.0.contacts_if_done()
    }

    fn envs(&mut self) -> Option<&mut dyn EnvBlock> {
        Some(self)
    }
}

impl LostBlock {
    fn envs_of_host(&mut self) -> Result<&mut dyn EnvBlock, DeviceError> {
        let lost = DeviceError::Call { call: "step", text: "lost".into() };
        self.0.envs().filter(|_| self.1.load(Ordering::Relaxed) > 0).ok_or(lost)
    }
}

impl EnvBlock for LostBlock {
    fn place(&mut self, task: TaskTables, first: usize) -> Result<(), DeviceError> {
        self.envs_of_host()?.place(task, first)
    }

    fn told(&mut self, slot: usize) -> Option<Told<'_>> {
        self.0.envs()?.told(slot)
    }

    fn host(&mut self) -> Option<EnvHost<'_>> {
        self.0.envs()?.host()
    }

    fn watch(&mut self, watched: bool) -> Result<(), DeviceError> {
        self.envs_of_host()?.watch(watched)
    }

    fn kept(&mut self, robot: usize) -> Result<Option<Vec<f32>>, DeviceError> {
        self.envs_of_host()?.kept(robot)
    }

    fn upload(&mut self) -> Result<(), DeviceError> {
        self.envs_of_host()?.upload()
    }

    fn download(&mut self) -> Result<(), DeviceError> {
        self.envs_of_host()?.download()
    }

    fn start(&mut self, slot: Option<usize>) -> Result<(), DeviceError> {
        let _ = self.1.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1));
        self.envs_of_host()?.start(slot)
    }
}

#[test]
fn a_card_that_is_lost_with_the_state_is_an_error_in_each_step() {
    let device = Arc::new(AtomicUsize::new(6));
    let mut sim = on(busy(&["unitree_a1"], 20), move || Ok(Arc::new(Lost(Host::default(), device.clone()))));
    let saved = sim.snapshot().unwrap();
    // two steps on the host, and five on the card
    for t in 0..7 {
        step(&mut sim, t);
    }
    let actions = vec![0.0; sim.batch().actions.len()];
    for _ in 0..2 {
        let error = sim.step(&actions).unwrap_err().to_string();
        assert!(error.contains("the card failed in the middle of a simulation"), "{error}");
    }
    // a look at the states that are gone mends nothing, a snapshot does
    sim.world_mut();
    for _ in 0..2 {
        let error = sim.step(&actions).unwrap_err().to_string();
        assert!(error.contains("the card failed in the middle of a simulation"), "{error}");
    }
    sim.restore(&saved).unwrap();
    sim.step(&actions).unwrap();
}

#[test]
fn a_card_that_is_lost_while_steps_flow_is_an_error_too() {
    let (host, left) = (Host::default(), Arc::new(AtomicUsize::new(6)));
    let device = (host.clone(), left);
    let mut sim = on(busy(&["unitree_a1"], 20), move || Ok(Arc::new(Lost(device.0.clone(), device.1.clone()))));
    let saved = sim.snapshot().unwrap();
    let rows = sim.device_rows().unwrap().unwrap();
    let actions = vec![0.0; rows.sizes.part(RowsOf::Given).len()];
    for _ in 0..5 {
        flow(&host, &mut sim, &actions);
    }
    for _ in 0..2 {
        let error = sim.step_device(0).unwrap_err().to_string();
        assert!(error.contains("the card failed in the middle of a simulation"), "{error}");
    }
    let error = sim.device_rows().unwrap_err().to_string();
    assert!(error.contains("the card failed in the middle of a simulation"), "{error}");
    sim.restore(&saved).unwrap();
    sim.step(&actions).unwrap();
}
