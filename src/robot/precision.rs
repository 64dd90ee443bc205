//! Robots whose motion is lost in single precision: a part that is far away, or heavy, next to one
//! that turns easily.

use std::path::Path;

use glam::{DMat3, DVec3};

use super::error::{Diagnosis, RobotError};
use super::inertia::{MassProperties, principal_moments};
use super::merge::MAX_EXTENT;
use super::model::{JointKind, Model};

/// Least inertia that a joint or the base moves, over that of all that hangs on it. The engine
/// computes the former as a difference of numbers of the size of the latter, in single precision
/// (6e-8). States became infinite at up to 1.5e-5; known robots have 2e-3 or more.
const LEAST_SHARE: f64 = 2e-5;
/// Farthest link, m: limbs of a humanoid in millimetres reach a little farther than one length may.
const REACH: f64 = 2.0 * MAX_EXTENT;
/// Extent, m, mass, kg, and principal moment of a link, kg m^2, up to which any share is taken:
/// makers write token inertias for light links, and a chain of many links turns its first one
/// easily.
const LONG: f64 = 10.0;
const HEAVY: f64 = 1e3;
const BULKY: f64 = 3e4;

/// Checks the size of the whole robot with all joints at zero, and the precision of its inertia.
///
/// # Errors
/// [`RobotError::Value`] for links farther from the base than [`REACH`], [`RobotError::Inertia`]
/// for a robot that is too large or too heavy for its lightest part.
pub(super) fn check(model: &Model, file: &Path) -> Result<(), RobotError> {
    let poses = model.forward_kinematics(&[]);
    let distance = |link: usize| {
        let com = poses[link].transform_point(model.links[link].com);
        com.length().max(poses[link].translation.length())
    };
    let (farthest, extent) = (0..model.links.len())
        .map(|link| (link, distance(link)))
        .fold((0, 0.0), |most: (usize, f64), other| if other.1 > most.1 { other } else { most });
    let of_farthest = format!("link \"{}\"", model.links[farthest].name);
    if extent > REACH {
        let problem = format!("it lies {extent:.1} m from the base with all joints at zero, beyond {REACH} m");
        return Err(RobotError::Value(Diagnosis::new(file, of_farthest, problem, "write metres")));
    }
    let mass = model.total_mass();
    let is_bulky = model.links.iter().any(|link| principal_moments(&link.inertia)[2] > BULKY);
    if extent <= LONG && mass <= HEAVY && !is_bulky {
        return Ok(());
    }
    let least = Moved::least(model);
    if least.share() >= LEAST_SHARE {
        return Ok(());
    }
    let element = match least.joint {
        Some(joint) => format!("joint \"{}\"", model.joints[joint].name),
        None => format!("link \"{}\"", model.links[0].name),
    };
    let problem = format!(
        "single precision loses the {} that it moves next to the {} of all that hangs on it; the robot has {mass:.4} kg, and \
         {of_farthest} lies {extent:.4} m from the base",
        least.shown(least.own),
        least.shown(least.whole)
    );
    let remedy = "write lengths in metres (this looks like millimetres if they are large), kilograms and kg m^2";
    Err(RobotError::Inertia(Diagnosis::new(file, element, problem, remedy)))
}

/// Inertia that a joint, or the base, moves while all joints after it are free.
#[derive(Clone, Copy)]
struct Moved {
    /// `None`: the base.
    joint: Option<usize>,
    is_prismatic: bool,
    /// Inertia about the joint's axis, kg m^2; kg for a prismatic joint. `whole` is that of all
    /// that hangs on the joint as one body.
    own: f64,
    whole: f64,
}

impl Moved {
    fn share(&self) -> f64 {
        self.own / self.whole
    }

    fn shown(&self, inertia: f64) -> String {
        format!("{inertia:.1e} {}", if self.is_prismatic { "kg" } else { "kg m^2" })
    }

