//! `Learner`: PPO on the simulator's threads.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use numpy::{Element, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadwriteArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::exceptions::{Guarded, to_python, unsigned, value_error, whole};
use super::vec_sim::VecSim;
use polypod::engine::open_update_card;
use polypod::learner::{self, LearnerError, NetworkName, NetworkState, Normalizer, RewardScale, RolloutArrays, Worker};

/// Numbers as NumPy arrays of one dimension.
type Arrays<'py, T> = Vec<Bound<'py, PyArray1<T>>>;
/// Weights, Adam's two moments, Adam's steps.
type Network<'py> = (Arrays<'py, f32>, Arrays<'py, f32>, Arrays<'py, f32>, u64);

#[doc = docstring!("Learner")]
#[pyclass(module = "polypod._core")]
pub(super) struct Learner {
    learner: Guarded<learner::Learner>,
    raised: Raised,
    /// Steps of an iteration that is collected step by step.
    steps: Steps,
}

/// Steps of an iteration that its caller takes.
#[derive(Default)]
struct Steps {
    /// Number that are left.
    left: usize,
    /// Whether actions were drawn whose outcome is still unknown.
    acted: bool,
    /// Episodes that ended.
    ended: Vec<learner::Episode>,
}

/// Exception of a call into Python while the learner was at work.
type Raised = Arc<Mutex<Option<PyErr>>>;

/// Peers behind a Python object. Only their calls hold the interpreter.
struct PythonPeers {
    object: Py<PyAny>,
    raised: Raised,
}

impl PythonPeers {
    fn call(&self, name: &'static str, mine: &[u8]) -> Result<Vec<u8>, LearnerError> {
        let all = Python::attach(|py| -> PyResult<Vec<u8>> {
            let all = self.object.bind(py).call_method1(name, (PyArray1::from_slice(py, mine),))?;
            Ok(all.extract::<PyReadonlyArray1<u8>>()?.as_slice()?.to_vec())
        });
        all.map_err(|error| {
            let problem = error.to_string();
            *self.raised.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
            LearnerError { element: name, problem }
        })
    }
}

impl learner::Peers for PythonPeers {
    fn gather(&self, mine: &[u8]) -> Result<Vec<u8>, LearnerError> {
        self.call("gather", mine)
    }
    fn exchange(&self, mine: &[u8]) -> Result<Vec<u8>, LearnerError> {
        self.call("exchange", mine)
    }
}

impl Learner {
    /// The exception of an error: the one that a peer raised, if one did.
    fn exception(&self, py: Python<'_>, error: polypod::Error) -> PyErr {
        let raised = self.raised.lock().unwrap_or_else(PoisonError::into_inner).take();
        raised.unwrap_or_else(|| to_python(py, error))
    }
}

fn network_name(name: &str) -> PyResult<NetworkName> {
    match name {
        "actor" => Ok(NetworkName::Actor),
        "critic" => Ok(NetworkName::Critic),
        _ => Err(value_error(format!("there is no network {name:?}; use \"actor\" or \"critic\""))),
    }
}

fn arrays<'py>(py: Python<'py>, numbers: Vec<Vec<f32>>) -> Arrays<'py, f32> {
    numbers.into_iter().map(|numbers| PyArray1::from_vec(py, numbers)).collect()
}

fn vectors(arrays: &[PyReadonlyArray1<f32>]) -> PyResult<Vec<Vec<f32>>> {
    arrays.iter().map(|array| Ok(array.as_slice()?.to_vec())).collect()
}

#[pymethods]
impl Learner {
    #[new]
    #[pyo3(signature = (sim, options, peers=None, worker=0, workers=1))]
    fn new(
        py: Python<'_>,
        sim: &VecSim,
        options: &str,
        peers: Option<Py<PyAny>>,
        #[pyo3(from_py_with = whole)] worker: i128,
        #[pyo3(from_py_with = whole)] workers: i128,
    ) -> PyResult<Self> {
        let worker = Worker { index: unsigned(py, "worker", worker)?, count: unsigned(py, "workers", workers)? };
        let options: learner::Options =
            serde_json::from_str(options).map_err(|error| value_error(format!("options: {error}")))?;
        let raised = Raised::default();
        let peers = peers.map(|object| Box::new(PythonPeers { object, raised: raised.clone() }));
        let learner = sim.sim().look(py, |sim| match peers {
            Some(peers) => sim.learner_of_worker(options, worker, peers),
            None => sim.learner(options),
        })?;
        Ok(Self { learner: Guarded::new(py, || learner, to_python)?, raised, steps: Steps::default() })
    }

