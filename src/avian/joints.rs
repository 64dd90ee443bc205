//! Revolute joints as soft, warm-started velocity constraints between rigid bodies, solved in turn with Avian's contacts.
//!
//! A joint holds two links together by three rows for the anchor and two for the axis. What acts about the axis (gains,
//! damping, rotor, dry friction, limits) is one scalar row, solved exactly: see [`AxisRow`].

use std::f64::consts::TAU;

use avian3d::dynamics::solver::solver_body::SolverBody;
use bevy_ecs::prelude::Resource;
use bevy_math::{Mat3, Quat, Vec3};

use crate::dynamics::{EffortTable, Parameters, Topology};

/// Natural frequency of the anchor and axis rows, in cycles per substep, and their damping ratio.
const FREQUENCY: f32 = 0.125;
const DAMPING_RATIO: f32 = 2.0;
/// Share of a substep by which the stiffness looks ahead. From 1/4 on every stiffness is stable; 1 is backward Euler.
const LOOK_AHEAD: f32 = 0.36;
/// Joints beyond a position limit return at no more than this, rad/s.
const MAX_RETURN: f32 = 4.0;
/// Anchors that came apart return at no more than this, m/s, and axes at no more than this, rad/s.
const MAX_BIAS: f32 = 4.0;

/// Share of an error that is taken back, and of impulses that are let go, in a substep.
#[derive(Clone, Copy, Default)]
pub(super) struct Softness {
    bias: f32,
    mass_scale: f32,
    impulse_scale: f32,
}

impl Softness {
    pub(super) fn new(h: f32) -> Self {
        // Catto, Soft Constraints (GDC 2011)
        let angle = std::f32::consts::TAU * FREQUENCY;
        let a = 2.0 * DAMPING_RATIO + angle;
        let scale = 1.0 / (1.0 + angle * a);
        Self { bias: angle / a / h, mass_scale: angle * a * scale, impulse_scale: scale }
    }
}

/// What acts about a joint's axis, as impulses over one substep.
#[derive(Clone, Copy, Debug, Default)]
struct AxisRow {
    /// Actuator impulse at zero speed, before its limits, N m s.
    drive: f32,
    /// What the actuator loses per speed, N m s^2.
    slope: f32,
    /// Limits of the actuator's impulse, N m s.
    least: f32,
    most: f32,
    /// Rotor inertia and viscous damping, kg m^2.
    drag: f32,
    /// Rotor inertia times the speed before, N m s.
    momentum: f32,
    /// Largest impulse of dry friction, N m s.
    friction: f32,
}

impl AxisRow {
    /// The actuator's impulse at a speed.
    fn motor(&self, speed: f32) -> f32 {
        (self.drive - self.slope * speed).min(self.most).max(self.least)
    }

    /// Speed that solves the row: `now` is the present one with the impulse `applied` in it, `k` the speed that a unit of
    /// impulse gives, and the result stays between the bounds.
    fn solve(&self, k: f32, now: f32, applied: f32, [low, high]: [f32; 2]) -> f32 {
        let start = now + k * (self.momentum - applied);
        let free = |friction: f32| {
            let speed = (start + k * (self.drive + friction)) / (1.0 + k * (self.slope + self.drag));
            let impulse = self.drive - self.slope * speed;
            let saturated = |limit: f32| (start + k * (limit + friction)) / (1.0 + k * self.drag);
            if impulse > self.most {
                saturated(self.most)
            } else if impulse < self.least {
                saturated(self.least)
            } else {
                speed
            }
        };
        // the friction that holds the joint still, if it can
        let hold = -start / k - self.motor(0.0);
        let speed = if hold.abs() < self.friction { 0.0 } else { free(hold.min(self.friction).max(-self.friction)) };
        speed.min(high).max(low)
    }
}

/// Numbers of one joint of one robot.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct JointNumbers {
    pub(super) stiffness: f32,
    pub(super) damping: f32,
    pub(super) effort_limit: f32,
    pub(super) armature: f32,
    saturation: f32,
    motor_velocity_limit: f32,
    joint_damping: f32,
    friction: f32,
    lower: f32,
    upper: f32,
    velocity_limit: f32,
    /// From the parent's origin to the anchor, in its axes, m.
    offset: Vec3,
    /// From the centre of mass of the parent and of the child to the anchor, in the link's axes, m.
    anchors: [Vec3; 2],
}

