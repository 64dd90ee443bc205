//! A training gives the same policy, to the bit, for any number of threads and workers and on every instruction set.

use std::sync::{Arc, Barrier, Mutex};

use polypod::dynamics::lanes::Simd;
use polypod::learner::{
    Activation, Algorithm, Learner, LearnerError, Network, Options, Peers, Symmetry, Which, Worker,
};
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

/// Two kinds of robots that are pushed over, so that episodes end early.
fn pushed(num_envs: usize) -> SimOptions {
    let mut options = busy(&["unitree_a1", "anymal_c"], num_envs);
    options.overrides.push("events.push_robot.velocity_range=[-8.0, 8.0]".into());
    options
}

/// A hash of all that a training has learnt.
fn trained(simd: Simd, threads: usize, symmetry: Symmetry) -> u64 {
    let envs = pushed(size(72, 520));
    let sim = Sim::new(&SimOptions { simd: Some(simd), threads: Some(threads), ..envs }).unwrap();
    let learner = sim.learner(options(symmetry)).unwrap();
    learnt(sim, learner, 1)
}

/// Hash of a learner after some iterations. With several workers, each has only seen its share of the episodes.
fn learnt(mut sim: Sim, mut learner: Learner, least_episodes: usize) -> u64 {
    fill(&mut learner);
    let (mut rate, mut episodes) = (1e-3, 0);
    for iteration in 0..ITERATIONS {
        episodes += sim.collect(&mut learner, iteration).unwrap().len();
        rate = sim.learn(&mut learner, rate).unwrap().learning_rate;
    }
    assert!(episodes >= least_episodes, "resets must have been part of it");
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

/// Workers that are threads of this test.
struct Threads {
    index: usize,
    barrier: Arc<Barrier>,
    sent: Arc<Mutex<Vec<Vec<u8>>>>,
}

impl Threads {
    fn send(&self, mine: &[u8]) -> Vec<Vec<u8>> {
        self.sent.lock().unwrap()[self.index] = mine.to_vec();
        self.barrier.wait();
        let all = self.sent.lock().unwrap().clone();
        self.barrier.wait();
        all
    }
}

impl Peers for Threads {
    fn gather(&self, mine: &[u8]) -> Result<Vec<u8>, LearnerError> {
        Ok(self.send(mine).concat())
    }
    fn exchange(&self, mine: &[u8]) -> Result<Vec<u8>, LearnerError> {
        let all = self.send(mine);
        let piece = mine.len() / all.len();
        Ok(all.iter().flat_map(|of| of[self.index * piece..(self.index + 1) * piece].to_vec()).collect())
    }
}

/// Hash of each of several workers' learners.
fn trained_by(count: usize, options: &Options) -> Vec<u64> {
    let (barrier, sent) = (Arc::new(Barrier::new(count)), Arc::new(Mutex::new(vec![Vec::new(); count])));
    let worker = |index: usize| {
        let (worker, envs) = (Worker { index, count }, pushed(ENVS_OF_WORKERS));
        let peers = Threads { index, barrier: barrier.clone(), sent: sent.clone() };
        let share = Some(worker.envs(ENVS_OF_WORKERS).unwrap());
        let sim = Sim::new(&SimOptions { share, ..envs }).unwrap();
        let learner = sim.learner_of_worker(options.clone(), worker, Box::new(peers)).unwrap();
        learnt(sim, learner, 0)
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..count).map(|index| scope.spawn(move || worker(index))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    })
}

/// Twelve parts of the learner: no power of two.
const ENVS_OF_WORKERS: usize = 197;

#[test]
fn workers_do_not_change_the_policy() {
    let one = |symmetry| Options { normalize_reward_per_robot: false, ..options(symmetry) };
    let mut per_mini_batch = one(Symmetry::None);
    per_mini_batch.algorithm.normalize_advantage_per_mini_batch = true;
    per_mini_batch.normalize_advantage_per_robot = false;
    for options in [options(Symmetry::Both), per_mini_batch] {
        let sim = Sim::new(&pushed(ENVS_OF_WORKERS)).unwrap();
        let learner = sim.learner(options.clone()).unwrap();
        let expected = learnt(sim, learner, 1);
        for count in [2, 3, 4] {
            assert_eq!(trained_by(count, &options), vec![expected; count], "{count} workers");
        }
    }
}

#[test]
fn workers_that_do_not_fit_the_envs_are_refused() {
    let whole = Sim::new(&busy(&["spot"], 48)).unwrap();
    let refused = |sim: &Sim, worker: Worker| {
        let peers = Threads { index: 0, barrier: Arc::new(Barrier::new(1)), sent: Arc::default() };
        match sim.learner_of_worker(options(Symmetry::None), worker, Box::new(peers)) {
            Ok(_) => panic!("{worker:?} is accepted"),
            Err(error) => error.to_string(),
        }
    };
    assert!(refused(&whole, Worker { index: 0, count: 4 }).contains("use at most 3"));
    assert!(refused(&whole, Worker { index: 0, count: 2 }).contains("envs 0 to 16"));
    let half = Sim::new(&SimOptions { share: Some(16..48), ..busy(&["spot"], 48) }).unwrap();
    assert!(half.learner(options(Symmetry::None)).is_err_and(|error| error.to_string().contains("share")));
}

#[test]
fn mirror_images_change_the_policy() {
    let [none, both, alternate] = [Symmetry::None, Symmetry::Both, Symmetry::Alternate]
        .map(|symmetry| trained(Simd::available()[0], 2, symmetry));
    assert!(none != both && none != alternate && both != alternate);
}

/// Hash of this file's training on any machine. A change of it changes every policy that is trained from now on.
#[test]
fn the_policy_is_the_one_that_it_was() {
    if size(true, false) {
        assert_eq!(format!("{:016x}", trained(Simd::available()[0], 1, Symmetry::None)), "2c112ab2f5692757");
    }
}
