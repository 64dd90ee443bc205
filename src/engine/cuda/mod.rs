//! The articulated engine on an NVIDIA card: the same equations, one thread per robot, with the
//! bits of the CPU.
//!
//! Robots live in their components. A control step copies states and drives into rows in pinned
//! memory, and one launch steps the robots of all morphologies. The components of a morphology are
//! written when all its robots are back: if the card is lost, the CPU's engine makes the same step
//! of the others.

mod robots;
mod trial;
mod whole;

use std::sync::Arc;
use std::time::{Duration, Instant};

use polypod_cuda::update::{Update, UpdateCard};
use polypod_cuda::{Card, Device, DeviceError, Found, Heights};
use polypod_learner::UpdateDevice;

use super::{DivergenceRecord, Engine, EngineFactory, EngineSetup, RobotSlices, Run};
use crate::blocks::{Block, BlockList, BlockSizes};
use crate::dynamics::{Parameters, StepSettings};
use crate::error::Error;
use crate::workers::{Workers, packs_of};
use robots::{Means, Pair, Robots};
use trial::Trial;
pub use whole::{BrokenRobot, WholeSteps};

/// Folders of Python packages, in which `cuda` looks for its kernels and for torch's NVRTC; the
/// first call counts.
pub use polypod_cuda::search_packages;

/// Whether the engine `cuda` can be used here, and why not: one line.
pub fn describe_card() -> String {
    match polypod_cuda::find() {
        Ok(Found { name, driver, memory }) => format!(
            "{name}, {} GB, driver for CUDA {}.{}; its kernels {}; tasks use it with physics.engine=cuda, and alone \
             or next to the CPU, where that is faster, with physics.engine=auto",
            memory >> 30,
            driver / 1000,
            driver % 1000 / 10,
            if polypod_cuda::are_kernels_shipped() { "are in the package" } else { "are compiled once" }
        ),
        Err(error) => format!("not used: {error}; {}", error.remedy()),
    }
}