impl JointNumbers {
    pub(super) fn new(topology: &Topology, p: &Parameters<f64>, j: usize) -> Self {
        let vector = |v: [f64; 3]| Vec3::from_array(v.map(|x| x as f32));
        let parent = topology.joints[j].parent;
        let from_com: [f64; 3] = std::array::from_fn(|k| p.joint_offset[j][k] - p.com[parent][k]);
        Self {
            stiffness: p.stiffness[j] as f32,
            damping: p.damping[j] as f32,
            effort_limit: p.effort_limit[j] as f32,
            armature: p.armature[j] as f32,
            saturation: p.saturation_effort[j] as f32,
            motor_velocity_limit: p.motor_velocity_limit[j] as f32,
            joint_damping: p.joint_damping[j] as f32,
            friction: p.joint_friction[j] as f32,
            lower: p.lower[j] as f32,
            upper: p.upper[j] as f32,
            velocity_limit: p.velocity_limit[j] as f32,
            offset: vector(p.joint_offset[j]),
            anchors: [vector(from_com), -vector(p.com[j + 1])],
        }
    }
}

/// Where a joint's parts are, in world axes.
#[derive(Clone, Copy, Default)]
struct Geometry {
    /// From the parent's anchor to the child's, m.
    gap: Vec3,
    /// From the links' centres of mass to their anchors, m.
    arms: [Vec3; 2],
    /// The axis as the parent and the child have it.
    axes: [Vec3; 2],
}

/// One joint of one robot.
#[derive(Clone, Copy, Default)]
pub(super) struct Joint {
    pub(super) numbers: JointNumbers,
    /// rad.
    pub(super) target: f32,
    /// N m.
    pub(super) feedforward: f32,
    /// Position and velocity at the end of the last physics step, rad and rad/s.
    pub(super) position: f64,
    pub(super) velocity: f64,
    /// Mean effort of the actuator in the last physics step, N m.
    pub(super) effort: f32,
    /// Accumulated impulses: anchor, axis, about the axis, of the actuator.
    point: Vec3,
    align: Vec3,
    turn: f32,
    start: Geometry,
    now: Geometry,
    point_mass: Mat3,
    /// Position in the present substep, rad.
    angle: f32,
    row: AxisRow,
    motor: f32,
}

impl Joint {
    /// Forgets the impulses of the last step.
    pub(super) fn forget(&mut self) {
        (self.point, self.align, self.turn, self.motor) = (Vec3::ZERO, Vec3::ZERO, 0.0, 0.0);
    }
}

/// Inverse mass and world-axes inverse inertia of a link.
#[derive(Clone, Copy, Default)]
pub(super) struct Inverse {
    pub(super) mass: f32,
    pub(super) inertia: Mat3,
}

/// A link's pose at the beginning of a physics step.
#[derive(Clone, Copy)]
pub(super) struct LinkPose {
    pub(super) position: Vec3,
    pub(super) rotation: Quat,
}

/// The joints of all robots of a world.
#[derive(Resource, Default)]
pub(super) struct Joints {
    /// The link that carries each joint, `[joints]`.
    pub(super) parents: Vec<usize>,
    /// Joint axes in link axes, `[joints]`.
    pub(super) axes: Vec<Vec3>,
    pub(super) tables: Vec<Option<EffortTable>>,
    pub(super) explicit: Vec<bool>,
    /// Whether the gains act; else the feed-forward effort alone.
    pub(super) gains: bool,
    /// Length of a substep, s, and their number in a physics step.
    pub(super) h: f32,
    pub(super) substeps: usize,
    pub(super) softness: Softness,
    /// `[robots * joints]`.
    pub(super) all: Vec<Joint>,
    /// `[robots * links]`.
    pub(super) inverses: Vec<Inverse>,
}

/// Effort limit from a table over the joint position.
fn table_limit(table: &EffortTable, position: f32) -> f32 {
    let last = table.limits.len().saturating_sub(1);
    let x = ((position - table.start) * table.inverse_step).clamp(0.0, last as f32);
    let i = (x as usize).min(last.saturating_sub(1));
    let (a, b) = (table.limits[i], table.limits[(i + 1).min(last)]);
    (b - a).mul_add(x - i as f32, a)
}

/// `[v]x M [v]x^T`.
fn cross_square(m: &Mat3, v: Vec3) -> Mat3 {
    // columns of [v]x are v x e_k
    let cross = Mat3::from_cols(v.cross(Vec3::X), v.cross(Vec3::Y), v.cross(Vec3::Z));
    cross * *m * cross.transpose()
}

/// The parent's and the child's body of a joint.
fn pair(bodies: &mut [SolverBody], parent: usize, child: usize) -> (&mut SolverBody, &mut SolverBody) {
    let (left, right) = bodies.split_at_mut(child);
    (&mut left[parent], &mut right[0])
}

impl Joints {
    fn num_joints(&self) -> usize {
        self.parents.len()
    }

