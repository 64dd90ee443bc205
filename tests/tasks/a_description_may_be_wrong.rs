//! A term that describes the robot may have errors: drawn when an episode begins, kept until it
//! ends, within their limit.

use polypod::{Sim, SimOptions};

use crate::common::noise;

const ERROR: f32 = 0.2;
const ROBOTS: [&str; 2] = ["anymal_c", "cassie"];
const ENVS: usize = 16;

fn sim(changes: &[&str], threads: usize) -> Sim {
    let quiet = ["sim.episode_length_s=0.4", "observations.policy.joint_pos_rel.noise=0"];
    Sim::new(&SimOptions {
        robots: Some(ROBOTS.map(str::to_owned).to_vec()),
        overrides: quiet.iter().chain(changes).map(|text| (*text).to_owned()).collect(),
        threads: Some(threads),
        ..SimOptions::new("velocity_flat_any_legged", ENVS)
    })
    .unwrap()
}

fn wrong(threads: usize) -> Sim {
    sim(&["observations.policy.joint_descriptors.error=0.2"], threads)
}

/// Descriptions of each env's robot in the observations `rows`.
fn described(sim: &Sim, rows: &[f32]) -> Vec<Vec<f32>> {
    let terms = &sim.task().observations;
    let at = terms.iter().position(|term| term.name == "joint_descriptors").unwrap();
    let start: usize = terms[..at].iter().map(|term| term.size).sum();
    rows.chunks(sim.batch().num_obs).map(|row| row[start..start + terms[at].size].to_vec()).collect()
}

fn step(sim: &mut Sim, t: usize) {
    let width = sim.batch().actions.len() / ENVS;
    let actions: Vec<f32> = (0..ENVS * width).map(|i| 0.2 * noise(0, i / width, t, i % width)).collect();
    sim.step(&actions).unwrap();
}

#[test]
fn errors_last_an_episode() {
    // randomised bodies are described too: the true numbers are those without
    let [gains, joints, motors] = ["actuator_gains", "joint_parameters", "motor_strength"]
        .map(|what| format!("events.randomize_{what}.enabled=false"));
    let told_wrongly = "observations.policy.joint_descriptors.error=0.2";
    let (mut told, truth) = (sim(&[&gains, &joints, &motors, told_wrongly], 2), sim(&[&gains, &joints, &motors], 1));
    let exact = described(&truth, &truth.batch().observations);
    let mut now = described(&told, &told.batch().observations);
    let mut ends = 0;
    for t in 0..60 {
        step(&mut told, t);
        let after = described(&told, &told.batch().observations);
        let last = described(&told, &told.batch().final_observations);
        for env in 0..ENVS {
            if told.batch().has_final[env] {
                ends += 1;
                assert_eq!(last[env], now[env], "step {t}, env {env}: the last observation of an episode");
                assert_ne!(after[env], now[env], "step {t}, env {env}: a new episode");
            } else {
                assert_eq!(after[env], now[env], "step {t}, env {env}: within an episode");
            }
            for (told, exact) in after[env].iter().zip(&exact[env]) {
                let bound = (ERROR + 1e-6) * exact.abs();
                assert!((told - exact).abs() <= bound, "step {t}, env {env}: {told} for {exact}");
            }
        }
        now = after;
    }
    assert!(ends >= 2 * ENVS, "{ends} episodes have ended");
    let ratios = now.iter().flatten().zip(exact.iter().flatten()).filter(|(_, exact)| **exact != 0.0);
    let ratios: Vec<f32> = ratios.map(|(told, exact)| told / exact - 1.0).collect();
    let mean = ratios.iter().sum::<f32>() / ratios.len() as f32;
    let most = ratios.iter().fold(0.0f32, |most, ratio| most.max(ratio.abs()));
    assert!(mean.abs() < 0.02 && most > 0.95 * ERROR, "mean {mean}, largest {most} of {}", ratios.len());
}

#[test]
fn errors_survive_a_snapshot_and_any_number_of_threads() {
    let (mut one, mut two) = (wrong(1), wrong(2));
    for t in 0..13 {
        step(&mut one, t);
        step(&mut two, t);
    }
    let saved = one.snapshot().unwrap();
    let mut restored = wrong(2);
    restored.restore(&saved).unwrap();
    for t in 13..40 {
        for sim in [&mut one, &mut two, &mut restored] {
            step(sim, t);
        }
        assert_eq!(one.batch().observations, two.batch().observations, "step {t}, threads");
        assert_eq!(one.batch().observations, restored.batch().observations, "step {t}, restored");
    }
}

#[test]
fn errors_are_refused_where_numbers_change() {
    let [positions, descriptors] =
        ["joint_pos_rel", "joint_descriptors"].map(|term| format!("observations.policy.{term}"));
    for (changes, term) in [
        (vec![format!("{positions}.error=0.1")], "joint_pos_rel"),
        (vec![format!("{descriptors}.error=0.1"), format!("{descriptors}.history_length=2")], "joint_descriptors"),
    ] {
        let options = SimOptions { overrides: changes, ..SimOptions::new("velocity_flat_any_legged", 24) };
        let text = Sim::new(&options).err().expect("it must be refused").to_string();
        assert!(text.contains(&format!("`{term}`")) && text.contains(".error"), "{text}");
    }
}
