//! The articulated engine on an NVIDIA card: the same equations, one thread per robot, with the
//! bits of the CPU.
//!
//! Robots live in their rows. A control step copies states and drives into columns, and each
//! morphology's block goes to the card, steps and comes back on its own queue, so that blocks step
//! side by side. Rows are written when all blocks are back: if the card is lost, the CPU's engine
//! makes the same step from them.

mod robots;
mod trial;

use std::sync::Arc;
use std::time::{Duration, Instant};

use polypod_cuda::{Card, Device, DeviceError, Found, Heights};

use super::{DivergenceRecord, Engine, EngineFactory, EngineSetup, RobotSlices, Run};
use crate::blocks::{Block, BlockList, BlockSizes};
use crate::dynamics::{Parameters, StepSettings};
use crate::error::Error;
use crate::workers::{Workers, packs_of};
use robots::{Means, Robots};
use trial::{Trial, Turn};

/// Folders of Python packages, in which `cuda` looks for torch's NVRTC; the first call counts.
pub use polypod_cuda::search_packages;

/// Whether the engine `cuda` can be used here, and why not: one line.
pub fn describe_card() -> String {
    match polypod_cuda::find() {
        Ok(Found { name, driver, memory }) => format!(
            "{name}, {} GB, driver for CUDA {}.{}; tasks use it with physics.engine=cuda, and with \
             physics.engine=auto where it is faster than the CPU",
            memory >> 30,
            driver / 1000,
            driver % 1000 / 10
        ),
        Err(error) => format!("not used: {error}; {}", error.remedy()),
    }
}

/// Environment variable: the engine prints where the time of its steps went when it ends.
const TIMES: &str = "POLYPOD_CUDA_TIMES";

type Open = dyn Fn() -> Result<Arc<dyn Device>, DeviceError> + Send + Sync;

/// Makes engines that step on a device. Built in as `cuda` and `auto`, for NVIDIA cards.
pub struct OnDevice {
    open: Box<Open>,
    if_faster: bool,
}

impl OnDevice {
    /// Engines on a device that `open` opens when a simulation is made.
    pub fn new(open: impl Fn() -> Result<Arc<dyn Device>, DeviceError> + Send + Sync + 'static) -> Self {
        Self { open: Box::new(open), if_faster: false }
    }

    /// Engines on a device where it is faster than the CPU: both take turns in the first steps.
    /// They have the same bits. Where there is no device, the CPU steps.
    pub fn if_faster(open: impl Fn() -> Result<Arc<dyn Device>, DeviceError> + Send + Sync + 'static) -> Self {
        Self { if_faster: true, ..Self::new(open) }
    }

    /// Opens the first NVIDIA card.
    pub(super) fn open_card() -> Result<Arc<dyn Device>, DeviceError> {
        Ok(Arc::new(Card::open(std::env::var_os(TIMES).is_some())?))
    }

    /// The robots of all morphologies on a device.
    fn place(&self, setup: &EngineSetup) -> Result<Placed, Error> {
        let refused = |error: DeviceError| Error::argument("physics.engine", error.to_string(), error.remedy());
        let device = (self.open)().map_err(refused)?;
        let settings = setup.step_settings(setup.plane());
        let heights = setup.ground.terrain.as_deref().map(Heights::new);
        let (mut robots, mut first_env) = (Vec::new(), 0);
        for (morphology, &count) in setup.morphologies.iter().zip(&setup.blocks.0) {
            if count > 0 {
                let made = Robots::new(&*device, morphology, &settings, heights.as_ref(), first_env, count);
                robots.push(made.map_err(|error| {
                    let problem = format!("{}: {error}", morphology.name());
                    Error::argument("physics.engine", problem, error.remedy())
                })?);
            }
            first_env += count;
        }
        // the morphologies whose robots take the longest begin first
        let mut order: Vec<usize> = (0..robots.len()).collect();
        order.sort_by_key(|&place| std::cmp::Reverse(robots[place].num_impulses()));
        Ok(Placed { device, settings, heights, robots, order })
    }
}

impl EngineFactory for OnDevice {
    fn varies_shapes(&self) -> bool {
        true
    }

    fn has_spin_friction(&self) -> bool {
        true
    }

    fn bits_of(&self) -> Option<&'static str> {
        Some("articulated")
    }

    fn pieces(&self, blocks: &BlockSizes) -> usize {
        blocks.0.iter().map(|&count| packs_of(count)).sum()
    }

    fn make(&self, setup: &EngineSetup) -> Result<Box<dyn Engine>, Error> {
        let placed = match self.place(setup) {
            Ok(placed) => Some(placed),
            Err(error) if self.if_faster => {
                if polypod_cuda::find().is_err() {
                    tracing::info!("physics.engine auto: the CPU steps: {error}");
                } else {
                    tracing::warn!("physics.engine auto: the CPU steps: {error}");
                }
                None
            }
            Err(error) => return Err(error),
        };
        let timed = std::env::var_os(TIMES).is_some();
        let engine = DeviceEngine {
            on_cpu: setup.make_articulated()?,
            placed,
            trial: self.if_faster.then(Trial::default),
            times: timed.then(Times::default),
        };
        Ok(Box::new(engine))
    }
}