    /// Takes up the poses at the beginning of a physics step.
    pub(super) fn prepare(&mut self, poses: &[LinkPose]) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let poses = &poses[robot * links..(robot + 1) * links];
            let inverses = &self.inverses[robot * links..(robot + 1) * links];
            for (j, joint) in chunk.iter_mut().enumerate() {
                let (parent, child) = (self.parents[j], j + 1);
                let [a, b] = [&poses[parent], &poses[child]];
                let arms = [a.rotation * joint.numbers.anchors[0], b.rotation * joint.numbers.anchors[1]];
                // the child's anchor is its origin
                let gap = b.position - (a.position + a.rotation * joint.numbers.offset);
                joint.start = Geometry { gap, arms, axes: [a.rotation * self.axes[j], b.rotation * self.axes[j]] };
                let [ia, ib] = [&inverses[parent], &inverses[child]];
                let k = Mat3::from_diagonal(Vec3::splat(ia.mass + ib.mass))
                    + cross_square(&ia.inertia, arms[0])
                    + cross_square(&ib.inertia, arms[1]);
                joint.point_mass = k.inverse();
                joint.now = joint.start;
                joint.angle = joint.position as f32;
                joint.effort = 0.0;
            }
        }
    }

    /// What actuators and rotors do in a substep, and the impulses of the last one as a first guess.
    pub(super) fn begin(&mut self, bodies: &mut [SolverBody], first: bool) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        let h = self.h;
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let bodies = &mut bodies[robot * links..(robot + 1) * links];
            let inverses = &self.inverses[robot * links..(robot + 1) * links];
            for (j, joint) in chunk.iter_mut().enumerate() {
                let (parent, child) = (self.parents[j], j + 1);
                let axis = joint.now.axes[0];
                let speed = axis.dot(bodies[child].angular_velocity - bodies[parent].angular_velocity);
                let n = &joint.numbers;
                let limit = match &self.tables[j] {
                    Some(table) => n.effort_limit * table_limit(table, joint.angle),
                    None => n.effort_limit,
                };
                let line = speed / n.motor_velocity_limit;
                let most = (n.saturation * (1.0 - line)).min(limit).max(0.0);
                let least = (n.saturation * (-1.0 - line)).max(-limit).min(0.0);
                let (kp, kd) = if self.gains { (n.stiffness, n.damping) } else { (0.0, 0.0) };
                let wanted = kp * (joint.target - joint.angle) + joint.feedforward;
                let held = joint.row;
                joint.row = AxisRow {
                    drive: h * wanted,
                    slope: h * (kp * LOOK_AHEAD * h + kd),
                    least: h * least,
                    most: h * most,
                    drag: n.armature + h * n.joint_damping,
                    momentum: n.armature * speed,
                    friction: h * n.friction,
                };
                if self.explicit[j] {
                    // the effort of the step's beginning, held
                    let effort =
                        if first { (h * (wanted - kd * speed)).min(h * most).max(h * least) } else { held.drive };
                    joint.row = AxisRow { drive: effort, slope: 0.0, least: effort, most: effort, ..joint.row };
                }
            }
            // every joint has seen the speeds before any impulse changes them
            for (j, joint) in chunk.iter_mut().enumerate() {
                let (parent, child) = (self.parents[j], j + 1);
                let axis = joint.now.axes[0];
                joint.align -= axis * axis.dot(joint.align);
                let [ia, ib] = [&inverses[parent], &inverses[child]];
                let (a, b) = pair(bodies, parent, child);
                let twist = joint.align + axis * joint.turn;
                let [ra, rb] = joint.now.arms;
                a.linear_velocity -= joint.point * ia.mass;
                a.angular_velocity -= ia.inertia * (ra.cross(joint.point) + twist);
                b.linear_velocity += joint.point * ib.mass;
                b.angular_velocity += ib.inertia * (rb.cross(joint.point) + twist);
            }
        }
    }

    /// One sweep with the errors of position taken back, leaves first.
    pub(super) fn solve(&mut self, bodies: &mut [SolverBody]) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let bodies = &mut bodies[robot * links..(robot + 1) * links];
            let inverses = &self.inverses[robot * links..(robot + 1) * links];
            for (j, joint) in chunk.iter_mut().enumerate().rev() {
                let (parent, child) = (self.parents[j], j + 1);
                let (a, b) = pair(bodies, parent, child);
                sweep::<true>(joint, a, b, [&inverses[parent], &inverses[child]], self.softness, self.h);
            }
        }
    }

    /// Follows the bodies to where they have moved, and one sweep without errors of position, base first.
    pub(super) fn relax(&mut self, bodies: &mut [SolverBody]) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let bodies = &mut bodies[robot * links..(robot + 1) * links];
            let inverses = &self.inverses[robot * links..(robot + 1) * links];
            for (j, joint) in chunk.iter_mut().enumerate() {
                let (parent, child) = (self.parents[j], j + 1);
                let (a, b) = pair(bodies, parent, child);
                let axis = joint.now.axes[0];
                joint.angle += self.h * axis.dot(b.angular_velocity - a.angular_velocity);
                let start = &joint.start;
                let arms = [a.delta_rotation * start.arms[0], b.delta_rotation * start.arms[1]];
                let moved = b.delta_position - a.delta_position;
                joint.now = Geometry {
                    gap: start.gap + moved + (arms[1] - start.arms[1]) - (arms[0] - start.arms[0]),
                    arms,
                    axes: [a.delta_rotation * start.axes[0], b.delta_rotation * start.axes[1]],
                };
                sweep::<false>(joint, a, b, [&inverses[parent], &inverses[child]], self.softness, self.h);
                joint.effort += joint.motor;
            }
        }
    }

    /// Positions, velocities and mean efforts at the end of a physics step.
    pub(super) fn finish(&mut self, rotations: &[Quat], velocities: &[Vec3]) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        let step = self.h * self.substeps as f32;
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let rotations = &rotations[robot * links..(robot + 1) * links];
            let velocities = &velocities[robot * links..(robot + 1) * links];
            for (j, joint) in chunk.iter_mut().enumerate() {
                let (parent, child) = (self.parents[j], j + 1);
                let axis = self.axes[j].as_dvec3();
                let (a, b) = (rotations[parent].as_dquat(), rotations[child].as_dquat());
                let turn = a.conjugate() * b;
                let angle = 2.0 * turn.xyz().dot(axis).atan2(turn.w);
                // the turn nearest to where the joint was
                let change = angle - joint.position;
                joint.position += change - TAU * (change / TAU).round();
                joint.velocity = (a * axis).dot((velocities[child] - velocities[parent]).as_dvec3());
                joint.effort /= step;
            }
        }
    }
}

