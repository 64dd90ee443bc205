//! One, two or four threads: the same bits, at every step.

use polypod::{Sim, SimOptions};

use crate::common::{ROBOTS, assert_all_same, busy, ended, step};

#[test]
fn one_two_and_four_threads_give_the_same_bits() {
    // no multiple of anything: the last pack of each robot and the last chunk of rows are partly filled
    let options = busy(&ROBOTS, 203);
    let mut sims = [1, 2, 4].map(|threads| {
        let sim = Sim::new(&SimOptions { threads: Some(threads), ..options.clone() }).unwrap();
        assert_eq!(sim.threads(), threads);
        sim
    });
    let mut episodes = 0;
    for t in 0..200 {
        for sim in &mut sims {
            step(sim, t);
        }
        let [one, others @ ..] = &mut sims;
        for other in others {
            let threads = other.threads();
            assert_all_same(one, other, &format!("step {t}, {threads} threads"));
        }
        episodes += ended(one);
    }
    assert!(episodes > 203, "resets must have been part of it");
    let [one, two, four] = sims.map(|mut sim| sim.snapshot().unwrap());
    assert!(one == two && one == four, "state that the batches do not show differs");
}
