//! Tasks and envs as a device has them.

pub(crate) use polypod_cuda::{
    AutoresetForm, Column, Delay, Device, DeviceError, DeviceRows, Ended, EnvHost, Flow, Form, FormKind,
    ObservationForm, RewardForm, RowSizes, RowsOf, SLOTS, Slot, TaskForm, TaskTables, Tiles, Word, flags,
};
