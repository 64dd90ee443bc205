//! `VecSim`: many envs behind NumPy arrays.

use std::collections::BTreeMap;
use std::path::PathBuf;

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray2, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PySlice};
use serde::Serialize;

use super::arrays::{BatchArrays, array, read_only, rows, shaped, view};
use super::device_array::DeviceArray;
use super::exceptions::{
    Guarded, fault_exception, optional_pair, optional_whole, to_python, unsigned, value_error, whole,
};
use super::rows::{StateArguments, env_ids, force_steps, in_world, numbers};
use super::terrain;
use polypod::components::{EnvId, Episode};
use polypod::config::{POLICY_GROUP, VELOCITY_COLUMNS, VELOCITY_COMMAND, VelocityCommandConfig};
use polypod::morphology::MorphologyModel;
use polypod::systems::{StateField, TermSpec};
use polypod::workers::Workers;
use polypod::world::Ground;
use polypod::{Autoreset, ForceRows, Sim, SimOptions};

#[doc = docstring!("VecSim")]
#[pyclass(module = "polypod._core", subclass)]
pub(super) struct VecSim {
    sim: Guarded<Sim>,
    arrays: BatchArrays,
    /// Whether the arrays are those of an earlier step, after steps on the card.
    is_behind: bool,
}

/// JSON of a description.
pub(super) fn written(py: Python<'_>, json: serde_json::Result<String>) -> PyResult<String> {
    json.map_err(|error| fault_exception(py, &format!("a description cannot be written as JSON: {error}")))
}

impl VecSim {
    /// The simulation, for the learner.
    pub(super) fn sim(&self) -> &Guarded<Sim> {
        &self.sim
    }

    /// Changes the simulation, and updates the arrays that Python sees.
    pub(super) fn run<T: Send>(&mut self, py: Python<'_>, f: impl FnOnce(&mut Sim) -> T + Send) -> PyResult<T> {
        let result = self.sim.run(py, f)?;
        self.publish(py)?;
        Ok(result)
    }

    /// Copies observations that were measured between steps.
    fn publish_observations(&mut self, py: Python<'_>) -> PyResult<()> {
        self.arrays.publish_observations(py, self.sim.batch(), self.sim.world().resource::<Workers>())
    }

    /// Brings the arrays up to date, after steps on the card.
    fn fetch(slf: &Bound<'_, Self>) -> PyResult<()> {
        if slf.try_borrow()?.is_behind {
            let (py, mut this) = (slf.py(), slf.try_borrow_mut()?);
            this.sim.run(py, Sim::fetch_batch)?.map_err(|error| to_python(py, error))?;
            this.publish(py)?;
        }
        Ok(())
    }

    fn publish(&mut self, py: Python<'_>) -> PyResult<()> {
        self.is_behind = false;
        self.arrays.publish(py, self.sim.batch(), self.sim.world().resource::<Workers>())?;
        self.publish_commands(py)
    }

    fn publish_commands(&mut self, py: Python<'_>) -> PyResult<()> {
        let mut target = self.arrays.command.bind(py).try_readwrite()?;
        let out = target.as_slice_mut()?;
        self.sim.run(py, |sim| sim.write_commands(out))
    }

    /// JSON of `of` for each robot, by name.
    fn json_of_robots<T: Serialize>(&self, py: Python<'_>, of: fn(&MorphologyModel) -> T) -> PyResult<String> {
        let json = self.sim.look(py, |sim| {
            let robots: BTreeMap<&str, T> = sim.morphologies().iter().map(|m| (m.name(), of(m))).collect();
            serde_json::to_string(&robots)
        })?;
        written(py, json)
    }

    /// The columns of an observation group: a view that is guarded against writing.
    fn columns<'py>(
        &self,
        py: Python<'py>,
        rows: &Bound<'py, PyArray2<f32>>,
        group: &str,
    ) -> PyResult<Bound<'py, PyAny>> {
        let task = self.sim.task();
        let columns = &task.group(group).map_err(|error| to_python(py, error.into()))?.columns;
        if task.groups.len() == 1 {
            return view(rows.as_any());
        }
        let columns = PySlice::new(py, columns.start as isize, columns.end as isize, 1);
        read_only(rows.get_item((PySlice::full(py), columns))?)
    }

    /// Ends the episodes of a mask, and copies the flags.
    fn end_episodes(
        &mut self,
        py: Python<'_>,
        mask: &Bound<'_, PyAny>,
        end: fn(&mut Sim, &[bool]) -> Result<(), polypod::Error>,
    ) -> PyResult<()> {
        let n = self.sim.num_envs();
        let mask = array::<bool, numpy::Ix1>("mask", mask, "bool", &[n])?;
        let mask = mask.as_slice()?;
        self.sim.run(py, |sim| end(sim, mask))?.map_err(|error| to_python(py, error))?;
        self.arrays.publish_ends(py, self.sim.batch(), self.sim.world().resource::<Workers>())
    }

    fn robot_index(&self, py: Python<'_>, robot: &str) -> PyResult<usize> {
        let names: Vec<&str> = self.sim.morphologies().iter().map(|m| m.name()).collect();
        names.iter().position(|name| *name == robot).ok_or_else(|| {
            let error = polypod::config::ConfigError::unknown_robot_of_run(robot, &names);
            to_python(py, error.into())
        })
    }
}

