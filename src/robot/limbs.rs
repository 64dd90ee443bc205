//! Limbs as data: chains of joints with roles and, perhaps, an end that touches the world.

use std::fmt;

use glam::DVec3;

/// Place of a limb on the body. The order is that of legs within a role.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Place {
    /// Left front leg.
    LeftFront,
    /// Left middle leg.
    LeftMiddle,
    /// Left hind leg.
    LeftHind,
    /// Right front leg.
    RightFront,
    /// Right middle leg.
    RightMiddle,
    /// Right hind leg.
    RightHind,
    /// The left leg of a biped, or a left arm.
    Left,
    /// The right leg of a biped, or a right arm.
    Right,
    /// A waist or spine, between the base and other limbs.
    Torso,
    /// A head with its neck.
    Head,
    /// An arm in the middle of the body.
    Arm,
    /// A tail.
    Tail,
}

/// Side of the body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Side {
    /// Positive y of the base.
    Left,
    /// Negative y of the base.
    Right,
    /// The plane between left and right.
    Middle,
}

impl Place {
    /// All of them, in order.
    pub const ALL: [Self; 12] = [
        Self::LeftFront,
        Self::LeftMiddle,
        Self::LeftHind,
        Self::RightFront,
        Self::RightMiddle,
        Self::RightHind,
        Self::Left,
        Self::Right,
        Self::Torso,
        Self::Head,
        Self::Arm,
        Self::Tail,
    ];

    /// The prefix of slots at this place.
    pub const fn name(self) -> &'static str {
        match self {
            Self::LeftFront => "LF",
            Self::LeftMiddle => "LM",
            Self::LeftHind => "LH",
            Self::RightFront => "RF",
            Self::RightMiddle => "RM",
            Self::RightHind => "RH",
            Self::Left => "L",
            Self::Right => "R",
            Self::Torso => "TORSO",
            Self::Head => "HEAD",
            Self::Arm => "ARM",
            Self::Tail => "TAIL",
        }
    }

    /// The place of this name.
    pub fn parse(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|place| place.name() == name)
    }

    /// Side of the body.
    pub const fn side(self) -> Side {
        match self {
            Self::LeftFront | Self::LeftMiddle | Self::LeftHind | Self::Left => Side::Left,
            Self::RightFront | Self::RightMiddle | Self::RightHind | Self::Right => Side::Right,
            Self::Torso | Self::Head | Self::Arm | Self::Tail => Side::Middle,
        }
    }

    /// The place in a mirror between left and right.
    #[must_use]
    pub const fn mirrored(self) -> Self {
        match self {
            Self::LeftFront => Self::RightFront,
            Self::LeftMiddle => Self::RightMiddle,
            Self::LeftHind => Self::RightHind,
            Self::RightFront => Self::LeftFront,
            Self::RightMiddle => Self::LeftMiddle,
            Self::RightHind => Self::LeftHind,
            Self::Left => Self::Right,
            Self::Right => Self::Left,
            middle => middle,
        }
    }
}

/// Role of a joint in its limb. The order is that of the slots; each says about which axis its
/// positive direction turns, with all joints at zero: x forward, y left, z up of the base.
///
/// Legs at corners that move in a plane along the body have HAA, HFE and KFE. Legs that turn about
/// z and lift (hexapods, spiders) lift about the horizontal axis to the left of the direction in
/// which the leg points away from the body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Hip abduction, x.
    Haa,
    /// Hip flexion, y.
    Hfe,
    /// Knee flexion, y.
    Kfe,
    /// Hip about z.
    HipYaw,
    /// Hip about x.
    HipRoll,
    /// Hip about y.
    HipPitch,
    /// Hip of a leg that points away from the body: positive lowers the leg.
    HipLift,
    /// Knee about y; of a leg that points away from the body: positive lowers the shank.
    Knee,
    /// A joint between knee and ankle, about y.
    Tarsus,
    /// Ankle about y.
    AnklePitch,
    /// Ankle about x.
    AnkleRoll,
    /// Ankle about z.
    AnkleYaw,
    /// A wheel at the end of a leg, about y.
    Wheel,
    /// Joints that branch off a leg: toes, springs.
    Toe,
    /// Torso, head, tail or an arm in the middle: about z.
    Yaw,
    /// Torso, head, tail or an arm in the middle: about x.
    Roll,
    /// Torso, head, tail or an arm in the middle: about y.
    Pitch,
    /// Shoulder about y.
    ShoulderPitch,
    /// Shoulder about x.
    ShoulderRoll,
    /// Twist of the upper arm: about z where it hangs.
    ShoulderYaw,
    /// Elbow: about y where the upper arm hangs.
    Elbow,
    /// Wrist about x.
    WristRoll,
    /// Wrist about y.
    WristPitch,
    /// Wrist about z.
    WristYaw,
    /// Joints that branch off an arm.
    Finger,
    /// A joint that slides.
    Slide,
}

