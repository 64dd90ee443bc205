//! An NVIDIA card, through its driver, which is loaded at run time.
#![allow(unsafe_code, reason = "the border to the driver")]

use std::ffi::c_int;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use cudarc::driver::sys::{CUdevice_attribute, CUdeviceptr, CUevent_flags, CUresult};
use cudarc::driver::{
    CudaContext, CudaEvent, CudaSlice, CudaStream, DevicePtr, DeviceRepr, DriverError, LaunchConfig, PushKernelArg,
    result, sys,
};

use crate::columns::{Columns, ROBOTS_OF_TILE, Shape};
use crate::device::{Device, DeviceBlock, DeviceError};
use crate::kernels::{Kernels, Own};
use crate::nvrtc;

/// The first version of CUDA whose drivers have all functions that are called here.
const OLDEST_CUDA: i32 = 11040;
/// The first generation of cards that the text is compiled for.
const OLDEST_CAPABILITY: (i32, i32) = (8, 0);
/// Warps that a multiprocessor steps at a time.
const WARPS_AT_A_TIME: usize = 4;
/// Most warps that share a tile. They are a block of the kernel, for a line of memory is theirs
/// together.
const MOST_WARPS: usize = 4;
/// Bytes that the context and the kernel take beyond the robots' memory.
const RESERVED: usize = 64 << 20;

/// `Block` of `device/step.cu`.
#[derive(Clone, Copy)]
#[repr(C)]
struct Arguments {
    integers: CUdeviceptr,
    numbers: CUdeviceptr,
    parameters: CUdeviceptr,
    drive: CUdeviceptr,
    state: CUdeviceptr,
    report: CUdeviceptr,
    grid: CUdeviceptr,
    work: CUdeviceptr,
    work_integers: CUdeviceptr,
    robots: c_int,
    shared: c_int,
    capacity: c_int,
    first: c_int,
    end: c_int,
}

// SAFETY: plain numbers, laid out as the text of the device has them
unsafe impl DeviceRepr for Arguments {}

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

fn context() -> Result<(Arc<CudaContext>, Found), DeviceError> {
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
    timed: bool,
    multiprocessors: usize,
    /// Tiles of all blocks.
    tiles: Arc<AtomicUsize>,
    /// The ground that was placed last, which all blocks share.
    ground: Mutex<Option<(Arc<[f32]>, Arc<CudaSlice<f32>>)>>,
}

impl Card {
    /// Opens the card and compiles the text for it. `timed`: blocks measure their steps.
    ///
    /// # Errors
    /// No driver or card, or too old ones; no compiler.
    pub fn open(timed: bool) -> Result<Self, DeviceError> {
        let (context, Found { name, .. }) = context()?;
        // SAFETY: each block has its own stream, which orders all work on its memory
        unsafe { context.disable_event_tracking() };
        let kernels = Arc::new(Kernels::new(&context)?);
        let attribute = CUdevice_attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT;
        let multiprocessors = context.attribute(attribute).map_err(call("cuDeviceGetAttribute"))?;
        let multiprocessors = usize::try_from(multiprocessors).unwrap_or(1);
        Ok(Self { context, kernels, name, timed, multiprocessors, tiles: Arc::default(), ground: Mutex::default() })
    }
}

