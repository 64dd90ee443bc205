//! The share of a core's peak that an update of the learner reaches, on each instruction set.
//!
//! `cargo run --release -p polypod-learner --example share_of_peak` counts the multiply-adds of the
//! layers' products alone: activations, losses and Adam cost time and count as nothing. The peak is
//! that of a loop of fused multiply-adds in the same run. Timings are the best of several, since
//! other programs only make them longer.

use std::hint::black_box;
use std::time::Instant;

use polypod_lanes::{Kernel, Lanes, Real, Simd, WithLanes};
use polypod_learner::{
    Activation, Algorithm, Learner, LearnerError, Network, NetworkName, NetworkState, Options, Robot, Settings,
    Symmetry, Team,
};

const ENVS: usize = 256;
const STEPS: usize = 24;
const OBSERVATIONS: usize = 48;
const ACTIONS: usize = 12;
const EPOCHS: usize = 5;
const ROUNDS: usize = 12;

/// One thread.
struct Alone;

impl Team for Alone {
    fn for_each<T: Send>(&self, tasks: Vec<T>, f: impl Fn(T) + Sync) {
        tasks.into_iter().for_each(f);
    }
}

/// Rounds of multiply-adds in sixteen lanes, `CHAINS` side by side. A chain waits for itself, so
/// there must be as many as an instruction takes cycles times those that begin in a cycle.
struct Chains<const CHAINS: usize>(usize);

impl<const CHAINS: usize> WithLanes for Chains<CHAINS> {
    type Output = f64;

    fn run<L: Lanes>(self) -> f64 {
        struct Loop<const CHAINS: usize>(usize);
        impl<L: Real, const CHAINS: usize> Kernel<L> for Loop<CHAINS> {
            type Output = f32;
            #[inline(always)]
            fn run(self) -> f32 {
                // numbers that the compiler does not know, and different ones in each lane: it
                // leaves out registers that hold what others hold
                let given = black_box(std::array::from_fn::<f32, 16, _>(|lane| 0.9 + 0.005 * lane as f32));
                let (factor, term) = (L::load(&given), L::load(&given));
                let mut sums = [L::zero(); CHAINS];
                for chain in 0..CHAINS {
                    sums[chain] = L::load(&black_box(given));
                }
                for _ in 0..self.0 {
                    for chain in 0..CHAINS {
                        sums[chain] = sums[chain].mul_add(factor, term);
                    }
                }
                let (mut total, mut lanes) = (L::zero(), [0.0; 16]);
                for sum in sums {
                    total = total + sum;
                }
                // all lanes are read: a register that is not would be left out, too
                total.store(&mut lanes);
                lanes.iter().sum()
            }
        }
        let start = Instant::now();
        black_box(L::vectorize(Loop::<CHAINS>(self.0)));
        (2 * 16 * CHAINS * self.0) as f64 / start.elapsed().as_secs_f64()
    }
}

/// Floating-point operations a second, at most.
fn peak(simd: Simd) -> f64 {
    let token = simd.token().expect("it is available");
    let rounds = 200_000;
    let measured = (0..ROUNDS * 3).flat_map(|_| {
        [
            token.with_sixteen_lanes(Chains::<4>(rounds)),
            token.with_sixteen_lanes(Chains::<5>(rounds)),
            token.with_sixteen_lanes(Chains::<8>(rounds)),
            token.with_sixteen_lanes(Chains::<10>(rounds)),
        ]
    });
    measured.fold(0.0, f64::max)
}

fn settings(hidden_dims: &[usize]) -> Settings {
    let network = Network {
        hidden_dims: hidden_dims.to_vec(),
        activation: Activation::Elu,
        obs_normalization: false,
        columns: Vec::new(),
        joints: None,
    };
    let algorithm = Algorithm {
        num_learning_epochs: EPOCHS,
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
    };
    let robot = Robot {
        envs: (0, ENVS),
        observation_mirror: Vec::new(),
        action_mirror: Vec::new(),
        observation_mask: Vec::new(),
        action_mask: Vec::new(),
    };
    let options = Options {
        num_steps_per_env: STEPS,
        actor: network.clone(),
        critic: network,
        algorithm,
        normalize_reward_per_robot: false,
        normalize_advantage_per_robot: false,
        symmetry: Symmetry::None,
    };
    Settings { num_envs: ENVS, num_obs: OBSERVATIONS, num_actions: ACTIONS, seed: 0, robots: vec![robot], options }
}

