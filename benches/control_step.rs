//! Whole control steps: everything the pipeline does, in env-steps per second. `make bench`.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use polypod::components::EnvRng;
use polypod::{Sim, SimOptions};

/// Sets of robots, by name, to compare one with many.
const ROBOTS: [(&str, Option<&str>); 3] =
    [("eight", None), ("unitree_go2", Some("unitree_go2")), ("spot", Some("spot"))];

fn sim(robot: Option<&str>, num_envs: usize, threads: usize, overrides: &[&str]) -> Sim {
    let options = SimOptions {
        robots: robot.map(|name| vec![name.to_string()]),
        threads: Some(threads),
        overrides: overrides.iter().map(ToString::to_string).collect(),
        ..SimOptions::new("velocity_flat", num_envs)
    };
    Sim::new(&options).expect("the built-in task and robots load")
}

/// Steps with random actions after a while of the same, so that robots are on their feet, in the air and falling.
fn bench(c: &mut Criterion, group: &str, id: BenchmarkId, mut sim: Sim) {
    let mut rng = EnvRng::new(0, 0);
    let mut actions = vec![0.0; sim.batch().actions.len()];
    for _ in 0..50 {
        actions.fill_with(|| rng.uniform([-1.0, 1.0]));
        sim.step(&actions).expect("the actions are finite");
    }
    let mut group = c.benchmark_group(group);
    group.throughput(Throughput::Elements(sim.num_envs() as u64)).sample_size(20);
    group.bench_function(id, |b| b.iter(|| sim.step(&actions).expect("the actions are finite")));
    group.finish();
}

fn robots(c: &mut Criterion) {
    for (name, robot) in ROBOTS {
        bench(c, "robots", BenchmarkId::from_parameter(name), sim(robot, 4096, 1, &[]));
    }
}

fn envs(c: &mut Criterion) {
    for num_envs in [64, 1024, 4096, 16384] {
        bench(c, "envs", BenchmarkId::from_parameter(num_envs), sim(None, num_envs, 1, &[]));
    }
}

fn threads(c: &mut Criterion) {
    for threads in [1, 2] {
        bench(c, "threads", BenchmarkId::from_parameter(threads), sim(None, 4096, threads, &[]));
    }
}

/// One physics step against four, and one solver sweep against eight: the differences are their costs.
fn shares(c: &mut Criterion) {
    for (name, overrides) in [
        ("four physics steps", &[][..]),
        ("one physics step", &["sim.decimation=1"][..]),
        ("one solver sweep", &["physics.solver_iterations=1"][..]),
    ] {
        bench(c, "shares", BenchmarkId::from_parameter(name), sim(None, 4096, 1, overrides));
    }
}

criterion_group!(benches, robots, envs, threads, shares);
criterion_main!(benches);