impl Role {
    /// All of them, in order.
    pub const ALL: [Self; 26] = [
        Self::Haa,
        Self::Hfe,
        Self::Kfe,
        Self::HipYaw,
        Self::HipRoll,
        Self::HipPitch,
        Self::HipLift,
        Self::Knee,
        Self::Tarsus,
        Self::AnklePitch,
        Self::AnkleRoll,
        Self::AnkleYaw,
        Self::Wheel,
        Self::Toe,
        Self::Yaw,
        Self::Roll,
        Self::Pitch,
        Self::ShoulderPitch,
        Self::ShoulderRoll,
        Self::ShoulderYaw,
        Self::Elbow,
        Self::WristRoll,
        Self::WristPitch,
        Self::WristYaw,
        Self::Finger,
        Self::Slide,
    ];

    /// The suffix of slots of this role.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Haa => "HAA",
            Self::Hfe => "HFE",
            Self::Kfe => "KFE",
            Self::HipYaw => "HIP_YAW",
            Self::HipRoll => "HIP_ROLL",
            Self::HipPitch => "HIP_PITCH",
            Self::HipLift => "HIP_LIFT",
            Self::Knee => "KNEE",
            Self::Tarsus => "TARSUS",
            Self::AnklePitch => "ANKLE_PITCH",
            Self::AnkleRoll => "ANKLE_ROLL",
            Self::AnkleYaw => "ANKLE_YAW",
            Self::Wheel => "WHEEL",
            Self::Toe => "TOE",
            Self::Yaw => "YAW",
            Self::Roll => "ROLL",
            Self::Pitch => "PITCH",
            Self::ShoulderPitch => "SHOULDER_PITCH",
            Self::ShoulderRoll => "SHOULDER_ROLL",
            Self::ShoulderYaw => "SHOULDER_YAW",
            Self::Elbow => "ELBOW",
            Self::WristRoll => "WRIST_ROLL",
            Self::WristPitch => "WRIST_PITCH",
            Self::WristYaw => "WRIST_YAW",
            Self::Finger => "FINGER",
            Self::Slide => "SLIDE",
        }
    }

    /// Whether the role is a leg's, wherever the leg is.
    const fn is_of_leg(self) -> bool {
        matches!(
            self,
            Self::Haa
                | Self::Hfe
                | Self::Kfe
                | Self::HipYaw
                | Self::HipRoll
                | Self::HipPitch
                | Self::HipLift
                | Self::Knee
                | Self::Tarsus
                | Self::AnklePitch
                | Self::AnkleRoll
                | Self::AnkleYaw
                | Self::Wheel
                | Self::Toe
        )
    }

    /// Whether limbs at `place` may have the role, as legs or as arms.
    const fn is_at(self, place: Place) -> bool {
        let is_of_middle = matches!(self, Self::Yaw | Self::Roll | Self::Pitch);
        match (self, place) {
            (Self::Slide, _) => true,
            (Self::Haa | Self::Hfe | Self::Kfe, Place::Left | Place::Right) => false,
            (Self::Finger, Place::Arm) => true,
            (_, Place::Left | Place::Right) => !is_of_middle,
            (_, Place::Torso | Place::Head | Place::Arm | Place::Tail) => is_of_middle,
            _ => self.is_of_leg(),
        }
    }

    /// Whether the joint spreads a leg sideways.
    pub const fn is_abduction(self) -> bool {
        matches!(self, Self::Haa | Self::HipRoll)
    }

    /// Whether the joint bends a leg.
    pub const fn is_flexion(self) -> bool {
        matches!(
            self,
            Self::Hfe | Self::Kfe | Self::HipPitch | Self::HipLift | Self::Knee | Self::Tarsus | Self::AnklePitch
        )
    }

    /// Whether the joint is between thigh and shank.
    pub const fn is_knee(self) -> bool {
        matches!(self, Self::Kfe | Self::Knee)
    }
}