impl Card {
    /// The heights of the ground on the card.
    fn grid(&self, heights: &Arc<[f32]>, stream: &Arc<CudaStream>) -> Result<Arc<CudaSlice<f32>>, DriverError> {
        let mut ground = self.ground.lock().unwrap_or_else(PoisonError::into_inner);
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

    fn allocate(&self, shape: Shape) -> Result<Box<dyn DeviceBlock>, DeviceError> {
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
        let stream = self.context.new_stream().map_err(call("cuStreamCreate"))?;
        let integers = stream.clone_htod(&shape.tables.integers).map_err(memory)?;
        let numbers = stream.clone_htod(&shape.tables.numbers).map_err(memory)?;
        let grid = self.grid(&shape.tables.grid, &stream).map_err(memory)?;
        let host = Pinned::new(&self.context, exchanged).map_err(memory)?;
        let events = if self.timed {
            let event = || self.context.new_event(Some(CUevent_flags::CU_EVENT_DEFAULT));
            let events = (0..4).map(|_| event()).collect::<Result<Vec<_>, _>>();
            events.map_err(call("cuEventCreate"))?
        } else {
            Vec::new()
        };
        let block = CardBlock {
            integers,
            numbers,
            grid,
            parameters: stream.alloc_zeros(1).map_err(memory)?,
            shared: true,
            exchanged: stream.alloc_zeros(exchanged).map_err(memory)?,
            work: stream.alloc_zeros(work.max(1)).map_err(memory)?,
            work_integers: stream.alloc_zeros(work_integers.max(1)).map_err(memory)?,
            host,
            kernels: self.kernels.clone(),
            warps: WARPS_AT_A_TIME * self.multiprocessors,
            tiles: self.tiles.clone(),
            own: self.kernels.of_new_block(&shape.tables),
            steps: 0,
            stream,
            events,
            shape,
        };
        self.tiles.fetch_add(block.shape.tiles(), Ordering::Relaxed);
        block.stream.synchronize().map_err(call("cuStreamSynchronize"))?;
        Ok(Box::new(block))
    }
}

/// Memory of the host that the card reads and writes directly.
struct Pinned {
    start: NonNull<f32>,
    len: usize,
    context: Arc<CudaContext>,
}

// SAFETY: the memory belongs to this value alone
unsafe impl Send for Pinned {}
// SAFETY: shared references give no access to it
unsafe impl Sync for Pinned {}

impl Pinned {
    /// Numbers that are zero.
    fn new(context: &Arc<CudaContext>, len: usize) -> Result<Self, DriverError> {
        context.bind_to_thread()?;
        // SAFETY: the memory is freed in `drop`, and zeros are numbers
        let start = unsafe {
            let start = result::malloc_host(size_of::<f32>() * len, 0)?.cast::<f32>();
            start.write_bytes(0, len);
            start
        };
        let start = NonNull::new(start).ok_or(DriverError(CUresult::CUDA_ERROR_OUT_OF_MEMORY))?;
        Ok(Self { start, len, context: context.clone() })
    }

    fn numbers(&mut self) -> &mut [f32] {
        // SAFETY: the numbers are there until `drop`, and the borrow is the only one
        unsafe { std::slice::from_raw_parts_mut(self.start.as_ptr(), self.len) }
    }
}

impl Drop for Pinned {
    fn drop(&mut self) {
        // a card that is lost has nothing to free
        if self.context.bind_to_thread().is_ok() {
            // SAFETY: `new` allocated it, and nobody uses it after this
            let _ = unsafe { result::free_host(self.start.as_ptr().cast()) };
        }
    }
}

/// A block on a card. Its stream orders transfers and steps, so that blocks step side by side.
struct CardBlock {
    shape: Shape,
    integers: CudaSlice<i32>,
    numbers: CudaSlice<f32>,
    grid: Arc<CudaSlice<f32>>,
    parameters: CudaSlice<f32>,
    shared: bool,
    exchanged: CudaSlice<f32>,
    work: CudaSlice<f32>,
    work_integers: CudaSlice<i32>,
    host: Pinned,
    kernels: Arc<Kernels>,
    /// Warps that the card steps at a time.
    warps: usize,
    /// Tiles of all blocks.
    tiles: Arc<AtomicUsize>,
    own: Option<Own>,
    /// Control steps so far.
    steps: u32,
    stream: Arc<CudaStream>,
    /// Before the upload, the kernel and the download, and after it, where steps are measured.
    events: Vec<CudaEvent>,
}

impl Drop for CardBlock {
    fn drop(&mut self) {
        self.tiles.fetch_sub(self.shape.tiles(), Ordering::Relaxed);
        // the transfers use the memory of the host
        let _ = self.stream.synchronize();
    }
}

impl CardBlock {
    fn note(&self, event: usize) -> Result<(), DeviceError> {
        self.events.get(event).map_or(Ok(()), |event| event.record(&self.stream)).map_err(call("cuEventRecord"))
    }

    /// Warps that share a tile: a robot waits for those of its warp, so that few robots take more
    /// warps than they need.
    fn warps_of_tile(&self) -> usize {
        let mut warps = MOST_WARPS;
        while warps > 1 && self.tiles.load(Ordering::Relaxed) * warps > self.warps {
            warps /= 2;
        }
        warps
    }

