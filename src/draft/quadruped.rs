//! The legs of a quadruped, as drafts know them.

use glam::DVec3;

use crate::robot::{CANONICAL_JOINT_NAMES, LEGS, Place, Roles, Slot};

/// Joints and feet of a quadruped with twelve joints in its legs.
pub(super) struct Legs {
    /// Joint of each of [`CANONICAL_JOINT_NAMES`].
    pub joint_of_slot: [usize; CANONICAL_JOINT_NAMES.len()],
    /// Contact body of the foot of each of [`LEGS`], and the foot's point and radius in the frame
    /// of its link, m.
    pub foot_body: [usize; LEGS.len()],
    pub foot_point: [DVec3; LEGS.len()],
    pub foot_radius: [f64; LEGS.len()],
}

impl Legs {
    /// The joints and feet of a quadruped; None for a robot that lacks one of them.
    pub fn of(roles: &Roles) -> Option<Self> {
        let slot = |name: &&str| Slot::parse(name).and_then(|slot| roles.slots.binary_search(&slot).ok());
        let slots: Vec<usize> = CANONICAL_JOINT_NAMES.iter().filter_map(slot).collect();
        let leg = |name: &&str| Place::parse(name).and_then(|place| roles.legs.iter().position(|leg| *leg == place));
        let legs: Vec<usize> = LEGS.iter().filter_map(leg).collect();
        if slots.len() != CANONICAL_JOINT_NAMES.len() || legs.len() != LEGS.len() {
            return None;
        }
        Some(Self {
            joint_of_slot: std::array::from_fn(|at| roles.joint_of_slot[slots[at]]),
            foot_body: std::array::from_fn(|at| roles.foot_body[legs[at]]),
            foot_point: std::array::from_fn(|at| roles.foot_point[legs[at]]),
            foot_radius: std::array::from_fn(|at| roles.foot_radius[legs[at]]),
        })
    }
}
