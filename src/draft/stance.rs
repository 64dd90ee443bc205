//! Standing poses of quadrupeds, from the URDF alone.

use std::ops::RangeInclusive;

use glam::{DMat3, DQuat, DVec3};

use super::quadruped::Legs;
use crate::config::EARTH_GRAVITY;
use crate::robot::{Joint, LEGS, Model, Pose};

/// Share of thigh and shank together by which the foot lies below the hip. This and the next two
/// are the pose in which most of the known quadrupeds are trained (thighs 0.8 rad to the rear in
/// front and 1.0 behind, knees bent by 1.5, legs 0.1 outwards: Isaac Lab), with all feet on one
/// level: a policy walks best from a pose that it knows. The second share is that of front and hind
/// knees which point to each other, and carry more the lower the body is: their makers have 0.83 to
/// 0.85.
const CROUCH: [f64; 2] = [0.72, 0.84];
/// Distance of front and hind feet behind their hips, as the same share.
const BEHIND: [f64; 2] = [0.037, 0.181];
/// Angles by which the legs lean outwards, rad: the usual one, and the largest one of a known
/// robot, to which they lean until the feet are apart.
const OUTWARD: [f64; 2] = [0.1, 0.25];
/// Least distance between left and right feet over the height of the centre of mass above the
/// soles. Most known quadrupeds have 1.0 to 1.5; narrower ones tip over as they turn.
const APART: f64 = 1.05;
/// Share of each joint's range that the pose keeps away from either end.
const MARGIN: f64 = 0.05;
/// Range of the search for a joint without limits, rad.
const TURN: f64 = std::f64::consts::PI;
/// Angles of thigh and knee that the search begins with, each.
const STARTS: u32 = 24;
const ITERATIONS: u32 = 60;
/// Number of times that the feet are moved below the centre of mass, which moves with them.
pub(super) const ROUNDS: u32 = 3;
/// Distance below which a foot has reached its place, m.
pub(super) const REACHED: f64 = 1e-3;
/// Gravity, m/s^2: a robot is drafted to stand on Earth.
pub(super) const GRAVITY: f64 = EARTH_GRAVITY;

/// A pose with bent knees in which all feet stand level, behind and outside the hips, about the
/// centre of mass.
pub(super) struct Stance {
    /// Joint angles by canonical slot, rad.
    pub angles: [f64; 12],
    /// Distance of each foot from where it should be, m.
    pub misses: [f64; 4],
    /// Height of the base frame above the feet's soles, m.
    pub height: f64,
    /// Mean length of thigh and shank together, m.
    pub leg_length: f64,
    /// Largest torque that the joints of each role bear while each foot carries a quarter of the
    /// weight, N m.
    pub torques: [f64; 3],
}

impl Stance {
    pub fn find(model: &Model, roles: &Legs) -> Self {
        let legs: [Leg; 4] = std::array::from_fn(|leg| Leg::new(model, roles, leg));
        let stance = Self::find_at(model, roles, &legs, CROUCH[0]);
        let mut q = vec![0.0; model.joints.len()];
        roles.joint_of_slot.iter().zip(stance.angles).for_each(|(&joint, angle)| q[joint] = angle);
        let links = model.forward_kinematics(&q);
        // front and hind knees point to each other
        if legs.iter().enumerate().all(|(index, leg)| leg.knee_is_behind(&links) == (index % 2 == 0)) {
            return Self::find_at(model, roles, &legs, CROUCH[1]);
        }
        stance
    }

    /// The stance whose feet lie below the hips by a share of thigh and shank together.
    fn find_at(model: &Model, roles: &Legs, legs: &[Leg; 4], crouch: f64) -> Self {
        // the shortest leg says how high the robot stands
        let ground =
            legs.iter().map(|leg| leg.hip.z - crouch * leg.length - leg.radius).fold(f64::NEG_INFINITY, f64::max);
        let hips = legs.iter().map(|leg| leg.hip.x).sum::<f64>() / 4.0;
        let leg_length = legs.iter().map(|leg| leg.length).sum::<f64>() / 4.0;
        let mut q = vec![0.0; model.joints.len()];
        let mut misses = [0.0; 4];
        let (mut shift, mut apart) = (0.0, 0.0);
        for _ in 0..ROUNDS {
            for (index, (leg, miss)) in legs.iter().zip(&mut misses).enumerate() {
                let behind = BEHIND[index % 2] * leg.length;
                let side = leg.hip.y.signum();
                let [usual, most] = OUTWARD.map(|angle| angle.sin() * crouch * leg.length);
                let wide = (0.5 * apart - side * leg.track).clamp(usual, most);
                let mut stand = |outward: f64| {
                    let left = leg.track + side * outward;
                    leg.solve(model, DVec3::new(leg.hip.x + shift - behind, left, ground + leg.radius), &mut q)
                };
                *miss = stand(wide);
                if *miss >= REACHED && wide > usual {
                    // its limits end before
                    *miss = stand(usual);
                }
            }
            let furthest = 0.2 * leg_length;
            let centre = centre_of_mass(model, &q);
            // the hips of a balanced robot lie about its centre of mass
            shift = (centre.x - hips).clamp(-furthest, furthest);
            apart = APART * (centre.z - ground);
        }
        let angles = roles.joint_of_slot.map(|joint| q[joint]);
        Self { angles, misses, height: -ground, leg_length, torques: torques(model, legs, &q) }
    }
}