#[pymethods]
impl VecSim {
    #[new]
    #[pyo3(signature = (task, num_envs, robots=None, seed=0, threads=None, overrides=Vec::new(), autoreset="same_step", dump_dir=None, share=None, slots=Vec::new()))]
    fn new(
        py: Python<'_>,
        task: String,
        #[pyo3(from_py_with = whole)] num_envs: i128,
        robots: Option<Vec<String>>,
        #[pyo3(from_py_with = whole)] seed: i128,
        #[pyo3(from_py_with = optional_whole)] threads: Option<i128>,
        overrides: Vec<String>,
        autoreset: &str,
        dump_dir: Option<PathBuf>,
        #[pyo3(from_py_with = optional_pair)] share: Option<(i128, i128)>,
        slots: Vec<String>,
    ) -> PyResult<Self> {
        let autoreset = autoreset.parse::<Autoreset>().map_err(|error| to_python(py, error))?;
        let num_envs = unsigned(py, "num_envs", num_envs)?;
        let seed = unsigned(py, "seed", seed)?;
        let threads = threads.map(|threads| unsigned(py, "threads", threads)).transpose()?;
        let share = match share {
            Some((start, end)) => Some(unsigned(py, "share", start)?..unsigned(py, "share", end)?),
            None => None,
        };
        let options = SimOptions {
            robots,
            seed,
            threads,
            overrides,
            autoreset,
            dump_dir,
            share,
            slots,
            ..SimOptions::new(task, num_envs)
        };
        let make = || {
            let mut sim = Sim::new(&options)?;
            // all that Python reads goes through methods that bring the components up to date
            sim.stay_on_device(true);
            Ok(sim)
        };
        let sim = Guarded::new(py, make, to_python)?;
        let arrays = BatchArrays::zeros(py, sim.num_envs(), sim.batch().num_obs);
        let mut this = Self { sim, arrays, is_behind: false };
        this.publish(py)?;
        Ok(this)
    }

