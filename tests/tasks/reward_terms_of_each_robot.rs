//! Each robot is paid by the terms of its set and by no other, and each term has its formula's
//! value for two states worked out by hand.

use polypod::components::{
    Action, BasePose, BaseVelocity, ContactSensor, EnvOrigin, Feet, Imu, JointEffort, JointState, PerJoint,
};
use polypod::morphology::MorphologyModel;
use polypod::robot::BodyGroup;
use polypod::systems::{CommandView, RobotView};
use polypod::world::Ground;
use polypod::{Sim, SimOptions};
use smallvec::smallvec;

/// Unweighted values for a robot that walks, told to go at (0.6, -0.8) m/s and 0.5 rad/s, and for
/// one that is to stand.
///
/// Both: v = (0.3, -0.4, 0.2), w = (0.4, -0.3, 0.1), gravity (0.6, 0, -0.8); joints 0.1 rad off, at
/// 0.5 rad/s, 10 rad/s^2 and 2 N m; actions 0.3 after 0.1; feet LF, LH, RF, RH: air 0.2, 0, 0, 0.1
/// s, contact 0, 0.02, 0.4, 0 s, last air 0.6, 0.7, 0.3, 0.2 s, last contact 0.5, 0.1, 0.3, 0.8 s,
/// heights 0.2, 0.03, 0.03, 0.1 m, speeds 0.5, 0, 1, 0 m/s; LH and RF on the ground; one thigh and
/// one shank in contact. The one that stands moves at v = (0.03, 0.04, 0.2) m/s.
const VALUES: [(&str, f64, f64); 22] = [
    // e^-(0.3^2 + 0.4^2) / 0.25; e^-(0.05^2 / 0.25)
    ("track_lin_vel_xy_exp", 0.367_879_4, 0.990_049_8),
    // e^-(0.4^2 / 0.25); e^-(0.1^2 / 0.25)
    ("track_ang_vel_z_exp", 0.527_292_4, 0.960_789_4),
    ("lin_vel_z_l2", 0.04, 0.04),
    ("ang_vel_xy_l2", 0.25, 0.25),
    ("dof_torques_l2", 48.0, 48.0),
    ("dof_acc_l2", 1200.0, 1200.0),
    ("action_rate_l2", 0.48, 0.48),
    ("flat_orientation_l2", 0.36, 0.36),
    // LH has just landed after 0.7 s; who stands gets nothing for it
    ("feet_air_time", 0.2, 0.0),
    // 0.2 + 0.02 + nothing for 0.4 + 0.1; -0.2 + 0.02 + 0.3 - 0.1
    ("air_time", 0.32, 0.02),
    // e^-(0.4 / 2); e^-(0.1 / 2)
    ("base_angular_velocity", 0.818_730_8, 0.951_229_4),
    // e^-0.5 at the speed from which it grows; e^-0.05
    ("base_linear_velocity", 0.606_530_7, 0.951_229_4),
    // 0.1^2 tanh 1 + 0.07^2 tanh 2 over 0.05
    ("foot_clearance", 0.781_302_0, 0.781_302_0),
    // 0.01 + 0.04 in step, 0.04 + 0.0324 + 0.04 + 0.0064 in turn, over 0.1
    ("gait", 0.184_888_9, 0.0),
    ("action_smoothness", 0.692_820_3, 0.692_820_3),
    // 0.0675 / 3 + 0.11 / 3
    ("air_time_variance", 0.059_166_7, 0.059_166_7),
    ("base_motion", 0.172, 0.172),
    ("base_orientation", 0.6, 0.6),
    ("foot_slip", 1.0, 1.0),
    ("joint_acc", 34.641_016, 34.641_016),
    // 0.1 sqrt 12, five times that for who is to stand and does
    ("joint_pos", 0.346_410_2, 1.732_050_8),
    ("joint_vel", 1.732_050_8, 1.732_050_8),
];

const LEGGED: [&str; 9] = [
    "action_rate_l2",
    "ang_vel_xy_l2",
    "dof_acc_l2",
    "dof_torques_l2",
    "feet_air_time",
    "flat_orientation_l2",
    "lin_vel_z_l2",
    "track_ang_vel_z_exp",
    "track_lin_vel_xy_exp",
];
const SPOT: [&str; 15] = [
    "action_smoothness",
    "air_time",
    "air_time_variance",
    "base_angular_velocity",
    "base_linear_velocity",
    "base_motion",
    "base_orientation",
    "foot_clearance",
    "foot_slip",
    "gait",
    "joint_acc",
    "joint_pos",
    "joint_torques",
    "joint_vel",
    "undesired_contacts",
];

/// Robots, whether `undesired_contacts` joins the nine terms, and the weights of those that differ:
/// torques, orientation, air time.
const ROBOTS: [(&str, bool, [f32; 3]); 7] = [
    ("anymal_d", true, [-2.5e-5, -5.0, 0.5]),
    ("anymal_c", true, [-2.5e-5, -5.0, 0.5]),
    ("anymal_b", true, [-2.5e-5, -5.0, 0.5]),
    ("unitree_a1", false, [-2.0e-4, -2.5, 0.25]),
    ("unitree_go1", false, [-2.0e-4, -2.5, 0.25]),
    ("unitree_go2", false, [-2.0e-4, -2.5, 0.25]),
    ("unitree_b2", false, [-2.0e-5, -5.0, 0.125]),
];

