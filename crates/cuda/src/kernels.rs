//! Kernels of a card: a common one for all morphologies, and own ones of morphologies that step for
//! long.
//!
//! In an own kernel all sizes are constants. NVRTC compiles it in seconds, aside, while the common
//! kernel steps. Both give the same bits, so that it does not matter when one takes over.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::{self, JoinHandle};

use cudarc::driver::{CudaContext, CudaFunction};
use cudarc::nvrtc::Ptx;

use crate::device::DeviceError;
use crate::layout::THREADS_OF_FEW;
use crate::nvrtc;
use crate::tables::Tables;

/// Environment variable that says which kernels step: `own`, for which the first step waits, or
/// `ready`, where own ones take over when they are compiled. By default the common one steps.
const VARIABLE: &str = "POLYPOD_CUDA_KERNELS";
/// Name of the physics kernel.
const STEP: &str = "polypod_control_step";
/// Control steps of a block after which its own kernel is worth its compilation.
const WORTH: u32 = 50;
/// Most own kernels of an engine: each is some hundred kB of code.
const MOST: usize = 64;
/// Most kernels that are compiled at a time.
const MOST_AT_A_TIME: usize = 8;

/// The kernel of that name in a PTX.
fn load(context: &Arc<CudaContext>, ptx: String, name: &str) -> Result<CudaFunction, DeviceError> {
    let call = crate::driver::call;
    let module = context.load_module(Ptx::from_src(ptx)).map_err(call("cuModuleLoadData"))?;
    module.load_function(name).map_err(call("cuModuleGetFunction"))
}

/// An own kernel, once it is compiled; `None` where the common kernel steps instead.
pub(crate) type Own = Arc<OnceLock<Result<Option<CudaFunction>, DeviceError>>>;

/// Kernels that step: the common one, own ones that the first step waits for, or own ones from when
/// they are compiled.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Choice {
    Common,
    Own,
    WhenReady,
}

/// A kernel of a block.
pub(crate) struct Kernel {
    pub(crate) function: CudaFunction,
    pub(crate) is_common: bool,
    /// Threads that step a robot together.
    pub(crate) threads: usize,
}

/// Own kernels that wait for a thread, and the threads at work.
#[derive(Default)]
struct Work {
    waiting: VecDeque<(String, Own)>,
    running: usize,
}

