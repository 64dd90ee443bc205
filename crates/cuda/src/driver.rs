//! An NVIDIA card, through its driver, which is loaded at run time.
#![allow(unsafe_code, reason = "the border to the driver")]

use std::ffi::c_int;
use std::ops::Range;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

use cudarc::driver::sys::{CUdeviceptr, CUevent_flags, CUresult};
use cudarc::driver::{
    CudaContext, CudaEvent, CudaFunction, CudaSlice, CudaStream, DevicePtr, DriverError, LaunchConfig, PushKernelArg,
    result, sys,
};

use crate::columns::{Exchange, Shape};
use crate::device::{Device, DeviceBlock, DeviceError, EnvBlock};
use crate::envs::{DeviceRows, EnvHost, EnvParts, Flow, RowSizes, RowsMemory, RowsOf, SLOTS, TaskTables, Told};
use crate::kernels::{Kernel, Kernels, Own, locked};
use crate::nvrtc;

/// The first version of CUDA whose drivers have all functions that are called here.
const OLDEST_CUDA: i32 = 11040;
/// The first generation of cards that the text is compiled for.
const OLDEST_CAPABILITY: (i32, i32) = (8, 0);
/// Threads of a warp, which are a block of the kernel.
const THREADS: usize = 32;
/// Warps of a block of the kernel of envs.
const WARPS_OF_ENVS: usize = 2;
/// Looks at a number in the host's memory for each question to the driver, which is slow and knows
/// whether the card is lost.
const POLLS_OF_CARD: u32 = 1 << 12;
/// Bytes that the context and the kernel take beyond the robots' memory.
const RESERVED: usize = 64 << 20;

/// `Block` of `device/block.h`.
#[derive(Clone, Copy)]
#[repr(C)]
struct Arguments {
    integers: CUdeviceptr,
    numbers: CUdeviceptr,
    parameters: CUdeviceptr,
    common: CUdeviceptr,
    drive: CUdeviceptr,
    state: CUdeviceptr,
    report: CUdeviceptr,
    host: CUdeviceptr,
    grid: CUdeviceptr,
    work: CUdeviceptr,
    work_integers: CUdeviceptr,
    ended: CUdeviceptr,
    done: CUdeviceptr,
    robots: c_int,
    own: u32,
    capacity: c_int,
    first: c_int,
    end: c_int,
    warp: c_int,
    number: c_int,
}

/// `EnvBlock` of `device/env.cu`.
#[derive(Clone, Copy)]
#[repr(C)]
struct EnvArguments {
    block: Arguments,
    task: CUdeviceptr,
    task_numbers: CUdeviceptr,
    columns: CUdeviceptr,
    words: CUdeviceptr,
    actions: CUdeviceptr,
    observations: CUdeviceptr,
    finals: CUdeviceptr,
    rewards: CUdeviceptr,
    commands: CUdeviceptr,
    terminated: CUdeviceptr,
    truncated: CUdeviceptr,
    kept: CUdeviceptr,
    given: CUdeviceptr,
    host_observations: CUdeviceptr,
    host_finals: CUdeviceptr,
    host_rewards: CUdeviceptr,
    host_commands: CUdeviceptr,
    flags: CUdeviceptr,
    ended: CUdeviceptr,
    ended_size: c_int,
    warp: c_int,
}

pub(crate) fn call(call: &'static str) -> impl Fn(DriverError) -> DeviceError {
    move |error| {
        let text = error.error_string().map(|text| text.to_string_lossy().into_owned());
        DeviceError::Call { call, text: text.unwrap_or_else(|_| format!("error {:?}", error.0)) }
    }
}

/// A card that the engine may use.
#[derive(Clone, Debug)]
pub struct Found {
    /// Name of the card.
    pub name: String,
    /// Version of CUDA that the driver knows, `1000 * major + 10 * minor`.
    pub driver: i32,
    /// Memory, bytes.
    pub memory: usize,
}

pub(crate) fn context() -> Result<(Arc<CudaContext>, Found), DeviceError> {
    // SAFETY: the driver's library has no initialisers that depend on this process
    if !unsafe { sys::is_culib_present() } {
        return Err(DeviceError::NoDriver);
    }
    let mut driver = 0;
    // SAFETY: every driver has this function, and it writes the number
    unsafe { sys::cuDriverGetVersion(&raw mut driver) }.result().map_err(call("cuDriverGetVersion"))?;
    if driver < OLDEST_CUDA {
        return Err(DeviceError::OldDriver(driver, OLDEST_CUDA));
    }
    let none = |error: DriverError| match call("cuInit")(error) {
        DeviceError::Call { text, .. } => DeviceError::NoCard(text),
        other => other,
    };
    let count = CudaContext::device_count().map_err(none)?;
    // processes of one training have a card each
    let rank = std::env::var("LOCAL_RANK").ok().and_then(|rank| rank.parse::<usize>().ok()).unwrap_or(0);
    let count = usize::try_from(count).unwrap_or(0);
    if count == 0 {
        return Err(DeviceError::NoCard("no device".into()));
    }
    let context = CudaContext::new(rank % count).map_err(none)?;
    let name = context.name().map_err(call("cuDeviceGetName"))?;
    let capability = context.compute_capability().map_err(call("cuDeviceGetAttribute"))?;
    if capability < OLDEST_CAPABILITY {
        return Err(DeviceError::OldCard { name, capability });
    }
    let memory = context.total_mem().map_err(call("cuDeviceTotalMem"))?;
    Ok((context, Found { name, driver, memory }))
}

