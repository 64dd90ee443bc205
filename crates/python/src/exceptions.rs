//! Errors as Python exceptions: each is also the standard exception that a Python user would
//! expect.

use std::ops::Deref;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::OnceLock;

use pyo3::exceptions::{PyException, PyKeyError, PyOverflowError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBool, PyDict, PyTuple, PyType};

use polypod::Error;
use polypod::config::ConfigErrorKind;

struct Exceptions {
    polypod: Py<PyType>,
    config: Py<PyType>,
    robot: Py<PyType>,
    unknown_name: Py<PyType>,
}

static EXCEPTIONS: PyOnceLock<Exceptions> = PyOnceLock::new();

fn exceptions(py: Python<'_>) -> PyResult<&Exceptions> {
    EXCEPTIONS.get_or_try_init(py, || {
        let polypod = class(py, "PolypodError", docstring!("PolypodError"), &[py.get_type::<PyException>()])?;
        let config =
            class(py, "ConfigError", docstring!("ConfigError"), &[polypod.clone(), py.get_type::<PyValueError>()])?;
        let robot =
            class(py, "RobotError", docstring!("RobotError"), &[polypod.clone(), py.get_type::<PyValueError>()])?;
        let unknown_name = class(
            py,
            "UnknownNameError",
            docstring!("UnknownNameError"),
            &[config.clone(), py.get_type::<PyKeyError>()],
        )?;
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

fn class<'py>(
    py: Python<'py>,
    name: &str,
    docstring: &str,
    bases: &[Bound<'py, PyType>],
) -> PyResult<Bound<'py, PyType>> {
    let namespace = PyDict::new(py);
    namespace.set_item("__doc__", docstring)?;
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
pub(super) fn to_python(py: Python<'_>, error: Error) -> PyErr {
    let all = match exceptions(py) {
        Ok(all) => all,
        Err(error) => return error,
    };
    let class = match &error {
        Error::Config(error) if error.kind == ConfigErrorKind::UnknownName => &all.unknown_name,
        Error::Robot(_) => &all.robot,
        // systems are the program's: a user can change nothing
        Error::System { .. } => &all.polypod,
        _ => &all.config,
    };
    PyErr::from_type(class.bind(py).clone(), format!("{error}{}", reference(&error)))
}

/// Tables of a task whose entries are terms.
const TERMS: [&str; 6] = ["rewards", "observations", "terminations", "events", "curriculum", "commands"];

/// The command that prints what exists, after an error about a key or a term that does not.
fn reference(error: &Error) -> &'static str {
    let Error::Config(error) = error else {
        return "";
    };
    let is_of_term = || error.element.split(['.', '[']).next().is_some_and(|table| TERMS.contains(&table));
    match error.kind {
        ConfigErrorKind::UnknownName if error.problem.contains(" term `") => " (see `polypod terms`)",
        ConfigErrorKind::UnknownKey if is_of_term() => " (see `polypod terms`)",
        ConfigErrorKind::UnknownKey => " (see `polypod show` and `polypod schema`)",
        _ => "",
    }
}

/// A whole number of any size; beyond 128 bits the nearest one. This function, the next two and
/// [`unsigned`] read all arguments that count, so that a number out of range is a `ConfigError`
/// that names the argument.
pub(super) fn whole(value: &Bound<'_, PyAny>) -> PyResult<i128> {
    if value.is_instance_of::<PyBool>() {
        return Err(type_error("'bool' object cannot be interpreted as an integer".into()));
    }
    value.extract().or_else(|error: PyErr| {
        if !error.is_instance_of::<PyOverflowError>(value.py()) {
            return Err(error);
        }
        Ok(if value.lt(0)? { i128::MIN } else { i128::MAX })
    })
}

/// Like [`whole`], or `None`.
pub(super) fn optional_whole(value: &Bound<'_, PyAny>) -> PyResult<Option<i128>> {
    if value.is_none() { Ok(None) } else { whole(value).map(Some) }
}

/// A pair of whole numbers or `None`.
pub(super) fn optional_pair(value: &Bound<'_, PyAny>) -> PyResult<Option<(i128, i128)>> {
    if value.is_none() {
        return Ok(None);
    }
    let (first, second): (Bound<'_, PyAny>, Bound<'_, PyAny>) = value.extract()?;
    Ok(Some((whole(&first)?, whole(&second)?)))
}

/// A number of the type `T`, or a `ConfigError` that names the argument.
pub(super) fn unsigned<T: TryFrom<i128>>(py: Python<'_>, element: &'static str, value: i128) -> PyResult<T> {
    T::try_from(value).map_err(|_| {
        let remedy = if value < 0 { "pass no negative number" } else { "pass a smaller number" };
        to_python(py, Error::Argument { element, problem: format!("{value} is out of range"), remedy: remedy.into() })
    })
}

/// A simulation, and its panic if there was one: it may be half changed and is of no further use.
pub(super) struct Guarded<S> {
    sim: S,
    fault: OnceLock<String>,
}

impl<S: Send + Sync> Guarded<S> {
    /// Makes the simulation without the interpreter's lock.
    pub(super) fn new<E: Send>(
        py: Python<'_>,
        make: impl FnOnce() -> Result<S, E> + Send,
        exception: impl FnOnce(Python<'_>, E) -> PyErr,
    ) -> PyResult<Self> {
        let sim = guarded(py, make)?;
        Ok(Self { sim: sim.map_err(|error| exception(py, error))?, fault: OnceLock::new() })
    }

    fn check(&self, py: Python<'_>) -> PyResult<()> {
        match self.fault.get() {
            None => Ok(()),
            Some(fault) => Err(fault_exception(py, &format!("this simulation has stopped for good: {fault}"))),
        }
    }

    /// Changes the simulation without the interpreter's lock. A panic is a fault of polypod: it
    /// becomes an exception, as does any later use.
    pub(super) fn run<T: Send>(&mut self, py: Python<'_>, f: impl FnOnce(&mut S) -> T + Send) -> PyResult<T> {
        self.check(py)?;
        let Self { sim, fault } = self;
        py.detach(|| caught(|| f(sim))).map_err(|message| fault_exception(py, fault.get_or_init(|| message)))
    }

    /// Changes the simulation within [`Guarded::run`] or [`Guarded::look`] of another one, whose
    /// guard catches a panic.
    ///
    /// # Errors
    /// Any error of `f`.
    pub(super) fn try_run<T>(&mut self, f: impl FnOnce(&mut S) -> Result<T, Error>) -> Result<T, Error> {
        f(&mut self.sim)
    }

    /// Computes from the simulation without the interpreter's lock, like [`Guarded::run`].
    pub(super) fn look<T: Send>(&self, py: Python<'_>, f: impl FnOnce(&S) -> T + Send) -> PyResult<T> {
        self.check(py)?;
        let Self { sim, fault } = self;
        py.detach(|| caught(|| f(sim))).map_err(|message| fault_exception(py, fault.get_or_init(|| message)))
    }
}

/// Access to sizes, names and other stored data; computations go through [`Guarded::look`].
impl<S> Deref for Guarded<S> {
    type Target = S;

    fn deref(&self) -> &S {
        &self.sim
    }
}

/// Works without the interpreter's lock. A panic becomes an exception. A signal in the meantime,
/// such as Ctrl-C, is raised here: this work may take seconds, and so may the next.
pub(super) fn guarded<T: Send>(py: Python<'_>, f: impl FnOnce() -> T + Send) -> PyResult<T> {
    let done = py.detach(|| caught(f)).map_err(|fault| fault_exception(py, &fault))?;
    py.check_signals()?;
    Ok(done)
}

/// Result of `f`, or the message of its panic.
fn caught<T>(f: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(f)).map_err(|panic| match panic.downcast::<String>() {
        Ok(message) => *message,
        Err(panic) => panic.downcast_ref::<&str>().map_or_else(|| "no message".into(), ToString::to_string),
    })
}

/// The exception of an internal fault.
pub(super) fn fault_exception(py: Python<'_>, fault: &str) -> PyErr {
    match exceptions(py) {
        Ok(all) => {
            let fault = fault.replace('\n', " ");
            let message =
                format!("{fault}; this is a fault of polypod: make the simulation anew, and please report it");
            PyErr::from_type(all.polypod.bind(py).clone(), message)
        }
        Err(error) => error,
    }
}

/// A `TypeError`.
pub(super) fn type_error(message: String) -> PyErr {
    PyTypeError::new_err(message)
}

/// A plain `ValueError`, for arrays.
pub(super) fn value_error(message: String) -> PyErr {
    PyValueError::new_err(message)
}
