//! `Simulation`: physics without a task behind NumPy arrays.

use std::collections::BTreeMap;
use std::ffi::CString;
use std::path::PathBuf;

use numpy::{PyArray1, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::PyUserWarning;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use super::arrays::tuple;
use super::exceptions::{Guarded, optional_whole, to_python, type_error, unsigned, value_error, whole};
use polypod::AVIAN_SUBSTEPS;
use polypod::Error;
use polypod::config::EARTH_GRAVITY;
use polypod::dynamics::SWEEPS;
use polypod::dynamics::lanes::Simd;
use polypod::robot::summed_up;
use polypod::simulation::{Control, LinkId, Precision, Simulation as Inner, SimulationOptions};

#[doc = docstring!("Simulation")]
#[pyclass(module = "polypod._core")]
pub(super) struct Simulation {
    sim: Guarded<Inner>,
}

type Array<'py> = PyResult<Bound<'py, PyArrayDyn<f64>>>;

/// Numbers as a NumPy array of this shape.
fn array<'py>(py: Python<'py>, values: Vec<f64>, shape: &[usize]) -> Array<'py> {
    PyArray1::from_vec(py, values).reshape(shape.to_vec())
}

/// An argument as numbers, if its shape is one of `shapes`.
fn numbers(name: &str, value: &Bound<'_, PyAny>, shapes: &[Vec<usize>]) -> PyResult<Vec<f64>> {
    let numpy = value.py().import("numpy")?;
    let converted = numpy.call_method1("ascontiguousarray", (value, "float64"));
    let converted = converted.map_err(|error| type_error(format!("{name}: no array of numbers ({error})")))?;
    // ascontiguousarray makes a scalar one-dimensional
    let shape: Vec<usize> = numpy.call_method1("shape", (value,))?.extract()?;
    if !shapes.contains(&shape) {
        let mut wanted: Vec<String> = shapes.iter().map(|shape| tuple(shape)).collect();
        wanted.dedup();
        let wanted = wanted.join(" or ").replace("()", "a number");
        return Err(value_error(format!("{name}: shape {}; pass {wanted}", tuple(&shape))));
    }
    let array = converted.cast_into::<PyArrayDyn<f64>>()?;
    Ok(array.try_readonly()?.as_slice()?.to_vec())
}

/// The envs of a call.
fn env_indices(value: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Vec<usize>>> {
    let Some(value) = value else {
        return Ok(None);
    };
    let remedy = "pass a sequence of env indices; np.flatnonzero(mask) for a mask";
    let flat = value.py().import("numpy")?.call_method1("atleast_1d", (value,))?;
    let array = flat.cast::<PyUntypedArray>()?;
    if array.ndim() != 1 {
        return Err(value_error(format!("env_ids: shape {}; {remedy}", tuple(array.shape()))));
    }
    if array.len() > 0 && !matches!(array.dtype().kind(), b'i' | b'u') {
        return Err(type_error(format!("env_ids: dtype {}; {remedy}", array.dtype())));
    }
    let ids: Vec<i64> = flat.call_method1("astype", ("int64",))?.extract()?;
    let index =
        |id: i64| usize::try_from(id).map_err(|_| value_error(format!("env_ids: there is no env {id}; {remedy}")));
    ids.into_iter().map(index).collect::<PyResult<Vec<usize>>>().map(Some)
}

/// A link by its name or index in Python.
enum Link {
    Name(String),
    Index(usize),
}

impl Link {
    fn id(&self) -> LinkId<'_> {
        match self {
            Self::Name(name) => LinkId::Name(name),
            Self::Index(index) => LinkId::Index(*index),
        }
    }
}

/// A name or an index.
fn link_of(link: &Bound<'_, PyAny>, num_links: usize) -> PyResult<Link> {
    if let Ok(name) = link.extract::<String>() {
        return Ok(Link::Name(name));
    }
    let Ok(index) = whole(link) else {
        return Err(type_error(format!("link: a {}; pass a name or an index", link.get_type().name()?)));
    };
    unsigned(link.py(), "link", index).map(Link::Index).map_err(|_| {
        let remedy = format!("the links are 0 to {}, in the order of link_names", num_links - 1);
        let problem = format!("there is no link {index}");
        to_python(link.py(), Error::Argument { element: "link", problem, remedy })
    })
}

