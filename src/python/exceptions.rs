//! Errors as Python exceptions: each is also the standard exception that a Python user would expect.

use pyo3::exceptions::{PyException, PyKeyError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyDict, PyTuple, PyType};

use polypod::app::SimError;
use polypod::config::{ConfigError, ConfigErrorKind};
use polypod::morphology::MorphologyError;
use polypod::simulation::SimulationError;
use polypod::systems::TermError;

struct Exceptions {
    polypod: Py<PyType>,
    config: Py<PyType>,
    robot: Py<PyType>,
    unknown_name: Py<PyType>,
}

static EXCEPTIONS: PyOnceLock<Exceptions> = PyOnceLock::new();

fn exceptions(py: Python<'_>) -> PyResult<&Exceptions> {
    EXCEPTIONS.get_or_try_init(py, || {
        let polypod = class(py, "PolypodError", &[py.get_type::<PyException>()])?;
        let config = class(py, "ConfigError", &[polypod.clone(), py.get_type::<PyValueError>()])?;
        let robot = class(py, "RobotError", &[polypod.clone(), py.get_type::<PyValueError>()])?;
        let unknown_name = class(py, "UnknownNameError", &[config.clone(), py.get_type::<PyKeyError>()])?;
        // KeyError would show the representation of its message
        unknown_name.setattr("__str__", py.get_type::<PyException>().getattr("__str__")?)?;
        Ok(Exceptions {
            polypod: polypod.unbind(),
            config: config.unbind(),
            robot: robot.unbind(),
            unknown_name: unknown_name.unbind(),
        })
    })
}

fn class<'py>(py: Python<'py>, name: &str, bases: &[Bound<'py, PyType>]) -> PyResult<Bound<'py, PyType>> {
    let namespace = PyDict::new(py);
    namespace.set_item("__module__", "polypod._core")?;
    let class = py.get_type::<PyType>().call1((name, PyTuple::new(py, bases)?, namespace))?;
    Ok(class.cast_into::<PyType>()?)
}

pub(super) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    let all = exceptions(py)?;
    module.add("PolypodError", all.polypod.bind(py))?;
    module.add("ConfigError", all.config.bind(py))?;
    module.add("RobotError", all.robot.bind(py))?;
    module.add("UnknownNameError", all.unknown_name.bind(py))
}

/// The exception of an error.
pub(super) fn to_python(py: Python<'_>, error: SimError) -> PyErr {
    let all = match exceptions(py) {
        Ok(all) => all,
        Err(error) => return error,
    };
    let message = error.to_string();
    let class = match &error {
        SimError::Config(error)
        | SimError::Term(TermError::Config(error))
        | SimError::Morphology(MorphologyError::Config(error)) => config_class(all, error),
        SimError::Morphology(MorphologyError::Robot(_)) => &all.robot,
        SimError::Argument { .. }
        | SimError::Simd(_)
        | SimError::World(_)
        | SimError::Snapshot(_)
        | SimError::Dump(_) => &all.config,
    };
    PyErr::from_type(class.bind(py).clone(), message)
}

/// The exception of an error of a simulation without a task.
pub(super) fn simulation_error(py: Python<'_>, error: SimulationError) -> PyErr {
    let all = match exceptions(py) {
        Ok(all) => all,
        Err(error) => return error,
    };
    let class = match &error {
        SimulationError::Config(error) => config_class(all, error),
        SimulationError::Robot(_) => &all.robot,
        // arguments, instruction sets, snapshots
        _ => &all.config,
    };
    PyErr::from_type(class.bind(py).clone(), error.to_string())
}

fn config_class<'a>(all: &'a Exceptions, error: &ConfigError) -> &'a Py<PyType> {
    if error.kind == ConfigErrorKind::UnknownName { &all.unknown_name } else { &all.config }
}

/// A `TypeError`.
pub(super) fn type_error(message: String) -> PyErr {
    PyTypeError::new_err(message)
}

/// A plain `ValueError`, for arrays.
pub(super) fn value_error(message: String) -> PyErr {
    PyValueError::new_err(message)
}
