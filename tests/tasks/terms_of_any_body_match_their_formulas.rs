//! Reward and termination terms for bodies of any kind, recomputed in double precision from their
//! formulas and the state of the step: air time and symmetry of steps, sums and means over the
//! joints that patterns name, heights and tilts.

use std::path::Path;

use bevy_ecs::prelude::*;
use polypod::Autoreset;
use polypod::components::{Action, BasePose, Body, EnvId, Episode, EpisodeSums, Feet, JointEffort, JointState};
use polypod::morphology::MorphologyModel;
use polypod::{Sim, SimOptions};

use crate::common::{commands_and_sensors, noise};

const ROBOTS: [&str; 4] = ["small_biped", "small_humanoid", "small_hexapod", "unitree_go2"];
const EACH: usize = 8;
const STEPS: usize = 250;
const STEP_DT: f64 = 0.02;

/// Key in the set, parameters (but for the weight) and weight.
const TERMS: [(&str, &str, f64); 21] = [
    ("action_rate_l2", "mean = true", -0.01),
    ("base_height_l2", "", -1.0),
    ("desired_contacts", "", -1.0),
    ("deviation", "term = 'joint_deviation_l1'", -0.1),
    ("deviation_hips", "term = 'joint_deviation_l1', joints = ['*_HIP_*', '*_HFE'], mean = true", -0.5),
    ("deviation_torso", "term = 'joint_deviation_l1', joints = ['TORSO_*']", -0.1),
    ("dof_acc_l2", "mean = true", -1e-6),
    ("dof_torques_l2", "joints = ['*_KNEE', 'LF_KFE']", -1e-3),
    ("feet_air_time_positive_biped", "threshold = 0.2", 0.75),
    ("feet_slide", "", -0.25),
    ("gait_symmetry", "", -10.0),
    ("is_terminated", "", -200.0),
    ("joint_pos_limits", "", -1.0),
    ("joint_vel_l2", "joints = ['L*'], mean = true", -1e-3),
    ("landings", "term = 'feet_air_time', threshold = 0.1, turning = true", 0.25),
    ("limits_of_knees", "term = 'joint_pos_limits', joints = ['*_KNEE', '*_KFE'], mean = true", -1.0),
    ("low_base", "term = 'base_height_l2', target_height = 0.2", -1.0),
    ("scaled_acc_l2", "", -1e-2),
    ("scaled_torques_l2", "", -1.0),
    ("stand_still_joint_deviation_l1", "command_threshold = 0.3", -0.4),
    ("strides", "term = 'feet_air_time_positive_biped', threshold = 0.2, turning = true", 0.75),
];

fn options(overrides: &[String]) -> SimOptions {
    let terms: Vec<String> = TERMS
        .iter()
        .map(|(key, parameters, weight)| {
            let comma = if parameters.is_empty() { "" } else { ", " };
            format!("{key} = {{ weight = {weight:?}{comma}{parameters} }}")
        })
        .collect();
    let mut all = vec![
        format!("rewards.any={{ {} }}", terms.join(", ")),
        "commands.base_velocity.resampling_time_s=1.0".into(),
        "commands.base_velocity.rel_standing_envs=0.3".into(),
        "commands.base_velocity.rel_turning_envs=0.3".into(),
        "events.push_robot.interval_range_s=[0.5, 1.0]".into(),
        "terminations={ time_out = {}, bad_orientation = { limit_angle = 0.7 } }".into(),
        "terminations.root_height_below_minimum={ minimum_share = 0.6 }".into(),
    ];
    for robot in ROBOTS {
        all.push(format!("robot_overrides.{robot}.reward_set=any"));
        all.push(format!("robot_overrides.{robot}.reset.soft_limit_factor=0.5"));
    }
    all.extend_from_slice(overrides);
    SimOptions {
        robots: Some(ROBOTS.map(String::from).to_vec()),
        roots: vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/bodies")],
        threads: Some(1),
        autoreset: Autoreset::Disabled,
        overrides: all,
        ..SimOptions::new("velocity_flat", EACH * ROBOTS.len())
    }
}

