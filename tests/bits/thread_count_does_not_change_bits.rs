//! One, two or four threads: the same bits, at every step.

use polypod::{Sim, SimOptions};

use crate::common::{ROBOTS, assert_all_same, busy, ended, step, turning};

#[test]
fn one_two_and_four_threads_give_the_same_bits() {
    // no multiple of anything: the last pack of each robot and the last chunk of rows are partly
    // filled
    same_bits(&busy(&ROBOTS, 203), 200);
}

#[test]
fn so_they_do_on_ground_that_resists_turning() {
    same_bits(&turning(busy(&["anymal_d", "spot", "unitree_go2"], 83)), 130);
}

fn same_bits(options: &SimOptions, steps: usize) {
    let mut sims = [1, 2, 4].map(|threads| {
        let sim = Sim::new(&SimOptions { threads: Some(threads), ..options.clone() }).unwrap();
        assert_eq!(sim.threads(), threads);
        sim
    });
    let mut episodes = 0;
    for t in 0..steps {
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
    assert!(episodes > options.num_envs, "resets must have been part of it");
    let [one, two, four] = sims.map(|mut sim| sim.snapshot().unwrap());
    assert!(one == two && one == four, "state that the batches do not show differs");
}
