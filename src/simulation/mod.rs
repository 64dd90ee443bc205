//! Physics without a task: any tree of links that a URDF describes, in many envs at once.
//!
//! Arrays are row-major slices of `f64`, one row per env. Generalised positions `qpos` are the
//! base's position in the world (3, m), its orientation (w, x, y, z) and the joints' positions (rad
//! or m) in the order of [`joint_names`](Simulation::joint_names); velocities `qvel` are the linear
//! velocity of the base's origin in world axes (3, m/s), its angular velocity in base axes (3,
//! rad/s) and the joints'. A fixed base has joints only.
//!
//! ```
//! use polypod::{Control, Simulation, SimulationOptions};
//!
//! let mut sim = Simulation::new(&SimulationOptions::new("tests/data/urdf/biped.urdf", 16))?;
//! let stand = Control { targets: Some(&[0.0]), kp: Some(&[400.0]), kd: Some(&[10.0]), ..Control::default() };
//! sim.step(&stand, 200)?;
//! assert!((sim.qpos()[2] - sim.default_qpos()[2]).abs() < 0.02);
//! # Ok::<(), polypod::Error>(())
//! ```

mod envs;
mod options;
mod parameters;
mod queries;
mod robot;
mod rows;
mod snapshot;

pub use options::{Precision, SimulationOptions};
pub use parameters::LinkId;
pub(crate) use parameters::named_link;
pub use queries::{LinkPoses, LinkVelocities};

use crate::blocks::BlockList;
use crate::bounds::{BYTES_PER_LINK, MAX_STEPS, check_num_envs};
use crate::dynamics::lanes::Simd;
use crate::dynamics::{ContactSettings, Parameters, Plane, StepSettings};
use crate::engine::avian::EngineError;
use crate::engine::{self, EngineChoice, RowEngine, Run, StateLimits};
use crate::error::Error;
use crate::robot::Warning;
use crate::workers::{Workers, packs_of};
use envs::{Actuation, Env, EnvRows, Envs};
use robot::Robot;
use rows::{EnvIds, Rows};

/// Physics steps that the articulated engine makes in one go; its reports grow with it.
const MAX_RUN: usize = 32;

/// Inputs of the actuators during a [`Simulation::step`]. Rows are one number, `[joints]` or
/// `[num_envs, joints]`.
#[derive(Clone, Copy, Debug, Default)]
pub struct Control<'a> {
    /// Joint efforts, N m or N, within the effort limit; excludes `targets`. With neither the
    /// joints are passive.
    pub torque: Option<&'a [f64]>,
    /// Joint positions that the gains pull to, rad or m.
    pub targets: Option<&'a [f64]>,
    /// Stiffness, N m/rad; kept for later steps.
    pub kp: Option<&'a [f64]>,
    /// Damping, N m s/rad; kept for later steps.
    pub kd: Option<&'a [f64]>,
    /// Largest effort, N m or N; kept for later steps. Infinity: no limit.
    pub effort_limit: Option<&'a [f64]>,
    /// Whether the gains act on the end of each physics step, stable with any gains, or on its
    /// beginning. Default: what the robot's config says, which is the end unless it is `explicit`.
    pub implicit: Option<bool>,
}

/// Robots of one morphology and their physics.
pub struct Simulation {
    robot: Robot,
    /// Joints whose config asks for explicit gains.
    explicit: Vec<bool>,
    /// Largest entry of each joint's effort table, 1 without one.
    effort_scale: Vec<f64>,
    settings: StepSettings,
    engine: Box<dyn RowEngine<Envs>>,
    /// Parameters of each env's robot, as precise as the engine computes.
    bodies: Vec<Parameters<f64>>,
    workers: Workers,
    simd: Simd,
    precision: Precision,
    /// Whether numbers are rounded to single precision.
    rounds: bool,
    default_qpos: Vec<f64>,
    steps: u64,
    /// Hash of all that decides the result of a step, except the state and the envs' parameters.
    fingerprint: u64,
}

