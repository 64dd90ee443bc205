//! Helpers that several promises share: an eventful task, reproducible actions, and envs as bits.

pub mod driven;
pub mod facts;

use std::ops::Range;

use bevy_ecs::prelude::World;
use polypod::components::{
    BasePose, BaseVelocity, Body, Command, ContactForces, ContactSensor, EnvId, Episode, EpisodeSums, Feet,
    JointEffort, JointState,
};
use polypod::dynamics::{
    ContactSettings, ControlStep, Drive, Kernels, Parameters, Report, State, StepSettings, Topology, Workspace,
};
use polypod::{Sim, SimOptions};

/// A size of a test, such as a number of samples: `core` with `make test`, `extended` with `make
/// test TIER=extended`. Both assert the same.
pub fn size<T>(core: T, extended: T) -> T {
    match std::env::var("POLYPOD_TEST_TIER").as_deref() {
        Err(_) | Ok("" | "core") => core,
        Ok("extended") => extended,
        Ok(other) => panic!("POLYPOD_TEST_TIER: `{other}` is not a tier; use core or extended"),
    }
}

/// All built-in robots, in the order of the flat task.
pub const ROBOTS: [&str; 8] =
    ["anymal_d", "anymal_c", "anymal_b", "unitree_a1", "unitree_go1", "unitree_go2", "unitree_b2", "spot"];

/// Velocity command and contact sensor of each env's robot, by env.
pub fn commands_and_sensors(world: &mut World) -> (Vec<[f64; 3]>, Vec<ContactSensor>) {
    let mut query = world.query::<(&EnvId, &Command)>();
    let commands = query.iter(world).sort::<&EnvId>().map(|(_, command)| command.velocity.map(f64::from)).collect();
    let mut query = world.query::<(&EnvId, &ContactSensor)>();
    (commands, query.iter(world).sort::<&EnvId>().map(|(_, sensor)| sensor.clone()).collect())
}

/// The flat task, with short episodes and frequent pushes and commands so that a short run meets
/// all of them, on one thread.
pub fn busy(robots: &[&str], num_envs: usize) -> SimOptions {
    SimOptions {
        robots: Some(robots.iter().map(|robot| robot.to_string()).collect()),
        seed: 7,
        threads: Some(1),
        overrides: [
            "sim.episode_length_s=1.2",
            "commands.base_velocity.resampling_time_s=0.3",
            "events.push_robot.interval_range_s=[0.2, 0.4]",
        ]
        .map(String::from)
        .to_vec(),
        ..SimOptions::new("velocity_flat", num_envs)
    }
}

/// The engine's own control step, without actions.
pub fn control_step<S: Kernels>(
    topology: &Topology,
    settings: &StepSettings,
    parameters: &Parameters<S>,
    state: &mut State<S>,
) {
    ControlStep {
        topology,
        settings,
        terrain: None,
        parameters,
        nominal: None,
        drive: &Drive::zeros(topology, 1),
        substeps: 0..settings.decimation,
        state,
        report: &mut Report::zeros(topology, settings.decimation),
        work: &mut Workspace::new(topology),
    }
    .run();
}

/// Control step of a robot in free fall whose joints turn with this velocity, rad/s or m/s.
pub fn fall(topology: &Topology, parameters: &Parameters<f32>, joint_velocity: f32, decimation: usize) -> State<f32> {
    let settings =
        StepSettings { dt: 0.005, decimation, gravity: [0.0, 0.0, -9.81], contact: ContactSettings::default() };
    let mut state = State::zeros(topology);
    state.joint_velocity.fill(joint_velocity);
    control_step(topology, &settings, parameters, &mut state);
    state
}

/// The same task on ground that resists turning and rolling, with another coefficient in each env.
pub fn turning(mut options: SimOptions) -> SimOptions {
    let more = ["scene.ground.rolling_friction=0.004", "events.physics_material.torsional_friction_range=[0.0, 0.03]"];
    options.overrides.extend(more.map(String::from));
    options
}

/// The same task with a spring at each joint, and front legs that touch the ground otherwise than
/// the rest.
pub fn sprung(mut options: SimOptions) -> SimOptions {
    for robot in options.robots.iter().flatten() {
        let own = format!("robot_overrides.{robot}");
        options.overrides.extend([
            format!("{own}.actuators.legs.spring_stiffness=8.0"),
            format!("{own}.actuators.legs.spring_reference=0.4"),
            format!(
                "{own}.surfaces={{front={{bodies=[\"*F*\"], friction=0.5, torsional_friction=0.01, contact_margin=0.002}}}}"
            ),
        ]);
    }
    options
}

