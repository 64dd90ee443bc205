//! Draws of events lie in their ranges, reach their ends, have their distributions, and depend on
//! no other draw.
//!
//! Distributions are tested by Kolmogorov and Smirnov, or for whole numbers by chi-square,
//! independence by correlation, each on a level of 1 in 1000 or less. The draws are seeded: what
//! passes once passes always.

use polypod::components::{
    ActuatorDelay, BasePose, BaseVelocity, Body, Command, EnvId, EventTimers, ExternalWrench, JointState, Stance,
};
use polypod::morphology::MorphologyModel;
use polypod::{Sim, SimOptions};

const ENVS: usize = 3000;
/// sqrt(n) times the largest distance of two distribution functions that chance exceeds once in
/// 1000 times.
const KOLMOGOROV: f64 = 1.949;
/// sqrt(n) times a correlation that chance exceeds once in 10000 times.
const CORRELATION: f64 = 3.89;

const STARTUP: [&str; 3] = ["randomize_actuator_gains", "randomize_joint_parameters", "randomize_motor_strength"];
const AT_RESET: [&str; 2] = ["base_external_force_torque", "action_delay"];

fn options(robot: &str, events: &[&str], more: &[&str], seed: u64) -> SimOptions {
    let switches = events.iter().map(|event| format!("events.{event}.enabled=true"));
    SimOptions {
        robots: Some(vec![robot.into()]),
        seed,
        threads: Some(1),
        overrides: switches.chain(more.iter().map(ToString::to_string)).collect(),
        ..SimOptions::new("velocity_flat", ENVS)
    }
}

/// A quantity with its range and what each env drew.
struct Column {
    name: String,
    range: [f64; 2],
    drawn: Vec<f64>,
}

fn column(name: impl Into<String>, range: [f64; 2], drawn: Vec<f64>) -> Column {
    Column { name: name.into(), range, drawn }
}

fn bodies(sim: &mut Sim) -> Vec<Body> {
    let world = sim.world_mut();
    let mut rows: Vec<_> =
        world.query::<(&EnvId, &Body)>().iter(world).map(|(id, body)| (id.0, body.clone())).collect();
    rows.sort_by_key(|(id, _)| *id);
    rows.into_iter().map(|(_, body)| body).collect()
}

fn read<C: bevy_ecs::component::Component, T>(sim: &mut Sim, f: impl Fn(&C) -> T) -> Vec<T> {
    let world = sim.world_mut();
    let mut rows: Vec<_> = world.query::<(&EnvId, &C)>().iter(world).map(|(id, c)| (id.0, f(c))).collect();
    rows.sort_by_key(|(id, _)| *id);
    rows.into_iter().map(|(_, value)| value).collect()
}

/// Distance of the drawn numbers' distribution function from a given one.
fn distance(drawn: &[f64], cumulative: impl Fn(f64) -> f64) -> f64 {
    let mut sorted = drawn.to_vec();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len() as f64;
    let gaps = sorted.iter().enumerate().map(|(i, &x)| {
        let expected = cumulative(x);
        (expected - i as f64 / n).abs().max((expected - (i + 1) as f64 / n).abs())
    });
    gaps.fold(0.0, f64::max)
}

#[track_caller]
fn assert_uniform(c: &Column) {
    let [low, high] = c.range;
    let width = high - low;
    let slack = 2e-6 * (1.0 + low.abs().max(high.abs()));
    let least = c.drawn.iter().copied().fold(f64::INFINITY, f64::min);
    let most = c.drawn.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    assert!(least >= low - slack && most <= high + slack, "{}: {least} .. {most} is not within {:?}", c.name, c.range);
    // chance leaves 1 % of the range out at an end once in e^30 times
    assert!(least < low + 0.01 * width && most > high - 0.01 * width, "{}: only {least} .. {most}", c.name);
    let d = distance(&c.drawn, |x| ((x - low) / width).clamp(0.0, 1.0));
    let bound = KOLMOGOROV / (c.drawn.len() as f64).sqrt();
    assert!(d < bound, "{}: not uniform, {d} is beyond {bound}", c.name);
}