/// Inputs of the formulas for one robot after a step; joints in the robot's own order of slots.
struct Seen<'a> {
    robot: &'a MorphologyModel,
    command: [f64; 3],
    height: f64,
    mass: f64,
    /// Cosine of the angle between the base's z axis and the vertical.
    upright: f64,
    position: Vec<f64>,
    default: Vec<f64>,
    range: Vec<[f64; 2]>,
    velocity: Vec<f64>,
    torque: Vec<f64>,
    acceleration: Vec<f64>,
    action_change: Vec<f64>,
    foot_speed: Vec<f64>,
    foot_peak: Vec<f64>,
    air: Vec<f64>,
    contact: Vec<f64>,
    last_air: Vec<f64>,
    ended: bool,
}

fn wide(x: &[f32]) -> Vec<f64> {
    x.iter().map(|&x| f64::from(x)).collect()
}

fn length(x: &[f64]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

impl Seen<'_> {
    /// Values of the joints whose names pass, in order of slots.
    fn named(&self, values: &[f64], named: impl Fn(&str) -> bool) -> Vec<f64> {
        let slots = self.robot.slots.iter().zip(values);
        slots.filter(|(own, _)| named(&own.slot.to_string())).map(|(_, value)| *value).collect()
    }

    /// Height of the base in the default pose, m.
    fn stance(&self) -> f64 {
        f64::from(self.robot.stance.spawn_height) - self.robot.config.reset.spawn_margin
    }

    fn value(&self, key: &str) -> f64 {
        let all = |_: &str| true;
        let deviation: Vec<f64> = self.position.iter().zip(&self.default).map(|(q, d)| (q - d).abs()).collect();
        let beyond: Vec<f64> = self
            .position
            .iter()
            .zip(&self.range)
            .map(|(q, [lower, upper])| {
                let (middle, half) = (0.5 * (lower + upper), 0.25 * (upper - lower));
                if half.is_finite() { ((q - middle).abs() - half).max(0.0) } else { 0.0 }
            })
            .collect();
        let sum = |x: Vec<f64>| x.iter().sum::<f64>();
        let mean = |x: Vec<f64>| x.iter().sum::<f64>() / x.len().max(1) as f64;
        let squares = |x: Vec<f64>| x.iter().map(|x| x * x).collect::<Vec<f64>>();
        let planar = length(&self.command[..2]);
        let steps = planar > 0.1 || self.command[2].abs() > 0.1;
        let landed = |foot: usize| (1e-9..STEP_DT + 1e-5).contains(&self.contact[foot]);
        let knee = |name: &str| name.ends_with("_KNEE") || name.ends_with("_KFE");
        match key {
            "action_rate_l2" => mean(squares(self.action_change.clone())),
            "base_height_l2" => (self.height - self.stance()).powi(2),
            "scaled_acc_l2" => mean(squares(self.acceleration.clone())) * (self.stance() / 9.81).powi(2),
            "scaled_torques_l2" => mean(squares(self.torque.clone())) / (self.mass * 9.81 * self.stance()).powi(2),
            "low_base" => (self.height - 0.2).powi(2),
            "desired_contacts" => f64::from(u8::from(self.foot_peak.iter().all(|force| *force <= 1.0))),
            "deviation" => sum(deviation),
            "deviation_hips" => mean(self.named(&deviation, |name| name.contains("_HIP_") || name.ends_with("_HFE"))),
            "deviation_torso" => sum(self.named(&deviation, |name| name.starts_with("TORSO_"))),
            "dof_acc_l2" => mean(squares(self.named(&self.acceleration, all))),
            "dof_torques_l2" => {
                sum(squares(self.named(&self.torque, |name| name.ends_with("_KNEE") || name == "LF_KFE")))
            }
            "joint_vel_l2" => mean(squares(self.named(&self.velocity, |name| name.starts_with('L')))),
            "joint_pos_limits" => sum(beyond),
            "limits_of_knees" => mean(self.named(&beyond, knee)),
            "stand_still_joint_deviation_l1" => {
                if planar < 0.3 {
                    sum(deviation)
                } else {
                    0.0
                }
            }
            "feet_air_time_positive_biped" | "strides" => {
                let standing = self.contact.iter().filter(|time| **time > 0.0).count();
                let phases = self.contact.iter().zip(&self.air).map(|(contact, air)| contact.max(*air));
                let counts = if key == "strides" { steps } else { planar > 0.1 };
                if standing == 1 && counts { phases.fold(0.2, f64::min) } else { 0.0 }
            }
            "landings" => {
                let last = (0..self.last_air.len()).filter(|foot| landed(*foot)).map(|foot| self.last_air[foot] - 0.1);
                if steps { last.sum() } else { 0.0 }
            }
            "feet_slide" => {
                let feet = self.foot_speed.iter().zip(&self.foot_peak);
                feet.filter(|(_, force)| **force > 1.0).map(|(speed, _)| speed).sum()
            }
            "gait_symmetry" => {
                let pairs = self.robot.feet.len() / 2;
                let of = |left: usize| {
                    let (left, right) = (left, left + pairs);
                    let flown = self.last_air[left].min(self.last_air[right]) > 0.0;
                    let counts = flown && (landed(left) || landed(right));
                    if counts { (self.last_air[left] - self.last_air[right]).abs() } else { 0.0 }
                };
                let turn = (-self.command[2].powi(2) / (2.0 * 0.25 * 0.25)).exp();
                if length(&self.command) > 0.1 { turn * (0..pairs).map(of).sum::<f64>() } else { 0.0 }
            }
            "is_terminated" => f64::from(u8::from(self.ended)),
            other => panic!("{other}"),
        }
    }
}