impl Simulation {
    /// Shapes of a row of joints.
    fn of_joints(&self, rows: usize) -> Vec<Vec<usize>> {
        let joints = self.sim.num_joints();
        vec![vec![], vec![joints], vec![rows, joints]]
    }

    fn optional(name: &str, value: Option<&Bound<'_, PyAny>>, shapes: &[Vec<usize>]) -> PyResult<Option<Vec<f64>>> {
        value.map(|value| numbers(name, value, shapes)).transpose()
    }

    fn count(&self, ids: Option<&Vec<usize>>) -> usize {
        ids.map_or(self.sim.num_envs(), Vec::len)
    }
}

fn options(
    robot: PathBuf,
    num_envs: usize,
    ground: Option<&str>,
    ground_normal: [f64; 3],
    friction: &Bound<'_, PyAny>,
    armature: Option<&Bound<'_, PyAny>>,
    dtype: &Bound<'_, PyAny>,
    simd: Option<&str>,
) -> PyResult<SimulationOptions> {
    let py = friction.py();
    let config = |element, problem: String, remedy: &str| {
        to_python(py, Error::Argument { element, problem, remedy: remedy.into() })
    };
    let friction = match numbers("friction", friction, &[vec![], vec![2]])?[..] {
        [both] => [both, both],
        [sticking, sliding, ..] => [sticking, sliding],
        [] => return Err(value_error("friction: no number".into())),
    };
    let ground = match ground {
        Some("plane") => Some(ground_normal),
        None => None,
        Some(other) => return Err(config("ground", format!("there is no ground `{other}`"), "use \"plane\" or None")),
    };
    let name = match dtype.getattr("__name__") {
        Ok(name) => name.extract::<String>()?,
        Err(_) => dtype.str()?.to_string(),
    };
    let precision = match name.as_str() {
        "float32" => Precision::Single,
        "float64" => Precision::Double,
        other => return Err(config("dtype", format!("no simulation in {other}"), "use \"float32\" or \"float64\"")),
    };
    let armature = armature.map(|value| numbers_of_any_length("armature", value)).transpose()?;
    let simd = simd.map(Simd::named).transpose().map_err(|error| to_python(py, error.into()))?;
    Ok(SimulationOptions {
        ground,
        friction,
        armature,
        precision,
        simd,
        ..SimulationOptions::new(robot.to_string_lossy(), num_envs)
    })
}

/// Numbers of a scalar or a vector; the simulation checks the length.
fn numbers_of_any_length(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    let length = value.py().import("numpy")?.call_method1("size", (value,))?.extract()?;
    numbers(name, value, &[vec![], vec![length]])
}

// the signature below must hold figures: Python prints names as `...`
const _: () = assert!(SWEEPS == 4 && AVIAN_SUBSTEPS == 8 && EARTH_GRAVITY == 9.81);

