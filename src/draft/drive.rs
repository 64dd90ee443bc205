//! Gains and limits of a draft: the URDF's limits where it has any, and the rest from weight, leg
//! length and effort.

use crate::robot::{Joint, LimbKind, Model, Roles};

use super::body;
use super::round;
use super::stance::GRAVITY;

/// Stiffness of a leg, per rad: the geometric mean of these shares of weight times leg length and
/// of the median effort limit of the hips and knees. Quadrupeds of `configs/robots` have 0.22 to
/// 0.64 of the one and 0.6 to 2.8 of the other; the mean of both is nearer to each of them than
/// either share. The first holds for `USUAL_MASS` and falls with this power of the mass: light
/// robots are stiffer. Without effort limits it is the first alone.
const STIFFNESS_OF_LOAD: f64 = 0.5;
const STIFFNESS_OF_EFFORT: f64 = 1.25;
pub(super) const USUAL_MASS: f64 = 15.0;
pub(super) const POWER_OF_MASS: f64 = -0.2;
/// Bounds of that stiffness over weight times leg length: softer legs buckle, stiffer ones shake.
const STIFFNESS_BOUNDS: [f64; 2] = [0.25, 0.8];
/// Stiffness of two legs over weight times leg length. Standing needs it: two softer ankles do not
/// hold the moment of the weight as the body leans. Makers choose less, 0.01 at an ankle to 1.2 at
/// a hip, and let a policy balance: see [`balance`](super::balance).
const STIFFNESS_OF_TWO_LEGS: f64 = 0.7;
const DAMPING_OF_TWO_LEGS: f64 = 1.0 / 40.0;
/// Damping over stiffness of a leg, s, which falls with the same power up to `USUAL_MASS`.
/// Quadrupeds in `configs/robots` have 1/50 to 1/25, the lightest ones most, and those of 60 to 75
/// kg no less than the others: 1/40 to 1/31.
const DAMPING: f64 = 1.0 / 36.0;
/// Effort limit over weight times leg length where the URDF has none, of hips and knees and of
/// ankles. Legs in `configs/robots` have 0.16 to 1.2 and 0.06 to 0.29.
const EFFORT: f64 = 0.35;
const ANKLE_EFFORT: f64 = 0.15;
/// Effort limits beyond this multiple of weight times leg length, and of this many N m, are
/// placeholders; the strongest motors in `configs/robots` have 1.2 times and 300 N m.
const MOST_LOADS: f64 = 2.0;
const MOST_EFFORT: f64 = 1000.0;
/// Speed limit where the URDF has none, of a leg of 1 m, rad/s m^0.5: by dynamic similarity speeds
/// fall with the root of the length.
const SPEED: f64 = 12.6;
/// Speed limits beyond this are placeholders, rad/s; the fastest motor in `configs/robots` reaches
/// 52.
const MOST_SPEED: f64 = 100.0;
/// Drives of joints that carry an arm, a head or a torso: stiffness and effort limit over the
/// largest moment of gravity about them, and the least stiffness over weight times leg length. Arms
/// of the robots in `configs/robots` have 5 to 20 times.
const HELD: f64 = 10.0;
const HELD_EFFORT: f64 = 3.0;
const HELD_LEAST: f64 = 0.02;
/// Damping over stiffness of these joints, s.
const HELD_DAMPING: f64 = 1.0 / 20.0;

/// Gains and limits of a joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Drive {
    pub stiffness: f64,
    pub damping: f64,
    pub effort: f64,
    pub velocity: f64,
    /// Origin of the effort limit.
    pub effort_is: Limit,
    /// Origin of the speed limit.
    pub velocity_is: Limit,
}

impl Drive {
    /// Whether a config has the same lines for both.
    pub fn reads_as(&self, other: &Self) -> bool {
        let lines = |own: &Self| {
            (own.stiffness, own.damping, own.effort, own.velocity, own.effort_is.comment(), own.velocity_is.comment())
        };
        lines(self) == lines(other)
    }
}

/// Origin of a limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Limit {
    /// The URDF states it.
    Stated,
    /// The URDF has none, or 0.
    Absent,
    /// The URDF has this number, which no motor reaches.
    Placeholder(f64),
    /// The URDF has this number in all joints of the legs, and it is too small for a motor.
    Uniform(f64),
}

impl Limit {
    fn of(stated: f64, most: f64) -> Self {
        if !stated.is_finite() || stated <= 0.0 {
            Self::Absent
        } else if stated >= most {
            Self::Placeholder(stated)
        } else {
            Self::Stated
        }
    }

