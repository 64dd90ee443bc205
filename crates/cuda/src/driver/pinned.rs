//! Memory of the host that a card reads and writes directly, and the kernels' arguments there.

use std::ffi::c_int;
use std::ptr::NonNull;
use std::sync::Arc;

use cudarc::driver::sys::{CUdeviceptr, CUresult};
use cudarc::driver::{CudaContext, DriverError, result, sys};

/// `Block` of `device/block.h`.
#[derive(Clone, Copy)]
#[repr(C)]
pub(super) struct Arguments {
    pub(super) integers: CUdeviceptr,
    pub(super) numbers: CUdeviceptr,
    pub(super) parameters: CUdeviceptr,
    pub(super) common: CUdeviceptr,
    pub(super) drive: CUdeviceptr,
    pub(super) state: CUdeviceptr,
    pub(super) report: CUdeviceptr,
    pub(super) host: CUdeviceptr,
    pub(super) grid: CUdeviceptr,
    pub(super) work: CUdeviceptr,
    pub(super) work_integers: CUdeviceptr,
    pub(super) ended: CUdeviceptr,
    pub(super) done: CUdeviceptr,
    pub(super) robots: c_int,
    pub(super) own: u32,
    pub(super) capacity: c_int,
    pub(super) first: c_int,
    pub(super) end: c_int,
    pub(super) warp: c_int,
    pub(super) number: c_int,
}

/// `EnvBlock` of `device/env.cu`.
#[derive(Clone, Copy)]
#[repr(C)]
pub(super) struct EnvArguments {
    pub(super) block: Arguments,
    pub(super) task: CUdeviceptr,
    pub(super) task_numbers: CUdeviceptr,
    pub(super) columns: CUdeviceptr,
    pub(super) words: CUdeviceptr,
    pub(super) actions: CUdeviceptr,
    pub(super) observations: CUdeviceptr,
    pub(super) finals: CUdeviceptr,
    pub(super) rewards: CUdeviceptr,
    pub(super) commands: CUdeviceptr,
    pub(super) terminated: CUdeviceptr,
    pub(super) truncated: CUdeviceptr,
    pub(super) kept: CUdeviceptr,
    pub(super) given: CUdeviceptr,
    pub(super) host_observations: CUdeviceptr,
    pub(super) host_finals: CUdeviceptr,
    pub(super) host_rewards: CUdeviceptr,
    pub(super) host_commands: CUdeviceptr,
    pub(super) flags: CUdeviceptr,
    pub(super) ended: CUdeviceptr,
    pub(super) ended_size: c_int,
    pub(super) warp: c_int,
}

/// Memory of the host that the card reads and writes directly.
pub(super) struct Pinned<T> {
    start: NonNull<T>,
    pub(super) len: usize,
    context: Arc<CudaContext>,
}

// SAFETY: the memory belongs to this value alone
unsafe impl<T: Send> Send for Pinned<T> {}
// SAFETY: shared references give no access to it
unsafe impl<T: Sync> Sync for Pinned<T> {}

/// Types for which zeros are values, and which need no drop.
pub(super) trait Plain: Copy {}
impl Plain for f32 {}
impl Plain for u32 {}
impl Plain for Arguments {}
impl Plain for EnvArguments {}

impl<T: Plain> Pinned<T> {
    /// Numbers that are zero.
    pub(super) fn new(context: &Arc<CudaContext>, len: usize) -> Result<Self, DriverError> {
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
    pub(super) fn address(&self) -> CUdeviceptr {
        self.start.as_ptr().expose_provenance() as CUdeviceptr
    }

    pub(super) fn numbers(&mut self) -> &mut [T] {
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