fn see<'a>(world: &mut World, robots: &'a [MorphologyModel]) -> Vec<Seen<'a>> {
    let (commands, sensors) = commands_and_sensors(world);
    let ended: Vec<bool> =
        world.query::<(&EnvId, &Episode)>().iter(world).sort::<&EnvId>().map(|(_, e)| e.terminated).collect();
    let mut query = world.query::<(&EnvId, &BasePose, &Body, &JointState, &JointEffort, &Action, &Feet)>();
    let mut all = Vec::new();
    for (id, pose, body, joints, effort, action, feet) in query.iter(world).sort::<&EnvId>() {
        let env = id.0 as usize;
        let robot = &robots[env / EACH];
        let sensor = &sensors[env];
        let by_slot = |x: &[f32]| robot.slots.iter().map(|own| f64::from(x[own.joint()])).collect::<Vec<f64>>();
        let limits = by_slot(&body.0.lower).into_iter().zip(by_slot(&body.0.upper));
        let changes = action.current.iter().zip(&action.previous).map(|(new, old)| f64::from(*new) - f64::from(*old));
        let [w, x, y, z] = pose.rotation.map(f64::from);
        all.push(Seen {
            robot,
            command: commands[env],
            height: f64::from(pose.position[2]),
            mass: wide(&body.0.mass).iter().sum(),
            upright: 1.0 - 2.0 * (x * x + y * y) / (w * w + x * x + y * y + z * z),
            position: by_slot(&joints.position),
            default: by_slot(&robot.stance.default_position),
            range: limits.map(|(lower, upper)| [lower, upper]).collect(),
            velocity: by_slot(&joints.velocity),
            torque: by_slot(&effort.applied),
            acceleration: by_slot(&effort.acceleration),
            action_change: changes.collect(),
            foot_speed: feet.velocity.iter().map(|v| f64::from(v[0]).hypot(f64::from(v[1]))).collect(),
            foot_peak: robot.feet.iter().map(|&foot| f64::from(sensor.peak_force[foot])).collect(),
            air: wide(&sensor.air_time),
            contact: wide(&sensor.contact_time),
            last_air: wide(&sensor.last_air_time),
            ended: ended[env],
        });
    }
    all
}

/// Envs of a robot act more and more wildly, the first two not at all.
fn actions(sim: &Sim, t: usize) -> Vec<f32> {
    let width = sim.batch().num_actions;
    let scale = |env: usize| if env % EACH < 2 { 0.0 } else { (env % EACH) as f32 * 0.6 };
    (0..sim.batch().actions.len()).map(|i| noise(0, i / width, t, i % width) * scale(i / width)).collect()
}