/// One joint's rows, one after another: about the axis, the axis, the anchor.
#[inline]
fn sweep<const BIAS: bool>(
    joint: &mut Joint,
    a: &mut SolverBody,
    b: &mut SolverBody,
    [ia, ib]: [&Inverse; 2],
    soft: Softness,
    h: f32,
) {
    let Geometry { gap, arms: [ra, rb], axes: [axis, child_axis] } = joint.now;
    let n = &joint.numbers;
    let relative = b.angular_velocity - a.angular_velocity;

    let response = (ia.inertia + ib.inertia) * axis;
    let k = axis.dot(response);
    let speed = axis.dot(relative);
    // a bound may be reached within the substep; beyond it the joint returns
    let to_lower = n.lower - joint.angle;
    let to_upper = n.upper - joint.angle;
    let back = |distance: f32| if BIAS { (soft.bias * distance).clamp(-MAX_RETURN, MAX_RETURN) } else { 0.0 };
    let low = if to_lower <= 0.0 { to_lower / h } else { back(to_lower) };
    let high = if to_upper >= 0.0 { to_upper / h } else { back(to_upper) };
    let bounds = [low.max(-n.velocity_limit), high.min(n.velocity_limit)];
    let new = joint.row.solve(k, speed, joint.turn, bounds);
    joint.motor = joint.row.motor(new);
    let impulse = (new - speed) / k;
    joint.turn += impulse;
    a.angular_velocity -= ia.inertia * (axis * impulse);
    b.angular_velocity += ib.inertia * (axis * impulse);

    let (u, v) = axis.any_orthonormal_pair();
    let sum = ia.inertia + ib.inertia;
    let (su, sv) = (sum * u, sum * v);
    let (kuu, kuv, kvv) = (u.dot(su), u.dot(sv), v.dot(sv));
    let mut wanted = b.angular_velocity - a.angular_velocity;
    if BIAS {
        wanted += (axis.cross(child_axis) * soft.bias).clamp_length_max(MAX_BIAS);
    }
    let (wu, wv) = (u.dot(wanted), v.dot(wanted));
    let scale = -1.0 / (kuu * kvv - kuv * kuv);
    let mut impulse = u * (scale * (kvv * wu - kuv * wv)) + v * (scale * (kuu * wv - kuv * wu));
    if BIAS {
        impulse = impulse * soft.mass_scale - joint.align * soft.impulse_scale;
    }
    joint.align += impulse;
    a.angular_velocity -= ia.inertia * impulse;
    b.angular_velocity += ib.inertia * impulse;

    let mut wanted =
        b.linear_velocity + b.angular_velocity.cross(rb) - a.linear_velocity - a.angular_velocity.cross(ra);
    if BIAS {
        wanted += (gap * soft.bias).clamp_length_max(MAX_BIAS);
    }
    let mut impulse = -(joint.point_mass * wanted);
    if BIAS {
        impulse = impulse * soft.mass_scale - joint.point * soft.impulse_scale;
    }
    joint.point += impulse;
    a.linear_velocity -= impulse * ia.mass;
    a.angular_velocity -= ia.inertia * ra.cross(impulse);
    b.linear_velocity += impulse * ib.mass;
    b.angular_velocity += ib.inertia * rb.cross(impulse);
}