/// A column of the action: a role of a limb. Slots are ordered by role, then by limb.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Slot {
    /// Role of the joint.
    pub role: Role,
    /// Number of the joint among the limb's joints of this role, counted from the base, from 0.
    pub nth: u8,
    /// Place of the limb.
    pub place: Place,
}

impl Slot {
    /// The first joint of this role.
    pub const fn new(place: Place, role: Role) -> Self {
        Self { role, nth: 0, place }
    }

    /// The slot of this name, such as `LF_HAA`, `L_HIP_YAW`, `TORSO_YAW` or `ARM_ROLL_2`.
    pub fn parse(name: &str) -> Option<Self> {
        let (place, rest) = name.split_once('_')?;
        let place = Place::parse(place)?;
        let of = |text: &str| Role::ALL.into_iter().find(|role| role.name() == text);
        let (role, nth) = match of(rest) {
            Some(role) => (role, 0),
            None => {
                let (role, number) = rest.rsplit_once('_')?;
                let nth: u8 = number.parse().ok().filter(|n| (2..100).contains(n))?;
                (of(role).filter(|_| nth.to_string() == number)?, nth - 1)
            }
        };
        role.is_at(place).then_some(Self { role, nth, place })
    }

    /// Whether the slot is a leg's. A joint that slides counts as one unless it is in the middle of
    /// the body: its slot does not tell an arm from a leg.
    pub const fn is_of_leg(self) -> bool {
        let slides = matches!(self.role, Role::Slide) && !matches!(self.place.side(), Side::Middle);
        self.role.is_of_leg() || slides
    }

    /// The slot in a mirror between left and right.
    #[must_use]
    pub const fn mirrored(self) -> Self {
        Self { place: self.place.mirrored(), ..self }
    }
}

impl fmt::Display for Slot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}_{}", self.place.name(), self.role.name())?;
        if self.nth > 0 {
            write!(f, "_{}", self.nth + 1)?;
        }
        Ok(())
    }
}

/// Purpose of a limb.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum LimbKind {
    /// Leg, which stands on the ground.
    Leg,
    /// Arm, with a hand for things.
    Arm,
    /// Torso, which carries other limbs.
    Torso,
    /// Head.
    Head,
    /// Any other limb.
    Tail,
}

/// A joint of a limb.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LimbJoint {
    /// Index in [`Model::joints`](super::Model::joints).
    pub joint: usize,
    /// Slot of the joint: role, and column of the action.
    pub slot: Slot,
    /// 1 where the URDF's axis has the direction that the role states, and -1 where it is turned
    /// round.
    pub sign: f64,
}

/// Part of a leg that touches the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Foot {
    /// Index in [`Model::bodies`](super::Model::bodies).
    pub body: usize,
    /// Centre of the foot's sphere, or the middle of what is lowest of it at zero joint positions,
    /// in the frame of the link that carries it, m.
    pub point: DVec3,
    /// Radius of the foot's sphere, or 0, m.
    pub radius: f64,
}

/// A chain of joints with its place and purpose.
#[derive(Clone, Debug, PartialEq)]
pub struct Limb {
    /// Place of the limb.
    pub place: Place,
    /// Purpose of the limb.
    pub kind: LimbKind,
    /// Joints from the base to the end.
    pub joints: Vec<LimbJoint>,
    /// Foot of a leg.
    pub foot: Option<Foot>,
}

impl Limb {
    /// The joint of this role, if it has one.
    pub fn joint(&self, role: Role) -> Option<usize> {
        self.joints.iter().find(|joint| joint.slot.role == role && joint.slot.nth == 0).map(|joint| joint.joint)
    }
}