    /// Comment on the limit in a config.
    pub fn comment(self) -> &'static str {
        match self {
            Self::Stated => "",
            Self::Uniform(_) => ", assumed: the URDF's is no motor's",
            Self::Absent | Self::Placeholder(_) => ", assumed: not in the URDF",
        }
    }

    fn value(self, stated: f64, assumed: f64) -> f64 {
        if self == Self::Stated { stated } else { round(assumed) }
    }
}

/// Drives of a body's joints.
pub(super) struct Drives<'a> {
    model: &'a Model,
    /// Weight times leg length, N m.
    load: f64,
    /// Length of a leg, m.
    leg_length: f64,
    /// Joints of legs.
    of_legs: Vec<usize>,
    /// Joints of legs that are ankles.
    ankles: Vec<usize>,
    /// Stiffness of legs, N m/rad.
    stiffness: f64,
    /// Damping over stiffness of legs, s.
    damping: f64,
    /// Factor on all gains.
    factor: f64,
}

impl<'a> Drives<'a> {
    pub fn new(model: &'a Model, roles: &Roles, leg_length: f64, factor: f64) -> Self {
        let load = model.total_mass() * GRAVITY * leg_length;
        let legs = roles.limbs.iter().filter(|limb| limb.kind == LimbKind::Leg).flat_map(|limb| &limb.joints);
        let (mut of_legs, mut ankles) = (Vec::new(), Vec::new());
        for own in legs {
            of_legs.push(own.joint);
            if own.slot.role.is_ankle() {
                ankles.push(own.joint);
            }
        }
        let mut drives = Self { model, load, leg_length, of_legs, ankles, stiffness: 0.0, damping: 0.0, factor };
        let bends = drives.of_legs.iter().filter(|joint| !drives.ankles.contains(joint));
        let stated = bends.map(|joint| drives.effort(*joint)).filter(|(limit, _)| *limit == Limit::Stated);
        let mut efforts: Vec<f64> = stated.map(|(_, effort)| effort).collect();
        efforts.sort_by(f64::total_cmp);
        let median = efforts.get(efforts.len().saturating_sub(1) / 2);
        let [least, most] = STIFFNESS_BOUNDS.map(|share| share * load);
        let of_load = STIFFNESS_OF_LOAD * drives.of_mass() * load;
        let of_both = median.map_or(of_load, |effort| (of_load * STIFFNESS_OF_EFFORT * effort).sqrt());
        (drives.stiffness, drives.damping) = match roles.legs.len() {
            2 => (STIFFNESS_OF_TWO_LEGS * load, DAMPING_OF_TWO_LEGS),
            _ => (of_both.clamp(least, most), DAMPING * drives.of_mass().max(1.0)),
        };
        drives
    }

    /// Factor on values that hold for the usual mass.
    fn of_mass(&self) -> f64 {
        (self.model.total_mass() / USUAL_MASS).powf(POWER_OF_MASS)
    }

    pub fn of(&self, joint: usize) -> Drive {
        let own = &self.model.joints[joint];
        let (effort_is, effort) = self.effort(joint);
        let (velocity_is, velocity) = self.velocity(own);
        let (stiffness, damping) = if self.of_legs.contains(&joint) {
            (self.stiffness, self.damping)
        } else {
            let of_moment = HELD * body::gravity_moment(self.model, joint);
            let of_both = match effort_is {
                Limit::Stated => (of_moment * STIFFNESS_OF_EFFORT * effort).sqrt(),
                _ => of_moment,
            };
            (of_both.clamp(HELD_LEAST * self.load, self.stiffness), HELD_DAMPING)
        };
        let stiffness = round(stiffness * self.factor);
        Drive { stiffness, damping: round(damping * stiffness), effort, velocity, effort_is, velocity_is }
    }

    /// Effort limit of a joint, N m, and how it was found.
    fn effort(&self, joint: usize) -> (Limit, f64) {
        let stated = self.model.joints[joint].effort;
        let limit = Limit::of(stated, (MOST_LOADS * self.load).min(MOST_EFFORT));
        let assumed = if self.ankles.contains(&joint) {
            ANKLE_EFFORT * self.load
        } else if self.of_legs.contains(&joint) {
            EFFORT * self.load
        } else {
            (HELD_EFFORT * body::gravity_moment(self.model, joint)).max(HELD_LEAST * self.load)
        };
        (limit, limit.value(stated, assumed))
    }

    /// Speed limit of a joint, rad/s, and how it was found.
    fn velocity(&self, own: &Joint) -> (Limit, f64) {
        let limit = Limit::of(own.velocity, MOST_SPEED);
        (limit, limit.value(own.velocity, SPEED / self.leg_length.sqrt()))
    }
}
