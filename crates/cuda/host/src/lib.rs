//! The text of the device (`crates/cuda/device`), compiled as C for the host: what tests compare
//! with the kernels where there is no GPU.

#![warn(missing_docs)]
#![allow(unsafe_code, reason = "the border to C")]

mod update;

use std::cell::UnsafeCell;
use std::ffi::c_int;
use std::ops::Range;
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::{env, fs, io};

use libloading::Library;
use polypod_cuda::{
    Block, DEVICE_TEXT, Device, DeviceBlock, DeviceError, DeviceRows, EnvBlock, EnvHost, EnvParts, Exchange, Parts,
    RowSizes, RowsMemory, RowsOf, Shape, Tables, TaskTables, Told,
};

pub use update::UpdateHost;

/// `Block` of `device/block.h`.
#[repr(C)]
struct Arguments {
    integers: *const c_int,
    numbers: *const f32,
    parameters: *const f32,
    common: *const f32,
    drive: *mut f32,
    state: *mut f32,
    report: *mut f32,
    host: *mut f32,
    grid: *const f32,
    work: *mut f32,
    work_integers: *mut c_int,
    ended: *mut u32,
    done: *mut u32,
    robots: c_int,
    own: u32,
    capacity: c_int,
    first: c_int,
    end: c_int,
    warp: c_int,
    number: c_int,
}

/// `EnvBlock` of `device/env.cu`.
#[repr(C)]
struct EnvArguments {
    block: Arguments,
    task: *const c_int,
    task_numbers: *const f32,
    columns: *mut f32,
    words: *mut u32,
    actions: *mut f32,
    observations: *mut f32,
    finals: *mut f32,
    rewards: *mut f32,
    commands: *mut f32,
    terminated: *mut u8,
    truncated: *mut u8,
    kept: *mut f32,
    given: *const f32,
    host_observations: *mut f32,
    host_finals: *mut f32,
    host_rewards: *mut f32,
    host_commands: *mut f32,
    flags: *mut u32,
    ended: *mut u32,
    ended_size: c_int,
    warp: c_int,
}

type Step = unsafe extern "C" fn(*const Arguments);

unsafe extern "C" {
    fn polypod_control_step(block: *const Arguments);
    fn polypod_env_step(envs: *const EnvArguments, after: c_int);
    #[cfg(target_os = "linux")]
    fn polypod_control_step_by_threads(block: *const Arguments);
}

/// The text of one morphology, in which all sizes are constants.
pub struct OwnText(Library);

