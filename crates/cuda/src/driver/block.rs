//! The robots of one morphology on a card, and their envs.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use cudarc::driver::sys::{CUdeviceptr, CUresult};
use cudarc::driver::{CudaContext, CudaSlice, DevicePtr, DriverError};

use super::pinned::{Arguments, EnvArguments, Pinned};
use super::queue::{Queue, whole};
use super::{Card, RESERVED, THREADS, call};
use crate::columns::{Exchange, Shape};
use crate::device::{DeviceBlock, DeviceError, EnvBlock};
use crate::envs::{EnvHost, EnvParts, RowsOf, TaskTables, Told};
use crate::kernels::{Kernels, Own};

/// Looks at a number in the host's memory for each question to the driver, which is slow and knows
/// whether the card is lost.
const POLLS_OF_CARD: u32 = 1 << 12;
/// Bytes of a number.
const NUMBER: usize = size_of::<f32>();

/// A block on a card.
pub(super) struct CardBlock {
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
    /// Memory for a block on a card.
    ///
    /// # Errors
    /// Too little memory, or a card that is lost.
    pub(super) fn new(card: &Card, shape: Shape) -> Result<Self, DeviceError> {
        // the robots of a warp make a tile
        let tile = THREADS / card.kernels.prepare(shape.robots)?;
        let shape = shape.with_tile(tile);
        let [work, work_integers] = shape.scratch();
        let exchanged = shape.exchanged();
        let needed = size_of::<f32>() * (work + work_integers + exchanged) + RESERVED;
        let (free, _) = card.context.mem_get_info().map_err(call("cuMemGetInfo"))?;
        let too_little = DeviceError::Memory { needed: needed >> 20, free: free >> 20 };
        if needed > free {
            return Err(too_little);
        }
        let memory = |error: DriverError| match error.0 {
            CUresult::CUDA_ERROR_OUT_OF_MEMORY => too_little.clone(),
            _ => call("cuMemAlloc")(error),
        };
        let stream = &card.queue.stream;
        let integers = stream.clone_htod(&shape.tables.integers).map_err(memory)?;
        let numbers = stream.clone_htod(&shape.tables.numbers).map_err(memory)?;
        let block = Self {
            integers,
            numbers,
            grid: card.grid(&shape.tables.grid, stream).map_err(memory)?,
            parameters: stream.alloc_zeros(1).map_err(memory)?,
            common: stream.alloc_zeros(shape.tables.sizes.parameters.max(1)).map_err(memory)?,
            own_columns: 0,
            exchanged: stream.alloc_zeros(exchanged).map_err(memory)?,
            work: stream.alloc_zeros(work.max(1)).map_err(memory)?,
            work_integers: stream.alloc_zeros(work_integers.max(1)).map_err(memory)?,
            host: Pinned::new(&card.context, exchanged).map_err(memory)?,
            ended: stream.alloc_zeros(2).map_err(memory)?,
            done: Pinned::new(&card.context, 2).map_err(memory)?,
            kernels: card.kernels.clone(),
            own: card.kernels.of_new_block(&shape.tables),
            steps: 0,
            polls: 0,
            queue: card.queue.clone(),
            envs: None,
            context: card.context.clone(),
            shape,
        };
        card.queue.finish()?;
        Ok(block)
    }

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
        self.queue.add(kernel, arguments);
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
        self.queue.add_envs(kernel, arguments);
        Ok(())
    }
}