/// A leg, with the place for its foot.
struct Leg {
    joints: [usize; 3],
    foot_link: usize,
    foot_point: DVec3,
    radius: f64,
    /// The hip flexion joint with the leg upright, between left and right at the axis of abduction,
    /// base frame, m.
    hip: DVec3,
    /// Length of thigh and shank together, m.
    length: f64,
    /// Distance of the foot to the left of the base when the leg stands upright, m.
    track: f64,
}

impl Leg {
    fn new(model: &Model, roles: &Legs, leg: usize) -> Self {
        let joints = [leg, leg + 4, leg + 8].map(|slot| roles.joint_of_slot[slot]);
        let foot = &model.bodies[roles.foot_body[leg]];
        let zero = model.forward_kinematics(&[]);
        let at = joints.map(|joint| zero[joint + 1].translation);
        let tip = zero[foot.link].transform_point(roles.foot_point[leg]);
        // in the plane that thigh and shank move in
        let across = zero[joints[1] + 1].rotation * model.joints[joints[1]].axis;
        let across = across * across.y.signum();
        // with that plane upright; the thigh may begin below the axis of abduction
        let upright = DQuat::from_rotation_x(-across.z.atan2(across.y));
        let drop = (upright * (at[1] - at[0])).z;
        let sideways = (tip - at[0]).dot(across);
        let flat = |v: DVec3| (v - across * v.dot(across)).length();
        Self {
            joints,
            foot_link: foot.link,
            foot_point: roles.foot_point[leg],
            radius: roles.foot_radius[leg],
            hip: DVec3::new(at[1].x, at[0].y, at[0].z + drop),
            length: flat(at[2] - at[1]) + flat(tip - at[2]),
            track: at[0].y + sideways,
        }
    }

    fn foot(&self, links: &[Pose]) -> DVec3 {
        links[self.foot_link].transform_point(self.foot_point)
    }

    /// Writes the angles to `q` for which the foot is nearest to `target`; knees bend to the rear
    /// where they can. Returns the remaining distance, m.
    fn solve(&self, model: &Model, target: DVec3, q: &mut [f64]) -> f64 {
        let ranges = self.joints.map(|joint| range(model, joint));
        let mut solutions: Vec<(bool, f64, [f64; 3])> = Vec::new();
        for rear in [true, false] {
            let start = self.start(model, target, &ranges, rear, q);
            if let Some(start) = start {
                let (angles, miss) = self.refine(model, target, &ranges, start, q);
                self.joints.iter().zip(angles).for_each(|(&joint, angle)| q[joint] = angle);
                solutions.push((self.knee_is_behind(&model.forward_kinematics(q)), miss, angles));
            }
        }
        let reached = |solution: &&(bool, f64, [f64; 3])| solution.1 < REACHED;
        let best = solutions
            .iter()
            .filter(reached)
            .find(|(rear, ..)| *rear)
            .or_else(|| solutions.iter().min_by(|a, b| a.1.total_cmp(&b.1)));
        // the search over the whole of both ranges always finds a nearest start
        let (_, miss, angles) = best.copied().unwrap_or((true, f64::INFINITY, [0.0; 3]));
        self.joints.iter().zip(angles).for_each(|(&joint, angle)| q[joint] = angle);
        miss
    }

    fn knee_is_behind(&self, links: &[Pose]) -> bool {
        let [_, hip, knee] = self.joints.map(|joint| links[joint + 1].translation);
        let foot = self.foot(links);
        // to the rear of the line from hip to foot
        let along = (knee.z - hip.z) / (foot.z - hip.z).min(-1e-9);
        knee.x < hip.x + along * (foot.x - hip.x)
    }

