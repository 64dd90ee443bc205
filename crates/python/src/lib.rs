//! The PyO3 boundary: `polypod._core`. It is thin; its documentation is in
//! `python/polypod/_core.pyi`.

/// The docstring of a member of `polypod._core`, from its stub.
macro_rules! docstring {
    ($name:literal) => {
        include_str!(concat!(env!("OUT_DIR"), "/", $name))
    };
}

mod arrays;
mod device_array;
mod exceptions;
mod learner;
mod rows;
mod simulation;
mod terrain;
mod vec_sim;

use std::collections::BTreeMap;
use std::path::PathBuf;

use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use exceptions::{guarded, to_python, unsigned, value_error, whole};
use polypod::config::{ConfigError, EARTH_GRAVITY, Explained, LEAST_BASE_MASS, Library};
use polypod::draft::{DraftOptions, draft};
use polypod::dynamics::lanes::Simd;
use polypod::engine::{describe_card, search_packages};
use polypod::learner::Worker;
use polypod::robot::{self, LoadOptions};
use polypod::snapshot;
use polypod::systems::Registry;

#[doc = docstring!("tasks")]
#[pyfunction]
fn tasks(py: Python<'_>) -> PyResult<Vec<Bound<'_, PyDict>>> {
    let tasks = guarded(py, || Library::new(Vec::new()).tasks())?.map_err(|error| to_python(py, error.into()))?;
    let entry = |task: polypod::config::TaskEntry| {
        let dict = PyDict::new(py);
        dict.set_item("name", task.name)?;
        dict.set_item("aliases", task.aliases)?;
        dict.set_item("file", task.file)?;
        dict.set_item("num_robots", task.robots.len())?;
        dict.set_item("robots", task.robots)?;
        Ok(dict)
    };
    tasks.into_iter().map(entry).collect()
}

#[doc = docstring!("robots")]
#[pyfunction]
fn robots(py: Python<'_>) -> PyResult<Vec<Bound<'_, PyDict>>> {
    let robots = guarded(py, || Library::new(Vec::new()).robots())?.map_err(|error| to_python(py, error.into()))?;
    let entry = |robot: polypod::config::RobotEntry| {
        let dict = PyDict::new(py);
        dict.set_item("name", robot.name)?;
        dict.set_item("title", robot.title)?;
        dict.set_item("needs_policy", robot.needs_policy)?;
        Ok(dict)
    };
    robots.into_iter().map(entry).collect()
}

#[doc = docstring!("observation_specs")]
#[pyfunction]
fn observation_specs(py: Python<'_>) -> PyResult<String> {
    let registry = Registry::builtin();
    let specs: BTreeMap<_, _> = registry.observation_specs().collect();
    vec_sim::written(py, serde_json::to_string(&specs))
}

#[doc = docstring!("command_specs")]
#[pyfunction]
fn command_specs(py: Python<'_>) -> PyResult<String> {
    let registry = Registry::builtin();
    let specs: BTreeMap<_, _> = registry.command_specs().collect();
    vec_sim::written(py, serde_json::to_string(&specs))
}

#[doc = docstring!("broken_configs")]
#[pyfunction]
fn broken_configs(py: Python<'_>) -> PyResult<Vec<String>> {
    let broken = guarded(py, || Library::new(Vec::new()).broken())?.map_err(|error| to_python(py, error.into()))?;
    Ok(broken.iter().map(ToString::to_string).collect())
}

#[doc = docstring!("train_config")]
#[pyfunction]
#[pyo3(signature = (name, above=Vec::new()))]
fn train_config<'py>(py: Python<'py>, name: &str, above: Vec<PathBuf>) -> PyResult<Bound<'py, PyDict>> {
    let file =
        guarded(py, || Library::new(Vec::new()).train(name, &above))?.map_err(|error| to_python(py, error.into()))?;
    let dict = PyDict::new(py);
    dict.set_item("text", file.text)?;
    dict.set_item("id", file.id.display().to_string())?;
    dict.set_item("folder", file.folder.map(|folder| folder.display().to_string()))?;
    Ok(dict)
}

/// Config files with their settings, and the merged config, as TOML.
type ExplainedTexts = (Vec<(String, String)>, String);

fn texts_of(py: Python<'_>, found: Result<Explained, ConfigError>) -> PyResult<ExplainedTexts> {
    let found = found.map_err(|error| to_python(py, error.into()))?;
    let layers = found.layers.into_iter().map(|(file, table)| (file, table.to_string()));
    Ok((layers.collect(), found.resolved.to_string()))
}

#[doc = docstring!("explain_task")]
#[pyfunction]
#[pyo3(signature = (name, overrides=Vec::new()))]
fn explain_task(py: Python<'_>, name: &str, overrides: Vec<String>) -> PyResult<ExplainedTexts> {
    let found = guarded(py, || Library::new(Vec::new()).explain_task(name, &overrides))?;
    texts_of(py, found)
}

#[doc = docstring!("explain_robot")]
#[pyfunction]
fn explain_robot(py: Python<'_>, name: &str) -> PyResult<ExplainedTexts> {
    let found = guarded(py, || Library::new(Vec::new()).explain_robot(name))?;
    texts_of(py, found)
}

