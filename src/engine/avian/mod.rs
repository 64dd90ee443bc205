//! The other physics engine: links as Avian's rigid bodies, held together by joints of polypod's
//! own.
//!
//! Avian finds and solves the contacts with the ground. Its own joints correct positions after its
//! contacts are solved, which makes feet slide; [`joints`] solves changes of velocity instead, all
//! joints of a robot at once, in turn with the contacts in every substep.

mod joints;
mod robots;
mod saved;
mod shapes;
mod world;

use std::ops::Range;
use std::time::Duration;

use avian3d::prelude::{
    AngularVelocity, ComputedAngularInertia, ComputedCenterOfMass, ComputedMass, Friction, LinearVelocity, Position,
    Restitution, Rotation,
};
use bevy_ecs::component::Mutable;
use bevy_ecs::prelude::{Component, Entity, World};
use bevy_math::{Mat3, Vec3};
use glam::{DMat3, DQuat, DVec3};

use super::MorphologySetup;
use crate::dynamics::math::{Mat3 as Rows3, Spatial, mul_vec_transposed, quat_to_mat};
use crate::dynamics::{JointMotion, LinkForce, Parameters, Plane, Scalar, State, Topology, Workspace};
use crate::obstacles::Part;
use crate::workers::Workers;
use joints::{Joint, JointNumbers, Joints, Pull, Wrench};
pub(crate) use robots::AvianRobots;
use shapes::LinkCollider;
pub(crate) use shapes::link_colliders;
use world::Bodies;

/// Why a robot cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub(crate) enum EngineError {
    /// A joint that slides.
    #[error("joint `{0}` is prismatic, and the engine avian has revolute joints only")]
    Prismatic(String),
    /// Substeps below the clock's resolution.
    #[error("substeps of {0:e} s are too short or too long for the engine avian")]
    Step(f64),
    /// Never seen: links in another order than they were made in.
    #[error("the engine avian does not keep the links in order")]
    Order,
}

/// Settings that all envs share.
#[derive(Clone, Copy)]
pub(crate) struct Settings {
    /// Physics step, s.
    pub(crate) dt: f64,
    /// Substeps in it.
    pub(crate) substeps: usize,
    /// Gravity, m/s^2, world axes.
    pub(crate) gravity: [f64; 3],
    /// Plane that the robots stand on.
    pub(crate) ground: Option<Plane>,
}

/// Robots of one morphology, one in each env.
struct Worlds {
    topology: Topology,
    chunks: Vec<Chunk>,
    /// Envs in each chunk but the last.
    per_chunk: usize,
}

/// Envs that share a world of Avian's and are stepped by one thread.
struct Chunk {
    world: World,
    bodies: Bodies,
    joints: Joints,
    envs: Vec<Env>,
    work: Workspace<f64>,
    /// Contact body of each collider of a robot, and the factor on its friction.
    body_of_collider: Vec<usize>,
    friction_of_collider: Vec<f32>,
    /// Colliders of a robot that may touch each other.
    self_pairs: Vec<[usize; 2]>,
    /// Lengths of a physics step and of a substep.
    dt: Duration,
    h: Duration,
}

/// State of an env between steps.
struct Env {
    /// Origin of the env in the world, m. A state that is set afterwards is about it.
    origin: DVec3,
    /// State that was set, or that the bodies have reached since.
    state: State<f64>,
    parameters: Parameters<f64>,
    /// Mean effort of each actuator in the last physics step, N m.
    effort: Vec<f64>,
    /// Mean force on each contact body in the last physics step, N, world axes.
    force: Vec<[f64; 3]>,
    /// Sum of the normal forces of each contact body's contacts in the last physics step, N.
    normal_force: Vec<f64>,
}

