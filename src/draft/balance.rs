//! Gains of two legs on which a policy balances, joint by joint.
//!
//! Makers let a policy balance a robot on two legs: the ankles are far softer than the hips, and no
//! such robot stands on its gains alone. The rule predicts the gains of `configs/robots` from
//! weight, height of the hips and effort limits:
//!
//! ```text
//! load  = weight x height of the hips
//! leg   = LEG x (USUAL_MASS / mass)^0.2 x load
//! hips, knees, other joints of legs   leg^0.75 x effort^0.25
//! torso                               leg^0.5 x effort^0.5
//! ankles                              effort, at most leg
//! arms, heads                         ARM x load, at most leg
//! ```
//!
//! Stiffness is in N m/rad and effort in N m. Damping is a share of the stiffness.

use super::drive::{Drive, Limit, POWER_OF_MASS, USUAL_MASS};
use super::round;
use super::stance::GRAVITY;
use crate::robot::{LimbKind, Slot};

/// Stiffness of a hip or knee over the load, of a robot of `USUAL_MASS` and where the effort limit
/// is as large. `configs/robots` have 0.19 to 1.24.
const LEG: f64 = 0.41;
/// Stiffness of arms and heads over the load; `configs/robots` have 0.067 to 0.124.
const ARM: f64 = 0.085;
/// Powers of the effort limit in the stiffness of hips and knees and of torsos.
const POWER_IN_LEGS: f64 = 0.25;
const POWER_IN_TORSO: f64 = 0.5;
/// Damping over stiffness of legs and torsos, of ankles and of arms, s. Makers have 0.025 to 0.064,
/// 0.02 to 0.2 and 0.06 to 0.25.
const DAMPING: f64 = 0.04;
const DAMPING_OF_ANKLES: f64 = 0.06;
const DAMPING_OF_ARMS: f64 = 0.1;
/// Effort limit over the load where the URDF has only a placeholder: of a heavy robot's ankles, and
/// of other joints.
const EFFORT_OF_ANKLES: f64 = 0.16;
const EFFORT: f64 = 0.38;
/// Mass of a heavy robot, kg. Torques grow with the volume and the load with length more, so that
/// ankles of lighter robots are stronger, as those of hobby servos: at most like their legs.
const HEAVY: f64 = 50.0;
/// Least effort limit of a motor over the load, where all joints of the legs have the same:
/// exporters write 1 N m into every joint. Knees of makers have 0.36 and more.
const LEAST_EFFORT: f64 = 0.15;

/// Part of a body on two legs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    Leg,
    Ankle,
    Torso,
    /// An arm, a head or a tail.
    Arm,
}

impl Part {
    fn of(slot: Slot) -> Self {
        match slot.limb_kind() {
            LimbKind::Torso => Self::Torso,
            LimbKind::Leg if slot.role.is_ankle() => Self::Ankle,
            LimbKind::Leg => Self::Leg,
            LimbKind::Arm | LimbKind::Head | LimbKind::Tail => Self::Arm,
        }
    }
}

/// A body on two legs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Body {
    /// Mass of the robot, kg.
    pub mass: f64,
    /// Height of the hips above the soles in the default pose, m.
    pub hip_height: f64,
}

impl Body {
    /// Replaces the gains of the joints in these slots, and effort limits that are no motor's.
    pub fn balance(self, mut joints: Vec<(Slot, &mut Drive)>) {
        let of_legs = joints.iter().filter(|(slot, _)| matches!(Part::of(*slot), Part::Leg | Part::Ankle));
        let mut of_legs = of_legs.map(|(_, drive)| drive.effort);
        let first = of_legs.next();
        let is_uniform = of_legs.all(|effort| Some(effort) == first);
        let no_motors = first.filter(|effort| is_uniform && *effort < LEAST_EFFORT * self.load());
        for (slot, drive) in &mut joints {
            let part = Part::of(*slot);
            if Some(drive.effort) == no_motors {
                drive.effort_is = Limit::Uniform(drive.effort);
                drive.effort = round(self.assumed_effort(part));
            }
            drive.stiffness = round(self.stiffness(part, drive.effort));
            drive.damping = round(damping(part) * drive.stiffness);
        }
    }