/// The card that the engine would use.
///
/// # Errors
/// Why it would not.
pub fn find() -> Result<Found, DeviceError> {
    let (_, found) = context()?;
    if !nvrtc::is_present() {
        return Err(DeviceError::NoCompiler);
    }
    Ok(found)
}

/// A card with the compiled text.
pub struct Card {
    context: Arc<CudaContext>,
    kernels: Arc<Kernels>,
    name: String,
    queue: Arc<Queue>,
    /// The ground that was placed last, which all blocks share.
    ground: Mutex<Option<(Arc<[f32]>, Arc<CudaSlice<f32>>)>>,
}

/// The control steps of all blocks. One launch of the common kernel takes all its blocks, so that
/// the card is full and the host calls the driver once.
struct Queue {
    stream: Arc<CudaStream>,
    launch: Mutex<Launch>,
    env_launch: Mutex<EnvLaunch>,
    /// Arrays of all envs.
    rows: Mutex<Option<Arc<Rows>>>,
    /// The caller's work before a control step that flows, and the end of the step of each slot.
    flow: [CudaEvent; 1 + SLOTS],
    /// Streams of own kernels, which step side by side.
    others: Mutex<Vec<Arc<CudaStream>>>,
    /// Before and after a launch, where steps are measured.
    events: Option<[CudaEvent; 2]>,
}

/// Blocks that wait for a launch.
#[derive(Default)]
struct Launch {
    waiting: Vec<(Kernel, Arguments)>,
    /// Arguments of the launches that run, which the card reads from the host's memory.
    arguments: Option<Pinned<Arguments>>,
}

/// Blocks that wait for a whole control step.
#[derive(Default)]
struct EnvLaunch {
    waiting: Vec<(Kernel, EnvArguments)>,
    /// Arguments of the launches that run, by slots, which the card reads from the host's memory.
    envs: [Option<Pinned<EnvArguments>>; SLOTS],
    robots: [Option<Pinned<Arguments>>; SLOTS],
}

/// Arrays of all envs in the card's memory.
struct Rows {
    sizes: RowSizes,
    numbers: CudaSlice<f32>,
    /// Whether episodes failed, and whether they ran out of time.
    ends: CudaSlice<u8>,
    /// The stream of all steps.
    stream: Arc<CudaStream>,
}

impl RowsMemory for Rows {
    fn let_wait(&self, stream: u64) -> Result<(), DeviceError> {
        let event = self.stream.record_event(None).map_err(call("cuEventRecord"))?;
        wait_for_event(stream, &event)
    }
}

/// Lets a caller's stream wait for an event.
fn wait_for_event(stream: u64, event: &CudaEvent) -> Result<(), DeviceError> {
    let flags = sys::CUevent_wait_flags::CU_EVENT_WAIT_DEFAULT;
    event.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
    // SAFETY: the caller promises that the stream lives
    unsafe { result::stream::wait_event(caller(stream), event.cu_event(), flags) }.map_err(call("cuStreamWaitEvent"))
}

impl Card {
    /// Opens the card. `timed`: launches are measured.
    ///
    /// # Errors
    /// No driver or card, or too old ones; no compiler.
    pub fn open(timed: bool) -> Result<Self, DeviceError> {
        let (context, Found { name, .. }) = context()?;
        // SAFETY: one stream orders all work on the blocks' memory
        unsafe { context.disable_event_tracking() };
        let kernels = Arc::new(Kernels::new(&context)?);
        let event = || context.new_event(Some(CUevent_flags::CU_EVENT_DEFAULT)).map_err(call("cuEventCreate"));
        let events = if timed { Some([event()?, event()?]) } else { None };
        let stream = context.new_stream().map_err(call("cuStreamCreate"))?;
        let mark = || context.new_event(Some(CUevent_flags::CU_EVENT_DISABLE_TIMING)).map_err(call("cuEventCreate"));
        let marks = (0..=SLOTS).map(|_| mark()).collect::<Result<Vec<_>, _>>()?;
        let flow = marks.try_into().map_err(|_| DeviceError::no_envs())?;
        let queue = Arc::new(Queue {
            stream,
            launch: Mutex::default(),
            env_launch: Mutex::default(),
            rows: Mutex::default(),
            flow,
            others: Mutex::default(),
            events,
        });
        Ok(Self { context, kernels, name, queue, ground: Mutex::default() })
    }
}

/// Neighbouring blocks of one launch.
struct Group<'a> {
    kernel: &'a Kernel,
    place: usize,
    count: usize,
    warps: usize,
}

