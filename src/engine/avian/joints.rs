//! Revolute joints as velocity constraints between rigid bodies, solved in turn with Avian's
//! contacts.
//!
//! The joints of a robot form a tree, so all of them are solved at once, exactly: articulated
//! inertias are summed from the leaves to the base, and changes of velocity handed on from the base
//! to the leaves (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 7.3, for impulses).
//! Gains, damping and rotors are implicit parts of that solution. Dry friction and position limits
//! are impulses that every solution corrects for the next one.

use std::f64::consts::TAU;

use avian3d::dynamics::solver::solver_body::SolverBody;
use bevy_ecs::prelude::Resource;
use bevy_math::{Mat3, Quat, Vec3};

use crate::dynamics::{EffortTable, Parameters, Topology};

/// Share of an anchor's gap, of an axis's misalignment and of a limit's violation that is taken
/// back in a substep.
const TAKEN_BACK: f32 = 0.2;
/// Share of a substep by which the stiffness looks ahead. From 1/4 on every stiffness is stable; 1
/// is backward Euler.
const LOOK_AHEAD: f32 = 0.36;
/// Share of `h^2 k` of a spring that acts as inertia: stable for every stiffness, without numerical
/// damping.
const AVERAGE_ACCELERATION: f32 = 0.25;
/// Links that came apart return at no more than this, m/s or rad/s.
const MAX_RETURN: f32 = 4.0;
/// Share of the inertia behind a joint that corrections of its bounds assume: the links before the
/// joint yield, too.
const BOUND_MASS: f32 = 0.4;

/// Impulses about a joint's axis over one substep.
#[derive(Clone, Copy, Debug, Default)]
struct AxisRow {
    /// Actuator impulse at zero speed, N m s.
    drive: f32,
    /// Impulse that the actuator loses per speed, N m s^2; zero at the actuator's limits.
    slope: f32,
    /// Rotor inertia, viscous damping and the spring's implicit share, kg m^2.
    drag: f32,
    /// Rotor inertia and the spring's implicit share times the speed before, and the spring's
    /// impulse, N m s.
    momentum: f32,
    /// Largest impulse of dry friction, N m s.
    friction: f32,
}

/// Numbers of one joint of one robot.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct JointNumbers {
    stiffness: f32,
    damping: f32,
    effort_limit: f32,
    armature: f32,
    saturation: f32,
    motor_velocity_limit: f32,
    joint_damping: f32,
    /// Stiffness, N m/rad, and angle at rest, rad.
    spring: [f32; 2],
    friction: f32,
    lower: f32,
    upper: f32,
    velocity_limit: f32,
    /// Way from the parent's origin to the anchor, in the parent's axes, m.
    offset: Vec3,
    /// Ways from the centres of mass of parent and child to the anchor, in the link's axes, m.
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
            spring: p.spring.get(j).map_or([0.0; 2], |spring| spring.map(|x| x as f32)),
            friction: p.joint_friction[j] as f32,
            lower: p.lower[j] as f32,
            upper: p.upper[j] as f32,
            velocity_limit: p.velocity_limit[j] as f32,
            offset: vector(p.joint_offset[j]),
            anchors: [vector(from_com), -vector(p.com[j + 1])],
        }
    }
}

/// Places of a joint's parts, in world axes.
#[derive(Clone, Copy, Default)]
struct Geometry {
    /// Way from the parent's anchor to the child's, m.
    gap: Vec3,
    /// Ways from the links' centres of mass to their anchors, m.
    arms: [Vec3; 2],
    /// The axis as the parent and the child have it.
    axes: [Vec3; 2],
}

/// A symmetric 6 x 6 matrix: what turns, how turning and moving are coupled, what moves.
#[derive(Clone, Copy)]
pub(super) struct Inertia {
    turn: Mat3,
    couple: Mat3,
    shift: Mat3,
}

impl Default for Inertia {
    fn default() -> Self {
        Self::ZERO
    }
}

/// A velocity or an impulse about some point.
#[derive(Clone, Copy, Default)]
pub(super) struct Twist {
    ang: Vec3,
    lin: Vec3,
}

