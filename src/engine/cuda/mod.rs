//! The articulated engine on an NVIDIA card: the same equations, one thread per robot, with the
//! bits of the CPU.
//!
//! Robots live in their rows. A control step copies states and drives into columns, and each
//! morphology's block goes to the card, steps and comes back on its own queue, so that blocks step
//! side by side. Rows are written when all blocks are back: if the card is lost, the CPU's engine
//! makes the same step from them.

mod robots;

use std::sync::Arc;
use std::time::{Duration, Instant};

use polypod_cuda::{Card, Device, DeviceError, Found};

use super::{DivergenceRecord, Engine, EngineFactory, EngineSetup, RobotSlices, Run};
use crate::blocks::{Block, BlockList, BlockSizes};
use crate::dynamics::{HeightGrid, Parameters, StepSettings};
use crate::error::Error;
use crate::workers::{Workers, packs_of};
use robots::Robots;

/// Folders of Python packages, in which `cuda` looks for torch's NVRTC; the first call counts.
pub use polypod_cuda::search_packages;

/// Whether the engine `cuda` can be used here, and why not: one line.
pub fn describe_card() -> String {
    match polypod_cuda::find() {
        Ok(Found { name, driver, memory }) => format!(
            "{name}, {} GB, driver for CUDA {}.{}; tasks use it with physics.engine=cuda",
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

/// Makes engines that step on a device. Built in as `cuda`, for NVIDIA cards.
pub struct OnDevice(Box<Open>);

impl OnDevice {
    /// Engines on a device that `open` opens when a simulation is made.
    pub fn new(open: impl Fn() -> Result<Arc<dyn Device>, DeviceError> + Send + Sync + 'static) -> Self {
        Self(Box::new(open))
    }

    /// Engines on the first NVIDIA card.
    pub(super) fn card() -> Self {
        Self::new(|| Ok(Arc::new(Card::open(std::env::var_os(TIMES).is_some())?)))
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
        let refused = |error: DeviceError| Error::argument("physics.engine", error.to_string(), error.remedy());
        let device = (self.0)().map_err(refused)?;
        let (settings, terrain) = (setup.step_settings(setup.plane()), setup.ground.terrain.clone());
        let (mut robots, mut first_env) = (Vec::new(), 0);
        for (morphology, &count) in setup.morphologies.iter().zip(&setup.blocks.0) {
            if count > 0 {
                let made = Robots::new(&*device, morphology, &settings, terrain.as_deref(), first_env, count);
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
        let timed = std::env::var_os(TIMES).is_some();
        let engine = DeviceEngine {
            on_cpu: setup.make_articulated()?,
            device: Some(device),
            settings,
            terrain,
            robots,
            order,
            times: timed.then(Times::default),
        };
        Ok(Box::new(engine))
    }
}

/// Steps on a device; on the CPU if the device is lost.
struct DeviceEngine {
    /// The engine with the same bits, which goes on where the device is lost.
    on_cpu: Box<dyn Engine>,
    /// Absent once it is lost.
    device: Option<Arc<dyn Device>>,
    settings: StepSettings,
    terrain: Option<Arc<HeightGrid>>,
    /// Robots of each morphology that has some.
    robots: Vec<Robots>,
    /// Places in `robots` in the order in which their steps begin.
    order: Vec<usize>,
    times: Option<Times>,
}

impl DeviceEngine {
    /// Steps all blocks on the device. The rows are unchanged.
    fn step_on_device(&mut self, workers: &Workers, blocks: &mut [Block<RobotSlices<'_>>]) -> Result<(), DeviceError> {
        let Self { device: Some(device), settings, terrain, robots, order, times, .. } = self else { return Ok(()) };
        let begun = Instant::now();
        for &place in &*order {
            let (robots, block) = (&mut robots[place], &mut blocks[place]);
            robots.start(&**device, settings, terrain.as_deref(), workers, &mut block.rows)?;
        }
        let started = Instant::now();
        for &place in &*order {
            let (robots, block) = (&mut robots[place], &mut blocks[place]);
            robots.finish(&**device, settings, terrain.as_deref(), workers, &mut block.rows)?;
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

impl Engine for DeviceEngine {
    fn upload(&mut self, env: usize, parameters: &Parameters<f32>) {
        self.on_cpu.upload(env, parameters);
        if self.device.is_some() {
            let place = self.robots.partition_point(|robots| robots.envs().end <= env);
            if let Some(robots) = self.robots.get_mut(place) {
                robots.upload(env, parameters);
            }
        }
    }

    fn step(&mut self, workers: &Workers, robots: BlockList<RobotSlices<'_>>, run: Run) -> Vec<DivergenceRecord> {
        if self.device.is_none() || !run.gains || run.steps != self.settings.decimation {
            return self.on_cpu.step(workers, robots, run);
        }
        let mut blocks: Vec<Block<RobotSlices>> = robots.into_iter().collect();
        if let Err(error) = self.step_on_device(workers, &mut blocks) {
            tracing::warn!(
                "physics.engine: the card failed ({error}); the simulation goes on from the last control step with the \
                 engine articulated, on the CPU and with the same bits"
            );
            self.device = None;
            self.robots.clear();
            return self.on_cpu.step(workers, BlockList::new(blocks.into_iter()), run);
        }
        let begun = Instant::now();
        let mut found = Vec::new();
        for (robots, block) in self.robots.iter_mut().zip(&mut blocks) {
            let morphology = usize::from(block.morphology.0);
            let limits = run.watched[morphology].then_some(run.limits);
            found.extend(robots.write_rows(workers, &mut block.rows, morphology, limits));
        }
        if let Some(times) = &mut self.times {
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