impl Simulation {
    /// Loads the robot and puts one into each env, at rest in the default pose.
    ///
    /// # Errors
    /// Any fault of the options, the robot's config or its URDF.
    pub fn new(options: &SimulationOptions) -> Result<Self, Error> {
        options.validate()?;
        let simd = Simd::choose(options.simd)?;
        let robot = Robot::new(options)?;
        let normal = options.ground.map(|n| {
            let length = n.iter().map(|x| x * x).sum::<f64>().sqrt();
            n.map(|x| x / length)
        });
        let avian = options.is_avian();
        let settings = StepSettings {
            dt: options.dt,
            decimation: if avian { 1 } else { MAX_RUN },
            gravity: options.gravity,
            contact: ContactSettings {
                iterations: options.solver_iterations,
                ground: normal.map(|normal| Plane { normal, offset: 0.0 }),
                ..ContactSettings::default()
            },
        };
        let mut default_qpos = Vec::new();
        if robot.topology.floating {
            // the lowest point touches the ground
            let height = |n: [f64; 3]| -robot.lowest_point(&n);
            default_qpos.extend(normal.map_or([0.0; 3], |n| n.map(|x| x * height(n))));
            default_qpos.extend([1.0, 0.0, 0.0, 0.0]);
        }
        default_qpos.extend(&robot.default_position);
        let bytes = BYTES_PER_LINK * robot.topology.num_links();
        check_num_envs(options.num_envs, bytes)
            .map_err(|(problem, remedy)| Error::argument("num_envs", problem, remedy))?;
        let pieces = match (avian, options.precision) {
            (false, Precision::Single) => packs_of(options.num_envs),
            _ => options.num_envs,
        };
        let workers = Workers::for_pieces(options.threads, pieces, simd);
        let choice = match (avian, options.precision) {
            (true, _) => EngineChoice::Avian(options.avian_substeps, Vec::new()),
            (false, Precision::Single) => EngineChoice::Articulated(simd, None),
            (false, Precision::Double) => EngineChoice::ArticulatedDouble,
        };
        let (topology, n) = (&robot.topology, options.num_envs);
        let rounds = !avian && options.precision == Precision::Single;
        let nominal = if rounds {
            Parameters::from_scalars(topology, &Parameters::<f32>::from_scalars(topology, &robot.nominal))
        } else {
            robot.nominal.clone()
        };
        let engine = engine::make(choice, settings, &[robot.setup(&nominal, n)], &workers).map_err(|error| {
            let element = match error {
                EngineError::Step(_) => "dt",
                EngineError::Prismatic(_) | EngineError::Order => "engine",
            };
            Error::argument(element, error.to_string(), "use \"articulated\", or another step or robot")
        })?;
        let mut sim = Self {
            explicit: topology.joints.iter().map(|joint| joint.explicit).collect(),
            effort_scale: topology
                .joints
                .iter()
                .map(|joint| joint.effort_table.as_ref())
                .map(|table| table.map_or(1.0, |t| t.limits.iter().fold(0.0, |most, &x| f64::from(x).max(most))))
                .collect(),
            fingerprint: snapshot::fingerprint(&robot, &settings, avian.then_some(options.avian_substeps)),
            settings,
            engine,
            bodies: vec![nominal; n],
            workers,
            simd,
            precision: options.precision,
            rounds,
            default_qpos,
            steps: 0,
            robot,
        };
        let start = sim.default_qpos.clone();
        sim.set_state(None, Some(&start), None)?;
        Ok(sim)
    }

    /// Number of envs.
    pub fn num_envs(&self) -> usize {
        self.bodies.len()
    }

    /// Number of joints that move.
    pub fn num_joints(&self) -> usize {
        self.robot.topology.num_joints()
    }

    /// Number of links that move, the base included.
    pub fn num_links(&self) -> usize {
        self.robot.topology.num_links()
    }

    /// Length of `qpos`.
    pub fn nq(&self) -> usize {
        self.num_joints() + if self.is_floating() { 7 } else { 0 }
    }

    /// Length of `qvel`.
    pub fn nv(&self) -> usize {
        self.num_joints() + if self.is_floating() { 6 } else { 0 }
    }

    /// Whether the base moves.
    pub fn is_floating(&self) -> bool {
        self.robot.topology.floating
    }

    /// Names of the joints that move, as in the URDF, parents before children.
    pub fn joint_names(&self) -> Vec<&str> {
        self.robot.model.joints.iter().map(|joint| joint.name.as_str()).collect()
    }

