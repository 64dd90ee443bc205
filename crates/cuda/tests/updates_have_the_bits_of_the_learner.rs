//! The update that the text of the device computes, compiled for the host, has the bits of the
//! native learner on the CPU: losses, weights, Adam's moments, statistics and actions of whole
//! trainings.

use polypod::{Sim, SimOptions};
use polypod_cuda::update::Update;
use polypod_cuda_host::UpdateHost;
use polypod_dynamics::lanes::Simd;
use polypod_learner::{
    Activation, Algorithm, Learner, Losses, Network, NetworkName, NetworkState, Options, Robot, Settings, Symmetry,
    Team,
};

/// One thread.
struct Alone;

impl Team for Alone {
    fn for_each<T: Send>(&self, tasks: Vec<T>, f: impl Fn(T) + Sync) {
        tasks.into_iter().for_each(f);
    }
}

/// Numbers from -1 to 1.
struct Random(u32);

impl Random {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (self.0 >> 8) as f32 / 8_388_608.0 - 1.0
    }

    fn many(&mut self, count: usize, scale: f32) -> Vec<f32> {
        (0..count).map(|_| scale * self.next()).collect()
    }
}

fn network(hidden_dims: &[usize], activation: Activation) -> Network {
    Network {
        hidden_dims: hidden_dims.to_vec(),
        activation,
        obs_normalization: true,
        columns: Vec::new(),
        joints: None,
    }
}

/// A training of four robots' blocks of envs with the options of `flat`, on a small scale.
fn settings(envs: &[usize], num_obs: usize, num_actions: usize) -> Settings {
    let robot = |(k, _): (usize, &usize)| Robot {
        envs: (envs[..k].iter().sum(), envs[..=k].iter().sum()),
        observation_mirror: mirror(num_obs),
        action_mirror: mirror(num_actions),
        observation_mask: Vec::new(),
        action_mask: Vec::new(),
    };
    Settings {
        num_envs: envs.iter().sum(),
        num_obs,
        num_actions,
        seed: 7,
        robots: envs.iter().enumerate().map(robot).collect(),
        options: Options {
            num_steps_per_env: 6,
            actor: network(&[32, 24], Activation::Elu),
            critic: network(&[32, 24], Activation::Elu),
            algorithm: Algorithm {
                num_learning_epochs: 3,
                num_mini_batches: 4,
                clip_param: 0.2,
                gamma: 0.99,
                lam: 0.95,
                value_loss_coef: 1.0,
                entropy_coef: 0.005,
                max_grad_norm: 1.0,
                use_clipped_value_loss: true,
                desired_kl: Some(0.01),
                normalize_advantage_per_mini_batch: false,
                mirror_loss_coef: 0.0,
            },
            normalize_reward_per_robot: true,
            normalize_advantage_per_robot: false,
            symmetry: Symmetry::None,
        },
    }
}

/// Neighbours change places, and every third number its sign.
fn mirror(count: usize) -> Vec<(usize, f32)> {
    (0..count).map(|i| (if (i ^ 1) < count { i ^ 1 } else { i }, if i % 3 == 0 { -1.0 } else { 1.0 })).collect()
}

