//! `polypod-sim play`

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use polypod::Autoreset;
use polypod::components::{BasePose, Command, EnvId, Imu, MountedOn};
use polypod::config::Library;
use polypod::{Sim, SimOptions};
use serde::Serialize;

use crate::policy::{Policy, PolicyManifest};

/// Arguments of `play`.
#[derive(Args)]
pub(super) struct Play {
    /// `policy.onnx` of an export, next to its manifest `policy.json`.
    #[arg(long)]
    policy: PathBuf,
    /// Robots, separated by commas; those that the policy was trained on by default.
    #[arg(long, visible_alias = "robot", value_delimiter = ',')]
    robots: Option<Vec<String>>,
    /// Name, alias or path of the task; by default the policy's own. Its Play variant is used: no
    /// noise, no pushes.
    #[arg(long)]
    task: Option<String>,
    /// Number of envs; 16 per robot by default.
    #[arg(long)]
    num_envs: Option<usize>,
    /// Control steps; an env whose episode ends earlier stays where it is.
    #[arg(long, default_value_t = 1000)]
    steps: usize,
    /// Forward and left velocity (m/s) and yaw rate (rad/s) for all envs; by default sampled as in
    /// the task.
    #[arg(long, num_args = 3, value_names = ["VX", "VY", "WZ"], allow_negative_numbers = true)]
    command: Option<Vec<f32>>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    /// Seed of all random streams.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Threads of the physics; all cores by default.
    #[arg(long)]
    threads: Option<usize>,
    /// Changes to the task, on top of the policy's own; may be given several times.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

/// One env until its episode ended.
#[derive(Clone, Default)]
struct Track {
    steps: usize,
    error_xy: f64,
    error_yaw: f64,
    still_xy: f64,
    still_yaw: f64,
    distance: f64,
    place: [f32; 2],
    fell: bool,
    ended: bool,
}

/// Means over a robot's envs.
#[derive(Serialize)]
struct Played {
    robot: String,
    envs: usize,
    /// Error between commanded and actual planar velocity, m/s.
    error_vel_xy: f64,
    /// Error between commanded and actual yaw rate, rad/s.
    error_vel_yaw: f64,
    /// Planar velocity error of a robot that stands still, m/s.
    still_error_vel_xy: f64,
    /// Yaw rate error of a robot that stands still, rad/s.
    still_error_vel_yaw: f64,
    /// Number of episodes that ended in failure.
    falls: usize,
    /// Distance of the base over the ground, m.
    distance: f64,
    /// Length of an episode, s.
    episode_length_s: f64,
}

impl Play {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        let manifest = PolicyManifest::beside(&self.policy)?;
        let library = Library::new(Vec::new());
        let task = library.play_task(self.task.as_ref().unwrap_or(&manifest.task))?;
        // a training may have changed events; the arguments of this command come last
        let disturbances = library.task(&task, &manifest.overrides)?.config.disturbances();
        let quiet = disturbances.iter().map(|key| format!("{key}=false"));
        let robots = self.robots.clone().unwrap_or_else(|| manifest.robots.clone());
        let num_envs = self.num_envs.unwrap_or(16 * robots.len());
        let mut sim = Sim::new(&SimOptions {
            robots: Some(robots),
            seed: self.seed,
            threads: self.threads,
            overrides: manifest.overrides.iter().cloned().chain(quiet).chain(self.overrides.iter().cloned()).collect(),
            autoreset: Autoreset::Disabled,
            slots: manifest.canonical_joint_names.clone(),
            ..SimOptions::new(task, num_envs)
        })?;
        let mut policy = Policy::load(&self.policy, num_envs)?;
        policy.check(&sim)?;
        if let Some(command) = &self.command {
            sim.set_commands(Some(&command.repeat(num_envs)))?;
            // the first observation shows the command
            sim.reset(None, None)?;
        }
        let progress = if std::io::stderr().is_terminal() {
            let style = ProgressStyle::with_template("{bar:40} {pos}/{len} steps, {eta} left")?;
            ProgressBar::new(self.steps as u64).with_style(style)
        } else {
            ProgressBar::hidden()
        };
        let mut tracks = vec![Track::default(); num_envs];
        visit(&mut sim, |env, place| tracks[env].place = place);
        let began = Instant::now();
        for _ in 0..self.steps {
            let batch = sim.batch();
            let observed = policy.manifest.num_obs();
            let actions = if observed == batch.num_obs {
                policy.act(&batch.observations)?
            } else {
                // the policy's group comes first in each row
                let rows = batch.observations.chunks_exact(batch.num_obs);
                policy.act(&rows.flat_map(|row| &row[..observed]).copied().collect::<Vec<_>>())?
            };
            sim.step(&actions)?;
            let batch = sim.batch();
            let ends = batch.terminated.iter().zip(&batch.truncated[..]).map(|(a, b)| *a || *b);
            policy.reset(Some(&ends.collect::<Vec<_>>()))?;
            advance(&mut sim, &mut tracks);
            progress.inc(1);
            if tracks.iter().all(|track| track.ended) {
                break;
            }
        }
        progress.finish_and_clear();
        let seconds = began.elapsed().as_secs_f64();
        let step_dt = sim.task().config.sim.step_dt();
        let played: Vec<Played> = (0..sim.morphologies().len())
            .map(|robot| summary(sim.morphologies()[robot].name(), &tracks[sim.env_ids(robot)], step_dt))
            .collect();
        if self.json {
            writeln!(out, "{}", serde_json::to_string_pretty(&played)?)?;
            return Ok(());
        }
        let steps = tracks.iter().map(|track| track.steps).sum::<usize>() as f64;
        writeln!(
            out,
            "{}: {num_envs} envs, {:.0} env-steps/s with the policy",
            sim.task().config.name,
            steps / seconds.max(1e-9)
        )?;
        writeln!(
            out,
            "  {:<14} {:>6} {:>7} {:>15} {:>7} {:>18} {:>7} {:>13} {:>11}",
            "robot",
            "envs",
            "falls",
            "error xy (m/s)",
            "still",
            "error yaw (rad/s)",
            "still",
            "distance (m)",
            "length (s)"
        )?;
        for p in &played {
            writeln!(
                out,
                "  {:<14} {:>6} {:>7} {:>15.3} {:>7.3} {:>18.3} {:>7.3} {:>13.2} {:>11.2}",
                p.robot,
                p.envs,
                p.falls,
                p.error_vel_xy,
                p.still_error_vel_xy,
                p.error_vel_yaw,
                p.still_error_vel_yaw,
                p.distance,
                p.episode_length_s
            )?;
        }
        Ok(())
    }
}

