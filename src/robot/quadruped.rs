//! Bodies on four legs that move in planes along the body: hip abduction, hip flexion and knee, a
//! leg at each corner.

use glam::DVec3;

use super::chains::{LegJoints, ZeroPose};
use super::error::RobotError;
use super::feet;
use super::limbs::{Place, Role, Slot};
use super::roles::{Overrides, list, roles_error};

/// Legs of a quadruped in order: left front, left hind, right front, right hind.
pub const LEGS: [&str; 4] = ["LF", "LH", "RF", "RH"];

/// Joints of a leg in order: hip abduction, hip flexion, knee flexion.
pub const ROLES: [&str; 3] = ["HAA", "HFE", "KFE"];

/// Slots of a quadruped in order: role-major, legs inside (`slot = 4 * role + leg`).
pub const CANONICAL_JOINT_NAMES: [&str; 12] = [
    "LF_HAA", "LH_HAA", "RF_HAA", "RH_HAA", "LF_HFE", "LH_HFE", "RF_HFE", "RH_HFE", "LF_KFE", "LH_KFE", "RF_KFE",
    "RH_KFE",
];

/// The places of [`LEGS`].
pub(super) const CORNERS: [Place; 4] = [Place::LeftFront, Place::LeftHind, Place::RightFront, Place::RightHind];

/// The roles of [`ROLES`].
pub(super) const LEG_ROLES: [Role; 3] = [Role::Haa, Role::Hfe, Role::Kfe];

/// The joints of each of [`LEGS`]: joints that are named, and the others by geometry.
pub(super) fn legs(pose: &ZeroPose<'_>, named: &Overrides) -> Result<[LegJoints; 4], RobotError> {
    let of_slot = |place, role| named.joints.get(&Slot::new(place, role)).copied();
    let named_legs = CORNERS.map(|place| LEG_ROLES.map(|role| of_slot(place, role)));
    let mut legs: [Option<LegJoints>; 4] = named_legs.map(|leg| {
        let [haa, hfe, knee] = leg;
        let is_whole = haa.is_some() || hfe.is_some_and(|hip| pose.chain_to(hip + 1).len() == 1);
        (hfe.is_some() && knee.is_some() && is_whole).then_some(leg)
    });
    let taken: Vec<usize> = legs.iter().flatten().flatten().flatten().copied().collect();
    let mut chains = pose.chains();
    chains.retain(|chain| !chain.iter().any(|joint| taken.contains(joint)));
    let wanted = legs.iter().filter(|leg| leg.is_none()).count();
    let found = pose.leg_candidates(&chains, wanted);
    if found.len() != wanted {
        let legs = found.len() + 4 - wanted;
        let problem = match legs {
            2 | 6 => format!("{legs} legs were found on a body that needs 4"),
            _ => format!("{legs} legs were found instead of 2, 4 or 6"),
        };
        return Err(roles_error(
            pose,
            "<robot>",
            format!("{problem}: {}", list(pose, &chains)),
            "let the base frame have x forward and y left, name all joints of the legs in joint_roles (--role SLOT=JOINT of \
             robot new), or lock the joints that are no legs' in locked_joints (--lock JOINT=POSITION)",
        ));
    }

    let first = |leg: &LegJoints| leg.iter().flatten().next().map_or(DVec3::ZERO, |joint| pose.position(*joint));
    let foot = |leg: &LegJoints| match leg[2].and_then(|knee| feet::find(pose, knee, None)) {
        Some(foot) => pose.links[foot.link].transform_point(foot.point),
        None => leg[2].map_or(DVec3::ZERO, |knee| pose.position(knee)),
    };
    // Where the hips leave the corners open, the feet may decide.
    let corners = corners(&legs, &found, &first).or_else(|| corners(&legs, &found, &foot));
    let Some(corners) = corners else {
        let found: Vec<Vec<usize>> = found.iter().map(|leg| leg.iter().flatten().copied().collect()).collect();
        return Err(roles_error(
            pose,
            "<robot>",
            format!("the legs are not one at each corner of the base: {}", list(pose, &found)),
            "let the base frame have x forward and y left, or name the joints in joint_roles (--role SLOT=JOINT of robot new)",
        ));
    };
    for (leg, corner) in found.iter().zip(corners) {
        legs[corner] = Some(*leg);
    }
    // `corners` fills every gap exactly once.
    let mut legs = legs.map(Option::unwrap_or_default);
    for (leg, named) in legs.iter_mut().zip(named_legs) {
        for (joint, named) in leg.iter_mut().zip(named) {
            *joint = named.or(*joint);
        }
    }
    Ok(legs)
}

/// The index in [`LEGS`] of each found leg, by where `point` lies among all legs; `None` when two
/// legs share a corner or one lies on a middle line.
fn corners(
    named: &[Option<LegJoints>; 4],
    found: &[LegJoints],
    point: &dyn Fn(&LegJoints) -> DVec3,
) -> Option<Vec<usize>> {
    let all: Vec<DVec3> = named.iter().flatten().chain(found).map(point).collect();
    let mean = all.iter().sum::<DVec3>() / all.len() as f64;
    let spread = all.iter().map(|p| p.distance(mean)).fold(0.0, f64::max);
    let mut free = named.map(|leg| leg.is_none());
    let mut corners = Vec::with_capacity(found.len());
    for leg in found {
        let offset = point(leg) - mean;
        if offset.x.abs().min(offset.y.abs()) <= 0.02 * spread {
            return None;
        }
        let corner = 2 * usize::from(offset.y < 0.0) + usize::from(offset.x < 0.0);
        if !std::mem::take(&mut free[corner]) {
            return None;
        }
        corners.push(corner);
    }
    Some(corners)
}
