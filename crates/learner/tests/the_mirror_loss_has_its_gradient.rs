//! The gradient of the mirror loss is the derivative of its formula, by central differences.

use polypod_lanes::Simd;
use polypod_learner::{Activation, Algorithm, Learner, Network, NetworkName, Options, Robot, Settings, Symmetry, Team};

const ENVS: usize = 20;
const STEPS: usize = 4;
const OBS: usize = 6;
const ACTIONS: usize = 5;
const COEF: f32 = 3.0;
/// Robots: the first env, the end of the envs, and which actions there are.
const ROBOTS: [((usize, usize), [bool; ACTIONS]); 2] =
    [((0, 8), [true; ACTIONS]), ((8, ENVS), [true, true, false, false, true])];

/// One thread.
struct Alone;

impl Team for Alone {
    fn for_each<T: Send>(&self, tasks: Vec<T>, f: impl Fn(T) + Sync) {
        tasks.into_iter().for_each(f);
    }
}

/// Neighbours change places, and every third number its sign.
fn mirror(count: usize) -> Vec<(usize, f32)> {
    (0..count).map(|i| (if (i ^ 1) < count { i ^ 1 } else { i }, if i % 3 == 0 { -1.0 } else { 1.0 })).collect()
}

/// A linear policy without hidden layers, and one step of the optimiser.
fn settings(symmetry: Symmetry, mirror_loss_coef: f32) -> Settings {
    let linear = Network {
        hidden_dims: Vec::new(),
        activation: Activation::Elu,
        obs_normalization: false,
        columns: Vec::new(),
        joints: None,
    };
    let robot = |(envs, mask): ((usize, usize), [bool; ACTIONS])| Robot {
        envs,
        observation_mirror: mirror(OBS),
        action_mirror: mirror(ACTIONS),
        observation_mask: Vec::new(),
        action_mask: mask.to_vec(),
    };
    Settings {
        num_envs: ENVS,
        num_obs: OBS,
        num_actions: ACTIONS,
        seed: 5,
        robots: ROBOTS.map(robot).to_vec(),
        options: Options {
            num_steps_per_env: STEPS,
            actor: linear.clone(),
            critic: linear,
            algorithm: Algorithm {
                num_learning_epochs: 1,
                num_mini_batches: 1,
                clip_param: 0.2,
                gamma: 0.99,
                lam: 0.95,
                value_loss_coef: 1.0,
                entropy_coef: 0.01,
                max_grad_norm: 1e30,
                use_clipped_value_loss: true,
                desired_kl: None,
                normalize_advantage_per_mini_batch: false,
                mirror_loss_coef,
            },
            normalize_reward_per_robot: false,
            normalize_advantage_per_robot: false,
            symmetry,
        },
    }
}

/// An invented number from -1 to 1.
fn number(i: usize) -> f32 {
    (i as f32 * 12.9898).sin()
}

fn observation(step: usize, env: usize) -> Vec<f32> {
    (0..OBS).map(|i| number(1 + i + OBS * (env + ENVS * step))).collect()
}

/// Weights and bias, `[outputs, inputs]` and `[outputs]`.
fn policy() -> Vec<f32> {
    (0..ACTIONS * (OBS + 1)).map(|i| 0.5 * number(7 * i + 3)).collect()
}

/// Derivatives of the whole loss after one update.
fn gradient(symmetry: Symmetry, coef: f32) -> Vec<f64> {
    let mut learner = Learner::new(settings(symmetry, coef), Simd::available()[0]).unwrap();
    let mut state = learner.network(NetworkName::Actor);
    let (weights, bias) = (policy()[..ACTIONS * OBS].to_vec(), policy()[ACTIONS * OBS..].to_vec());
    state.weights = vec![vec![0.6; ACTIONS], weights, bias];
    learner.set_network(NetworkName::Actor, &state).unwrap();
    learner.begin(0);
    let all = |step| -> Vec<f32> { (0..ENVS).flat_map(|env| observation(step, env)).collect() };
    let mut actions = vec![0.0; ENVS * ACTIONS];
    for step in 0..STEPS {
        learner.act(&Alone, &all(step), &mut actions);
        let rewards: Vec<f32> = (0..ENVS).map(|env| actions[env * ACTIONS]).collect();
        learner.record(&rewards, &[false; ENVS], &[false; ENVS], &mut Vec::new());
    }
    learner.finish_rollout(&Alone, &all(STEPS)).unwrap();
    learner.update(&Alone, 1e-3).unwrap();
    // Adam's first mean is a tenth of the gradient
    learner.network(NetworkName::Actor).first[1..].concat().iter().map(|&x| 10.0 * f64::from(x)).collect()
}

/// Mean of a linear policy.
fn mean(policy: &[f64], observation: &[f64]) -> Vec<f64> {
    (0..ACTIONS)
        .map(|j| {
            let products = policy[j * OBS..][..OBS].iter().zip(observation).map(|(w, x)| w * x);
            products.sum::<f64>() + policy[ACTIONS * OBS + j]
        })
        .collect()
}

fn mirrored(numbers: &[f64]) -> Vec<f64> {
    mirror(numbers.len()).into_iter().map(|(index, sign)| numbers[index] * f64::from(sign)).collect()
}

/// The mirror loss of a policy, whose samples an older one collected.
fn mirror_loss(symmetry: Symmetry, policy: &[f64], old: &[f64]) -> f64 {
    let mut sum = 0.0;
    for sample in 0..STEPS * ENVS {
        // in the first epoch the samples with an odd number are images
        if symmetry == Symmetry::Alternate && sample % 2 == 0 {
            continue;
        }
        let (step, env) = (sample / ENVS, sample % ENVS);
        let (_, mask) = ROBOTS[usize::from(env >= ROBOTS[1].0.0)];
        let observation: Vec<f64> = observation(step, env).into_iter().map(f64::from).collect();
        let (found, target) = (mean(policy, &mirrored(&observation)), mirrored(&mean(old, &observation)));
        let squares = (0..ACTIONS).filter(|&j| mask[j]).map(|j| (found[j] - target[j]).powi(2));
        sum += squares.sum::<f64>() / mask.iter().filter(|has| **has).count() as f64;
    }
    let images = if symmetry == Symmetry::Alternate { STEPS * ENVS / 2 } else { STEPS * ENVS };
    f64::from(COEF) * sum / images as f64
}

#[test]
fn the_gradient_of_the_mirror_loss_is_the_derivative_of_its_formula() {
    const STEP: f64 = 1e-3;
    let old: Vec<f64> = policy().into_iter().map(f64::from).collect();
    for symmetry in [Symmetry::Both, Symmetry::Alternate] {
        let [with, without] = [COEF, 0.0].map(|coef| gradient(symmetry, coef));
        let derivative = |i: usize| {
            let [above, below] = [STEP, -STEP].map(|change| {
                let mut policy = old.clone();
                policy[i] += change;
                mirror_loss(symmetry, &policy, &old)
            });
            (above - below) / (2.0 * STEP)
        };
        let expected: Vec<f64> = (0..old.len()).map(derivative).collect();
        let largest = expected.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
        assert!(largest > 0.1, "{symmetry:?}: {expected:?}");
        for (i, expected) in expected.into_iter().enumerate() {
            let found = with[i] - without[i];
            assert!((found - expected).abs() < 1e-4 * largest, "{symmetry:?}: number {i}: {found} for {expected}");
        }
    }
}