impl Queue {
    /// Waits for the card.
    fn finish(&self) -> Result<(), DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        let others = locked(&self.others);
        let mut streams = std::iter::once(&self.stream).chain(&*others);
        streams.try_for_each(|stream| stream.synchronize()).map_err(call("cuStreamSynchronize"))
    }

    /// Whether the card has ended all work.
    fn is_finished(&self) -> Result<bool, DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        let others = locked(&self.others);
        for stream in std::iter::once(&self.stream).chain(&*others) {
            // SAFETY: the stream lives
            match unsafe { sys::cuStreamQuery(stream.cu_stream()) }.result() {
                Ok(()) => {}
                Err(DriverError(CUresult::CUDA_ERROR_NOT_READY)) => return Ok(false),
                Err(error) => return Err(call("cuStreamQuery")(error)),
            }
        }
        Ok(true)
    }

    /// The stream of the n-th launch of a control step.
    fn stream_of(&self, n: usize) -> Result<Arc<CudaStream>, DeviceError> {
        let mut others = locked(&self.others);
        while others.len() < n {
            others.push(self.stream.context().new_stream().map_err(call("cuStreamCreate"))?);
        }
        Ok(n.checked_sub(1).map_or_else(|| self.stream.clone(), |place| others[place].clone()))
    }

    fn note(&self, event: usize) -> Result<(), DeviceError> {
        let event = self.events.as_ref().map(|events| &events[event]);
        event.map_or(Ok(()), |event| event.record(&self.stream)).map_err(call("cuEventRecord"))
    }

    /// Memory for arguments: that of the last launch, if it is large enough.
    fn pinned<T: Plain>(&self, of_last: Option<Pinned<T>>, len: usize) -> Result<Pinned<T>, DeviceError> {
        match of_last.filter(|of_last| of_last.len >= len) {
            Some(of_last) => Ok(of_last),
            None => Pinned::new(self.stream.context(), len).map_err(call("cuMemHostAlloc")),
        }
    }

    /// Launches the physics of blocks, those of one kernel together, with arguments in the memory
    /// that is returned. `in_order`: after all work before, and before all work after.
    fn launch_physics(
        &self,
        of_last: Option<Pinned<Arguments>>,
        blocks: &[(&Kernel, Arguments)],
        in_order: bool,
    ) -> Result<Pinned<Arguments>, DeviceError> {
        let mut written = self.pinned(of_last, blocks.len())?;
        let start = written.address();
        let mut launches: Vec<Group> = Vec::new();
        for (place, (kernel, block)) in blocks.iter().enumerate() {
            let together = launches.last().is_some_and(|group| kernel.is_common && group.kernel.is_common);
            if !together {
                launches.push(Group { kernel, place, count: 0, warps: 0 });
            }
            let Some(group) = launches.last_mut() else { continue };
            written.numbers()[place] = Arguments { warp: whole(group.warps), ..*block };
            group.count += 1;
            group.warps += usize::try_from(block.robots).unwrap_or(0).div_ceil(THREADS / kernel.threads);
        }
        let others = if in_order { 1..launches.len() } else { 0..0 };
        let others: Vec<_> = others.map(|n| self.stream_of(n)).collect::<Result<_, _>>()?;
        others.iter().try_for_each(|other| other.join(&self.stream)).map_err(call("cuStreamWaitEvent"))?;
        for (n, Group { kernel, place, count, warps }) in launches.into_iter().enumerate() {
            let blocks = start + (size_of::<Arguments>() * place) as CUdeviceptr;
            let config = LaunchConfig {
                grid_dim: (u32::try_from(warps).unwrap_or(u32::MAX), 1, 1),
                block_dim: (THREADS as u32, 1, 1),
                shared_mem_bytes: 0,
            };
            let count = whole(count);
            // SAFETY: the arrays have the sizes of the tables' lists, which bound every index of
            // the text
            unsafe { self.stream_of(n)?.launch_builder(&kernel.function).arg(&blocks).arg(&count).launch(config) }
                .map_err(call("cuLaunchKernel"))?;
        }
        others.iter().try_for_each(|other| self.stream.join(other)).map_err(call("cuStreamWaitEvent"))?;
        Ok(written)
    }

    /// Launches the blocks that wait.
    fn launch(&self) -> Result<(), DeviceError> {
        // the card must not read arguments that are written
        self.finish()?;
        let Launch { waiting, arguments } = &mut *locked(&self.launch);
        if waiting.is_empty() {
            return Ok(());
        }
        let blocks: Vec<_> = waiting.iter().map(|(kernel, block)| (kernel, *block)).collect();
        self.note(0)?;
        *arguments = Some(self.launch_physics(arguments.take(), &blocks, false)?);
        waiting.clear();
        self.note(1)
    }

    /// Launches one half of the control steps of envs around their physics.
    fn launch_envs(
        &self,
        function: &CudaFunction,
        (blocks, count, warps): (CUdeviceptr, usize, usize),
        after: bool,
    ) -> Result<(), DeviceError> {
        let config = LaunchConfig {
            grid_dim: (u32::try_from(warps.div_ceil(WARPS_OF_ENVS)).unwrap_or(u32::MAX), 1, 1),
            block_dim: ((THREADS * WARPS_OF_ENVS) as u32, 1, 1),
            shared_mem_bytes: 0,
        };
        let (count, after) = (whole(count), c_int::from(after));
        // SAFETY: the arrays have the sizes of the tables' lists and columns, which bound every
        // index of the text
        unsafe { self.stream.launch_builder(function).arg(&blocks).arg(&count).arg(&after).launch(config) }
            .map(drop)
            .map_err(call("cuLaunchKernel"))
    }

    /// Makes the whole control steps of the blocks that wait, and waits for them unless they flow.
    fn step_envs(&self, function: &CudaFunction, flow: Option<Flow>) -> Result<(), DeviceError> {
        match flow {
            // the card must not read arguments that are written
            None => self.finish()?,
            Some(Flow { slot, stream }) => {
                self.wait(slot)?;
                self.wait_for_caller(stream)?;
            }
        }
        let slot = flow.map_or(0, |flow| flow.slot);
        let EnvLaunch { waiting, envs, robots } = &mut *locked(&self.env_launch);
        if waiting.is_empty() {
            return Ok(());
        }
        let (mut written, mut warps) = (self.pinned(envs[slot].take(), waiting.len())?, 0);
        for (to, (_, block)) in written.numbers().iter_mut().zip(&*waiting) {
            *to = EnvArguments { warp: whole(warps), ..*block };
            warps += usize::try_from(block.block.robots).unwrap_or(0).div_ceil(THREADS);
        }
        let all = (written.address(), waiting.len(), warps);
        let blocks: Vec<_> = waiting.iter().map(|(kernel, env)| (kernel, env.block)).collect();
        self.note(0)?;
        self.launch_envs(function, all, false)?;
        robots[slot] = Some(self.launch_physics(robots[slot].take(), &blocks, true)?);
        self.launch_envs(function, all, true)?;
        self.note(1)?;
        envs[slot] = Some(written);
        waiting.clear();
        let Some(Flow { stream, .. }) = flow else { return self.finish() };
        let ended = &self.flow[1 + slot];
        ended.record(&self.stream).map_err(call("cuEventRecord"))?;
        wait_for_event(stream, ended)
    }

    /// Waits for the control step of a slot.
    fn wait(&self, slot: usize) -> Result<(), DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        self.flow[1 + slot].synchronize().map_err(call("cuEventSynchronize"))
    }

    /// Lets all further work wait for a caller's stream.
    fn wait_for_caller(&self, stream: u64) -> Result<(), DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        // SAFETY: the caller promises that the stream lives
        unsafe { result::event::record(self.flow[0].cu_event(), caller(stream)) }.map_err(call("cuEventRecord"))?;
        self.stream.wait(&self.flow[0]).map_err(call("cuStreamWaitEvent"))
    }

    fn rows(&self) -> Result<Arc<Rows>, DeviceError> {
        locked(&self.rows).clone().ok_or_else(DeviceError::no_envs)
    }
}