/// Whole numbers `0..counts`, each as likely as the others.
#[track_caller]
fn assert_even(name: &str, drawn: &[f64], counts: usize) {
    let mut found = vec![0.0; counts];
    for &x in drawn {
        assert!(x >= 0.0 && x.fract() == 0.0 && (x as usize) < counts, "{name}: {x}");
        found[x as usize] += 1.0;
    }
    let expected = drawn.len() as f64 / counts as f64;
    let chi: f64 = found.iter().map(|n| (n - expected).powi(2) / expected).sum();
    // normal approximation of chi-square, 3.3 deviations
    let freedom = (counts - 1) as f64;
    assert!(chi < freedom + 3.3 * (2.0 * freedom).sqrt() + 3.0, "{name}: chi-square {chi} of {freedom}");
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let sum = |f: &dyn Fn(f64, f64) -> f64| a.iter().zip(b).map(|(x, y)| f(x - ma, y - mb)).sum::<f64>();
    sum(&|x, y| x * y) / (sum(&|x, _| x * x) * sum(&|_, y| y * y)).sqrt()
}

/// No quantity tells anything of another, nor an env of the next ones.
#[track_caller]
fn assert_independent(columns: &[Column]) {
    let n = ENVS as f64;
    let mut pairs = 0;
    let mut beyond = 0;
    for (i, a) in columns.iter().enumerate() {
        for lag in [1, 2, 7] {
            let r = correlation(&a.drawn[lag..], &a.drawn[..a.drawn.len() - lag]);
            assert!(r.abs() < CORRELATION / (n - lag as f64).sqrt(), "{}: env and env + {lag}: {r}", a.name);
        }
        for b in &columns[..i] {
            let r = correlation(&a.drawn, &b.drawn);
            pairs += 1;
            beyond += usize::from(r.abs() > CORRELATION / n.sqrt());
            assert!(r.abs() < 1.3 * CORRELATION / n.sqrt(), "{} and {}: {r}", a.name, b.name);
        }
    }
    assert!(beyond <= 1 + pairs / 1000, "{beyond} of {pairs} pairs are correlated");
}

/// Everything that startup events but `body_variation` and resets draw, of robots of one kind.
#[expect(clippy::approx_constant, reason = "the task says 3.14")]
fn columns(sim: &mut Sim) -> Vec<Column> {
    let model: MorphologyModel = sim.morphologies()[0].clone();
    let (nominal, ranges, reset) = (&model.nominal, &model.config.randomization, &model.config.reset);
    let bodies = bodies(sim);
    let of = |f: &dyn Fn(&Body) -> f32| bodies.iter().map(|b| f64::from(f(b))).collect::<Vec<_>>();
    let mut all = vec![column("base mass", ranges.base_mass_offset, of(&|b| b.0.mass[0] - nominal.mass[0]))];
    let com = &ranges.base_com_offset;
    for (axis, range) in [com.x, com.y, com.z].into_iter().enumerate() {
        all.push(column(format!("base com {axis}"), range, of(&|b| b.0.com[0][axis] - nominal.com[0][axis])));
    }
    for joint in [0, 5, 11] {
        let strength = move |b: &Body| b.0.effort_limit[joint] / nominal.effort_limit[joint];
        let share = |of: fn(&Body) -> &[f32], nominal: f32| {
            bodies.iter().map(|b| f64::from(of(b)[joint] / nominal)).collect::<Vec<_>>()
        };
        let by_strength = |share: Vec<f64>| -> Vec<f64> {
            share.iter().zip(&bodies).map(|(x, b)| x / f64::from(strength(b))).collect()
        };
        all.push(column(format!("motor strength {joint}"), ranges.motor_strength, of(&strength)));
        let stiffness = by_strength(share(|b| &b.0.stiffness, nominal.stiffness[joint]));
        all.push(column(format!("stiffness {joint}"), ranges.stiffness.distribution_params, stiffness));
        let damping = by_strength(share(|b| &b.0.damping, nominal.damping[joint]));
        all.push(column(format!("damping {joint}"), ranges.damping.distribution_params, damping));
        let armature = share(|b| &b.0.armature, nominal.armature[joint]);
        all.push(column(format!("armature {joint}"), ranges.armature.distribution_params, armature));
        let friction = share(|b| &b.0.joint_friction, nominal.joint_friction[joint]);
        all.push(column(format!("joint friction {joint}"), ranges.joint_friction.distribution_params, friction));
    }
    let wrenches = read(sim, |w: &ExternalWrench| *w);
    for axis in 0..3 {
        let force = wrenches.iter().map(|w| f64::from(w.force[axis])).collect();
        all.push(column(format!("external force {axis}"), ranges.external_force, force));
        let torque = wrenches.iter().map(|w| f64::from(w.torque[axis])).collect();
        all.push(column(format!("external torque {axis}"), ranges.external_torque, torque));
    }
    let poses = read(sim, |pose: &BasePose| *pose);
    for axis in 0..2 {
        let at = poses.iter().map(|p| f64::from(p.position[axis])).collect();
        all.push(column(format!("position {axis}"), [-0.5, 0.5], at));
    }
    let yaw = poses.iter().map(|p| 2.0 * f64::from(p.rotation[3]).atan2(f64::from(p.rotation[0]))).collect();
    all.push(column("yaw", [-3.14, 3.14], yaw));
    let velocities = read(sim, |v: &BaseVelocity| v.linear);
    for axis in 0..3 {
        let speed = velocities.iter().map(|v| f64::from(v[axis])).collect();
        all.push(column(format!("velocity {axis}"), reset.base_velocity.range, speed));
    }
    let joints = read(sim, |joints: &JointState| joints.position.clone());
    for joint in [1, 6] {
        let moved = joints.iter().map(|q| f64::from(q[joint] - model.stance.default_position[joint])).collect();
        all.push(column(format!("joint position {joint}"), reset.joint_position.range, moved));
    }
    let headings = read(sim, |command: &Command| f64::from(command.heading));
    all.push(column("heading", [-std::f64::consts::PI, std::f64::consts::PI], headings));
    let timers = read(sim, |timers: &EventTimers| f64::from(timers.0[0]));
    all.push(column("time to the next push", [10.0, 15.0], timers));
    all
}

