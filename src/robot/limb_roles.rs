//! Roles of the joints of a limb, by their axes with all joints at zero.

use glam::{DQuat, DVec3};

use super::chains::{ALIGNED, ZeroPose};
use super::limbs::{Limb, LimbJoint, Role};
use super::model::JointKind;

/// Components of an axis that differ by less are equal.
const TIE: f64 = 0.05;

/// Largest distance of a wheel's centre of mass from its axle, over the length of the link before.
const ON_AXLE: f64 = 0.05;

/// Component of an axis along the direction of its role from which the role says its sign.
const TOLD: f64 = 0.1;

/// The base axis that a joint turns about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Turn {
    Roll,
    Pitch,
    Yaw,
}

impl ZeroPose<'_> {
    /// The base axis nearest to the joint's.
    pub(super) fn turn(&self, joint: usize) -> Turn {
        let axis = self.axis(joint).abs();
        if axis.y >= axis.x && axis.y >= axis.z {
            Turn::Pitch
        } else if axis.z > axis.x {
            Turn::Yaw
        } else {
            Turn::Roll
        }
    }

    /// Turns of the joints of a chain: of axes halfway between x and z, the first is yaw where the
    /// chain has no other, then roll.
    fn turns_of(&self, chain: &[usize]) -> Vec<Turn> {
        let is_between = |joint: usize| {
            let axis = self.axis(joint).abs();
            (axis.x - axis.z).abs() < TIE && axis.y < axis.x
        };
        let mut turns: Vec<Turn> = chain.iter().map(|joint| self.turn(*joint)).collect();
        let clear = |turns: &[Turn], turn: Turn| {
            chain.iter().zip(turns).any(|(joint, own)| *own == turn && !is_between(*joint))
        };
        let mut has_yaw = clear(&turns, Turn::Yaw);
        for (at, joint) in chain.iter().enumerate() {
            if is_between(*joint) {
                turns[at] = if has_yaw { Turn::Roll } else { Turn::Yaw };
                has_yaw = true;
            }
        }
        turns
    }

    /// Roles of a biped's leg: joints about y are hip, knee, what lies between, and ankle.
    pub(super) fn biped_leg(&self, chain: &[usize]) -> Vec<Role> {
        let turns = self.turns_of(chain);
        let wheel = self.wheel(chain);
        let bends: Vec<usize> = (0..chain.len())
            .filter(|at| turns[*at] == Turn::Pitch && self.turns(chain[*at]) && Some(*at) != wheel)
            .collect();
        let knee = bends.get(1).copied().unwrap_or(chain.len());
        (0..chain.len())
            .map(|at| match (turns[at], bends.iter().position(|bend| *bend == at)) {
                _ if !self.turns(chain[at]) => Role::Slide,
                _ if Some(at) == wheel => Role::Wheel,
                (_, Some(0)) => Role::HipPitch,
                (_, Some(1)) => Role::Knee,
                (_, Some(bend)) if bend + 1 < bends.len() => Role::Tarsus,
                (_, Some(_)) => Role::AnklePitch,
                (Turn::Roll, _) if at < knee => Role::HipRoll,
                (Turn::Roll, _) => Role::AnkleRoll,
                (_, _) if at < knee => Role::HipYaw,
                (_, _) => Role::AnkleYaw,
            })
            .collect()
    }

    /// Roles of joints of a quadruped's leg other than abduction, flexion and knee, which are at
    /// `known`.
    pub(super) fn quadruped_leg(&self, chain: &[usize], known: &[Option<usize>; 3]) -> Vec<Role> {
        let wheel = self.wheel(chain);
        let knee = chain.iter().position(|joint| Some(*joint) == known[2]).unwrap_or(chain.len());
        let others = chain.iter().enumerate().map(|(at, joint)| {
            match (known.iter().position(|own| *own == Some(*joint)), self.turn(*joint)) {
                (Some(0), _) => Role::Haa,
                (Some(1), _) => Role::Hfe,
                (Some(_), _) => Role::Kfe,
                _ if !self.turns(*joint) => Role::Slide,
                _ if Some(at) == wheel && at > knee => Role::Wheel,
                (None, Turn::Roll) if at < knee => Role::HipRoll,
                (None, Turn::Pitch) if at < knee => Role::HipPitch,
                (None, Turn::Yaw) if at < knee => Role::HipYaw,
                (None, Turn::Roll) => Role::AnkleRoll,
                (None, Turn::Pitch) => Role::AnklePitch,
                (None, Turn::Yaw) => Role::AnkleYaw,
            }
        });
        others.collect()
    }

    /// Index of a leg's wheel in its chain: the last joint, if it alone turns without limits and
    /// about y. A joint that is not called continuous also carries a body about its axle.
    fn wheel(&self, chain: &[usize]) -> Option<usize> {
        let is_continuous = |joint: &usize| self.model.joints[*joint].kind == JointKind::Continuous;
        let (last, others) = chain.split_last()?;
        let turns = is_continuous(last) || self.is_on_an_axle(*last);
        let is_wheel = turns && self.turn(*last) == Turn::Pitch && !others.iter().all(is_continuous);
        is_wheel.then_some(others.len())
    }

    /// Whether a joint without limits moves one link, whose centre of mass lies on the axis.
    fn is_on_an_axle(&self, joint: usize) -> bool {
        let (own, link) = (&self.model.joints[joint], joint + 1);
        let is_free = own.kind == JointKind::Revolute && own.lower.is_infinite() && own.upper.is_infinite();
        let centre = self.model.links[link].com;
        let off = (centre - own.axis * own.axis.dot(centre)).length();
        let length = own.origin.translation.length();
        is_free && self.model.children(link).next().is_none() && off <= ON_AXLE * length
    }

    /// The horizontal axis to the left of the direction in which a leg points away from the body;
    /// `None` for one that hangs.
    pub(super) fn lift_axis(&self, chain: &[usize], foot: DVec3) -> Option<DVec3> {
        let out = foot - self.position(*chain.first()?);
        let out = DVec3::new(out.x, out.y, 0.0).try_normalize()?;
        Some(DVec3::Z.cross(out))
    }

    /// Whether a leg turns about z first and then lifts.
    pub(super) fn points_away(&self, chain: &[usize], foot: DVec3) -> bool {
        let turning: Vec<usize> = chain.iter().copied().filter(|joint| self.turns(*joint)).collect();
        let Some(lift) = self.lift_axis(chain, foot) else {
            return false;
        };
        match turning[..] {
            [yaw, hip, ..] => self.axis(yaw).z.abs() > ALIGNED && self.axis(hip).dot(lift).abs() > ALIGNED,
            _ => false,
        }
    }

    /// Roles of a leg that points away from the body.
    pub(super) fn radial_leg(&self, chain: &[usize], lift: DVec3) -> Vec<Role> {
        let mut lifts = 0;
        chain
            .iter()
            .map(|joint| {
                if !self.turns(*joint) {
                    Role::Slide
                } else if self.axis(*joint).dot(lift).abs() > ALIGNED {
                    lifts += 1;
                    [Role::HipLift, Role::Knee, Role::Tarsus][(lifts - 1).min(2)]
                } else if self.turn(*joint) == Turn::Yaw {
                    if lifts < 2 { Role::HipYaw } else { Role::AnkleYaw }
                } else if lifts < 2 {
                    Role::HipRoll
                } else {
                    Role::AnkleRoll
                }
            })
            .collect()
    }

    /// Roles of an arm at the side: shoulder, elbow, wrist.
    pub(super) fn arm(&self, chain: &[usize]) -> Vec<Role> {
        let elbow = if chain.len() < 3 { chain.len() } else { (chain.len() - 1).min(3) };
        let along = self.upper_arm(chain);
        (0..chain.len())
            .map(|at| {
                let (joint, turn) = (chain[at], self.turn(chain[at]));
                let is_twist = at == 2 && self.axis(joint).dot(along).abs() > ALIGNED;
                match turn {
                    _ if !self.turns(joint) => Role::Slide,
                    _ if at == elbow => Role::Elbow,
                    _ if at < elbow && is_twist => Role::ShoulderYaw,
                    Turn::Pitch if at < elbow => Role::ShoulderPitch,
                    Turn::Roll if at < elbow => Role::ShoulderRoll,
                    Turn::Yaw if at < elbow => Role::ShoulderYaw,
                    Turn::Pitch => Role::WristPitch,
                    Turn::Roll => Role::WristRoll,
                    Turn::Yaw => Role::WristYaw,
                }
            })
            .collect()
    }

    /// Roles of limbs in the middle.
    pub(super) fn middle_limb(&self, chain: &[usize]) -> Vec<Role> {
        let role = |joint: &usize| match self.turn(*joint) {
            _ if !self.turns(*joint) => Role::Slide,
            Turn::Roll => Role::Roll,
            Turn::Pitch => Role::Pitch,
            Turn::Yaw => Role::Yaw,
        };
        chain.iter().map(role).collect()
    }

    /// Direction of the upper arm, from the shoulder to the elbow; down where the joints do not
    /// tell.
    fn upper_arm(&self, chain: &[usize]) -> DVec3 {
        let (Some(first), Some(elbow)) = (chain.first(), chain.get((chain.len() - 1).min(3))) else {
            return -DVec3::Z;
        };
        (self.position(*elbow) - self.position(*first)).try_normalize().unwrap_or(-DVec3::Z)
    }

    /// 1 where a joint's axis has the direction that its role states, and -1 where it is turned
    /// round. `chain` are the joints of the limb, `lift` the axis about which a leg that points
    /// away from the body lifts.
    pub(super) fn sign(&self, joint: usize, role: Role, chain: &[usize], lift: Option<DVec3>) -> f64 {
        let axis = self.axis(joint);
        let along_stated = axis.dot(self.stated(joint, role, chain, lift));
        // an axis that lies across the role's counts by its largest component
        let largest = [axis.x, axis.y, axis.z].into_iter().fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a });
        let told = if along_stated.abs() > TOLD { along_stated } else { largest };
        if told < 0.0 { -1.0 } else { 1.0 }
    }

    /// The axis that a role states for a joint; zero where it states none.
    fn stated(&self, joint: usize, role: Role, chain: &[usize], lift: Option<DVec3>) -> DVec3 {
        let axis = self.axis(joint);
        let along = self.upper_arm(chain);
        match role {
            Role::Haa | Role::HipRoll | Role::AnkleRoll | Role::Roll | Role::ShoulderRoll | Role::WristRoll => DVec3::X,
            Role::HipYaw | Role::AnkleYaw | Role::Yaw | Role::WristYaw => DVec3::Z,
            Role::HipLift | Role::Knee | Role::Tarsus => lift.unwrap_or(DVec3::Y),
            Role::ShoulderYaw if axis.z.abs() < 0.5 => -along,
            Role::ShoulderYaw => DVec3::Z,
            Role::Elbow if axis.y.abs() < 0.5 => DQuat::from_rotation_arc(-DVec3::Z, along) * DVec3::Y,
            Role::Slide => DVec3::ZERO,
            _ => DVec3::Y,
        }
    }

    /// For each joint of a limb, the cosine between its axis and the one that its role states,
    /// without its sign.
    pub(super) fn cosines(&self, limb: &Limb) -> Vec<f64> {
        let chain: Vec<usize> = limb.joints.iter().map(|joint| joint.joint).collect();
        let lift = self.lift_of(limb);
        let cosine = |own: &LimbJoint| {
            let stated = self.stated(own.joint, own.slot.role, &chain, lift);
            self.axis(own.joint).dot(stated).abs()
        };
        limb.joints.iter().map(cosine).collect()
    }

    /// The axis about which a leg lifts that points away from the body, if it does.
    pub(super) fn lift_of(&self, limb: &Limb) -> Option<DVec3> {
        let lifts = limb.joints.iter().any(|joint| joint.slot.role == Role::HipLift);
        let foot = limb.foot.filter(|_| lifts)?;
        let chain: Vec<usize> = limb.joints.iter().map(|joint| joint.joint).collect();
        let link = &self.links[self.model.bodies[foot.body].link];
        self.lift_axis(&chain, link.transform_point(foot.point))
    }
}