    #[doc = docstring!("VecSim.num_envs")]
    #[getter]
    fn num_envs(&self) -> usize {
        self.sim.num_envs()
    }
    #[doc = docstring!("VecSim.share")]
    #[getter]
    fn share(&self) -> (usize, usize) {
        let envs = &self.sim.share().envs;
        (envs.start, envs.end)
    }
    #[doc = docstring!("VecSim.total_num_envs")]
    #[getter]
    fn total_num_envs(&self) -> usize {
        self.sim.share().num_envs
    }
    #[doc = docstring!("VecSim.simd")]
    #[getter]
    fn simd(&self) -> &'static str {
        self.sim.simd().name()
    }
    #[doc = docstring!("VecSim.num_obs")]
    #[getter]
    fn num_obs(&self) -> usize {
        self.sim.task().groups[0].columns.len()
    }
    #[doc = docstring!("VecSim.num_actions")]
    #[getter]
    fn num_actions(&self) -> usize {
        self.sim.batch().num_actions
    }
    #[doc = docstring!("VecSim.max_episode_length")]
    #[getter]
    fn max_episode_length(&self) -> u32 {
        self.sim.task().max_episode_length
    }
    #[doc = docstring!("VecSim.step_dt")]
    #[getter]
    fn step_dt(&self) -> f64 {
        self.sim.task().config.sim.step_dt()
    }
    #[doc = docstring!("VecSim.gravity")]
    #[getter]
    fn gravity(&self) -> (f64, f64, f64) {
        self.sim.task().config.sim.gravity.into()
    }
    #[doc = docstring!("VecSim.robots")]
    #[getter]
    fn robots(&self) -> Vec<&str> {
        self.sim.morphologies().iter().map(|m| m.name()).collect()
    }
    #[doc = docstring!("VecSim.canonical_joint_names")]
    #[getter]
    fn canonical_joint_names(&self) -> Vec<String> {
        self.sim.slots().joint_names()
    }
    #[doc = docstring!("VecSim.feet_names")]
    #[getter]
    fn feet_names(&self) -> Vec<&'static str> {
        self.sim.slots().feet_names()
    }
    #[doc = docstring!("VecSim.action_mask")]
    #[getter]
    fn action_mask<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        let shape = [self.sim.num_envs(), self.sim.batch().num_actions];
        PyArray1::from_vec(py, self.sim.action_mask()).reshape(shape)
    }

    #[doc = docstring!("VecSim.is_padded")]
    #[getter]
    fn is_padded(&self) -> bool {
        let num_actions = self.sim.batch().num_actions;
        self.sim.morphologies().iter().any(|robot| robot.slots.len() < num_actions)
    }

    #[doc = docstring!("VecSim.observation_mask")]
    #[pyo3(signature = (robot, group=POLICY_GROUP))]
    fn observation_mask(&self, py: Python<'_>, robot: &str, group: &str) -> PyResult<Vec<bool>> {
        let index = self.robot_index(py, robot)?;
        let mask = self.sim.look(py, |sim| {
            let task = sim.task();
            task.group(group)
                .map(|group| task.observation_mask(&sim.morphologies()[index])[group.columns.clone()].to_vec())
        })?;
        mask.map_err(|error| to_python(py, error.into()))
    }

    #[doc = docstring!("VecSim.observation_shares")]
    #[pyo3(signature = (group=POLICY_GROUP))]
    fn observation_shares(&self, py: Python<'_>, group: &str) -> PyResult<Vec<f64>> {
        let shares = self.sim.look(py, |sim| sim.observation_shares(group))?;
        shares.map_err(|error| to_python(py, error.into()))
    }
    #[doc = docstring!("VecSim.task_name")]
    #[getter]
    fn task_name(&self) -> &str {
        &self.sim.task().config.name
    }
    #[doc = docstring!("VecSim.experiment_name")]
    #[getter]
    fn experiment_name(&self) -> &str {
        &self.sim.task().config.experiment_name
    }
    #[doc = docstring!("VecSim.threads")]
    #[getter]
    fn threads(&self) -> usize {
        self.sim.threads()
    }
    #[doc = docstring!("VecSim.seed")]
    #[getter]
    fn seed(&self) -> u64 {
        self.sim.seed()
    }
    #[doc = docstring!("VecSim.observation_layout")]
    #[getter]
    fn observation_layout(&self) -> Vec<(&str, usize)> {
        let task = self.sim.task();
        task.terms_of(&task.groups[0]).iter().map(|term| (term.name.as_str(), term.size)).collect()
    }
    #[doc = docstring!("VecSim.observation_groups")]
    #[getter]
    fn observation_groups<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        // in their order
        let groups = PyDict::new(py);
        for group in &self.sim.task().groups {
            groups.set_item(&group.name, (group.columns.start, group.columns.end))?;
        }
        Ok(groups)
    }

    #[doc = docstring!("VecSim.observation_terms")]
    #[pyo3(signature = (group=POLICY_GROUP))]
    fn observation_terms(&self, py: Python<'_>, group: &str) -> PyResult<String> {
        #[derive(Serialize)]
        struct Entry<'a> {
            term: &'a str,
            size: usize,
            history_length: usize,
            #[serde(flatten)]
            spec: &'a TermSpec,
            inputs: Vec<&'a str>,
            offset: f32,
            clip: Option<[f32; 2]>,
            scale: f32,
        }
        let task = self.sim.task();
        let group = task.group(group).map_err(|error| to_python(py, error.into()))?;
        let terms = task.terms_of(group).iter().map(|term| Entry {
            term: &term.name,
            size: term.size,
            history_length: term.history,
            spec: &term.spec,
            inputs: term.spec.source.inputs(&term.name),
            offset: term.offset,
            clip: term.clip,
            scale: term.scale,
        });
        written(py, serde_json::to_string(&terms.collect::<Vec<_>>()))
    }

    #[doc = docstring!("VecSim.observation_mirror")]
    #[pyo3(signature = (robot, group=POLICY_GROUP))]
    fn observation_mirror(&self, py: Python<'_>, robot: &str, group: &str) -> PyResult<Vec<(usize, f32)>> {
        let index = self.robot_index(py, robot)?;
        let mirror = self.sim.look(py, |sim| {
            let task = sim.task();
            task.group(group).map(|group| {
                let start = group.columns.start;
                let row = task.mirrored_observation(&sim.morphologies()[index]);
                row[group.columns.clone()].iter().map(|&(column, sign)| (column - start, sign)).collect()
            })
        })?;
        mirror.map_err(|error| to_python(py, error.into()))
    }

    #[doc = docstring!("VecSim.action_mirror")]
    fn action_mirror(&self, py: Python<'_>, robot: &str) -> PyResult<Vec<(usize, f32)>> {
        let index = self.robot_index(py, robot)?;
        self.sim.look(py, |sim| sim.morphologies()[index].mirrored_columns(sim.batch().num_actions))
    }

    #[doc = docstring!("VecSim.env_ids")]
    fn env_ids(&self, py: Python<'_>, robot: &str) -> PyResult<(usize, usize)> {
        let range = self.sim.env_ids(self.robot_index(py, robot)?);
        Ok((range.start, range.end))
    }

    #[doc = docstring!("VecSim.joint_map")]
    fn joint_map(&self, py: Python<'_>, robot: &str) -> PyResult<Vec<(&str, usize)>> {
        let morphology = &self.sim.morphologies()[self.robot_index(py, robot)?];
        Ok(morphology.joint_names_by_slot().into_iter().zip(morphology.joint_of_slot()).collect())
    }

    #[doc = docstring!("VecSim.robot_info")]
    fn robot_info(&self, py: Python<'_>) -> PyResult<String> {
        self.json_of_robots(py, MorphologyModel::describe)
    }

    #[doc = docstring!("VecSim.command_ranges")]
    fn command_ranges(&self) -> BTreeMap<&str, BTreeMap<&str, [f64; 2]>> {
        let ranges = |config: &VelocityCommandConfig| {
            [("lin_vel_x", config.lin_vel_x), ("lin_vel_y", config.lin_vel_y), ("ang_vel_z", config.ang_vel_z)]
        };
        let robots = self.sim.morphologies().iter().zip(self.sim.velocity_commands());
        robots.map(|(robot, config)| (robot.name(), ranges(config).into_iter().collect())).collect()
    }

    #[doc = docstring!("VecSim.network_torques")]
    #[pyo3(signature = (robot, error, velocity, memory=None))]
    fn network_torques<'py>(
        &self,
        py: Python<'py>,
        robot: &str,
        error: &Bound<'py, PyAny>,
        velocity: &Bound<'py, PyAny>,
        memory: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<(Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<f32>>)> {
        let model = &self.sim.morphologies()[self.robot_index(py, robot)?];
        let (joints, remembered) = (model.topology.num_joints(), model.num_remembered());
        let rows = error.cast::<PyUntypedArray>().ok().and_then(|array| array.shape().first().copied()).unwrap_or(1);
        let error: PyReadonlyArray2<'_, f32> = array("error", error, "float32", &[rows, joints])?;
        let velocity: PyReadonlyArray2<'_, f32> = array("velocity", velocity, "float32", &[rows, joints])?;
        let mut after = match memory {
            Some(memory) => {
                let memory: PyReadonlyArray2<'_, f32> = array("memory", memory, "float32", &[rows, remembered])?;
                memory.as_slice()?.to_vec()
            }
            None => vec![0.0_f32; rows * remembered],
        };
        let (error, velocity): (&[f32], &[f32]) = (error.as_slice()?, velocity.as_slice()?);
        let mut torques = Vec::with_capacity(rows * joints);
        for row in 0..rows {
            let of_row = row * joints..(row + 1) * joints;
            let memory = &mut after[row * remembered..(row + 1) * remembered];
            torques.extend(model.network_torques(&error[of_row.clone()], &velocity[of_row], memory));
        }
        let matrix = |numbers, width| PyArray1::from_vec(py, numbers).reshape([rows, width]);
        Ok((matrix(torques, joints)?, matrix(after, remembered)?))
    }

    #[doc = docstring!("VecSim.robot_shapes")]
    fn robot_shapes(&self, py: Python<'_>) -> PyResult<String> {
        self.json_of_robots(py, MorphologyModel::outline)
    }

    #[doc = docstring!("VecSim.qpos")]
    fn qpos<'py>(&mut self, py: Python<'py>, robot: &str) -> PyResult<Bound<'py, PyAny>> {
        let index = self.robot_index(py, robot)?;
        let states = self.sim.run(py, |sim| sim.robot_states(index))?;
        rows(py, states.qpos, self.sim.env_ids(index).len())
    }

    #[doc = docstring!("VecSim.qvel")]
    fn qvel<'py>(&mut self, py: Python<'py>, robot: &str) -> PyResult<Bound<'py, PyAny>> {
        let index = self.robot_index(py, robot)?;
        let states = self.sim.run(py, |sim| sim.robot_states(index))?;
        rows(py, states.qvel, self.sim.env_ids(index).len())
    }

    #[doc = docstring!("VecSim.link_pose")]
    fn link_pose<'py>(&mut self, py: Python<'py>, robot: &str) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let index = self.robot_index(py, robot)?;
        let poses = self.sim.run(py, |sim| sim.link_pose(index))?;
        let (envs, links) = (self.sim.env_ids(index).len(), self.sim.morphologies()[index].model.links.len());
        Ok((shaped(py, poses.position, [envs, links, 3])?, shaped(py, poses.quaternion, [envs, links, 4])?))
    }

    #[doc = docstring!("VecSim.link_names")]
    fn link_names(&self, py: Python<'_>, robot: &str) -> PyResult<Vec<&str>> {
        let model = &self.sim.morphologies()[self.robot_index(py, robot)?].model;
        Ok(model.links.iter().map(|link| link.name.as_str()).collect())
    }

    #[doc = docstring!("VecSim.contact_body_names")]
    fn contact_body_names(&self, py: Python<'_>, robot: &str) -> PyResult<Vec<&str>> {
        let model = &self.sim.morphologies()[self.robot_index(py, robot)?].model;
        Ok(model.bodies.iter().map(|body| body.name.as_str()).collect())
    }

    #[doc = docstring!("VecSim.contact_forces")]
    fn contact_forces<'py>(&mut self, py: Python<'py>, robot: &str) -> PyResult<Bound<'py, PyAny>> {
        let index = self.robot_index(py, robot)?;
        let (envs, bodies) = (self.sim.env_ids(index).len(), self.sim.morphologies()[index].topology.num_bodies);
        let forces = self.sim.run(py, |sim| sim.contact_forces(index))?;
        shaped(py, forces, [envs, bodies, 3])
    }

    #[doc = docstring!("VecSim.resolved_config")]
    fn resolved_config(&self, py: Python<'_>) -> PyResult<String> {
        self.sim.look(py, Sim::resolved_config)
    }

    #[doc = docstring!("VecSim.config_hash")]
    fn config_hash(&self, py: Python<'_>) -> PyResult<String> {
        Ok(format!("{:016x}", self.sim.look(py, Sim::config_hash)?))
    }

    #[doc = docstring!("VecSim.reset")]
    #[pyo3(signature = (seed=None, mask=None, state=None))]
    fn reset(
        &mut self,
        py: Python<'_>,
        #[pyo3(from_py_with = optional_whole)] seed: Option<i128>,
        mask: Option<&Bound<'_, PyAny>>,
        state: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<()> {
        let seed = seed.map(|seed| unsigned(py, "seed", seed)).transpose()?;
        let n = self.sim.num_envs();
        let mask = mask.map(|mask| array::<bool, numpy::Ix1>("mask", mask, "bool", &[n])).transpose()?;
        let mask = mask.as_ref().map(|mask| mask.as_slice()).transpose()?;
        let envs: Vec<usize> = (0..n).filter(|&env| mask.is_none_or(|mask| mask[env])).collect();
        let slots = self.sim.batch().num_actions;
        let state = state.map(|state| StateArguments::of_dict(state, envs.len(), slots)).transpose()?;
        let reset = self.sim.run(py, |sim| match &state {
            None => sim.reset(seed, mask),
            Some(state) => sim.reset_to(seed, mask, &state.rows()),
        })?;
        reset.map_err(|error| to_python(py, error))?;
        self.publish(py)
    }

    #[doc = docstring!("VecSim.set_state")]
    #[pyo3(signature = (env_ids=None, *, base_pos=None, base_quat=None, base_lin_vel=None, base_ang_vel=None, joint_pos=None, joint_vel=None))]
    fn set_state(
        &mut self,
        py: Python<'_>,
        env_ids: Option<&Bound<'_, PyAny>>,
        base_pos: Option<&Bound<'_, PyAny>>,
        base_quat: Option<&Bound<'_, PyAny>>,
        base_lin_vel: Option<&Bound<'_, PyAny>>,
        base_ang_vel: Option<&Bound<'_, PyAny>>,
        joint_pos: Option<&Bound<'_, PyAny>>,
        joint_vel: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let envs = self::env_ids("set_state", env_ids, self.sim.num_envs())?;
        let values = [base_pos, base_quat, base_lin_vel, base_ang_vel, joint_pos, joint_vel];
        let state = StateArguments::new(values, envs.len(), self.sim.batch().num_actions)?;
        self.sim.run(py, |sim| sim.set_states(&envs, &state.rows()))?.map_err(|error| to_python(py, error))?;
        self.publish_observations(py)
    }

    #[doc = docstring!("VecSim.set_friction")]
    #[pyo3(signature = (static_friction, dynamic_friction=None, env_ids=None))]
    fn set_friction(
        &mut self,
        py: Python<'_>,
        static_friction: &Bound<'_, PyAny>,
        dynamic_friction: Option<&Bound<'_, PyAny>>,
        env_ids: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let envs = self::env_ids("set_friction", env_ids, self.sim.num_envs())?;
        let rows = (envs.len(), 1);
        let sticking = numbers("set_friction: static_friction", static_friction, rows, false)?;
        let sliding =
            dynamic_friction.map(|x| numbers("set_friction: dynamic_friction", x, rows, false)).transpose()?;
        let set = self.sim.run(py, |sim| sim.set_friction(&envs, &sticking, sliding.as_deref()))?;
        set.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.set_mass")]
    #[pyo3(signature = (mass, link=None, env_ids=None))]
    fn set_mass(
        &mut self,
        py: Python<'_>,
        mass: &Bound<'_, PyAny>,
        link: Option<&str>,
        env_ids: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let envs = self::env_ids("set_mass", env_ids, self.sim.num_envs())?;
        let mass = numbers("set_mass: mass", mass, (envs.len(), 1), false)?;
        self.sim.run(py, |sim| sim.set_mass(&envs, link, &mass))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.set_gains")]
    #[pyo3(signature = (stiffness=None, damping=None, env_ids=None))]
    fn set_gains(
        &mut self,
        py: Python<'_>,
        stiffness: Option<&Bound<'_, PyAny>>,
        damping: Option<&Bound<'_, PyAny>>,
        env_ids: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let envs = self::env_ids("set_gains", env_ids, self.sim.num_envs())?;
        let rows = (envs.len(), self.sim.batch().num_actions);
        let gains = |element, value: Option<&Bound<'_, PyAny>>| {
            value.map(|value| numbers(element, value, rows, true)).transpose()
        };
        let (stiffness, damping) = (gains("set_gains: stiffness", stiffness)?, gains("set_gains: damping", damping)?);
        let set = self.sim.run(py, |sim| sim.set_gains(&envs, stiffness.as_deref(), damping.as_deref()))?;
        set.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.parameters")]
    fn parameters<'py>(&mut self, py: Python<'py>, robot: &str) -> PyResult<Bound<'py, PyDict>> {
        let index = self.robot_index(py, robot)?;
        let (n, slots) = (self.sim.env_ids(index).len(), self.sim.batch().num_actions);
        let links = self.sim.morphologies()[index].model.links.len();
        let all = self.sim.run(py, |sim| sim.parameters(index))?;
        let entries = PyDict::new(py);
        entries.set_item("static_friction", shaped(py, all.static_friction, [n])?)?;
        entries.set_item("dynamic_friction", shaped(py, all.dynamic_friction, [n])?)?;
        for (name, numbers, width) in
            [("mass", all.mass, links), ("stiffness", all.stiffness, slots), ("damping", all.damping, slots)]
        {
            entries.set_item(name, shaped(py, numbers, [n, width])?)?;
        }
        Ok(entries)
    }

    #[doc = docstring!("VecSim.apply_force")]
    #[pyo3(signature = (force, torque=None, *, link=None, env_ids=None, frame="world", point=None, steps=None, duration_s=None))]
    fn apply_force(
        &mut self,
        py: Python<'_>,
        force: &Bound<'_, PyAny>,
        torque: Option<&Bound<'_, PyAny>>,
        link: Option<&str>,
        env_ids: Option<&Bound<'_, PyAny>>,
        frame: &str,
        point: Option<&Bound<'_, PyAny>>,
        #[pyo3(from_py_with = optional_whole)] steps: Option<i128>,
        duration_s: Option<f64>,
    ) -> PyResult<()> {
        let envs = self::env_ids("apply_force", env_ids, self.sim.num_envs())?;
        let in_world = in_world(frame)?;
        let steps = force_steps(py, steps, duration_s, self.step_dt())?;
        let vectors = |element, value| numbers(element, value, (envs.len(), 3), false);
        let force = vectors("apply_force: force", force)?;
        let torque = torque.map(|torque| vectors("apply_force: torque", torque)).transpose()?;
        let point = point.map(|point| vectors("apply_force: point", point)).transpose()?;
        let rows = ForceRows { force: &force, torque: torque.as_deref(), in_world, point: point.as_deref(), steps };
        self.sim.run(py, |sim| sim.apply_force(&envs, link, &rows))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.links")]
    #[pyo3(signature = (robot, names=None))]
    fn links<'py>(&mut self, py: Python<'py>, robot: &str, names: Option<Vec<String>>) -> PyResult<Bound<'py, PyDict>> {
        let index = self.robot_index(py, robot)?;
        let (n, all) = (self.sim.env_ids(index).len(), self.sim.morphologies()[index].model.links.len());
        let links = names.as_ref().map_or(all, Vec::len);
        let rows = self.sim.run(py, |sim| sim.links(index, names.as_deref()))?;
        let rows = rows.map_err(|error| to_python(py, error))?;
        let entries = PyDict::new(py);
        for (name, numbers, width) in [
            ("pos", rows.position, 3),
            ("quat", rows.quaternion, 4),
            ("lin_vel", rows.linear_velocity, 3),
            ("ang_vel", rows.angular_velocity, 3),
            ("contact_force", rows.contact_force, 3),
        ] {
            entries.set_item(name, shaped(py, numbers, [n, links, width])?)?;
        }
        Ok(entries)
    }

    #[doc = docstring!("VecSim.step")]
    fn step(&mut self, py: Python<'_>, actions: &Bound<'_, PyAny>) -> PyResult<()> {
        let shape = [self.sim.num_envs(), self.sim.batch().num_actions];
        let actions = array::<f32, numpy::Ix2>("actions", actions, "float32", &shape)?;
        let actions = actions.as_slice()?;
        self.sim.run(py, |sim| sim.step(actions))?.map_err(|error| to_python(py, error))?;
        self.publish(py)
    }

    #[doc = docstring!("VecSim.device_arrays")]
    fn device_arrays(&mut self, py: Python<'_>) -> PyResult<Option<BTreeMap<&'static str, DeviceArray>>> {
        let rows = self.sim.run(py, Sim::device_rows)?.map_err(|error| to_python(py, error))?;
        Ok(rows.map(|rows| DeviceArray::all(&rows)))
    }

    #[doc = docstring!("VecSim.step_device")]
    #[pyo3(signature = (stream=0))]
    fn step_device(&mut self, py: Python<'_>, #[pyo3(from_py_with = whole)] stream: i128) -> PyResult<()> {
        let stream = unsigned(py, "stream", stream)?;
        self.is_behind = true;
        self.sim.run(py, |sim| sim.step_device(stream))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.observation")]
    #[getter]
    fn observation<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::observation_of(slf, POLICY_GROUP)
    }
    #[doc = docstring!("VecSim.observation_of")]
    fn observation_of<'py>(slf: &Bound<'py, Self>, group: &str) -> PyResult<Bound<'py, PyAny>> {
        Self::fetch(slf)?;
        let this = slf.try_borrow()?;
        this.columns(slf.py(), this.arrays.observations[this.arrays.current].bind(slf.py()), group)
    }
    #[doc = docstring!("VecSim.reward")]
    #[getter]
    fn reward<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::fetch(slf)?;
        view(slf.try_borrow()?.arrays.reward.bind(slf.py()).as_any())
    }
    #[doc = docstring!("VecSim.terminated")]
    #[getter]
    fn terminated<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::fetch(slf)?;
        view(slf.try_borrow()?.arrays.terminated.bind(slf.py()).as_any())
    }
    #[doc = docstring!("VecSim.truncated")]
    #[getter]
    fn truncated<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::fetch(slf)?;
        view(slf.try_borrow()?.arrays.truncated.bind(slf.py()).as_any())
    }
    #[doc = docstring!("VecSim.final_obs")]
    #[getter]
    fn final_obs<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::final_obs_of(slf, POLICY_GROUP)
    }
    #[doc = docstring!("VecSim.final_obs_of")]
    fn final_obs_of<'py>(slf: &Bound<'py, Self>, group: &str) -> PyResult<Bound<'py, PyAny>> {
        Self::fetch(slf)?;
        let this = slf.try_borrow()?;
        this.columns(slf.py(), this.arrays.final_obs.bind(slf.py()), group)
    }
    #[doc = docstring!("VecSim.final_mask")]
    #[getter]
    fn final_mask<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::fetch(slf)?;
        view(slf.try_borrow()?.arrays.final_mask.bind(slf.py()).as_any())
    }
    #[doc = docstring!("VecSim.command")]
    #[getter]
    fn command<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::fetch(slf)?;
        view(slf.try_borrow()?.arrays.command.bind(slf.py()).as_any())
    }

    #[doc = docstring!("VecSim.state")]
    fn state<'py>(&mut self, py: Python<'py>, field: &str) -> PyResult<Bound<'py, PyAny>> {
        let Some(known) = StateField::ALL.into_iter().find(|known| known.name() == field) else {
            let names: Vec<&str> = StateField::ALL.iter().map(|known| known.name()).collect();
            return Err(value_error(format!("field: there is no `{field}`; use one of {}", names.join(", "))));
        };
        let rows = PyArray2::<f32>::zeros(py, [self.sim.num_envs(), self.sim.state_width(known)], false);
        {
            let mut out = rows.try_readwrite()?;
            let out = out.as_slice_mut()?;
            self.sim.run(py, |sim| sim.state(known, out))?.map_err(|error| to_python(py, error))?;
        }
        read_only(rows.into_any())
    }

    #[doc = docstring!("VecSim.terminate")]
    fn terminate(&mut self, py: Python<'_>, mask: &Bound<'_, PyAny>) -> PyResult<()> {
        self.end_episodes(py, mask, Sim::terminate)
    }

    #[doc = docstring!("VecSim.truncate")]
    fn truncate(&mut self, py: Python<'_>, mask: &Bound<'_, PyAny>) -> PyResult<()> {
        self.end_episodes(py, mask, Sim::truncate)
    }

    #[doc = docstring!("VecSim.env_origins")]
    fn env_origins<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let rows = self.sim.run(py, terrain::origins)?;
        shaped(py, rows, [self.sim.num_envs(), 3])
    }

    #[doc = docstring!("VecSim.terrain")]
    fn terrain<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let ground = self.sim.world().resource::<Ground>();
        terrain::entry(py, &self.sim.task().config, ground)
    }

    #[doc = docstring!("VecSim.terrain_tiles")]
    fn terrain_tiles<'py>(&mut self, py: Python<'py>) -> PyResult<(Bound<'py, PyArray1<i64>>, Vec<String>)> {
        let (levels, names) = self.sim.run(py, terrain::tiles)?;
        Ok((PyArray1::from_vec(py, levels), names))
    }

    #[doc = docstring!("VecSim.episode_length")]
    #[getter]
    fn episode_length<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let lengths = self.sim.run(py, |sim| {
            let mut lengths = vec![0; sim.num_envs()];
            let world = sim.world_mut();
            for (env, episode) in world.query::<(&EnvId, &Episode)>().iter(world) {
                lengths[env.0 as usize] = i64::from(episode.length);
            }
            lengths
        })?;
        shaped(py, lengths, [self.sim.num_envs()])
    }

    #[doc = docstring!("VecSim.set_episode_length")]
    fn set_episode_length(&mut self, py: Python<'_>, episode_length: &Bound<'_, PyAny>) -> PyResult<()> {
        let n = self.sim.num_envs();
        let lengths = array::<i64, numpy::Ix1>("episode_length", episode_length, "int64", &[n])?;
        let lengths = lengths.as_slice()?;
        self.sim.run(py, |sim| sim.set_episode_lengths(lengths))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.command_columns")]
    fn command_columns(&self) -> BTreeMap<&str, Vec<&'static str>> {
        let terms = self.sim.task().command_terms.iter();
        let mut columns: BTreeMap<_, _> = terms.map(|term| (term.name.as_str(), term.columns.to_vec())).collect();
        if self.sim.task().has_velocity_command() {
            columns.insert(VELOCITY_COMMAND, VELOCITY_COLUMNS.to_vec());
        }
        columns
    }

    #[doc = docstring!("VecSim.command_of")]
    fn command_of<'py>(slf: &Bound<'py, Self>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        Self::fetch(slf)?;
        let (py, mut this) = (slf.py(), slf.try_borrow_mut()?);
        if name == VELOCITY_COMMAND && this.sim.task().has_velocity_command() {
            return this.arrays.command.bind(py).call_method0("copy");
        }
        let numbers = this.sim.run(py, |sim| sim.command_numbers(name))?.map_err(|error| to_python(py, error))?;
        let shape = [this.sim.num_envs(), numbers.len() / this.sim.num_envs().max(1)];
        Ok(numbers.into_pyarray(py).reshape(shape)?.into_any())
    }

    #[doc = docstring!("VecSim.set_command")]
    #[pyo3(signature = (command, env_ids=None, *, name=VELOCITY_COMMAND))]
    fn set_command(
        &mut self,
        py: Python<'_>,
        command: Option<&Bound<'_, PyAny>>,
        env_ids: Option<&Bound<'_, PyAny>>,
        name: &str,
    ) -> PyResult<()> {
        let envs = self::env_ids("set_command", env_ids, self.sim.num_envs())?;
        let of_other = self.sim.task().command_terms.iter().find(|term| term.name == name);
        let shape = [envs.len(), of_other.map_or(3, |term| term.columns.len())];
        let command = command.map(|c| array::<f32, numpy::Ix2>("command", c, "float32", &shape)).transpose()?;
        let command = command.as_ref().map(|c| c.as_slice()).transpose()?;
        let set = self.sim.run(py, |sim| match name {
            VELOCITY_COMMAND => sim.set_commands_of(&envs, command),
            _ => sim.pin_command_of(&envs, name, command),
        })?;
        set.map_err(|error| to_python(py, error))?;
        self.publish_commands(py)
    }

    #[doc = docstring!("VecSim.observe_external")]
    #[pyo3(signature = (values, mask=None))]
    fn observe_external(
        &mut self,
        py: Python<'_>,
        values: &Bound<'_, PyAny>,
        mask: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let n = self.sim.num_envs();
        let values = array::<f32, numpy::Ix2>("values", values, "float32", &[n, self.sim.num_external()])?;
        let values = values.as_slice()?;
        let mask = mask.map(|mask| array::<bool, numpy::Ix1>("mask", mask, "bool", &[n])).transpose()?;
        let mask = mask.as_ref().map(|mask| mask.as_slice()).transpose()?;
        self.sim.run(py, |sim| sim.observe_external(values, mask))?.map_err(|error| to_python(py, error))?;
        self.arrays.update_observations(py, self.sim.batch(), self.sim.world().resource::<Workers>())
    }

    #[doc = docstring!("VecSim.set_reward_weight")]
    fn set_reward_weight(&mut self, py: Python<'_>, robot: &str, term: &str, weight: f64) -> PyResult<()> {
        let index = self.robot_index(py, robot)?;
        self.sim.run(py, |sim| sim.set_reward_weight(index, term, weight))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.set_command_ranges")]
    #[pyo3(signature = (robot, *, lin_vel_x=None, lin_vel_y=None, ang_vel_z=None))]
    fn set_command_ranges(
        &mut self,
        py: Python<'_>,
        robot: &str,
        lin_vel_x: Option<[f64; 2]>,
        lin_vel_y: Option<[f64; 2]>,
        ang_vel_z: Option<[f64; 2]>,
    ) -> PyResult<()> {
        let index = self.robot_index(py, robot)?;
        let now = &self.sim.velocity_commands()[index];
        let ranges = [
            lin_vel_x.unwrap_or(now.lin_vel_x),
            lin_vel_y.unwrap_or(now.lin_vel_y),
            ang_vel_z.unwrap_or(now.ang_vel_z),
        ];
        self.sim.run(py, |sim| sim.set_command_ranges(index, ranges))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.set_terrain_levels")]
    fn set_terrain_levels(&mut self, py: Python<'_>, levels: &Bound<'_, PyAny>) -> PyResult<()> {
        let n = self.sim.num_envs();
        let levels = array::<i64, numpy::Ix1>("levels", levels, "int64", &[n])?;
        let levels = levels.as_slice()?;
        self.sim.run(py, |sim| sim.set_terrain_levels(levels))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.push")]
    fn push(&mut self, py: Python<'_>, velocity: &Bound<'_, PyAny>) -> PyResult<()> {
        let n = self.sim.num_envs();
        let velocity = array::<f32, numpy::Ix2>("velocity", velocity, "float32", &[n, 3])?;
        let velocity = velocity.as_slice()?;
        self.sim.run(py, |sim| sim.push(velocity))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.reward_terms")]
    fn reward_terms(&self, py: Python<'_>, robot: &str) -> PyResult<Vec<&str>> {
        Ok(self.sim.reward_terms(self.robot_index(py, robot)?))
    }

    #[doc = docstring!("VecSim.reward_weights")]
    fn reward_weights(&self, py: Python<'_>, robot: &str) -> PyResult<BTreeMap<&str, f32>> {
        let index = self.robot_index(py, robot)?;
        Ok(self.sim.task().rewards[index].iter().map(|term| (term.name.as_str(), term.weight)).collect())
    }

    #[doc = docstring!("VecSim.reward_sums")]
    fn reward_sums<'py>(&mut self, py: Python<'py>, robot: &str) -> PyResult<Bound<'py, PyAny>> {
        let index = self.robot_index(py, robot)?;
        let (envs, terms) = (self.sim.env_ids(index).len(), self.sim.reward_terms(index).len());
        let sums = self.sim.run(py, |sim| sim.reward_sums(index))?;
        shaped(py, sums, [envs, terms])
    }

    #[doc = docstring!("VecSim.height_scan")]
    fn height_scan<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let points = self.sim.run(py, Sim::height_scan)?;
        let (envs, rays) = (self.sim.num_envs(), points.len() / (3 * self.sim.num_envs()).max(1));
        shaped(py, points, [envs, rays, 3])
    }

    #[doc = docstring!("VecSim.log")]
    fn log(&mut self, py: Python<'_>) -> PyResult<BTreeMap<String, f64>> {
        self.sim.run(py, Sim::take_log)
    }

    #[doc = docstring!("VecSim.take_logs")]
    fn take_logs<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self.sim.run(py, Sim::take_logs)?.map_err(|error| to_python(py, error))?;
        Ok(PyBytes::new(py, &bytes))
    }

    #[doc = docstring!("VecSim.add_logs")]
    fn add_logs(&mut self, py: Python<'_>, data: &[u8]) -> PyResult<()> {
        self.sim.run(py, |sim| sim.add_logs(data))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.episode_stats")]
    #[pyo3(signature = (clear=true))]
    fn episode_stats(
        &mut self,
        py: Python<'_>,
        clear: bool,
    ) -> PyResult<BTreeMap<String, BTreeMap<&'static str, f64>>> {
        let stats = self.sim.run(py, |sim| sim.episode_stats(clear))?;
        let entry = |s: polypod::systems::EpisodeStats| {
            let level = s.terrain_level.map(|level| ("terrain_level", level));
            let stats = [
                ("episodes", s.episodes as f64),
                ("falls", s.falls as f64),
                ("fall_rate", s.falls as f64 / s.episodes.max(1) as f64),
                ("episode_length_s", s.episode_length_s),
                ("error_vel_xy", s.error_vel_xy),
                ("error_vel_yaw", s.error_vel_yaw),
                ("command_xy", s.command_xy),
                ("command_yaw", s.command_yaw),
                ("reward_per_s", s.reward_per_s),
                ("distance", s.distance),
            ];
            stats.into_iter().chain(level).collect()
        };
        Ok(stats.into_iter().map(|(robot, stats)| (robot, entry(stats))).collect())
    }

    #[doc = docstring!("VecSim.stay_on_device")]
    fn stay_on_device(&mut self, py: Python<'_>, stay: bool) -> PyResult<()> {
        self.sim.run(py, |sim| sim.stay_on_device(stay))
    }

    #[doc = docstring!("VecSim.steps_on_device")]
    #[getter]
    fn steps_on_device(&self) -> u64 {
        self.sim.steps_on_device()
    }

    #[doc = docstring!("VecSim.lacks_on_device")]
    fn lacks_on_device(&mut self, py: Python<'_>) -> PyResult<Option<String>> {
        self.sim.run(py, Sim::lacks_on_device)
    }

    #[doc = docstring!("VecSim.choice_of_engine")]
    #[getter]
    fn choice_of_engine(&self) -> Option<&str> {
        self.sim.choice_of_engine()
    }

    #[doc = docstring!("VecSim.set_dump_dir")]
    #[pyo3(signature = (dump_dir))]
    fn set_dump_dir(&mut self, py: Python<'_>, dump_dir: Option<PathBuf>) -> PyResult<()> {
        self.sim.run(py, |sim| sim.set_dump_dir(dump_dir))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("VecSim.snapshot")]
    #[pyo3(signature = (env_ids=None))]
    fn snapshot<'py>(&mut self, py: Python<'py>, env_ids: Option<&Bound<'py, PyAny>>) -> PyResult<Bound<'py, PyBytes>> {
        let envs = env_ids.map(|ids| self::env_ids("snapshot", Some(ids), self.sim.num_envs())).transpose()?;
        let bytes = self.sim.run(py, |sim| match &envs {
            None => sim.snapshot(),
            Some(envs) => sim.snapshot_of(envs),
        })?;
        let bytes = bytes.map_err(|error| to_python(py, error))?;
        Ok(PyBytes::new(py, &bytes))
    }

    #[doc = docstring!("VecSim.restore")]
    #[pyo3(signature = (data, env_ids=None))]
    fn restore(&mut self, py: Python<'_>, data: &[u8], env_ids: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
        let envs = env_ids.map(|ids| self::env_ids("restore", Some(ids), self.sim.num_envs())).transpose()?;
        let restored = self.sim.run(py, |sim| match &envs {
            None => sim.restore(data),
            Some(envs) => sim.restore_some(data, envs),
        })?;
        restored.map_err(|error| to_python(py, error))?;
        self.publish(py)
    }
}