fn all_events(seed: u64) -> Sim {
    let events: Vec<&str> = STARTUP.into_iter().chain(AT_RESET).collect();
    Sim::new(&options("spot", &events, &[], seed)).unwrap()
}

#[test]
fn draws_are_uniform_over_their_ranges_and_independent() {
    let mut sim = all_events(11);
    let columns = columns(&mut sim);
    columns.iter().for_each(assert_uniform);
    assert_independent(&columns);
}

#[test]
fn the_same_seed_gives_the_same_draws_and_another_one_others() {
    let (a, b, c) = (columns(&mut all_events(5)), columns(&mut all_events(5)), columns(&mut all_events(6)));
    for ((a, b), c) in a.iter().zip(&b).zip(&c) {
        assert!(a.drawn == b.drawn, "{}", a.name);
        let same = a.drawn.iter().zip(&c.drawn).filter(|(x, y)| x == y).count();
        assert!(same < ENVS / 50, "{}: {same} envs drew the same under another seed", a.name);
        let r = correlation(&a.drawn, &c.drawn);
        assert!(r.abs() < CORRELATION / (ENVS as f64).sqrt(), "{}: correlated with another seed's: {r}", a.name);
    }
}

#[test]
fn materials_come_from_even_buckets() {
    let mut sim = Sim::new(&options("spot", &[], &[], 3)).unwrap();
    let ranges = sim.morphologies()[0].config.randomization.clone();
    let bodies = bodies(&mut sim);
    let [low, high] = ranges.static_friction;
    let bucket = |x: f64| ((x - low) / (high - low) * 63.0 * 1e3).round() / 1e3;
    let buckets: Vec<f64> = bodies.iter().map(|b| bucket(f64::from(b.0.static_friction))).collect();
    assert_even("static friction", &buckets, 64);
    let [low, high] = ranges.dynamic_friction.map(|x| x as f32);
    for body in &bodies {
        let (still, sliding) = (body.0.static_friction, body.0.dynamic_friction);
        assert!(sliding <= still && sliding >= low && sliding <= high, "{still} {sliding}");
    }
}

