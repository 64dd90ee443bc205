//! Quantities of rigid-body dynamics for whoever asks: mass matrix, bias force, forward and inverse
//! dynamics, Jacobians, energy, momentum. A step does not use them; they allocate and recompute the
//! kinematics at each call. [`Scalar`](super::Scalar) hands them out.
//!
//! Generalised vectors are in the order of `qvel`: linear velocity of the base's origin in world
//! axes (3), angular velocity of the base in base axes (3), joints; a fixed base has joints only.
//! Accelerations are the time derivatives of these components, and forces are those that do work on
//! them.

use super::articulation::{JointMotion, Topology};
use super::blocks::{BLOCK, gather, scatter};
use super::kinematics;
use super::lanes::Real;
use super::math::{
    Mat3, Spatial, SpatialInertia, Vec3, add, add_scaled, cross, dot, mul_mat, mul_sym, mul_vec, mul_vec_transposed,
    quat_to_mat, rotate_sym, scale, sub,
};
use super::parameters::Parameters;
use super::state::{LinkState, State, Workspace};

/// A body (or a pack of bodies) in a state, to be asked for its dynamics.
pub struct Dynamics<'a, S: Real> {
    /// Topology that the lanes share.
    pub topology: &'a Topology,
    /// Masses, frames and actuators of the bodies.
    pub parameters: &'a Parameters<S>,
    /// Positions and velocities. A fixed base keeps its pose; its velocities count as zero.
    pub state: &'a State<S>,
    /// Gravity in world axes, m/s^2.
    pub gravity: [f64; 3],
    /// Scratch memory.
    pub work: &'a mut Workspace<S>,
}

/// Motion of a link for the Newton-Euler recursion, in base axes.
#[derive(Clone, Copy)]
struct Motion<S> {
    /// Angular velocity, rad/s.
    angular_velocity: Vec3<S>,
    /// Angular acceleration, rad/s^2.
    angular_acceleration: Vec3<S>,
    /// Acceleration of the link's origin as an observer at rest sees it, less gravity, m/s^2.
    acceleration: Vec3<S>,
}

