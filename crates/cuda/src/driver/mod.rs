//! An NVIDIA card, through its driver, which is loaded at run time.
#![allow(unsafe_code, reason = "the border to the driver")]

mod block;
mod pinned;
mod queue;

use std::sync::{Arc, Mutex};

use cudarc::driver::{CudaContext, CudaSlice, CudaStream, DevicePtr, DriverError, result, sys};

use self::block::CardBlock;
use self::queue::{Queue, Rows};
use crate::columns::Shape;
use crate::device::{Device, DeviceBlock, DeviceError};
use crate::envs::{DeviceRows, Flow, RowSizes, RowsOf};
use crate::kernels::{Kernels, locked};
use crate::nvrtc;

/// The first version of CUDA whose drivers have all functions that are called here.
const OLDEST_CUDA: i32 = 11040;
/// The first generation of cards that the text is compiled for.
const OLDEST_CAPABILITY: (i32, i32) = (8, 0);
/// Threads of a warp, which are a block of the kernel.
const THREADS: usize = 32;
/// Bytes that the context and the kernel take beyond the robots' memory.
const RESERVED: usize = 64 << 20;

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
    if !nvrtc::is_present() && !nvrtc::are_kernels_shipped() {
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
        let queue = Arc::new(Queue::new(&context, timed)?);
        Ok(Self { context, kernels, name, queue, ground: Mutex::default() })
    }
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
        Ok(Box::new(CardBlock::new(self, shape)?))
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
        self.queue.seconds()
    }
}
