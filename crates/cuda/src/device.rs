//! Devices, as an engine sees them: memory for blocks of robots, and their steps.

use crate::columns::{Exchange, Shape};
use crate::envs::{DeviceRows, EnvHost, Flow, RowSizes, RowsOf, TaskTables, Told};
use crate::tables::Unsupported;

/// Why a device cannot be used, or no longer.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DeviceError {
    /// The driver's library is not there.
    #[error("there is no driver of an NVIDIA card here (libcuda)")]
    NoDriver,
    /// The driver sees no card.
    #[error("the driver sees no NVIDIA card: {0}")]
    NoCard(String),
    /// A driver that is older than the first that loads the text.
    #[error("the driver knows CUDA {}.{} at most, and {}.{} is needed", .0 / 1000, .0 % 1000 / 10, .1 / 1000, .1 % 1000 / 10)]
    OldDriver(i32, i32),
    /// A card of an older generation.
    #[error("the card {name} has compute capability {}.{}, and 8.0 is needed", .capability.0, .capability.1)]
    OldCard {
        /// Name of the card.
        name: String,
        /// Compute capability of the card.
        capability: (i32, i32),
    },
    /// The compiler NVRTC is not there.
    #[error("there is no NVRTC here, which compiles the text for the card (libnvrtc)")]
    NoCompiler,
    /// The compiler refuses the text.
    #[error("NVRTC cannot compile the text for the card: {0}")]
    Compiler(String),
    /// The variable that names the kernels names none.
    #[error("POLYPOD_CUDA_KERNELS is `{0}`, which is none of common, own and ready")]
    Kernels(String),
    /// The card's memory or the host's pinned memory is too small.
    #[error("the card has {free} MB of memory free, and {needed} MB are needed")]
    Memory {
        /// MB that are needed.
        needed: usize,
        /// MB that are free.
        free: usize,
    },
    /// A call of the driver failed.
    #[error("{call}: {text}")]
    Call {
        /// Name of the call.
        call: &'static str,
        /// The driver's text.
        text: String,
    },
    /// A feature that the text lacks.
    #[error(transparent)]
    Unsupported(#[from] Unsupported),
}

impl DeviceError {
    /// The error of a device that does not know envs.
    pub fn no_envs() -> Self {
        Self::Call { call: "envs", text: "the device makes no whole control steps".into() }
    }

    /// Advice for the user.
    pub fn remedy(&self) -> &'static str {
        match self {
            Self::NoDriver => "install NVIDIA's driver, or use \"articulated\", which has the same bits on the CPU",
            Self::NoCard(_) => "look at nvidia-smi and CUDA_VISIBLE_DEVICES, or use \"articulated\"",
            Self::OldDriver(..) => "install a newer driver of NVIDIA's, or use \"articulated\"",
            Self::OldCard { .. } => "use a card of the Ampere generation or newer, or \"articulated\"",
            Self::NoCompiler => "install torch for CUDA, or set POLYPOD_NVRTC to libnvrtc.so, or use \"articulated\"",
            Self::Kernels(_) => "leave the variable out, or name one of them",
            Self::Memory { .. } => "use fewer envs, or \"articulated\"",
            Self::Compiler(_) | Self::Call { .. } => "use \"articulated\", which has the same bits on the CPU",
            Self::Unsupported(_) => "use \"articulated\"",
        }
    }
}

/// A device that steps blocks of robots.
pub trait Device: Send + Sync {
    /// Name of the device.
    fn name(&self) -> &str;

    /// Prepares steps of that many robots in all, before their memory is allocated. The first call
    /// counts.
    ///
    /// # Errors
    /// A compiler that refuses the text.
    fn prepare(&self, _robots: usize) -> Result<(), DeviceError> {
        Ok(())
    }

    /// Memory for a block. Drive, state and parameters are zero.
    ///
    /// # Errors
    /// Too little memory, or a device that is lost.
    fn allocate(&self, shape: Shape) -> Result<Box<dyn DeviceBlock>, DeviceError>;

    /// Begins the control steps of all blocks that [`start`](DeviceBlock::start) noted since the
    /// last call.
    ///
    /// # Errors
    /// A device that is lost.
    fn launch(&self) -> Result<(), DeviceError> {
        Ok(())
    }

    /// Makes room for the arrays of all envs, which the blocks share. Arrays of these sizes stay
    /// where they are.
    ///
    /// # Errors
    /// Too little memory, or a device that is lost.
    fn place_rows(&self, _sizes: RowSizes) -> Result<(), DeviceError> {
        Err(DeviceError::no_envs())
    }

    /// The arrays of all envs; `None` before there are any.
    fn rows(&self) -> Option<DeviceRows> {
        None
    }

    /// Copies an array to the host, after the work of all control steps.
    ///
    /// # Errors
    /// A device that is lost.
    fn read_rows(&self, _of: RowsOf, _to: &mut [f32]) -> Result<(), DeviceError> {
        Err(DeviceError::no_envs())
    }

