//! Options of a [`Simulation`](super::Simulation), and the errors of bad ones.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::bounds::{LARGEST, MAX_DT, MAX_ENVS, MAX_GRAVITY, MAX_SUBSTEPS, MAX_SWEEPS, MIN_DT, check_threads};
use crate::config::{AVIAN_SUBSTEPS, EARTH_GRAVITY};
use crate::dynamics::SWEEPS;
use crate::dynamics::lanes::Simd;
use crate::error::Error;

/// Precision in which a simulation computes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// Single precision, many envs side by side in SIMD lanes.
    #[default]
    Single,
    /// Double precision, one env at a time: slower, for reference.
    Double,
}

/// Options of a simulation. [`SimulationOptions::new`] has the defaults.
#[derive(Clone, Debug)]
pub struct SimulationOptions {
    /// Name of a robot of the library, path of a robot's `.toml`, or path of a URDF (it ends in
    /// `.urdf` or exists).
    pub robot: String,
    /// Number of envs, one robot each. Default: 1.
    pub num_envs: usize,
    /// Physics step, s, at least 1e-6. Default: 0.005.
    pub dt: f64,
    /// Normal of the ground plane through the world's origin, of any length; `None`: no ground.
    /// Default: (0, 0, 1).
    pub ground: Option<[f64; 3]>,
    /// Gravity in world axes, m/s^2. Default: (0, 0, -9.81).
    pub gravity: [f64; 3],
    /// The physics engine. `articulated`, the default, moves joints and has no other degrees of
    /// freedom. `avian` has Avian's rigid bodies with polypod's joints between them: single
    /// precision, revolute joints, no shapes on a base that is fixed, and one friction coefficient,
    /// the dynamic one.
    pub engine: String,
    /// Fix the base to the world, at its origin. Default: no.
    pub fixed_base: bool,
    /// Folder of each package in `package://<package>/...` mesh names.
    pub package_dirs: BTreeMap<String, PathBuf>,
    /// Joints to hold at a position (rad or m): they become part of their parent link. Joints of a
    /// URDF that mimic others are held in any case, with a warning. Default: those of the robot's
    /// config.
    pub locked_joints: BTreeMap<String, f64>,
    /// Static and dynamic friction coefficient, robot and ground combined. Default: 1.
    pub friction: [f64; 2],
    /// Coefficient of torsional friction, robot and ground combined, m: torque about a contact's
    /// normal per normal force. Default: 0.
    pub torsional_friction: f64,
    /// Coefficient of rolling friction, robot and ground combined, m: torque across a contact's
    /// normal per normal force. Default: 0.
    pub rolling_friction: f64,
    /// Restitution coefficient, robot and ground combined. Default: 0.
    pub restitution: f64,
    /// Reflected rotor inertia, kg m^2: one number or `[joints]`. Default: the robot's, 0 for a
    /// URDF.
    pub armature: Option<Vec<f64>>,
    /// Whether links of a robot collide with one another, but for those joined by a joint or
    /// touching in the default pose. Default: what the robot's config says; no for a URDF.
    pub self_collision: Option<bool>,
    /// Sweeps of the articulated engine's contact solver per physics step. Default: 4.
    pub solver_iterations: usize,
    /// Substeps per physics step of the engine `avian`. Default: 8.
    pub avian_substeps: usize,
    /// Threads. Default: all cores. Only as many are made as there are packs of envs.
    pub threads: Option<usize>,
    /// Instruction set in single precision. Default: the fastest one, or what `POLYPOD_SIMD` says.
    pub simd: Option<Simd>,
    /// Default: single.
    pub precision: Precision,
}

impl SimulationOptions {
    /// The defaults for a robot.
    pub fn new(robot: impl Into<String>, num_envs: usize) -> Self {
        Self {
            robot: robot.into(),
            num_envs,
            dt: 0.005,
            ground: Some([0.0, 0.0, 1.0]),
            gravity: [0.0, 0.0, -EARTH_GRAVITY],
            engine: "articulated".into(),
            fixed_base: false,
            package_dirs: BTreeMap::new(),
            locked_joints: BTreeMap::new(),
            friction: [1.0, 1.0],
            torsional_friction: 0.0,
            rolling_friction: 0.0,
            restitution: 0.0,
            armature: None,
            self_collision: None,
            solver_iterations: SWEEPS,
            avian_substeps: AVIAN_SUBSTEPS,
            threads: None,
            simd: None,
            precision: Precision::Single,
        }
    }