impl<S: Real> Dynamics<'_, S> {
    /// Length `nv` of generalised vectors: joints, and six more for a floating base.
    pub fn num_dofs(topology: &Topology) -> usize {
        topology.num_joints() + if topology.floating { 6 } else { 0 }
    }

    /// Poses and velocities of all links, in base axes about the base's origin.
    fn kinematics(&mut self) {
        let state = self.state;
        self.work.base_rotation = quat_to_mat(&state.rotation);
        let base = if self.topology.floating {
            let linear = mul_vec_transposed(&self.work.base_rotation, &state.linear_velocity);
            Spatial { ang: state.angular_velocity, lin: linear }
        } else {
            Spatial::zero()
        };
        let (position, velocity) = (&state.joint_position, &state.joint_velocity);
        kinematics::forward_kinematics(self.topology, self.parameters, position, velocity, &base, self.work);
    }

    /// Gravity in base axes.
    fn base_gravity(&self) -> Vec3<S> {
        mul_vec_transposed(&self.work.base_rotation, &self.gravity.map(S::splat))
    }

    /// Leaves bias forces and the mass matrix, not factorised, in the workspace.
    fn equations_of_motion(&mut self) {
        let state = self.state;
        self.work.base_rotation = quat_to_mat(&state.rotation);
        let gravity = self.base_gravity();
        let turning = if self.topology.floating { state.angular_velocity } else { [S::zero(); 3] };
        let (position, velocity) = (&state.joint_position, &state.joint_velocity);
        kinematics::equations_of_motion(
            self.topology,
            self.parameters,
            position,
            velocity,
            &turning,
            &gravity,
            self.work,
        );
    }

    /// The base's part of a generalised vector from the engine's order (angular, linear; base
    /// axes).
    fn base_to_qvel(&self, base: &[S; 6]) -> [S; 6] {
        let linear = mul_vec(&self.work.base_rotation, &[base[3], base[4], base[5]]);
        [linear[0], linear[1], linear[2], base[0], base[1], base[2]]
    }

    /// A generalised vector from its parts in the engine's order.
    fn to_qvel(&self, base: &[S; 6], joints: &[S]) -> Vec<S> {
        let mut out = Vec::with_capacity(Self::num_dofs(self.topology));
        if self.topology.floating {
            out.extend(self.base_to_qvel(base));
        }
        out.extend(joints);
        out
    }

    /// The parts of a generalised vector: angular and linear in base axes, and joints.
    fn split<'v>(&self, vector: &'v [S]) -> (Vec3<S>, Vec3<S>, &'v [S]) {
        if self.topology.floating {
            let linear = mul_vec_transposed(&self.work.base_rotation, &[vector[0], vector[1], vector[2]]);
            ([vector[3], vector[4], vector[5]], linear, &vector[6..])
        } else {
            ([S::zero(); 3], [S::zero(); 3], vector)
        }
    }

    /// See [`Scalar::mass_matrix`](super::Scalar::mass_matrix).
    pub(super) fn mass_matrix(&mut self) -> Vec<S> {
        self.equations_of_motion();
        let topology = self.topology;
        let nv = Self::num_dofs(topology);
        let first = nv - topology.num_joints();
        let mut m = vec![S::zero(); nv * nv];
        let factor = &self.work.factor;
        let mut set = |row: usize, column: usize, x: S| {
            m[row * nv + column] = x;
            m[column * nv + row] = x;
        };
        for (block, own) in topology.blocks().iter().zip(&factor.blocks) {
            for place in 0..block.len {
                let j = first + block.joints[place];
                set(j, j, own.diagonal[place]);
                for t in 0..place {
                    set(j, first + block.joints[t], own.inner[place + t - 1]);
                }
                for (carrier, couplings) in
                    topology.carriers_of(block).iter().zip(&factor.couplings[block.first_coupling..])
                {
                    for t in 0..carrier.count {
                        set(j, first + topology.blocks()[carrier.block].joints[t], couplings[place][t]);
                    }
                }
            }
        }
        if topology.floating {
            for (block, own) in topology.blocks().iter().zip(&factor.blocks) {
                for (j, couplings) in block.joints[..block.len].iter().zip(&own.base) {
                    for (r, x) in self.base_to_qvel(couplings).into_iter().enumerate() {
                        set(r, 6 + j, x);
                    }
                }
            }
            for k in 0..3 {
                // the linear block is the total mass times the identity in any axes
                set(k, k, factor.base[3 + k][3 + k]);
                for (r, x) in self.base_to_qvel(&factor.base[k]).into_iter().enumerate() {
                    set(r, 3 + k, x);
                }
            }
        }
        m
    }

    /// See [`Scalar::bias_force`](super::Scalar::bias_force).
    pub(super) fn bias_force(&mut self) -> Vec<S> {
        self.equations_of_motion();
        self.to_qvel(&self.work.bias_base, &self.work.bias_joint)
    }

    /// See [`Scalar::forward_dynamics`](super::Scalar::forward_dynamics).
    pub(super) fn forward_dynamics(&mut self, force: &[S]) -> Vec<S> {
        self.equations_of_motion();
        let (angular, linear, joints) = self.split(force);
        let given = [angular[0], angular[1], angular[2], linear[0], linear[1], linear[2]];
        let mut base: [S; 6] = std::array::from_fn(|r| given[r] - self.work.bias_base[r]);
        let mut joint: Vec<S> = joints.iter().zip(&self.work.bias_joint).map(|(&f, &c)| f - c).collect();
        let blocks = self.topology.blocks();
        let mut by_block = vec![[S::zero(); BLOCK]; blocks.len()];
        gather(blocks, &joint, &mut by_block);
        let factor = &mut self.work.factor;
        factor.factorise(self.topology);
        factor.half_solve(self.topology, &mut base, &mut by_block);
        factor.to_dense(self.topology, &mut base, &mut by_block);
        scatter(blocks, &by_block, &mut joint);
        self.to_qvel(&base, &joint)
    }

    /// See [`Scalar::inverse_dynamics`](super::Scalar::inverse_dynamics).
    ///
    /// Newton's and Euler's equations link by link (J. Luh, M. Walker, R. Paul, On-Line
    /// Computational Scheme for Mechanical Manipulators, 1980), with ordinary accelerations and
    /// moments about each link's origin: shares neither the mass matrix nor the spatial algebra of
    /// the step.
    pub(super) fn inverse_dynamics(&mut self, qacc: &[S]) -> Vec<S> {
        self.kinematics();
        let topology = self.topology;
        let (angular, linear, joints) = self.split(qacc);
        let two = S::splat(2.0);
        let links = &self.work.links;
        let mut motions = vec![Motion {
            angular_velocity: links[0].velocity.ang,
            angular_acceleration: angular,
            acceleration: sub(&linear, &self.base_gravity()),
        }];
        for (j, joint) in topology.joints.iter().enumerate() {
            let parent = motions[joint.parent];
            let w = parent.angular_velocity;
            let arm = sub(&links[j + 1].position, &links[joint.parent].position);
            let carried = add(&cross(&parent.angular_acceleration, &arm), &cross(&w, &cross(&w, &arm)));
            let carried = Motion { acceleration: add(&parent.acceleration, &carried), ..parent };
            let (qd, qdd) = (self.state.joint_velocity[j], joints[j]);
            let axis = &self.work.links[j + 1].axis;
            motions.push(match joint.motion {
                JointMotion::Revolute => {
                    let spin = scale(&axis.ang, qd);
                    Motion {
                        angular_velocity: add(&w, &spin),
                        angular_acceleration: add_scaled(
                            &add(&carried.angular_acceleration, &cross(&w, &spin)),
                            &axis.ang,
                            qdd,
                        ),
                        ..carried
                    }
                }
                JointMotion::Prismatic => {
                    let coriolis = cross(&w, &scale(&axis.lin, qd * two));
                    let acceleration = add_scaled(&add(&carried.acceleration, &coriolis), &axis.lin, qdd);
                    Motion { acceleration, ..carried }
                }
            });
        }
        // force on each link, and moment about its origin, that its motion needs; then of all that
        // it carries
        let mut forces: Vec<(Vec3<S>, Vec3<S>)> = motions
            .iter()
            .enumerate()
            .map(|(link, motion)| {
                let rotation = &links[link].rotation;
                let com = mul_vec(rotation, &self.parameters.com[link]);
                let inertia = rotate_sym(rotation, &self.parameters.inertia[link]);
                let (w, dw) = (&motion.angular_velocity, &motion.angular_acceleration);
                let acceleration = add(&motion.acceleration, &add(&cross(dw, &com), &cross(w, &cross(w, &com))));
                let force = scale(&acceleration, self.parameters.mass[link]);
                let about_com = add(&mul_sym(&inertia, dw), &cross(w, &mul_sym(&inertia, w)));
                (force, add(&about_com, &cross(&com, &force)))
            })
            .collect();
        let mut effort = vec![S::zero(); topology.num_joints()];
        for (j, joint) in topology.joints.iter().enumerate().rev() {
            let (force, moment) = forces[j + 1];
            let axis = &self.work.links[j + 1].axis;
            let along = match joint.motion {
                JointMotion::Revolute => dot(&axis.ang, &moment),
                JointMotion::Prismatic => dot(&axis.lin, &force),
            };
            effort[j] = self.parameters.armature[j].mul_add(joints[j], along);
            let arm = sub(&links[j + 1].position, &links[joint.parent].position);
            let (f, m) = &mut forces[joint.parent];
            *f = add(f, &force);
            *m = add(m, &add(&moment, &cross(&arm, &force)));
        }
        let (f, m) = forces[0];
        self.to_qvel(&[m[0], m[1], m[2], f[0], f[1], f[2]], &effort)
    }

    /// See [`Scalar::jacobian`](super::Scalar::jacobian).
    pub(super) fn jacobian(&mut self, link: usize, point: &Vec3<S>) -> Vec<S> {
        self.kinematics();
        let topology = self.topology;
        let nv = Self::num_dofs(topology);
        let first = nv - topology.num_joints();
        let rotation = &self.work.base_rotation;
        let at = &self.work.links[link];
        let at = add(&at.position, &mul_vec(&at.rotation, point));
        let mut out = vec![S::zero(); 6 * nv];
        let mut set = |column: usize, linear: &Vec3<S>, angular: &Vec3<S>| {
            let (linear, angular) = (mul_vec(rotation, linear), mul_vec(rotation, angular));
            for r in 0..3 {
                out[r * nv + column] = linear[r];
                out[(3 + r) * nv + column] = angular[r];
            }
        };
        let unit: Mat3<S> = std::array::from_fn(|i| std::array::from_fn(|k| S::splat(f64::from(u8::from(i == k)))));
        if topology.floating {
            for k in 0..3 {
                set(3 + k, &cross(&unit[k], &at), &unit[k]);
            }
        }
        for j in topology.chain(link) {
            let axis = &self.work.links[j + 1].axis;
            set(first + j, &add(&axis.lin, &cross(&axis.ang, &at)), &axis.ang);
        }
        if topology.floating {
            for k in 0..3 {
                out[k * nv + k] = S::one();
            }
        }
        out
    }

    /// See [`Scalar::link_pose`](super::Scalar::link_pose).
    pub(super) fn link_pose(&mut self, link: usize) -> (Vec3<S>, Mat3<S>) {
        self.kinematics();
        let (rotation, at) = (&self.work.base_rotation, &self.work.links[link]);
        (add(&self.state.position, &mul_vec(rotation, &at.position)), mul_mat(rotation, &at.rotation))
    }

    /// See [`Scalar::link_velocity`](super::Scalar::link_velocity).
    pub(super) fn link_velocity(&mut self, link: usize) -> (Vec3<S>, Vec3<S>) {
        self.kinematics();
        let rotation = &self.work.base_rotation;
        let at = &self.work.links[link];
        let (_, linear) = kinematics::point_motion(at, &[S::zero(); 3]);
        (mul_vec(rotation, &linear), mul_vec(rotation, &at.velocity.ang))
    }

    /// See [`Scalar::energy`](super::Scalar::energy).
    pub(super) fn energy(&mut self) -> (S, S) {
        self.kinematics();
        let gravity = self.gravity.map(S::splat);
        let mut double_kinetic = S::zero();
        let mut moment = [S::zero(); 3];
        for (at, inertia) in self.link_inertias() {
            double_kinetic = double_kinetic + at.velocity.dot(&inertia.apply(&at.velocity));
            moment = add(&moment, &inertia.moment);
        }
        for (&v, &armature) in self.state.joint_velocity.iter().zip(&self.parameters.armature) {
            double_kinetic = (armature * v).mul_add(v, double_kinetic);
        }
        let moment = mul_vec(&self.work.base_rotation, &moment);
        let moment = add_scaled(&moment, &self.state.position, self.parameters.total_mass());
        (double_kinetic * S::splat(0.5), -dot(&gravity, &moment))
    }

    /// See [`Scalar::momentum`](super::Scalar::momentum).
    pub(super) fn momentum(&mut self) -> (Vec3<S>, Vec3<S>) {
        self.kinematics();
        let mut total = Spatial::zero();
        for (at, inertia) in self.link_inertias() {
            total = total.plus(&inertia.apply(&at.velocity));
        }
        let com = self.base_com();
        let about_com = sub(&total.ang, &cross(&com, &total.lin));
        let rotation = &self.work.base_rotation;
        (mul_vec(rotation, &total.lin), mul_vec(rotation, &about_com))
    }

    /// See [`Scalar::center_of_mass`](super::Scalar::center_of_mass).
    pub(super) fn center_of_mass(&mut self) -> Vec3<S> {
        self.kinematics();
        add(&self.state.position, &mul_vec(&self.work.base_rotation, &self.base_com()))
    }

    /// All links, with their spatial inertias; [`kinematics`](Self::kinematics) must have placed
    /// them.
    fn link_inertias(&self) -> impl Iterator<Item = (&LinkState<S>, SpatialInertia<S>)> {
        let inertia = |(link, at)| (at, kinematics::link_inertia(self.parameters, link, at));
        self.work.links.iter().enumerate().map(inertia)
    }

    /// Centre of mass in base axes about the base's origin, in the present pose.
    fn base_com(&self) -> Vec3<S> {
        let moment = self.link_inertias().fold([S::zero(); 3], |sum, (_, inertia)| add(&sum, &inertia.moment));
        scale(&moment, S::one() / self.parameters.total_mass())
    }
}
