//! Every instruction set that this machine has gives the same bits.

use std::process::Output;

use polypod::dynamics::lanes::Simd;
use polypod::{Sim, SimOptions};

use crate::common::{ROBOTS, assert_all_same, busy, ended, sprung, step, turning};

#[test]
fn every_instruction_set_gives_the_same_bits() {
    // eleven envs per robot: one pack or several, and the last one is not full
    same_bits(&busy(&ROBOTS, 88));
    same_bits(&turning(busy(&["anymal_d", "unitree_go2"], 22)));
    same_bits(&sprung(busy(&["anymal_d", "unitree_go2"], 22)));
}

fn same_bits(options: &SimOptions) {
    let make = |simd| Sim::new(&SimOptions { simd: Some(simd), ..options.clone() }).unwrap();
    let mut reference = make(Simd::Portable);
    let missing = [Simd::Avx512, Simd::Avx2, Simd::Neon].map(|simd| (simd, Simd::available().contains(&simd)));
    for (simd, _) in missing.iter().filter(|(_, available)| !available) {
        println!("skipped: this machine has no {}", simd.name());
    }
    let mut others: Vec<Sim> = Simd::available().into_iter().filter(|&s| s != Simd::Portable).map(make).collect();
    let mut episodes = 0;
    for t in 0..100 {
        step(&mut reference, t);
        episodes += ended(&reference);
        for sim in &mut others {
            step(sim, t);
            let name = sim.simd().name();
            assert_all_same(&mut reference, sim, &format!("step {t}, {name}"));
        }
    }
    assert!(episodes >= options.num_envs, "resets must have been part of it");
    let snapshot = reference.snapshot().unwrap();
    for mut sim in others {
        assert!(
            sim.snapshot().unwrap() == snapshot,
            "{}: state that the batches do not show differs",
            sim.simd().name()
        );
    }
}

fn rollout(simd: &str) -> Output {
    let arguments = ["rollout", "--num-envs", "40", "--steps", "60", "--set", "sim.episode_length_s=0.5"];
    crate::polypod_sim(&arguments).env("POLYPOD_SIMD", simd).output().unwrap()
}

#[test]
fn the_environment_variable_chooses_the_instruction_set() {
    let mut tables = Vec::new();
    for simd in Simd::available() {
        let output = rollout(simd.name());
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let first = text.lines().next().unwrap();
        assert!(first.contains(&format!("threads, {},", simd.name())), "{first}");
        // the lines after the speed are statistics of the episodes
        tables
            .push(text.lines().skip_while(|line| !line.starts_with("finished")).map(String::from).collect::<Vec<_>>());
    }
    assert!(tables[0].len() > 8, "{tables:?}");
    assert!(tables.iter().all(|table| *table == tables[0]), "{tables:?}");

    let refused = rollout("sse9");
    let error = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(2), "{error}");
    assert!(error.contains("`sse9`") && error.contains("portable") && error.contains("POLYPOD_SIMD"), "{error}");
}
