//! Tasks and envs as a device has them.

pub(crate) use polypod_cuda::{
    AutoresetForm, Column, Delay, DeviceError, Ended, EnvHost, Form, FormKind, ObservationForm, RewardForm, Slot,
    TaskForm, TaskTables, Word, flags,
};
