//! A command is drawn from its ranges, again after its time, and not where the caller has set it.
//! Observations and rewards follow it; a task without it refuses them by name.

use polypod::components::{
    BasePose, BaseVelocity, Command, CommandNumbers, ContactSensor, EnvId, EpisodeSums, Feet, Imu,
};
use polypod::{Error, Sim, SimOptions};

use crate::common;

/// A task with all commands; `lines` end it.
fn task(name: &str, lines: &str) -> String {
    let commands = r#"
[commands.pose]
resampling_time_s = 0.1
height_share = [0.6, 1.0]
roll = [-0.3, 0.3]
pitch = [0.1, 0.4]
[commands.heading]
resampling_time_s = 0.06
heading = [1.0, 3.0]
[commands.position]
pos_x = [2.0, 3.0]
pos_y = [-4.0, -1.0]
[commands.gait]
resampling_time_s = 10.0
frequency = [1.5, 3.0]
duration = [0.4, 0.6]
[commands.foot_placement]
stance_width = [0.8, 1.4]
stance_length = [0.7, 1.2]
[commands.jump]
time = [0.02, 0.06]
height_share = [0.2, 0.6]
length = [-0.2, 0.5]
"#;
    common::extended_task(name, "velocity_flat", &format!("{commands}{lines}"))
}

fn options(task: String) -> SimOptions {
    let robots = ["unitree_go1", "anymal_c"].map(String::from);
    SimOptions { robots: Some(robots.into()), seed: 3, threads: Some(1), ..SimOptions::new(task, 64) }
}

/// Numbers of a command of all envs.
fn numbers(sim: &mut Sim, name: &str) -> Vec<Vec<f32>> {
    let range = sim.task().command_terms.iter().find(|term| term.name == name).unwrap().range.clone();
    let world = sim.world_mut();
    let mut all: Vec<_> = world.query::<(&EnvId, &CommandNumbers)>().iter(world).collect();
    all.sort_by_key(|(env, _)| **env);
    all.into_iter().map(|(_, commands)| commands.numbers[range.clone()].to_vec()).collect()
}

fn still(sim: &mut Sim, steps: usize) {
    let actions = vec![0.0; sim.batch().actions.len()];
    (0..steps).for_each(|_| sim.step(&actions).unwrap());
}