impl OwnText {
    /// Compiles it.
    ///
    /// # Errors
    /// No compiler for C, or one that refuses the text.
    pub fn compile(tables: &Tables) -> io::Result<Self> {
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let name = format!("polypod-cuda-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let folder = env::temp_dir().join(name);
        fs::create_dir_all(&folder)?;
        let header = tables.header().ok_or_else(|| io::Error::other("a number of the tables is not finite"))?;
        for (name, text) in DEVICE_TEXT.into_iter().chain([("morphology.h", header.as_str())]) {
            fs::write(folder.join(name), text)?;
        }
        let compiler = env::var_os("CC").unwrap_or_else(|| "cc".into());
        let mut command = Command::new(compiler);
        command.args(["-xc", "-std=c11", "-O1", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared"]);
        #[cfg(target_arch = "x86_64")]
        if std::is_x86_feature_detected!("fma") {
            command.arg("-mfma");
        }
        let library = folder.join("step.so");
        let done = command.arg("-DPOLYPOD_TABLES").arg(folder.join("step.cu")).args(["-lm", "-o"]).arg(&library);
        let done = done.output()?;
        if !done.status.success() {
            return Err(io::Error::other(String::from_utf8_lossy(&done.stderr).into_owned()));
        }
        // SAFETY: the library is the text, which has no initialisers
        let library = unsafe { Library::new(&library) }.map_err(io::Error::other)?;
        fs::remove_dir_all(&folder)?;
        Ok(Self(library))
    }

    /// Makes the step of [`step_on_host`] with this text. The block must have the tables that the
    /// text was compiled for.
    pub fn step(&self, block: &mut Block, substeps: Range<usize>) -> bool {
        // SAFETY: the text has this function
        unsafe { self.0.get::<Step>(b"polypod_control_step\0") }.is_ok_and(|step| step_with(*step, block, substeps))
    }
}

/// Makes some physics steps of a control step on the host. Returns whether it could: the
/// steps must be of the control step, and the robots must have parameters.
pub fn step_on_host(block: &mut Block, substeps: Range<usize>) -> bool {
    step_with(polypod_control_step, block, substeps)
}

/// As [`step_on_host`], with several threads for each robot, as on a card. They are coroutines,
/// which go on in random order from where they met.
#[cfg(target_os = "linux")]
pub fn step_by_threads(block: &mut Block, substeps: Range<usize>) -> bool {
    step_with(polypod_control_step_by_threads, block, substeps)
}

/// Makes the step of [`step_on_host`]; other machines have no coroutines.
#[cfg(not(target_os = "linux"))]
pub fn step_by_threads(block: &mut Block, substeps: Range<usize>) -> bool {
    step_on_host(block, substeps)
}

/// The arguments of some physics steps; `None` where these are none of a control step, or the
/// robots have no parameters.
fn arguments(block: &mut Block, substeps: Range<usize>) -> Option<Arguments> {
    let whole = |x: usize| c_int::try_from(x).ok();
    let (first, end) = (whole(substeps.start)?, whole(substeps.end)?);
    let (robots, capacity) = (whole(block.robots())?, whole(block.shape().capacity)?);
    if !block.may_step(&substeps) {
        return None;
    }
    let Parts { integers, numbers, parameters, common, drive, state, report, grid, work, work_integers, own, .. } =
        block.parts();
    Some(Arguments {
        integers: integers.as_ptr(),
        numbers: numbers.as_ptr(),
        parameters: parameters.as_ptr(),
        common: common.as_ptr(),
        drive: drive.as_mut_ptr(),
        state: state.as_mut_ptr(),
        report: report.as_mut_ptr(),
        host: std::ptr::null_mut(),
        grid: grid.as_ptr(),
        work: work.as_mut_ptr(),
        work_integers: work_integers.as_mut_ptr(),
        ended: std::ptr::null_mut(),
        done: std::ptr::null_mut(),
        robots,
        own,
        capacity,
        first,
        end,
        warp: 0,
        number: 0,
    })
}

fn step_with(step: Step, block: &mut Block, substeps: Range<usize>) -> bool {
    let Some(arguments) = arguments(block, substeps) else { return false };
    // SAFETY: the arrays have the sizes of the tables' columns, which bound every index of the
    // text; it keeps no pointer
    unsafe { step(&raw const arguments) };
    true
}

/// Arrays of all envs.
struct Rows {
    sizes: RowSizes,
    numbers: UnsafeCell<Vec<f32>>,
    ends: UnsafeCell<Vec<u8>>,
}

// SAFETY: steps of the blocks use different rows, and nobody reads or writes during a step
unsafe impl Sync for Rows {}

impl RowsMemory for Rows {}

impl Rows {
    /// The address of the row of an env in an array.
    fn row(&self, of: RowsOf, env: usize) -> *mut f32 {
        let part = self.sizes.part(of);
        let width = part.len() / self.sizes.envs.max(1);
        // SAFETY: nobody else uses the list itself, and the place is within its numbers
        unsafe { (*self.numbers.get()).as_mut_ptr().add(part.start + width * env) }
    }

    /// The address of the flag of an env: whether its episode failed.
    fn end(&self, env: usize) -> *mut u8 {
        // SAFETY: as above
        unsafe { (*self.ends.get()).as_mut_ptr().add(env) }
    }
}

/// The arrays of the present simulation, which its blocks share.
type SharedRows = Arc<Mutex<Option<Arc<Rows>>>>;

fn rows_of(shared: &SharedRows) -> Result<Arc<Rows>, DeviceError> {
    shared.lock().unwrap_or_else(PoisonError::into_inner).clone().ok_or_else(DeviceError::no_envs)
}

/// Envs of a block in the memory of the host.
struct Envs {
    task: TaskTables,
    first: usize,
    /// Columns and words that a card has in its own memory.
    columns: Vec<f32>,
    words: Vec<u32>,
    /// The host's side.
    host_numbers: Vec<f32>,
    host_words: Vec<u32>,
    /// Rows of robots that are watched; empty if none is.
    kept: Vec<f32>,
}

impl Envs {
    fn new(task: TaskTables, first: usize, robots: usize) -> Self {
        let ([columns, words], [host_numbers, host_words]) =
            (task.parts(robots).of_device(), task.parts(robots).of_host());
        Self {
            task,
            first,
            columns: vec![0.0; columns],
            words: vec![0; words],
            host_numbers: vec![0.0; host_numbers],
            host_words: vec![0; host_words],
            kept: Vec::new(),
        }
    }

    /// Makes a whole control step.
    fn step(&mut self, block: &mut Block, rows: &Rows, slot: Option<usize>) -> bool {
        let (robots, steps) = (block.robots(), 0..block.shape().decimation());
        let Some(of_block) = arguments(block, steps) else { return false };
        let Self { task, first, columns, words, host_numbers, host_words, kept } = self;
        let parts = task.parts(robots);
        let mut place = |part: usize| host_numbers[parts.numbers[part].clone()].as_mut_ptr();
        let actions = place(1);
        let mut shown = |part: usize| slot.map_or_else(|| place(part), |_| std::ptr::null_mut());
        let [flags, ended] = parts.of_slot(slot.unwrap_or(0));
        let mut word = |part: Range<usize>| host_words[part].as_mut_ptr();
        let row = |of: RowsOf| rows.row(of, *first);
        let arguments = EnvArguments {
            block: of_block,
            task: task.integers.as_ptr(),
            task_numbers: task.numbers.as_ptr(),
            columns: columns.as_mut_ptr(),
            words: words.as_mut_ptr(),
            actions: row(RowsOf::Actions),
            observations: row(RowsOf::Observations),
            finals: row(RowsOf::Finals),
            rewards: row(RowsOf::Rewards),
            commands: row(RowsOf::Commands),
            terminated: rows.end(*first),
            truncated: rows.end(rows.sizes.envs + *first),
            kept: if kept.is_empty() { std::ptr::null_mut() } else { kept.as_mut_ptr() },
            given: slot.map_or(actions, |_| row(RowsOf::Given)),
            host_observations: shown(2),
            host_finals: shown(3),
            host_rewards: shown(4),
            host_commands: shown(5),
            flags: word(flags),
            ended: word(ended),
            ended_size: task.widths[2] as c_int,
            warp: 0,
        };
        // SAFETY: the arrays have the sizes of the tables' lists and columns, which bound every
        // index of the text; it keeps no pointer
        unsafe {
            polypod_env_step(&raw const arguments, 0);
            polypod_control_step(&raw const arguments.block);
            polypod_env_step(&raw const arguments, 1);
        }
        true
    }
}

/// The host as a device: the engine's path without a GPU.
#[derive(Clone, Default)]
pub struct Host(SharedRows);

impl Host {
    /// The flags of ended episodes: whether they failed, then whether they ran out of time.
    ///
    /// # Errors
    /// There are no envs.
    pub fn ends(&self) -> Result<Vec<bool>, DeviceError> {
        let rows = rows_of(&self.0)?;
        // SAFETY: the array is that long, and no step runs
        let ends = unsafe { std::slice::from_raw_parts(rows.end(0), 2 * rows.sizes.envs) };
        Ok(ends.iter().map(|&ended| ended != 0).collect())
    }
}

impl Device for Host {
    fn name(&self) -> &str {
        "host"
    }

    fn allocate(&self, shape: Shape) -> Result<Box<dyn DeviceBlock>, DeviceError> {
        Ok(Box::new(HostBlock(Block::of_shape(shape), None, self.0.clone())))
    }

    fn place_rows(&self, sizes: RowSizes) -> Result<(), DeviceError> {
        let mut rows = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if rows.as_ref().is_none_or(|rows| rows.sizes != sizes) {
            let numbers = vec![0.0; sizes.numbers()].into();
            *rows = Some(Arc::new(Rows { sizes, numbers, ends: vec![0; 2 * sizes.envs].into() }));
        }
        Ok(())
    }

    fn rows(&self) -> Option<DeviceRows> {
        let rows = rows_of(&self.0).ok()?;
        let (numbers, ends) = (rows.row(RowsOf::Given, 0), rows.end(0));
        let [numbers, ends] = [numbers.expose_provenance(), ends.expose_provenance()].map(|address| address as u64);
        Some(DeviceRows { sizes: rows.sizes, card: None, numbers, ends, memory: rows })
    }

    fn read_rows(&self, of: RowsOf, to: &mut [f32]) -> Result<(), DeviceError> {
        let rows = rows_of(&self.0)?;
        // SAFETY: the array is that long, and no step runs
        to.copy_from_slice(unsafe { std::slice::from_raw_parts(rows.row(of, 0), rows.sizes.part(of).len()) });
        Ok(())
    }

    fn write_rows(&self, of: RowsOf, from: &[f32]) -> Result<(), DeviceError> {
        let rows = rows_of(&self.0)?;
        // SAFETY: as above
        unsafe { std::slice::from_raw_parts_mut(rows.row(of, 0), rows.sizes.part(of).len()) }.copy_from_slice(from);
        Ok(())
    }

    fn write_ends(&self, ends: &[u8]) -> Result<(), DeviceError> {
        let rows = rows_of(&self.0)?;
        // SAFETY: as above
        unsafe { std::slice::from_raw_parts_mut(rows.end(0), 2 * rows.sizes.envs) }.copy_from_slice(ends);
        Ok(())
    }
}

struct HostBlock(Block, Option<Envs>, SharedRows);

impl DeviceBlock for HostBlock {
    fn shape(&self) -> &Shape {
        self.0.shape()
    }

    fn exchange(&mut self) -> Exchange<'_> {
        self.0.exchange()
    }

    fn set_parameters(
        &mut self,
        common: &[f32],
        own: u32,
        tiles: &[f32],
        _changed: &[usize],
    ) -> Result<(), DeviceError> {
        self.0.set_parameters(common, own, tiles);
        Ok(())
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        let steps = 0..self.0.shape().decimation();
        let made = step_on_host(&mut self.0, steps);
        if made { Ok(()) } else { Err(DeviceError::Call { call: "step_on_host", text: "no parameters".into() }) }
    }

    fn contacts_if_done(&mut self) -> Result<Option<usize>, DeviceError> {
        let (robots, exchange) = (self.0.robots(), self.0.exchange());
        Ok((0..robots).map(|robot| exchange.num_impulses(robot)).max())
    }

    fn envs(&mut self) -> Option<&mut dyn EnvBlock> {
        Some(self)
    }
}

impl EnvBlock for HostBlock {
    fn place(&mut self, task: TaskTables, first: usize) -> Result<(), DeviceError> {
        self.1 = Some(Envs::new(task, first, self.0.robots()));
        Ok(())
    }

    fn host(&mut self) -> Option<EnvHost<'_>> {
        let Envs { task, host_numbers, host_words, .. } = self.1.as_mut()?;
        Some(EnvHost::new(task, self.0.robots(), host_numbers, host_words))
    }

    fn told(&mut self, slot: usize) -> Option<Told<'_>> {
        let Envs { task, host_words, .. } = self.1.as_mut()?;
        Some(Told::new(task, self.0.robots(), host_words, slot))
    }

