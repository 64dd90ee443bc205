//! A viewer reads the simulation's state, and a push is a change of velocity.

use polypod::components::{BaseVelocity, EnvId};
use polypod::{Sim, SimOptions};

fn sim(task: &str, more: &[&str]) -> Sim {
    let options = SimOptions {
        robots: Some(vec!["unitree_go2".into(), "spot".into()]),
        threads: Some(1),
        overrides: more.iter().map(ToString::to_string).collect(),
        ..SimOptions::new(task, 5)
    };
    Sim::new(&options).unwrap()
}

fn still(sim: &Sim) -> Vec<f32> {
    vec![0.0; sim.batch().actions.len()]
}

#[test]
fn a_push_adds_its_velocity_and_the_robot_moves() {
    for engine in ["articulated", "avian"] {
        let engine = format!("physics.engine={engine}");
        let (mut pushed, mut alone) = (sim("velocity_flat", &[&engine]), sim("velocity_flat", &[&engine]));
        let mut velocity = vec![0.0; 3 * 5];
        velocity[3 * 4..].copy_from_slice(&[0.5, -0.25, 0.0]);
        pushed.push(&velocity).unwrap();
        let of = |sim: &mut Sim| -> Vec<[f32; 3]> {
            let world = sim.world_mut();
            let mut rows = vec![[0.0; 3]; 5];
            let mut query = world.query::<(&EnvId, &BaseVelocity)>();
            query.iter(world).for_each(|(env, velocity)| rows[env.0 as usize] = velocity.linear);
            rows
        };
        for (env, (with, without)) in of(&mut pushed).into_iter().zip(of(&mut alone)).enumerate() {
            for axis in 0..3 {
                assert!((with[axis] - without[axis] - velocity[3 * env + axis]).abs() < 1e-6);
            }
        }
        let actions = still(&alone);
        pushed.step(&actions).unwrap();
        alone.step(&actions).unwrap();
        // spot has envs 3 and 4; the others are as they were, to the bit
        let (with, without) = (pushed.robot_states(1).qpos, alone.robot_states(1).qpos);
        let row = with.len() / 2;
        assert_eq!(with[..row], without[..row], "{engine}");
        assert_eq!(pushed.robot_states(0), alone.robot_states(0), "{engine}");
        assert!(with[row] - without[row] > 0.002, "{engine}: {} m", with[row] - without[row]);
    }
}

#[test]
fn a_push_that_is_none_is_refused() {
    let mut sim = sim("velocity_flat", &[]);
    let before = sim.robot_states(0);
    for (numbers, problem) in
        [(vec![0.0; 14], "14 numbers"), (vec![f32::NAN; 15], "x of env 0"), (vec![200.0; 15], "200")]
    {
        let error = sim.push(&numbers).unwrap_err().to_string();
        assert!(error.contains(problem), "{error}");
    }
    assert_eq!(before, sim.robot_states(0));
}

#[test]
fn reward_terms_add_up_to_the_reward() {
    let mut sim = sim("velocity_flat", &[]);
    let actions = still(&sim);
    for (robot, envs) in [(0, 0..3), (1, 3..5)] {
        let terms = sim.reward_terms(robot).len();
        assert!(terms > 3);
        let mut before = sim.reward_sums(robot);
        assert_eq!(before.len(), terms * envs.len());
        for _ in 0..5 {
            sim.step(&actions).unwrap();
            let after = sim.reward_sums(robot);
            for (row, env) in envs.clone().enumerate() {
                let range = row * terms..(row + 1) * terms;
                let grown: f32 = after[range.clone()].iter().sum::<f32>() - before[range].iter().sum::<f32>();
                assert!((grown - sim.batch().rewards[env]).abs() < 1e-4);
            }
            before = after;
        }
    }
    assert!(sim.reward_terms(2).is_empty());
}

#[test]
fn height_scans_are_where_the_rays_hit() {
    let small = ["scene.terrain.num_rows=2", "scene.terrain.num_cols=10", "scene.terrain.border_width=2.0"];
    let mut sim = sim("velocity_rough", &small);
    let actions = still(&sim);
    sim.step(&actions).unwrap();
    let points = sim.height_scan();
    assert_eq!(points.len(), 5 * 187 * 3);
    let ground = sim.world().resource::<polypod::world::Ground>().clone();
    let grid = ground.terrain.as_ref().unwrap();
    for point in points.chunks_exact(3) {
        let mut height = [0.0];
        grid.heights_below(&[point[0]], &[point[1]], &mut height);
        assert!((height[0] - point[2]).abs() < 2e-3, "{} is not {}", point[2], height[0]);
    }
    assert!(self::sim("velocity_flat", &[]).height_scan().is_empty());
}