#[pymethods]
impl Simulation {
    #[new]
    #[pyo3(signature = (robot, num_envs=1, *, dt=0.005, ground=Some("plane"), gravity=[0.0, 0.0, -9.81],
        engine="articulated".to_string(), fixed_base=false, package_dirs=BTreeMap::new(),
        locked_joints=BTreeMap::new(), friction=None, torsional_friction=0.0, rolling_friction=0.0, restitution=0.0,
        armature=None, self_collision=None, ground_normal=[0.0, 0.0, 1.0], solver_iterations=4, avian_substeps=8, threads=None,
        simd=None, dtype=None))]
    fn new(
        py: Python<'_>,
        robot: PathBuf,
        #[pyo3(from_py_with = whole)] num_envs: i128,
        dt: f64,
        ground: Option<&str>,
        gravity: [f64; 3],
        engine: String,
        fixed_base: bool,
        package_dirs: BTreeMap<String, PathBuf>,
        locked_joints: BTreeMap<String, f64>,
        friction: Option<Bound<'_, PyAny>>,
        torsional_friction: f64,
        rolling_friction: f64,
        restitution: f64,
        armature: Option<Bound<'_, PyAny>>,
        self_collision: Option<bool>,
        ground_normal: [f64; 3],
        #[pyo3(from_py_with = whole)] solver_iterations: i128,
        #[pyo3(from_py_with = whole)] avian_substeps: i128,
        #[pyo3(from_py_with = optional_whole)] threads: Option<i128>,
        simd: Option<&str>,
        dtype: Option<Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let friction = friction.map_or_else(|| Ok(1.0_f64.into_pyobject(py)?.into_any()), PyResult::Ok)?;
        let dtype = dtype.map_or_else(|| Ok("float32".into_pyobject(py)?.into_any()), PyResult::Ok)?;
        let num_envs = unsigned(py, "num_envs", num_envs)?;
        let given = options(robot, num_envs, ground, ground_normal, &friction, armature.as_ref(), &dtype, simd)?;
        let options = SimulationOptions {
            dt,
            gravity,
            engine,
            fixed_base,
            package_dirs,
            locked_joints,
            torsional_friction,
            rolling_friction,
            restitution,
            self_collision,
            solver_iterations: unsigned(py, "solver_iterations", solver_iterations)?,
            avian_substeps: unsigned(py, "avian_substeps", avian_substeps)?,
            threads: threads.map(|threads| unsigned(py, "threads", threads)).transpose()?,
            ..given
        };
        let sim = Guarded::new(py, || Inner::new(&options), to_python)?;
        if options.is_urdf_path() {
            for warning in summed_up(sim.warnings()) {
                let message = CString::new(warning.to_string().replace('\0', " "))?;
                PyErr::warn(py, &py.get_type::<PyUserWarning>(), &message, 1)?;
            }
        }
        Ok(Self { sim })
    }

    #[doc = docstring!("Simulation.joint_names")]
    #[getter]
    fn joint_names(&self) -> Vec<&str> {
        self.sim.joint_names()
    }
    #[doc = docstring!("Simulation.link_names")]
    #[getter]
    fn link_names(&self) -> Vec<&str> {
        self.sim.link_names()
    }
    #[doc = docstring!("Simulation.num_joints")]
    #[getter]
    fn num_joints(&self) -> usize {
        self.sim.num_joints()
    }
    #[doc = docstring!("Simulation.num_links")]
    #[getter]
    fn num_links(&self) -> usize {
        self.sim.num_links()
    }
    #[doc = docstring!("Simulation.num_envs")]
    #[getter]
    fn num_envs(&self) -> usize {
        self.sim.num_envs()
    }
    #[doc = docstring!("Simulation.nq")]
    #[getter]
    fn nq(&self) -> usize {
        self.sim.nq()
    }
    #[doc = docstring!("Simulation.nv")]
    #[getter]
    fn nv(&self) -> usize {
        self.sim.nv()
    }
    #[doc = docstring!("Simulation.total_mass")]
    #[getter]
    fn total_mass(&self) -> f64 {
        self.sim.total_mass()
    }
    #[doc = docstring!("Simulation.dt")]
    #[getter]
    fn dt(&self) -> f64 {
        self.sim.dt()
    }
    #[doc = docstring!("Simulation.time")]
    #[getter]
    fn time(&self) -> f64 {
        self.sim.time()
    }
    #[doc = docstring!("Simulation.threads")]
    #[getter]
    fn threads(&self) -> usize {
        self.sim.threads()
    }
    #[doc = docstring!("Simulation.warnings")]
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.sim.warnings().iter().map(ToString::to_string).collect()
    }
    #[doc = docstring!("Simulation.default_qpos")]
    #[getter]
    fn default_qpos<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.default_qpos().to_vec(), &[self.sim.nq()])
    }
    #[doc = docstring!("Simulation.joint_range")]
    #[getter]
    fn joint_range<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.joint_range().into_flattened())?, &[self.sim.num_joints(), 2])
    }
    #[doc = docstring!("Simulation.effort_limit")]
    #[getter]
    fn effort_limit<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.effort_limit())?, &[self.sim.num_joints()])
    }
    #[doc = docstring!("Simulation.qpos")]
    #[getter]
    fn qpos<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.qpos())?, &[self.sim.num_envs(), self.sim.nq()])
    }
    #[doc = docstring!("Simulation.qvel")]
    #[getter]
    fn qvel<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.qvel())?, &[self.sim.num_envs(), self.sim.nv()])
    }
    #[doc = docstring!("Simulation.contact_forces")]
    #[getter]
    fn contact_forces<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.contact_forces())?, &[self.sim.num_envs(), self.sim.num_links(), 3])
    }
    #[doc = docstring!("Simulation.link_drift")]
    #[getter]
    fn link_drift<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.link_drift())?, &[self.sim.num_envs()])
    }
    #[doc = docstring!("Simulation.joint_torque")]
    #[getter]
    fn joint_torque<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.joint_torque())?, &[self.sim.num_envs(), self.sim.num_joints()])
    }

    #[doc = docstring!("Simulation.set_state")]
    #[pyo3(signature = (qpos=None, qvel=None, env_ids=None))]
    fn set_state(
        &mut self,
        py: Python<'_>,
        qpos: Option<Bound<'_, PyAny>>,
        qvel: Option<Bound<'_, PyAny>>,
        env_ids: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let ids = env_indices(env_ids.as_ref())?;
        let n = self.count(ids.as_ref());
        let shapes = |width| [vec![width], vec![n, width]];
        let qpos = Self::optional("qpos", qpos.as_ref(), &shapes(self.sim.nq()))?;
        let qvel = Self::optional("qvel", qvel.as_ref(), &shapes(self.sim.nv()))?;
        self.sim
            .run(py, |sim| sim.set_state(ids.as_deref(), qpos.as_deref(), qvel.as_deref()))?
            .map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("Simulation.step")]
    #[pyo3(signature = (*, torque=None, targets=None, kp=None, kd=None, effort_limit=None, implicit=None, n=1))]
    fn step(
        &mut self,
        py: Python<'_>,
        torque: Option<Bound<'_, PyAny>>,
        targets: Option<Bound<'_, PyAny>>,
        kp: Option<Bound<'_, PyAny>>,
        kd: Option<Bound<'_, PyAny>>,
        effort_limit: Option<Bound<'_, PyAny>>,
        implicit: Option<bool>,
        #[pyo3(from_py_with = whole)] n: i128,
    ) -> PyResult<()> {
        let shapes = self.of_joints(self.sim.num_envs());
        let torque = Self::optional("torque", torque.as_ref(), &shapes)?;
        let targets = Self::optional("targets", targets.as_ref(), &shapes)?;
        let kp = Self::optional("kp", kp.as_ref(), &shapes)?;
        let kd = Self::optional("kd", kd.as_ref(), &shapes)?;
        let effort_limit = Self::optional("effort_limit", effort_limit.as_ref(), &shapes)?;
        let control = Control {
            torque: torque.as_deref(),
            targets: targets.as_deref(),
            kp: kp.as_deref(),
            kd: kd.as_deref(),
            effort_limit: effort_limit.as_deref(),
            implicit,
        };
        let n = unsigned(py, "n", n)?;
        self.sim.run(py, |sim| sim.step(&control, n))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("Simulation.link_pose")]
    fn link_pose<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let (n, links) = (self.sim.num_envs(), self.sim.num_links());
        let poses = self.sim.look(py, |sim| sim.link_pose())?;
        let position = array(py, poses.position, &[n, links, 3])?;
        Ok((position.into_any(), array(py, poses.quaternion, &[n, links, 4])?.into_any()))
    }

    #[doc = docstring!("Simulation.link_velocity")]
    fn link_velocity<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let shape = [self.sim.num_envs(), self.sim.num_links(), 3];
        let velocities = self.sim.look(py, |sim| sim.link_velocity())?;
        let linear = array(py, velocities.linear, &shape)?;
        Ok((linear.into_any(), array(py, velocities.angular, &shape)?.into_any()))
    }

    #[doc = docstring!("Simulation.mass_matrix")]
    fn mass_matrix<'py>(&self, py: Python<'py>) -> Array<'py> {
        let nv = self.sim.nv();
        array(py, self.sim.look(py, |sim| sim.mass_matrix())?, &[self.sim.num_envs(), nv, nv])
    }

    #[doc = docstring!("Simulation.bias_force")]
    fn bias_force<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.bias_force())?, &[self.sim.num_envs(), self.sim.nv()])
    }

    #[doc = docstring!("Simulation.forward_dynamics")]
    fn forward_dynamics<'py>(&self, py: Python<'py>, torque: Bound<'py, PyAny>) -> Array<'py> {
        let (n, nv, joints) = (self.sim.num_envs(), self.sim.nv(), self.sim.num_joints());
        let given = numbers("torque", &torque, &[vec![joints], vec![n, joints], vec![nv], vec![n, nv]])?;
        let width: usize = torque.py().import("numpy")?.call_method1("shape", (&torque,))?.get_item(-1)?.extract()?;
        // whole rows make the meaning of the values clear
        let mut force = Vec::with_capacity(n * nv);
        for env in 0..n {
            let at = if given.len() == width { 0 } else { env * width };
            force.extend(std::iter::repeat_n(0.0, nv - width).chain(given[at..at + width].iter().copied()));
        }
        let qacc = self.sim.look(py, |sim| sim.forward_dynamics(&force))?.map_err(|error| to_python(py, error))?;
        array(py, qacc, &[n, nv])
    }

    #[doc = docstring!("Simulation.inverse_dynamics")]
    fn inverse_dynamics<'py>(&self, py: Python<'py>, qacc: Bound<'py, PyAny>) -> Array<'py> {
        let (n, nv) = (self.sim.num_envs(), self.sim.nv());
        let qacc = numbers("qacc", &qacc, &[vec![nv], vec![n, nv]])?;
        let force = self.sim.look(py, |sim| sim.inverse_dynamics(&qacc))?.map_err(|error| to_python(py, error))?;
        array(py, force, &[n, nv])
    }

    #[doc = docstring!("Simulation.jacobian")]
    #[pyo3(signature = (link, point=[0.0, 0.0, 0.0]))]
    fn jacobian<'py>(&self, py: Python<'py>, link: Bound<'py, PyAny>, point: [f64; 3]) -> Array<'py> {
        let link = link_of(&link, self.sim.num_links())?;
        let rows = self.sim.look(py, |sim| sim.jacobian(link.id(), point))?.map_err(|error| to_python(py, error))?;
        array(py, rows, &[self.sim.num_envs(), 6, self.sim.nv()])
    }

    #[doc = docstring!("Simulation.ground_gap")]
    fn ground_gap<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.ground_gap())?, &[self.sim.num_envs(), self.sim.num_links()])
    }

    #[doc = docstring!("Simulation.energy")]
    fn energy<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let (kinetic, potential) = self.sim.look(py, |sim| sim.energy())?;
        let shape = [self.sim.num_envs()];
        Ok((array(py, kinetic, &shape)?.into_any(), array(py, potential, &shape)?.into_any()))
    }

    #[doc = docstring!("Simulation.center_of_mass")]
    fn center_of_mass<'py>(&self, py: Python<'py>) -> Array<'py> {
        array(py, self.sim.look(py, |sim| sim.center_of_mass())?, &[self.sim.num_envs(), 3])
    }

    #[doc = docstring!("Simulation.momentum")]
    fn momentum<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let (linear, angular) = self.sim.look(py, |sim| sim.momentum())?;
        let shape = [self.sim.num_envs(), 3];
        Ok((array(py, linear, &shape)?.into_any(), array(py, angular, &shape)?.into_any()))
    }

    #[doc = docstring!("Simulation.set_mass")]
    #[pyo3(signature = (link, mass, env_ids=None))]
    fn set_mass(
        &mut self,
        py: Python<'_>,
        link: Bound<'_, PyAny>,
        mass: Bound<'_, PyAny>,
        env_ids: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let ids = env_indices(env_ids.as_ref())?;
        let mass = numbers("mass", &mass, &[vec![], vec![self.count(ids.as_ref())]])?;
        let link = link_of(&link, self.sim.num_links())?;
        self.sim.run(py, |sim| sim.set_mass(ids.as_deref(), link.id(), &mass))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("Simulation.set_com")]
    #[pyo3(signature = (link, com, env_ids=None))]
    fn set_com(
        &mut self,
        py: Python<'_>,
        link: Bound<'_, PyAny>,
        com: Bound<'_, PyAny>,
        env_ids: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let ids = env_indices(env_ids.as_ref())?;
        let com = numbers("com", &com, &[vec![3], vec![self.count(ids.as_ref()), 3]])?;
        let link = link_of(&link, self.sim.num_links())?;
        self.sim.run(py, |sim| sim.set_com(ids.as_deref(), link.id(), &com))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("Simulation.set_inertia")]
    #[pyo3(signature = (link, inertia, env_ids=None))]
    fn set_inertia(
        &mut self,
        py: Python<'_>,
        link: Bound<'_, PyAny>,
        inertia: Bound<'_, PyAny>,
        env_ids: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let ids = env_indices(env_ids.as_ref())?;
        let n = self.count(ids.as_ref());
        let given = numbers("inertia", &inertia, &[vec![6], vec![n, 6], vec![3, 3], vec![n, 3, 3]])?;
        let last: usize = inertia.py().import("numpy")?.call_method1("shape", (&inertia,))?.get_item(-1)?.extract()?;
        let inertia = if last == 6 { given } else { from_matrices(&given)? };
        let link = link_of(&link, self.sim.num_links())?;
        self.sim
            .run(py, |sim| sim.set_inertia(ids.as_deref(), link.id(), &inertia))?
            .map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("Simulation.set_friction")]
    #[pyo3(signature = (r#static, dynamic=None, env_ids=None))]
    fn set_friction(
        &mut self,
        py: Python<'_>,
        r#static: Bound<'_, PyAny>,
        dynamic: Option<Bound<'_, PyAny>>,
        env_ids: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let ids = env_indices(env_ids.as_ref())?;
        let shapes = [vec![], vec![self.count(ids.as_ref())]];
        let sticking = numbers("static", &r#static, &shapes)?;
        let sliding = Self::optional("dynamic", dynamic.as_ref(), &shapes)?;
        self.sim
            .run(py, |sim| sim.set_friction(ids.as_deref(), &sticking, sliding.as_deref()))?
            .map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("Simulation.set_gains")]
    #[pyo3(signature = (kp=None, kd=None, env_ids=None))]
    fn set_gains(
        &mut self,
        py: Python<'_>,
        kp: Option<Bound<'_, PyAny>>,
        kd: Option<Bound<'_, PyAny>>,
        env_ids: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let ids = env_indices(env_ids.as_ref())?;
        let shapes = self.of_joints(self.count(ids.as_ref()));
        let kp = Self::optional("kp", kp.as_ref(), &shapes)?;
        let kd = Self::optional("kd", kd.as_ref(), &shapes)?;
        self.sim
            .run(py, |sim| sim.set_gains(ids.as_deref(), kp.as_deref(), kd.as_deref()))?
            .map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("Simulation.set_armature")]
    #[pyo3(signature = (armature, env_ids=None))]
    fn set_armature(
        &mut self,
        py: Python<'_>,
        armature: Bound<'_, PyAny>,
        env_ids: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let ids = env_indices(env_ids.as_ref())?;
        let armature = numbers("armature", &armature, &self.of_joints(self.count(ids.as_ref())))?;
        self.sim.run(py, |sim| sim.set_armature(ids.as_deref(), &armature))?.map_err(|error| to_python(py, error))
    }

    #[doc = docstring!("Simulation.snapshot")]
    fn snapshot<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self.sim.run(py, |sim| sim.snapshot())?.map_err(|error| to_python(py, error))?;
        Ok(PyBytes::new(py, &bytes))
    }

    #[doc = docstring!("Simulation.restore")]
    fn restore(&mut self, py: Python<'_>, data: &[u8]) -> PyResult<()> {
        self.sim.run(py, |sim| sim.restore(data))?.map_err(|error| to_python(py, error))
    }
}

/// xx, yy, zz, xy, xz, yz of symmetric matrices.
fn from_matrices(values: &[f64]) -> PyResult<Vec<f64>> {
    let mut out = Vec::new();
    for m in values.chunks_exact(9) {
        let largest = m.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        let asymmetry = [m[1] - m[3], m[2] - m[6], m[5] - m[7]].map(f64::abs);
        if asymmetry.iter().any(|&x| x > 1e-9 * largest) {
            return Err(value_error(format!("inertia: {m:?} is not symmetric; pass xx, yy, zz, xy, xz, yz")));
        }
        out.extend([m[0], m[4], m[8], m[1], m[2], m[5]]);
    }
    Ok(out)
}
