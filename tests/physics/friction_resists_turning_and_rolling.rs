//! A task's torsional and rolling friction act on its robots, on a plane and on other ground. A
//! task without them has no such rows.

use polypod::components::{BasePose, BaseVelocity, Body};
use polypod::dynamics::ContactFriction;
use polypod::{Sim, SimOptions};

use crate::common::{assert_all_same, busy, step};

const ROBOT: &str = "unitree_go2";

fn options(task: &str, overrides: &[&str]) -> SimOptions {
    SimOptions {
        robots: Some(vec![ROBOT.into()]),
        threads: Some(1),
        overrides: overrides.iter().map(ToString::to_string).collect(),
        ..SimOptions::new(task, 1)
    }
}

/// Friction coefficients of a task with these changes.
fn friction_of(overrides: &[&str]) -> ContactFriction {
    let sim = Sim::new(&options("velocity_flat", overrides)).unwrap();
    let topology = &sim.morphologies()[0].topology;
    let rows = if topology.friction == ContactFriction::Sliding { 0 } else { topology.contacts.len() };
    assert!(topology.pairs.is_empty());
    assert_eq!(topology.num_impulses(), topology.contacts.len() + rows);
    topology.friction
}

#[test]
fn coefficients_decide_which_rows_there_are() {
    use ContactFriction::{Rolling, Sliding, Torsional};
    let material = "events.physics_material";
    let (off, range) =
        (format!("{material}.enabled=false"), format!("{material}.torsional_friction_range=[0.0, 0.02]"));
    let own = format!("robot_overrides.{ROBOT}.randomization.rolling_friction=[0.0, 0.01]");
    for (expected, overrides) in [
        (Sliding, vec![]),
        (Sliding, vec!["robot_material.torsional_friction=0.0", "scene.ground.rolling_friction=0.0"]),
        (Torsional, vec!["robot_material.torsional_friction=0.01"]),
        (Torsional, vec!["scene.ground.torsional_friction=0.01"]),
        (Rolling, vec!["robot_material.rolling_friction=0.01"]),
        (Rolling, vec!["scene.ground.rolling_friction=0.01", "scene.ground.torsional_friction=0.01"]),
        (Torsional, vec![range.as_str()]),
        (Rolling, vec![own.as_str()]),
        (Sliding, vec![range.as_str(), own.as_str(), off.as_str()]),
    ] {
        assert_eq!(friction_of(&overrides), expected, "{overrides:?}");
    }
}

#[test]
fn the_larger_coefficient_of_robot_and_ground_acts() {
    let of = |overrides: &[&str]| {
        let mut sim = Sim::new(&options("velocity_flat_play", overrides)).unwrap();
        let world = sim.world_mut();
        let body = world.query::<&Body>().single(world).unwrap();
        [body.0.torsional_friction, body.0.rolling_friction]
    };
    let ground = ["scene.ground.torsional_friction=0.01", "scene.ground.rolling_friction=0.002"];
    let robot = ["robot_material.torsional_friction=0.005", "robot_material.rolling_friction=0.003"];
    assert_eq!(of(&[]), [0.0, 0.0]);
    assert_eq!(of(&ground), [0.01, 0.002]);
    assert_eq!(of(&robot), [0.005, 0.003]);
    assert_eq!(of(&[&ground[..], &robot[..]].concat()), [0.01, 0.003]);
}

/// How far a standing robot turns that is given a yaw rate of 3 rad/s, rad.
fn turned(overrides: &[&str]) -> f32 {
    let calm = ["events.reset_base.enabled=false", "events.reset_joints.enabled=false"];
    let mut sim = Sim::new(&options("velocity_flat_play", &[&calm[..], overrides].concat())).unwrap();
    let still = vec![0.0; sim.batch().actions.len()];
    (0..50).for_each(|_| sim.step(&still).unwrap());
    let world = sim.world_mut();
    world.query::<&mut BaseVelocity>().single_mut(world).unwrap().angular[2] += 3.0;
    let heading = |sim: &mut Sim| {
        let world = sim.world_mut();
        let [w, x, y, z] = world.query::<&BasePose>().single(world).unwrap().rotation;
        (w * z + x * y).atan2(0.5 - (y * y + z * z))
    };
    let start = heading(&mut sim);
    let mut most = 0.0f32;
    for _ in 0..15 {
        sim.step(&still).unwrap();
        most = most.max((heading(&mut sim) - start).abs());
    }
    most
}

#[test]
fn a_robot_turns_less_on_a_plane_and_on_a_grid_of_heights() {
    // an obstacle makes the ground a grid of heights
    let box_at_the_side = "scene.obstacles=[{shape = \"box\", size = [0.2, 0.2, 0.2], position = [1.8, 1.8, 0.1]}]";
    let friction = "robot_material.torsional_friction=0.05";
    let (free, held) = (turned(&[]), turned(&[friction]));
    let (free_on_grid, held_on_grid) = (turned(&[box_at_the_side]), turned(&[box_at_the_side, friction]));
    println!("{free} {held} {free_on_grid} {held_on_grid}");
    assert!(held < 0.95 * free, "{held} of {free}");
    assert!((free - free_on_grid).abs() < 0.01 * free && (held - held_on_grid).abs() < 0.01 * free);
}

#[test]
fn rows_without_a_coefficient_change_no_bit() {
    let plain = busy(&["spot"], 20);
    let mut with_rows = plain.clone();
    with_rows.overrides.push("scene.ground.rolling_friction=0.01".into());
    let (mut plain, mut with_rows) = (Sim::new(&plain).unwrap(), Sim::new(&with_rows).unwrap());
    let world = with_rows.world_mut();
    world.query::<&mut Body>().iter_mut(world).for_each(|mut body| body.0.rolling_friction = 0.0);
    for t in 0..100 {
        step(&mut plain, t);
        step(&mut with_rows, t);
        assert_all_same(&mut plain, &mut with_rows, &format!("step {t}"));
    }
}

#[test]
fn the_engine_avian_refuses_it() {
    let error = Sim::new(&options(
        "velocity_flat",
        &["physics.engine=avian", "events.physics_material.torsional_friction_range=[0.0, 0.02]"],
    ));
    let error = error.err().unwrap().to_string();
    assert!(error.contains("physics.engine: the engine avian") && error.contains(ROBOT), "{error}");
    assert!(error.contains("torsional_friction") && error.contains("articulated"), "{error}");
}