/// Sizes of a network's layers, from the observation to the output.
fn layers(hidden_dims: &[usize], outputs: usize) -> Vec<usize> {
    std::iter::once(OBSERVATIONS).chain(hidden_dims.iter().copied()).chain([outputs]).collect()
}

/// Weights that spread numbers as they go from layer to layer, biases of zero, deviations of one.
fn state(name: NetworkName, hidden_dims: &[usize]) -> NetworkState {
    let is_actor = name == NetworkName::Actor;
    let mut weights = if is_actor { vec![vec![1.0; ACTIONS]] } else { Vec::new() };
    let mut numbers = (0u32..).map(|k| (k.wrapping_mul(2_654_435_769) >> 8) as f32 / (1 << 23) as f32 - 1.0);
    for sizes in layers(hidden_dims, if is_actor { ACTIONS } else { 1 }).windows(2) {
        let scale = (3.0 / sizes[0] as f32).sqrt();
        weights.push(numbers.by_ref().take(sizes[0] * sizes[1]).map(|x| scale * x).collect());
        weights.push(vec![0.0; sizes[1]]);
    }
    let zeros: Vec<Vec<f32>> = weights.iter().map(|of| vec![0.0; of.len()]).collect();
    NetworkState { weights, first: zeros.clone(), second: zeros, steps: 0 }
}

/// Operations of the products of an update: forward, to the weights, and to all inputs but the
/// first.
fn operations(hidden_dims: &[usize]) -> f64 {
    let of_network = |outputs: usize| -> usize {
        let sizes = layers(hidden_dims, outputs);
        let products: usize = sizes.windows(2).map(|pair| pair[0] * pair[1]).sum();
        6 * products - 2 * sizes[0] * sizes[1]
    };
    (ENVS * STEPS * EPOCHS * (of_network(ACTIONS) + of_network(1))) as f64
}

/// Operations a second of the fastest update.
fn update(simd: Simd, hidden_dims: &[usize]) -> Result<f64, LearnerError> {
    let mut learner = Learner::new(settings(hidden_dims), simd)?;
    for name in [NetworkName::Actor, NetworkName::Critic] {
        learner.set_network(name, &state(name, hidden_dims))?;
    }
    let observations: Vec<f32> = (0..ENVS * OBSERVATIONS).map(|k| (k as f32).sin()).collect();
    let (mut actions, mut best) = (vec![0.0; ENVS * ACTIONS], f64::INFINITY);
    for iteration in 0..ROUNDS as u64 {
        learner.begin(iteration);
        for step in 0..STEPS {
            learner.act(&Alone, &observations, &mut actions);
            let rewards: Vec<f32> = (0..ENVS).map(|env| ((env + step) as f32).cos()).collect();
            learner.record(&rewards, &[false; ENVS], &[false; ENVS], &mut Vec::new());
        }
        learner.finish_rollout(&Alone, &observations)?;
        let start = Instant::now();
        learner.update(&Alone, 1e-4)?;
        best = best.min(start.elapsed().as_secs_f64());
    }
    Ok(operations(hidden_dims) / best)
}

fn main() -> Result<(), LearnerError> {
    for simd in Simd::available().into_iter().filter(|simd| simd.name() != "portable") {
        let peak = peak(simd);
        println!("{}: {:.0} GFLOP/s at most", simd.name(), peak / 1e9);
        for hidden_dims in [[128, 128, 128], [512, 256, 128]] {
            let rate = update(simd, &hidden_dims)?;
            println!("  update of {hidden_dims:?}: {:.0} GFLOP/s, {:.2} of it", rate / 1e9, rate / peak);
        }
    }
    Ok(())
}