/// A caller's stream.
fn caller(stream: u64) -> sys::CUstream {
    std::ptr::with_exposed_provenance_mut(usize::try_from(stream).unwrap_or(0))
}

/// Sizes are counted in integers of 32 bits, as `Tables` checks.
fn whole(x: usize) -> c_int {
    c_int::try_from(x).unwrap_or(c_int::MAX)
}

impl Card {
    /// The heights of the ground on the card.
    fn grid(&self, heights: &Arc<[f32]>, stream: &Arc<CudaStream>) -> Result<Arc<CudaSlice<f32>>, DriverError> {
        let mut ground = locked(&self.ground);
        if let Some((_, placed)) = ground.as_ref().filter(|(known, _)| Arc::ptr_eq(known, heights)) {
            return Ok(placed.clone());
        }
        let numbers: &[f32] = if heights.is_empty() { &[0.0] } else { heights };
        let placed = Arc::new(stream.clone_htod(numbers)?);
        stream.synchronize()?;
        *ground = Some((heights.clone(), placed.clone()));
        Ok(placed)
    }
}

impl Device for Card {
    fn name(&self) -> &str {
        &self.name
    }

    fn prepare(&self, robots: usize) -> Result<(), DeviceError> {
        self.kernels.prepare(robots).map(drop)
    }