    /// Copies an array from the host.
    ///
    /// # Errors
    /// A device that is lost.
    fn write_rows(&self, _of: RowsOf, _from: &[f32]) -> Result<(), DeviceError> {
        Err(DeviceError::no_envs())
    }

    /// Copies the flags of ended episodes from the host: whether they failed, then whether they ran
    /// out of time.
    ///
    /// # Errors
    /// A device that is lost.
    fn write_ends(&self, _ends: &[u8]) -> Result<(), DeviceError> {
        Err(DeviceError::no_envs())
    }

    /// Waits for a caller's queue on the device, see [`Flow::stream`].
    ///
    /// # Errors
    /// A device that is lost.
    fn wait_for_caller(&self, _stream: u64) -> Result<(), DeviceError> {
        Ok(())
    }

    /// Makes the whole control steps of all blocks that [`EnvBlock::start`] noted since the last
    /// call. Waits for them unless they flow.
    ///
    /// # Errors
    /// A device that is lost.
    fn step_envs(&self, _flow: Option<Flow>) -> Result<(), DeviceError> {
        Ok(())
    }

    /// Waits for the control step of a slot.
    ///
    /// # Errors
    /// A device that is lost.
    fn wait(&self, _slot: usize) -> Result<(), DeviceError> {
        Ok(())
    }

    /// Seconds between the beginning and the end of the last launch, where the device measures
    /// them.
    fn seconds(&self) -> Option<f64> {
        None
    }
}

/// The robots of one morphology on a device. An error means that the device is lost.
pub trait DeviceBlock: Send + Sync {
    /// Tables and sizes.
    fn shape(&self) -> &Shape;

    /// Rows that the host shares with the device. The host reads and writes them only
    /// from when the step [is done](Self::contacts_if_done) to [`Device::launch`].
    fn exchange(&mut self) -> Exchange<'_>;

    /// Takes over parameters: those of all robots, the columns of which each robot reads its own, a
    /// bit for each, and, where there are any, the tiles that have changed.
    ///
    /// # Errors
    /// Too little memory, or a device that is lost.
    fn set_parameters(&mut self, common: &[f32], own: u32, tiles: &[f32], changed: &[usize])
    -> Result<(), DeviceError>;

    /// Notes a control step for the next [`Device::launch`]: drive and state to the device, the
    /// physics steps, state and report to the host.
    ///
    /// # Errors
    /// A device that is lost.
    fn start(&mut self) -> Result<(), DeviceError>;

    /// The most contacts of a robot that press, if the control step has ended. Does not wait. More
    /// contacts than lists have room for are lost.
    ///
    /// # Errors
    /// A device that is lost.
    fn contacts_if_done(&mut self) -> Result<Option<usize>, DeviceError>;

    /// Whether steps are as fast as they will be; asking begins what there is to prepare.
    fn is_ready(&mut self) -> bool {
        true
    }

    /// The envs of the robots, where the device makes whole control steps.
    fn envs(&mut self) -> Option<&mut dyn EnvBlock> {
        None
    }
}

/// The robots of a block with their envs, whose whole control step the device makes: nothing of
/// their state leaves it. An error means that the device is lost.
pub trait EnvBlock {
    /// Takes over a task; `first` is the row of the first env among all. The block's lists must
    /// have room for all impulses.
    ///
    /// # Errors
    /// Too little memory, or a device that is lost.
    fn place(&mut self, task: TaskTables, first: usize) -> Result<(), DeviceError>;

    /// The host's side; `None` before there is a task.
    fn host(&mut self) -> Option<EnvHost<'_>>;

    /// Flags and ended episodes of the control step of a slot, which has ended; `None` before there
    /// is a task.
    fn told(&mut self, slot: usize) -> Option<Told<'_>>;

    /// Whether the next control steps keep the rows of robots whose states break.
    ///
    /// # Errors
    /// Too little memory, or a device that is lost.
    fn watch(&mut self, watched: bool) -> Result<(), DeviceError>;

    /// The rows of a robot that were kept, see [`Shape::kept`](crate::Shape::kept); `None` if it is
    /// not watched.
    ///
    /// # Errors
    /// A device that is lost.
    fn kept(&mut self, robot: usize) -> Result<Option<Vec<f32>>, DeviceError>;

    /// Copies the rows of drive, state and report, columns and words to the device.
    ///
    /// # Errors
    /// A device that is lost.
    fn upload(&mut self) -> Result<(), DeviceError>;

    /// Copies the rows of drive, state and report, columns and words to the host.
    ///
    /// # Errors
    /// A device that is lost.
    fn download(&mut self) -> Result<(), DeviceError>;

    /// Notes a control step for the next [`Device::step_envs`]: with the actions of the host's
    /// side, or of a slot with those that are given on the device.
    ///
    /// # Errors
    /// A device that is lost.
    fn start(&mut self, slot: Option<usize>) -> Result<(), DeviceError>;
}