/// Robots on a device.
struct Placed {
    device: Arc<dyn Device>,
    settings: StepSettings,
    heights: Option<Heights>,
    /// Robots of each morphology that has some.
    robots: Vec<Robots>,
    /// Places in `robots` in the order in which their steps begin.
    order: Vec<usize>,
}

/// Steps on a device; on the CPU if the device is lost or slower.
struct DeviceEngine {
    /// The engine with the same bits, which goes on where the device is lost.
    on_cpu: Box<dyn Engine>,
    /// Absent once the device is lost, or where the CPU is faster.
    placed: Option<Placed>,
    /// While it is not known who is faster.
    trial: Option<Trial>,
    times: Option<Times>,
}

impl Placed {
    /// Steps all blocks on the device. The rows are unchanged.
    fn step(
        &mut self,
        workers: &Workers,
        blocks: &mut [Block<RobotSlices<'_>>],
        times: Option<&mut Times>,
    ) -> Result<(), DeviceError> {
        let Self { device, settings, heights, robots, order } = self;
        let means = Means { device: &**device, settings, heights: heights.as_ref(), workers };
        let begun = Instant::now();
        robots::read_rows(workers, robots, blocks);
        for &place in &*order {
            robots[place].start(&means, &mut blocks[place])?;
        }
        let started = Instant::now();
        for &place in &*order {
            robots[place].finish(&means, &mut blocks[place])?;
        }
        if let Some(times) = times {
            times.gather += started - begun;
            times.wait += started.elapsed();
            times.steps += 1;
            for robots in robots {
                for (sum, seconds) in times.device.iter_mut().zip(robots.seconds().unwrap_or_default()) {
                    *sum += seconds;
                }
            }
        }
        Ok(())
    }
}

impl DeviceEngine {
    /// Whether the device makes the next step.
    fn takes_device(&mut self) -> bool {
        let Self { placed: Some(placed), trial, .. } = self else { return false };
        let Some(of_both) = trial else { return true };
        // asking begins the preparations of all, side by side
        if placed.robots.iter_mut().map(Robots::is_ready).filter(|ready| !ready).count() > 0 {
            return false;
        }
        let turn = of_both.next(Instant::now());
        let Some((winner, [cpu, device])) = of_both.verdict() else { return turn == Turn::Device };
        let [cpu, device] = [cpu, device].map(|time| 1e3 * time.as_secs_f64());
        tracing::info!(
            "physics.engine auto: a control step takes {device:.2} ms with {} and {cpu:.2} ms with the CPU alone, \
             which have the same bits; {} goes on",
            placed.device.name(),
            if winner == Turn::Device { "the card" } else { "the CPU" }
        );
        self.trial = None;
        if winner == Turn::Cpu {
            self.placed = None;
        }
        self.placed.is_some()
    }
}

impl Engine for DeviceEngine {
    fn upload(&mut self, env: usize, parameters: &Parameters<f32>) {
        self.on_cpu.upload(env, parameters);
        if let Some(Placed { robots, .. }) = &mut self.placed {
            let place = robots.partition_point(|robots| robots.envs().end <= env);
            if let Some(robots) = robots.get_mut(place) {
                robots.upload(env, parameters);
            }
        }
    }

    fn step(&mut self, workers: &Workers, robots: BlockList<RobotSlices<'_>>, run: Run) -> Vec<DivergenceRecord> {
        let whole = |placed: &Placed| run.gains && run.steps == placed.settings.decimation;
        if !self.placed.as_ref().is_some_and(whole) || !self.takes_device() {
            return self.on_cpu.step(workers, robots, run);
        }
        let Self { placed, times, .. } = self;
        let Some(device) = placed else { return self.on_cpu.step(workers, robots, run) };
        let mut blocks: Vec<Block<RobotSlices>> = robots.into_iter().collect();
        if let Err(error) = device.step(workers, &mut blocks, times.as_mut()) {
            tracing::warn!(
                "physics.engine: the card failed ({error}); the simulation goes on from the last control step with the \
                 engine articulated, on the CPU and with the same bits"
            );
            self.placed = None;
            return self.on_cpu.step(workers, BlockList::new(blocks.into_iter()), run);
        }
        let begun = Instant::now();
        let found = robots::write_rows(workers, &mut device.robots, &mut blocks, &run);
        if let Some(times) = times {
            times.scatter += begun.elapsed();
        }
        found
    }
}

/// Where the time of the steps went.
#[derive(Default)]
struct Times {
    steps: u32,
    /// Rows into columns, and the beginning of the blocks' work.
    gather: Duration,
    /// For the device, beyond that.
    wait: Duration,
    /// Columns into rows.
    scatter: Duration,
    /// Upload, kernel, download, s: sums over blocks, which overlap.
    device: [f64; 3],
}

impl Drop for Times {
    fn drop(&mut self) {
        let ms = |seconds: f64| 1e3 * seconds / f64::from(self.steps.max(1));
        let [gather, wait, scatter] = [self.gather, self.wait, self.scatter].map(|time| ms(time.as_secs_f64()));
        let [upload, kernel, download] = self.device.map(ms);
        eprintln!(
            "physics.engine cuda: {} steps; ms a step: rows into columns {gather:.3}, waiting {wait:.3}, columns into \
             rows {scatter:.3}; sums over blocks, which overlap: upload {upload:.3}, kernel {kernel:.3}, download \
             {download:.3}",
            self.steps
        );
    }
}