    /// The nearest of a grid of angles with the knee on the wanted side.
    fn start(
        &self,
        model: &Model,
        target: DVec3,
        ranges: &[RangeInclusive<f64>; 3],
        rear: bool,
        q: &[f64],
    ) -> Option<[f64; 3]> {
        let mut q = q.to_vec();
        let mut best: Option<(f64, [f64; 3])> = None;
        let abduction = 0.0_f64.clamp(*ranges[0].start(), *ranges[0].end());
        for i in 0..=STARTS {
            for j in 0..=STARTS {
                let angles = [abduction, at(&ranges[1], i), at(&ranges[2], j)];
                self.joints.iter().zip(angles).for_each(|(&joint, angle)| q[joint] = angle);
                let links = model.forward_kinematics(&q);
                let miss = self.foot(&links).distance(target);
                if self.knee_is_behind(&links) == rear && best.is_none_or(|(least, _)| miss < least) {
                    best = Some((miss, angles));
                }
            }
        }
        best.map(|(_, angles)| angles)
    }

    /// Damped Gauss-Newton steps within the ranges.
    fn refine(
        &self,
        model: &Model,
        target: DVec3,
        ranges: &[RangeInclusive<f64>; 3],
        start: [f64; 3],
        q: &[f64],
    ) -> ([f64; 3], f64) {
        let mut q = q.to_vec();
        let mut miss_at = |angles: [f64; 3]| {
            self.joints.iter().zip(angles).for_each(|(&joint, angle)| q[joint] = angle);
            let links = model.forward_kinematics(&q);
            let foot = self.foot(&links);
            let columns = self.joints.map(|joint| {
                let link = &links[joint + 1];
                (link.rotation * model.joints[joint].axis).cross(foot - link.translation)
            });
            (target - foot, DMat3::from_cols(columns[0], columns[1], columns[2]))
        };
        let (mut angles, mut damping) = (start, 1e-3);
        let (mut error, mut jacobian) = miss_at(angles);
        for _ in 0..ITERATIONS {
            let normal = jacobian.transpose() * jacobian + DMat3::IDENTITY * (damping * self.length * self.length);
            let step = (normal.inverse() * (jacobian.transpose() * error)).to_array();
            let next = std::array::from_fn(|i| (angles[i] + step[i]).clamp(*ranges[i].start(), *ranges[i].end()));
            let (next_error, next_jacobian) = miss_at(next);
            if next_error.length() < error.length() {
                (angles, error, jacobian) = (next, next_error, next_jacobian);
                damping *= 0.1;
            } else {
                damping *= 10.0;
            }
        }
        (angles, error.length())
    }
}

/// The position nearest to 0 that a joint can have, rad or m.
pub(super) fn nearest_to_zero(joint: &Joint) -> f64 {
    0.0_f64.max(joint.lower).min(joint.upper)
}

/// Range of a joint in the search, rad.
pub(super) fn range(model: &Model, joint: usize) -> RangeInclusive<f64> {
    let joint = &model.joints[joint];
    let (lower, upper) = (joint.lower.max(-TURN), joint.upper.min(TURN));
    if lower > upper {
        // limits beyond a turn
        return nearest_to_zero(joint)..=nearest_to_zero(joint);
    }
    let margin = MARGIN * (upper - lower);
    lower + margin..=upper - margin
}

fn at(range: &RangeInclusive<f64>, step: u32) -> f64 {
    range.start() + (range.end() - range.start()) * f64::from(step) / f64::from(STARTS)
}

/// Centre of mass in the base frame, m.
pub(super) fn centre_of_mass(model: &Model, q: &[f64]) -> DVec3 {
    let links = model.forward_kinematics(q);
    let moment: DVec3 =
        model.links.iter().zip(&links).map(|(link, pose)| pose.transform_point(link.com) * link.mass).sum();
    moment / model.total_mass()
}

fn torques(model: &Model, legs: &[Leg; 4], q: &[f64]) -> [f64; 3] {
    let links = model.forward_kinematics(q);
    let force = DVec3::Z * (model.total_mass() * GRAVITY / LEGS.len() as f64);
    let of = |leg: &Leg, role: usize| {
        let joint = leg.joints[role];
        let link = &links[joint + 1];
        let axis = link.rotation * model.joints[joint].axis;
        axis.dot((leg.foot(&links) - link.translation).cross(force)).abs()
    };
    std::array::from_fn(|role| legs.iter().map(|leg| of(leg, role)).fold(0.0, f64::max))
}
