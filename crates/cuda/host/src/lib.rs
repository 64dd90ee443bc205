//! The text of the device (`crates/cuda/device`), compiled as C for the host: what tests compare
//! with the kernels where there is no GPU.

#![warn(missing_docs)]
#![allow(unsafe_code, reason = "the border to C")]

use std::ffi::c_int;
use std::ops::Range;

use polypod_cuda::{Block, Parts};

/// `Block` of `device/step.cu`.
#[repr(C)]
struct Arguments {
    integers: *const c_int,
    numbers: *const f32,
    parameters: *const f32,
    state: *mut f32,
    drive: *const f32,
    grid: *const f32,
    report: *mut f32,
    touched: *mut c_int,
    work: *mut f32,
    work_integers: *mut c_int,
    robots: c_int,
    shared: c_int,
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
    let (Ok(first), Ok(end), Ok(robots)) = (whole(substeps.start), whole(substeps.end), whole(block.robots())) else {
        return false;
    };
    if !block.may_step(&substeps) {
        return false;
    }
    let Parts {
        integers,
        numbers,
        parameters,
        state,
        drive,
        grid,
        report,
        touched,
        work,
        work_integers,
        shared,
        robots: _,
    } = block.parts();
    let arguments = Arguments {
        integers: integers.as_ptr(),
        numbers: numbers.as_ptr(),
        parameters: parameters.as_ptr(),
        state: state.as_mut_ptr(),
        drive: drive.as_ptr(),
        grid: grid.as_ptr(),
        report: report.as_mut_ptr(),
        touched: touched.as_mut_ptr(),
        work: work.as_mut_ptr(),
        work_integers: work_integers.as_mut_ptr(),
        robots,
        shared: c_int::from(shared),
        first,
        end,
    };
    // SAFETY: the arrays have the sizes of the tables' columns, which bound every index of the
    // text; it keeps no pointer
    unsafe { polypod_control_step(&raw const arguments) };
    true
}
