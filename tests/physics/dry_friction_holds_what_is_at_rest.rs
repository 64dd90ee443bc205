//! Joints that dry friction holds stay where they are in the air, and nearly so on the ground.

use polypod::{Control, Simulation, SimulationOptions};

/// Robots whose joints have dry friction.
const ROBOTS: [&str; 2] = ["unitree_a1", "spot"];

/// The fastest joint between 10 s and 20 s after the robot was put into its default pose, rad/s: by
/// how far each has come.
fn creep(robot: &str, in_air: bool) -> f64 {
    let options = SimulationOptions { threads: Some(1), ..SimulationOptions::new(robot, 1) };
    let options = if in_air { SimulationOptions { fixed_base: true, ground: None, ..options } } else { options };
    let mut sim = Simulation::new(&options).unwrap();
    let first = sim.nq() - sim.num_joints();
    let targets = sim.default_qpos()[first..].to_vec();
    let hold = Control { targets: Some(&targets), ..Control::default() };
    sim.step(&hold, 2000).unwrap();
    let before = sim.qpos();
    sim.step(&hold, 2000).unwrap();
    let moved = sim.qpos().iter().zip(&before).skip(first).fold(0.0, |most: f64, (q, p)| most.max((q - p).abs()));
    moved / 10.0
}

/// On the ground feet creep a little, and the joints with them, rad/s. Measured: 7e-5.
const ON_GROUND: f64 = 2e-4;

#[test]
fn nothing_creeps() {
    for robot in ROBOTS {
        for (in_air, most) in [(true, 0.0), (false, ON_GROUND)] {
            let speed = creep(robot, in_air);
            println!("{robot:<12} {:<9} {speed:.1e} rad/s", if in_air { "in air" } else { "on ground" });
            assert!(speed <= most, "{robot}, in air {in_air}: {speed} rad/s");
        }
    }
}