    #[doc = docstring!("Learner.collect")]
    #[pyo3(signature = (sim, iteration, clip_actions=None))]
    fn collect(
        &mut self,
        py: Python<'_>,
        sim: &mut VecSim,
        #[pyo3(from_py_with = whole)] iteration: i128,
        clip_actions: Option<f32>,
    ) -> PyResult<Vec<(usize, usize, f32, f32)>> {
        let iteration = unsigned(py, "iteration", iteration)?;
        let learner = &mut self.learner;
        let episodes = sim.run(py, |sim| learner.try_run(|learner| sim.collect(learner, iteration, clip_actions)))?;
        Ok(in_order(episodes.map_err(|error| self.exception(py, error))?))
    }

    #[doc = docstring!("Learner.begin")]
    fn begin(&mut self, py: Python<'_>, #[pyo3(from_py_with = whole)] iteration: i128) -> PyResult<()> {
        let iteration = unsigned(py, "iteration", iteration)?;
        let left = self.learner.settings().options.num_steps_per_env;
        self.steps = Steps { left, ..Steps::default() };
        self.learner.run(py, |learner| learner.begin(iteration))
    }

    #[doc = docstring!("Learner.act")]
    fn act<'py>(&mut self, py: Python<'py>, sim: &VecSim) -> PyResult<Bound<'py, PyArray2<f32>>> {
        if self.steps.left == 0 || self.steps.acted {
            return Err(value_error(
                "act: no step of the iteration is due; call begin, then act and record in turn".into(),
            ));
        }
        let shape = [sim.sim().num_envs(), sim.sim().batch().num_actions];
        let actions = PyArray2::<f32>::zeros(py, shape, false);
        let mut out = actions.try_readwrite()?;
        let (out, learner) = (out.as_slice_mut()?, &mut self.learner);
        let drawn = sim.sim().look(py, |sim| learner.try_run(|learner| sim.act(learner, out)))?;
        drawn.map_err(|error| to_python(py, error))?;
        self.steps.acted = true;
        Ok(actions)
    }

    #[doc = docstring!("Learner.record")]
    fn record(
        &mut self,
        py: Python<'_>,
        rewards: PyReadonlyArray1<f32>,
        terminated: PyReadonlyArray1<bool>,
        truncated: PyReadonlyArray1<bool>,
    ) -> PyResult<()> {
        let (rewards, terminated, truncated) = (rewards.as_slice()?, terminated.as_slice()?, truncated.as_slice()?);
        let envs = self.learner.num_own_envs();
        if !self.steps.acted || [rewards.len(), terminated.len(), truncated.len()] != [envs; 3] {
            return Err(value_error(format!("record: pass a number for each of {envs} envs, once after act")));
        }
        let ended = &mut self.steps.ended;
        self.learner.run(py, |learner| learner.record(rewards, terminated, truncated, ended))?;
        (self.steps.left, self.steps.acted) = (self.steps.left - 1, false);
        Ok(())
    }

    #[doc = docstring!("Learner.finish")]
    fn finish(&mut self, py: Python<'_>, sim: &VecSim) -> PyResult<Vec<(usize, usize, f32, f32)>> {
        if self.steps.left > 0 || self.steps.acted {
            return Err(value_error("finish: steps of the iteration are left; call act and record for each".into()));
        }
        let learner = &mut self.learner;
        let finished = sim.sim().look(py, |sim| learner.try_run(|learner| sim.finish_rollout(learner)))?;
        finished.map_err(|error| self.exception(py, error))?;
        Ok(in_order(std::mem::take(&mut self.steps.ended)))
    }

    #[doc = docstring!("Learner.update")]
    fn update(&mut self, py: Python<'_>, sim: &VecSim, learning_rate: f64) -> PyResult<BTreeMap<&'static str, f64>> {
        let learner = &mut self.learner;
        let losses = sim.sim().look(py, |sim| learner.try_run(|learner| sim.learn(learner, learning_rate)))?;
        let losses = losses.map_err(|error| self.exception(py, error))?;
        Ok(BTreeMap::from([
            ("value", losses.value),
            ("surrogate", losses.surrogate),
            ("entropy", losses.entropy),
            ("learning_rate", losses.learning_rate),
        ]))
    }

    #[doc = docstring!("Learner.use_card")]
    fn use_card(&mut self, py: Python<'_>) -> PyResult<String> {
        let device = py.detach(open_update_card).map_err(|error| to_python(py, error))?;
        let name = device.name().to_owned();
        let used = self.learner.run(py, |learner| learner.use_device(device))?;
        used.map_err(|error| to_python(py, error.into())).map(|()| name)
    }

    #[doc = docstring!("Learner.take_card_failure")]
    fn take_card_failure(&mut self, py: Python<'_>) -> PyResult<Option<String>> {
        self.learner.run(py, |learner| learner.take_device_failure().map(|failure| failure.0))
    }

    #[doc = docstring!("Learner.set_goals")]
    #[pyo3(signature = (entropy_coef, desired_kl))]
    fn set_goals(&mut self, py: Python<'_>, entropy_coef: f32, desired_kl: Option<f64>) -> PyResult<()> {
        if !(entropy_coef.is_finite() && desired_kl.is_none_or(|kl| kl > 0.0)) {
            let problem = format!("entropy_coef {entropy_coef} and desired_kl {desired_kl:?}");
            return Err(value_error(format!("{problem}: a finite number and one above 0, or None, are wanted")));
        }
        self.learner.run(py, |learner| learner.set_goals(entropy_coef, desired_kl))
    }

    #[doc = docstring!("Learner.network")]
    fn network<'py>(&self, py: Python<'py>, name: &str) -> PyResult<Network<'py>> {
        let NetworkState { weights, first, second, steps } = self.learner.network(network_name(name)?);
        Ok((arrays(py, weights), arrays(py, first), arrays(py, second), steps))
    }

    #[doc = docstring!("Learner.action_std")]
    fn action_std<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_vec(py, self.learner.deviations())
    }

    #[doc = docstring!("Learner.set_network")]
    fn set_network(
        &mut self,
        py: Python<'_>,
        name: &str,
        weights: Vec<PyReadonlyArray1<f32>>,
        first: Vec<PyReadonlyArray1<f32>>,
        second: Vec<PyReadonlyArray1<f32>>,
        #[pyo3(from_py_with = whole)] steps: i128,
    ) -> PyResult<()> {
        let (network, weights, steps) = (network_name(name)?, vectors(&weights)?, unsigned(py, "steps", steps)?);
        let state = NetworkState { weights, first: vectors(&first)?, second: vectors(&second)?, steps };
        let done = self.learner.run(py, |learner| learner.set_network(network, &state))?;
        done.map_err(|error| to_python(py, error.into()))
    }

    #[doc = docstring!("Learner.normalizer")]
    #[pyo3(signature = (name, index=0))]
    fn normalizer<'py>(
        &self,
        py: Python<'py>,
        name: &str,
        #[pyo3(from_py_with = whole)] index: i128,
    ) -> PyResult<Option<(Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>, u64)>> {
        let index: usize = unsigned(py, "index", index)?;
        Ok(self
            .learner
            .normalizers(network_name(name)?)
            .get(index)
            .map(|of| (PyArray1::from_slice(py, &of.mean), PyArray1::from_slice(py, &of.variance), of.count)))
    }

    #[doc = docstring!("Learner.set_normalizer")]
    #[pyo3(signature = (name, mean, variance, count, index=0))]
    fn set_normalizer(
        &mut self,
        py: Python<'_>,
        name: &str,
        mean: PyReadonlyArray1<f32>,
        variance: PyReadonlyArray1<f32>,
        #[pyo3(from_py_with = whole)] count: i128,
        #[pyo3(from_py_with = whole)] index: i128,
    ) -> PyResult<()> {
        let (network, count, index) =
            (network_name(name)?, unsigned(py, "count", count)?, unsigned(py, "index", index)?);
        let normalizer = Normalizer::from_parts(mean.as_slice()?.to_vec(), variance.as_slice()?.to_vec(), count);
        let done = self.learner.run(py, |learner| learner.set_normalizer(network, index, normalizer))?;
        done.map_err(|error| to_python(py, error.into()))
    }

    #[doc = docstring!("Learner.reward_scale")]
    fn reward_scale<'py>(&self, py: Python<'py>) -> Option<(Bound<'py, PyArray1<f32>>, Arrays<'py, f64>)> {
        self.learner.reward_scale().map(|scale| {
            let of_robots =
                [&scale.count, &scale.mean, &scale.variance].map(|numbers| PyArray1::from_slice(py, numbers));
            (PyArray1::from_vec(py, self.learner.discounted()), of_robots.into())
        })
    }

    #[doc = docstring!("Learner.set_reward_scale")]
    fn set_reward_scale(
        &mut self,
        py: Python<'_>,
        returns: PyReadonlyArray1<f32>,
        count: PyReadonlyArray1<f64>,
        mean: PyReadonlyArray1<f64>,
        variance: PyReadonlyArray1<f64>,
    ) -> PyResult<()> {
        let numbers = |array: &PyReadonlyArray1<f64>| Ok::<_, PyErr>(array.as_slice()?.to_vec());
        let scale = RewardScale { count: numbers(&count)?, mean: numbers(&mean)?, variance: numbers(&variance)? };
        let returns = returns.as_slice()?;
        let done = self.learner.run(py, |learner| learner.set_reward_scale(scale, returns))?;
        done.map_err(|error| to_python(py, error.into()))
    }

    #[doc = docstring!("Learner.episodes")]
    fn episodes<'py>(&self, py: Python<'py>) -> (Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>) {
        let (rewards, lengths) = self.learner.episodes();
        (PyArray1::from_vec(py, rewards), PyArray1::from_vec(py, lengths))
    }

    #[doc = docstring!("Learner.set_episodes")]
    fn set_episodes(
        &mut self,
        py: Python<'_>,
        rewards: PyReadonlyArray1<f32>,
        lengths: PyReadonlyArray1<f32>,
    ) -> PyResult<()> {
        let (rewards, lengths) = (rewards.as_slice()?, lengths.as_slice()?);
        let done = self.learner.run(py, |learner| learner.set_episodes(rewards, lengths))?;
        done.map_err(|error| to_python(py, error.into()))
    }

    #[doc = docstring!("Learner.rollout")]
    #[pyo3(signature = (sim, into=None))]
    fn rollout<'py>(
        &self,
        py: Python<'py>,
        sim: &VecSim,
        into: Option<Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let into = into.unwrap_or_else(|| PyDict::new(py));
        let (settings, samples) = (self.learner.settings(), self.learner.num_own_samples());
        let (of_obs, of_actions) = (samples * settings.num_obs, samples * settings.num_actions);
        let mut observations = array_of::<f32>(&into, "observations", of_obs)?;
        let mut actions = array_of::<f32>(&into, "actions", of_actions)?;
        let mut means = array_of::<f32>(&into, "means", of_actions)?;
        let mut rewards = array_of::<f32>(&into, "rewards", samples)?;
        let mut ends = array_of::<u8>(&into, "ends", samples)?;
        let mut log_probs = array_of::<f32>(&into, "log_probs", samples)?;
        let mut values = array_of::<f32>(&into, "values", samples)?;
        let mut returns = array_of::<f32>(&into, "returns", samples)?;
        let mut advantages = array_of::<f32>(&into, "advantages", samples)?;
        let mut places = array_of::<u32>(&into, "places", samples)?;
        let arrays = RolloutArrays {
            observations: observations.as_slice_mut()?,
            actions: actions.as_slice_mut()?,
            means: means.as_slice_mut()?,
            rewards: rewards.as_slice_mut()?,
            ends: ends.as_slice_mut()?,
            log_probs: log_probs.as_slice_mut()?,
            values: values.as_slice_mut()?,
            returns: returns.as_slice_mut()?,
            advantages: advantages.as_slice_mut()?,
            places: places.as_slice_mut()?,
        };
        let learner = &self.learner;
        let written = sim.sim().look(py, |sim| sim.write_rollout(learner, arrays))?;
        written.map_err(|error| to_python(py, error))?;
        into.set_item("order", PyArray1::from_vec(py, self.learner.look(py, learner::Learner::order)?))?;
        into.set_item("batch_sizes", PyArray1::from_vec(py, self.learner.batch_sizes()))?;
        Ok(into)
    }
}

/// Episodes that ended, by step and env: both of them, the sum of rewards, and the length.
fn in_order(mut episodes: Vec<learner::Episode>) -> Vec<(usize, usize, f32, f32)> {
    episodes.sort_by_key(|episode| (episode.step, episode.env));
    episodes.into_iter().map(|episode| (episode.step, episode.env, episode.reward, episode.length)).collect()
}

/// The array of this name, or a new one.
fn array_of<'py, T: Element + Default>(
    arrays: &Bound<'py, PyDict>,
    name: &str,
    numbers: usize,
) -> PyResult<PyReadwriteArray1<'py, T>> {
    let array = match arrays.get_item(name)? {
        Some(array) => array.cast_into::<PyArray1<T>>()?,
        None => {
            let array = PyArray1::zeros(arrays.py(), numbers, false);
            arrays.set_item(name, &array)?;
            array
        }
    };
    Ok(array.try_readwrite()?)
}
