//! Every instruction set that this machine has gives the same bits.

mod common;

use common::{ROBOTS, assert_all_same, busy, ended, step};
use polypod::dynamics::Simd;
use polypod::{Sim, SimOptions};

#[test]
fn every_instruction_set_gives_the_same_bits() {
    // eleven envs per robot: one pack or several, and the last one is not full
    let options = busy(&ROBOTS, 88);
    let make = |simd| Sim::new(&SimOptions { simd: Some(simd), ..options.clone() }).unwrap();
    let mut reference = make(Simd::Portable);
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
    assert!(episodes >= 88, "resets must have been part of it");
    let snapshot = reference.snapshot().unwrap();
    for mut sim in others {
        assert!(
            sim.snapshot().unwrap() == snapshot,
            "{}: state that the batches do not show differs",
            sim.simd().name()
        );
    }
}
