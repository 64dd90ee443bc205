//! `polypod-sim soak`

use std::io::{IsTerminal, Write};
use std::time::Instant;

use anyhow::bail;
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use polypod::components::EnvRng;
use polypod::config::Library;
use polypod::dynamics::math::integrate_quat;
use polypod::morphology::MorphologyModel;
use polypod::{Control, Error, Simulation, SimulationOptions};

/// Arguments of `soak`.
#[derive(Args)]
pub(super) struct Soak {
    /// Robots, separated by commas; all robots by default.
    #[arg(long, value_delimiter = ',')]
    robots: Option<Vec<String>>,
    /// Number of envs, shared out evenly.
    #[arg(long, default_value_t = 1000)]
    num_envs: usize,
    /// Simulated minutes.
    #[arg(long, default_value_t = 60)]
    minutes: usize,
    /// Physics step, s.
    #[arg(long, default_value_t = 0.005)]
    dt: f64,
    /// Seed of the targets.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Threads; all cores by default.
    #[arg(long)]
    threads: Option<usize>,
}

/// Part of each minute with random targets over the whole range of the joints, s, ...
const RANDOM_S: f64 = 55.0;
/// ... passive joints, while energy may only fall, ...
const PASSIVE_S: f64 = 2.0;
/// ... and the default pose held, until nothing is in the ground.
const HOLD_S: f64 = 3.0;
/// Time that a target holds, s.
const TARGET_S: f64 = 0.25;
/// Number of checks of the state while a target holds.
const OBSERVATIONS: usize = 10;
/// Limits of joints that have none, rad or m.
const UNLIMITED: f64 = 3.0;
/// Largest depth of a robot at rest in the ground, m.
const MAX_DEPTH: f64 = 0.01;
/// Energy that contacts may add to passive joints, as a height of the whole robot, m: a body that
/// is pushed out of a penetration rises.
const MAX_LIFT: f64 = 0.01;
/// Largest distance of a joint beyond a limit, rad or m.
const MAX_OVER_LIMIT: f64 = 0.02;

/// The worst of a robot's envs.
#[derive(Default)]
struct Worst {
    broken: usize,
    depth: f64,
    won: f64,
    lift: f64,
    over_limit: f64,
    speed: f64,
}

/// Task whose robots are used by default.
const TASK: &str = "velocity_flat";