#[doc = docstring!("check_names")]
#[pyfunction]
#[pyo3(signature = (task=None, robots=Vec::new(), overrides=Vec::new()))]
fn check_names(py: Python<'_>, task: Option<&str>, robots: Vec<String>, overrides: Vec<String>) -> PyResult<()> {
    let check = || {
        let library = Library::new(Vec::new());
        let task = task.map(|task| library.task(task, &overrides)).transpose()?;
        for robot in &robots {
            match &task {
                Some(task) => library.robot_in(robot, &task.config)?,
                None => library.robot(robot)?,
            };
        }
        Ok(())
    };
    guarded(py, check)?.map_err(|error: ConfigError| to_python(py, error.into()))
}

#[doc = docstring!("play_task")]
#[pyfunction]
fn play_task(py: Python<'_>, task: &str) -> PyResult<String> {
    guarded(py, || Library::new(Vec::new()).play_task(task))?.map_err(|error| to_python(py, error.into()))
}

#[doc = docstring!("training_task")]
#[pyfunction]
fn training_task(py: Python<'_>, task: &str) -> PyResult<String> {
    guarded(py, || Library::new(Vec::new()).training_task(task))?.map_err(|error| to_python(py, error.into()))
}

#[doc = docstring!("disturbances")]
#[pyfunction]
#[pyo3(signature = (task, overrides=Vec::new()))]
fn disturbances(py: Python<'_>, task: &str, overrides: Vec<String>) -> PyResult<Vec<String>> {
    let task = guarded(py, || Library::new(Vec::new()).task(task, &overrides))?;
    Ok(task.map_err(|error| to_python(py, error.into()))?.config.disturbances())
}

#[doc = docstring!("task_robots")]
#[pyfunction]
#[pyo3(signature = (task, overrides=Vec::new()))]
fn task_robots(py: Python<'_>, task: &str, overrides: Vec<String>) -> PyResult<Vec<String>> {
    let task = guarded(py, || Library::new(Vec::new()).task(task, &overrides))?;
    Ok(task.map_err(|error| to_python(py, error.into()))?.config.robots)
}

#[doc = docstring!("train_configs")]
#[pyfunction]
fn train_configs(py: Python<'_>) -> PyResult<Vec<Bound<'_, PyDict>>> {
    let configs =
        guarded(py, || Library::new(Vec::new()).train_configs())?.map_err(|error| to_python(py, error.into()))?;
    let entry = |config: polypod::config::TrainEntry| {
        let dict = PyDict::new(py);
        dict.set_item("name", config.name)?;
        dict.set_item("file", config.file)?;
        dict.set_item("title", config.title)?;
        Ok(dict)
    };
    configs.into_iter().map(entry).collect()
}

#[doc = docstring!("with_overrides")]
#[pyfunction]
fn with_overrides(py: Python<'_>, config: &str, overrides: Vec<String>) -> PyResult<String> {
    let mut config: toml::Table = serde_json::from_str(config).map_err(|error| value_error(error.to_string()))?;
    for text in &overrides {
        polypod::config::apply_override(&mut config, text).map_err(|error| to_python(py, error.into()))?;
    }
    Ok(config.to_string())
}

#[doc = docstring!("robot_urdf")]
#[pyfunction]
fn robot_urdf(py: Python<'_>, name: &str) -> PyResult<String> {
    let robot = guarded(py, || Library::new(Vec::new()).robot(name))?.map_err(|error| to_python(py, error.into()))?;
    Ok(robot.urdf_text)
}

#[doc = docstring!("check")]
#[pyfunction]
#[pyo3(signature = (path, package_dirs=BTreeMap::new(), locked_joints=BTreeMap::new()))]
fn check(
    py: Python<'_>,
    path: PathBuf,
    package_dirs: BTreeMap<String, PathBuf>,
    locked_joints: BTreeMap<String, f64>,
) -> PyResult<String> {
    let options = LoadOptions { package_dirs, locked_joints, ..LoadOptions::default() };
    guarded(py, || robot::check(&path, &options))?.map_err(|error| to_python(py, error.into()))
}

#[doc = docstring!("draft_robot")]
#[pyfunction]
#[pyo3(signature = (path, *, name=None, urdf=None, package_dirs=BTreeMap::new(), feet=BTreeMap::new(),
    joint_roles=BTreeMap::new(), locked_joints=BTreeMap::new(), gain_factor=1.0, balanced=false))]
fn draft_robot(
    py: Python<'_>,
    path: PathBuf,
    name: Option<String>,
    urdf: Option<PathBuf>,
    package_dirs: BTreeMap<String, PathBuf>,
    feet: BTreeMap<String, String>,
    joint_roles: BTreeMap<String, String>,
    locked_joints: BTreeMap<String, f64>,
    gain_factor: f64,
    balanced: bool,
) -> PyResult<Bound<'_, PyDict>> {
    let gain_factor = Some(gain_factor);
    let options = DraftOptions { name, urdf, package_dirs, feet, joint_roles, locked_joints, gain_factor, balanced };
    let draft = guarded(py, || draft(&path, &options))?.map_err(|error| to_python(py, error))?;
    let dict = PyDict::new(py);
    dict.set_item("name", draft.name)?;
    dict.set_item("toml", draft.toml)?;
    dict.set_item("notes", draft.notes)?;
    dict.set_item("kind", draft.class)?;
    dict.set_item("needs_policy", draft.needs_policy)?;
    Ok(dict)
}