#[test]
fn torsional_and_rolling_friction_come_from_even_buckets() {
    let torsional = "events.physics_material.torsional_friction_range=[0.005, 0.02]";
    let rolling = "robot_overrides.spot.randomization.rolling_friction=[0.0, 0.01]";
    let mut sim = Sim::new(&options("spot", &[], &[torsional, rolling], 3)).unwrap();
    let bodies = bodies(&mut sim);
    let bucket = |x: f32, [low, high]: [f64; 2]| ((f64::from(x) - low) / (high - low) * 63.0 * 1e3).round() / 1e3;
    let drawn = |f: &dyn Fn(&Body) -> f64| bodies.iter().map(f).collect::<Vec<_>>();
    let columns = [
        column("torsional friction", [0.0, 63.0], drawn(&|b| bucket(b.0.torsional_friction, [0.005, 0.02]))),
        column("rolling friction", [0.0, 63.0], drawn(&|b| bucket(b.0.rolling_friction, [0.0, 0.01]))),
        column("static friction", [0.0, 63.0], drawn(&|b| f64::from(b.0.static_friction))),
    ];
    columns[..2].iter().for_each(|c| assert_even(&c.name, &c.drawn, 64));
    assert_independent(&columns);
    // a quantity without a range leaves all other draws as they are
    let mut plain = Sim::new(&options("spot", &[], &[], 3)).unwrap();
    for (drawn, plain) in bodies.iter().zip(self::bodies(&mut plain)) {
        assert_eq!(drawn.0.static_friction, plain.0.static_friction);
        assert_eq!((plain.0.torsional_friction, plain.0.rolling_friction), (0.0, 0.0));
    }
}

#[test]
fn a_task_gives_all_robots_one_range_of_friction_and_of_mass() {
    let changes = [
        "events.physics_material.static_friction_range=[0.3, 0.6]",
        "events.physics_material.dynamic_friction_range=[0.1, 0.2]",
        "events.add_base_mass.mass_scale_range=[0.5, 2.0]",
    ];
    // light and heavy robots, with offsets in kg that a factor replaces
    for robot in ["solo12", "unitree_b2"] {
        let mut sim = Sim::new(&options(robot, &[], &changes, 4)).unwrap();
        let nominal = sim.morphologies()[0].nominal.clone();
        let bodies = bodies(&mut sim);
        let drawn = |f: &dyn Fn(&Body) -> f64| bodies.iter().map(f).collect::<Vec<_>>();
        let factor = column("mass", [0.5, 2.0], drawn(&|b| f64::from(b.0.mass[0] / nominal.mass[0])));
        assert_uniform(&factor);
        let bucket = |x: f32, [low, high]: [f64; 2]| ((f64::from(x) - low) / (high - low) * 63.0 * 1e3).round() / 1e3;
        let statics = drawn(&|b| bucket(b.0.static_friction, [0.3, 0.6]));
        let dynamics = drawn(&|b| bucket(b.0.dynamic_friction, [0.1, 0.2]));
        assert_even("static friction", &statics, 64);
        assert_even("dynamic friction", &dynamics, 64);
    }
}

#[test]
fn the_inertia_follows_the_added_mass_unless_told_otherwise() {
    for recompute in [true, false] {
        let more = format!("events.add_base_mass.recompute_inertia={recompute}");
        let mut sim = Sim::new(&options("unitree_go2", &[], &[&more], 3)).unwrap();
        let nominal = sim.morphologies()[0].nominal.clone();
        for body in bodies(&mut sim) {
            let share = if recompute { body.0.mass[0] / nominal.mass[0] } else { 1.0 };
            for (new, old) in body.0.inertia[0].iter().zip(&nominal.inertia[0]) {
                assert!((new - old * share).abs() <= 1e-6 * old.abs().max(1e-6), "{new} {old} {share}");
            }
        }
    }
}

#[test]
fn delays_are_whole_steps_on_top_of_the_actuators_own() {
    let mut sim = Sim::new(&options("unitree_go2", &["action_delay"], &[], 3)).unwrap();
    let delays = read(&mut sim, |delay: &ActuatorDelay| delay.0.clone());
    assert!(delays.iter().all(|d| d.iter().all(|x| x == &d[0])), "a joint has its own delay");
    assert_even("action delay", &delays.iter().map(|d| f64::from(d[0])).collect::<Vec<_>>(), 3);
    // a robot whose actuators are late by themselves: two groups of 0 to 4 steps
    let mut own = Sim::new(&options("spot", &[], &[], 3)).unwrap();
    let own = read(&mut own, |delay: &ActuatorDelay| delay.0.clone());
    let longer = ["events.action_delay.delay_range=[3, 3]"];
    let mut late = Sim::new(&options("spot", &["action_delay"], &longer, 3)).unwrap();
    assert_eq!(late.morphologies()[0].max_delay(), 7);
    for (a, b) in own.iter().zip(read(&mut late, |delay: &ActuatorDelay| delay.0.clone())) {
        assert!(a.iter().zip(&b).all(|(own, all)| own + 3.0 == *all), "{a:?} {b:?}");
    }
}