    fn allocate(&self, shape: Shape) -> Result<Box<dyn DeviceBlock>, DeviceError> {
        // the robots of a warp make a tile
        let tile = THREADS / self.kernels.prepare(shape.robots)?;
        let shape = shape.with_tile(tile);
        let [work, work_integers] = shape.scratch();
        let exchanged = shape.exchanged();
        let needed = size_of::<f32>() * (work + work_integers + exchanged) + RESERVED;
        let (free, _) = self.context.mem_get_info().map_err(call("cuMemGetInfo"))?;
        let too_little = DeviceError::Memory { needed: needed >> 20, free: free >> 20 };
        if needed > free {
            return Err(too_little);
        }
        let memory = |error: DriverError| match error.0 {
            CUresult::CUDA_ERROR_OUT_OF_MEMORY => too_little.clone(),
            _ => call("cuMemAlloc")(error),
        };
        let stream = &self.queue.stream;
        let integers = stream.clone_htod(&shape.tables.integers).map_err(memory)?;
        let numbers = stream.clone_htod(&shape.tables.numbers).map_err(memory)?;
        let block = CardBlock {
            integers,
            numbers,
            grid: self.grid(&shape.tables.grid, stream).map_err(memory)?,
            parameters: stream.alloc_zeros(1).map_err(memory)?,
            common: stream.alloc_zeros(shape.tables.sizes.parameters.max(1)).map_err(memory)?,
            own_columns: 0,
            exchanged: stream.alloc_zeros(exchanged).map_err(memory)?,
            work: stream.alloc_zeros(work.max(1)).map_err(memory)?,
            work_integers: stream.alloc_zeros(work_integers.max(1)).map_err(memory)?,
            host: Pinned::new(&self.context, exchanged).map_err(memory)?,
            ended: stream.alloc_zeros(2).map_err(memory)?,
            done: Pinned::new(&self.context, 2).map_err(memory)?,
            kernels: self.kernels.clone(),
            own: self.kernels.of_new_block(&shape.tables),
            steps: 0,
            polls: 0,
            queue: self.queue.clone(),
            envs: None,
            context: self.context.clone(),
            shape,
        };
        self.queue.finish()?;
        Ok(Box::new(block))
    }

    fn launch(&self) -> Result<(), DeviceError> {
        self.queue.launch()
    }

    fn place_rows(&self, sizes: RowSizes) -> Result<(), DeviceError> {
        let mut rows = locked(&self.queue.rows);
        if rows.as_ref().is_some_and(|rows| rows.sizes == sizes) {
            return Ok(());
        }
        let stream = &self.queue.stream;
        let placed = Rows {
            sizes,
            numbers: stream.alloc_zeros(sizes.numbers().max(1)).map_err(call("cuMemAlloc"))?,
            ends: stream.alloc_zeros(2 * sizes.envs.max(1)).map_err(call("cuMemAlloc"))?,
            stream: stream.clone(),
        };
        *rows = Some(Arc::new(placed));
        drop(rows);
        self.queue.finish()
    }

    fn rows(&self) -> Option<DeviceRows> {
        let rows = self.queue.rows().ok()?;
        let stream = &self.queue.stream;
        Some(DeviceRows {
            sizes: rows.sizes,
            card: Some(self.context.ordinal()),
            numbers: rows.numbers.device_ptr(stream).0,
            ends: rows.ends.device_ptr(stream).0,
            memory: rows.clone(),
        })
    }

    fn read_rows(&self, of: RowsOf, to: &mut [f32]) -> Result<(), DeviceError> {
        let (rows, stream) = (self.queue.rows()?, &self.queue.stream);
        stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        stream.memcpy_dtoh(&rows.numbers.slice(rows.sizes.part(of)), to).map_err(call("cuMemcpyDtoH"))?;
        stream.synchronize().map_err(call("cuStreamSynchronize"))
    }

    fn write_rows(&self, of: RowsOf, from: &[f32]) -> Result<(), DeviceError> {
        let (rows, stream) = (self.queue.rows()?, &self.queue.stream);
        stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        let (to, bytes) = (rows.numbers.slice(rows.sizes.part(of)), size_of_val(from));
        if to.len() != from.len() {
            return Err(DeviceError::Call { call: "cuMemcpyHtoD", text: format!("{bytes} bytes of other sizes") });
        }
        // SAFETY: the memory lives, has that size and is read by nobody but the card
        unsafe { result::memcpy_htod_async(to.device_ptr(stream).0, from, stream.cu_stream()) }
            .map_err(call("cuMemcpyHtoD"))?;
        stream.synchronize().map_err(call("cuStreamSynchronize"))
    }

    fn write_ends(&self, ends: &[u8]) -> Result<(), DeviceError> {
        let (rows, stream) = (self.queue.rows()?, &self.queue.stream);
        stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        let ends = &ends[..rows.ends.len().min(ends.len())];
        // SAFETY: the memory lives, has that size and is read by nobody but the card
        unsafe { result::memcpy_htod_async(rows.ends.device_ptr(stream).0, ends, stream.cu_stream()) }
            .map_err(call("cuMemcpyHtoD"))?;
        stream.synchronize().map_err(call("cuStreamSynchronize"))
    }

    fn wait_for_caller(&self, stream: u64) -> Result<(), DeviceError> {
        self.queue.wait_for_caller(stream)
    }

    fn step_envs(&self, flow: Option<Flow>) -> Result<(), DeviceError> {
        self.queue.step_envs(&self.kernels.of_envs()?, flow)
    }

    fn wait(&self, slot: usize) -> Result<(), DeviceError> {
        self.queue.wait(slot)
    }

    fn seconds(&self) -> Option<f64> {
        let [before, after] = self.queue.events.as_ref()?;
        before.elapsed_ms(after).ok().map(|ms| f64::from(ms) / 1000.0)
    }
}