impl Worlds {
    /// The robots of a morphology in up to `num_chunks` worlds, each among the same `statics`;
    /// `nominal` are their numbers.
    pub(crate) fn new<T>(
        setup: &MorphologySetup<T>,
        nominal: &Parameters<f64>,
        settings: &Settings,
        statics: &[Part],
        num_chunks: usize,
    ) -> Result<Self, EngineError> {
        let &MorphologySetup { model, topology, count: num_envs, .. } = setup;
        if let Some(j) = topology.joints.iter().position(|joint| joint.motion == JointMotion::Prismatic) {
            return Err(EngineError::Prismatic(model.joints[j].name.clone()));
        }
        let substep = settings.dt / settings.substeps as f64;
        let dt = Duration::try_from_secs_f64(settings.dt).map_err(|_| EngineError::Step(substep))?;
        let h = dt.div_f64(settings.substeps as f64);
        // the clock counts nanoseconds
        if h < Duration::from_micros(1) {
            return Err(EngineError::Step(substep));
        }
        let colliders = shapes::colliders(model, setup.align, topology.floating);
        // a base that cannot move has no colliders
        let place = |shape: usize| colliders.iter().position(|collider| collider.shape == shape);
        let self_pairs: Vec<[usize; 2]> =
            setup.shape_pairs.iter().filter_map(|&[a, b]| Some([place(a)?, place(b)?])).collect();
        let per_chunk = num_envs.div_ceil(num_chunks.max(1)).max(1);
        let mut engine = Self { topology: topology.clone(), chunks: Vec::new(), per_chunk };
        for first in (0..num_envs).step_by(per_chunk) {
            let count = per_chunk.min(num_envs - first);
            engine.chunks.push(Chunk::new(
                topology,
                nominal,
                settings,
                &colliders,
                &self_pairs,
                statics,
                count,
                dt,
                h,
            )?);
        }
        for env in 0..num_envs {
            engine.set_parameters(env, nominal);
        }
        Ok(engine)
    }

    fn at(&self, env: usize) -> (&Chunk, usize) {
        (&self.chunks[env / self.per_chunk], env % self.per_chunk)
    }

    fn at_mut(&mut self, env: usize) -> (&mut Chunk, usize) {
        (&mut self.chunks[env / self.per_chunk], env % self.per_chunk)
    }

    /// State of an env.
    fn env(&self, env: usize) -> &Env {
        let (chunk, i) = self.at(env);
        &chunk.envs[i]
    }

    /// Mutable state of an env. Numbers that the world also holds have separate setters.
    fn env_mut(&mut self, env: usize) -> &mut Env {
        let (chunk, i) = self.at_mut(env);
        &mut chunk.envs[i]
    }

    /// Puts all links at the poses of forward kinematics; contacts and joints start without memory.
    pub(crate) fn set_state(&mut self, env: usize, state: &State<f64>) {
        let (chunk, i) = (&mut self.chunks[env / self.per_chunk], env % self.per_chunk);
        chunk.set_state(&self.topology, i, state);
    }

    /// Sets the numbers of an env; positions stay, and so do the velocities of the links' origins.
    pub(crate) fn set_parameters(&mut self, env: usize, parameters: &Parameters<f64>) {
        let (chunk, i) = (&mut self.chunks[env / self.per_chunk], env % self.per_chunk);
        chunk.set_parameters(&self.topology, i, parameters);
    }

    /// Sets the position that a joint's gains pull to, rad, and the effort on top of that, N m.
    pub(crate) fn set_drive(&mut self, env: usize, joint: usize, target: f64, effort: f64) {
        let joints = self.topology.num_joints();
        let (chunk, i) = self.at_mut(env);
        let to = &mut chunk.joints.all[i * joints + joint];
        (to.target, to.feedforward) = (target as f32, effort as f32);
    }

    /// Sets force (at the centre of mass, N) and torque (N m) on a base, base axes.
    pub(crate) fn set_wrench(&mut self, env: usize, force: [f32; 3], torque: [f32; 3]) {
        let (chunk, i) = self.at_mut(env);
        chunk.joints.wrenches[i] = Wrench { force: Vec3::from_array(force), torque: Vec3::from_array(torque) };
    }