/// The path of a task file that extends another task by these lines; `name` tells it from those of
/// other tests.
pub fn extended_task(name: &str, extends: &str, lines: &str) -> String {
    let folder = std::env::temp_dir().join(format!("polypod-tests-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join(format!("{name}.toml"));
    std::fs::write(&path, format!("extends = \"{extends}\"\nname = \"{name}\"\n{lines}\n")).unwrap();
    path.to_str().unwrap().to_string()
}

/// The sum of the contact forces on a robot in the last physics step, along the world's z, N.
pub fn upward_force(forces: &ContactForces) -> f64 {
    let others = forces.others.iter().map(|force| &force.net);
    forces.feet.iter().chain(others).map(|net| f64::from(net[2])).sum()
}

/// A number in `[-1, 1)` that depends on its arguments alone.
pub fn noise(stream: u64, env: usize, step: usize, slot: usize) -> f32 {
    let mut x = stream;
    for word in [env, step, slot] {
        // splitmix64
        x = (x ^ word as u64).wrapping_add(0x9e37_79b9_7f4a_7c15);
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^= x >> 31;
    }
    (x >> 40) as f32 / (1 << 23) as f32 - 1.0
}

/// One control step; each env's actions are drawn from its own stream, so that they depend on no
/// other env.
pub fn step_with(sim: &mut Sim, step: usize, stream: impl Fn(usize) -> u64) {
    let width = sim.batch().num_actions;
    let actions: Vec<f32> =
        (0..sim.batch().actions.len()).map(|i| noise(stream(i / width), i / width, step, i % width)).collect();
    sim.step(&actions).unwrap();
}

/// One control step with the usual actions.
pub fn step(sim: &mut Sim, step: usize) {
    step_with(sim, step, |_| 0);
}

/// The bits of each env: its rows of the batch, and its components as far as the batch does not
/// show them.
pub fn env_bits(sim: &mut Sim) -> Vec<Vec<u32>> {
    let batch = sim.batch();
    let row = |data: &[f32], env: usize| bits(&data[env * batch.num_obs..(env + 1) * batch.num_obs]);
    let mut envs: Vec<Vec<u32>> = (0..batch.num_envs)
        .map(|env| {
            let mut out = row(&batch.observations, env);
            out.push(batch.rewards[env].to_bits());
            out.extend([batch.terminated[env], batch.truncated[env], batch.has_final[env]].map(u32::from));
            if batch.has_final[env] {
                out.extend(row(&batch.final_observations, env));
            }
            out
        })
        .collect();
    let world = sim.world_mut();
    let mut robots = world.query::<(&EnvId, &BasePose, &BaseVelocity, &JointState, &JointEffort, &Feet, &Body)>();
    for (env, pose, velocity, joints, effort, feet, body) in robots.iter(world) {
        let out = &mut envs[env.0 as usize];
        out.extend(bits(&pose.position).into_iter().chain(bits(&pose.rotation)));
        out.extend(bits(&velocity.linear).into_iter().chain(bits(&velocity.angular)));
        out.extend(bits(&joints.position).into_iter().chain(bits(&joints.velocity)));
        out.extend(bits(&effort.applied).into_iter().chain(bits(&effort.acceleration)));
        out.extend(feet.position.iter().chain(&feet.velocity).flat_map(|x| bits(x)));
        out.extend(bits(&body.0.com[0]));
        out.extend(bits(&[body.0.mass[0], body.0.static_friction, body.0.dynamic_friction]));
    }
    for (env, episode, command, sums) in world.query::<(&EnvId, &Episode, &Command, &EpisodeSums)>().iter(world) {
        let out = &mut envs[env.0 as usize];
        out.extend([episode.length, episode.causes]);
        out.extend(bits(&command.velocity).into_iter().chain(bits(&[command.heading, command.time_left])));
        out.extend(bits(&sums.terms));
    }
    for (env, contacts) in world.query::<(&EnvId, &ContactSensor)>().iter(world) {
        let out = &mut envs[env.0 as usize];
        out.extend(bits(&contacts.peak_force).into_iter().chain(bits(&contacts.contact_time)));
    }
    envs
}

/// The bits of numbers: equal ones are the same to the last bit, and NaNs compare like everything
/// else.
pub fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|x| x.to_bits()).collect()
}

/// Envs `a_envs` of `a` and `b_envs` of `b` are the same, bit for bit.
#[track_caller]
pub fn assert_same(a: &mut Sim, a_envs: Range<usize>, b: &mut Sim, b_envs: Range<usize>, when: &str) {
    assert_eq!(a_envs.len(), b_envs.len());
    let (left, right) = (env_bits(a), env_bits(b));
    for (i, j) in a_envs.zip(b_envs) {
        let differing = left[i].iter().zip(&right[j]).position(|(x, y)| x != y);
        assert!(
            differing.is_none() && left[i].len() == right[j].len(),
            "{when}: env {i} differs from env {j}, first at number {differing:?} of {}",
            left[i].len()
        );
    }
}

/// All envs are the same, bit for bit.
#[track_caller]
pub fn assert_all_same(a: &mut Sim, b: &mut Sim, when: &str) {
    let (n, m) = (a.num_envs(), b.num_envs());
    assert_same(a, 0..n, b, 0..m, when);
}

/// Episodes that ended in the last control step.
pub fn ended(sim: &Sim) -> usize {
    let batch = sim.batch();
    batch.terminated.iter().zip(&batch.truncated).filter(|(terminated, truncated)| **terminated || **truncated).count()
}

/// Whether heights on a grid of `pitch`, six of it to each side of a place, rise or fall by more
/// than `step` between neighbours.
pub fn near_a_step(height: &impl Fn(f32, f32) -> f32, [x, y]: [f32; 2], pitch: f32, step: f32) -> bool {
    (-6..6).any(|i| {
        (-6..6).any(|j| {
            let at = |i: i32, j: i32| height(x + pitch * i as f32, y + pitch * j as f32);
            let here = at(i, j);
            (at(i + 1, j) - here).abs().max((at(i, j + 1) - here).abs()) > step
        })
    })
}