#[test]
fn a_delayed_action_moves_the_joints_that_many_steps_later() {
    let moved = |steps: u32| {
        let late = format!("events.action_delay.delay_range=[{steps}, {steps}]");
        let mut options = options("unitree_go2", &["action_delay"], &[&late], 3);
        options.num_envs = 1;
        options.overrides.extend(["sim.decimation=1".into(), "observations.enable_noise=false".into()]);
        let mut sim = Sim::new(&options).unwrap();
        (0..12)
            .map(|t| {
                sim.step(&[if t < 3 { 0.0 } else { 1.0 }; 12]).unwrap();
                read(&mut sim, |joints: &JointState| joints.velocity[4])[0]
            })
            .collect::<Vec<f32>>()
    };
    let on_time = moved(0);
    for steps in [1, 2, 5] {
        let late = moved(steps);
        let apart = |t: usize| (on_time[t] - late[t]).abs() > 1e-3;
        // in time the joint moves at once after step 3, late by this many steps
        assert!(apart(3), "{steps}: {on_time:?} {late:?}");
        let still = moved(8);
        let first = (0..12).find(|&t| (late[t] - still[t]).abs() > 1e-3);
        assert_eq!(first, Some(3 + steps as usize), "{late:?} {still:?}");
    }
}

#[test]
fn bodies_vary_over_their_ranges_and_independently() {
    let off = ["events.add_base_mass.enabled=false", "events.base_com.enabled=false"];
    let mut sim = Sim::new(&options("spot", &["body_variation"], &off, 11)).unwrap();
    let model = sim.morphologies()[0].clone();
    let (nominal, ranges) = (&model.nominal, &model.config.variation);
    let bodies = bodies(&mut sim);
    let joint = |role: usize| model.slots[4 * role].joint();
    let length = |v: &[f32; 3]| v.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt();
    let offset = |j: usize| -> Vec<f64> {
        bodies.iter().map(|b| length(&b.0.joint_offset[j]) / length(&nominal.joint_offset[j])).collect()
    };
    let axis = |axis: usize| -> Vec<f64> {
        let of = |p: &[[f32; 3]]| f64::from(p[joint(0)][axis]);
        bodies.iter().map(|b| of(&b.0.joint_offset) / of(&nominal.joint_offset)).collect()
    };
    let mass = |link: usize| bodies.iter().map(|b| f64::from(b.0.mass[link] / nominal.mass[link])).collect();
    let first = |f: fn(&Body) -> f32, nominal: f32| bodies.iter().map(|b| f64::from(f(b) / nominal)).collect();
    let span = |lower: &[f32], upper: &[f32]| f64::from(upper[joint(1)] - lower[joint(1)]);
    let joint_range =
        bodies.iter().map(|b| span(&b.0.lower, &b.0.upper) / span(&nominal.lower, &nominal.upper)).collect();
    let shank = bodies.iter().map(|b| length(&b.0.site_position[0]) / length(&nominal.site_position[0])).collect();
    let columns = [
        column("base length", ranges.base_length, axis(0)),
        column("base width", ranges.base_width, axis(1)),
        column("hip offset", ranges.hip_offset, offset(joint(1))),
        column("thigh length", ranges.thigh_length, offset(joint(2))),
        column("shank length", ranges.shank_length, shank),
        column("base mass", ranges.base_mass, mass(0)),
        column("hip mass", ranges.hip_mass, mass(joint(0) + 1)),
        column("thigh mass", ranges.thigh_mass, mass(joint(1) + 1)),
        column("shank mass", ranges.shank_mass, mass(joint(2) + 1)),
        column("joint range", ranges.joint_range, joint_range),
        column("stiffness", ranges.stiffness, first(|b| b.0.stiffness[0], nominal.stiffness[0])),
        column("damping", ranges.damping, first(|b| b.0.damping[0], nominal.damping[0])),
    ];
    columns.iter().for_each(assert_uniform);
    assert_independent(&columns);
}

