//! Position limits of legs that a URDF lets turn freely.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use crate::robot::{Model, Role, Roles};

/// Joints whose limits are this far apart turn freely, rad: URDFs without limits have -6.28 .. 6.28
/// or more.
const FREELY: f64 = 6.0;
/// Limits of such joints from where the leg hangs straight, rad, as in drawn bodies: abduction, and
/// hip and knee of a leg whose knee bends to the rear. A knee does not pass straight.
const ABDUCTION: [f64; 2] = [-0.9, 0.9];
const HIP: [f64; 2] = [-1.5, 3.4];
const KNEE: [f64; 2] = [-2.7, -0.3];

/// Assumed limits by slot, in its direction, rad, for joint positions `q` of a standing pose.
pub(super) fn assumed(model: &Model, roles: &Roles, q: &[f64]) -> BTreeMap<String, [f64; 2]> {
    // angle from where the leg hangs, less than half a turn
    let hanging = |at: usize| {
        let (position, zero) = (roles.sign_of_slot[at] * q[roles.joint_of_slot[at]], roles.zero_of_slot[at]);
        let angle = position - zero;
        angle - TAU * (angle / TAU).round()
    };
    let mut limits = BTreeMap::new();
    for limb in &roles.limbs {
        let knee = roles.slots.iter().position(|slot| slot.place == limb.place && slot.role == Role::Kfe);
        let bends_ahead = knee.is_some_and(|at| hanging(at) > 0.0);
        for (at, slot) in roles.slots.iter().enumerate().filter(|(_, slot)| slot.place == limb.place && slot.nth == 0) {
            let joint = &model.joints[roles.joint_of_slot[at]];
            let of_role = match slot.role {
                Role::Haa => ABDUCTION,
                Role::Hfe => HIP,
                Role::Kfe => KNEE,
                _ => continue,
            };
            let mirrored = bends_ahead && slot.role != Role::Haa;
            let [lower, upper] = if mirrored { [-of_role[1], -of_role[0]] } else { of_role };
            let angle = hanging(at);
            if joint.upper - joint.lower < FREELY || !(lower < angle && angle < upper) {
                continue;
            }
            let from = roles.sign_of_slot[at] * q[roles.joint_of_slot[at]] - angle;
            let rounded = |x: f64| (x * 1e3).round() / 1e3;
            limits.insert(slot.to_string(), [rounded(from + lower), rounded(from + upper)]);
        }
    }
    limits
}
