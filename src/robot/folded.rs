//! Legs of quadrupeds that are folded with all joints at zero.

use std::f64::consts::{PI, TAU};

use glam::DVec3;

use super::chains::ZeroPose;
use super::limbs::{LimbKind, Role, Roles};

/// Links that hang within this angle of straight count as straight, rad: shanks whose feet lie
/// ahead of them, and bodies whose makers count from a slight bend. The legs of the robots in
/// `configs/robots` are within 0.5.
const STRAIGHT: f64 = 0.8;

/// For each slot, the position in the slot's direction at which the thigh hangs upright or the
/// shank continues the thigh, rad; 0 where the leg is about straight at zero, and for all joints
/// but hip flexion and knee.
pub(super) fn zeros(pose: &ZeroPose<'_>, roles: &Roles) -> Vec<f64> {
    let mut zeros = vec![0.0; roles.slots.len()];
    for limb in roles.limbs.iter().filter(|limb| limb.kind == LimbKind::Leg) {
        let (Some(hip), Some(knee), Some(foot)) = (limb.joint(Role::Hfe), limb.joint(Role::Kfe), limb.foot) else {
            continue;
        };
        let tip = pose.links[pose.model.bodies[foot.body].link].transform_point(foot.point);
        // in the plane of the leg
        let left = pose.axis(hip) * pose.axis(hip).y.signum();
        let forward = left.cross(DVec3::Z).normalize_or_zero();
        let up = forward.cross(left);
        let turn = |rod: DVec3| (-rod.dot(forward)).atan2(-rod.dot(up));
        let thigh = turn(pose.position(knee) - pose.position(hip));
        let shank = turn(tip - pose.position(knee));
        for (joint, turned) in [(hip, thigh), (knee, shank - thigh)] {
            let turned = turned - TAU * (turned / TAU).round();
            if let Some(at) = roles.joint_of_slot.iter().position(|own| *own == joint)
                && turned.abs() > STRAIGHT
            {
                zeros[at] = -turned.clamp(-PI, PI);
            }
        }
    }
    zeros
}