/// One joint of one robot.
#[derive(Clone, Copy, Default)]
pub(super) struct Joint {
    pub(super) numbers: JointNumbers,
    /// Target position, rad.
    pub(super) target: f32,
    /// Feed-forward effort, N m.
    pub(super) feedforward: f32,
    /// Position and velocity at the end of the last physics step, rad and rad/s.
    pub(super) position: f64,
    pub(super) velocity: f64,
    /// Mean effort of the actuator in the last physics step, N m.
    pub(super) effort: f32,
    /// Impulses of dry friction and of the bounds in a substep, N m s.
    rub: f32,
    bound: f32,
    /// Impulse about the axis so far in the present substep, N m s.
    applied: f32,
    /// Speed that the joints were last solved for, rad/s: the rotor's. Contacts change that of the
    /// links alone.
    rotor: f32,
    row: AxisRow,
    start: Geometry,
    now: Geometry,
    /// Position in the present substep, rad.
    angle: f32,
    /// Way from the parent's reference point to its anchor, m.
    reach: Vec3,
    /// Inertia of the child and all that it carries, about the anchor, with the joint free to give
    /// way.
    carried: Inertia,
    /// Impulse at the anchor per speed of the joint, and one over its part along the axis.
    push: Twist,
    inverse: f32,
    /// Speed that the impulses on the joint and on what it carries give it.
    share: f32,
}

impl Joint {
    /// Forgets the impulses of the last step.
    pub(super) fn forget(&mut self) {
        (self.rub, self.bound) = (0.0, 0.0);
        self.rotor = self.velocity as f32;
    }

    /// Impulses of dry friction and bounds (N m s) and the rotor's speed (rad/s), with which the
    /// next step begins.
    pub(super) fn kept(&self) -> [f32; 3] {
        [self.rub, self.bound, self.rotor]
    }

    /// Goes on from there.
    pub(super) fn keep(&mut self, [rub, bound, rotor]: [f32; 3]) {
        (self.rub, self.bound, self.rotor) = (rub, bound, rotor);
    }

    /// Speed about the axis.
    fn speed(&self, a: &SolverBody, b: &SolverBody) -> f32 {
        self.now.axes[0].dot(b.angular_velocity - a.angular_velocity)
    }
}

/// Mass properties of a link at the beginning of a physics step, world axes.
#[derive(Clone, Copy, Default)]
pub(super) struct LinkMass {
    pub(super) mass: f32,
    pub(super) inertia: Mat3,
}

/// A link's pose at the beginning of a physics step.
#[derive(Clone, Copy)]
pub(super) struct LinkPose {
    pub(super) position: Vec3,
    pub(super) rotation: Quat,
}

/// External force and torque on a base, base axes.
#[derive(Clone, Copy, Default, PartialEq)]
pub(super) struct Wrench {
    /// Force at the centre of mass, N.
    pub(super) force: Vec3,
    /// Torque, N m.
    pub(super) torque: Vec3,
}

/// A force and a torque on a link from outside.
#[derive(Clone, Copy)]
pub(super) struct Pull {
    /// Number of the link among those of all robots.
    pub(super) body: usize,
    /// Whether the wrench is in world axes; else it turns with the link.
    pub(super) in_world: bool,
    /// Way from the link's centre of mass to where the force acts, link axes, m.
    pub(super) arm: Vec3,
    pub(super) wrench: Wrench,
}

/// The joints of all robots of a world.
#[derive(Resource, Default)]
pub(super) struct Joints {
    /// Whether bases move.
    pub(super) floating: bool,
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
    /// `[robots * joints]`.
    pub(super) all: Vec<Joint>,
    /// `[robots]`, and the rotations of the bases at the beginning of the physics step.
    pub(super) wrenches: Vec<Wrench>,
    pub(super) rotations: Vec<Quat>,
    /// Forces on links, in the order of the links, and the rotations of these at the beginning of
    /// the physics step.
    pub(super) pulls: Vec<Pull>,
    pub(super) pulled: Vec<Quat>,
    /// `[robots * links]`.
    pub(super) masses: Vec<LinkMass>,
    /// Inverse articulated inertia of each base, `[robots]`.
    pub(super) bases: Vec<Inertia>,
    /// Scratch memory, `[links]`.
    pub(super) inertias: Vec<Inertia>,
    pub(super) twists: Vec<Twist>,
}

/// The matrix of `v x`.
fn skew(v: Vec3) -> Mat3 {
    Mat3::from_cols(v.cross(Vec3::X), v.cross(Vec3::Y), v.cross(Vec3::Z))
}

/// `a b^T`.
fn outer(a: Vec3, b: Vec3) -> Mat3 {
    Mat3::from_cols(a * b.x, a * b.y, a * b.z)
}

impl Inertia {
    const ZERO: Self = Self { turn: Mat3::ZERO, couple: Mat3::ZERO, shift: Mat3::ZERO };