    /// Sets the forces on the links of a robot.
    pub(crate) fn set_link_forces(&mut self, env: usize, forces: &[LinkForce<f64>]) {
        let links = self.topology.num_links();
        let (chunk, i) = self.at_mut(env);
        let com = &chunk.envs[i].parameters.com;
        let pulls = &mut chunk.joints.pulls;
        pulls.retain(|pull| pull.body / links != i);
        pulls.extend(forces.iter().map(|force| Pull {
            body: i * links + force.link,
            in_world: force.in_world,
            arm: vector(std::array::from_fn(|k| force.point[k] - com[force.link][k])),
            wrench: Wrench { force: vector(force.force), torque: vector(force.torque) },
        }));
        // each robot's forces in one order, whatever its neighbours have
        pulls.sort_by_key(|pull| pull.body);
    }

    /// Largest distance of the links' origins from their places in the forward kinematics of the
    /// state, m.
    pub(crate) fn drift(&self, env: usize) -> f64 {
        let (chunk, i) = self.at(env);
        let links = self.topology.num_links();
        let mut work = Workspace::new(&self.topology);
        let env = &chunk.envs[i];
        let rotation = forward(&self.topology, &env.parameters, &env.state, &mut work);
        let origin = env.origin + DVec3::from_array(env.state.position);
        let distances = work.links.iter().zip(&chunk.bodies.links[i * links..]).filter_map(|(link, entity)| {
            let there = origin + rotation * DVec3::from_array(link.position);
            Some(chunk.world.get::<Position>(*entity)?.0.as_dvec3().distance(there))
        });
        distances.fold(0.0, f64::max)
    }

    /// `n` physics steps of all envs. With `gains` the actuators pull to the targets, and
    /// `explicit` joints hold the effort of the beginning of a physics step.
    pub(crate) fn step(&mut self, workers: &Workers, explicit: &[bool], gains: bool, n: usize) {
        let topology = &self.topology;
        workers.for_each(self.chunks.iter_mut(), |chunk| chunk.step(topology, explicit, gains, n));
    }
}

impl Chunk {
    fn new(
        topology: &Topology,
        nominal: &Parameters<f64>,
        settings: &Settings,
        colliders: &[LinkCollider],
        self_pairs: &[[usize; 2]],
        statics: &[Part],
        num_envs: usize,
        dt: Duration,
        h: Duration,
    ) -> Result<Self, EngineError> {
        let (links, substeps) = (topology.num_links(), settings.substeps);
        let (floating, ground, gravity) = (topology.floating, settings.ground, settings.gravity);
        let contents = world::Contents { robots: num_envs, links, floating, colliders, self_pairs, ground, statics };
        let (world, bodies) = world::build(contents, gravity, substeps).ok_or(EngineError::Order)?;
        let mut joints = Joints {
            floating,
            parents: topology.joints.iter().map(|joint| joint.parent).collect(),
            axes: topology.joints.iter().map(|joint| vector(joint.axis.direction())).collect(),
            tables: topology.joints.iter().map(|joint| joint.effort_table.clone()).collect(),
            all: vec![Joint::default(); num_envs * topology.num_joints()],
            wrenches: vec![Wrench::default(); num_envs],
            ..Joints::default()
        };
        joints.set_step(h, substeps);
        let env = || Env {
            origin: DVec3::ZERO,
            state: State::zeros(topology),
            parameters: nominal.clone(),
            effort: vec![0.0; topology.num_joints()],
            force: vec![[0.0; 3]; topology.num_bodies],
            normal_force: vec![0.0; topology.num_bodies],
        };
        Ok(Self {
            world,
            bodies,
            joints,
            envs: (0..num_envs).map(|_| env()).collect(),
            work: Workspace::new(topology),
            body_of_collider: colliders.iter().map(|collider| collider.body).collect(),
            friction_of_collider: colliders.iter().map(|collider| collider.friction).collect(),
            self_pairs: self_pairs.to_vec(),
            dt,
            h,
        })
    }

    fn colliders(&self, env: usize) -> Range<usize> {
        let count = self.body_of_collider.len();
        env * count..(env + 1) * count
    }

