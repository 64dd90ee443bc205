//! `polypod-sim rollout`

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::Instant;

use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use polypod::components::EnvRng;
use polypod::morphology::Morphologies;
use polypod::systems::{CompiledTask, Logs};
use polypod::{Sim, SimOptions};

/// Arguments of `rollout`.
#[derive(Args)]
pub(super) struct Rollout {
    /// Name, alias or path of the task.
    #[arg(long, default_value = "velocity_flat")]
    task: String,
    /// Robots, separated by commas; the task's own list by default.
    #[arg(long, value_delimiter = ',')]
    robots: Option<Vec<String>>,
    /// Number of envs.
    #[arg(long, default_value_t = 4096)]
    num_envs: usize,
    /// Control steps.
    #[arg(long, default_value_t = 1000)]
    steps: usize,
    /// Seed of all random streams.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Threads; all cores by default.
    #[arg(long)]
    threads: Option<usize>,
    /// Actions of the robots.
    #[arg(long, value_enum, default_value_t = Actions::Random)]
    actions: Actions,
    /// Physics engine of the robots, `articulated` or `avian`; the task's by default.
    #[arg(long)]
    engine: Option<String>,
    /// Changes to the task, such as `sim.decimation=2`; may be given several times.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Directory for a dump of the first state of each robot that breaks, for `replay`.
    #[arg(long)]
    dump_dir: Option<PathBuf>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Actions {
    /// Uniform in [-1, 1], redrawn every control step.
    Random,
    /// Hold the default pose.
    Zero,
}

impl Rollout {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        let mut overrides = self.overrides;
        overrides.extend(self.engine.map(|engine| format!("physics.engine={engine}")));
        let options = SimOptions {
            robots: self.robots,
            seed: self.seed,
            threads: self.threads,
            overrides,
            dump_dir: self.dump_dir,
            ..SimOptions::new(self.task, self.num_envs)
        };
        let began = Instant::now();
        let mut sim = Sim::new(&options)?;
        writeln!(
            out,
            "{}: {} envs ({}), {} threads, {}, started in {:.2} s",
            sim.task().config.name,
            sim.num_envs(),
            sim.morphologies().iter().map(|robot| robot.name()).collect::<Vec<_>>().join(", "),
            sim.threads(),
            sim.simd().name(),
            began.elapsed().as_secs_f64()
        )?;
        let progress = if std::io::stderr().is_terminal() {
            let style = ProgressStyle::with_template("{bar:40} {pos}/{len} steps, {eta} left")?;
            ProgressBar::new(self.steps as u64).with_style(style)
        } else {
            ProgressBar::hidden()
        };
        let mut rng = EnvRng::new(self.seed, 0);
        let mut actions = vec![0.0; sim.batch().actions.len()];
        let mut seconds = 0.0;
        for _ in 0..self.steps {
            if matches!(self.actions, Actions::Random) {
                actions.fill_with(|| rng.uniform([-1.0, 1.0]));
            }
            let began = Instant::now();
            sim.step(&actions)?;
            seconds += began.elapsed().as_secs_f64();
            progress.inc(1);
        }
        progress.finish_and_clear();
        report(&mut out, &mut sim, self.steps, seconds)
    }
}

fn report(out: &mut impl Write, sim: &mut Sim, steps: usize, seconds: f64) -> anyhow::Result<()> {
    let rate = (sim.num_envs() * steps) as f64 / seconds;
    let decimation = f64::from(sim.task().config.sim.decimation);
    writeln!(
        out,
        "{steps} control steps in {seconds:.2} s: {rate:.0} env-steps/s ({:.0} env-physics-steps/s)",
        rate * decimation
    )?;
    writeln!(out, "finished episodes per robot:")?;
    writeln!(
        out,
        "  {:<14} {:>6} {:>9} {:>10} {:>12} {:>15} {:>17}",
        "robot", "envs", "episodes", "fall rate", "length (s)", "error xy (m/s)", "error yaw (rad/s)"
    )?;
    let stats = sim.world_mut().resource_scope(|world, mut logs: bevy_ecs::prelude::Mut<Logs>| {
        logs.stats(world.resource::<CompiledTask>(), world.resource::<Morphologies>(), false)
    });
    for (i, (robot, s)) in stats.iter().enumerate() {
        let falls = if s.episodes == 0 { "-".into() } else { format!("{:.3}", s.falls as f64 / s.episodes as f64) };
        writeln!(
            out,
            "  {robot:<14} {:>6} {:>9} {falls:>10} {:>12.2} {:>15.3} {:>17.3}",
            sim.env_ids(i).len(),
            s.episodes,
            s.episode_length_s,
            s.error_vel_xy,
            s.error_vel_yaw
        )?;
    }
    Ok(())
}