#[doc = docstring!("slots_of_legs")]
#[pyfunction]
fn slots_of_legs(joint_names: Vec<String>) -> Vec<bool> {
    joint_names.iter().map(|name| robot::Slot::parse(name).is_some_and(robot::Slot::is_of_leg)).collect()
}

#[doc = docstring!("share_of_worker")]
#[pyfunction]
fn share_of_worker(
    py: Python<'_>,
    #[pyo3(from_py_with = whole)] num_envs: i128,
    #[pyo3(from_py_with = whole)] worker: i128,
    #[pyo3(from_py_with = whole)] workers: i128,
) -> PyResult<(usize, usize)> {
    let num_envs = unsigned(py, "num_envs", num_envs)?;
    let worker = Worker { index: unsigned(py, "worker", worker)?, count: unsigned(py, "workers", workers)? };
    let envs = worker.envs(num_envs).map_err(|error| to_python(py, error.into()))?;
    Ok((envs.start, envs.end))
}

#[doc = docstring!("join_snapshots")]
#[pyfunction]
fn join_snapshots<'py>(py: Python<'py>, parts: Vec<Vec<u8>>) -> PyResult<Bound<'py, PyBytes>> {
    let joined = guarded(py, || snapshot::join(&parts))?.map_err(|error| to_python(py, error))?;
    Ok(PyBytes::new(py, &joined))
}

#[doc = docstring!("cuda")]
#[pyfunction]
fn cuda(py: Python<'_>) -> String {
    py.detach(describe_card)
}

#[doc = docstring!("info")]
#[pyfunction]
fn info(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("version", env!("CARGO_PKG_VERSION"))?;
    dict.set_item("simd", Simd::choose(None).map_err(|error| to_python(py, error.into()))?.name())?;
    dict.set_item("threads", std::thread::available_parallelism().map_or(1, Into::into))?;
    Ok(dict)
}

/// Loads NumPy's C interface ahead of time. The crate `numpy` loads it with the first array, and
/// panics where that fails, as it does after a Ctrl-C; the first array of a simulation comes after
/// seconds of work.
fn load_numpy(py: Python<'_>) -> PyResult<()> {
    py.import("numpy")?;
    py.check_signals()?;
    let array = PyArray1::<f32>::zeros(py, 1, false);
    drop(array.try_readwrite()?);
    Ok(())
}

#[doc = docstring!("_core")]
#[pymodule]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    load_numpy(module.py())?;
    search_packages(module.py().import("sys")?.getattr("path")?.extract().unwrap_or_default());
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("EARTH_GRAVITY", EARTH_GRAVITY)?;
    module.add("LEAST_BASE_MASS", LEAST_BASE_MASS)?;
    exceptions::register(module)?;
    module.add_class::<vec_sim::VecSim>()?;
    module.add_class::<device_array::DeviceArray>()?;
    module.add_class::<simulation::Simulation>()?;
    module.add_class::<learner::Learner>()?;
    module.add_function(wrap_pyfunction!(tasks, module)?)?;
    module.add_function(wrap_pyfunction!(robots, module)?)?;
    module.add_function(wrap_pyfunction!(broken_configs, module)?)?;
    module.add_function(wrap_pyfunction!(observation_specs, module)?)?;
    module.add_function(wrap_pyfunction!(command_specs, module)?)?;
    module.add_function(wrap_pyfunction!(train_config, module)?)?;
    module.add_function(wrap_pyfunction!(check_names, module)?)?;
    module.add_function(wrap_pyfunction!(explain_task, module)?)?;
    module.add_function(wrap_pyfunction!(explain_robot, module)?)?;
    module.add_function(wrap_pyfunction!(play_task, module)?)?;
    module.add_function(wrap_pyfunction!(training_task, module)?)?;
    module.add_function(wrap_pyfunction!(disturbances, module)?)?;
    module.add_function(wrap_pyfunction!(task_robots, module)?)?;
    module.add_function(wrap_pyfunction!(train_configs, module)?)?;
    module.add_function(wrap_pyfunction!(with_overrides, module)?)?;
    module.add_function(wrap_pyfunction!(robot_urdf, module)?)?;
    module.add_function(wrap_pyfunction!(check, module)?)?;
    module.add_function(wrap_pyfunction!(draft_robot, module)?)?;
    module.add_function(wrap_pyfunction!(slots_of_legs, module)?)?;
    module.add_function(wrap_pyfunction!(share_of_worker, module)?)?;
    module.add_function(wrap_pyfunction!(join_snapshots, module)?)?;
    module.add_function(wrap_pyfunction!(cuda, module)?)?;
    module.add_function(wrap_pyfunction!(info, module)?)?;
    module.add_function(wrap_pyfunction!(terrain::terrain, module)?)?;
    Ok(())
}
