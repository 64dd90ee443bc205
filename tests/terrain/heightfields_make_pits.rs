//! Heights below zero in a heightfield exist, on both engines, or the task is refused.

use polypod::components::{BasePose, EnvId, Feet};
use polypod::systems::StateField;
use polypod::world::Ground;
use polypod::{Sim, SimOptions};

/// A field of 4 x 4 m in rows along x, at `z`.
fn field(rows: &[&str], more: &str) -> String {
    format!(
        "scene.obstacles=[{{shape=\"heightfield\", size=[4.0, 4.0], position=[0.0, 0.0, 0.0], heights=[{}]{more}}}]",
        rows.join(", ")
    )
}

fn options(scene: &[String], more: &[&str]) -> SimOptions {
    let mut overrides: Vec<String> =
        ["events.reset_base.x=[0.0, 0.0]", "events.reset_base.y=[0.0, 0.0]", "events.push_robot.enabled=false"]
            .map(String::from)
            .to_vec();
    overrides.extend_from_slice(scene);
    overrides.extend(more.iter().map(|text| text.to_string()));
    SimOptions { overrides, robots: Some(vec!["unitree_go2".into()]), ..SimOptions::new("velocity_flat", 4) }
}

const DEEP: [&str; 2] = ["[-1.0, -1.0]", "[-1.0, -1.0]"];

fn sampled(sim: &Sim, place: [f32; 2]) -> f32 {
    let ground = sim.world().resource::<Ground>();
    ground.terrain.as_ref().unwrap().sample(place[0], place[1]).0
}

#[test]
fn a_robot_stands_on_the_bottom_of_a_pit() {
    for engine in ["articulated", "avian"] {
        let mut sim = Sim::new(&options(&[field(&DEEP, "")], &[&format!("physics.engine={engine}")])).unwrap();
        for place in [[0.0, 0.0], [1.9, -1.9], [-1.5, 0.3]] {
            assert_eq!(sampled(&sim, place), -1.0, "{place:?}");
        }
        for place in [[2.05, 0.0], [0.0, -2.05], [3.0, 3.0], [30.0, 0.0]] {
            assert_eq!(sampled(&sim, place), 0.0, "{place:?}");
        }
        let actions = vec![0.0; sim.batch().actions.len()];
        for _ in 0..50 {
            sim.step(&actions).unwrap();
            assert!(!sim.batch().terminated.contains(&true), "{engine}");
        }
        let world = sim.world_mut();
        for (_, pose, feet) in world.query::<(&EnvId, &BasePose, &Feet)>().iter(world) {
            assert!((-0.8..-0.6).contains(&pose.position[2]), "{engine}: base at {} m", pose.position[2]);
            assert!(feet.height.iter().all(|height| (0.0..0.06).contains(height)), "{engine}: {:?}", feet.height);
        }
        let mut heights = vec![0.0; 4];
        sim.state(StateField::BaseHeight, &mut heights).unwrap();
        assert!(heights.iter().all(|height| (0.2..0.4).contains(height)));
    }
}

#[test]
fn stones_and_pits_alternate() {
    let rows = ["[0.03, -1.0, 0.03]", "[-1.0, -1.0, -1.0]", "[0.03, -1.0, -0.03]"];
    let sim = Sim::new(&options(&[field(&rows, "")], &[])).unwrap();
    // a fortieth of a cell from the corners
    let corner = 1.95;
    for (place, height) in [
        ([-corner, -corner], 0.004),
        ([-corner, 0.0], -1.0),
        ([0.0, 0.0], -1.0),
        ([corner, corner], -0.054),
        ([-1.0, -1.0], -0.485),
    ] {
        assert!((sampled(&sim, place) - height).abs() < 0.005, "{place:?}: {}", sampled(&sim, place));
    }
    // an obstacle in a pit is seen there
    let scene = "scene.obstacles=[{shape=\"heightfield\", size=[4.0, 4.0], position=[0.0, 0.0, 0.0], \
        heights=[[-1.0, -1.0], [-1.0, -1.0]]}, {shape=\"box\", size=[1.0, 1.0, 0.4], position=[1.0, 0.0, -0.8]}]";
    let sim = Sim::new(&options(&[scene.into()], &[])).unwrap();
    assert!((sampled(&sim, [1.0, 0.0]) + 0.6).abs() < 1e-4);
    assert!((sampled(&sim, [-1.0, 0.0]) + 1.0).abs() < 1e-4);
}

#[test]
fn a_field_that_is_nowhere_below_the_ground_changes_nothing_beside_it() {
    let raised = field(&["[0.0, 0.2]", "[0.2, 0.0]"], "");
    let sim = Sim::new(&options(&[raised], &[])).unwrap();
    assert_eq!(sampled(&sim, [2.5, 0.0]), 0.0);
    assert!(sim.task().config.scene.pits().is_empty());
}

#[test]
fn what_cannot_be_is_refused_with_a_remedy() {
    let terrain = "scene.terrain={size=[8.0, 8.0], num_rows=2, num_cols=2, border_width=5.0, \
        sub_terrains=[{name=\"flat\", type=\"flat\", proportion=1.0}]}";
    let buried = "scene.obstacles=[{shape=\"SHAPE\", position=[1.0, 0.0, -0.5]}]";
    for (scene, problem, remedy) in [
        (vec![field(&DEEP, ", rpy=[0.0, 0.0, 0.3]")], "scene.obstacles[0]: it is turned", "leave out its rpy"),
        (
            vec![field(&DEEP, ""), terrain.into(), "scene.placement=global".into()],
            "generated terrain covers it",
            "leave out scene.terrain",
        ),
        (
            vec![buried.replace("SHAPE\"", "box\", size=[1.0, 1.0, 0.4]")],
            "scene.obstacles[0]: all of it is below the ground",
            "make pits with a heightfield",
        ),
        (
            vec![buried.replace("SHAPE\"", "sphere\", radius=0.4")],
            "scene.obstacles[0]: all of it is below the ground",
            "raise it",
        ),
        (
            vec![buried.replace("SHAPE\"", "ramp\", size=[1.0, 1.0, 0.4]")],
            "scene.obstacles[0]: all of it is below the ground",
            "raise it",
        ),
    ] {
        let error = Sim::new(&options(&scene, &[])).err().map(|error| error.to_string()).unwrap_or_default();
        assert!(error.contains(problem) && error.contains(remedy), "{scene:?}: {error}");
    }
    // half of it is above
    let half = buried.replace("SHAPE\"", "box\", size=[1.0, 1.0, 1.4]");
    let sim = Sim::new(&options(&[half], &[])).unwrap();
    assert!((sampled(&sim, [1.0, 0.0]) - 0.2).abs() < 1e-4);
}