    /// Whether `robot` is the path of a URDF rather than a robot of the library.
    pub fn is_urdf_path(&self) -> bool {
        let path = Path::new(&self.robot);
        let has_extension = |wanted: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(wanted));
        has_extension("urdf") || (path.is_file() && !has_extension("toml"))
    }

    /// Whether the engine is Avian's.
    pub(super) fn is_avian(&self) -> bool {
        self.engine == "avian"
    }

    /// Checks what does not depend on the robot.
    ///
    /// # Errors
    /// Names the first option that is out of its range.
    pub fn validate(&self) -> Result<(), Error> {
        match self.engine.as_str() {
            "articulated" => {}
            "avian" if self.precision == Precision::Double => {
                let remedy = "use single precision, or the engine \"articulated\"";
                return Err(Error::argument("precision", "the engine avian has single precision only", remedy));
            }
            "avian" => {}
            other => {
                let remedy = "use \"articulated\" or \"avian\"";
                return Err(Error::argument("engine", format!("there is no engine `{other}`"), remedy));
            }
        }
        if self.num_envs == 0 {
            return Err(Error::argument("num_envs", "0 envs", "pass at least 1"));
        }
        if self.num_envs > MAX_ENVS {
            return Err(Error::argument(
                "num_envs",
                format!("{} envs", self.num_envs),
                format!("pass at most {MAX_ENVS}"),
            ));
        }
        check_threads(self.threads).map_err(|(problem, remedy)| Error::argument("threads", problem, remedy))?;
        check_count("solver_iterations", self.solver_iterations, MAX_SWEEPS, "sweeps")?;
        check_count("avian_substeps", self.avian_substeps, MAX_SUBSTEPS, "substeps")?;
        if !(MIN_DT..=MAX_DT).contains(&self.dt) {
            let remedy = format!("pass a positive number of seconds, at least {MIN_DT:e} and at most {MAX_DT}");
            return Err(Error::argument("dt", format!("a step of {:e} s", self.dt), remedy));
        }
        if self.gravity.iter().any(|g| !(-MAX_GRAVITY..=MAX_GRAVITY).contains(g)) {
            return Err(Error::argument(
                "gravity",
                format!("{:?}", self.gravity),
                format!("pass three finite numbers from -{MAX_GRAVITY} to {MAX_GRAVITY} m/s^2"),
            ));
        }
        if let Some(normal) = self.ground
            // its length must be a number
            && !normal.iter().map(|x| x * x).sum::<f64>().is_normal()
        {
            let remedy = "pass three finite numbers, not all zero; a length of 1 is usual";
            return Err(Error::argument("ground_normal", format!("{normal:?}"), remedy));
        }
        check_non_negative("friction", &self.friction)?;
        for (element, coefficient) in
            [("torsional_friction", self.torsional_friction), ("rolling_friction", self.rolling_friction)]
        {
            check_non_negative(element, &[coefficient])?;
            if coefficient > 0.0 && self.is_avian() {
                let remedy = "pass 0, or use the engine \"articulated\"";
                return Err(Error::argument(element, "the engine avian has no such friction", remedy));
            }
        }
        if !(0.0..=1.0).contains(&self.restitution) {
            return Err(Error::argument("restitution", format!("{}", self.restitution), "pass a number from 0 to 1"));
        }
        Ok(())
    }
}

fn check_count(element: &'static str, count: usize, most: u32, what: &str) -> Result<(), Error> {
    if (1..=most as usize).contains(&count) {
        return Ok(());
    }
    Err(Error::argument(element, format!("{count} {what}"), format!("pass a number from 1 to {most}")))
}

pub(super) fn check_non_negative(element: &'static str, values: &[f64]) -> Result<(), Error> {
    match values.iter().find(|x| !(0.0..=LARGEST).contains(*x)) {
        Some(bad) => {
            let remedy = format!("pass finite numbers of at least 0 and at most {LARGEST:e}");
            Err(Error::argument(element, format!("{bad} among the values"), remedy))
        }
        None => Ok(()),
    }
}

/// Checks limits, which may be infinite: infinity is no limit.
pub(super) fn check_not_below_zero(element: &'static str, values: &[f64]) -> Result<(), Error> {
    match values.iter().find(|x| x.is_nan() || **x < 0.0) {
        Some(bad) => {
            let remedy = "pass numbers of at least 0; infinity is no limit";
            Err(Error::argument(element, format!("{bad} among the values"), remedy))
        }
        None => Ok(()),
    }
}