/// Memory of the host that the card reads and writes directly.
struct Pinned<T> {
    start: NonNull<T>,
    len: usize,
    context: Arc<CudaContext>,
}

// SAFETY: the memory belongs to this value alone
unsafe impl<T: Send> Send for Pinned<T> {}
// SAFETY: shared references give no access to it
unsafe impl<T: Sync> Sync for Pinned<T> {}

/// Types for which zeros are values, and which need no drop.
trait Plain: Copy {}
impl Plain for f32 {}
impl Plain for u32 {}
impl Plain for Arguments {}
impl Plain for EnvArguments {}

impl<T: Plain> Pinned<T> {
    /// Numbers that are zero.
    fn new(context: &Arc<CudaContext>, len: usize) -> Result<Self, DriverError> {
        context.bind_to_thread()?;
        // SAFETY: the memory is freed in `drop`, and zeros are numbers
        let start = unsafe {
            let start = result::malloc_host(size_of::<T>() * len, sys::CU_MEMHOSTALLOC_DEVICEMAP)?.cast::<T>();
            start.write_bytes(0, len);
            start
        };
        let start = NonNull::new(start).ok_or(DriverError(CUresult::CUDA_ERROR_OUT_OF_MEMORY))?;
        Ok(Self { start, len, context: context.clone() })
    }

    /// The address, which is the same for the host and the card.
    fn address(&self) -> CUdeviceptr {
        self.start.as_ptr().expose_provenance() as CUdeviceptr
    }

    fn numbers(&mut self) -> &mut [T] {
        // SAFETY: the numbers are there until `drop`, and the borrow is the only one
        unsafe { std::slice::from_raw_parts_mut(self.start.as_ptr(), self.len) }
    }
}

impl<T> Drop for Pinned<T> {
    fn drop(&mut self) {
        // a card that is lost has nothing to free
        if self.context.bind_to_thread().is_ok() {
            // SAFETY: `new` allocated it, and nobody uses it after this
            let _ = unsafe { result::free_host(self.start.as_ptr().cast()) };
        }
    }
}

/// A block on a card.
struct CardBlock {
    shape: Shape,
    integers: CudaSlice<i32>,
    numbers: CudaSlice<f32>,
    grid: Arc<CudaSlice<f32>>,
    parameters: CudaSlice<f32>,
    common: CudaSlice<f32>,
    own_columns: u32,
    exchanged: CudaSlice<f32>,
    work: CudaSlice<f32>,
    work_integers: CudaSlice<i32>,
    /// The rows, which the kernel reads and writes where they are.
    host: Pinned<f32>,
    /// Warps that have ended, and the most contacts, on the card.
    ended: CudaSlice<u32>,
    /// The number of the last control step that all warps have ended, and the most contacts of a
    /// robot, which the card writes.
    done: Pinned<u32>,
    kernels: Arc<Kernels>,
    own: Option<Own>,
    /// Control steps so far.
    steps: u32,
    /// Looks at `done` so far.
    polls: u32,
    queue: Arc<Queue>,
    envs: Option<CardEnvs>,
    context: Arc<CudaContext>,
}

/// Envs of a block on a card.
struct CardEnvs {
    task: TaskTables,
    /// Row of the first env among all.
    first: usize,
    integers: CudaSlice<i32>,
    task_numbers: CudaSlice<f32>,
    /// The parts of [`EnvParts::of_device`].
    numbers: CudaSlice<f32>,
    words: CudaSlice<u32>,
    /// Rows of robots that are watched.
    kept: Option<CudaSlice<f32>>,
    /// The parts of [`EnvParts::of_host`].
    host_numbers: Pinned<f32>,
    host_words: Pinned<u32>,
}

impl Drop for CardBlock {
    fn drop(&mut self) {
        // a launch uses the memory
        let _ = self.queue.finish();
    }
}

impl CardBlock {
    fn arguments(&self) -> Arguments {
        let stream = &self.queue.stream;
        let float = |slice: &CudaSlice<f32>| slice.device_ptr(stream).0;
        let integer = |slice: &CudaSlice<i32>| slice.device_ptr(stream).0;
        let at = |number: usize| float(&self.exchanged) + (size_of::<f32>() * number) as CUdeviceptr;
        let [drive, state, report] = self.shape.ranges().map(|range| at(range.start));
        Arguments {
            integers: integer(&self.integers),
            numbers: float(&self.numbers),
            parameters: float(&self.parameters),
            common: float(&self.common),
            drive,
            state,
            report,
            host: self.host.address(),
            grid: float(&self.grid),
            work: float(&self.work),
            work_integers: integer(&self.work_integers),
            ended: self.ended.device_ptr(stream).0,
            done: self.done.address(),
            robots: whole(self.shape.robots),
            own: self.own_columns,
            capacity: whole(self.shape.capacity),
            first: 0,
            end: whole(self.shape.decimation()),
            warp: 0,
            number: self.steps.cast_signed(),
        }
    }
}

