//! Articulated bodies in motion for the tests of the dynamics: random trees (proptest strategies)
//! and the built-in robots.
#![allow(dead_code, reason = "every test is a crate of its own and uses a part of this")]

use std::ops::RangeInclusive;
use std::path::PathBuf;

use glam::{DMat3, DQuat, DVec3};
use polypod::config::Library;
use polypod::dynamics::lanes::Real;
use polypod::dynamics::{Dynamics, Parameters, State, Topology, Workspace};
use polypod::robot::{self, Articulation, Joint, JointKind, Link, Model, Pose};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

/// All built-in robots.
pub const ROBOTS: [&str; 8] =
    ["anymal_d", "anymal_c", "anymal_b", "unitree_a1", "unitree_go1", "unitree_go2", "unitree_b2", "spot"];

/// The same cases in every run.
pub fn fixed_cases(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, rng_seed: RngSeed::Fixed(1), failure_persistence: None, ..ProptestConfig::default() }
}

/// A body, how it moves, and a generalised force and acceleration to try on it.
#[derive(Clone, Debug)]
pub struct Case {
    pub model: Model,
    pub articulation: Articulation,
    pub state: State<f64>,
    pub force: Vec<f64>,
    pub qacc: Vec<f64>,
}

impl Case {
    pub fn new(model: Model, floating: bool, base: &BaseMotion, joints: &[JointMotion]) -> Self {
        let articulation = Articulation::new(&model, floating, &[], None);
        let mut state = State::zeros(&articulation.topology);
        state.position = base.position;
        let q = unit_quaternion(base.rotation);
        state.rotation = [q.w, q.x, q.y, q.z];
        if floating {
            state.linear_velocity = base.linear_velocity;
            state.angular_velocity = base.angular_velocity;
        }
        let (mut force, mut qacc) = (Vec::new(), Vec::new());
        if floating {
            force.extend(base.force);
            qacc.extend(base.qacc);
        }
        for (j, motion) in joints.iter().enumerate() {
            state.joint_position[j] = motion.position;
            state.joint_velocity[j] = motion.velocity;
            force.push(motion.force);
            qacc.push(motion.qacc);
        }
        Self { model, articulation, state, force, qacc }
    }

    pub fn topology(&self) -> &Topology {
        &self.articulation.topology
    }

    /// Generalised velocity in the order of `qvel`.
    pub fn qvel(&self) -> Vec<f64> {
        let base = self.state.linear_velocity.iter().chain(&self.state.angular_velocity);
        let base = base.take(if self.topology().floating { 6 } else { 0 });
        base.chain(&self.state.joint_velocity).copied().collect()
    }

    pub fn state_as<S: Real>(&self) -> State<S> {
        state_as(self.topology(), &self.state)
    }

    pub fn parameters_as<S: Real>(&self) -> Parameters<S> {
        Parameters::from_scalars(self.topology(), &self.articulation.parameters)
    }
}

/// Asks something of a body's dynamics.
pub fn ask<S: Real, T>(
    topology: &Topology,
    parameters: &Parameters<S>,
    state: &State<S>,
    gravity: [f64; 3],
    question: impl FnOnce(&mut Dynamics<'_, S>) -> T,
) -> T {
    let mut work = Workspace::new(topology);
    question(&mut Dynamics { topology, parameters, state, gravity, work: &mut work })
}

/// A state in another precision.
pub fn state_as<S: Real>(topology: &Topology, from: &State<f64>) -> State<S> {
    let mut to = State::zeros(topology);
    to.position = from.position.map(S::splat);
    to.rotation = from.rotation.map(S::splat);
    to.linear_velocity = from.linear_velocity.map(S::splat);
    to.angular_velocity = from.angular_velocity.map(S::splat);
    to.joint_position = from.joint_position.iter().map(|&x| S::splat(x)).collect();
    to.joint_velocity = from.joint_velocity.iter().map(|&x| S::splat(x)).collect();
    to
}

pub fn to_f64<S: Real>(numbers: &[S]) -> Vec<f64> {
    numbers.iter().map(|x| x.lane(0)).collect()
}

pub fn largest(numbers: &[f64]) -> f64 {
    numbers.iter().fold(0.0, |most, x| x.abs().max(most))
}

pub fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(x, y)| if x.is_nan() || y.is_nan() { f64::INFINITY } else { (x - y).abs() })
        .fold(0.0, f64::max)
}