#[test]
fn draws_stay_in_their_ranges_and_follow_their_times() {
    let mut sim = Sim::new(&options(task("draws", ""))).unwrap();
    let within = |values: &[Vec<f32>], column: usize, [low, high]: [f32; 2]| {
        let column: Vec<f32> = values.iter().map(|row| row[column]).collect();
        assert!(column.iter().all(|x| (low..=high).contains(x)), "{column:?}");
        let (least, most) = (column.iter().copied().fold(high, f32::min), column.iter().copied().fold(low, f32::max));
        assert!(most - least > 0.8 * (high - low), "{least} to {most} of {low} to {high}");
    };
    let pose = numbers(&mut sim, "pose");
    within(&pose, 1, [-0.3, 0.3]);
    within(&pose, 2, [0.1, 0.4]);
    let (placement, jump) = (numbers(&mut sim, "foot_placement"), numbers(&mut sim, "jump"));
    within(&placement, 0, [0.8, 1.4]);
    within(&placement, 1, [0.7, 1.2]);
    // a reset makes no control step: the time of the jump is as drawn
    within(&jump, 0, [-0.06, -0.02]);
    within(&jump, 2, [-0.2, 0.5]);
    // each robot in shares of its own height
    let mut shares = Vec::new();
    for (index, rows) in [(0, 0..32), (1, 32..64)] {
        let model = &sim.morphologies()[index];
        let height = model.stance.spawn_height - model.config.reset.spawn_margin as f32;
        within(&pose[rows.clone()], 0, [0.6 * height, height]);
        let hips = height + model.hip_height;
        shares.extend(jump[rows.clone()].iter().map(|row| vec![row[1] / hips]));
        assert!(placement[rows].iter().all(|row| (row[2] - 0.2 * hips).abs() < 1e-6));
    }
    within(&shares, 0, [0.2, 0.6]);
    within(&numbers(&mut sim, "heading"), 0, [1.0, 3.0]);
    let position = numbers(&mut sim, "position");
    within(&position, 0, [2.0, 3.0]);
    within(&position, 1, [-4.0, -1.0]);
    let gait = numbers(&mut sim, "gait");
    within(&gait, 1, [1.5, 3.0]);
    within(&gait, 5, [0.4, 0.6]);
    assert!(gait.iter().all(|row| row[2..5] == [0.5, 0.0, 0.0]));

    still(&mut sim, 3);
    let heading = numbers(&mut sim, "heading");
    assert_eq!((&numbers(&mut sim, "pose"), &numbers(&mut sim, "position")), (&pose, &position));
    still(&mut sim, 1);
    assert!(numbers(&mut sim, "heading").iter().zip(&heading).all(|(now, then)| now != then));
    still(&mut sim, 2);
    assert!(numbers(&mut sim, "pose").iter().zip(&pose).all(|(now, then)| now != then));
    // without a resampling time a reset alone draws
    assert_eq!(numbers(&mut sim, "position"), position);
    sim.reset(None, None).unwrap();
    assert!(numbers(&mut sim, "position").iter().zip(&position).all(|(now, then)| now != then));
    for (now, first) in numbers(&mut sim, "foot_placement").iter().zip(&placement) {
        assert_ne!(now, first);
    }
    // the clock runs at the frequency, through draws and resets
    let now = numbers(&mut sim, "gait");
    for (row, first) in now.iter().zip(&gait) {
        let turns = first[1] * 6.0 * 0.02;
        assert!((row[0] - turns).abs() < 1e-5, "{row:?}, {turns}");
    }
}