    fn arguments(&self) -> Arguments {
        let float = |slice: &CudaSlice<f32>| slice.device_ptr(&self.stream).0;
        let integer = |slice: &CudaSlice<i32>| slice.device_ptr(&self.stream).0;
        let at = |number: usize| float(&self.exchanged) + (size_of::<f32>() * number) as CUdeviceptr;
        let [drive, state, report] = self.shape.ranges().map(|range| at(range.start));
        // the tables count in integers of the same size
        let whole = |x: usize| c_int::try_from(x).unwrap_or(c_int::MAX);
        Arguments {
            integers: integer(&self.integers),
            numbers: float(&self.numbers),
            parameters: float(&self.parameters),
            drive,
            state,
            report,
            grid: float(&self.grid),
            work: float(&self.work),
            work_integers: integer(&self.work_integers),
            robots: whole(self.shape.robots),
            shared: c_int::from(self.shared),
            capacity: whole(self.shape.capacity),
            first: 0,
            end: whole(self.shape.decimation()),
        }
    }
}

impl DeviceBlock for CardBlock {
    fn shape(&self) -> &Shape {
        &self.shape
    }

    fn columns(&mut self) -> Columns<'_> {
        let Self { shape, host, .. } = self;
        shape.columns(host.numbers())
    }

    fn set_parameters(&mut self, all: &[f32], shared: bool, changed: &[usize]) -> Result<(), DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        self.shared = shared;
        if shared || self.parameters.len() != all.len() {
            self.parameters = self.stream.clone_htod(all).map_err(call("cuMemcpyHtoD"))?;
        } else {
            for &tile in changed {
                let part = self.shape.parameters_of_tile(tile);
                let mut to = self.parameters.slice_mut(part.clone());
                self.stream.memcpy_htod(&all[part], &mut to).map_err(call("cuMemcpyHtoD"))?;
            }
        }
        self.stream.synchronize().map_err(call("cuStreamSynchronize"))
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        let kernel = self.kernels.for_step(&self.shape.tables, &mut self.own, self.steps)?;
        self.steps = self.steps.saturating_add(1);
        let arguments = self.arguments();
        let [_, state, report] = self.shape.ranges();
        let (at, queue) = (arguments.drive, self.stream.cu_stream());
        self.note(0)?;
        // SAFETY: the pinned memory has as many numbers as the device's, and nobody uses it before
        // `finish`
        unsafe { result::memcpy_htod_async(at, &self.host.numbers()[..state.end], queue) }
            .map_err(call("cuMemcpyHtoDAsync"))?;
        self.note(1)?;
        let threads = ROBOTS_OF_TILE * self.warps_of_tile();
        let config = LaunchConfig {
            grid_dim: (u32::try_from(self.shape.tiles()).unwrap_or(u32::MAX), 1, 1),
            block_dim: (threads as u32, 1, 1),
            shared_mem_bytes: 0,
        };
        // SAFETY: the arrays have the sizes of the tables' columns, which bound every index of the
        // text
        unsafe { self.stream.launch_builder(&kernel).arg(&arguments).launch(config) }
            .map_err(call("cuLaunchKernel"))?;
        self.note(2)?;
        let from = arguments.state;
        // SAFETY: as above
        unsafe { result::memcpy_dtoh_async(&mut self.host.numbers()[state.start..report.end], from, queue) }
            .map_err(call("cuMemcpyDtoHAsync"))?;
        self.note(3)
    }

    fn finish(&mut self) -> Result<(), DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        self.stream.synchronize().map_err(call("cuStreamSynchronize"))
    }

    fn is_ready(&mut self) -> bool {
        self.kernels.is_ready(&self.shape.tables, &mut self.own)
    }

    fn seconds(&self) -> Option<[f64; 3]> {
        let [before, kernel, after, end] = &self.events[..] else { return None };
        let seconds = |from: &CudaEvent, to: &CudaEvent| from.elapsed_ms(to).ok().map(|ms| f64::from(ms) / 1000.0);
        Some([seconds(before, kernel)?, seconds(kernel, after)?, seconds(after, end)?])
    }
}