impl Soak {
    /// Fails when a state broke, a robot rested in the ground, a joint limit gave way, or energy
    /// came from nothing.
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        let library = Library::new(Vec::new());
        let robots = match &self.robots {
            Some(robots) => robots.clone(),
            None => library.task(TASK, &[]).map_err(Error::from)?.config.robots,
        };
        let least = robots.len().max(1);
        if self.minutes == 0 {
            let (problem, remedy) = ("0 minutes".into(), "pass at least 1".into());
            return Err(Error::Argument { element: "minutes", problem, remedy }.into());
        }
        if robots.is_empty() || self.num_envs < least {
            let problem = format!("{} envs for {} robots", self.num_envs, robots.len());
            let remedy = format!("pass at least {least}, and at least one robot");
            return Err(Error::Argument { element: "num_envs", problem, remedy }.into());
        }
        // check the options before anything is printed
        SimulationOptions { dt: self.dt, threads: self.threads, ..SimulationOptions::new("", self.num_envs) }
            .validate()?;
        writeln!(
            out,
            "{} envs, {} min simulated in steps of {} ms: random targets over the joints' whole range, at the extremes of \
             the randomisation",
            self.num_envs,
            self.minutes,
            1e3 * self.dt
        )?;
        writeln!(
            out,
            "{:<14} {:>5} {:>7} {:>14} {:>17} {:>11} {:>16} {:>14} {:>9}",
            "robot",
            "envs",
            "broken",
            "depth at rest",
            "energy won / m g",
            "of contacts",
            "past a limit",
            "fastest joint",
            "time"
        )?;
        let mut failed = false;
        for (i, robot) in robots.iter().enumerate() {
            let envs = self.num_envs / robots.len() + usize::from(i < self.num_envs % robots.len());
            let began = Instant::now();
            let worst = self.soak(&library, robot, envs)?;
            failed |= worst.broken > 0
                || worst.depth > MAX_DEPTH
                || worst.lift > MAX_LIFT
                || worst.over_limit > MAX_OVER_LIMIT;
            writeln!(
                out,
                "{robot:<14} {envs:>5} {:>7} {:>11.2} mm {:>14.2} mm {:>8.2} mm {:>11.2} mrad {:>8.1} rad/s {:>7.1} s",
                worst.broken,
                1e3 * worst.depth,
                1e3 * worst.won,
                1e3 * worst.lift,
                1e3 * worst.over_limit,
                worst.speed,
                began.elapsed().as_secs_f64()
            )?;
        }
        if failed {
            bail!(
                "a state broke, a robot rested more than {} mm in the ground, a joint was more than {} mrad past a limit, or \
                 contacts added more energy than lifting the robot by {} mm takes",
                1e3 * MAX_DEPTH,
                1e3 * MAX_OVER_LIMIT,
                1e3 * MAX_LIFT
            );
        }
        Ok(())
    }

    fn soak(&self, library: &Library, robot: &str, envs: usize) -> anyhow::Result<Worst> {
        let model = MorphologyModel::new(&library.robot(robot).map_err(Error::from)?)?;
        let options =
            SimulationOptions { dt: self.dt, threads: self.threads, ..SimulationOptions::new(robot.to_string(), envs) };
        let mut sim = Simulation::new(&options)?;
        set_extremes(&mut sim, &model)?;
        let mut energy = Energy::new(&options, &model)?;
        let steps = |seconds: f64| ((seconds / self.dt).round() as usize).max(1);
        let default_pose: Vec<f64> = sim.default_qpos()[7..].to_vec();
        let joints = sim.num_joints();
        let range: Vec<[f32; 2]> =
            sim.joint_range().iter().map(|r| [r[0].max(-UNLIMITED) as f32, r[1].min(UNLIMITED) as f32]).collect();
        let mut rngs: Vec<EnvRng> = (0..envs).map(|env| EnvRng::new(self.seed, env as u64)).collect();
        let mut targets = vec![0.0; envs * joints];
        let mut worst = Worst::default();
        let progress = if std::io::stderr().is_terminal() {
            let style = ProgressStyle::with_template("{msg} {bar:40} {pos}/{len} min, {eta} left")?;
            ProgressBar::new(self.minutes as u64).with_style(style).with_message(robot.to_string())
        } else {
            ProgressBar::hidden()
        };
        for _ in 0..self.minutes {
            for _ in 0..(RANDOM_S / TARGET_S) as usize {
                for (row, rng) in targets.chunks_mut(joints).zip(&mut rngs) {
                    for (target, range) in row.iter_mut().zip(&range) {
                        *target = f64::from(rng.uniform(*range));
                    }
                }
                let control = Control { targets: Some(&targets), ..Control::default() };
                for _ in 0..OBSERVATIONS {
                    sim.step(&control, steps(TARGET_S / OBSERVATIONS as f64))?;
                    worst.look(&mut sim)?;
                }
            }
            energy.begin();
            for _ in 0..steps(PASSIVE_S) {
                energy.step(&mut sim, &mut worst)?;
                worst.look(&mut sim)?;
            }
            sim.step(&Control { targets: Some(&default_pose), ..Control::default() }, steps(HOLD_S))?;
            worst.look(&mut sim)?;
            worst.depth = sim.ground_gap().into_iter().fold(worst.depth, |worst, gap| worst.max(-gap));
            progress.inc(1);
        }
        progress.finish_and_clear();
        Ok(worst)
    }
}

impl Worst {
    /// Counts envs whose state is broken and restarts them; records speeds and violated limits.
    fn look(&mut self, sim: &mut Simulation) -> anyhow::Result<()> {
        let (qpos, qvel) = (sim.qpos(), sim.qvel());
        let (nq, nv) = (sim.nq(), sim.nv());
        let range = sim.joint_range();
        let mut broken = Vec::new();
        for env in 0..sim.num_envs() {
            let (q, v) = (&qpos[env * nq..(env + 1) * nq], &qvel[env * nv..(env + 1) * nv]);
            if q.iter().chain(v).any(|x| !x.is_finite()) || v.iter().any(|x| x.abs() > 1e3) {
                broken.push(env);
                continue;
            }
            for (x, [low, high]) in q[7..].iter().zip(&range) {
                self.over_limit = self.over_limit.max(low - x).max(x - high);
            }
            self.speed = v[6..].iter().fold(self.speed, |worst, x| worst.max(x.abs()));
        }
        if !broken.is_empty() {
            self.broken += broken.len();
            let (qpos, qvel) = (sim.default_qpos().to_vec(), vec![0.0; nv]);
            sim.set_state(Some(&broken), Some(&qpos), Some(&qvel))?;
        }
        Ok(())
    }
}

/// Energy that passive joints gain: in total, and from contacts as the work of their forces and the
/// lift of resolved depths.
///
/// The work of impulses `p` over a step is `p . (v0 + v1) / 2`, with the velocities before and
/// after it. `p = M (v1 - v)` is the difference to the velocities of the same step without
/// contacts. The rest of the gain is the integrator's, of first order; a fast joint shows it.
struct Energy {
    dt: f64,
    weight: f64,
    /// Simulation of these robots without contacts.
    alone: Simulation,
    /// Total energy, J, `[envs]`.
    total: Vec<Won>,
    contacts: Vec<Won>,
}

/// An energy and its minimum so far, J.
#[derive(Clone)]
struct Won {
    energy: f64,
    least: f64,
}

