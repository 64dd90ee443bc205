//! Springs of joints and surfaces of links act in both engines, and robots without them keep their
//! bits.

use polypod::components::{BasePose, BaseVelocity, Body, JointState};
use polypod::dynamics::ContactFriction;
use polypod::{Sim, SimOptions};

use crate::common::{assert_all_same, busy, sprung, step};

const ROBOT: &str = "unitree_go2";

/// A robot that stands where it is put, with these changes of its config.
fn calm(changes: &[&str]) -> SimOptions {
    let calm = ["events.reset_base.enabled=false", "events.reset_joints.enabled=false"].map(String::from);
    let changes = changes.iter().map(|change| format!("robot_overrides.{ROBOT}.{change}"));
    SimOptions {
        robots: Some(vec![ROBOT.into()]),
        threads: Some(1),
        overrides: calm.into_iter().chain(changes).collect(),
        ..SimOptions::new("velocity_flat_play", 1)
    }
}

fn on_avian(mut options: SimOptions) -> SimOptions {
    options.overrides.push("physics.engine=avian".into());
    options
}

#[test]
fn threads_do_not_change_the_bits_of_springs_and_surfaces() {
    let options = sprung(busy(&["anymal_d", ROBOT], 40));
    let make = |threads| Sim::new(&SimOptions { threads: Some(threads), ..options.clone() }).unwrap();
    let (mut one, mut three) = (make(1), make(3));
    for t in 0..100 {
        step(&mut one, t);
        step(&mut three, t);
        assert_all_same(&mut one, &mut three, &format!("step {t}"));
    }
}

#[test]
fn springs_and_surfaces_that_do_nothing_change_no_bit() {
    let (plain, mut sprung) = (busy(&["anymal_d"], 20), sprung(busy(&["anymal_d"], 20)));
    // a margin would lift the robots where they begin
    sprung.overrides.iter_mut().for_each(|line| *line = line.replace(", contact_margin=0.002", ""));
    let (mut plain, mut without) = (Sim::new(&plain).unwrap(), Sim::new(&sprung).unwrap());
    let topology = &plain.morphologies()[0].topology;
    assert!(!topology.has_springs && !topology.has_surfaces && topology.friction == ContactFriction::Sliding);
    let topology = &without.morphologies()[0].topology;
    assert!(topology.has_springs && topology.has_surfaces && topology.friction == ContactFriction::Torsional);
    let world = without.world_mut();
    for mut body in world.query::<&mut Body>().iter_mut(world) {
        body.0.spring.iter_mut().for_each(|spring| *spring = [0.0; 2]);
        body.0.contact_friction.iter_mut().for_each(|friction| *friction = [1.0, 0.0, 0.0]);
    }
    for t in 0..100 {
        step(&mut plain, t);
        step(&mut without, t);
        assert_all_same(&mut plain, &mut without, &format!("step {t}"));
    }
}

/// Angle of a joint of each slot after the robot has stood for 2 s, rad.
fn angles(options: &SimOptions) -> Vec<f32> {
    let mut sim = Sim::new(options).unwrap();
    let still = vec![0.0; sim.batch().actions.len()];
    (0..100).for_each(|_| sim.step(&still).unwrap());
    let model = sim.morphologies()[0].clone();
    let world = sim.world_mut();
    let state = world.query::<&JointState>().single(world).unwrap();
    model.slots.iter().map(|slot| slot.sign * state.position[slot.joint()]).collect()
}

#[test]
fn a_spring_pulls_to_its_reference_in_both_engines() {
    // as stiff as the actuators; hips and knees are far from 0.2 rad
    let (stiffness, rest) = (25.0, 0.2);
    let spring = ["actuators.legs.spring_stiffness=25.0", "actuators.legs.spring_reference=0.2"];
    for avian in [false, true] {
        let engine = |options| if avian { on_avian(options) } else { options };
        let (free, pulled) = (angles(&engine(calm(&[]))), angles(&engine(calm(&spring))));
        let model = Sim::new(&calm(&spring)).unwrap().morphologies()[0].clone();
        // a robot in the air would move each joint by the spring's share; on the ground all feet
        // share
        for (slot, joint) in model.slots.iter().enumerate().filter(|(_, joint)| joint.slot.role.is_flexion()) {
            let towards = (rest - free[slot]).signum();
            let moved = (pulled[slot] - free[slot]) * towards;
            let gain = model.nominal.stiffness[joint.joint()];
            let share = stiffness / (stiffness + gain) * (rest - free[slot]).abs();
            assert!(moved > 0.2 * share, "avian {avian}, {}: {moved} of {share}", joint.slot);
        }
    }
}

/// How far a robot that is pushed sideways slides, m.
fn slid(options: &SimOptions) -> f32 {
    let mut sim = Sim::new(options).unwrap();
    let still = vec![0.0; sim.batch().actions.len()];
    (0..50).for_each(|_| sim.step(&still).unwrap());
    let world = sim.world_mut();
    world.query::<&mut BaseVelocity>().single_mut(world).unwrap().linear[0] += 0.6;
    let place = |sim: &mut Sim| {
        let world = sim.world_mut();
        world.query::<&BasePose>().single(world).unwrap().position[0]
    };
    let start = place(&mut sim);
    (0..75).for_each(|_| sim.step(&still).unwrap());
    place(&mut sim) - start
}

#[test]
fn feet_of_less_friction_slide_farther_in_both_engines() {
    let slippery = ["surfaces={feet={bodies=[\"*_foot\"], friction=0.05}}"];
    let thighs = ["surfaces={thighs={bodies=[\"*_thigh\"], friction=0.05}}"];
    for avian in [false, true] {
        let engine = |options| if avian { on_avian(options) } else { options };
        let [plain, on_ice, others] = [&[][..], &slippery, &thighs].map(|changes| slid(&engine(calm(changes))));
        assert!(on_ice > plain + 0.05, "avian {avian}: {on_ice} of {plain}");
        assert!((others - plain).abs() < 0.01, "avian {avian}: {others} of {plain}");
    }
}

#[test]
fn a_margin_lifts_the_robot_in_both_engines() {
    let height = |options: &SimOptions| {
        let mut sim = Sim::new(options).unwrap();
        let still = vec![0.0; sim.batch().actions.len()];
        (0..100).for_each(|_| sim.step(&still).unwrap());
        let world = sim.world_mut();
        world.query::<&BasePose>().single(world).unwrap().position[2]
    };
    let margin = ["surfaces={feet={bodies=[\"*_foot\"], contact_margin=0.008}}"];
    for avian in [false, true] {
        let engine = |options| if avian { on_avian(options) } else { options };
        let lifted = height(&engine(calm(&margin))) - height(&engine(calm(&[])));
        // the legs bend a little otherwise
        assert!((lifted - 0.008).abs() < 1e-3, "avian {avian}: {lifted}");
    }
}

#[test]
fn the_engine_avian_refuses_surfaces_that_resist_turning() {
    let turning = calm(&["surfaces={feet={bodies=[\"*_foot\"], torsional_friction=0.01}}"]);
    assert_eq!(Sim::new(&turning).unwrap().morphologies()[0].topology.friction, ContactFriction::Torsional);
    let error = Sim::new(&on_avian(turning)).err().unwrap().to_string();
    assert!(error.contains("physics.engine: the engine avian") && error.contains(ROBOT), "{error}");
    assert!(error.contains("[surfaces]"), "{error}");
}
