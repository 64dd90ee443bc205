#![doc = include_str!("../README.md")]
#![deny(unsafe_code)]
#![warn(missing_docs)]

mod columns;
mod device;
mod driver;
mod layout;
mod nvrtc;
mod tables;

pub use columns::{Block, Columns, Motion, Parts, ROBOTS_OF_TILE, Shape, list};
pub use device::{Device, DeviceBlock, DeviceError};
pub use driver::{Card, Found, find};
pub use nvrtc::{compile, search_packages};
pub use tables::{Scene, Sizes, Tables, Unsupported};

/// The text of the device, file by file: its name and its contents. `step.cu` includes the others.
pub const DEVICE_TEXT: [(&str, &str); 12] = [
    ("step.cu", include_str!("../device/step.cu")),
    ("step.h", include_str!("../device/step.h")),
    ("solver.h", include_str!("../device/solver.h")),
    ("bounds.h", include_str!("../device/bounds.h")),
    ("pairs.h", include_str!("../device/pairs.h")),
    ("terrain.h", include_str!("../device/terrain.h")),
    ("ground.h", include_str!("../device/ground.h")),
    ("rows.h", include_str!("../device/rows.h")),
    ("kinematics.h", include_str!("../device/kinematics.h")),
    ("factor.h", include_str!("../device/factor.h")),
    ("tables.h", include_str!("../device/tables.h")),
    ("numbers.h", include_str!("../device/numbers.h")),
];