#[test]
fn a_task_may_draw_bodies_of_any_size_and_stance() {
    let event = |text: &str| format!("events.body_variation.{text}");
    let ranges =
        ["size=[0.8, 1.5]", "action_scale=[0.5, 1.5]", "default_flexion=[0.7, 1.2]", "default_abduction=[-0.1, 0.2]"];
    let with = |power: f64| {
        let power = format!("range_power={power:?}");
        let mut more: Vec<String> = ranges.iter().map(|text| event(text)).chain([event(&power)]).collect();
        more.extend(["events.add_base_mass.enabled=false".into(), "events.base_com.enabled=false".into()]);
        let more: Vec<&str> = more.iter().map(String::as_str).collect();
        Sim::new(&options("spot", &["body_variation"], &more, 11)).unwrap()
    };
    // to the power of 0 the robot's own factors are 1, and what is left is the task's
    let mut sim = with(0.0);
    let model = sim.morphologies()[0].clone();
    let nominal = &model.nominal;
    let joint = |slot: usize| model.slots[slot].joint();
    let stances = read(&mut sim, |stance: &Stance| stance.clone());
    let bodies = bodies(&mut sim);
    let size: Vec<f64> = bodies.iter().map(|b| f64::from(b.0.mass[0] / nominal.mass[0]).cbrt()).collect();
    let moved = |slot: usize| stances.iter().map(move |s| f64::from(s.default_position[joint(slot)]));
    let at_rest = |slot: usize| f64::from(model.stance.default_position[joint(slot)]);
    let columns = [
        column("size", [0.8, 1.5], size.clone()),
        column(
            "action scale",
            [0.5, 1.5],
            stances.iter().map(|s| f64::from(s.action_scale / model.stance.action_scale)).collect(),
        ),
        column("default flexion", [0.7, 1.2], moved(8).map(|q| q / at_rest(8)).collect()),
        column("default abduction", [-0.1, 0.2], moved(0).map(|q| q - at_rest(0)).collect()),
    ];
    columns.iter().for_each(assert_uniform);
    assert_independent(&columns);
    for ((body, stance), size) in bodies.iter().zip(&stances).zip(&size) {
        let share = |of: fn(&Body) -> f32, power: f64| {
            let whole = f64::from(of(body) / of(&Body(Box::new(nominal.clone()))));
            assert!((whole / size.powf(power) - 1.0).abs() < 1e-4, "{whole} at size {size}");
        };
        share(|b| b.0.joint_offset[0][0], 1.0);
        share(|b| b.0.inertia[0][0], 5.0);
        share(|b| b.0.stiffness[0], 4.0);
        share(|b| b.0.damping[0], 4.5);
        share(|b| b.0.effort_limit[0], 4.0);
        // LF and RF are spread equally
        let outward = |slot: usize| stance.default_position[joint(slot)] - model.stance.default_position[joint(slot)];
        assert!((outward(0) + outward(2)).abs() < 1e-6, "{stance:?}");
    }
    // lengths across and along the base: their ratio does not depend on the size
    let ratio = |body: &Body| f64::from(body.0.joint_offset[0][0] / body.0.joint_offset[0][1]);
    let whole = ratio(&Body(Box::new(nominal.clone())));
    let ratios = read(&mut with(2.0), ratio);
    let variation = &model.config.variation;
    let ([x0, x1], [y0, y1]) = (variation.base_length.map(|x| x * x), variation.base_width.map(|y| y * y));
    assert!(ratios.iter().all(|r| (x0 / y1..x1 / y0).contains(&(r / whole))));
    let beyond = ratios.iter().filter(|r| *r / whole > variation.base_length[1] / variation.base_width[0]).count();
    assert!(beyond > ENVS / 100, "{beyond} bodies are farther from the robot's than its own ranges go");
}

/// The base's velocity after one control step in the air, with pushes at once or none.
fn velocities(pushed: bool) -> Vec<[f32; 3]> {
    let push = format!("events.push_robot.enabled={pushed}");
    let more = [&push, "events.push_robot.interval_range_s=[0.02, 0.02]", "sim.gravity=[0.0, 0.0, 0.0]"];
    let mut sim = Sim::new(&options("spot", &[], &more, 9)).unwrap();
    let still = vec![0.0; sim.batch().actions.len()];
    sim.step(&still).unwrap();
    read(&mut sim, |v: &BaseVelocity| v.linear)
}

