//! Links of one robot that got wedged by random targets, in each other or between a joint limit and the ground, do not fly apart when the joints go passive, nor press with forces
//! that nothing asked for.

mod common;

use polypod::{Control, Simulation, SimulationOptions};

const ENVS: usize = 64;
/// Physics steps, of 5 ms, of random targets, new ones every 50; then of passive joints.
const RANDOM: usize = 600;
const PASSIVE: usize = 200;
const BLOCKS: usize = 8;

#[test]
fn passive_joints_win_no_energy() {
    for robot in ["anymal_b", "anymal_c", "unitree_b2"] {
        let mut sim = Simulation::new(&SimulationOptions::new(robot.to_string(), ENVS)).unwrap();
        let (joints, weight) = (sim.num_joints(), sim.total_mass() * 9.81);
        let range = sim.joint_range();
        let (mut won, mut largest) = (0.0f64, 0.0f64);
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
            let mut least = [f64::INFINITY; ENVS];
            for _ in 0..PASSIVE {
                let (kinetic, potential) = sim.energy();
                for (least, total) in least.iter_mut().zip(kinetic.iter().zip(&potential).map(|(a, b)| a + b)) {
                    *least = least.min(total);
                    won = won.max((total - *least) / weight);
                }
                sim.step(&Control::default(), 1).unwrap();
                largest = sim.contact_forces().into_iter().fold(largest, |largest, f| largest.max(f.abs()));
            }
        }
        println!("{robot}: {:.2} mm of height won, forces up to {:.0} of the weight", 1e3 * won, largest / weight);
        // 1085 mm and hundreds of times the weight while friction resisted the push out of penetrations; ANYmal B's 8 mm are the
        // integrator's (`polypod-sim soak` tells them apart)
        assert!(won < 0.015, "{robot}: passive joints lift it by {won} m");
        assert!(largest < 100.0 * weight, "{robot}: jammed links press with {largest} N");
    }
}
