//! The control steps of all blocks on their way to a card.

use std::ffi::c_int;
use std::sync::{Arc, Mutex};

use cudarc::driver::sys::{CUdeviceptr, CUevent_flags, CUresult};
use cudarc::driver::{
    CudaContext, CudaEvent, CudaFunction, CudaSlice, CudaStream, DriverError, LaunchConfig, PushKernelArg, result, sys,
};

use super::pinned::{Arguments, EnvArguments, Pinned, Plain};
use super::{THREADS, call};
use crate::device::DeviceError;
use crate::envs::{Flow, RowSizes, RowsMemory, SLOTS};
use crate::kernels::{Kernel, locked};

/// Warps of a block of the kernel of envs.
const WARPS_OF_ENVS: usize = 2;

/// The control steps of all blocks. One launch of the common kernel takes all its blocks, so that
/// the card is full and the host calls the driver once.
pub(super) struct Queue {
    pub(super) stream: Arc<CudaStream>,
    launch: Mutex<Launch>,
    env_launch: Mutex<EnvLaunch>,
    /// Arrays of all envs.
    pub(super) rows: Mutex<Option<Arc<Rows>>>,
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
pub(super) struct Rows {
    pub(super) sizes: RowSizes,
    pub(super) numbers: CudaSlice<f32>,
    /// Whether episodes failed, and whether they ran out of time.
    pub(super) ends: CudaSlice<u8>,
    /// The stream of all steps.
    pub(super) stream: Arc<CudaStream>,
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

/// Neighbouring blocks of one launch.
struct Group<'a> {
    kernel: &'a Kernel,
    place: usize,
    count: usize,
    warps: usize,
}

impl Queue {
    /// No steps yet. `timed`: launches are measured.
    ///
    /// # Errors
    /// A card that is lost.
    pub(super) fn new(context: &Arc<CudaContext>, timed: bool) -> Result<Self, DeviceError> {
        let event = || context.new_event(Some(CUevent_flags::CU_EVENT_DEFAULT)).map_err(call("cuEventCreate"));
        let events = if timed { Some([event()?, event()?]) } else { None };
        let stream = context.new_stream().map_err(call("cuStreamCreate"))?;
        let mark = || context.new_event(Some(CUevent_flags::CU_EVENT_DISABLE_TIMING)).map_err(call("cuEventCreate"));
        let marks = (0..=SLOTS).map(|_| mark()).collect::<Result<Vec<_>, _>>()?;
        let flow = marks.try_into().map_err(|_| DeviceError::no_envs())?;
        Ok(Self {
            stream,
            launch: Mutex::default(),
            env_launch: Mutex::default(),
            rows: Mutex::default(),
            flow,
            others: Mutex::default(),
            events,
        })
    }

    /// Adds a block to the next [`launch`](Self::launch).
    pub(super) fn add(&self, kernel: Kernel, block: Arguments) {
        locked(&self.launch).waiting.push((kernel, block));
    }

    /// Adds a block to the next [`step_envs`](Self::step_envs).
    pub(super) fn add_envs(&self, kernel: Kernel, envs: EnvArguments) {
        locked(&self.env_launch).waiting.push((kernel, envs));
    }

    /// Seconds of the last launch, where they are measured.
    pub(super) fn seconds(&self) -> Option<f64> {
        let [before, after] = self.events.as_ref()?;
        before.elapsed_ms(after).ok().map(|ms| f64::from(ms) / 1000.0)
    }

    /// Waits for the card.
    pub(super) fn finish(&self) -> Result<(), DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        let others = locked(&self.others);
        let mut streams = std::iter::once(&self.stream).chain(&*others);
        streams.try_for_each(|stream| stream.synchronize()).map_err(call("cuStreamSynchronize"))
    }

    /// Whether the card has ended all work.
    pub(super) fn is_finished(&self) -> Result<bool, DeviceError> {
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
    pub(super) fn launch(&self) -> Result<(), DeviceError> {
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
    pub(super) fn step_envs(&self, function: &CudaFunction, flow: Option<Flow>) -> Result<(), DeviceError> {
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
    pub(super) fn wait(&self, slot: usize) -> Result<(), DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        self.flow[1 + slot].synchronize().map_err(call("cuEventSynchronize"))
    }

    /// Lets all further work wait for a caller's stream.
    pub(super) fn wait_for_caller(&self, stream: u64) -> Result<(), DeviceError> {
        self.stream.context().bind_to_thread().map_err(call("cuCtxSetCurrent"))?;
        // SAFETY: the caller promises that the stream lives
        unsafe { result::event::record(self.flow[0].cu_event(), caller(stream)) }.map_err(call("cuEventRecord"))?;
        self.stream.wait(&self.flow[0]).map_err(call("cuStreamWaitEvent"))
    }

    pub(super) fn rows(&self) -> Result<Arc<Rows>, DeviceError> {
        locked(&self.rows).clone().ok_or_else(DeviceError::no_envs)
    }
}

/// A caller's stream.
fn caller(stream: u64) -> sys::CUstream {
    std::ptr::with_exposed_provenance_mut(usize::try_from(stream).unwrap_or(0))
}

/// Sizes are counted in integers of 32 bits, as `Tables` checks.
pub(super) fn whole(x: usize) -> c_int {
    c_int::try_from(x).unwrap_or(c_int::MAX)
}
