//! A training gives the same policy, to the bit, for any number of threads and workers and on every
//! instruction set.

use std::sync::{Arc, Barrier, Mutex};

use polypod::dynamics::lanes::Simd;
use polypod::learner::{
    Activation, Algorithm, Joints, Learner, LearnerError, Network, NetworkName, Options, Peers, RolloutArrays,
    Symmetry, Worker,
};
use polypod::{Sim, SimOptions};

use crate::common::{busy, noise, size};

const ITERATIONS: u64 = 3;

fn options(symmetry: Symmetry) -> Options {
    let network = |activation, hidden_dims| Network {
        hidden_dims,
        activation,
        obs_normalization: true,
        columns: Vec::new(),
        joints: None,
    };
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
            mirror_loss_coef: 0.3,
        },
        normalize_reward_per_robot: true,
        normalize_advantage_per_robot: true,
        symmetry,
    }
}

/// Networks of joints that read the task `velocity_flat_joints` with `slots` slots.
fn options_of_joints(slots: usize, symmetry: Symmetry) -> Options {
    let columns = |number: usize| -> Vec<usize> { (0..slots).map(|slot| 12 + number * slots + slot).collect() };
    let joints = |joint_dim, num_heads| Joints {
        joint_dim,
        num_heads,
        states: (0..3).map(columns).collect(),
        scales: vec![1.0, 0.1, 0.5],
        descriptions: (3..22).map(columns).collect(),
        general: (0..12).collect(),
        leg_heads: None,
        legs: Vec::new(),
    };
    let mut options = options(symmetry);
    (options.actor.joints, options.critic.joints) = (Some(joints(20, 9)), Some(joints(8, 3)));
    options
}

