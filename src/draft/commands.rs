//! Command ranges of a draft, from the legs' length and from how their joints move the feet.

use glam::DVec3;

use crate::robot::{JointKind, LimbKind, Model, Role, Roles};

use super::round;
use super::stance::GRAVITY;

/// Froude number v^2 / (g L) of the fastest command ahead: a brisk walk or a trot, as in the
/// training of drawn bodies and of robots in `configs/robots`.
const FROUDE: f64 = 0.25;
/// Shares of that speed backwards and sideways: of quadrupeds, of two legs, and of legs that point
/// away from the body, whose share ahead is the third.
const BACKWARDS: [f64; 3] = [1.0, 0.5, 0.6];
const SIDEWAYS: [f64; 3] = [1.0, 0.4, 0.4];
const AHEAD: [f64; 3] = [1.0, 1.0, 0.6];
/// Yaw rate of legs that step sideways or turn about z, and of legs that turn the body by steps of
/// unequal length, rad/s.
const TURN: f64 = 1.0;
const SKID: f64 = 0.5;
/// A joint moves a foot sideways if it moves it by this share of the leg's length per rad.
const MOVES: f64 = 0.3;

/// A box of commands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Commands {
    /// Speeds backwards and ahead, m/s.
    pub ahead: [f64; 2],
    /// Speed to either side, m/s; 0 for legs that cannot spread.
    pub aside: f64,
    /// Yaw rate to either side, rad/s; 0 for two legs that neither spread nor turn.
    pub turn: f64,
}

impl Commands {
    /// Commands for a body on legs of this length, m, at joint positions `q`.
    pub fn new(model: &Model, roles: &Roles, leg_length: f64, q: &[f64]) -> Self {
        let links = model.forward_kinematics(q);
        let legs = || roles.limbs.iter().filter(|limb| limb.kind == LimbKind::Leg);
        let has = |role: Role| legs().all(|leg| leg.joints.iter().any(|own| own.slot.role == role));
        let spreads = legs().all(|leg| {
            let Some(foot) = leg.foot else { return false };
            let tip = links[model.bodies[foot.body].link].transform_point(foot.point);
            leg.joints.iter().any(|own| {
                let (joint, link) = (&model.joints[own.joint], &links[own.joint + 1]);
                let axis = link.rotation * joint.axis;
                let moved =
                    if joint.kind == JointKind::Prismatic { DVec3::ZERO } else { axis.cross(tip - link.translation) };
                !matches!(own.slot.role, Role::Wheel | Role::Toe) && moved.y.abs() >= MOVES * leg_length
            })
        });
        let kind = match roles.legs.len() {
            2 => 1,
            4 if !has(Role::HipLift) => 0,
            _ => 2,
        };
        let speed = (FROUDE * GRAVITY * leg_length).sqrt();
        let turn = match (spreads || has(Role::HipYaw), roles.legs.len()) {
            (true, _) => TURN,
            (false, 2) => 0.0,
            (false, _) => SKID,
        };
        Self {
            ahead: [-round(BACKWARDS[kind] * speed), round(AHEAD[kind] * speed)],
            aside: if spreads { round(SIDEWAYS[kind] * speed) } else { 0.0 },
            turn,
        }
    }

    /// Note for people that names the commands which the body cannot follow.
    pub fn note(&self) -> Option<&'static str> {
        match (self.aside > 0.0, self.turn > 0.0) {
            (true, _) => None,
            (false, true) => Some("no joint moves the feet sideways: the robot is not asked for side-steps"),
            (false, false) => Some(
                "no joint moves the feet sideways or turns them: the robot is asked for neither side-steps nor turns",
            ),
        }
    }
}