#[test]
fn pushes_are_uniform_and_independent() {
    let (with, without) = (velocities(true), velocities(false));
    let push = |axis: usize| with.iter().zip(&without).map(|(a, b)| f64::from(a[axis] - b[axis])).collect();
    let columns = [column("push x", [-0.5, 0.5], push(0)), column("push y", [-0.5, 0.5], push(1))];
    columns.iter().for_each(assert_uniform);
    assert_independent(&columns);
}

#[test]
fn other_distributions_and_operations_are_isaac_labs() {
    let with = |more: &[&str]| -> (Vec<f64>, f64) {
        let mut sim = Sim::new(&options("unitree_go2", &["randomize_actuator_gains"], more, 4)).unwrap();
        let nominal = f64::from(sim.morphologies()[0].nominal.stiffness[3]);
        (bodies(&mut sim).iter().map(|b| f64::from(b.0.stiffness[3])).collect(), nominal)
    };
    let event = "events.randomize_actuator_gains";
    let bound = KOLMOGOROV / (ENVS as f64).sqrt();
    let params = format!("{event}.stiffness_distribution_params=[0.5, 2.0]");
    let (drawn, nominal) = with(&[&params, &format!("{event}.distribution=log_uniform")]);
    let d = distance(&drawn, |x| (x / nominal / 0.5).ln() / 4f64.ln());
    assert!(d < bound, "log-uniform factors: {d}");
    let (drawn, nominal) = with(&[&params, &format!("{event}.operation=add")]);
    assert!(distance(&drawn, |x| (x - nominal - 0.5) / 1.5) < bound, "added");
    let (drawn, _) = with(&[&params, &format!("{event}.operation=abs")]);
    assert!(distance(&drawn, |x| (x - 0.5) / 1.5) < bound, "absolute");
    let params = format!("{event}.stiffness_distribution_params=[1.0, 0.1]");
    let (drawn, nominal) = with(&[&params, &format!("{event}.distribution=gaussian")]);
    let z: Vec<f64> = drawn.iter().map(|x| (x / nominal - 1.0) / 0.1).collect();
    let n = z.len() as f64;
    let (mean, square) = (z.iter().sum::<f64>() / n, z.iter().map(|x| x * x).sum::<f64>() / n);
    let fourth = z.iter().map(|x| x.powi(4)).sum::<f64>() / n;
    // deviations of the three moments' estimates: 1, sqrt 2 and sqrt 96 over sqrt n
    assert!(mean.abs() < 3.3 / n.sqrt() && (square - 1.0).abs() < 3.3 * (2.0 / n).sqrt(), "{mean} {square}");
    assert!((fourth - 3.0).abs() < 3.3 * (96.0 / n).sqrt(), "{fourth}");
    let error =
        Sim::new(&options("unitree_go2", &["randomize_actuator_gains"], &[&format!("{event}.operation=add")], 4));
    assert!(error.err().unwrap().to_string().contains("distribution_params"));
}

#[test]
fn joints_get_viscous_friction_in_proportion_to_their_effort() {
    let event = "events.randomize_joint_parameters";
    let params = format!("{event}.viscous_friction_distribution_params=[0.0, 0.06]");
    let operation = format!("{event}.operation=add_effort_share");
    for robot in ["unitree_go2", "solo12"] {
        let options = options(robot, &["randomize_joint_parameters"], &[&params, &operation], 4);
        let mut sim = Sim::new(&options).unwrap();
        let model = sim.morphologies()[0].clone();
        let (nominal, bodies) = (&model.nominal, bodies(&mut sim));
        let columns = [0, 5, 11].map(|j| {
            let effort = model.max_effort(j, nominal);
            let share = |b: &Body| f64::from((b.0.joint_damping[j] - nominal.joint_damping[j]) / effort);
            column(format!("{robot}, viscous friction {j}"), [0.0, 0.06], bodies.iter().map(share).collect())
        });
        columns.iter().for_each(assert_uniform);
        assert_independent(&columns);
        let kept = |b: &Body| b.0.armature == nominal.armature && b.0.joint_friction == nominal.joint_friction;
        assert!(bodies.iter().all(kept), "{robot}: quantities without a range were drawn");
    }
    // a robot's own range, in its unit
    let own = "robot_overrides.unitree_go2.randomization.joint_damping";
    let more = [format!("{own}.operation=abs"), format!("{own}.distribution_params=[0.1, 0.3]")];
    let more = [more[0].as_str(), more[1].as_str()];
    let mut sim = Sim::new(&options("unitree_go2", &["randomize_joint_parameters"], &more, 4)).unwrap();
    let drawn = bodies(&mut sim).iter().map(|b| f64::from(b.0.joint_damping[7])).collect();
    assert_uniform(&column("viscous friction", [0.1, 0.3], drawn));
}