impl DeviceBlock for CardBlock {
    fn shape(&self) -> &Shape {
        &self.shape
    }

    fn exchange(&mut self) -> Exchange<'_> {
        let Self { shape, host, .. } = self;
        shape.exchange(host.numbers())
    }

    fn set_parameters(
        &mut self,
        common: &[f32],
        own: u32,
        tiles: &[f32],
        changed: &[usize],
    ) -> Result<(), DeviceError> {
        let stream = &self.queue.stream;
        stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        self.own_columns = own;
        stream.memcpy_htod(common, &mut self.common).map_err(call("cuMemcpyHtoD"))?;
        if own != 0 && self.parameters.len() != tiles.len() {
            self.parameters = stream.clone_htod(tiles).map_err(call("cuMemcpyHtoD"))?;
        } else if own != 0 {
            for &tile in changed {
                let part = self.shape.parameters_of_tile(tile);
                let mut to = self.parameters.slice_mut(part.clone());
                stream.memcpy_htod(&tiles[part], &mut to).map_err(call("cuMemcpyHtoD"))?;
            }
        }
        stream.synchronize().map_err(call("cuStreamSynchronize"))
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        let kernel = self.kernels.for_step(&self.shape.tables, &mut self.own, self.steps)?;
        self.steps = self.steps.wrapping_add(1);
        let arguments = self.arguments();
        locked(&self.queue.launch).waiting.push((kernel, arguments));
        Ok(())
    }

    fn contacts_if_done(&mut self) -> Result<Option<usize>, DeviceError> {
        let [number, contacts] = [0, 1].map(|place| &raw mut self.done.numbers()[place]);
        // SAFETY: the numbers live, and nobody but the card writes them
        let [number, contacts] = [number, contacts].map(|at| unsafe { AtomicU32::from_ptr(at) });
        let is_done = || number.load(Ordering::Acquire) == self.steps;
        if !is_done() {
            self.polls = self.polls.wrapping_add(1);
            if !self.polls.is_multiple_of(POLLS_OF_CARD) || !self.queue.is_finished()? {
                return Ok(None);
            }
            if !is_done() {
                return Err(DeviceError::Call { call: "cuLaunchKernel", text: "it ended without a result".into() });
            }
        }
        Ok(Some(contacts.load(Ordering::Relaxed) as usize))
    }

    fn is_ready(&mut self) -> bool {
        self.kernels.is_ready(&self.shape.tables, &mut self.own)
    }

    fn envs(&mut self) -> Option<&mut dyn EnvBlock> {
        Some(self)
    }
}

/// Bytes of a number.
const NUMBER: usize = size_of::<f32>();

impl EnvBlock for CardBlock {
    fn place(&mut self, task: TaskTables, first: usize) -> Result<(), DeviceError> {
        let (stream, parts) = (&self.queue.stream, task.parts(self.shape.robots));
        stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        // begins to compile
        self.kernels.of_envs()?;
        let ([numbers, words], [host_numbers, host_words]) = (parts.of_device(), parts.of_host());
        let (free, _) = self.context.mem_get_info().map_err(call("cuMemGetInfo"))?;
        let needed = NUMBER * (numbers + words) + RESERVED;
        if needed > free {
            return Err(DeviceError::Memory { needed: needed >> 20, free: free >> 20 });
        }
        let memory = call("cuMemAlloc");
        self.envs = Some(CardEnvs {
            integers: stream.clone_htod(&task.integers).map_err(&memory)?,
            task_numbers: stream.clone_htod(&task.numbers).map_err(&memory)?,
            numbers: stream.alloc_zeros(numbers.max(1)).map_err(&memory)?,
            words: stream.alloc_zeros(words.max(1)).map_err(&memory)?,
            kept: None,
            host_numbers: Pinned::new(&self.context, host_numbers.max(1)).map_err(&memory)?,
            host_words: Pinned::new(&self.context, host_words.max(1)).map_err(&memory)?,
            task,
            first,
        });
        self.queue.finish()
    }

