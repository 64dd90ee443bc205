//! NumPy arrays: those that hold the batch, those that are handed out, and those of callers.

use numpy::ndarray::IntoDimension;
use numpy::{
    Element, PyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray, PyUntypedArray, PyUntypedArrayMethods,
};
use polypod::batch::Batch;
use polypod::workers::Workers;
use pyo3::prelude::*;

use super::exceptions::{type_error, value_error};

/// The arrays that Python sees, allocated once: copies of the batch, made with Python's lock held.
///
/// `src/README.md` says why systems do not write here directly, and what the copies cost.
pub(super) struct BatchArrays {
    /// Two arrays in turn, so that a learner may store the present one after the next step.
    pub(super) observations: [Py<PyArray2<f32>>; 2],
    pub(super) current: usize,
    pub(super) reward: Py<PyArray1<f32>>,
    pub(super) terminated: Py<PyArray1<bool>>,
    pub(super) truncated: Py<PyArray1<bool>>,
    pub(super) final_obs: Py<PyArray2<f32>>,
    pub(super) final_mask: Py<PyArray1<bool>>,
    pub(super) command: Py<PyArray2<f32>>,
}

impl BatchArrays {
    /// Arrays of zeros for a batch.
    pub(super) fn zeros(py: Python<'_>, num_envs: usize, num_obs: usize) -> Self {
        let matrix = |width: usize| PyArray2::<f32>::zeros(py, [num_envs, width], false).unbind();
        let flags = || PyArray1::<bool>::zeros(py, num_envs, false).unbind();
        Self {
            observations: [matrix(num_obs), matrix(num_obs)],
            current: 1,
            reward: PyArray1::<f32>::zeros(py, num_envs, false).unbind(),
            terminated: flags(),
            truncated: flags(),
            final_obs: matrix(num_obs),
            final_mask: flags(),
            command: matrix(3),
        }
    }

    /// Copies the observations into the array in turn.
    pub(super) fn publish_observations(&mut self, py: Python<'_>, batch: &Batch, workers: &Workers) -> PyResult<()> {
        self.current = 1 - self.current;
        self.update_observations(py, batch, workers)
    }

    /// Copies the observations into the array that is shown.
    pub(super) fn update_observations(&self, py: Python<'_>, batch: &Batch, workers: &Workers) -> PyResult<()> {
        fill(py, workers, &self.observations[self.current], &batch.observations)
    }

    /// Copies the flags of ended episodes.
    pub(super) fn publish_ends(&self, py: Python<'_>, batch: &Batch, workers: &Workers) -> PyResult<()> {
        fill(py, workers, &self.terminated, &batch.terminated)?;
        fill(py, workers, &self.truncated, &batch.truncated)
    }

    /// Copies the batch, but for commands. Final observations are copied where there are any.
    pub(super) fn publish(&mut self, py: Python<'_>, batch: &Batch, workers: &Workers) -> PyResult<()> {
        self.publish_observations(py, batch, workers)?;
        self.publish_ends(py, batch, workers)?;
        fill(py, workers, &self.reward, &batch.rewards)?;
        fill(py, workers, &self.final_mask, &batch.has_final)?;
        let mut final_obs = self.final_obs.bind(py).try_readwrite()?;
        let width = batch.num_obs.max(1);
        let rows = final_obs.as_slice_mut()?.chunks_exact_mut(width).zip(batch.final_observations.chunks_exact(width));
        for ((to, from), _) in rows.zip(&batch.has_final).filter(|(_, valid)| **valid) {
            to.copy_from_slice(from);
        }
        Ok(())
    }
}

/// Size from which threads share a copy.
const LARGE: usize = 1 << 16;

pub(super) fn fill<T: Element + Copy + Send + Sync, D: numpy::ndarray::Dimension>(
    py: Python<'_>,
    workers: &Workers,
    array: &Py<PyArray<T, D>>,
    values: &[T],
) -> PyResult<()> {
    let mut target = array.bind(py).try_readwrite()?;
    let target = target.as_slice_mut()?;
    if values.len() < LARGE || values.len() != target.len() {
        target.copy_from_slice(values);
    } else {
        workers.for_each_chunk((target, values), values.len(), |_, _, (to, from)| to.copy_from_slice(from));
    }
    Ok(())
}

/// A shape as Python writes it.
pub(super) fn tuple(shape: &[usize]) -> String {
    let sizes: Vec<String> = shape.iter().map(usize::to_string).collect();
    if let [size] = &sizes[..] { format!("({size},)") } else { format!("({})", sizes.join(", ")) }
}

/// An argument as a C-contiguous array of the right dtype and shape.
pub(super) fn array<'py, T: Element, D: numpy::ndarray::Dimension>(
    name: &str,
    value: &Bound<'py, PyAny>,
    dtype: &str,
    shape: &[usize],
) -> PyResult<PyReadonlyArray<'py, T, D>> {
    let Ok(untyped) = value.cast::<PyUntypedArray>() else {
        let got = value.get_type().name()?;
        return Err(type_error(format!("{name}: a {got}; pass a NumPy array of {dtype} of shape {}", tuple(shape))));
    };
    if untyped.shape() != shape {
        let (got, wanted) = (tuple(untyped.shape()), tuple(shape));
        return Err(value_error(format!("{name}: shape {got}, not {wanted}; pass one row per env")));
    }
    let Ok(typed) = value.cast::<PyArray<T, D>>() else {
        let got = untyped.dtype();
        return Err(type_error(format!("{name}: dtype {got}, not {dtype}; convert it with .astype(np.{dtype})")));
    };
    if !typed.is_c_contiguous() {
        return Err(value_error(format!("{name}: not C-contiguous; pass np.ascontiguousarray({name})")));
    }
    Ok(typed.try_readonly()?)
}

/// Numbers as an array of this shape, guarded against writing.
pub(super) fn shaped<T: Element, const N: usize>(
    py: Python<'_>,
    numbers: Vec<T>,
    shape: [usize; N],
) -> PyResult<Bound<'_, PyAny>>
where
    [usize; N]: IntoDimension<Dim: numpy::ndarray::Dimension>,
{
    read_only(PyArray1::from_vec(py, numbers).reshape(shape)?.into_any())
}

/// Numbers as `count` rows of the same length, guarded against writing.
pub(super) fn rows(py: Python<'_>, numbers: Vec<f64>, count: usize) -> PyResult<Bound<'_, PyAny>> {
    let width = numbers.len() / count.max(1);
    shaped(py, numbers, [count, width])
}

/// An array that is handed out, guarded against writing: what is written would change nothing.
pub(super) fn read_only(array: Bound<'_, PyAny>) -> PyResult<Bound<'_, PyAny>> {
    array.getattr("flags")?.setattr("writeable", false)?;
    Ok(array)
}

/// A view of an array of the simulator, guarded against writing.
pub(super) fn view<'py>(array: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    read_only(array.call_method0("view")?)
}
