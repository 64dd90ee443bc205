//! Which joint is which: four legs, three joints each, and their feet, told apart by geometry.

use std::collections::BTreeMap;

use glam::DVec3;

use super::chains::ZeroPose;
use super::error::{Diagnosis, RobotError, nearest_name};
use super::feet::{self, Foot};
use super::model::Model;

/// Legs in canonical order: left front, left hind, right front, right hind.
pub const LEGS: [&str; 4] = ["LF", "LH", "RF", "RH"];

/// Joints of a leg in canonical order: hip abduction, hip flexion, knee flexion.
pub const ROLES: [&str; 3] = ["HAA", "HFE", "KFE"];

/// Canonical joints in slot order: role-major, legs inside (`slot = 4 * role + leg`).
pub const CANONICAL_JOINT_NAMES: [&str; 12] = [
    "LF_HAA", "LH_HAA", "RF_HAA", "RH_HAA", "LF_HFE", "LH_HFE", "RF_HFE", "RH_HFE", "LF_KFE", "LH_KFE", "RF_KFE",
    "RH_KFE",
];

/// Chains that an error lists.
const LISTED: usize = 12;

/// How a quadruped's joints and bodies map to canonical ones.
#[derive(Clone, Debug, PartialEq)]
pub struct Roles {
    /// For each slot of [`CANONICAL_JOINT_NAMES`], the index in [`Model::joints`].
    pub joint_of_slot: [usize; 12],
    /// For each of [`LEGS`], the index in [`Model::bodies`] of its foot.
    pub foot_body: [usize; 4],
    /// For each of [`LEGS`], the centre of the foot's sphere, or its lowest point at zero joint
    /// positions, in the frame of the link that carries it, m.
    pub foot_point: [DVec3; 4],
    /// For each of [`LEGS`], the radius of the foot's sphere, or 0, m.
    pub foot_radius: [f64; 4],
}

/// What part of the robot a contact body is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum BodyGroup {
    /// Part of the base link.
    Base,
    /// Moved by a hip abduction joint.
    Hip,
    /// Moved by a hip flexion joint.
    Thigh,
    /// Moved by a knee, but not the foot.
    Shank,
    /// The foot of a leg.
    Foot,
    /// Not part of a leg: an arm, a head.
    Other,
}

/// Hip abduction, hip flexion and knee joint.
type LegJoints = [usize; 3];

/// Finds legs, joint roles and feet of a quadruped from its geometry at zero joint positions.
///
/// `joint_overrides` maps canonical joint names to joint names, `foot_overrides` legs to contact
/// bodies; a leg whose three joints are all named is taken as it is.
///
/// # Errors
/// [`RobotError::Options`] for overrides that name nothing, [`RobotError::Roles`] when there are
/// not four legs, one at each corner, or a leg has no foot; it lists what was found.
pub fn detect(
    model: &Model,
    joint_overrides: &BTreeMap<String, String>,
    foot_overrides: &BTreeMap<String, String>,
) -> Result<Roles, RobotError> {
    let detector = Detector { model, pose: ZeroPose::new(model) };
    let named_joints = detector.named_joints(joint_overrides)?;
    let named_feet = detector.named_feet(foot_overrides)?;
    let mut legs = detector.legs(&named_joints)?;
    for (slot, joint) in named_joints.iter().enumerate() {
        if let Some(joint) = joint {
            legs[slot % 4][slot / 4] = *joint;
        }
    }
    detector.refuse_shared_joints(&legs)?;

    let mut roles =
        Roles { joint_of_slot: [0; 12], foot_body: [0; 4], foot_point: [DVec3::ZERO; 4], foot_radius: [0.0; 4] };
    for (index, leg) in legs.iter().enumerate() {
        for (role, joint) in leg.iter().enumerate() {
            roles.joint_of_slot[4 * role + index] = *joint;
        }
        let foot = detector.foot(index, leg, named_feet[index])?;
        roles.foot_body[index] = foot.body;
        roles.foot_point[index] = foot.point;
        roles.foot_radius[index] = foot.radius;
    }
    Ok(roles)
}

/// The group of each of [`Model::bodies`].
pub fn body_groups(model: &Model, roles: &Roles) -> Vec<BodyGroup> {
    let group_of_link = |link: usize| {
        let above = |link: &usize| model.parent(*link);
        for link in std::iter::successors(Some(link), above) {
            if link == 0 {
                break;
            }
            if let Some(slot) = roles.joint_of_slot.iter().position(|j| j + 1 == link) {
                return [BodyGroup::Hip, BodyGroup::Thigh, BodyGroup::Shank][slot / 4];
            }
        }
        BodyGroup::Other
    };
    let bodies = model.bodies.iter().enumerate();
    bodies
        .map(|(index, body)| match body.link {
            _ if roles.foot_body.contains(&index) => BodyGroup::Foot,
            0 => BodyGroup::Base,
            link => group_of_link(link),
        })
        .collect()
}

struct Detector<'a> {
    model: &'a Model,
    pose: ZeroPose<'a>,
}