impl Won {
    /// Adds a change; returns the gain since the minimum.
    fn add(&mut self, change: f64) -> f64 {
        self.energy += change;
        self.least = self.least.min(self.energy);
        self.energy - self.least
    }
}

impl Energy {
    fn new(options: &SimulationOptions, model: &MorphologyModel) -> anyhow::Result<Self> {
        let mut alone =
            Simulation::new(&SimulationOptions { ground: None, self_collision: Some(false), ..options.clone() })?;
        set_extremes(&mut alone, model)?;
        let none = vec![Won { energy: 0.0, least: 0.0 }; alone.num_envs()];
        let free_fall = options.gravity.iter().map(|g| g * g).sum::<f64>().sqrt();
        Ok(Self { dt: options.dt, weight: alone.total_mass() * free_fall, alone, total: none.clone(), contacts: none })
    }

    /// Restarts the sums.
    fn begin(&mut self) {
        for won in self.total.iter_mut().chain(&mut self.contacts) {
            (won.energy, won.least) = (0.0, 0.0);
        }
    }

    /// A passive step.
    fn step(&mut self, sim: &mut Simulation, worst: &mut Worst) -> anyhow::Result<()> {
        let (nq, nv) = (sim.nq(), sim.nv());
        let (qpos, before, (kinetic_before, potential_before)) = (sim.qpos(), sim.qvel(), sim.energy());
        self.alone.set_state(None, Some(&qpos), Some(&before))?;
        let mass = self.alone.mass_matrix();
        self.alone.step(&Control::default(), 1)?;
        let free = self.alone.qvel();
        sim.step(&Control::default(), 1)?;
        let after = sim.qvel();
        let moved: Vec<f64> = qpos.chunks(nq).zip(after.chunks(nv)).flat_map(|(q, v)| self.moved(q, v)).collect();
        self.alone.set_state(None, Some(&moved), None)?;
        let (_, without_push) = self.alone.energy();
        let (kinetic, potential) = sim.energy();
        for (env, after) in after.chunks(nv).enumerate() {
            let (mass, row) = (&mass[env * nv * nv..(env + 1) * nv * nv], env * nv..(env + 1) * nv);
            let work = work(mass, &before[row.clone()], after, &free[row]);
            let lift = potential[env] - without_push[env];
            let won = kinetic[env] + potential[env] - kinetic_before[env] - potential_before[env];
            worst.won = worst.won.max(self.total[env].add(won) / self.weight);
            worst.lift = worst.lift.max(self.contacts[env].add(work + lift) / self.weight);
        }
        Ok(())
    }

    /// Result of a step from a position `[nq]` at a velocity `[nv]` without forces.
    fn moved(&self, qpos: &[f64], qvel: &[f64]) -> Vec<f64> {
        let mut moved = qpos.to_vec();
        for (x, v) in moved[..3].iter_mut().zip(qvel) {
            *x += v * self.dt;
        }
        let rotation = std::array::from_fn(|k| qpos[3 + k]);
        let turn = std::array::from_fn(|k| qvel[3 + k] * self.dt);
        moved[3..7].copy_from_slice(&integrate_quat(&rotation, &turn));
        for (q, v) in moved[7..].iter_mut().zip(&qvel[6..]) {
            *q += v * self.dt;
        }
        moved
    }
}

/// Work of the impulses that change velocities from `free` to `after` in a step that begins with
/// `before`, all `[nv]`, J; `mass` is `[nv, nv]`.
fn work(mass: &[f64], before: &[f64], after: &[f64], free: &[f64]) -> f64 {
    let mut work = 0.0;
    for (row, (v0, v1)) in mass.chunks(before.len()).zip(before.iter().zip(after)) {
        let impulse: f64 = row.iter().zip(after.iter().zip(free)).map(|(m, (v1, v))| m * (v1 - v)).sum();
        work += 0.5 * impulse * (v0 + v1);
    }
    work
}

/// Gives each env a corner of the robot's randomisation: the base's mass and centre of mass, and
/// friction.
fn set_extremes(sim: &mut Simulation, model: &MorphologyModel) -> anyhow::Result<()> {
    let base = &model.model.links[0];
    let ranges = &model.config.randomization;
    let shift = &ranges.base_com_offset;
    for env in 0..sim.num_envs() {
        let corner = |bit: usize, range: [f64; 2]| range[(env >> bit) & 1];
        sim.set_mass(Some(&[env]), 0, &[base.mass + corner(0, ranges.base_mass_offset)])?;
        let com = [base.com.x + corner(1, shift.x), base.com.y + corner(2, shift.y), base.com.z + corner(3, shift.z)];
        sim.set_com(Some(&[env]), 0, &com)?;
        let of = |range| corner(4, range);
        sim.set_friction(Some(&[env]), &[of(ranges.static_friction)], Some(&[of(ranges.dynamic_friction)]))?;
    }
    Ok(())
}