/// Map of a robot's joints and bodies to limbs, slots and feet.
#[derive(Clone, Debug, PartialEq)]
pub struct Roles {
    /// Legs in the order of [`Place`], then all other limbs.
    pub limbs: Vec<Limb>,
    /// The robot's slots, in order.
    pub slots: Vec<Slot>,
    /// For each of `slots`, the index in [`Model::joints`](super::Model::joints).
    pub joint_of_slot: Vec<usize>,
    /// For each of `slots`, 1 where the joint's axis has the direction that the role states, and -1
    /// where it is turned round.
    pub sign_of_slot: Vec<f64>,
    /// For each of `slots`, the position in the slot's direction at which a quadruped's leg hangs
    /// straight, rad: 0 unless the file has the leg folded at zero. It makes angles of bodies
    /// comparable whose makers count them from other poses.
    pub zero_of_slot: Vec<f64>,
    /// The places of the legs, in order: those of the feet.
    pub legs: Vec<Place>,
    /// For each of `legs`, the index in [`Model::bodies`](super::Model::bodies) of its foot.
    pub foot_body: Vec<usize>,
    /// For each of `legs`, the foot's point, see [`Foot`].
    pub foot_point: Vec<DVec3>,
    /// For each of `legs`, the foot's radius, m.
    pub foot_radius: Vec<f64>,
}

impl Roles {
    /// Makes the roles of limbs whose slots differ.
    pub(super) fn new(mut limbs: Vec<Limb>) -> Self {
        limbs.sort_by_key(|limb| (limb.kind != LimbKind::Leg, limb.place));
        let mut joints: Vec<LimbJoint> = limbs.iter().flat_map(|limb| limb.joints.iter().copied()).collect();
        joints.sort_by_key(|joint| joint.slot);
        let feet: Vec<(Place, Foot)> = limbs.iter().filter_map(|limb| Some((limb.place, limb.foot?))).collect();
        Self {
            slots: joints.iter().map(|joint| joint.slot).collect(),
            joint_of_slot: joints.iter().map(|joint| joint.joint).collect(),
            sign_of_slot: joints.iter().map(|joint| joint.sign).collect(),
            zero_of_slot: vec![0.0; joints.len()],
            legs: feet.iter().map(|(place, _)| *place).collect(),
            foot_body: feet.iter().map(|(_, foot)| foot.body).collect(),
            foot_point: feet.iter().map(|(_, foot)| foot.point).collect(),
            foot_radius: feet.iter().map(|(_, foot)| foot.radius).collect(),
            limbs,
        }
    }

    /// The joint in this slot.
    pub fn joint(&self, slot: Slot) -> Option<usize> {
        self.slots.binary_search(&slot).ok().map(|at| self.joint_of_slot[at])
    }

    /// Name of the body's class.
    pub fn class(&self) -> &'static str {
        let has_arms = self.limbs.iter().any(|limb| limb.kind == LimbKind::Arm);
        match self.legs.len() {
            2 if has_arms => "humanoid",
            2 => "biped",
            4 if has_arms => "quadruped with an arm",
            4 => "quadruped",
            6 => "hexapod",
            _ => "legged robot",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_slots_are_one_to_one() {
        for place in Place::ALL {
            for role in Role::ALL.into_iter().filter(|role| role.is_at(place)) {
                for nth in [0, 1, 6] {
                    let slot = Slot { role, nth, place };
                    assert_eq!(Slot::parse(&slot.to_string()), Some(slot));
                    assert_eq!(slot.mirrored().mirrored(), slot);
                }
            }
        }
        let leg = |name: &str| Slot::parse(name).expect("a slot").is_of_leg();
        for name in ["LF_HAA", "RM_HIP_LIFT", "L_KNEE", "R_ANKLE_ROLL", "LH_WHEEL", "L_TOE", "R_SLIDE"] {
            assert!(leg(name), "{name}");
        }
        for name in ["TORSO_YAW", "HEAD_PITCH", "ARM_ROLL_2", "TAIL_SLIDE", "L_SHOULDER_YAW", "R_WRIST_ROLL", "L_FINGER"] {
            assert!(!leg(name), "{name}");
        }
        for name in ["LF_HIP", "FL_HAA", "L_HAA", "LF", "LF_HAA_1", "LF_HAA_02", "TORSO_KNEE", "LF_ELBOW", "L_YAW", ""]
        {
            assert_eq!(Slot::parse(name), None, "{name}");
        }
    }
}