impl Detector<'_> {
    fn named_joints(&self, overrides: &BTreeMap<String, String>) -> Result<[Option<usize>; 12], RobotError> {
        let mut named = [None; 12];
        for (canonical, name) in overrides {
            let slot = CANONICAL_JOINT_NAMES.iter().position(|n| n == canonical);
            let slot = slot.ok_or_else(|| {
                let remedy = nearest_name(canonical, CANONICAL_JOINT_NAMES);
                self.option_error("joint_roles", canonical, "is no canonical joint", remedy)
            })?;
            let joint = self.model.joint_index(name).ok_or_else(|| {
                let known = self.model.joints.iter().map(|joint| joint.name.as_str());
                let problem = format!("names \"{name}\", which is no moving joint");
                self.option_error("joint_roles", canonical, problem, nearest_name(name, known))
            })?;
            named[slot] = Some(joint);
        }
        Ok(named)
    }

    fn named_feet(&self, overrides: &BTreeMap<String, String>) -> Result<[Option<usize>; 4], RobotError> {
        let mut named = [None; 4];
        for (leg, name) in overrides {
            let index = LEGS
                .iter()
                .position(|known| known == leg)
                .ok_or_else(|| self.option_error("feet", leg, "is no leg", nearest_name(leg, LEGS)))?;
            let bodies = &self.model.bodies;
            let body = bodies.iter().position(|body| body.name == *name);
            let body = body.ok_or_else(|| {
                let known = bodies.iter().map(|body| body.name.as_str());
                let problem = format!("names \"{name}\", which is no link with collision shapes");
                self.option_error("feet", leg, problem, nearest_name(name, known))
            })?;
            named[index] = Some(body);
        }
        Ok(named)
    }

    /// The joints of each of [`LEGS`].
    fn legs(&self, named: &[Option<usize>; 12]) -> Result<[LegJoints; 4], RobotError> {
        let mut legs: [Option<LegJoints>; 4] =
            std::array::from_fn(|leg| Some([named[leg]?, named[leg + 4]?, named[leg + 8]?]));
        let taken: Vec<usize> = legs.iter().flatten().flatten().copied().collect();
        let mut chains = self.pose.chains();
        chains.retain(|chain| !chain.iter().any(|joint| taken.contains(joint)));
        let wanted = legs.iter().filter(|leg| leg.is_none()).count();
        let found = self.pose.leg_candidates(&chains, wanted);
        if found.len() != wanted {
            let legs = found.len() + 4 - wanted;
            return Err(self.roles_error(
                "<robot>",
                format!("{legs} legs were found instead of 4: {}", self.list(&chains)),
                "name all joints of the legs in joint_roles, or lock the joints that are no legs'",
            ));
        }

        let hip = |leg: &LegJoints| self.pose.position(leg[0]);
        let foot = |leg: &LegJoints| match feet::find(&self.pose, leg[2], None) {
            Some(foot) => self.pose.links[foot.link].transform_point(foot.point),
            None => self.pose.position(leg[2]),
        };
        // Where the hips do not tell the corners apart, the feet may.
        let corners = self.corners(&legs, &found, &hip).or_else(|| self.corners(&legs, &found, &foot));
        let Some(corners) = corners else {
            return Err(self.roles_error(
                "<robot>",
                format!("the legs are not one at each corner of the base: {}", self.list(&found)),
                "let the base frame have x forward and y left, or name the joints in joint_roles",
            ));
        };
        for (leg, corner) in found.iter().zip(corners) {
            legs[corner] = Some(*leg);
        }
        // `corners` fills every gap exactly once.
        Ok(legs.map(Option::unwrap_or_default))
    }

    /// The index in [`LEGS`] of each found leg, by where `point` lies among all legs; `None` when
    /// two legs share a corner or one lies on a middle line.
    fn corners(
        &self,
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

    fn refuse_shared_joints(&self, legs: &[LegJoints; 4]) -> Result<(), RobotError> {
        let mut slot_of: BTreeMap<usize, &str> = BTreeMap::new();
        for (slot, canonical) in CANONICAL_JOINT_NAMES.into_iter().enumerate() {
            let joint = legs[slot % 4][slot / 4];
            if let Some(other) = slot_of.insert(joint, canonical) {
                return Err(self.roles_error(
                    format!("joint \"{}\"", self.model.joints[joint].name),
                    format!("is both {other} and {canonical}"),
                    "give each canonical joint its own joint in joint_roles",
                ));
            }
        }
        Ok(())
    }

    fn foot(&self, leg: usize, joints: &LegJoints, named: Option<usize>) -> Result<Foot, RobotError> {
        if let Some(body) = named
            && !self.pose.is_below(self.model.bodies[body].link, joints[0])
        {
            let problem = format!("\"{}\" is not on this leg", self.model.bodies[body].name);
            let remedy = "name a body of the leg".to_string();
            return Err(self.option_error("feet", LEGS[leg], problem, remedy));
        }
        feet::find(&self.pose, joints[2], named).ok_or_else(|| {
            let shank =
                named.map_or_else(|| &self.model.links[joints[2] + 1].name, |body| &self.model.bodies[body].name);
            self.roles_error(
                format!("link \"{shank}\""),
                format!("leg {} has no collision shape for a foot there", LEGS[leg]),
                "add a <collision> with a <sphere>, or name the foot's link in feet",
            )
        })
    }

    fn list<C: AsRef<[usize]>>(&self, chains: &[C]) -> String {
        if chains.is_empty() {
            return "it has no chains of moving joints".to_string();
        }
        let mut listed: Vec<String> =
            chains.iter().take(LISTED).map(|chain| self.pose.describe(chain.as_ref())).collect();
        if chains.len() > LISTED {
            listed.push(format!("and {} more", chains.len() - LISTED));
        }
        listed.join(", ")
    }

    fn option_error(&self, table: &str, key: &str, problem: impl Into<String>, remedy: String) -> RobotError {
        let element = format!("{table}.{key}");
        RobotError::Options(Diagnosis::new(&self.model.source, element, problem, remedy))
    }

    fn roles_error(&self, element: impl Into<String>, problem: String, remedy: &str) -> RobotError {
        RobotError::Roles(Diagnosis::new(&self.model.source, element, problem, remedy))
    }
}
