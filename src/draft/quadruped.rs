//! The legs of a quadruped, as drafts know them.

use std::collections::BTreeMap;

use glam::DVec3;

use crate::error::Error;
use crate::robot::{self, CANONICAL_JOINT_NAMES, LEGS, Model, Place, Slot};

/// Joints and feet of a quadruped with twelve joints in its legs.
pub(super) struct Roles {
    /// For each of [`CANONICAL_JOINT_NAMES`], the joint.
    pub joint_of_slot: [usize; CANONICAL_JOINT_NAMES.len()],
    /// For each of them, 1, or -1 where the URDF's axis is turned round.
    pub sign_of_slot: [f64; CANONICAL_JOINT_NAMES.len()],
    /// For each of [`LEGS`], the contact body of its foot, and the foot's point and radius in the frame of its link, m.
    pub foot_body: [usize; LEGS.len()],
    pub foot_point: [DVec3; LEGS.len()],
    pub foot_radius: [f64; LEGS.len()],
}

/// Finds them by geometry; `feet` names the links of feet that geometry does not tell.
///
/// # Errors
/// Those of [`robot::detect`]; a robot that is no quadruped of twelve joints.
pub(super) fn detect(model: &Model, feet: &BTreeMap<String, String>) -> Result<Roles, Error> {
    let roles =
        robot::detect(model, &BTreeMap::new(), feet).map_err(|error| robot::naming_missing_meshes(error, model))?;
    let slot = |name: &&str| Slot::parse(name).and_then(|slot| roles.slots.binary_search(&slot).ok());
    let slots: Vec<usize> = CANONICAL_JOINT_NAMES.iter().filter_map(slot).collect();
    let leg = |name: &&str| Place::parse(name).and_then(|place| roles.legs.iter().position(|leg| *leg == place));
    let legs: Vec<usize> = LEGS.iter().filter_map(leg).collect();
    if slots.len() != CANONICAL_JOINT_NAMES.len() || legs.len() != LEGS.len() {
        let problem = format!(
            "{} is a {}, and drafts are of quadrupeds with twelve joints in their legs",
            model.name,
            roles.class()
        );
        let remedy = "write its config by hand: docs/add-a-robot.md";
        return Err(Error::argument("robot", problem, remedy));
    }
    Ok(Roles {
        joint_of_slot: std::array::from_fn(|at| roles.joint_of_slot[slots[at]]),
        sign_of_slot: std::array::from_fn(|at| roles.sign_of_slot[slots[at]]),
        foot_body: std::array::from_fn(|at| roles.foot_body[legs[at]]),
        foot_point: std::array::from_fn(|at| roles.foot_point[legs[at]]),
        foot_radius: std::array::from_fn(|at| roles.foot_radius[legs[at]]),
    })
}