/// Settings of a training, with their name.
fn cases() -> Vec<(&'static str, Settings)> {
    let mut all = Vec::new();
    let mut case = |name, envs: &[usize], [num_obs, num_actions]: [usize; 2], change: &dyn Fn(&mut Settings)| {
        let mut settings = settings(envs, num_obs, num_actions);
        change(&mut settings);
        all.push((name, settings));
    };
    case("a quadruped", &[40], [48, 12], &|_| {});
    case("hidden layers of other sizes, and none that is a multiple of a line", &[37], [69, 29], &|of| {
        of.options.actor = network(&[72, 41, 19], Activation::Elu);
        of.options.critic = network(&[131], Activation::Tanh);
    });
    case("images next to the samples", &[33], [45, 12], &|of| of.options.symmetry = Symmetry::Both);
    case("images and samples in turn", &[35], [45, 12], &|of| of.options.symmetry = Symmetry::Alternate);
    for symmetry in [Symmetry::Both, Symmetry::Alternate] {
        case("images that the mirror loss pulls", &[34], [45, 13], &|of| {
            of.options.symmetry = symmetry;
            of.options.algorithm.mirror_loss_coef = 4.0;
        });
    }
    for activation in [Activation::Relu, Activation::Tanh] {
        case("another activation", &[20], [24, 8], &|of| {
            of.options.actor.activation = activation;
            of.options.critic.activation = activation;
        });
    }
    case("robots that lack actions and numbers, and one without envs", &[19, 0, 31, 7], [50, 18], &|of| {
        for (k, robot) in of.robots.iter_mut().enumerate() {
            robot.action_mask = (0..18).map(|i| i % (k + 2) != 0).collect();
            robot.observation_mask = (0..50).map(|i| i % (k + 3) != 0).collect();
        }
        of.options.symmetry = Symmetry::Alternate;
        of.options.algorithm.mirror_loss_coef = 0.7;
        of.options.normalize_advantage_per_robot = true;
    });
    case("networks that read some columns", &[40], [60, 12], &|of| {
        of.options.actor.columns = (0..60).filter(|i| i % 4 != 1).collect();
        of.options.critic.columns = (0..60).rev().collect();
        of.options.symmetry = Symmetry::Both;
    });
    case("one mini-batch", &[48], [30, 6], &|of| of.options.algorithm.num_mini_batches = 1);
    case("seven mini-batches with scales of their own", &[50], [30, 6], &|of| {
        of.options.algorithm.num_mini_batches = 7;
        of.options.algorithm.normalize_advantage_per_mini_batch = true;
        of.options.normalize_reward_per_robot = false;
    });
    case("neither clipped values nor an adaptive rate nor statistics", &[21], [30, 6], &|of| {
        of.options.algorithm.use_clipped_value_loss = false;
        of.options.algorithm.desired_kl = None;
        of.options.algorithm.value_loss_coef = 0.5;
        of.options.actor.obs_normalization = false;
        of.options.critic.obs_normalization = false;
    });
    case("32 parts, of which some have no sample in a mini-batch", &[301, 219], [17, 5], &|of| {
        of.options.num_steps_per_env = 1;
        of.options.algorithm.num_mini_batches = 21;
    });
    case("one env", &[1], [10, 1], &|of| of.options.num_steps_per_env = 9);
    all
}

/// Weights as of a network that has begun to learn.
fn begin(learner: &mut Learner) {
    let mut random = Random(3);
    for name in [NetworkName::Actor, NetworkName::Critic] {
        let mut state = learner.network(name);
        for (k, weights) in state.weights.iter_mut().enumerate() {
            let deviations = k == 0 && name == NetworkName::Actor;
            weights
                .iter_mut()
                .for_each(|x| *x = if deviations { 0.7 + 0.2 * random.next() } else { 0.3 * random.next() });
        }
        learner.set_network(name, &state).unwrap();
    }
}

/// Collects the samples of an iteration in an invented world, whose rewards depend on the actions;
/// returns all actions.
fn collect(learner: &mut Learner, iteration: u64) -> Vec<f32> {
    let Settings { num_envs, num_obs, num_actions, options, robots, .. } = learner.settings().clone();
    let mut random = Random(100 + iteration as u32);
    let mut observations = |actions: &[f32]| {
        let mut numbers = random.many(num_envs * num_obs, 2.0);
        for (k, x) in numbers.iter_mut().enumerate() {
            *x += 0.5 * actions[k % actions.len()];
        }
        for robot in &robots {
            for env in robot.envs.0..robot.envs.1 {
                for (i, has) in robot.observation_mask.iter().enumerate() {
                    numbers[env * num_obs + i] *= f32::from(u8::from(*has));
                }
            }
        }
        numbers
    };
    let (mut actions, mut all) = (vec![0.0; num_envs * num_actions], Vec::new());
    learner.begin(iteration);
    let mut now = observations(&actions);
    for step in 0..options.num_steps_per_env {
        learner.act(&Alone, &now, &mut actions);
        all.extend_from_slice(&actions);
        let reward = |env: usize| actions[env * num_actions] - 0.3 * now[env * num_obs] * actions[env * num_actions];
        let rewards: Vec<f32> = (0..num_envs).map(reward).collect();
        let terminated: Vec<bool> = (0..num_envs).map(|env| (env + 3 * step) % 11 == 0).collect();
        let truncated: Vec<bool> = (0..num_envs).map(|env| (env + 5 * step) % 13 == 0).collect();
        learner.record(&rewards, &terminated, &truncated, &mut Vec::new());
        now = observations(&actions);
    }
    learner.finish_rollout(&Alone, &now).unwrap();
    all
}

