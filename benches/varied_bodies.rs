//! Are bodies that all differ as fast as equal ones? `cargo bench --bench varied_bodies`: both in turn, round after round, on one
//! thread, so that whatever else the machine does hits both.

use std::time::Instant;

use polypod::components::EnvRng;
use polypod::{Sim, SimOptions};

const ENVS: usize = 4096;
const STEPS: usize = 10;
const ROUNDS: usize = 15;

fn sim(varied: bool) -> Sim {
    let options = SimOptions {
        threads: Some(1),
        overrides: vec![format!("events.body_variation.enabled={varied}")],
        ..SimOptions::new("velocity_flat_variation", ENVS)
    };
    match Sim::new(&options) {
        Ok(sim) => sim,
        Err(error) => {
            eprintln!("{error}");
            std::process::exit(1);
        }
    }
}

fn main() {
    let mut sims = [sim(false), sim(true)];
    let mut rng = EnvRng::new(0, 0);
    let mut rates = [Vec::new(), Vec::new()];
    for round in 0..=ROUNDS {
        let actions: Vec<Vec<f32>> =
            (0..STEPS).map(|_| (0..ENVS * 12).map(|_| rng.uniform([-1.0, 1.0])).collect()).collect();
        for (sim, rates) in sims.iter_mut().zip(&mut rates) {
            let began = Instant::now();
            for actions in &actions {
                if let Err(error) = sim.step(actions) {
                    eprintln!("{error}");
                    std::process::exit(1);
                }
            }
            // the first round fills the caches
            if round > 0 {
                rates.push((ENVS * STEPS) as f64 / began.elapsed().as_secs_f64());
            }
        }
    }
    for (name, rates) in ["equal bodies", "varied bodies"].iter().zip(&mut rates) {
        rates.sort_by(f64::total_cmp);
        let (low, middle, high) = (rates[0], rates[ROUNDS / 2], rates[ROUNDS - 1]);
        println!("{name:<14} {middle:>9.0} env-steps/s (median of {ROUNDS}; {low:.0} .. {high:.0})");
    }
    println!("varied / equal: {:.3}", rates[1][ROUNDS / 2] / rates[0][ROUNDS / 2]);
}