    fn watch(&mut self, watched: bool) -> Result<(), DeviceError> {
        let size = self.0.shape().kept() * self.0.robots();
        if let Some(envs) = &mut self.1 {
            envs.kept.resize(if watched { size } else { 0 }, 0.0);
        }
        Ok(())
    }

    fn kept(&mut self, robot: usize) -> Result<Option<Vec<f32>>, DeviceError> {
        let size = self.0.shape().kept();
        let rows = self.1.as_ref().and_then(|envs| envs.kept.get(robot * size..(robot + 1) * size));
        Ok(rows.map(<[f32]>::to_vec))
    }

    fn upload(&mut self) -> Result<(), DeviceError> {
        if let Some(Envs { task, columns, words, host_numbers, host_words, .. }) = &mut self.1 {
            let EnvParts { numbers: parts, words: word_parts } = task.parts(self.0.robots());
            columns.copy_from_slice(&host_numbers[parts[0].clone()]);
            words.copy_from_slice(&host_words[word_parts[0].clone()]);
        }
        Ok(())
    }

    fn download(&mut self) -> Result<(), DeviceError> {
        if let Some(Envs { task, columns, words, host_numbers, host_words, .. }) = &mut self.1 {
            let EnvParts { numbers: parts, words: word_parts } = task.parts(self.0.robots());
            host_numbers[parts[0].clone()].copy_from_slice(columns);
            host_words[word_parts[0].clone()].copy_from_slice(words);
        }
        Ok(())
    }

    fn start(&mut self, slot: Option<usize>) -> Result<(), DeviceError> {
        let Self(block, envs, rows) = self;
        let rows = rows_of(rows)?;
        let made = envs.as_mut().is_some_and(|envs| envs.step(block, &rows, slot));
        if made { Ok(()) } else { Err(DeviceError::Call { call: "polypod_env_step", text: "no parameters".into() }) }
    }
}
