//! Speed of the physics alone, in env-physics-steps per second, and of whole control steps, in
//! env-steps per second. `cargo bench`; `cargo bench -- physics` for one group.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use polypod::components::EnvRng;
use polypod::{Control, Sim, SimOptions, Simulation, SimulationOptions};

/// Physics steps per drawing of targets, as in a control step.
const DECIMATION: usize = 4;
/// Sets of robots, by name, to compare one with many.
const ROBOTS: [(&str, Option<&str>); 4] =
    [("eight", None), ("unitree_a1", Some("unitree_a1")), ("anymal_c", Some("anymal_c")), ("spot", Some("spot"))];
/// Long before a measurement, so that what is measured lasts.
const WARM_UP: usize = 50;

/// Actions of the robots while their physics is measured.
#[derive(Clone, Copy)]
enum Scene {
    /// Targets within this of the default pose, rad: all stay on their feet.
    Standing(f32),
    /// Targets from the joints' whole range, until most lie on the ground.
    Fallen,
}

/// Physics alone: 4096 envs, one thread, new targets every four physics steps.
fn physics(c: &mut Criterion) {
    for (robot, scene, name) in [
        ("unitree_a1", Scene::Standing(0.1), "standing"),
        ("unitree_a1", Scene::Standing(0.25), "random actions"),
        ("unitree_a1", Scene::Fallen, "fallen"),
        ("unitree_b2", Scene::Standing(0.1), "standing"),
        ("anymal_c", Scene::Standing(0.1), "standing"),
        ("anymal_c", Scene::Fallen, "fallen"),
    ] {
        let options = SimulationOptions { threads: Some(1), ..SimulationOptions::new(robot.to_string(), 4096) };
        let mut sim = Simulation::new(&options).expect("the built-in robot loads");
        let default: Vec<f64> = sim.default_qpos()[7..].to_vec();
        let range = sim.joint_range();
        let mut rng = EnvRng::new(0, 0);
        let mut targets = vec![0.0; sim.num_envs() * default.len()];
        let mut draw = move |targets: &mut [f64]| {
            for row in targets.chunks_mut(default.len()) {
                for (j, x) in row.iter_mut().enumerate() {
                    let [low, high] = range[j].map(|x| x.clamp(-3.0, 3.0) as f32);
                    *x = match scene {
                        Scene::Standing(reach) => default[j] + f64::from(rng.uniform([-reach, reach])),
                        Scene::Fallen => f64::from(rng.uniform([low, high])),
                    };
                }
            }
        };
        let step = |sim: &mut Simulation, targets: &[f64]| {
            let control = Control { targets: Some(targets), ..Control::default() };
            sim.step(&control, DECIMATION).expect("the targets are finite");
        };
        for _ in 0..2 * WARM_UP {
            draw(&mut targets);
            step(&mut sim, &targets);
        }
        let mut group = c.benchmark_group("physics");
        group.throughput(Throughput::Elements((DECIMATION * sim.num_envs()) as u64)).sample_size(20);
        group.bench_function(BenchmarkId::new(robot, name), |b| {
            b.iter_batched_ref(
                || {
                    draw(&mut targets);
                    targets.clone()
                },
                |targets| step(&mut sim, targets),
                criterion::BatchSize::PerIteration,
            );
        });
        group.finish();
    }
}

fn sim(robot: Option<&str>, num_envs: usize, threads: usize, overrides: &[&str]) -> Sim {
    let options = SimOptions {
        robots: robot.map(|name| vec![name.to_string()]),
        threads: Some(threads),
        overrides: overrides.iter().map(ToString::to_string).collect(),
        ..SimOptions::new("velocity_flat", num_envs)
    };
    Sim::new(&options).expect("the built-in task and robots load")
}

/// Steps with random actions up to `reach`, after a while of the same: with 1 some robots stand,
/// some are in the air, some fall.
fn measure(c: &mut Criterion, group: &str, id: BenchmarkId, reach: f32, mut sim: Sim) {
    let mut rng = EnvRng::new(0, 0);
    let mut actions = vec![0.0; sim.batch().actions.len()];
    for _ in 0..WARM_UP {
        actions.fill_with(|| rng.uniform([-reach, reach]));
        sim.step(&actions).expect("the actions are finite");
    }
    let mut group = c.benchmark_group(group);
    group.throughput(Throughput::Elements(sim.num_envs() as u64)).sample_size(20);
    group.bench_function(id, |b| {
        b.iter_batched_ref(
            || {
                actions.fill_with(|| rng.uniform([-reach, reach]));
                actions.clone()
            },
            |actions| sim.step(actions).expect("the actions are finite"),
            criterion::BatchSize::PerIteration,
        );
    });
    group.finish();
}

/// Whole control steps: one kind of robot against eight, small actions against large ones.
fn control_step(c: &mut Criterion) {
    for (name, robot) in ROBOTS {
        for (what, reach) in [("small actions", 0.3), ("random actions", 1.0)] {
            measure(c, "control step", BenchmarkId::new(name, what), reach, sim(robot, 4096, 1, &[]));
        }
    }
}

/// Episodes of a tenth of a second: every fifth control step resets an env.
fn resets(c: &mut Criterion) {
    for (name, overrides) in [("of 20 s", &[][..]), ("of 0.1 s", &["sim.episode_length_s=0.1"][..])] {
        measure(c, "episodes", BenchmarkId::from_parameter(name), 0.3, sim(None, 4096, 1, overrides));
    }
}

fn envs(c: &mut Criterion) {
    for num_envs in [1024, 4096, 16384, 65536] {
        measure(c, "envs", BenchmarkId::from_parameter(num_envs), 0.3, sim(None, num_envs, 1, &[]));
    }
}

fn threads(c: &mut Criterion) {
    for threads in [1, 2] {
        measure(c, "threads", BenchmarkId::from_parameter(threads), 0.3, sim(None, 4096, threads, &[]));
    }
}

/// One physics step against four, and one solver sweep against the default four: the differences
/// are their costs.
fn shares(c: &mut Criterion) {
    for (name, overrides) in [
        ("four physics steps", &[][..]),
        ("one physics step", &["sim.decimation=1"][..]),
        ("one solver sweep", &["physics.solver_iterations=1"][..]),
    ] {
        measure(c, "shares", BenchmarkId::from_parameter(name), 0.3, sim(None, 4096, 1, overrides));
    }
}

/// Cost of bodies in Avian's world that follow the robots' links.
fn mirrors(c: &mut Criterion) {
    for num_envs in [64, 1024, 4096] {
        for (name, overrides) in
            [("without", &[][..]), ("with", &["physics.mirror_links=true", "sim.env_spacing=4.0"][..])]
        {
            measure(c, "link mirrors", BenchmarkId::new(name, num_envs), 1.0, sim(None, num_envs, 1, overrides));
        }
    }
}

/// Robots stepped by Avian, those of the first with contact between their own links.
fn avian(c: &mut Criterion) {
    for robot in ["anymal_c", "unitree_a1"] {
        let sim = sim(Some(robot), 64, 1, &["physics.engine=avian"]);
        measure(c, "avian engine", BenchmarkId::from_parameter(robot), 1.0, sim);
    }
}

criterion_group!(benches, physics, control_step, resets, envs, threads, shares, mirrors, avian);
criterion_main!(benches);