    /// Names of the links, as in the URDF: the base, then what each joint moves. Links fixed to
    /// another are part of it.
    pub fn link_names(&self) -> Vec<&str> {
        self.robot.model.links.iter().map(|link| link.name.as_str()).collect()
    }

    /// Mass of a robot before any change to it, kg.
    pub fn total_mass(&self) -> f64 {
        self.robot.model.total_mass()
    }

    /// Physics step, s.
    pub fn dt(&self) -> f64 {
        self.settings.dt
    }

    /// Time simulated since the beginning, s.
    pub fn time(&self) -> f64 {
        self.steps as f64 * self.settings.dt
    }

    /// Initial pose, `[nq]`: the default pose of a library robot, zero (or the nearest limit) for a
    /// URDF. The base is level, and its lowest collision shape touches the ground; without ground
    /// it is at the world's origin.
    pub fn default_qpos(&self) -> &[f64] {
        &self.default_qpos
    }

    /// Lower and upper position limit of each joint, rad or m; infinite where there is none.
    pub fn joint_range(&self) -> Vec<[f64; 2]> {
        self.robot.model.joints.iter().map(|joint| [joint.lower, joint.upper]).collect()
    }

    /// Initial effort limit of each joint, N m or N; infinite where there is no limit, the largest
    /// one where it depends on the position.
    pub fn effort_limit(&self) -> Vec<f64> {
        let limits = self.robot.nominal.effort_limit.iter().zip(&self.effort_scale);
        limits.map(|(&limit, scale)| limit * scale).collect()
    }

    /// Assumptions made while reading the URDF.
    pub fn warnings(&self) -> &[Warning] {
        &self.robot.model.warnings
    }

    /// Threads at work.
    pub fn threads(&self) -> usize {
        self.workers.threads()
    }

    /// The instruction set of single precision.
    pub fn simd(&self) -> Simd {
        self.simd
    }

    /// Generalised positions, `[num_envs, nq]`.
    pub fn qpos(&self) -> Vec<f64> {
        self.collect(self.nq(), |env| &env.qpos)
    }

    /// Generalised velocities, `[num_envs, nv]`.
    pub fn qvel(&self) -> Vec<f64> {
        self.collect(self.nv(), |env| &env.qvel)
    }

    /// A list of numbers of all envs, `[num_envs, width]`.
    fn collect(&self, width: usize, list: impl Fn(&Env) -> &[f64]) -> Vec<f64> {
        let mut out = Vec::with_capacity(self.num_envs() * width);
        let mut env = self.robot.env();
        for index in 0..self.num_envs() {
            self.engine.fetch(index, EnvRows::of(&mut env));
            out.extend(list(&env));
        }
        out
    }

    /// A number as the engine keeps it.
    fn rounding(&self) -> impl Fn(f64) -> f64 + Copy + use<> {
        let rounds = self.rounds;
        move |x| if rounds { f64::from(x as f32) } else { x }
    }

    /// Sets positions (`[n, nq]`), velocities (`[n, nv]`) or both in the `n` envs `env_ids`, or in
    /// all; one row serves for all of them. Quaternions are normalised. Contacts and networks of
    /// actuators lose their memory there.
    ///
    /// # Errors
    /// Another number of values, one that is not finite, a quaternion of length zero, or an env
    /// that does not exist.
    pub fn set_state(
        &mut self,
        env_ids: Option<&[usize]>,
        qpos: Option<&[f64]>,
        qvel: Option<&[f64]>,
    ) -> Result<(), Error> {
        let envs = EnvIds::new(env_ids, self.num_envs())?;
        let (nq, nv) = (self.nq(), self.nv());
        let qpos = qpos.map(|values| Rows::vectors("qpos", values, nq, envs.len())).transpose()?;
        let qvel = qvel.map(|values| Rows::vectors("qvel", values, nv, envs.len())).transpose()?;
        let mut rotations = Vec::new();
        if let Some(rows) = qpos.filter(|_| self.is_floating()) {
            for row in 0..envs.len() {
                let given = std::array::from_fn(|k| rows.get(row, 3 + k));
                let unit = self.unit_quaternion(given).ok_or_else(|| {
                    Error::argument(
                        "qpos",
                        format!("the quaternion of row {row} is {given:?}"),
                        "pass (w, x, y, z), not zero",
                    )
                })?;
                rotations.push(unit);
            }
        }
        let mut env = self.robot.env();
        for row in 0..envs.len() {
            self.engine.fetch(envs.get(row), EnvRows::of(&mut env));
            env.forget();
            if let Some(qpos) = qpos {
                env.qpos.iter_mut().enumerate().for_each(|(k, q)| *q = qpos.get(row, k));
                if let Some(rotation) = rotations.get(row) {
                    env.qpos[3..7].copy_from_slice(rotation);
                }
            }
            if let Some(qvel) = qvel {
                env.qvel.iter_mut().enumerate().for_each(|(k, v)| *v = qvel.get(row, k));
            }
            self.engine.restart(envs.get(row), EnvRows::of(&mut env));
        }
        Ok(())
    }