fn sim() -> Sim {
    Sim::new(&SimOptions { threads: Some(1), ..SimOptions::new("velocity_flat", 8) }).unwrap()
}

/// The parts of a state, walking or standing.
struct Hand {
    command: [f32; 3],
    pose: BasePose,
    velocity: BaseVelocity,
    imu: Imu,
    joints: JointState,
    effort: JointEffort,
    action: Action,
    contacts: ContactSensor,
    feet: Feet,
}

fn twelve(x: f32) -> PerJoint {
    smallvec![x; 12]
}

fn hand(model: &MorphologyModel, walks: bool) -> Hand {
    let mut peak_force = smallvec![0.0; model.body_groups.len()];
    let mut touch = |body: usize, force: f32| peak_force[body] = force;
    touch(model.feet[1], 50.0);
    touch(model.feet[2], 60.0);
    for group in [BodyGroup::Thigh, BodyGroup::Shank] {
        touch(model.body_groups.iter().position(|g| *g == group).unwrap(), 5.0);
    }
    let positions = [0.2, 0.03, 0.03, 0.1].map(|z| [0.0, 0.0, z]);
    let velocities = [[0.3, 0.4, 1.0], [0.0, 0.0, 0.5], [-0.6, 0.8, 0.0], [0.0, 0.0, 0.0]];
    Hand {
        command: if walks { [0.6, -0.8, 0.5] } else { [0.0; 3] },
        pose: BasePose { position: [0.0, 0.0, 0.5], rotation: [1.0, 0.0, 0.0, 0.0] },
        velocity: BaseVelocity::default(),
        imu: Imu {
            linear_velocity: if walks { [0.3, -0.4, 0.2] } else { [0.03, 0.04, 0.2] },
            angular_velocity: [0.4, -0.3, 0.1],
            projected_gravity: [0.6, 0.0, -0.8],
            heading: 0.0,
        },
        joints: JointState {
            position: model.stance.default_position.iter().map(|q| q + 0.1).collect(),
            velocity: twelve(0.5),
        },
        effort: JointEffort { applied: twelve(-2.0), acceleration: twelve(10.0) },
        action: Action { current: twelve(0.3), previous: twelve(0.1) },
        contacts: ContactSensor {
            peak_force,
            contact_time: smallvec![0.0, 0.02, 0.4, 0.0],
            air_time: smallvec![0.2, 0.0, 0.0, 0.1],
            last_contact_time: smallvec![0.5, 0.1, 0.3, 0.8],
            last_air_time: smallvec![0.6, 0.7, 0.3, 0.2],
        },
        feet: Feet {
            position: positions.into(),
            velocity: velocities.into(),
            height: positions.map(|foot| foot[2]).into(),
        },
    }
}

#[test]
fn each_robot_has_its_own_terms_and_no_others() {
    let sim = sim();
    for (index, (robot, contacts, [torques, orientation, air])) in ROBOTS.into_iter().enumerate() {
        assert_eq!(sim.morphologies()[index].name(), robot);
        let terms = &sim.task().rewards[index];
        let names: Vec<&str> = terms.iter().map(|term| term.name.as_str()).collect();
        let expected: Vec<&str> = LEGGED.into_iter().chain(contacts.then_some("undesired_contacts")).collect();
        assert_eq!(names, expected, "{robot}");
        let weight = |name: &str| terms.iter().find(|term| term.name == name).unwrap().weight;
        let own = [weight("dof_torques_l2"), weight("flat_orientation_l2"), weight("feet_air_time")];
        assert_eq!(own, [torques, orientation, air], "{robot}");
    }
    let names: Vec<&str> = sim.task().rewards[7].iter().map(|term| term.name.as_str()).collect();
    assert_eq!(names, SPOT);
}

#[test]
fn terms_are_worth_what_was_worked_out_by_hand() {
    let sim = sim();
    let mut checked = 0;
    for (model, terms) in sim.morphologies().iter().zip(&sim.task().rewards) {
        for walks in [true, false] {
            let h = hand(model, walks);
            let view = RobotView {
                morphology: model,
                command: &h.command,
                commands: CommandView::default(),
                pose: &h.pose,
                velocity: &h.velocity,
                imu: &h.imu,
                joints: &h.joints,
                effort: &h.effort,
                action: &h.action,
                contacts: &h.contacts,
                feet: &h.feet,
                height_scan: &[],
                image: &[],
                is_new_image: false,
                joint_descriptors: &[],
                body: &model.nominal,
                stance: &model.stance,
                ground: sim.world().resource::<Ground>(),
                origin: &EnvOrigin::default(),
                terminated: false,
                step_dt: 0.02,
            };
            for term in terms {
                let expected = match term.name.as_str() {
                    // the set of ANYmal names thighs, that of Spot thighs and shanks
                    "undesired_contacts" if model.config.reward_set == "anymal" => 1.0,
                    "undesired_contacts" => 2.0,
                    "joint_torques" => 6.928_203_2,
                    name => {
                        let (_, walking, standing) = VALUES.iter().find(|(known, ..)| *known == name).unwrap();
                        if walks { *walking } else { *standing }
                    }
                };
                let value = f64::from(term.value(&view));
                let robot = model.name();
                assert!(
                    (value - expected).abs() < 2e-6 * (1.0 + expected),
                    "{robot}, walks {walks}: {} is {value}, not {expected}",
                    term.name
                );
                checked += 1;
            }
        }
    }
    assert_eq!(checked, 2 * (3 * 10 + 4 * 9 + 15));
}