    /// A body about a point that is `arm` from its centre of mass.
    fn of_body(body: &LinkMass, arm: Vec3) -> Self {
        let arm = skew(arm);
        let couple = arm * -body.mass;
        Self { turn: body.inertia + arm * couple, couple, shift: Mat3::from_diagonal(Vec3::splat(body.mass)) }
    }

    /// The body about a point from which the present one is `reach` away.
    fn moved(&self, reach: Vec3) -> Self {
        let r = skew(reach);
        let couple = self.couple + r * self.shift;
        Self { turn: self.turn + r * self.couple.transpose() - couple * r, couple, shift: self.shift }
    }

    fn plus(&self, other: &Self) -> Self {
        Self { turn: self.turn + other.turn, couple: self.couple + other.couple, shift: self.shift + other.shift }
    }

    fn apply(&self, v: &Twist) -> Twist {
        Twist {
            ang: self.turn * v.ang + self.couple * v.lin,
            lin: self.couple.transpose() * v.ang + self.shift * v.lin,
        }
    }

    fn inverse(&self) -> Self {
        let shift = self.shift.inverse();
        let mixed = self.couple * shift;
        let turn = (self.turn - mixed * self.couple.transpose()).inverse();
        let couple = -(turn * mixed);
        Self { turn, couple, shift: shift - mixed.transpose() * couple }
    }
}

impl Joints {
    fn num_joints(&self) -> usize {
        self.parents.len()
    }

