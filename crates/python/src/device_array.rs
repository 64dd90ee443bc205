//! Arrays in the memory of a card, for other libraries that compute there.

use std::collections::BTreeMap;
use std::sync::Arc;

use pyo3::exceptions::{PyAttributeError, PyBufferError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use polypod::engine::{DeviceRows, RowsMemory, RowsOf};

/// Kinds of memory of DLPack: the host's, and that of an NVIDIA card.
const MEMORY: [i32; 2] = [1, 2];

#[doc = docstring!("DeviceArray")]
#[pyclass(module = "polypod._core", frozen)]
pub(super) struct DeviceArray {
    address: u64,
    shape: Vec<usize>,
    is_flag: bool,
    card: Option<usize>,
    memory: Arc<dyn RowsMemory>,
}

impl DeviceArray {
    /// The arrays of a simulation, by the names that `VecSim` has for them.
    pub(super) fn all(rows: &DeviceRows) -> BTreeMap<&'static str, Self> {
        let sizes = rows.sizes;
        let array = |address: u64, width: Option<usize>, is_flag: bool| Self {
            address,
            shape: [sizes.envs].into_iter().chain(width).collect(),
            is_flag,
            card: rows.card,
            memory: rows.memory.clone(),
        };
        let numbers = |of: RowsOf, width: Option<usize>| array(rows.address(of), width, false);
        BTreeMap::from([
            ("actions", numbers(RowsOf::Given, Some(sizes.actions))),
            ("observation", numbers(RowsOf::Observations, Some(sizes.observations))),
            ("final_obs", numbers(RowsOf::Finals, Some(sizes.observations))),
            ("reward", numbers(RowsOf::Rewards, None)),
            ("command", numbers(RowsOf::Commands, Some(3))),
            ("terminated", array(rows.ends, None, true)),
            ("truncated", array(rows.ends + sizes.envs as u64, None, true)),
        ])
    }
}

#[pymethods]
impl DeviceArray {
    #[doc = docstring!("DeviceArray.shape")]
    #[getter]
    fn shape(&self) -> Vec<usize> {
        self.shape.clone()
    }

    #[doc = docstring!("DeviceArray.dtype")]
    #[getter]
    fn dtype(&self) -> &'static str {
        if self.is_flag { "bool" } else { "float32" }
    }

    #[doc = docstring!("DeviceArray.address")]
    #[getter]
    fn address(&self) -> u64 {
        self.address
    }

    #[getter]
    fn __cuda_array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        if self.card.is_none() {
            return Err(PyAttributeError::new_err("__cuda_array_interface__"));
        }
        let interface = PyDict::new(py);
        interface.set_item("shape", pyo3::types::PyTuple::new(py, &self.shape)?)?;
        interface.set_item("typestr", if self.is_flag { "|b1" } else { "<f4" })?;
        interface.set_item("data", (self.address, false))?;
        interface.set_item("strides", py.None())?;
        interface.set_item("version", 3)?;
        Ok(interface)
    }

    fn __dlpack_device__(&self) -> (i32, usize) {
        (MEMORY[usize::from(self.card.is_some())], self.card.unwrap_or(0))
    }

    #[pyo3(signature = (*, stream=None, max_version=None, dl_device=None, copy=None))]
    fn __dlpack__<'py>(
        slf: &Bound<'py, Self>,
        stream: Option<i64>,
        max_version: Option<(u32, u32)>,
        dl_device: Option<(i32, usize)>,
        copy: Option<bool>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let _ = max_version;
        let this = slf.get();
        if copy == Some(true) || dl_device.is_some_and(|device| device != this.__dlpack_device__()) {
            return Err(PyBufferError::new_err("an array on the card is shared where it is; copy what you got"));
        }
        // -1: the consumer orders its work itself; none: it works on the default stream
        if let Ok(stream) = u64::try_from(stream.unwrap_or(0)) {
            this.memory.let_wait(stream).map_err(|error| PyBufferError::new_err(error.to_string()))?;
        }
        slf.py().import("polypod.dlpack")?.call_method1("capsule", (slf,))
    }
}