#[test]
fn body_events_at_resets_start_from_what_startup_left() {
    let event = "events.randomize_actuator_gains";
    let mode = format!("{event}.mode=reset");
    let mut sim = Sim::new(&options("unitree_go2", &["randomize_actuator_gains"], &[&mode], 4)).unwrap();
    let nominal = sim.morphologies()[0].nominal.stiffness[3];
    let mut before = bodies(&mut sim);
    for _ in 0..20 {
        sim.reset(None, None).unwrap();
        let now = bodies(&mut sim);
        let share: Vec<f64> = now.iter().map(|b| f64::from(b.0.stiffness[3] / nominal)).collect();
        // never beyond the range, however often
        assert!(share.iter().all(|x| (0.9 - 1e-5..=1.1 + 1e-5).contains(x)));
        let same = now.iter().zip(&before).filter(|(a, b)| a.0.stiffness == b.0.stiffness).count();
        assert_eq!(same, 0, "gains were not drawn anew");
        assert!(now.iter().zip(&before).all(|(a, b)| a.0.mass == b.0.mass), "masses are drawn at startup");
        before = now;
    }
    let mut mask = vec![false; ENVS];
    mask[7] = true;
    sim.reset(None, Some(&mask)).unwrap();
    let now = bodies(&mut sim);
    let changed: Vec<usize> = (0..ENVS).filter(|&i| now[i].0.stiffness != before[i].0.stiffness).collect();
    assert_eq!(changed, [7]);
}

#[test]
fn a_ninth_robot_leaves_every_draw_of_the_others() {
    let options = |robots: &[&str], num_envs: usize| {
        let events = STARTUP.into_iter().chain(AT_RESET).chain(["body_variation"]);
        SimOptions {
            robots: Some(robots.iter().map(ToString::to_string).collect()),
            threads: Some(1),
            overrides: events.map(|event| format!("events.{event}.enabled=true")).collect(),
            ..SimOptions::new("velocity_flat", num_envs)
        }
    };
    let eight = ["anymal_d", "anymal_c", "anymal_b", "unitree_a1", "unitree_go1", "unitree_go2", "unitree_b2", "spot"];
    let folder = std::env::temp_dir().join(format!("polypod-ninth-{}", std::process::id()));
    std::fs::create_dir_all(folder.join("configs/robots")).unwrap();
    let config = "extends = \"unitree_a1\"\nname = \"ninth\"\ntitle = \"Ninth\"\n";
    std::fs::write(folder.join("configs/robots/ninth.toml"), config).unwrap();
    let nine: Vec<&str> = std::iter::once("ninth").chain(eight).collect();
    let mut before = Sim::new(&options(&eight, 40)).unwrap();
    let mut after = Sim::new(&SimOptions { roots: vec![folder.clone()], ..options(&nine, 45) }).unwrap();
    std::fs::remove_dir_all(folder).unwrap();
    let all = |sim: &mut Sim| {
        let bodies = bodies(sim).into_iter().map(|body| {
            let mut numbers = Vec::new();
            let mut copy = body.0.as_ref().clone();
            copy.zip_with(body.0.as_ref(), |_, x: &f32| numbers.push(x.to_bits()));
            numbers
        });
        let bodies: Vec<_> = bodies.collect();
        let wrenches = read(sim, |w: &ExternalWrench| (w.force.map(f32::to_bits), w.torque.map(f32::to_bits)));
        let delays = read(sim, |d: &ActuatorDelay| d.0.clone());
        let joints = read(sim, |j: &JointState| j.position.iter().map(|x| x.to_bits()).collect::<Vec<_>>());
        let commands = read(sim, |c: &Command| c.heading.to_bits());
        (bodies, wrenches, delays, joints, commands)
    };
    let (a, b) = (all(&mut before), all(&mut after));
    assert!(a.0 == b.0[5..] && a.1 == b.1[5..] && a.2 == b.2[5..] && a.3 == b.3[5..] && a.4 == b.4[5..]);
    // and the ninth, a copy, draws for itself
    assert_ne!(b.4[..5], b.4[20..25]);
}
