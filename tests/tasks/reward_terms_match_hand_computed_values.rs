//! Every reward term of every set, recomputed in double precision from its formula and the state of
//! the step.

use bevy_ecs::prelude::*;
use polypod::Autoreset;
use polypod::components::{
    Action, BasePose, BaseVelocity, Body, ContactForces, ContactSensor, EnvId, EpisodeSums, Feet, JointEffort,
    JointState,
};
use polypod::morphology::MorphologyModel;
use polypod::robot::BodyGroup;
use polypod::{Sim, SimOptions};

use crate::common::{commands_and_sensors, noise};

const STEPS: usize = 300;
const ENVS_PER_ROBOT: usize = 6;
const PHYSICS_DT: f64 = 0.005;
const STEP_DT: f64 = 0.02;

/// One robot of each reward set, with the set's terms and weights (Hetero-IsaacLab, flat task).
const SETS: [(&str, &[(&str, f64)]); 4] = [
    (
        "anymal_d",
        &[
            ("action_rate_l2", -0.01),
            ("ang_vel_xy_l2", -0.05),
            ("dof_acc_l2", -2.5e-7),
            ("dof_torques_l2", -2.5e-5),
            ("feet_air_time", 0.5),
            ("flat_orientation_l2", -5.0),
            ("lin_vel_z_l2", -2.0),
            ("track_ang_vel_z_exp", 0.5),
            ("track_lin_vel_xy_exp", 1.0),
            ("undesired_contacts", -1.0),
        ],
    ),
    (
        "unitree_go2",
        &[
            ("action_rate_l2", -0.01),
            ("ang_vel_xy_l2", -0.05),
            ("dof_acc_l2", -2.5e-7),
            ("dof_torques_l2", -2.0e-4),
            ("feet_air_time", 0.25),
            ("flat_orientation_l2", -2.5),
            ("lin_vel_z_l2", -2.0),
            ("track_ang_vel_z_exp", 0.75),
            ("track_lin_vel_xy_exp", 1.5),
        ],
    ),
    (
        "unitree_b2",
        &[
            ("action_rate_l2", -0.01),
            ("ang_vel_xy_l2", -0.05),
            ("dof_acc_l2", -2.5e-7),
            ("dof_torques_l2", -2.0e-5),
            ("feet_air_time", 0.125),
            ("flat_orientation_l2", -5.0),
            ("lin_vel_z_l2", -2.0),
            ("track_ang_vel_z_exp", 0.75),
            ("track_lin_vel_xy_exp", 1.5),
        ],
    ),
    (
        "spot",
        &[
            ("action_smoothness", -1.0),
            ("air_time", 5.0),
            ("air_time_variance", -1.0),
            ("base_angular_velocity", 5.0),
            ("base_linear_velocity", 5.0),
            ("base_motion", -2.0),
            ("base_orientation", -3.0),
            ("foot_clearance", 0.5),
            ("foot_slip", -0.5),
            ("gait", 10.0),
            ("joint_acc", -1.0e-4),
            ("joint_pos", -0.7),
            ("joint_torques", -5.0e-4),
            ("joint_vel", -1.0e-2),
            ("undesired_contacts", -1.0),
        ],
    ),
];

/// Inputs of the formulas for one robot after a step, in double precision.
struct Seen {
    command: [f64; 3],
    /// Velocity of the base's centre of mass, base axes.
    linear: [f64; 3],
    angular: [f64; 3],
    gravity: [f64; 3],
    joints: Vec<f64>,
    default: Vec<f64>,
    joint_velocity: Vec<f64>,
    torque: Vec<f64>,
    acceleration: Vec<f64>,
    action: Vec<f64>,
    last_action: Vec<f64>,
    foot_position: Vec<[f64; 3]>,
    foot_velocity: Vec<[f64; 3]>,
    air: Vec<f64>,
    contact: Vec<f64>,
    last_air: Vec<f64>,
    last_contact: Vec<f64>,
    /// Largest contact force of each body over the last three physics steps, with the body's group.
    peak: Vec<(f64, BodyGroup)>,
    foot_peak: Vec<f64>,
}

fn wide(x: &[f32]) -> Vec<f64> {
    x.iter().map(|&x| f64::from(x)).collect()
}

fn squares<'a>(x: impl IntoIterator<Item = &'a f64>) -> f64 {
    x.into_iter().map(|x| x * x).sum()
}

fn change(x: &[f64], y: &[f64]) -> Vec<f64> {
    x.iter().zip(y).map(|(x, y)| x - y).collect()
}

