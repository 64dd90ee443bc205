//! Are bodies that all differ as fast as equal ones? `cargo bench --bench varied_bodies`: both in
//! turn, round after round, on one thread, so that whatever else the machine does hits both.
//!
//! Asked of a robot that does not fall, whose varied bodies do what the equal ones do, and of all:
//! heavier and longer bodies fall more often, and robots that lie on the ground cost more whatever
//! their bodies are.

use std::time::Instant;

use polypod::components::EnvRng;
use polypod::{Sim, SimOptions};

const ENVS: usize = 4096;
const STEPS: usize = 10;
const ROUNDS: usize = 15;

fn sim(robots: Option<&str>, varied: bool) -> Sim {
    let options = SimOptions {
        robots: robots.map(|name| vec![name.into()]),
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
    for (name, robots) in [("unitree_a1", Some("unitree_a1")), ("eight robots", None)] {
        println!("{name}:");
        compare([sim(robots, false), sim(robots, true)]);
    }
}

fn compare(mut sims: [Sim; 2]) {
    let mut ended = [0, 0];
    let mut rng = EnvRng::new(0, 0);
    let mut rates = [Vec::new(), Vec::new()];
    for round in 0..=ROUNDS {
        let actions: Vec<Vec<f32>> =
            (0..STEPS).map(|_| (0..ENVS * 12).map(|_| rng.uniform([-1.0, 1.0])).collect()).collect();
        for ((sim, rates), ended) in sims.iter_mut().zip(&mut rates).zip(&mut ended) {
            let began = Instant::now();
            for actions in &actions {
                if let Err(error) = sim.step(actions) {
                    eprintln!("{error}");
                    std::process::exit(1);
                }
                *ended += sim.batch().terminated.iter().filter(|ended| **ended).count();
            }
            // the first round fills the caches
            if round > 0 {
                rates.push((ENVS * STEPS) as f64 / began.elapsed().as_secs_f64());
            }
        }
    }
    for ((name, rates), falls) in ["equal bodies", "varied bodies"].iter().zip(&mut rates).zip(ended) {
        rates.sort_by(f64::total_cmp);
        let (low, middle, high) = (rates[0], rates[ROUNDS / 2], rates[ROUNDS - 1]);
        println!("  {name:<14} {middle:>9.0} env-steps/s (median of {ROUNDS}; {low:.0} .. {high:.0}), {falls} falls");
    }
    println!("  varied / equal: {:.3}", rates[1][ROUNDS / 2] / rates[0][ROUNDS / 2]);
}