/// Small numbers that depend on their places alone; deviations of one half.
fn fill(learner: &mut Learner) {
    for network in [NetworkName::Actor, NetworkName::Critic] {
        let mut state = learner.network(network);
        for (layer, weights) in state.weights.iter_mut().enumerate() {
            weights.iter_mut().enumerate().for_each(|(i, x)| *x = 0.2 * noise(layer as u64, i, 0, 0));
        }
        if network == NetworkName::Actor && learner.settings().options.actor.joints.is_none() {
            state.weights[0].fill(0.5);
        }
        learner.set_network(network, &state).unwrap();
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

/// Trains networks of joints for bodies with different joints.
fn joints_trained(simd: Simd, threads: usize, symmetry: Symmetry) -> u64 {
    let sim = Sim::new(&SimOptions { simd: Some(simd), threads: Some(threads), ..of_joints(72) }).unwrap();
    let learner = sim.learner(options_of_joints(sim.batch().num_actions, symmetry)).unwrap();
    learnt(sim, learner, 1)
}

/// Bodies with different joints, and with gains that differ from env to env.
fn of_joints(num_envs: usize) -> SimOptions {
    let mut options = busy(&["unitree_a1", "tests/data/bodies/configs/robots/small_biped.toml", "spot"], num_envs);
    options.task = "velocity_flat_joints".into();
    let more = ["events.push_robot.velocity_range=[-8.0, 8.0]", "events.randomize_actuator_gains.enabled=true"];
    options.overrides.extend(more.map(String::from));
    options
}

/// Hash of a learner after some iterations. With several workers, each has only seen its share of
/// the episodes.
fn learnt(mut sim: Sim, mut learner: Learner, least_episodes: usize) -> u64 {
    fill(&mut learner);
    let (mut rate, mut episodes) = (1e-3, 0);
    for iteration in 0..ITERATIONS {
        episodes += sim.collect(&mut learner, iteration, None).unwrap().len();
        rate = sim.learn(&mut learner, rate).unwrap().learning_rate;
    }
    assert!(episodes >= least_episodes, "resets must have been part of it");
    let mut numbers = Vec::new();
    for network in [NetworkName::Actor, NetworkName::Critic] {
        let state = learner.network(network);
        numbers.extend([state.weights, state.first, state.second].concat().concat());
        learner.normalizers(network).iter().for_each(|of| numbers.extend(&of.variance));
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
fn threads_and_instruction_sets_do_not_change_a_policy_of_joints() {
    for symmetry in [Symmetry::Alternate, Symmetry::Both] {
        let expected = joints_trained(Simd::available()[0], 1, symmetry);
        for simd in Simd::available() {
            assert_eq!(joints_trained(simd, 2, symmetry), expected, "{}, 2 threads", simd.name());
        }
        assert_eq!(joints_trained(Simd::available()[0], 3, symmetry), expected, "3 threads");
    }
}

/// The means of the first actions of the envs of a robot that has 16 envs, in a batch that holds
/// `others` too.
fn first_means(others: &[&str]) -> Vec<u32> {
    let robots: Vec<&str> = ["unitree_a1"].iter().chain(others).copied().collect();
    let mut options = SimOptions { robots: Some(robots.iter().map(|name| name.to_string()).collect()), ..of_joints(0) };
    options.num_envs = 10 * robots.len();
    let mut sim = Sim::new(&options).unwrap();
    let learner_options = options_of_joints(sim.batch().num_actions, Symmetry::None);
    let (slots, width) = (sim.batch().num_actions, sim.batch().num_obs);
    let mut learner = sim.learner(learner_options).unwrap();
    fill(&mut learner);
    sim.collect(&mut learner, 0, None).unwrap();
    let samples = learner.num_own_samples();
    let zeros = |numbers: usize| vec![0.0; samples * numbers];
    let (mut observations, mut actions, mut means) = (zeros(width), zeros(slots), zeros(slots));
    let [mut rewards, mut log_probs, mut values, mut returns, mut advantages] = [0; 5].map(|_| zeros(1));
    let (mut ends, mut places) = (vec![0; samples], vec![0; samples]);
    let arrays = RolloutArrays {
        observations: &mut observations,
        actions: &mut actions,
        means: &mut means,
        rewards: &mut rewards,
        ends: &mut ends,
        log_probs: &mut log_probs,
        values: &mut values,
        returns: &mut returns,
        advantages: &mut advantages,
        places: &mut places,
    };
    sim.write_rollout(&learner, arrays).unwrap();
    assert!(means[..10 * slots].iter().all(|x| *x != 0.0), "all of them have all slots");
    means[..10 * slots].iter().map(|x| x.to_bits()).collect()
}

#[test]
fn a_policy_of_joints_acts_in_company_as_it_does_alone() {
    assert_eq!(first_means(&["spot"]), first_means(&[]));
    assert_eq!(first_means(&["anymal_c", "unitree_go2"]), first_means(&[]));
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
fn trained_by(count: usize, options: &Options, envs: &SimOptions) -> Vec<u64> {
    let (barrier, sent) = (Arc::new(Barrier::new(count)), Arc::new(Mutex::new(vec![Vec::new(); count])));
    let worker = |index: usize| {
        let worker = Worker { index, count };
        let peers = Threads { index, barrier: barrier.clone(), sent: sent.clone() };
        let share = Some(worker.envs(envs.num_envs).unwrap());
        let sim = Sim::new(&SimOptions { share, ..envs.clone() }).unwrap();
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
        let envs = pushed(ENVS_OF_WORKERS);
        let sim = Sim::new(&envs).unwrap();
        let learner = sim.learner(options.clone()).unwrap();
        let expected = learnt(sim, learner, 1);
        for count in [2, 3, 4] {
            assert_eq!(trained_by(count, &options, &envs), vec![expected; count], "{count} workers");
        }
    }
}

#[test]
fn workers_do_not_change_a_policy_of_joints() {
    let envs = of_joints(72);
    let sim = Sim::new(&envs).unwrap();
    let options = options_of_joints(sim.batch().num_actions, Symmetry::Alternate);
    let learner = sim.learner(options.clone()).unwrap();
    let expected = learnt(sim, learner, 1);
    assert_eq!(trained_by(3, &options, &envs), vec![expected; 3]);
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
fn an_instruction_set_that_the_machine_lacks_is_refused() {
    let sim = Sim::new(&busy(&["spot"], 48)).unwrap();
    let settings = sim.learner(options(Symmetry::None)).unwrap().settings().clone();
    let foreign = if cfg!(target_arch = "aarch64") { Simd::Avx2 } else { Simd::Neon };
    let refused = Learner::new(settings, foreign).err().unwrap().to_string();
    assert!(refused.contains("simd") && refused.contains(foreign.name()), "{refused}");
}

#[test]
fn mirror_images_change_the_policy() {
    let [none, both, alternate] = [Symmetry::None, Symmetry::Both, Symmetry::Alternate]
        .map(|symmetry| trained(Simd::available()[0], 2, symmetry));
    assert!(none != both && none != alternate && both != alternate);
}

/// Hash of this file's training on any machine. A change of it changes every policy that is trained
/// from now on.
#[test]
fn the_policy_is_the_one_that_it_was() {
    if size(true, false) {
        assert_eq!(format!("{:016x}", trained(Simd::available()[0], 1, Symmetry::None)), "2c112ab2f5692757");
    }
}