/// Bits of all numbers that a training has made so far, with the names of their lists.
fn bits(learner: &Learner, losses: &Losses, actions: &[f32]) -> Vec<(String, Vec<u64>)> {
    let of = |numbers: &[f32]| -> Vec<u64> { numbers.iter().map(|x| u64::from(x.to_bits())).collect() };
    let Losses { value, surrogate, entropy, learning_rate } = losses;
    let mut all = vec![
        ("actions".to_owned(), of(actions)),
        ("losses".to_owned(), [value, surrogate, entropy, learning_rate].map(|x| x.to_bits()).to_vec()),
        ("deviations".to_owned(), of(&learner.deviations())),
    ];
    for name in [NetworkName::Actor, NetworkName::Critic] {
        let NetworkState { weights, first, second, steps } = learner.network(name);
        all.push((format!("{name:?}: steps"), vec![steps]));
        for (element, arrays) in [("weights", weights), ("first", first), ("second", second)] {
            for (k, array) in arrays.iter().enumerate() {
                all.push((format!("{name:?}: {element} {k}"), of(array)));
            }
        }
        for normalizer in learner.normalizers(name) {
            all.push((format!("{name:?}: means"), of(&normalizer.mean)));
            all.push((format!("{name:?}: variances"), of(&normalizer.variance)));
        }
    }
    all
}

/// Trains for some iterations on each side and compares them after each; returns the reason why the
/// device was given up, if it was.
fn compare(name: &str, settings: &Settings, device: UpdateHost, iterations: u64) -> Option<String> {
    let simd = Simd::available()[0];
    let [mut on_cpu, mut on_device] = [(); 2].map(|()| Learner::new(settings.clone(), simd).unwrap());
    on_device.use_device(Box::new(Update::new(device))).unwrap();
    [&mut on_cpu, &mut on_device].into_iter().for_each(begin);
    let (mut rates, mut failure) = ([1e-3; 2], None);
    for iteration in 0..iterations {
        let [expected, found] = [(&mut on_cpu, 0), (&mut on_device, 1)].map(|(learner, side)| {
            let actions = collect(learner, iteration);
            let losses = learner.update(&Alone, rates[side]).unwrap();
            rates[side] = losses.learning_rate;
            bits(learner, &losses, &actions)
        });
        for ((list, expected), (_, found)) in expected.iter().zip(&found) {
            let differs = expected.iter().zip(found).filter(|(a, b)| a != b).count();
            assert_eq!(
                differs,
                0,
                "{name}: {list}: {differs} of {} numbers differ in iteration {iteration}",
                found.len()
            );
        }
        assert_eq!(expected, found, "{name}");
        failure = failure.or(on_device.take_device_failure().map(|failure| failure.0));
    }
    failure
}

#[test]
fn whole_trainings_have_the_bits_of_the_cpu() {
    for (name, settings) in cases() {
        assert_eq!(compare(name, &settings, UpdateHost::default(), 3), None, "{name}");
    }
}

/// Trains in a simulation; returns the bits of all that is learnt.
fn trained(options: &SimOptions, symmetry: Symmetry, device: Option<UpdateHost>) -> Vec<(String, Vec<u64>)> {
    let mut sim = Sim::new(options).unwrap();
    let of_learner = Options { symmetry, ..settings(&[1], 1, 1).options };
    let mut learner = sim.learner(of_learner).unwrap();
    if let Some(device) = device {
        learner.use_device(Box::new(Update::new(device))).unwrap();
    }
    begin(&mut learner);
    let mut losses = Losses { learning_rate: 1e-3, ..Losses::default() };
    for iteration in 0..3 {
        sim.collect(&mut learner, iteration, None).unwrap();
        losses = sim.learn(&mut learner, losses.learning_rate).unwrap();
    }
    assert!(learner.take_device_failure().is_none());
    bits(&learner, &losses, &[])
}

#[test]
fn trainings_of_robots_give_the_same_policy() {
    for (task, symmetry) in [
        ("velocity_flat", Symmetry::Alternate),
        ("velocity_flat_legged", Symmetry::Both),
        ("velocity_flat_humanoid", Symmetry::None),
    ] {
        let options = SimOptions::new(task, 56);
        let expected = trained(&options, symmetry, None);
        assert!(trained(&options, symmetry, Some(UpdateHost::default())) == expected, "{task}");
    }
}

#[test]
fn threads_that_meet_where_they_must_have_the_bits_of_the_cpu() {
    for (name, settings) in cases() {
        if settings.num_envs < 60 {
            assert_eq!(compare(name, &settings, UpdateHost::by_threads(), 1), None, "{name}");
        }
    }
}

#[test]
fn an_update_whose_device_is_lost_is_made_again_with_the_same_bits() {
    let settings = settings(&[40], 48, 12);
    for launches in [0, 1, 100, 400] {
        let failure = compare("lost", &settings, UpdateHost::lost_after(launches), 3);
        assert_eq!(failure.as_deref(), Some("launch: the device is lost"), "after {launches} launches");
    }
}
