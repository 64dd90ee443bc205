#![doc = include_str!("../README.md")]
#![deny(unsafe_code)]
#![warn(missing_docs)]

mod columns;
mod device;
mod driver;
mod envs;
mod heights;
mod kernels;
mod layout;
mod networks;
mod nvrtc;
mod tables;
pub mod update;

pub use columns::{Block, Exchange, Motion, Parts, Shape, list};
pub use device::{Device, DeviceBlock, DeviceError, EnvBlock};
pub use driver::{Card, Found, find};
pub use envs::{
    AutoresetForm, BODY_NUMBERS, BodyList, Column, CombineForm, CommandForm, Delay, DeviceRows, DrawForm, Ended,
    EnvHost, EnvParts, EnvRows, Flow, Form, FormKind, ObservationForm, RewardForm, RowSizes, RowsMemory, RowsOf, SLOTS,
    Slot, StageForm, TaskForm, TaskTables, Tiles, Told, Word, flags,
};
pub use heights::Heights;
pub use nvrtc::{are_kernels_shipped, compile, search_packages};
pub use tables::{Scene, Sizes, Tables, Unsupported};

/// The text of the device without comments, file by file: its name and its contents. `step.cu`,
/// `env.cu` and `learn.cu` include the others.
pub const DEVICE_TEXT: [(&str, &str); 17] = [
    ("step.cu", include_str!(concat!(env!("OUT_DIR"), "/step.cu"))),
    ("env.cu", include_str!(concat!(env!("OUT_DIR"), "/env.cu"))),
    ("learn.cu", include_str!(concat!(env!("OUT_DIR"), "/learn.cu"))),
    ("env.h", include_str!(concat!(env!("OUT_DIR"), "/env.h"))),
    ("block.h", include_str!(concat!(env!("OUT_DIR"), "/block.h"))),
    ("step.h", include_str!(concat!(env!("OUT_DIR"), "/step.h"))),
    ("networks.h", include_str!(concat!(env!("OUT_DIR"), "/networks.h"))),
    ("solver.h", include_str!(concat!(env!("OUT_DIR"), "/solver.h"))),
    ("bounds.h", include_str!(concat!(env!("OUT_DIR"), "/bounds.h"))),
    ("pairs.h", include_str!(concat!(env!("OUT_DIR"), "/pairs.h"))),
    ("terrain.h", include_str!(concat!(env!("OUT_DIR"), "/terrain.h"))),
    ("ground.h", include_str!(concat!(env!("OUT_DIR"), "/ground.h"))),
    ("rows.h", include_str!(concat!(env!("OUT_DIR"), "/rows.h"))),
    ("kinematics.h", include_str!(concat!(env!("OUT_DIR"), "/kinematics.h"))),
    ("factor.h", include_str!(concat!(env!("OUT_DIR"), "/factor.h"))),
    ("tables.h", include_str!(concat!(env!("OUT_DIR"), "/tables.h"))),
    ("numbers.h", include_str!(concat!(env!("OUT_DIR"), "/numbers.h"))),
];
