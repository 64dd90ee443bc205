//! Heights in terms are heights above the ground below, whatever the ground and however high it
//! lies.

use polypod::components::{BasePose, EnvId, EnvOrigin};
use polypod::systems::StateField;
use polypod::world::Ground;
use polypod::{Sim, SimOptions};

use crate::common;

const STAIRS: &str = "scene.terrain={size=[8.0, 8.0], num_rows=10, num_cols=2, border_width=20.0, \
    max_init_terrain_level=9, sub_terrains=[{name=\"s\", type=\"TYPE\", proportion=1.0, \
    step_height_range=[0.05, 0.23], step_width=0.3, platform_width=3.0, border_width=1.0}]}";

fn still(task: &str, num_envs: usize, more: &[String]) -> Sim {
    let mut overrides: Vec<String> = [
        "events.reset_base.x=[0.0, 0.0]",
        "events.reset_base.y=[0.0, 0.0]",
        "events.push_robot.enabled=false",
        "events.add_base_mass.enabled=false",
    ]
    .map(String::from)
    .to_vec();
    overrides.extend_from_slice(more);
    let options = SimOptions { overrides, robots: Some(vec!["unitree_go2".into()]), ..SimOptions::new(task, num_envs) };
    Sim::new(&options).unwrap()
}

fn state(sim: &mut Sim, field: StateField) -> Vec<f32> {
    let mut rows = vec![0.0; sim.num_envs() * sim.state_width(field)];
    sim.state(field, &mut rows).unwrap();
    rows
}

fn step(sim: &mut Sim) {
    let actions = vec![0.0; sim.batch().actions.len()];
    sim.step(&actions).unwrap();
}

#[test]
fn a_robot_that_stands_in_a_hollow_or_on_a_hill_has_not_sunk() {
    for shape in ["pyramid_stairs_inv", "pyramid_stairs"] {
        let ground = [STAIRS.replace("TYPE", shape), "scene.grid_cell=0.025".into()];
        let lowest = "[terminations.root_height_below_minimum]\nminimum_height = 0.2";
        let mut sim = still(&common::extended_task("lowest", "velocity_flat", lowest), 64, &ground);
        for _ in 0..25 {
            step(&mut sim);
            assert!(!sim.batch().terminated.contains(&true), "{shape}: a robot that stands was ended");
        }
        let (heights, places) = (state(&mut sim, StateField::BaseHeight), state(&mut sim, StateField::BasePos));
        for (height, place) in heights.iter().zip(places.chunks(3)) {
            assert!((0.2..0.4).contains(height), "{shape}: {height} m above the ground");
            assert!((height - place[2]).abs() < 0.02, "{shape}: {} m above the origin", place[2]);
        }
        // and one that has fallen has
        let world = sim.world_mut();
        for mut pose in world.query::<&mut BasePose>().iter_mut(world) {
            pose.position[2] -= 0.15;
            pose.rotation = [0.0, 1.0, 0.0, 0.0];
        }
        step(&mut sim);
        assert!(sim.batch().terminated.iter().all(|ended| *ended), "{shape}");
    }
}

#[test]
fn rewards_of_height_are_the_same_on_any_tile() {
    let term = "rewards.unitree.base_height_l2={weight=-1.0, target_height=0.3}".to_string();
    let worth = |ground: &[String]| -> Vec<f32> {
        let mut sim = still("velocity_flat", 16, &[ground.to_vec(), vec![term.clone()]].concat());
        (0..50).for_each(|_| step(&mut sim));
        let terms = sim.reward_terms(0).len();
        let at = sim.reward_terms(0).iter().position(|name| *name == "base_height_l2").unwrap();
        sim.reward_sums(0).chunks(terms).map(|row| row[at]).collect()
    };
    let flat = worth(&[]);
    for shape in ["pyramid_stairs_inv", "pyramid_stairs"] {
        let tiles = worth(&[STAIRS.replace("TYPE", shape), "scene.grid_cell=0.025".into()]);
        for (here, there) in flat.iter().zip(&tiles) {
            assert!((here - there).abs() < 2e-3, "{shape}: {there}, on the plane {here}");
        }
    }
}

#[test]
fn a_robot_on_a_box_is_as_high_as_beside_it() {
    let table = "scene.obstacles=[{shape=\"box\", size=[3.0, 3.0, 0.5], position=[0.0, 0.0, 0.25]}]".to_string();
    let mut sim = still("velocity_flat", 4, &[table]);
    (0..50).for_each(|_| step(&mut sim));
    for height in state(&mut sim, StateField::BaseHeight) {
        assert!((0.25..0.4).contains(&height), "{height} m above the box");
    }
    assert!(state(&mut sim, StateField::FeetHeight).iter().all(|height| *height < 0.1));
    // the env's origin lies on the box
    assert!(state(&mut sim, StateField::BasePos).chunks(3).all(|place| place[2] < 0.4));
}

#[test]
fn positions_are_about_the_origin_on_the_ground() {
    let mut sim = still("velocity_rough", 40, &[]);
    let ground = sim.world().resource::<Ground>().clone();
    let places = state(&mut sim, StateField::BasePos);
    let world = sim.world_mut();
    let origins: Vec<(EnvId, EnvOrigin)> =
        world.query::<(&EnvId, &EnvOrigin)>().iter(world).map(|(env, origin)| (*env, *origin)).collect();
    let mut heights = Vec::new();
    for (env, pose) in world.query::<(&EnvId, &BasePose)>().iter(world) {
        let origin = origins.iter().find(|(id, _)| id == env).unwrap().1;
        let height = ground.height_at(&origin, [0.0; 2]);
        heights.push(height.abs());
        let row = &places[3 * env.0 as usize..][..3];
        assert_eq!(row, [pose.position[0], pose.position[1], pose.position[2] - height]);
    }
    assert!(heights.iter().any(|height| *height > 0.1), "no tile is high or deep");
}