    /// Pairs of colliders that may touch, among those of the world.
    fn pairs(&self, env: usize) -> Range<usize> {
        let count = self.body_of_collider.len() * self.bodies.statics + self.self_pairs.len();
        env * count..(env + 1) * count
    }

    fn set<C: Component<Mutability = Mutable>>(&mut self, entity: Entity, value: C) {
        if let Some(mut component) = self.world.get_mut::<C>(entity) {
            *component = value;
        }
    }

    fn set_state(&mut self, topology: &Topology, env: usize, state: &State<f64>) {
        self.envs[env].state = state.clone();
        let joints = topology.num_joints();
        for (j, joint) in self.joints.all[env * joints..(env + 1) * joints].iter_mut().enumerate() {
            (joint.position, joint.velocity) = (state.joint_position[j], state.joint_velocity[j]);
            joint.forget();
        }
        let pairs = self.pairs(env);
        world::forget_contacts(&mut self.world, pairs);
        self.place(topology, env);
    }

    /// Puts the bodies where the state has them.
    fn place(&mut self, topology: &Topology, env: usize) {
        let Env { state, parameters, .. } = &self.envs[env];
        let rotation = forward(topology, parameters, state, &mut self.work);
        let base = self.envs[env].origin + DVec3::from_array(state.position);
        let links = topology.num_links();
        for link in 0..links {
            let at = &self.work.links[link];
            let turn = rotation * matrix(&at.rotation);
            let position = base + rotation * DVec3::from_array(at.position);
            // the velocity of the centre of mass
            let com = add(
                at.position,
                (matrix(&at.rotation) * DVec3::from_array(self.envs[env].parameters.com[link])).to_array(),
            );
            let spin = DVec3::from_array(at.velocity.ang);
            let velocity = DVec3::from_array(at.velocity.lin) + spin.cross(com);
            let entity = self.bodies.links[env * links + link];
            self.set(entity, Position(position.as_vec3()));
            self.set(entity, Rotation(DQuat::from_mat3(&turn).normalize().as_quat()));
            self.set(entity, LinearVelocity((rotation * velocity).as_vec3()));
            self.set(entity, AngularVelocity((rotation * spin).as_vec3()));
        }
    }

    fn set_parameters(&mut self, topology: &Topology, env: usize, parameters: &Parameters<f64>) {
        let moved = self.envs[env].parameters.com != parameters.com
            || self.envs[env].parameters.joint_offset != parameters.joint_offset;
        self.envs[env].parameters = parameters.clone();
        let (joints, links) = (topology.num_joints(), topology.num_links());
        for (j, joint) in self.joints.all[env * joints..(env + 1) * joints].iter_mut().enumerate() {
            joint.numbers = JointNumbers::new(topology, parameters, j);
        }
        for link in 0..links {
            let entity = self.bodies.links[env * links + link];
            self.set(entity, ComputedCenterOfMass(vector(parameters.com[link])));
            if link == 0 && !topology.floating {
                continue;
            }
            self.set(entity, ComputedMass::new(parameters.mass[link] as f32));
            self.set(entity, angular_inertia(&parameters.inertia[link]));
        }
        let (friction, restitution): (Friction, Restitution) =
            world::robot_surface(parameters.dynamic_friction as f32, parameters.restitution as f32);
        for (of_robot, collider) in self.colliders(env).enumerate() {
            let entity = self.bodies.colliders[collider];
            let dynamic_coefficient = friction.dynamic_coefficient * self.friction_of_collider[of_robot];
            self.set(entity, Friction { static_coefficient: dynamic_coefficient, dynamic_coefficient, ..friction });
            self.set(entity, restitution);
        }
        if moved {
            self.place(topology, env);
        }
    }

