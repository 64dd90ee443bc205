//! Arguments that say which envs, and a row of numbers for each of them.

use numpy::{PyArrayDyn, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::arrays::tuple;
use super::exceptions::{type_error, unsigned, value_error};
use polypod::StateRows;

/// An argument as NumPy's array of numbers.
fn as_array<'py>(element: &str, value: &Bound<'py, PyAny>) -> PyResult<(Bound<'py, PyAny>, String)> {
    let py = value.py();
    let array = py.import("numpy")?.call_method1("asarray", (value,)).map_err(|error| {
        type_error(format!("{element}: no array of numbers ({error}); pass a NumPy array or nested lists"))
    })?;
    let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
    Ok((array, kind))
}

/// The envs that an argument names: all of them where it is absent.
pub(super) fn env_ids(method: &str, value: Option<&Bound<'_, PyAny>>, num_envs: usize) -> PyResult<Vec<usize>> {
    let Some(value) = value else {
        return Ok((0..num_envs).collect());
    };
    let element = format!("{method}: env_ids");
    let (array, kind) = as_array(&element, value)?;
    let size: usize = array.getattr("size")?.extract()?;
    if kind == "b" {
        return Err(type_error(format!("{element}: a mask; pass indices, e.g. np.flatnonzero(mask)")));
    }
    if size == 0 {
        return Ok(Vec::new());
    }
    if kind != "i" && kind != "u" {
        let dtype = array.getattr("dtype")?;
        return Err(type_error(format!("{element}: dtype {dtype}, not integers; pass env ids such as [0, 3]")));
    }
    let ids: Vec<i64> = array.call_method1("astype", ("int64",))?.call_method0("ravel")?.extract()?;
    if array.getattr("ndim")?.extract::<usize>()? > 1 {
        return Err(value_error(format!("{element}: more than one dimension; pass a list of env ids")));
    }
    let id = |id: i64| {
        let problem = || value_error(format!("{element}: there is no env {id}; the envs are 0 to {}", num_envs - 1));
        usize::try_from(id).map_err(|_| problem())
    };
    ids.into_iter().map(id).collect()
}

/// Whether a `frame` of forces is the world's; the other one is the link's.
pub(super) fn in_world(frame: &str) -> PyResult<bool> {
    match frame {
        "world" => Ok(true),
        "link" => Ok(false),
        _ => Err(value_error(format!("apply_force: frame: there is no `{frame}`; use \"world\" or \"link\""))),
    }
}

/// Number of control steps for which a force acts: `steps`, or as many as `duration_s` takes.
pub(super) fn force_steps(py: Python<'_>, steps: Option<i128>, duration_s: Option<f64>, step_dt: f64) -> PyResult<u32> {
    match (steps, duration_s) {
        (Some(_), Some(_)) => {
            Err(value_error("apply_force: duration_s: given together with steps; pass one of them".into()))
        }
        (Some(steps), None) => unsigned(py, "apply_force: steps", steps),
        (None, None) => Ok(1),
        (None, Some(seconds)) => {
            let steps = (seconds / step_dt - 1e-6).ceil();
            if !(1.0..=f64::from(u32::MAX)).contains(&steps) {
                let problem = format!("apply_force: duration_s: {seconds} s; pass a positive time");
                return Err(value_error(problem));
            }
            Ok(steps as u32)
        }
    }
}

/// Rows of `width` numbers for each of `count` envs, in single precision: an array [count, width],
/// or one row for all of them. Where `width` is one, [count] and a single number are taken too, and
/// a single number for all columns where `spreads`.
pub(super) fn numbers(
    element: &str,
    value: &Bound<'_, PyAny>,
    (count, width): (usize, usize),
    spreads: bool,
) -> PyResult<Vec<f32>> {
    let (array, kind) = as_array(element, value)?;
    if !["f", "i", "u"].contains(&kind.as_str()) {
        let dtype = array.getattr("dtype")?;
        return Err(type_error(format!("{element}: dtype {dtype}; pass an array of numbers")));
    }
    let array = array.call_method1("astype", ("float64",))?;
    let array = array.cast_into::<PyArrayDyn<f64>>()?;
    let shape = array.shape().to_vec();
    let row: Vec<f64> = array.readonly().as_array().iter().copied().collect();
    let row: Vec<f32> = row.into_iter().map(|x| x as f32).collect();
    match &shape[..] {
        [] if width == 1 || spreads => Ok(vec![row[0]; count * width]),
        [n] if width == 1 && *n == count => Ok(row),
        [n] if *n == width => Ok(row.repeat(count)),
        [n, m] if *n == count && *m == width => Ok(row),
        _ => {
            let wanted = if width == 1 { tuple(&[count]) } else { tuple(&[count, width]) };
            let got = tuple(&shape);
            Err(value_error(format!("{element}: shape {got}, not {wanted}; pass one row per env of env_ids")))
        }
    }
}

/// Quantities of a state, as [`StateRows`] has them.
#[derive(Default)]
pub(super) struct StateArguments([Option<Vec<f32>>; 6]);

/// Names and widths of the quantities; `None` stands for the number of slots.
const QUANTITIES: [(&str, Option<usize>); 6] = [
    ("base_pos", Some(3)),
    ("base_quat", Some(4)),
    ("base_lin_vel", Some(3)),
    ("base_ang_vel", Some(3)),
    ("joint_pos", None),
    ("joint_vel", None),
];

impl StateArguments {
    /// Reads the arguments of `set_state`, in the order of [`QUANTITIES`].
    pub(super) fn new(values: [Option<&Bound<'_, PyAny>>; 6], count: usize, slots: usize) -> PyResult<Self> {
        let mut all = Self::default();
        for ((to, value), (name, width)) in all.0.iter_mut().zip(values).zip(QUANTITIES) {
            if let Some(value) = value {
                let width = width.unwrap_or(slots);
                *to = Some(numbers(&format!("set_state: {name}"), value, (count, width), false)?);
            }
        }
        Ok(all)
    }

    /// Reads a dictionary with these arguments.
    pub(super) fn of_dict(values: &Bound<'_, PyDict>, count: usize, slots: usize) -> PyResult<Self> {
        let names: Vec<&str> = QUANTITIES.iter().map(|(name, _)| *name).collect();
        for key in values.keys() {
            let key: String = key.extract()?;
            if !names.contains(&key.as_str()) {
                return Err(value_error(format!("state: there is no `{key}`; use some of {}", names.join(", "))));
            }
        }
        let mut found: [Option<Bound<'_, PyAny>>; 6] = Default::default();
        for (to, name) in found.iter_mut().zip(names) {
            *to = values.get_item(name)?.filter(|value| !value.is_none());
        }
        Self::new(found.each_ref().map(Option::as_ref), count, slots)
    }

    /// Quantities that were given, as rows of the simulation's `set_states`.
    pub(super) fn rows(&self) -> StateRows<'_> {
        let [base_pos, base_quat, base_lin_vel, base_ang_vel, joint_pos, joint_vel] =
            self.0.each_ref().map(Option::as_deref);
        StateRows { base_pos, base_quat, base_lin_vel, base_ang_vel, joint_pos, joint_vel }
    }
}
