//! A training gives the same policy, to the bit, for any number of threads and on every instruction set.

use polypod::dynamics::lanes::Simd;
use polypod::learner::{Activation, Algorithm, Learner, Network, Options, Symmetry, Which};
use polypod::{Sim, SimOptions};

use crate::common::{busy, noise, size};

const ITERATIONS: u64 = 3;

fn options(symmetry: Symmetry) -> Options {
    let network = |activation, hidden_dims| Network { hidden_dims, activation, obs_normalization: true };
    Options {
        num_steps_per_env: 12,
        // sizes that fill no line, so that the rest of each is met
        actor: network(Activation::Elu, vec![33, 20]),
        critic: network(Activation::Tanh, vec![17]),
        algorithm: Algorithm {
            num_learning_epochs: 2,
            num_mini_batches: 3,
            clip_param: 0.2,
            gamma: 0.99,
            lam: 0.95,
            value_loss_coef: 1.0,
            entropy_coef: 0.01,
            max_grad_norm: 1.0,
            use_clipped_value_loss: true,
            desired_kl: Some(0.01),
            normalize_advantage_per_mini_batch: false,
        },
        normalize_reward_per_robot: true,
        normalize_advantage_per_robot: true,
        symmetry,
    }
}

/// Small numbers that depend on their places alone; deviations of one half.
fn fill(learner: &mut Learner) {
    for which in [Which::Actor, Which::Critic] {
        let mut state = learner.network(which);
        for (layer, weights) in state.weights.iter_mut().enumerate() {
            weights.iter_mut().enumerate().for_each(|(i, x)| *x = 0.2 * noise(layer as u64, i, 0, 0));
        }
        if which == Which::Actor {
            state.weights[0].fill(0.5);
        }
        learner.set_network(which, &state).unwrap();
    }
}

/// A hash of all that a training has learnt.
fn trained(simd: Simd, threads: usize, symmetry: Symmetry) -> u64 {
    let envs = busy(&["unitree_a1", "anymal_c"], size(72, 520));
    let mut sim = Sim::new(&SimOptions { simd: Some(simd), threads: Some(threads), ..envs }).unwrap();
    let mut learner = sim.learner(options(symmetry)).unwrap();
    fill(&mut learner);
    let (mut rate, mut episodes) = (1e-3, 0);
    for iteration in 0..ITERATIONS {
        episodes += sim.collect(&mut learner, iteration).unwrap().len();
        rate = sim.learn(&mut learner, rate).unwrap().learning_rate;
    }
    assert!(episodes > 0, "resets must have been part of it");
    let mut numbers = Vec::new();
    for which in [Which::Actor, Which::Critic] {
        let state = learner.network(which);
        numbers.extend([state.weights, state.first, state.second].concat().concat());
        numbers.extend(&learner.normalizer(which).unwrap().variance);
    }
    numbers.iter().fold(rate.to_bits(), |hash, x| (hash ^ u64::from(x.to_bits())).wrapping_mul(0x0000_0100_0000_01b3))
}

#[test]
fn threads_and_instruction_sets_do_not_change_the_policy() {
    for symmetry in [Symmetry::None, Symmetry::Both, Symmetry::Alternate] {
        let expected = trained(Simd::available()[0], 1, symmetry);
        for simd in Simd::available() {
            for threads in [1, 2, 4] {
                assert_eq!(trained(simd, threads, symmetry), expected, "{}, {threads} threads", simd.name());
            }
        }
    }
}

#[test]
fn mirror_images_change_the_policy() {
    let [none, both, alternate] = [Symmetry::None, Symmetry::Both, Symmetry::Alternate]
        .map(|symmetry| trained(Simd::available()[0], 2, symmetry));
    assert!(none != both && none != alternate && both != alternate);
}

/// What the training of this file learns on any machine. Whoever changes it changes every policy that is trained from now on.
#[test]
fn the_policy_is_the_one_that_it_was() {
    if size(true, false) {
        assert_eq!(format!("{:016x}", trained(Simd::available()[0], 1, Symmetry::None)), "1e97d95e16668405");
    }
}