/// Unbiased variance.
fn variance(x: &[f64]) -> f64 {
    let mean = x.iter().sum::<f64>() / x.len() as f64;
    squares(&x.iter().map(|x| x - mean).collect::<Vec<_>>()) / (x.len() - 1) as f64
}

impl Seen {
    fn count(&self, groups: &[BodyGroup]) -> f64 {
        self.peak.iter().filter(|(force, group)| *force > 1.0 && groups.contains(group)).count() as f64
    }

    fn moving(&self) -> bool {
        squares(&self.command) > 0.0 || squares(&self.linear[..2]).sqrt() > 0.5
    }

    fn foot_speed(&self, foot: usize) -> f64 {
        squares(&self.foot_velocity[foot][..2]).sqrt()
    }

    /// The unweighted value of a term; `thighs_only` tells the two sets' undesired contacts apart.
    fn value(&self, term: &str, thighs_only: bool) -> f64 {
        let (c, v, w) = (&self.command, &self.linear, &self.angular);
        let speed = squares(&c[..2]).sqrt();
        let error = (c[0] - v[0]).powi(2) + (c[1] - v[1]).powi(2);
        let action_change = squares(&change(&self.action, &self.last_action));
        match term {
            "track_lin_vel_xy_exp" => (-error / 0.25).exp(),
            "track_ang_vel_z_exp" => (-(c[2] - w[2]).powi(2) / 0.25).exp(),
            "lin_vel_z_l2" => v[2] * v[2],
            "ang_vel_xy_l2" => w[0] * w[0] + w[1] * w[1],
            "dof_torques_l2" => squares(&self.torque),
            "dof_acc_l2" => squares(&self.acceleration),
            "action_rate_l2" => action_change,
            "flat_orientation_l2" => squares(&self.gravity[..2]),
            "feet_air_time" if speed <= 0.1 => 0.0,
            "feet_air_time" => (0..4)
                .filter(|&foot| self.contact[foot] > 0.0 && self.contact[foot] < STEP_DT + 0.5 * PHYSICS_DT)
                .map(|foot| self.last_air[foot] - 0.5)
                .sum(),
            "undesired_contacts" if thighs_only => self.count(&[BodyGroup::Thigh]),
            "undesired_contacts" => self.count(&[BodyGroup::Thigh, BodyGroup::Shank]),
            "air_time" => (0..4)
                .map(|foot| match (self.moving(), self.air[foot].max(self.contact[foot])) {
                    (true, phase) if phase < f64::from(0.3f32) => phase,
                    (true, _) => 0.0,
                    (false, _) => (self.contact[foot] - self.air[foot]).clamp(-0.3, 0.3),
                })
                .sum(),
            "base_angular_velocity" => (-(c[2] - w[2]).abs() / 2.0).exp(),
            "base_linear_velocity" => (-error.sqrt()).exp() * (1.0 + 0.5 * (speed - 1.0)).max(1.0),
            "foot_clearance" => {
                let error: f64 = (0..4)
                    .map(|foot| (self.foot_position[foot][2] - 0.1).powi(2) * (2.0 * self.foot_speed(foot)).tanh())
                    .sum();
                (-error / 0.05).exp()
            }
            "gait" if !self.moving() => 0.0,
            "gait" => {
                let capped = |x: f64| (x * x).min(0.04);
                let factor = |x: f64, y: f64| (-(capped(x) + capped(y)) / 0.1).exp();
                let (air, contact) = (&self.air, &self.contact);
                let sync = |i: usize, j: usize| factor(air[i] - air[j], contact[i] - contact[j]);
                let apart = |i: usize, j: usize| factor(air[i] - contact[j], contact[i] - air[j]);
                // the trot's pairs, feet in the order LF, LH, RF, RH
                let (pair, other) = ([0, 3], [2, 1]);
                let across: f64 = pair.into_iter().flat_map(|i| other.map(|j| apart(i, j))).product();
                sync(pair[0], pair[1]) * sync(other[0], other[1]) * across
            }
            "action_smoothness" => action_change.sqrt(),
            "air_time_variance" => [&self.last_air, &self.last_contact]
                .map(|times| variance(&times.iter().map(|t| t.min(0.5)).collect::<Vec<_>>()))
                .iter()
                .sum(),
            "base_motion" => 0.8 * v[2] * v[2] + 0.2 * (w[0].abs() + w[1].abs()),
            "base_orientation" => squares(&self.gravity[..2]).sqrt(),
            "foot_slip" => (0..4).filter(|&foot| self.foot_peak[foot] > 1.0).map(|foot| self.foot_speed(foot)).sum(),
            "joint_acc" => squares(&self.acceleration).sqrt(),
            "joint_pos" => squares(&change(&self.joints, &self.default)).sqrt() * if self.moving() { 1.0 } else { 5.0 },
            "joint_torques" => squares(&self.torque).sqrt(),
            "joint_vel" => squares(&self.joint_velocity).sqrt(),
            other => panic!("no formula for {other}"),
        }
    }
}

