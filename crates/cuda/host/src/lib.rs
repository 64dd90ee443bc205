//! The text of the device (`crates/cuda/device`), compiled as C for the host: what tests compare
//! with the kernels where there is no GPU.

#![warn(missing_docs)]
#![allow(unsafe_code, reason = "the border to C")]

use std::ffi::c_int;
use std::ops::Range;

use polypod_cuda::{Block, Columns, Device, DeviceBlock, DeviceError, Parts, Shape};

/// `Block` of `device/step.cu`.
#[repr(C)]
struct Arguments {
    integers: *const c_int,
    numbers: *const f32,
    parameters: *const f32,
    drive: *const f32,
    state: *mut f32,
    report: *mut f32,
    grid: *const f32,
    work: *mut f32,
    work_integers: *mut c_int,
    robots: c_int,
    shared: c_int,
    capacity: c_int,
    first: c_int,
    end: c_int,
}

unsafe extern "C" {
    fn polypod_control_step(block: *const Arguments);
}

/// Makes some physics steps of a control step on the host. Returns whether it could: the
/// steps must be of the control step, and the robots must have parameters.
pub fn step_on_host(block: &mut Block, substeps: Range<usize>) -> bool {
    let whole = |x: usize| c_int::try_from(x);
    let (Ok(first), Ok(end), Ok(robots), Ok(capacity)) =
        (whole(substeps.start), whole(substeps.end), whole(block.robots()), whole(block.shape().capacity))
    else {
        return false;
    };
    if !block.may_step(&substeps) {
        return false;
    }
    let Parts { integers, numbers, parameters, drive, state, report, grid, work, work_integers, shared, .. } =
        block.parts();
    let arguments = Arguments {
        integers: integers.as_ptr(),
        numbers: numbers.as_ptr(),
        parameters: parameters.as_ptr(),
        drive: drive.as_ptr(),
        state: state.as_mut_ptr(),
        report: report.as_mut_ptr(),
        grid: grid.as_ptr(),
        work: work.as_mut_ptr(),
        work_integers: work_integers.as_mut_ptr(),
        robots,
        shared: c_int::from(shared),
        capacity,
        first,
        end,
    };
    // SAFETY: the arrays have the sizes of the tables' columns, which bound every index of the
    // text; it keeps no pointer
    unsafe { polypod_control_step(&raw const arguments) };
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

    fn columns(&mut self) -> Columns<'_> {
        self.0.columns()
    }

    fn set_parameters(&mut self, all: &[f32], shared: bool, _changed: &[usize]) -> Result<(), DeviceError> {
        self.0.set_parameters(all, shared);
        Ok(())
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        let steps = 0..self.0.shape().decimation();
        let made = step_on_host(&mut self.0, steps);
        if made { Ok(()) } else { Err(DeviceError::Call { call: "step_on_host", text: "no parameters".into() }) }
    }

    fn finish(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }
}
