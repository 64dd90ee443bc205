//! Links of one robot that got wedged by random targets, in each other or between a joint limit and the ground, do not fly apart when the joints
//! go passive, nor press with forces that nothing asked for.

mod common;

use std::process::Command;

use polypod::{Control, Simulation, SimulationOptions};

const ENVS: usize = 64;
/// Physics steps, of 5 ms, of random targets, new ones every 50; then of passive joints.
const RANDOM: usize = 600;
const PASSIVE: usize = 200;
const BLOCKS: usize = 8;

/// By the command that does so for hours: it tells the work of contacts from what the integrator wins where a leg whips through.
#[test]
fn contacts_win_no_energy() {
    let arguments = ["soak", "--robots", "anymal_b,anymal_c,unitree_b2", "--num-envs", "96", "--minutes", "3"];
    let soak = Command::new(env!("CARGO_BIN_EXE_polypod-sim")).args(arguments).output().unwrap();
    println!("{}", String::from_utf8_lossy(&soak.stdout));
    // 1085 mm of height while friction resisted the push out of penetrations
    assert!(soak.status.success(), "{}", String::from_utf8_lossy(&soak.stderr));
}

#[test]
fn links_press_with_no_more_than_they_can() {
    for robot in ["anymal_b", "anymal_c", "unitree_b2"] {
        let mut sim = Simulation::new(&SimulationOptions::new(robot.to_string(), ENVS)).unwrap();
        let (joints, weight) = (sim.num_joints(), sim.total_mass() * 9.81);
        let range = sim.joint_range();
        let mut largest = 0.0f64;
        for block in 0..BLOCKS {
            for turn in 0..RANDOM / 50 {
                let targets: Vec<f64> = (0..ENVS * joints)
                    .map(|i| {
                        let [low, high] = range[i % joints].map(|x| x.clamp(-3.0, 3.0));
                        let at = f64::from(common::noise(11, i / joints, block * 100 + turn, i % joints));
                        low + (high - low) * 0.5 * (1.0 + at)
                    })
                    .collect();
                sim.step(&Control { targets: Some(&targets), ..Control::default() }, 50).unwrap();
            }
            for _ in 0..PASSIVE {
                sim.step(&Control::default(), 1).unwrap();
                largest = sim.contact_forces().into_iter().fold(largest, |largest, f| largest.max(f.abs()));
            }
        }
        println!("{robot}: forces up to {:.0} times the weight", largest / weight);
        // hundreds of times the weight while friction resisted the push out of penetrations
        assert!(largest < 100.0 * weight, "{robot}: jammed links press with {largest} N");
    }
}