/// Contact and air times of one robot's feet, counted in whole physics steps.
#[derive(Default, Clone)]
struct Timers {
    /// Physics steps since the foot touched down (positive) or took off (negative), since the
    /// beginning if it never did.
    phase: [i32; 4],
    last_air: [i32; 4],
    last_contact: [i32; 4],
}

impl Timers {
    fn advance(&mut self, foot: usize, touches: bool) {
        let phase = &mut self.phase[foot];
        match (touches, *phase) {
            (true, n) if n < 0 => (self.last_air[foot], *phase) = (1 - n, 1),
            (false, n) if n > 0 => (self.last_contact[foot], *phase) = (n + 1, -1),
            (true, n) => *phase = n + 1,
            (false, n) => *phase = n - 1,
        }
    }

    /// The sensor agrees; its own sums of steps are what the terms use.
    fn check(&self, sensor: &ContactSensor, when: &str) {
        let times = [
            (&sensor.contact_time, self.phase.map(|n| n.max(0))),
            (&sensor.air_time, self.phase.map(|n| (-n).max(0))),
            (&sensor.last_air_time, self.last_air),
            (&sensor.last_contact_time, self.last_contact),
        ];
        for (sensed, counted) in times {
            for (&sensed, counted) in sensed.iter().zip(counted) {
                let seconds = f64::from(counted) * PHYSICS_DT;
                assert!(
                    (f64::from(sensed) - seconds).abs() < 1e-4,
                    "{when}: a foot's time is {sensed}, not {seconds} s"
                );
            }
        }
    }
}