    /// Takes up the poses at the beginning of a physics step.
    pub(super) fn prepare(&mut self, poses: &[LinkPose]) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        self.rotations.clear();
        self.rotations.extend(poses.iter().step_by(links).map(|pose| pose.rotation));
        self.pulled.clear();
        self.pulled.extend(self.pulls.iter().map(|pull| poses[pull.body].rotation));
        self.bases.resize(poses.len() / links, Inertia::default());
        self.inertias.resize(links, Inertia::default());
        self.twists.resize(links, Twist::default());
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let poses = &poses[robot * links..(robot + 1) * links];
            for (j, joint) in chunk.iter_mut().enumerate() {
                let [a, b] = [&poses[self.parents[j]], &poses[j + 1]];
                let arms = [a.rotation * joint.numbers.anchors[0], b.rotation * joint.numbers.anchors[1]];
                // the child's anchor is its origin
                let gap = b.position - (a.position + a.rotation * joint.numbers.offset);
                joint.start = Geometry { gap, arms, axes: [a.rotation * self.axes[j], b.rotation * self.axes[j]] };
                joint.angle = joint.position as f32;
                joint.effort = 0.0;
            }
        }
    }

    /// One substep of what acts on bases and links from outside; the joints hand it on to the other
    /// links.
    pub(super) fn push(&self, bodies: &mut [SolverBody]) {
        let links = self.num_joints() + 1;
        let at_rest = Wrench::default();
        for (robot, wrench) in self.wrenches.iter().enumerate().filter(|(_, w)| self.floating && **w != at_rest) {
            let base = &mut bodies[robot * links];
            let (own, turn) = (&self.masses[robot * links], base.delta_rotation * self.rotations[robot]);
            base.linear_velocity += turn * wrench.force * (self.h / own.mass);
            base.angular_velocity += own.inertia.inverse() * (turn * wrench.torque) * self.h;
        }
        for (pull, rotation) in self.pulls.iter().zip(&self.pulled) {
            let (body, own) = (&mut bodies[pull.body], &self.masses[pull.body]);
            // a base that cannot move
            if !self.floating && pull.body % links == 0 {
                continue;
            }
            let turn = body.delta_rotation * *rotation;
            let Wrench { force, torque } = pull.wrench;
            let (force, torque) = if pull.in_world { (force, torque) } else { (turn * force, turn * torque) };
            body.linear_velocity += force * (self.h / own.mass);
            body.angular_velocity += own.inertia.inverse() * (torque + (turn * pull.arm).cross(force)) * self.h;
        }
    }

    /// Takes up where the bodies are, what the actuators do in this substep, and the articulated
    /// inertias.
    pub(super) fn begin(&mut self, bodies: &[SolverBody], first: bool) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        let (h, gains) = (self.h, self.gains);
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let bodies = &bodies[robot * links..(robot + 1) * links];
            let masses = &self.masses[robot * links..(robot + 1) * links];
            self.inertias[0] = Inertia::of_body(&masses[0], Vec3::ZERO);
            for (j, joint) in chunk.iter_mut().enumerate() {
                let (a, b) = (&bodies[self.parents[j]], &bodies[j + 1]);
                let start = &joint.start;
                let arms = [a.delta_rotation * start.arms[0], b.delta_rotation * start.arms[1]];
                let moved = b.delta_position - a.delta_position;
                joint.now = Geometry {
                    gap: start.gap + moved + (arms[1] - start.arms[1]) - (arms[0] - start.arms[0]),
                    arms,
                    axes: [a.delta_rotation * start.axes[0], b.delta_rotation * start.axes[1]],
                };
                self.inertias[j + 1] = Inertia::of_body(&masses[j + 1], arms[1]);
                let speed = joint.rotor;
                let explicit = self.explicit[j];
                if first || !explicit {
                    joint.actuate(self.tables[j].as_ref(), speed, gains, explicit, h);
                }
                let n = &joint.numbers;
                joint.row.drag = n.armature + h * n.joint_damping;
                joint.row.momentum = n.armature * speed;
                joint.row.friction = h * n.friction;
                let [stiffness, rest] = n.spring;
                if stiffness > 0.0 {
                    let share = AVERAGE_ACCELERATION * h * h * stiffness;
                    joint.row.drag += share;
                    joint.row.momentum += share * speed + h * stiffness * (rest - joint.angle);
                }
                joint.applied = 0.0;
            }
            for j in (0..joints).rev() {
                let parent = self.parents[j];
                let own_arm = parent.checked_sub(1).map_or(Vec3::ZERO, |p| chunk[p].now.arms[1]);
                let joint = &mut chunk[j];
                let whole = self.inertias[j + 1];
                let axis = joint.now.axes[0];
                let push = Twist { ang: whole.turn * axis, lin: whole.couple.transpose() * axis };
                let inverse = 1.0 / (axis.dot(push.ang) + joint.row.slope + joint.row.drag);
                let (ang, lin) = (push.ang * inverse, push.lin * inverse);
                joint.carried = Inertia {
                    turn: whole.turn - outer(ang, push.ang),
                    couple: whole.couple - outer(ang, push.lin),
                    shift: whole.shift - outer(lin, push.lin),
                };
                joint.reach = joint.now.arms[0] - own_arm;
                (joint.push, joint.inverse) = (push, inverse);
                self.inertias[parent] = self.inertias[parent].plus(&joint.carried.moved(joint.reach));
            }
            self.bases[robot] = if self.floating { self.inertias[0].inverse() } else { Inertia::default() };
        }
    }

    /// Changes the velocities so that the joints hold, with `bias` also taking back what they came
    /// apart.
    pub(super) fn solve(&mut self, bodies: &mut [SolverBody], bias: bool) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        let back = if bias { TAKEN_BACK / self.h } else { 0.0 };
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let bodies = &mut bodies[robot * links..(robot + 1) * links];
            let twists = &mut self.twists;
            twists.fill(Twist::default());
            for (j, joint) in chunk.iter_mut().enumerate().rev() {
                let parent = self.parents[j];
                let (a, b) = (&bodies[parent], &bodies[j + 1]);
                let Geometry { gap, arms: [ra, rb], axes: [axis, child_axis] } = joint.now;
                let speed = joint.speed(a, b);
                let apart =
                    b.linear_velocity + b.angular_velocity.cross(rb) - a.linear_velocity - a.angular_velocity.cross(ra);
                let askew = b.angular_velocity - a.angular_velocity - axis * speed;
                let error = Twist {
                    ang: -(askew + (axis.cross(child_axis) * back).clamp_length_max(MAX_RETURN)),
                    lin: -(apart + (gap * back).clamp_length_max(MAX_RETURN)),
                };
                let row = &joint.row;
                let missing =
                    row.drive + row.momentum + joint.rub + joint.bound - (row.slope + row.drag) * speed - joint.applied;
                let own = twists[j + 1];
                let along = axis.dot(own.ang) + missing;
                let share = along * joint.inverse;
                let resist = joint.carried.apply(&error);
                let up = Twist {
                    ang: own.ang - joint.push.ang * share - resist.ang,
                    lin: own.lin - joint.push.lin * share - resist.lin,
                };
                let to = &mut twists[parent];
                to.ang += up.ang + joint.reach.cross(up.lin);
                to.lin += up.lin;
                // kept for the way back
                twists[j + 1] = error;
                joint.share = share;
            }
            let base = self.bases[robot].apply(&twists[0]);
            twists[0] = base;
            bodies[0].angular_velocity += base.ang;
            bodies[0].linear_velocity += base.lin;
            for (j, joint) in chunk.iter_mut().enumerate() {
                let from = twists[self.parents[j]];
                let error = twists[j + 1];
                let given =
                    Twist { ang: from.ang + error.ang, lin: from.lin + from.ang.cross(joint.reach) + error.lin };
                let faster =
                    joint.share - joint.inverse * (joint.push.ang.dot(given.ang) + joint.push.lin.dot(given.lin));
                let twist = Twist { ang: given.ang + joint.now.axes[0] * faster, lin: given.lin };
                twists[j + 1] = twist;
                let b = &mut bodies[j + 1];
                b.angular_velocity += twist.ang;
                b.linear_velocity += twist.lin - twist.ang.cross(joint.now.arms[1]);
            }
            for (j, joint) in chunk.iter_mut().enumerate() {
                let speed = joint.speed(&bodies[self.parents[j]], &bodies[j + 1]);
                joint.correct(speed, self.h, back);
            }
        }
    }

    /// Follows the joints to where their velocities have taken them.
    pub(super) fn advance(&mut self, bodies: &[SolverBody]) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let bodies = &bodies[robot * links..(robot + 1) * links];
            for (j, joint) in chunk.iter_mut().enumerate() {
                joint.angle += self.h * joint.speed(&bodies[self.parents[j]], &bodies[j + 1]);
            }
        }
    }

    /// Adds up the efforts of the substep.
    pub(super) fn add_efforts(&mut self, bodies: &[SolverBody]) {
        let (joints, links) = (self.num_joints(), self.num_joints() + 1);
        for (robot, chunk) in self.all.chunks_mut(joints.max(1)).enumerate() {
            let bodies = &bodies[robot * links..(robot + 1) * links];
            for (j, joint) in chunk.iter_mut().enumerate() {
                let speed = joint.speed(&bodies[self.parents[j]], &bodies[j + 1]);
                joint.effort += joint.row.drive - joint.row.slope * speed;
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

impl Joint {
    /// Gains and feed-forward effort within the motor's torque-speed line and the effort limit (or
    /// its table): implicit inside them, explicit beyond, as in the articulated engine.
    fn actuate(&mut self, table: Option<&EffortTable>, speed: f32, gains: bool, explicit: bool, h: f32) {
        let n = &self.numbers;
        let limit = match table {
            Some(table) => n.effort_limit * table.limit_at(self.angle),
            None => n.effort_limit,
        };
        let line = speed / n.motor_velocity_limit;
        let most = (n.saturation * (1.0 - line)).min(limit).max(0.0);
        let least = (n.saturation * (-1.0 - line)).max(-limit).min(0.0);
        let (kp, kd) = if gains { (n.stiffness, n.damping) } else { (0.0, 0.0) };
        let at_rest = kp * (self.target - self.angle) + self.feedforward;
        let slope = if explicit { kd } else { kd + kp * LOOK_AHEAD * h };
        let wanted = at_rest - slope * speed;
        let effort = wanted.min(most).max(least);
        (self.row.drive, self.row.slope) =
            if explicit || effort != wanted { (h * effort, 0.0) } else { (h * at_rest, h * slope) };
    }

    /// Corrects dry friction and bounds by the speed that the last solution came to.
    fn correct(&mut self, speed: f32, h: f32, back: f32) {
        let (n, row) = (&self.numbers, &self.row);
        self.rotor = speed;
        self.applied = row.drive + row.momentum + self.rub + self.bound - (row.slope + row.drag) * speed;
        let mass = BOUND_MASS / self.inverse;
        self.rub = (self.rub - mass * speed).min(row.friction).max(-row.friction);
        // a bound may be reached within the substep; beyond it the joint returns
        let (to_lower, to_upper) = (n.lower - self.angle, n.upper - self.angle);
        let low = if to_lower <= 0.0 { to_lower / h } else { (to_lower * back).min(MAX_RETURN) };
        let high = if to_upper >= 0.0 { to_upper / h } else { (to_upper * back).max(-MAX_RETURN) };
        let (low, high) = (low.max(-n.velocity_limit), high.min(n.velocity_limit));
        // positive at the lower bound, negative at the upper one
        let at_low = (self.bound + mass * (low - speed)).max(0.0);
        let at_high = (self.bound + mass * (high - speed)).min(0.0);
        self.bound = at_low + at_high;
    }
}