    fn host(&mut self) -> Option<EnvHost<'_>> {
        let CardEnvs { task, host_numbers, host_words, .. } = self.envs.as_mut()?;
        Some(EnvHost::new(task, self.shape.robots, host_numbers.numbers(), host_words.numbers()))
    }

    fn told(&mut self, slot: usize) -> Option<Told<'_>> {
        let CardEnvs { task, host_words, .. } = self.envs.as_mut()?;
        Some(Told::new(task, self.shape.robots, host_words.numbers(), slot))
    }

    fn watch(&mut self, watched: bool) -> Result<(), DeviceError> {
        let Self { shape, envs, queue, .. } = self;
        let Some(envs) = envs.as_mut().filter(|envs| envs.kept.is_some() != watched) else { return Ok(()) };
        queue.finish()?;
        let kept = |()| queue.stream.alloc_zeros(shape.kept() * shape.robots).map_err(call("cuMemAlloc"));
        envs.kept = watched.then_some(()).map(kept).transpose()?;
        Ok(())
    }

    fn kept(&mut self, robot: usize) -> Result<Option<Vec<f32>>, DeviceError> {
        let (size, stream) = (self.shape.kept(), &self.queue.stream);
        let kept = self.envs.as_ref().and_then(|envs| envs.kept.as_ref());
        let Some(kept) = kept else { return Ok(None) };
        stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        let rows = stream.clone_dtoh(&kept.slice(robot * size..(robot + 1) * size));
        let rows = rows.map_err(call("cuMemcpyDtoH"))?;
        stream.synchronize().map_err(call("cuStreamSynchronize"))?;
        Ok(Some(rows))
    }

    fn upload(&mut self) -> Result<(), DeviceError> {
        let Self { shape, exchanged, host, envs, queue, .. } = self;
        let stream = &queue.stream;
        stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        let rows = 0..shape.exchanged();
        let copy = |from: &[f32], to: &mut CudaSlice<f32>, part: Range<usize>| {
            stream.memcpy_htod(&from[part.clone()], &mut to.slice_mut(part)).map_err(call("cuMemcpyHtoD"))
        };
        copy(host.numbers(), exchanged, rows)?;
        if let Some(CardEnvs { task, numbers, words, host_numbers, host_words, .. }) = envs {
            let EnvParts { numbers: parts, words: word_parts } = task.parts(shape.robots);
            copy(host_numbers.numbers(), numbers, parts[0].clone())?;
            let part = word_parts[0].clone();
            stream.memcpy_htod(&host_words.numbers()[part], words).map_err(call("cuMemcpyHtoD"))?;
        }
        stream.synchronize().map_err(call("cuStreamSynchronize"))
    }

    fn download(&mut self) -> Result<(), DeviceError> {
        let Self { exchanged, host, envs, shape, queue, .. } = self;
        let stream = &queue.stream;
        stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        stream.memcpy_dtoh(exchanged, host.numbers()).map_err(call("cuMemcpyDtoH"))?;
        if let Some(CardEnvs { task, numbers, words, host_numbers, host_words, .. }) = envs {
            let EnvParts { numbers: parts, words: word_parts } = task.parts(shape.robots);
            let columns = parts[0].clone();
            let to = &mut host_numbers.numbers()[columns.clone()];
            stream.memcpy_dtoh(&numbers.slice(columns), to).map_err(call("cuMemcpyDtoH"))?;
            let to = &mut host_words.numbers()[word_parts[0].clone()];
            stream.memcpy_dtoh(words, to).map_err(call("cuMemcpyDtoH"))?;
        }
        stream.synchronize().map_err(call("cuStreamSynchronize"))
    }

    fn start(&mut self, slot: Option<usize>) -> Result<(), DeviceError> {
        let kernel = self.kernels.for_step(&self.shape.tables, &mut self.own, self.steps)?;
        self.steps = self.steps.wrapping_add(1);
        // the rows stay where they are
        let block = Arguments { host: 0, ..self.arguments() };
        let (robots, stream, rows) = (self.shape.robots, &self.queue.stream, self.queue.rows()?);
        let Some(CardEnvs { task, first, integers, task_numbers, numbers, words, kept, host_numbers, host_words }) =
            &self.envs
        else {
            return Err(DeviceError::Call { call: "polypod_env_step", text: "there is no task".into() });
        };
        let parts = task.parts(robots);
        let after = |start: CUdeviceptr, numbers: usize| start + (NUMBER * numbers) as CUdeviceptr;
        let row = |of: RowsOf| {
            let part = rows.sizes.part(of);
            let width = part.len() / rows.sizes.envs.max(1);
            after(rows.numbers.device_ptr(stream).0, part.start + width * first)
        };
        let of_host = |part: usize| after(host_numbers.address(), parts.numbers[part].start);
        let shown = |part: usize| slot.map_or_else(|| of_host(part), |_| 0);
        let [flags, ended] = parts.of_slot(slot.unwrap_or(0));
        let terminated = rows.ends.device_ptr(stream).0 + *first as CUdeviceptr;
        let arguments = EnvArguments {
            block,
            task: integers.device_ptr(stream).0,
            task_numbers: task_numbers.device_ptr(stream).0,
            columns: numbers.device_ptr(stream).0,
            words: words.device_ptr(stream).0,
            actions: row(RowsOf::Actions),
            observations: row(RowsOf::Observations),
            finals: row(RowsOf::Finals),
            rewards: row(RowsOf::Rewards),
            commands: row(RowsOf::Commands),
            terminated,
            truncated: terminated + rows.sizes.envs as CUdeviceptr,
            kept: kept.as_ref().map_or(0, |kept| kept.device_ptr(stream).0),
            given: slot.map_or_else(|| of_host(1), |_| row(RowsOf::Given)),
            host_observations: shown(2),
            host_finals: shown(3),
            host_rewards: shown(4),
            host_commands: shown(5),
            flags: after(host_words.address(), flags.start),
            ended: after(host_words.address(), ended.start),
            ended_size: whole(task.widths[2]),
            warp: 0,
        };
        locked(&self.queue.env_launch).waiting.push((kernel, arguments));
        Ok(())
    }
}
