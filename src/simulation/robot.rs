//! Robots of a simulation, from a name or a path.

use std::path::Path;

use glam::DMat3;

use super::envs::Env;
use super::options::{SimulationOptions, check_non_negative};
use super::rows::Rows;
use crate::config::Library;
use crate::dynamics::{ActuatorNetwork, ContactFriction, MAX_DEPTH, Parameters, Topology};
use crate::engine::MorphologySetup;
use crate::error::Error;
use crate::morphology::{ConfiguredRobot, lowest_point};
use crate::robot::{self, Articulation, Coupled, LoadOptions, Model};

/// Options of the reader of URDFs.
fn load_options(options: &SimulationOptions) -> LoadOptions {
    LoadOptions {
        package_dirs: options.package_dirs.clone(),
        locked_joints: options.locked_joints.clone(),
        coupled: Coupled::Held,
        keeps_root: options.fixed_base,
    }
}

/// One robot's model, in double precision.
pub(super) struct Robot {
    pub(super) model: Model,
    pub(super) topology: Topology,
    /// Initial parameters of every env.
    pub(super) nominal: Parameters<f64>,
    /// Turns a link's URDF axes into those of the engine, `[links]`.
    pub(super) align: Vec<DMat3>,
    /// Collision shapes that may touch each other, counted body after body.
    pub(super) shape_pairs: Vec<[usize; 2]>,
    /// Initial joint positions, rad or m.
    pub(super) default_position: Vec<f64>,
    /// Networks that drive joints.
    pub(super) networks: Vec<ActuatorNetwork>,
}

impl Robot {
    pub(super) fn new(options: &SimulationOptions) -> Result<Self, Error> {
        let mut robot = if options.is_urdf_path() { Self::of_urdf(options)? } else { Self::of_library(options)? };
        let depth = robot.topology.max_depth();
        if depth > MAX_DEPTH {
            let problem = format!("{}: a chain of {depth} moving joints", robot.model.source.display());
            return Err(Error::argument(
                "robot",
                problem,
                format!("fix joints until no chain has more than {MAX_DEPTH}"),
            ));
        }
        let joints = robot.topology.num_joints();
        if let Some(armature) = &options.armature {
            check_non_negative("armature", armature)?;
            let rows = Rows::of_joints("armature", armature, joints, 1)?;
            robot.nominal.armature = (0..joints).map(|j| rows.get(0, j)).collect();
        }
        [robot.nominal.static_friction, robot.nominal.dynamic_friction] = options.friction;
        robot.nominal.torsional_friction = options.torsional_friction;
        robot.nominal.rolling_friction = options.rolling_friction;
        if options.is_avian() && robot.topology.friction != ContactFriction::Sliding {
            let problem = "its [surfaces] have torsional_friction or rolling_friction, which the engine avian has not";
            return Err(Error::argument("robot", problem, "use engine \"articulated\", or leave these two keys out"));
        }
        let friction = ContactFriction::of(options.torsional_friction, options.rolling_friction);
        robot.topology.friction = friction.max(robot.topology.friction);
        robot.nominal.restitution = options.restitution;
        Ok(robot)
    }

    fn of_urdf(options: &SimulationOptions) -> Result<Self, Error> {
        let load = load_options(options);
        let model = robot::load(Path::new(&options.robot), &load)?;
        let position: Vec<f64> = model.joints.iter().map(|joint| 0.0_f64.max(joint.lower).min(joint.upper)).collect();
        let reference = options.self_collision.unwrap_or(false).then_some(&position[..]);
        let articulation = Articulation::new(&model, !options.fixed_base, &[], reference);
        Ok(Self::assemble(model, articulation, position, Vec::new()))
    }

    fn of_library(options: &SimulationOptions) -> Result<Self, Error> {
        let loaded = Library::new(Vec::new()).robot(&options.robot)?;
        let robot = ConfiguredRobot::new(
            &loaded,
            &LoadOptions { keeps_root: false, coupled: Coupled::Refused, ..load_options(options) },
            !options.fixed_base,
            options.self_collision,
        )?;
        Ok(Self::assemble(robot.model, robot.articulation, robot.default_position, robot.networks))
    }

    fn assemble(
        model: Model,
        articulation: Articulation,
        default_position: Vec<f64>,
        networks: Vec<ActuatorNetwork>,
    ) -> Self {
        let Articulation { topology, parameters: nominal, align, shape_pairs } = articulation;
        Self { model, topology, nominal, align, shape_pairs, default_position, networks }
    }

    /// The engine's view of it; `nominal` are the parameters of `count` robots.
    pub(super) fn setup<'a>(&'a self, nominal: &'a Parameters<f64>, count: usize) -> MorphologySetup<'a, f64> {
        let Self { model, topology, align, shape_pairs, networks, .. } = self;
        let (body_groups, feet): (&[_], &[_]) = (&[], &[]);
        MorphologySetup {
            model,
            topology,
            align,
            shape_pairs,
            nominal,
            body_groups,
            feet,
            networks,
            max_delay: 0,
            count,
        }
    }

    /// An env to be read into, all numbers zero.
    pub(super) fn env(&self) -> Env {
        Env::zeros(&self.topology, ActuatorNetwork::num_remembered_by(&self.networks))
    }

    /// Height of the lowest contact candidate above a plane through the base's origin, in the
    /// default pose with the base level, m; 0 without candidates.
    pub(super) fn lowest_point(&self, normal: &[f64; 3]) -> f64 {
        lowest_point(&self.topology, &self.nominal, &self.default_position, normal)
    }
}