/// The first NVIDIA card, for the updates of a learner: see [`Learner::use_device`].
///
/// # Errors
/// No driver, card or compiler, or too old ones.
///
/// [`Learner::use_device`]: crate::learner::Learner::use_device
pub fn open_update_card() -> Result<Box<dyn UpdateDevice>, Error> {
    let refused =
        |error: DeviceError| Error::argument("card", error.to_string(), "learn on the CPU, with the same bits");
    Ok(Box::new(Update::new(UpdateCard::open().map_err(refused)?)))
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

    /// Engines that share the robots between a device and the CPU as is fastest: shares take turns
    /// in the first steps. All have the same bits. Where there is no device, the CPU steps.
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
        device.prepare(setup.blocks.num_envs()).map_err(refused)?;
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
            on_device: placed.as_ref().map_or(0, |placed| placed.robots.len()),
            trial: placed.as_ref().filter(|_| self.if_faster).map(|placed| Trial::new(placed.shares())),
            placed,
            shares: self.if_faster,
            waits: false,
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

/// Steps robots on a device, and the others on the CPU; all on the CPU if the device is lost or
/// slower.
struct DeviceEngine {
    /// The engine with the same bits, which goes on where the device is lost.
    on_cpu: Box<dyn Engine>,
    /// Absent once the device is lost, or where the CPU alone is faster.
    placed: Option<Placed>,
    /// Number of morphologies whose robots the device steps, the last ones of [`Placed::order`].
    on_device: usize,
    /// While it is not known which number is the fastest.
    trial: Option<Trial>,
    /// Whether the CPU may take a share.
    shares: bool,
    /// Whether it takes all robots, until it is known whether whole steps on the device are faster.
    waits: bool,
    times: Option<Times>,
}

/// Shares of the robots that the device may take, eighths.
const SHARES: [usize; 5] = [0, 3, 5, 6, 8];

impl Placed {
    /// Numbers of morphologies, as [`DeviceEngine::on_device`] counts them, that make up the
    /// shares.
    fn shares(&self) -> Vec<usize> {
        let all: usize = self.robots.iter().map(|robots| robots.envs().len()).sum();
        let mut numbers: Vec<usize> = SHARES.iter().map(|share| self.number_of(all * share / 8)).collect();
        numbers.dedup();
        numbers
    }

    /// The least number of morphologies with that many robots.
    fn number_of(&self, wanted: usize) -> usize {
        let mut robots = 0;
        let sums = self.order.iter().rev().map(|&place| {
            robots += self.robots[place].envs().len();
            robots
        });
        if wanted == 0 { 0 } else { 1 + sums.take_while(|&sum| sum < wanted).count() }
    }
}

/// Robots that the device steps, with their components.
type Taken<'a, 'b> = Vec<(&'a mut Robots, Block<RobotSlices<'b>>)>;

fn pairs<'a, 'b>(taken: &'a mut Taken<'_, 'b>) -> Vec<Pair<'a, 'b>> {
    taken.iter_mut().map(|(robots, block)| (&mut **robots, block)).collect()
}

/// Begins a control step of robots on the device.
fn begin(means: &Means<'_>, taken: &mut Taken<'_, '_>) -> Result<(), DeviceError> {
    robots::read_rows(means.workers, pairs(taken));
    for (robots, block) in taken {
        robots.start(means, block)?;
    }
    means.device.launch()
}

/// Waits for the robots, and writes the components of those that are back while the others step.
/// Leaves in `taken` those whose components are as before, if the device fails. Returns the
/// records, and the time that writing took.
fn end(
    means: &Means<'_>,
    taken: &mut Taken<'_, '_>,
    run: &Run,
    found: &mut Vec<DivergenceRecord>,
) -> Result<Duration, DeviceError> {
    let mut writing = Duration::ZERO;
    while !taken.is_empty() {
        let done = taken.iter_mut().map(|(robots, block)| robots.is_done(means, block));
        let done: Vec<bool> = done.collect::<Result<_, _>>()?;
        if !done.contains(&true) {
            std::hint::spin_loop();
            continue;
        }
        let begun = Instant::now();
        let all = std::mem::take(taken).into_iter().zip(done);
        let (back, waiting): (Vec<_>, Vec<_>) = all.partition(|(_, done)| *done);
        *taken = waiting.into_iter().map(|(waiting, _)| waiting).collect();
        let mut back: Taken = back.into_iter().map(|(back, _)| back).collect();
        found.extend(robots::write_rows(means.workers, pairs(&mut back), run));
        writing += begun.elapsed();
    }
    Ok(writing)
}

impl DeviceEngine {
    /// Number of morphologies whose robots the device steps next.
    fn next_on_device(&mut self) -> usize {
        let Self { placed: Some(placed), on_device, trial, .. } = self else { return 0 };
        let Some(running) = trial else { return *on_device };
        // asking begins the preparations of all, side by side
        if placed.robots.iter_mut().map(Robots::is_ready).filter(|ready| !ready).count() > 0 {
            return 0;
        }
        let turn = running.next(Instant::now());
        let Some(verdict) = running.verdict() else { return turn };
        let of = |&(number, time): &(usize, Duration)| format!("{:.2} ms with {number}", 1e3 * time.as_secs_f64());
        let times: Vec<String> = verdict.times.iter().map(of).collect();
        tracing::info!(
            "physics.engine auto: of {} morphologies {} steps {}, and the CPU the others, with the same bits; a control \
             step takes {}",
            placed.robots.len(),
            placed.device.name(),
            verdict.best,
            times.join(", ")
        );
        *on_device = verdict.best;
        *trial = None;
        if verdict.best == 0 {
            self.placed = None;
        }
        self.on_device
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
        let may_start = self.placed.as_ref().is_some_and(whole) && !self.waits;
        let number = if may_start { self.next_on_device() } else { 0 };
        let Self { on_cpu, placed, times, .. } = self;
        let Some(Placed { device, settings, heights, robots: of_all, order }) = placed.as_mut().filter(|_| number > 0)
        else {
            return on_cpu.step(workers, robots, run);
        };
        let means = Means { device: &**device, settings, heights: heights.as_ref(), workers };
        let mut all: Vec<_> = of_all.iter_mut().zip(robots).map(Some).collect();
        let first = order.len().saturating_sub(number);
        let mut taken: Taken = order[first..].iter().filter_map(|&place| all[place].take()).collect();
        let of_cpu: Vec<_> = all.into_iter().flatten().map(|(_, block)| block).collect();
        let begun = Instant::now();
        let launched = begin(&means, &mut taken);
        let started = Instant::now();
        let mut found =
            if of_cpu.is_empty() { Vec::new() } else { on_cpu.step(workers, BlockList::new(of_cpu.into_iter()), run) };
        let stepped = Instant::now();
        let done = launched.and_then(|()| end(&means, &mut taken, &run, &mut found));
        match done {
            Ok(writing) => {
                if let Some(times) = times {
                    times.gather += started - begun;
                    times.on_cpu += stepped - started;
                    times.wait += stepped.elapsed().saturating_sub(writing);
                    times.scatter += writing;
                    times.steps += 1;
                    times.kernel += device.seconds().unwrap_or(0.0);
                }
            }
            Err(error) => {
                tracing::warn!(
                    "physics.engine: the card failed ({error}); the simulation goes on from the last control step with the \
                 engine articulated, on the CPU and with the same bits"
                );
                let mut blocks: Vec<_> = taken.into_iter().map(|(_, block)| block).collect();
                blocks.sort_by_key(|block| block.envs.start);
                found.extend(on_cpu.step(workers, BlockList::new(blocks.into_iter()), run));
                *placed = None;
            }
        }
        found.sort_by_key(|record| record.env);
        found
    }

    fn whole_steps(&mut self) -> Option<&mut dyn WholeSteps> {
        self.placed.is_some().then_some(self)
    }
}

/// Times of the parts of the steps.
#[derive(Default)]
struct Times {
    steps: u32,
    /// Components into rows, and the launch.
    gather: Duration,
    /// Robots of the CPU.
    on_cpu: Duration,
    /// For the device, beyond that.
    wait: Duration,
    /// Rows into components.
    scatter: Duration,
    /// Kernels, s.
    kernel: f64,
}

impl Drop for Times {
    fn drop(&mut self) {
        let ms = |seconds: f64| 1e3 * seconds / f64::from(self.steps.max(1));
        let [gather, on_cpu, wait, scatter] =
            [self.gather, self.on_cpu, self.wait, self.scatter].map(|time| ms(time.as_secs_f64()));
        let kernel = ms(self.kernel);
        eprintln!(
            "physics.engine cuda: {} steps; ms a step: components into rows {gather:.3}, robots of the CPU \
             {on_cpu:.3}, waiting {wait:.3}, rows into components {scatter:.3}; kernels {kernel:.3}",
            self.steps
        );
    }
}