/// Calls `f` with the position of each env's robot over the ground.
fn visit(sim: &mut Sim, mut f: impl FnMut(usize, [f32; 2])) {
    let world = sim.world_mut();
    for (env, pose) in world.query::<(&EnvId, &BasePose)>().iter(world) {
        f(env.0 as usize, [pose.position[0], pose.position[1]]);
    }
}

/// Adds a control step to the envs whose episodes go on.
fn advance(sim: &mut Sim, tracks: &mut [Track]) {
    let world = sim.world_mut();
    let mut wanted = vec![[0.0f32; 3]; tracks.len()];
    for (env, command) in world.query::<(&EnvId, &Command)>().iter(world) {
        wanted[env.0 as usize] = command.velocity;
    }
    for (env, imu, _) in world.query::<(&EnvId, &Imu, &MountedOn)>().iter(world) {
        let (track, wanted) = (&mut tracks[env.0 as usize], wanted[env.0 as usize]);
        if !track.ended {
            let [x, y] = [0, 1].map(|axis| f64::from(wanted[axis] - imu.linear_velocity[axis]));
            track.steps += 1;
            track.error_xy += x.hypot(y);
            track.error_yaw += f64::from((wanted[2] - imu.angular_velocity[2]).abs());
            track.still_xy += f64::from(wanted[0]).hypot(f64::from(wanted[1]));
            track.still_yaw += f64::from(wanted[2].abs());
        }
    }
    visit(sim, |env, place| {
        let track = &mut tracks[env];
        if !track.ended {
            track.distance += f64::from(place[0] - track.place[0]).hypot(f64::from(place[1] - track.place[1]));
            track.place = place;
        }
    });
    let batch = sim.batch();
    for (env, track) in tracks.iter_mut().enumerate().filter(|(_, track)| !track.ended) {
        track.fell = batch.terminated[env];
        track.ended = track.fell || batch.truncated[env];
    }
}

fn summary(robot: &str, tracks: &[Track], step_dt: f64) -> Played {
    let mean = |f: &dyn Fn(&Track) -> f64| tracks.iter().map(f).sum::<f64>() / tracks.len().max(1) as f64;
    Played {
        robot: robot.to_string(),
        envs: tracks.len(),
        error_vel_xy: mean(&|t| t.error_xy / t.steps.max(1) as f64),
        error_vel_yaw: mean(&|t| t.error_yaw / t.steps.max(1) as f64),
        still_error_vel_xy: mean(&|t| t.still_xy / t.steps.max(1) as f64),
        still_error_vel_yaw: mean(&|t| t.still_yaw / t.steps.max(1) as f64),
        falls: tracks.iter().filter(|t| t.fell).count(),
        distance: mean(&|t| t.distance),
        episode_length_s: mean(&|t| t.steps as f64 * step_dt),
    }
}
