//! The text of the device (`crates/cuda/device`), compiled as C for the host: what tests compare
//! with the kernels where there is no GPU.

#![warn(missing_docs)]
#![allow(unsafe_code, reason = "the border to C")]

use std::ffi::c_int;
use std::ops::Range;
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::{env, fs, io};

use libloading::Library;
use polypod_cuda::{Block, DEVICE_TEXT, Device, DeviceBlock, DeviceError, Exchange, Parts, Shape, Tables};

/// `Block` of `device/step.cu`.
#[repr(C)]
struct Arguments {
    integers: *const c_int,
    numbers: *const f32,
    parameters: *const f32,
    common: *const f32,
    drive: *const f32,
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

type Step = unsafe extern "C" fn(*const Arguments);

unsafe extern "C" {
    fn polypod_control_step(block: *const Arguments);
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

    /// As [`step_on_host`]. The block must have the tables that the text was compiled for.
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

/// As [`step_on_host`].
#[cfg(not(target_os = "linux"))]
pub fn step_by_threads(block: &mut Block, substeps: Range<usize>) -> bool {
    step_on_host(block, substeps)
}

fn step_with(step: Step, block: &mut Block, substeps: Range<usize>) -> bool {
    let whole = |x: usize| c_int::try_from(x);
    let (Ok(first), Ok(end), Ok(robots), Ok(capacity)) =
        (whole(substeps.start), whole(substeps.end), whole(block.robots()), whole(block.shape().capacity))
    else {
        return false;
    };
    if !block.may_step(&substeps) {
        return false;
    }
    let Parts { integers, numbers, parameters, common, drive, state, report, grid, work, work_integers, own, .. } =
        block.parts();
    let arguments = Arguments {
        integers: integers.as_ptr(),
        numbers: numbers.as_ptr(),
        parameters: parameters.as_ptr(),
        common: common.as_ptr(),
        drive: drive.as_ptr(),
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
    };
    // SAFETY: the arrays have the sizes of the tables' columns, which bound every index of the
    // text; it keeps no pointer
    unsafe { step(&raw const arguments) };
    true
}

/// The host as a device: the engine's path without a GPU.
pub struct Host;

impl Device for Host {
    fn name(&self) -> &str {
        "host"
    }

    fn allocate(&self, shape: Shape) -> Result<Box<dyn DeviceBlock>, DeviceError> {
        Ok(Box::new(HostBlock(Block::of_shape(shape))))
    }
}

struct HostBlock(Block);

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
}