    /// A quaternion, normalised unless it already is within the precision: a quaternion that was
    /// read is written back unchanged.
    fn unit_quaternion(&self, q: [f64; 4]) -> Option<[f64; 4]> {
        let exact = match self.precision {
            Precision::Single => 1e-6,
            Precision::Double => 1e-14,
        };
        let largest = q.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        if largest == 0.0 {
            return None;
        }
        let length = largest * q.iter().map(|x| (x / largest).powi(2)).sum::<f64>().sqrt();
        Some(if (length - 1.0).abs() < exact { q } else { q.map(|x| x / length) })
    }

    /// `n` physics steps of all envs.
    ///
    /// # Errors
    /// `n` zero, both efforts and targets, another number of values, or one that is not finite.
    pub fn step(&mut self, control: &Control, n: usize) -> Result<(), Error> {
        if n == 0 {
            return Err(Error::argument("n", "0 steps", "pass at least 1"));
        }
        if n > MAX_STEPS {
            return Err(Error::argument("n", format!("{n} steps"), format!("pass at most {MAX_STEPS}")));
        }
        let (values, element) = match (control.torque, control.targets) {
            (Some(_), Some(_)) => {
                return Err(Error::argument("torque", "given together with targets", "pass one of them"));
            }
            (Some(torque), None) => (torque, "torque"),
            (None, Some(targets)) => (targets, "targets"),
            (None, None) => (&[0.0][..], "torque"),
        };
        let asked = Rows::of_joints(element, values, self.num_joints(), self.num_envs())?;
        self.set_gains(None, control.kp, control.kd)?;
        if let Some(limit) = control.effort_limit {
            self.set_effort_limit(None, limit)?;
        }
        let gains = control.targets.is_some();
        let actuation = if gains { Actuation::Targets(asked) } else { Actuation::Effort(asked) };
        let explicit: Vec<bool> =
            self.explicit.iter().map(|&explicit| control.implicit.map_or(explicit, |implicit| !implicit)).collect();
        self.engine.set_explicit(0, &explicit);
        let run = Run { steps: n, gains, limits: &StateLimits::default(), watched: &[false] };
        let envs = 0..self.num_envs();
        self.engine.step(&self.workers, BlockList::of_one(envs, EnvRows::asking(actuation)), run);
        self.steps += n as u64;
        Ok(())
    }

    /// Net force on each link in the last physics step, N, world axes, `[num_envs, links, 3]`, from
    /// all its contacts.
    pub fn contact_forces(&self) -> Vec<f64> {
        let links = self.num_links();
        let mut out = vec![[0.0; 3]; self.num_envs() * links];
        let mut env = self.robot.env();
        for (index, out) in out.chunks_exact_mut(links).enumerate() {
            self.engine.fetch(index, EnvRows::of(&mut env));
            for (body, force) in self.robot.model.bodies.iter().zip(&env.force) {
                out[body.link].iter_mut().zip(force).for_each(|(sum, f)| *sum += f);
            }
        }
        out.into_flattened()
    }

    /// Largest distance of a link's origin from forward kinematics of base pose and joint
    /// positions, m, `[num_envs]`. Only the engine `avian` lets joints come apart.
    pub fn link_drift(&self) -> Vec<f64> {
        (0..self.num_envs()).map(|env| self.engine.link_drift(env)).collect()
    }

    /// Effort of each actuator in the last physics step, N m or N, `[num_envs, joints]`.
    pub fn joint_torque(&self) -> Vec<f64> {
        self.collect(self.num_joints(), |env| &env.effort)
    }
}