/// Motion of a base, and what is tried on it.
#[derive(Clone, Debug)]
pub struct BaseMotion {
    pub position: [f64; 3],
    pub rotation: [f64; 4],
    pub linear_velocity: [f64; 3],
    pub angular_velocity: [f64; 3],
    pub force: [f64; 6],
    pub qacc: [f64; 6],
}

/// Motion of a joint, and what is tried on it.
#[derive(Clone, Debug)]
pub struct JointMotion {
    pub position: f64,
    pub velocity: f64,
    pub force: f64,
    pub qacc: f64,
}

#[derive(Clone, Debug)]
struct LinkSpec {
    mass: f64,
    com: [f64; 3],
    /// Radii of gyration of the mass's distribution along three axes, m: any of them make a valid
    /// inertia.
    spread: [f64; 3],
    axes: [f64; 4],
}

#[derive(Clone, Debug)]
struct JointSpec {
    parent: Parent,
    prismatic: bool,
    axis: [f64; 3],
    offset: [f64; 3],
    rotation: [f64; 4],
    armature: f64,
    link: LinkSpec,
    motion: JointMotion,
}

#[derive(Clone, Debug)]
enum Parent {
    Base,
    Previous,
    Any(prop::sample::Index),
}

fn unit_quaternion([w, x, y, z]: [f64; 4]) -> DQuat {
    let q = DQuat::from_xyzw(x, y, z, w);
    if q.length() < 1e-3 { DQuat::IDENTITY } else { q.normalize() }
}

fn vector(most: f64) -> impl Strategy<Value = [f64; 3]> + Clone {
    let x = -most..most;
    [x.clone(), x.clone(), x]
}

fn quaternion() -> impl Strategy<Value = [f64; 4]> + Clone {
    let x = -1.0..1.0;
    [x.clone(), x.clone(), x.clone(), x]
}

fn unit_vector() -> impl Strategy<Value = [f64; 3]> {
    let aligned =
        (0..6usize).prop_map(|k| std::array::from_fn(|i| if i == k % 3 { 1.0 - 2.0 * (k / 3) as f64 } else { 0.0 }));
    let general = vector(1.0).prop_map(|v| DVec3::from_array(v).try_normalize().unwrap_or(DVec3::X).to_array());
    prop_oneof![aligned, general]
}

fn link() -> impl Strategy<Value = LinkSpec> {
    let spread = 0.02..0.2;
    (0.05..10.0, vector(0.1), [spread.clone(), spread.clone(), spread], quaternion())
        .prop_map(|(mass, com, spread, axes)| LinkSpec { mass, com, spread, axes })
}

fn joint() -> impl Strategy<Value = JointSpec> {
    let parent = prop_oneof![1 => Just(Parent::Base), 2 => Just(Parent::Previous), 2 => any::<prop::sample::Index>().prop_map(Parent::Any)];
    // without a rotation of the joint frame, aligned axes stay aligned
    let rotation = prop_oneof![Just([1.0, 0.0, 0.0, 0.0]), quaternion()];
    let armature = prop_oneof![Just(0.0), 1e-3..0.1];
    let motion = (-1.0..1.0, -3.0..3.0, -20.0..20.0, -20.0..20.0)
        .prop_map(|(position, velocity, force, qacc)| JointMotion { position, velocity, force, qacc });
    (parent, any::<bool>(), unit_vector(), vector(0.3), rotation, armature, link(), motion).prop_map(
        |(parent, prismatic, axis, offset, rotation, armature, link, motion)| {
            // any angle, but a slide of half a metre
            let reach = if prismatic { 0.5 } else { std::f64::consts::PI };
            let motion = JointMotion { position: motion.position * reach, ..motion };
            JointSpec { parent, prismatic, axis, offset, rotation, armature, link, motion }
        },
    )
}