#[test]
fn rewards() {
    let mut sim = Sim::new(&options(&[])).unwrap();
    let robots = sim.morphologies().to_vec();
    let names: Vec<&str> = sim.task().rewards[0].iter().map(|term| term.name.as_str()).collect();
    assert_eq!(names, TERMS.map(|(key, ..)| key));
    let mut worth = vec![[0usize; TERMS.len()]; ROBOTS.len()];
    for t in 0..STEPS {
        for mut sums in sim.world_mut().query::<&mut EpisodeSums>().iter_mut(sim.world_mut()) {
            sums.terms.fill(0.0);
        }
        let actions = actions(&sim, t);
        sim.step(&actions).unwrap();
        let seen = see(sim.world_mut(), &robots);
        let world = sim.world_mut();
        for (id, sums) in world.query::<(&EnvId, &EpisodeSums)>().iter(world) {
            let env = id.0 as usize;
            for (i, (&(key, _, weight), &got)) in TERMS.iter().zip(&sums.terms).enumerate() {
                let expected = weight * seen[env].value(key) * STEP_DT;
                let tolerance = 1e-5 * expected.abs() + 1e-6 * weight.abs() * STEP_DT;
                assert!(
                    (f64::from(got) - expected).abs() <= tolerance,
                    "step {t}, {}, env {env}: {key} is {got}, not {expected}",
                    ROBOTS[env / EACH]
                );
                worth[env / EACH][i] += usize::from(expected.abs() > 1e-9);
            }
        }
    }
    for (robot, worth) in ROBOTS.iter().zip(&worth) {
        for ((key, ..), &times) in TERMS.iter().zip(worth) {
            // one of them alone has a torso; only a biped often stands on one foot
            let never = match *key {
                "deviation_torso" => *robot != "small_humanoid",
                _ => false,
            };
            let strides = ["feet_air_time_positive_biped", "strides"].contains(key);
            let rare = strides && !robot.starts_with("small_b");
            assert!(rare || (times == 0) == never, "{robot}: {key} was worth something {times} times");
        }
    }
}

#[test]
fn terminations() {
    let mut sim = Sim::new(&options(&[])).unwrap();
    let robots = sim.morphologies().to_vec();
    let names: Vec<String> = sim.task().cause_names().map(str::to_owned).collect();
    let bit = |name: &str| 1 << names.iter().position(|known| known == name).unwrap();
    let mut counts = [0, 0, 0];
    for t in 0..STEPS {
        let actions = actions(&sim, t);
        sim.step(&actions).unwrap();
        let seen = see(sim.world_mut(), &robots);
        let world = sim.world_mut();
        for (id, episode) in world.query::<(&EnvId, &Episode)>().iter(world) {
            let seen = &seen[id.0 as usize];
            let stance = f64::from(seen.robot.stance.spawn_height) - seen.robot.config.reset.spawn_margin;
            let (tilted, low) = (seen.upright.acos() - 0.7, 0.6 * stance - seen.height);
            // at the very edge single precision decides
            if tilted.abs() > 1e-4 {
                assert_eq!(episode.causes & bit("bad_orientation") != 0, tilted > 0.0);
            }
            if low.abs() > 1e-4 {
                assert_eq!(episode.causes & bit("root_height_below_minimum") != 0, low > 0.0);
            }
            counts[0] += usize::from(tilted > 0.0);
            counts[1] += usize::from(low > 0.0);
            counts[2] += usize::from(tilted < 0.0 && low < 0.0);
        }
    }
    assert!(counts.iter().all(|&count| count > 10), "{counts:?}");
}

#[test]
fn bodies_that_may_not_touch_are_named_by_group() {
    let ends = |bodies: &str| {
        let overrides = [
            format!("terminations={{ illegal_contact = {{ threshold = 1.0, bodies = {bodies} }} }}"),
            "terminations.bad_orientation=null".into(),
            "terminations.root_height_below_minimum=null".into(),
            "terminations.base_contact=null".into(),
        ];
        let mut sim = Sim::new(&options(&overrides)).unwrap();
        for t in 0..20 {
            let still = vec![0.0; sim.batch().actions.len()];
            sim.step(&still).unwrap_or_else(|error| panic!("{t}: {error}"));
        }
        sim.batch().terminated.iter().filter(|ended| **ended).count()
    };
    // they stand on their feet
    assert_eq!(ends("['foot']"), EACH * ROBOTS.len());
    assert_eq!(ends("['thigh', 'arm', 'head', 'torso']"), 0);
}

#[test]
fn a_pattern_that_no_joint_could_match_is_an_error() {
    let wrong = ["rewards.any.deviation_hips.joints=['*_HIPS']".to_string()];
    let error = Sim::new(&options(&wrong)).err().unwrap().to_string();
    for part in ["rewards.any.deviation_hips.joints[0]", "`*_HIPS` matches the name of no joint", "PLACE_ROLE"] {
        assert!(error.contains(part), "{error}");
    }
    // a joint that only some robots lack is no error
    let none = ["rewards.any.deviation_hips.joints=['TAIL_PITCH']".to_string()];
    assert!(Sim::new(&options(&none)).is_ok());
}