    fn step(&mut self, topology: &Topology, explicit: &[bool], gains: bool, n: usize) {
        self.joints.explicit.clear();
        self.joints.explicit.extend(explicit);
        self.joints.gains = gains;
        self.world.insert_resource(std::mem::take(&mut self.joints));
        for _ in 0..n {
            world::step(&mut self.world, self.dt, self.h);
        }
        self.joints = self.world.remove_resource().unwrap_or_default();
        let (joints, links) = (topology.num_joints(), topology.num_links());
        for (i, env) in self.envs.iter_mut().enumerate() {
            let own = &self.joints.all[i * joints..(i + 1) * joints];
            for (j, joint) in own.iter().enumerate() {
                env.state.joint_position[j] = joint.position;
                env.state.joint_velocity[j] = joint.velocity;
                env.effort[j] = f64::from(joint.effort);
            }
            env.force.fill([0.0; 3]);
            env.normal_force.fill(0.0);
            let base = self.bodies.links[i * links];
            if topology.floating
                && let Ok(base) = self.world.get_entity(base)
                && let (Some(position), Some(rotation), Some(linear), Some(angular)) = (
                    base.get::<Position>(),
                    base.get::<Rotation>(),
                    base.get::<LinearVelocity>(),
                    base.get::<AngularVelocity>(),
                )
            {
                let (q, spin) = (rotation.0.as_dquat(), angular.0.as_dvec3());
                let com = DVec3::from_array(env.parameters.com[0]);
                env.state.position = (position.0.as_dvec3() - env.origin).to_array();
                env.state.rotation = [q.w, q.x, q.y, q.z];
                env.state.linear_velocity = (linear.0.as_dvec3() - spin.cross(q * com)).to_array();
                env.state.angular_velocity = (q.conjugate() * spin).to_array();
            }
        }
        let statics = self.bodies.statics;
        let on_statics = self.body_of_collider.len() * statics;
        let count = on_statics + self.self_pairs.len();
        let dt = self.dt.as_secs_f64();
        world::contact_impulses(&self.world, |pair, impulse, along_normal| {
            let (env, place) = (&mut self.envs[pair / count], pair % count);
            let mut add = |collider: usize, sign: f64| {
                let body = self.body_of_collider[collider];
                env.normal_force[body] += f64::from(along_normal) / dt;
                for (sum, p) in env.force[body].iter_mut().zip(impulse.to_array()) {
                    *sum += sign * f64::from(p) / dt;
                }
            };
            match place.checked_sub(on_statics) {
                None => add(place / statics, 1.0),
                Some(pair) => {
                    let [a, b] = self.self_pairs[pair];
                    add(a, 1.0);
                    add(b, -1.0);
                }
            }
        });
    }
}

/// Leaves poses and velocities of the links in the workspace, in base axes; the base's axes in the
/// world.
pub(crate) fn forward(
    topology: &Topology,
    parameters: &Parameters<f64>,
    state: &State<f64>,
    work: &mut Workspace<f64>,
) -> DMat3 {
    let length = state.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
    let rotation = quat_to_mat(&state.rotation.map(|x| x / length));
    let base = if topology.floating {
        Spatial { ang: state.angular_velocity, lin: mul_vec_transposed(&rotation, &state.linear_velocity) }
    } else {
        Spatial::zero()
    };
    let (position, velocity) = (&state.joint_position, &state.joint_velocity);
    f64::forward_kinematics(topology, parameters, position, velocity, &base, work);
    matrix(&rotation)
}

fn angular_inertia(&[xx, yy, zz, xy, xz, yz]: &[f64; 6]) -> ComputedAngularInertia {
    let columns = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let inverse = DMat3::from_cols_array_2d(&columns).inverse();
    let m: Mat3 = inverse.as_mat3();
    ComputedAngularInertia::from_inverse_tensor(avian3d::math::SymmetricTensor::from_mat3_unchecked(m))
}

/// Matrix with these rows.
fn matrix(rows: &Rows3<f64>) -> DMat3 {
    DMat3::from_cols_array_2d(rows).transpose()
}

fn add(a: [f64; 3], b: [f64; 3]) -> DVec3 {
    DVec3::from_array(a) + DVec3::from_array(b)
}

fn vector(v: [f64; 3]) -> Vec3 {
    DVec3::from_array(v).as_vec3()
}