    /// Weight times height of the hips, N m.
    fn load(self) -> f64 {
        self.mass * GRAVITY * self.hip_height
    }

    /// Stiffness of a joint with this effort limit, N m/rad.
    fn stiffness(self, part: Part, effort: f64) -> f64 {
        let leg = LEG * (self.mass / USUAL_MASS).powf(POWER_OF_MASS) * self.load();
        let mean = |power: f64| leg.powf(1.0 - power) * effort.powf(power);
        match part {
            Part::Leg => mean(POWER_IN_LEGS),
            Part::Torso => mean(POWER_IN_TORSO),
            Part::Ankle => effort.min(leg),
            Part::Arm => (ARM * self.load()).min(leg),
        }
    }

    /// Effort limit of a joint whose URDF has only a placeholder, N m.
    fn assumed_effort(self, part: Part) -> f64 {
        let of_ankles = EFFORT_OF_ANKLES * (self.mass / HEAVY).cbrt().recip();
        self.load() * if part == Part::Ankle { of_ankles.min(EFFORT) } else { EFFORT }
    }
}

/// Damping over stiffness, s.
fn damping(part: Part) -> f64 {
    match part {
        Part::Leg | Part::Torso => DAMPING,
        Part::Ankle => DAMPING_OF_ANKLES,
        Part::Arm => DAMPING_OF_ARMS,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Effort over load.
    fn assumed(slot: &str, mass: f64) -> f64 {
        let body = Body { mass, hip_height: 0.7 };
        body.assumed_effort(Part::of(Slot::parse(slot).unwrap())) / body.load()
    }

    /// A robot of 3.4 kg sags by 0.7 rad on ankles of a sixth of its load, and learns no step.
    #[test]
    fn ankles_of_light_robots_are_assumed_to_be_as_strong_as_their_legs() {
        assert!((assumed("L_ANKLE_PITCH", 3.4) - assumed("L_KNEE", 3.4)).abs() < 1e-12);
        assert!((assumed("L_ANKLE_PITCH", 50.0) - 0.16).abs() < 1e-12);
        assert!((assumed("L_KNEE", 50.0) - 0.38).abs() < 1e-12);
        assert!((assumed("L_ANKLE_ROLL", 50.0 / 8.0) - 0.32).abs() < 1e-12);
    }

    #[test]
    fn parts_follow_from_slots() {
        let parts = [
            ("L_HIP_YAW", Part::Leg),
            ("R_KNEE", Part::Leg),
            ("R_ANKLE_ROLL", Part::Ankle),
            ("TORSO_YAW", Part::Torso),
            ("L_SHOULDER_PITCH", Part::Arm),
            ("R_FINGER_2", Part::Arm),
            ("HEAD_PITCH", Part::Arm),
        ];
        for (slot, part) in parts {
            assert_eq!(Part::of(Slot::parse(slot).unwrap()), part, "{slot}");
        }
    }

    #[test]
    fn an_ankle_is_never_stiffer_than_a_leg_and_a_leg_follows_its_motor() {
        let body = Body { mass: USUAL_MASS, hip_height: 0.5 };
        let leg = LEG * body.load();
        assert!((body.stiffness(Part::Leg, leg) - leg).abs() < 1e-9);
        assert!((body.stiffness(Part::Leg, 16.0 * leg) - 2.0 * leg).abs() < 1e-9);
        assert!((body.stiffness(Part::Torso, 4.0 * leg) - 2.0 * leg).abs() < 1e-9);
        assert_eq!(body.stiffness(Part::Ankle, 5.0).to_bits(), 5.0_f64.to_bits());
        assert_eq!(body.stiffness(Part::Ankle, 2.0 * leg).to_bits(), leg.to_bits());
    }
}