fn base_motion() -> impl Strategy<Value = BaseMotion> {
    let six = |most: f64| (vector(most), vector(most)).prop_map(|(a, b)| [a[0], a[1], a[2], b[0], b[1], b[2]]);
    (vector(2.0), quaternion(), vector(2.0), vector(3.0), six(50.0), six(20.0)).prop_map(
        |(position, rotation, linear_velocity, angular_velocity, force, qacc)| BaseMotion {
            position,
            rotation,
            linear_velocity,
            angular_velocity,
            force,
            qacc,
        },
    )
}

fn model_link(name: String, spec: &LinkSpec) -> Link {
    let second = DVec3::from_array(spec.spread.map(|r| spec.mass * r * r));
    let about = DVec3::new(second.y + second.z, second.x + second.z, second.x + second.y);
    let axes = DMat3::from_quat(unit_quaternion(spec.axes));
    Link {
        name,
        mass: spec.mass,
        com: DVec3::from_array(spec.com),
        inertia: axes * DMat3::from_diagonal(about) * axes.transpose(),
        merged: Vec::new(),
    }
}

/// Random trees with this many joints: revolute and prismatic, aligned and general axes, any
/// branching.
pub fn tree(joints: RangeInclusive<usize>, floating: impl Strategy<Value = bool>) -> impl Strategy<Value = Case> {
    (floating, link(), base_motion(), prop::collection::vec(joint(), joints)).prop_map(
        |(floating, base, motion, specs)| {
            let mut model = Model {
                name: "tree".into(),
                source: PathBuf::new(),
                links: vec![model_link("base".into(), &base)],
                joints: Vec::new(),
                bodies: Vec::new(),
                locked: Vec::new(),
                warnings: Vec::new(),
            };
            for (j, spec) in specs.iter().enumerate() {
                let parent = match &spec.parent {
                    Parent::Base => 0,
                    Parent::Previous => j,
                    Parent::Any(index) => index.index(j + 1),
                };
                model.joints.push(Joint {
                    name: format!("joint_{j}"),
                    kind: if spec.prismatic { JointKind::Prismatic } else { JointKind::Continuous },
                    parent,
                    origin: Pose {
                        rotation: DMat3::from_quat(unit_quaternion(spec.rotation)),
                        translation: DVec3::from_array(spec.offset),
                    },
                    axis: DVec3::from_array(spec.axis),
                    lower: f64::NEG_INFINITY,
                    upper: f64::INFINITY,
                    effort: f64::INFINITY,
                    velocity: f64::INFINITY,
                    damping: 0.0,
                    friction: 0.0,
                    armature: spec.armature,
                });
                model.links.push(model_link(format!("link_{j}"), &spec.link));
            }
            let joints: Vec<JointMotion> = specs.into_iter().map(|spec| spec.motion).collect();
            Case::new(model, floating, &motion, &joints)
        },
    )
}

/// Model of a built-in robot, read from its URDF.
pub fn robot(name: &str) -> Model {
    let loaded = Library::new(Vec::new()).robot(name).unwrap();
    let options = robot::LoadOptions {
        package_dirs: loaded.config.package_dirs.clone(),
        locked_joints: loaded.config.locked_joints.clone(),
        ..robot::LoadOptions::default()
    };
    robot::load_str(&loaded.urdf_text, &loaded.urdf_path, &options).unwrap()
}

/// A built-in robot in random motion, joints anywhere.
pub fn moving_robot() -> impl Strategy<Value = Case> {
    let models: Vec<Model> = ROBOTS.iter().map(|name| robot(name)).collect();
    let motions = prop::collection::vec(joint().prop_map(|spec| spec.motion), 64);
    (prop::sample::select(models), any::<bool>(), base_motion(), motions).prop_map(
        |(model, floating, base, motions)| {
            let joints = &motions[..model.joints.len()];
            Case::new(model.clone(), floating, &base, joints)
        },
    )
}
