//! Tasks and envs as a device has them.

pub(crate) use polypod_cuda::{
    AutoresetForm, BODY_NUMBERS, BodyList, Column, CombineForm, CommandForm, Delay, Device, DeviceError, DeviceRows,
    DrawForm, Ended, EnvHost, Flow, Form, FormKind, ObservationForm, RewardForm, RowSizes, RowsOf, SLOTS, Slot,
    TaskForm, TaskTables, Tiles, Word, flags,
};
