//! A leg that lies between the base and the ground carries the base: it does not give way step
//! after step and end inside the ground.

use polypod::{Control, Simulation, SimulationOptions};

/// Position and velocity of three such robots, as random targets left them (`polypod-sim soak`).
const JAMS: [([f64; 19], [f64; 18]); 3] = [
    (
        [
            0.0, 0.0, 0.2297, 0.0320, -0.8808, -0.4702, -0.0450, 0.8981, -2.1140, -2.0229, -0.9137, -1.4229, -0.1522,
            0.0647, -0.2988, 2.2378, 0.6189, 0.7811, 2.7659,
        ],
        [
            0.02, 0.14, -0.16, -1.17, -0.06, 0.65, 0.20, -0.07, -0.15, -3.63, -5.52, -0.36, -8.13, -7.32, -0.02, 0.41,
            -7.36, -0.02,
        ],
    ),
    (
        [
            0.0, 0.0, 0.2315, -0.0279, -0.9416, 0.3317, -0.0509, 0.8156, 0.4570, 1.7387, -0.8216, -2.1251, -2.0461,
            0.3485, -0.8724, -2.3963, 1.8451, 1.2826, 2.6912,
        ],
        [
            -0.20, -0.18, -0.11, 1.15, 0.19, 0.12, -1.05, -0.41, 1.48, -0.01, -0.01, 0.0, -2.85, -2.06, 0.76, -0.18,
            0.39, 0.01,
        ],
    ),
    (
        [
            0.0, 0.0, 0.2306, -0.1075, 0.0302, -0.0438, -0.9928, 0.7937, -0.0406, -0.6544, 0.9919, 1.9941, -0.1762,
            -0.5627, 1.2342, 2.7279, 1.8000, -2.3230, 0.4507,
        ],
        [
            0.21, 0.09, 0.28, 0.95, -0.05, 0.63, -1.61, -6.81, 7.56, 0.06, 0.04, -0.01, -15.76, 7.29, 0.08, -0.04,
            0.04, -0.01,
        ],
    ),
];
/// Physics steps of 5 ms with passive joints.
const STEPS: usize = 200;

#[test]
fn a_leg_under_the_base_stays_above_the_ground() {
    let (qpos, qvel): (Vec<_>, Vec<_>) = JAMS.iter().copied().unzip();
    let mut sim = Simulation::new(&SimulationOptions::new("anymal_b".to_string(), JAMS.len())).unwrap();
    sim.set_state(None, Some(qpos.as_flattened()), Some(qvel.as_flattened())).unwrap();
    let mut deepest = [0.0f64; JAMS.len()];
    for _ in 0..STEPS {
        sim.step(&Control::default(), 1).unwrap();
        let links = sim.num_links();
        for (deepest, gaps) in deepest.iter_mut().zip(sim.ground_gap().chunks(links)) {
            *deepest = gaps.iter().fold(*deepest, |deepest, gap| deepest.max(-gap));
        }
    }
    println!("at most {:.1?} mm inside the ground", deepest.map(|depth| 1e3 * depth));
    // 4 mm is where the first begins; 27, 16 and 14 mm before contacts that are inside each other
    // had to settle further
    assert!(deepest.iter().all(|&depth| depth < 0.007), "{deepest:?} m");
}
