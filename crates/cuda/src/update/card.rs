//! The update on an NVIDIA card.
#![allow(unsafe_code, reason = "the border to the driver")]

use std::ffi::c_int;
use std::sync::Arc;

use cudarc::driver::sys::{CUdeviceptr, CUresult};
use cudarc::driver::{
    CudaContext, CudaFunction, CudaStream, DeviceRepr, DriverError, LaunchConfig, PushKernelArg, result,
};
use cudarc::nvrtc::Ptx;

use super::Machine;
use super::jobs::{
    Chains, Inputs, KERNELS, Launch, Plain, Product, Rows, Step, Surrogate, THREADS, Total, Value, WeightGradient,
};
use crate::device::DeviceError;
use crate::driver::{call, context};
use crate::nvrtc;

// SAFETY: these are structures of numbers alone, with the layout of C
unsafe impl DeviceRepr for Rows {}
// SAFETY: as above
unsafe impl DeviceRepr for Inputs {}
// SAFETY: as above
unsafe impl DeviceRepr for Product {}
// SAFETY: as above
unsafe impl DeviceRepr for Surrogate {}
// SAFETY: as above
unsafe impl DeviceRepr for Value {}
// SAFETY: as above
unsafe impl DeviceRepr for Chains {}
// SAFETY: as above
unsafe impl DeviceRepr for WeightGradient {}
// SAFETY: as above
unsafe impl DeviceRepr for Total {}
// SAFETY: as above
unsafe impl DeviceRepr for Step {}

/// A card with the compiled text of the update. Its work is apart from that of the simulator.
pub struct UpdateCard {
    context: Arc<CudaContext>,
    stream: Arc<CudaStream>,
    /// In the order of [`KERNELS`].
    functions: Vec<CudaFunction>,
    name: String,
    room: Option<CUdeviceptr>,
}

impl UpdateCard {
    /// Opens the card, and compiles the text.
    ///
    /// # Errors
    /// No driver or card, or too old ones; no compiler.
    pub fn open() -> Result<Self, DeviceError> {
        let (context, found) = context()?;
        let stream = context.new_stream().map_err(call("cuStreamCreate"))?;
        let ptx = nvrtc::compile_update()?;
        let module = context.load_module(Ptx::from_src(ptx)).map_err(call("cuModuleLoadData"))?;
        let function = |name| module.load_function(name).map_err(call("cuModuleGetFunction"));
        let functions = KERNELS.into_iter().map(function).collect::<Result<_, _>>()?;
        Ok(Self { context, stream, functions, name: found.name, room: None })
    }

    fn bind(&self) -> Result<(), DeviceError> {
        self.context.bind_to_thread().map_err(call("cuCtxSetCurrent"))
    }

    fn free(&mut self) -> Result<(), DeviceError> {
        let Some(room) = self.room.take() else { return Ok(()) };
        self.stream.synchronize().map_err(call("cuStreamSynchronize"))?;
        // SAFETY: `reserve` allocated it, and no work uses it any longer
        unsafe { result::free_sync(room) }.map_err(call("cuMemFree"))
    }

    fn start<T: DeviceRepr>(&self, launch: &Launch, job: &T) -> Result<(), DeviceError> {
        let [blocks, jobs] = launch.grid().map(c_int::cast_unsigned);
        if blocks == 0 {
            return Ok(());
        }
        let config =
            LaunchConfig { grid_dim: (blocks, jobs, 1), block_dim: (THREADS as u32, 1, 1), shared_mem_bytes: 0 };
        // SAFETY: the arguments are those of the kernel, and its indices lie within the arrays that
        // `Plan::place` made for the same sizes
        unsafe { self.stream.launch_builder(&self.functions[launch.kernel()]).arg(job).launch(config) }
            .map(drop)
            .map_err(call("cuLaunchKernel"))
    }
}

impl Drop for UpdateCard {
    fn drop(&mut self) {
        // a card that is lost has nothing to free
        if self.bind().is_ok() {
            let _ = self.free();
        }
    }
}

impl Machine for UpdateCard {
    fn name(&self) -> &str {
        &self.name
    }

    fn reserve(&mut self, bytes: u64) -> Result<u64, DeviceError> {
        self.bind()?;
        self.free()?;
        let (free, _) = self.context.mem_get_info().map_err(call("cuMemGetInfo"))?;
        let size = usize::try_from(bytes).unwrap_or(usize::MAX);
        // SAFETY: the memory is freed in `free`
        let made = unsafe { result::malloc_sync(size) };
        let room = made.map_err(|error: DriverError| match error.0 {
            CUresult::CUDA_ERROR_OUT_OF_MEMORY => DeviceError::Memory { needed: size >> 20, free: free >> 20 },
            _ => call("cuMemAlloc")(error),
        })?;
        self.room = Some(room);
        Ok(room)
    }

    fn write<T: Plain>(&mut self, to: u64, from: &[T]) -> Result<(), DeviceError> {
        if from.is_empty() {
            return Ok(());
        }
        self.bind()?;
        // SAFETY: the array lies within the room; the driver has read pageable memory when the call
        // returns
        unsafe { result::memcpy_htod_async(to, from, self.stream.cu_stream()) }.map_err(call("cuMemcpyHtoD"))
    }

    fn read<T: Plain>(&mut self, from: u64, to: &mut [T]) -> Result<(), DeviceError> {
        self.bind()?;
        if !to.is_empty() {
            // SAFETY: the array lies within the room, and the stream is waited for below
            unsafe { result::memcpy_dtoh_async(to, from, self.stream.cu_stream()) }.map_err(call("cuMemcpyDtoH"))?;
        }
        self.stream.synchronize().map_err(call("cuStreamSynchronize"))
    }

    fn launch(&mut self, launch: &Launch) -> Result<(), DeviceError> {
        match launch {
            Launch::Rows(job) => self.start(launch, job),
            Launch::Inputs(jobs) => self.start(launch, jobs),
            Launch::Product(jobs) => self.start(launch, jobs),
            Launch::Surrogate(job) => self.start(launch, job),
            Launch::Value(job) => self.start(launch, job),
            Launch::Chains(job) => self.start(launch, job),
            Launch::WeightGradient(jobs) => self.start(launch, jobs),
            Launch::Total(jobs) => self.start(launch, jobs),
            Launch::Step(jobs) => self.start(launch, jobs),
        }
    }
}