#[test]
fn a_pinned_command_stays_until_it_is_released() {
    let mut sim = Sim::new(&options(task("pins", ""))).unwrap();
    let wanted: Vec<f32> = (0..64).map(|env| 0.01 * env as f32).collect();
    sim.pin_command("heading", Some(&wanted)).unwrap();
    still(&mut sim, 10);
    sim.reset(None, None).unwrap();
    assert_eq!(numbers(&mut sim, "heading").concat(), wanted);
    sim.pin_command("heading", None).unwrap();
    still(&mut sim, 10);
    assert!(numbers(&mut sim, "heading").concat().iter().all(|heading| *heading >= 1.0));
    // some envs alone
    sim.pin_command_of(&[5, 2], "heading", Some(&[0.25, 0.5])).unwrap();
    still(&mut sim, 10);
    let now = sim.command_numbers("heading").unwrap();
    assert_eq!((now[2], now[5]), (0.5, 0.25));
    assert!(now.iter().enumerate().all(|(env, heading)| [2, 5].contains(&env) || *heading >= 1.0), "{now:?}");
    for (name, given, said) in [("headings", 64, "did you mean `heading`"), ("heading", 63, "64 rows of heading")] {
        let error = sim.pin_command(name, Some(&vec![0.0; given])).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}

#[test]
fn observations_and_rewards_follow_the_commands() {
    let rewards = r#"
[rewards.unitree]
track_base_height_exp = { weight = 1.0, std = 0.2 }
orientation_control = { weight = 1.0 }
heading_command_error_abs = { weight = 1.0 }
heading_there = { term = "heading_command_error_abs", weight = 1.0, command_name = "position" }
position_command_error_tanh = { weight = 1.0, std = 2.0 }
tracking_contacts_shaped_force = { weight = 1.0 }
tracking_contacts_shaped_vel = { weight = 1.0 }
[observations]
enable_noise = false
policy = [{ term = "pose_commands" }, { term = "heading_commands" }, { term = "position_commands" }, { term = "clock_inputs" }, { term = "gait_commands" }]
"#;
    let options = SimOptions { robots: Some(vec!["unitree_go1".into()]), ..options(task("follows", rewards)) };
    let mut sim = Sim::new(&options).unwrap();
    still(&mut sim, 1);
    let (pose, heading) = (numbers(&mut sim, "pose"), numbers(&mut sim, "heading"));
    let (position, gait) = (numbers(&mut sim, "position"), numbers(&mut sim, "gait"));
    let names: Vec<String> = sim.task().rewards[0].iter().map(|term| term.name.clone()).collect();
    let feet = sim.morphologies()[0].feet.clone();
    let (observations, width) = (sim.batch().observations.clone(), sim.batch().num_obs);
    let world = sim.world_mut();
    let mut sensors = world.query::<(&EnvId, &ContactSensor)>();
    let mut forces: Vec<_> = sensors.iter(world).map(|(env, sensor)| (*env, sensor.peak_force.clone())).collect();
    forces.sort_by_key(|(env, _)| *env);
    let mut sums: Vec<_> =
        world.query::<(&EnvId, &EpisodeSums)>().iter(world).map(|(env, sums)| (*env, sums.terms.clone())).collect();
    sums.sort_by_key(|(env, _)| *env);
    let mut imus: Vec<_> =
        world.query::<(&EnvId, &Imu)>().iter(world).map(|(env, imu)| (*env, imu.projected_gravity)).collect();
    imus.sort_by_key(|(env, _)| *env);
    let mut robots = world.query::<(&EnvId, &BasePose, &Feet)>();
    let states: Vec<_> = robots.iter(world).map(|(env, pose, feet)| (env.0 as usize, *pose, feet.clone())).collect();
    assert_eq!(states.len(), 64);
    for (env, base, foot) in states {
        let [w, x, y, z] = base.rotation.map(f64::from);
        let yaw = (2.0 * (x * y + w * z)).atan2(1.0 - 2.0 * (y * y + z * z));
        let wrap = |angle: f64| angle.sin().atan2(angle.cos());
        let turn = wrap(f64::from(heading[env][0]) - yaw);
        let [px, py, wanted] = [0, 1, 2].map(|k| f64::from(position[env][k]));
        let (dx, dy) = (px - f64::from(base.position[0]), py - f64::from(base.position[1]));
        let there = [yaw.cos() * dx + yaw.sin() * dy, yaw.cos() * dy - yaw.sin() * dx, wrap(wanted - yaw)];
        let [clock, frequency, phase, offset, bound, duration] = [0, 1, 2, 3, 4, 5].map(|k| f64::from(gait[env][k]));
        // left front, left hind, right front, right hind
        let clocks = [phase + offset + bound, bound, offset, phase].map(|lead| {
            let at = (clock + lead).rem_euclid(1.0);
            if at < duration { 0.5 * at / duration } else { 0.5 + 0.5 * (at - duration) / (1.0 - duration) }
        });
        let sines = clocks.map(|clock| (std::f64::consts::TAU * clock).sin());
        let seen =
            [&[0, 1, 2].map(|k| f64::from(pose[env][k]))[..], &[turn], &there, &sines, &[frequency, duration]].concat();
        let row = &observations[env * width..(env + 1) * width];
        for (found, expected) in row.iter().zip(&seen) {
            assert!((f64::from(*found) - expected).abs() < 2e-5, "{row:?} is not {seen:?}");
        }

        let gravity = imus[env].1.map(f64::from);
        let [height, roll, pitch] = [0, 1, 2].map(|k| f64::from(pose[env][k]));
        let lean = [gravity[0] - pitch.sin(), gravity[1] + roll.sin() * pitch.cos()];
        let cdf = |x: f64| 1.0 / (1.0 + (-1.702 * x / 0.07).exp());
        let stand = clocks.map(|c| cdf(c) * (1.0 - cdf(c - 0.5)) + cdf(c - 1.0) * (1.0 - cdf(c - 1.5)));
        let (mut force, mut speed) = (0.0, 0.0);
        for k in 0..4 {
            let f = f64::from(forces[env].1[feet[k]]);
            let v: f64 = foot.velocity[k].iter().map(|v| f64::from(*v).powi(2)).sum();
            force -= 0.25 * (1.0 - stand[k]) * (1.0 - (-f * f / 100.0).exp());
            speed -= 0.25 * stand[k] * (1.0 - (-v / 10.0).exp());
        }
        for (name, sum) in names.iter().zip(&sums[env].1) {
            let expected = match name.as_str() {
                "track_base_height_exp" => (-(height - f64::from(base.position[2])).powi(2) / 0.04).exp(),
                "orientation_control" => lean[0] * lean[0] + lean[1] * lean[1],
                "heading_command_error_abs" => turn.abs(),
                "heading_there" => there[2].abs(),
                "position_command_error_tanh" => 1.0 - (there[0].hypot(there[1]) / 2.0).tanh(),
                "tracking_contacts_shaped_force" => force,
                "tracking_contacts_shaped_vel" => speed,
                _ => continue,
            };
            let found = f64::from(*sum) / 0.02;
            assert!((found - expected).abs() < 1e-4, "{name} of env {env} is {found}, not {expected}");
        }
    }
}

#[test]
fn feet_and_jumps_follow_their_commands() {
    let lines = r#"
[rewards.unitree]
raibert_heuristic = { weight = 1.0 }
feet_clearance_cmd_linear = { weight = 1.0 }
jump_height_exp = { weight = 1.0, std = 0.3 }
jump_velocity_exp = { weight = 1.0, std = 0.5 }
jump_contacts = { weight = 1.0 }
[observations]
enable_noise = false
policy = [{ term = "foot_placement_commands" }, { term = "jump_commands" }]
"#;
    let options = SimOptions { robots: Some(vec!["unitree_go1".into()]), ..options(task("feet", lines)) };
    let mut sim = Sim::new(&options).unwrap();
    let time = |env: usize| if env == 0 { -3.0 } else { -0.2 + 0.01 * env as f32 };
    let jumps: Vec<f32> = (0..64).flat_map(|env| [time(env), 0.1, 0.02 * env as f32 - 0.6]).collect();
    sim.pin_command("jump", Some(&jumps)).unwrap();
    let actions: Vec<f32> = (0..sim.batch().actions.len()).map(|i| (i as f32 * 0.7).sin()).collect();
    sim.step(&actions).unwrap();
    let (placement, jump, gait) =
        (numbers(&mut sim, "foot_placement"), numbers(&mut sim, "jump"), numbers(&mut sim, "gait"));
    let model = sim.morphologies()[0].clone();
    let height = f64::from(model.stance.spawn_height) - model.config.reset.spawn_margin;
    let hips = height + f64::from(model.hip_height);
    // the feet of the standing robot, by its links
    let standing: Vec<[f64; 3]> = {
        let position: Vec<f64> = model.stance.default_position.iter().map(|&q| f64::from(q)).collect();
        let links = model.model.forward_kinematics(&position);
        let feet = model.roles.foot_body.iter().zip(&model.roles.foot_point);
        feet.map(|(&body, &point)| links[model.model.bodies[body].link].transform_point(point).to_array()).collect()
    };
    let lowest = standing.iter().map(|[_, _, z]| height + z).fold(f64::INFINITY, f64::min);
    assert!((0.01..0.03).contains(&lowest), "feet rest on the ground: {lowest}");
    let names: Vec<String> = sim.task().rewards[0].iter().map(|term| term.name.clone()).collect();
    let (observations, width) = (sim.batch().observations.clone(), sim.batch().num_obs);
    let world = sim.world_mut();
    let mut of_envs = world.query::<(&EnvId, &EpisodeSums, &Command)>();
    let mut envs: Vec<_> = of_envs.iter(world).map(|(env, sums, c)| (*env, sums.terms.clone(), c.velocity)).collect();
    envs.sort_by_key(|(env, ..)| *env);
    let mut sensors = world.query::<(&EnvId, &ContactSensor)>();
    let mut forces: Vec<_> = sensors.iter(world).map(|(env, sensor)| (*env, sensor.peak_force.clone())).collect();
    forces.sort_by_key(|(env, _)| *env);
    let mut robots = world.query::<(&EnvId, &BasePose, &BaseVelocity, &Feet)>();
    let states: Vec<_> = robots.iter(world).map(|(env, p, v, feet)| (env.0 as usize, *p, *v, feet.clone())).collect();
    let mut flights = 0;
    for (env, base, velocity, foot) in states {
        let [w, x, y, z] = base.rotation.map(f64::from);
        let yaw = (2.0 * (x * y + w * z)).atan2(1.0 - 2.0 * (y * y + z * z));
        let turned = |x: f64, y: f64| [yaw.cos() * x + yaw.sin() * y, yaw.cos() * y - yaw.sin() * x];
        let [wide, long, swing] = [0, 1, 2].map(|k| f64::from(placement[env][k]));
        let [clock, frequency, phase, offset, bound, duration] = [0, 1, 2, 3, 4, 5].map(|k| f64::from(gait[env][k]));
        let [vx, vy, turn] = envs[env].2.map(f64::from);
        let (mut places, mut heights) = (0.0, 0.0);
        // left front, left hind, right front, right hind
        for (k, lead) in [phase + offset + bound, bound, offset, phase].into_iter().enumerate() {
            let at = (clock + lead).rem_euclid(1.0);
            let part = if at < duration { 0.5 * at / duration } else { 0.5 + 0.5 * (at - duration) / (1.0 - duration) };
            let [x, y] = [standing[k][0] * long, standing[k][1] * wide];
            // half a stance ahead at touchdown, half behind at lift-off
            let share = if part < 0.5 { 0.5 - 2.0 * part } else { 2.0 * part - 1.5 };
            let ahead = [(vx - turn * y) * share * 0.5 / frequency, (vy + turn * x) * share * 0.5 / frequency];
            let [to_x, to_y] = [0, 1].map(|i| f64::from(foot.position[k][i]) - f64::from(base.position[i]));
            let [to_x, to_y] = turned(to_x, to_y);
            places += (to_x - x - ahead[0]).powi(2) + (to_y - y - ahead[1]).powi(2);
            let cdf = |x: f64| 1.0 / (1.0 + (-1.702 * x / 0.07).exp());
            let stands = cdf(part) * (1.0 - cdf(part - 0.5)) + cdf(part - 1.0) * (1.0 - cdf(part - 1.5));
            // a triangle over the swing
            let up = if part < 0.5 { 0.0 } else { 1.0 - (4.0 * part - 3.0).abs() };
            let wanted = swing * up + height + standing[k][2];
            heights += (1.0 - stands) * (wanted - f64::from(foot.height[k])).powi(2);
        }
        let [time, rise, length] = [0, 1, 2].map(|k| f64::from(jump[env][k]));
        // the parabola of free fall that rises this high
        let (take_off, flight) = ((2.0 * 9.81 * rise).sqrt(), 2.0 * (2.0 * rise / 9.81).sqrt());
        let flies = (0.0..flight).contains(&time);
        flights += usize::from(flies);
        let above = if flies { take_off * time - 0.5 * 9.81 * time * time } else { 0.0 };
        let speed = if flies { length / flight } else { 0.0 };
        let [forward, left] = turned(f64::from(velocity.linear[0]), f64::from(velocity.linear[1]));
        let right = model.feet.iter().filter(|&&body| (forces[env].1[body] <= 1.0) == flies).count() as f64 / 4.0;
        for (name, sum) in names.iter().zip(&envs[env].1) {
            let expected = match name.as_str() {
                "raibert_heuristic" => places,
                "feet_clearance_cmd_linear" => heights,
                "jump_height_exp" => (-((f64::from(base.position[2]) - height - above) / (0.3 * hips)).powi(2)).exp(),
                "jump_velocity_exp" => (-((forward - speed).powi(2) + left * left) / 0.25).exp(),
                "jump_contacts" => right,
                _ => continue,
            };
            let found = f64::from(*sum) / 0.02;
            assert!((found - expected).abs() < 1e-4, "{name} of env {env} is {found}, not {expected}");
        }
        let seen = [wide, long, swing, time.clamp(-1.0, 1.0), rise, length];
        for (found, expected) in observations[env * width..(env + 1) * width].iter().zip(seen) {
            assert!((f64::from(*found) - expected).abs() < 2e-5, "{found} of env {env} is not {expected}");
        }
    }
    assert!((10..54).contains(&flights), "{flights} jumps are in flight");
    // a term that follows several commands names the one that is missing
    let lines = "[commands.gait]\nfrequency = [2.0, 2.0]\n[rewards.unitree]\nraibert_heuristic = { weight = -1.0 }";
    let task = common::extended_task("placeless", "velocity_flat", lines);
    let error = Sim::new(&SimOptions { robots: Some(vec!["unitree_go1".into()]), ..SimOptions::new(task, 1) });
    let error = error.err().unwrap().to_string();
    assert!(error.contains("raibert_heuristic") && error.contains("[commands.foot_placement]"), "{error}");
}

#[test]
fn a_task_refuses_terms_of_commands_that_it_lacks() {
    let refused = |task: String, overrides: &[&str], said: &[&str]| {
        let overrides = overrides.iter().map(|text| text.to_string()).collect();
        let robots = Some(vec!["unitree_go1".into()]);
        let error = match Sim::new(&SimOptions { overrides, robots, ..SimOptions::new(task, 1) }) {
            Err(error) => error.to_string(),
            Ok(_) => panic!("{said:?} is taken"),
        };
        said.iter().for_each(|said| assert!(error.contains(said), "{error}"));
    };
    let flat = || "velocity_flat".to_owned();
    let heading = ["rewards.unitree.heading_command_error_abs={weight=1.0}"];
    refused(flat(), &heading, &["heading_command_error_abs", "`heading`", "base_velocity", "[commands.heading]"]);
    let there = ["rewards.unitree.heading_command_error_abs={weight=1.0, command_name=\"position\"}"];
    refused(flat(), &there, &["`position`", "[commands.position]"]);
    let lines = "[[observations.critic]]\nterm = \"clock_inputs\"";
    refused(common::extended_task("clockless", "velocity_flat", lines), &[], &["clock_inputs", "`gait`"]);
    let lines = "[rewards.getup]\ntrack_lin_vel_xy_exp = { weight = 1.0, std = 0.5 }";
    let said = ["track_lin_vel_xy_exp", "`base_velocity`", "the task gives none"];
    refused(common::extended_task("velocityless", "getup_flat", lines), &[], &said);
    refused(flat(), &["commands.base_velocty.lin_vel_x=[0.0, 1.0]"], &["base_velocty", "did you mean `base_velocity`"]);
    refused(flat(), &["commands.jumps.time=[0.5, 1.0]"], &["commands.jumps", "did you mean `jump`"]);
    refused(flat(), &["commands.jump.tim=[0.5, 1.0]"], &["commands.jump", "tim"]);
    refused(flat(), &["commands.headings={}"], &["commands.headings", "did you mean `heading`"]);
    refused(flat(), &["commands.pose={rol=[0.0, 1.0]}"], &["commands.pose", "rol"]);
    refused(flat(), &["commands.gait={frequency=[-1.0, 1.0]}"], &["commands.gait.frequency", "negative"]);
}

#[test]
fn a_task_without_a_velocity_command_says_so() {
    let robots = Some(vec!["unitree_go1".into()]);
    let mut sim = Sim::new(&SimOptions { robots, ..SimOptions::new("getup_flat", 2) }).unwrap();
    let error = sim.set_commands(Some(&[0.0; 6])).unwrap_err();
    assert!(matches!(error, Error::Argument { .. }), "{error}");
    let error = error.to_string();
    ["Getup-Flat-v0", "none", "base_velocity"].iter().for_each(|said| assert!(error.contains(said), "{error}"));
    sim.set_commands(None).unwrap();
}