    /// The smallest share of a robot, with all joints at zero.
    fn least(model: &Model) -> Self {
        let poses = model.forward_kinematics(&[]);
        let bodies = model.links.iter().zip(&poses).map(|(link, pose)| {
            let own = MassProperties { mass: link.mass, com: link.com, inertia: link.inertia };
            own.transformed(pose)
        });
        let mut whole: Vec<MassProperties> = bodies.collect();
        let mut articulated: Vec<Articulated> =
            whole.iter().zip(&poses).map(|(body, pose)| Articulated::of(body, pose.translation)).collect();
        let mut found = Vec::with_capacity(poses.len());
        for (index, joint) in model.joints.iter().enumerate().rev() {
            let (link, parent) = (index + 1, joint.parent);
            let is_prismatic = joint.kind == JointKind::Prismatic;
            let axis = poses[link].rotation * joint.axis;
            let (own, rest) = articulated[link].released(axis, is_prismatic);
            let all = if is_prismatic { whole[link].mass } else { moment_about(&whole[link], poses[link].translation) };
            found.push(Self { joint: Some(index), is_prismatic, own, whole: all });
            let shifted = rest.shifted(poses[link].translation - poses[parent].translation);
            articulated[parent].add(&shifted);
            whole[parent] = whole[parent].joined(&whole[link]);
        }
        let base = articulated[0].turning();
        let all = moment_about(&whole[0], poses[0].translation);
        let of_base = Self { joint: None, is_prismatic: false, own: principal_moments(&base)[0], whole: all };
        found.into_iter().fold(of_base, |least, other| if least.share() < other.share() { least } else { other })
    }
}

/// Trace of the inertia about a point, kg m^2.
fn moment_about(body: &MassProperties, point: DVec3) -> f64 {
    let diagonal = body.inertia.x_axis.x + body.inertia.y_axis.y + body.inertia.z_axis.z;
    diagonal + 2.0 * body.mass * body.com.distance_squared(point)
}

/// Articulated inertia about a link's origin, in axes of the base: moment = turn w + couple v,
/// force = couple' w + shift v.
#[derive(Clone, Copy)]
struct Articulated {
    turn: DMat3,
    couple: DMat3,
    shift: DMat3,
}

impl Articulated {
    fn of(body: &MassProperties, origin: DVec3) -> Self {
        let cross = cross(body.com - origin);
        let couple = cross * body.mass;
        Self { turn: body.inertia - cross * couple, couple, shift: DMat3::from_diagonal(DVec3::splat(body.mass)) }
    }

    fn add(&mut self, other: &Self) {
        self.turn += other.turn;
        self.couple += other.couple;
        self.shift += other.shift;
    }

    /// Inertia about or along an axis, and the remaining inertia for the parent.
    fn released(&self, axis: DVec3, is_prismatic: bool) -> (f64, Self) {
        let (moment, force) = if is_prismatic {
            (self.couple * axis, self.shift * axis)
        } else {
            (self.turn * axis, self.couple.transpose() * axis)
        };
        let own = axis.dot(if is_prismatic { force } else { moment });
        let less = |from: DMat3, a: DVec3, b: DVec3| from - outer(a, b) * own.recip();
        let turn = less(self.turn, moment, moment);
        (own, Self { turn, couple: less(self.couple, moment, force), shift: less(self.shift, force, force) })
    }

    /// The inertia about a point from which the present one lies at `offset`.
    fn shifted(&self, offset: DVec3) -> Self {
        let r = cross(offset);
        Self {
            turn: self.turn - self.couple * r + r * self.couple.transpose() - r * self.shift * r,
            couple: self.couple + r * self.shift,
            shift: self.shift,
        }
    }

    /// Inertia of turning while the body is free to move.
    fn turning(&self) -> DMat3 {
        self.turn - self.couple * self.shift.inverse() * self.couple.transpose()
    }
}

/// The matrix that takes `b` to `a` x `b`.
fn cross(a: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, a.z, -a.y), DVec3::new(-a.z, 0.0, a.x), DVec3::new(a.y, -a.x, 0.0))
}

/// a b'.
fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}