/// The kernels of a card.
pub(crate) struct Kernels {
    context: Arc<CudaContext>,
    /// The common kernel, and the threads that step a robot together, once the number of robots is
    /// known.
    common: OnceLock<(CudaFunction, usize)>,
    /// The kernel of envs.
    envs: OnceLock<CudaFunction>,
    choice: Choice,
    /// Own kernels by the headers of their tables.
    known: Mutex<HashMap<String, Own>>,
    work: Arc<Mutex<Work>>,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

pub(crate) fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Kernels {
    /// Kernels of a card, which are read or compiled later.
    ///
    /// # Errors
    /// No compiler, and none shipped; another value of the variable.
    pub(crate) fn new(context: &Arc<CudaContext>) -> Result<Self, DeviceError> {
        let choice = match std::env::var(VARIABLE).as_deref() {
            Ok("own") => Choice::Own,
            Ok("ready") => Choice::WhenReady,
            Ok("common") | Err(_) => Choice::Common,
            Ok(other) => return Err(DeviceError::Kernels(other.to_owned())),
        };
        let are_there = choice == Choice::Common && nvrtc::are_kernels_shipped();
        if !are_there && !nvrtc::is_present() {
            return Err(DeviceError::NoCompiler);
        }
        Ok(Self {
            context: context.clone(),
            common: OnceLock::new(),
            envs: OnceLock::new(),
            choice,
            known: Mutex::default(),
            work: Arc::default(),
            threads: Mutex::default(),
        })
    }

    /// Compiles the common kernel for a number of robots. The first call counts.
    ///
    /// # Errors
    /// A compiler that refuses the text.
    pub(crate) fn prepare(&self, robots: usize) -> Result<usize, DeviceError> {
        if let Some((_, threads)) = self.common.get() {
            return Ok(*threads);
        }
        let threads = nvrtc::threads_of_robot(robots, self.choice == Choice::Own);
        let function = load(&self.context, nvrtc::compile(None, threads)?, STEP)?;
        Ok(self.common.get_or_init(|| (function, threads)).1)
    }

    /// The kernel of envs, which is compiled in the first call.
    ///
    /// # Errors
    /// A compiler that refuses the text.
    pub(crate) fn of_envs(&self) -> Result<CudaFunction, DeviceError> {
        if let Some(function) = self.envs.get() {
            return Ok(function.clone());
        }
        let function = load(&self.context, nvrtc::compile_envs(self.prepare(1)?)?, "polypod_env_step")?;
        Ok(self.envs.get_or_init(|| function).clone())
    }

    /// The own kernel of a new block, where the first step waits for it: those of all blocks are
    /// compiled at the same time.
    pub(crate) fn of_new_block(&self, tables: &Tables) -> Option<Own> {
        (self.choice == Choice::Own).then(|| self.request(tables))
    }

    /// The kernel for a block that has made some steps; `own` remembers the block's own one.
    ///
    /// # Errors
    /// The own kernel does not compile, where the step must wait for it.
    pub(crate) fn for_step(&self, tables: &Tables, own: &mut Option<Own>, steps: u32) -> Result<Kernel, DeviceError> {
        let threads = self.prepare(1)?;
        let (function, _) = self.common.get().ok_or(DeviceError::NoCompiler)?;
        let common = || Kernel { function: function.clone(), is_common: true, threads };
        if self.choice == Choice::Common || (steps < WORTH && self.choice == Choice::WhenReady && own.is_none()) {
            return Ok(common());
        }
        let own = own.get_or_insert_with(|| self.request(tables));
        let found = match self.choice {
            Choice::Own => own.wait().clone()?,
            _ => own.get().and_then(|own| own.clone().ok().flatten()),
        };
        Ok(found.map_or_else(common, |function| Kernel { function, is_common: false, threads }))
    }

    /// Whether a block's own kernel is there, or will never be; asking for it begins its
    /// compilation.
    pub(crate) fn is_ready(&self, tables: &Tables, own: &mut Option<Own>) -> bool {
        self.choice == Choice::Common || own.get_or_insert_with(|| self.request(tables)).get().is_some()
    }

    /// The own kernel of some tables, which is compiled aside.
    fn request(&self, tables: &Tables) -> Own {
        let robot_threads = self.common.get().map_or(THREADS_OF_FEW, |(_, threads)| *threads);
        let mut known = locked(&self.known);
        let Some(header) = tables.header().filter(|header| known.len() < MOST || known.contains_key(header)) else {
            return Own::new(Ok(None).into());
        };
        if let Some(own) = known.get(&header) {
            return own.clone();
        }
        let own = Own::default();
        known.insert(header.clone(), own.clone());
        let mut work = locked(&self.work);
        work.waiting.push_back((header, own.clone()));
        let cores = thread::available_parallelism().map_or(1, usize::from);
        if work.running < (cores / 2).clamp(1, MOST_AT_A_TIME) {
            work.running += 1;
            drop(work);
            drop(known);
            let (context, work) = (self.context.clone(), self.work.clone());
            let spawned = thread::Builder::new().spawn(move || compile_waiting(&context, &work, robot_threads));
            match spawned {
                Ok(thread) => locked(&self.threads).push(thread),
                // without a further thread the caller compiles
                Err(_) => compile_waiting(&self.context, &self.work, robot_threads),
            }
        }
        own
    }
}

/// Compiles own kernels until none waits.
fn compile_waiting(context: &Arc<CudaContext>, work: &Mutex<Work>, threads: usize) {
    loop {
        let mut all = locked(work);
        let Some((header, own)) = all.waiting.pop_front() else {
            all.running -= 1;
            return;
        };
        drop(all);
        let compile = || nvrtc::compile(Some(&header), threads).and_then(|ptx| load(context, ptx, STEP)).map(Some);
        // a step may wait for the outcome, whatever it is
        let made = std::panic::catch_unwind(std::panic::AssertUnwindSafe(compile));
        let made = made.unwrap_or_else(|_| Err(DeviceError::Compiler("the thread that compiles panicked".into())));
        let _ = own.set(made);
    }
}

impl Drop for Kernels {
    fn drop(&mut self) {
        locked(&self.work).waiting.clear();
        // NVRTC must not work while the process ends
        for thread in locked(&self.threads).drain(..) {
            let _ = thread.join();
        }
    }
}