/// The inverse of a rotation by the quaternion w, x, y, z, applied to a vector: `v - 2 w (u x v) +
/// 2 u x (u x v)`.
fn rotate_back([w, x, y, z]: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let u = [x, y, z];
    let once = cross(u, v);
    let twice = cross(u, once);
    std::array::from_fn(|i| v[i] - 2.0 * w * once[i] + 2.0 * twice[i])
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Gathers what the formulas need from the robots' components, by env.
fn see(world: &mut World, robots: &[MorphologyModel], timers: &mut [Timers], when: &str) -> Vec<Seen> {
    let (commands, sensors) = commands_and_sensors(world);
    let mut query = world.query::<(
        &EnvId,
        (&BasePose, &BaseVelocity, &Body, &JointState),
        (&JointEffort, &Action, &Feet, &ContactForces),
    )>();
    let mut all = Vec::new();
    for (id, (pose, velocity, body, joints), (effort, action, feet, forces)) in query.iter(world).sort::<&EnvId>() {
        let env = id.0 as usize;
        let robot = &robots[env / ENVS_PER_ROBOT];
        let sensor = &sensors[env];
        let normals: Vec<&[f32]> = forces.feet_normal.chunks(robot.feet.len()).collect();
        assert_eq!(normals.len(), 4);
        for normal in &normals {
            for (foot, normal) in normal.iter().enumerate() {
                timers[env].advance(foot, *normal > 1.0);
            }
        }
        timers[env].check(sensor, &format!("{when}, env {env}"));
        let mut peaks = vec![0.0f64; robot.body_groups.len()];
        for (foot, &body) in robot.feet.iter().enumerate() {
            peaks[body] = normals[1..].iter().fold(0.0, |most, normal| most.max(f64::from(normal[foot])));
        }
        for force in &forces.others {
            peaks[force.body as usize] = force.normal.iter().fold(0.0, |most, normal| most.max(f64::from(*normal)));
        }
        let rotation = pose.rotation.map(f64::from);
        let angular = velocity.angular.map(f64::from);
        let of_origin = rotate_back(rotation, velocity.linear.map(f64::from));
        let turning = cross(angular, body.0.com[0].map(f64::from));
        all.push(Seen {
            command: commands[env],
            linear: std::array::from_fn(|i| of_origin[i] + turning[i]),
            angular,
            gravity: rotate_back(rotation, [0.0, 0.0, -1.0]),
            joints: wide(&joints.position),
            default: wide(&robot.stance.default_position),
            joint_velocity: wide(&joints.velocity),
            torque: wide(&effort.applied),
            acceleration: wide(&effort.acceleration),
            action: wide(&action.current),
            last_action: wide(&action.previous),
            foot_position: feet.position.iter().map(|x| x.map(f64::from)).collect(),
            foot_velocity: feet.velocity.iter().map(|x| x.map(f64::from)).collect(),
            air: wide(&sensor.air_time),
            contact: wide(&sensor.contact_time),
            last_air: wide(&sensor.last_air_time),
            last_contact: wide(&sensor.last_contact_time),
            foot_peak: robot.feet.iter().map(|&body| peaks[body]).collect(),
            peak: peaks.into_iter().zip(robot.body_groups.iter().copied()).collect(),
        });
    }
    all
}

/// One robot of each set; nobody resets, so that states and sums stay readable after an episode's
/// end.
fn sim() -> Sim {
    Sim::new(&SimOptions {
        robots: Some(SETS.iter().map(|(robot, _)| robot.to_string()).collect()),
        threads: Some(1),
        autoreset: Autoreset::Disabled,
        overrides: [
            "commands.base_velocity.resampling_time_s=1.0",
            "commands.base_velocity.rel_standing_envs=0.3",
            "commands.base_velocity.lin_vel_x=[-2.0, 2.0]",
            "events.push_robot.interval_range_s=[0.5, 1.0]",
        ]
        .map(String::from)
        .to_vec(),
        ..SimOptions::new("velocity_flat", ENVS_PER_ROBOT * SETS.len())
    })
    .unwrap()
}

#[test]
fn every_robot_has_the_terms_of_its_own_set() {
    let sim = sim();
    for ((robot, terms), compiled) in SETS.iter().zip(&sim.task().rewards) {
        let found: Vec<(&str, f32)> = compiled.iter().map(|term| (term.name.as_str(), term.weight)).collect();
        let expected: Vec<(&str, f32)> = terms.iter().map(|&(name, weight)| (name, weight as f32)).collect();
        assert_eq!(found, expected, "{robot}");
    }
}

#[test]
fn terms_have_the_values_of_their_formulas() {
    let mut sim = sim();
    let robots = sim.morphologies().to_vec();
    let mut timers = vec![Timers::default(); sim.num_envs()];
    // how often each term was worth something and how often not
    let mut seen_zero = SETS.map(|(_, terms)| vec![0usize; terms.len()]);
    let mut seen_value = seen_zero.clone();
    for t in 0..STEPS {
        let world = sim.world_mut();
        for mut sums in world.query::<&mut EpisodeSums>().iter_mut(world) {
            sums.terms.fill(0.0);
        }
        // two envs of each robot hold still, so that some stand; the others act more and more
        // wildly
        let before: Vec<f32> = (0..sim.batch().actions.len())
            .map(|i| match i / 12 % ENVS_PER_ROBOT {
                0 | 1 => 0.0,
                env => noise(0, i / 12, t, i % 12) * env as f32 * 0.5,
            })
            .collect();
        sim.step(&before).unwrap();
        let rewards = sim.batch().rewards.clone();
        let when = format!("step {t}");
        let seen = see(sim.world_mut(), &robots, &mut timers, &when);
        let world = sim.world_mut();
        for (id, sums) in world.query::<(&EnvId, &EpisodeSums)>().iter(world) {
            let env = id.0 as usize;
            let set = env / ENVS_PER_ROBOT;
            let (robot, terms) = SETS[set];
            let mut total = 0.0;
            for (i, (&(term, weight), &got)) in terms.iter().zip(&sums.terms).enumerate() {
                let expected = weight * seen[env].value(term, robot == "anymal_d") * STEP_DT;
                total += expected;
                // an absolute floor for what cancels: a millionth of the term's unit
                let tolerance = 1e-5 * expected.abs() + 1e-6 * weight.abs() * STEP_DT;
                assert!(
                    (f64::from(got) - expected).abs() <= tolerance,
                    "{when}, {robot}, env {env}: {term} is {got}, not {expected}"
                );
                let count = if expected.abs() > 1e-9 { &mut seen_value } else { &mut seen_zero };
                count[set][i] += 1;
            }
            let reward = f64::from(rewards[env]);
            assert!((reward - total).abs() < 1e-5 * (1.0 + total.abs()), "{when}, env {env}: {reward} is not {total}");
        }
    }
    for (set, (robot, terms)) in SETS.iter().enumerate() {
        for (i, (term, _)) in terms.iter().enumerate() {
            assert!(seen_value[set][i] > 0, "{robot}: {term} was never worth anything");
            if ["feet_air_time", "undesired_contacts", "foot_slip", "air_time"].contains(term) {
                assert!(seen_zero[set][i] > 0, "{robot}: {term} was never worth nothing");
            }
        }
    }
    let flights = timers.iter().flat_map(|timer| timer.last_air).filter(|&n| n > 0).count();
    assert!(flights > timers.len(), "too few feet have flown and landed: {flights}");
}
