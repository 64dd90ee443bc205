//! Reward terms on gaits, for any number of feet.
//!
//! Formulas: Isaac Lab's locomotion tasks and Hetero-IsaacLab's humanoid task (BSD-3-Clause), names
//! as there.

use serde::Deserialize;

use super::{STANDING, norm, stands};
use crate::config::quantities::{ForceThreshold, Time};
use crate::config::values;
use crate::dynamics::elementary::exp;
use crate::systems::terms::{NoParams, Registry};
use crate::systems::view::RobotView;

/// Commanded yaw rate at which feet may step unevenly, rad/s: the width of a bell curve.
const TURNING: f32 = 0.25;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StrideTime {
    /// Longest stride that is rewarded, s.
    #[serde(deserialize_with = "values::number_of::<Time, _, _>")]
    threshold: f32,
    /// Whether a pure turn is rewarded too, as in mjlab; Isaac Lab rewards strides on the way
    /// alone.
    #[serde(default)]
    turning: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Force {
    /// Normal force from which a foot stands, N. Isaac Lab's default.
    #[serde(default = "one", deserialize_with = "values::number_of::<ForceThreshold, _, _>")]
    threshold: f32,
}

fn one() -> f32 {
    1.0
}

pub(super) fn register(registry: &mut Registry) {
    registry.reward("feet_air_time_positive_biped", feet_air_time_positive_biped);
    registry.reward("feet_slide", feet_slide);
    registry.reward("desired_contacts", desired_contacts);
    registry.reward("gait_symmetry", gait_symmetry);
    // the numbers of these terms in `device/env.h`
    registry.reward_on_device("feet_air_time_positive_biped", |p: StrideTime| {
        vec![p.threshold, f32::from(u8::from(p.turning))]
    });
    registry.reward_on_device("feet_slide", |p: Force| vec![p.threshold]);
    registry.reward_on_device("desired_contacts", |p: Force| vec![p.threshold]);
    registry.reward_on_device("gait_symmetry", |_: NoParams| Vec::new());
}

/// While one foot stands alone: the least of its contact time and the others' air times.
#[inline(always)]
fn feet_air_time_positive_biped(p: &StrideTime, r: &RobotView) -> f32 {
    let c = r.contacts;
    let standing = c.contact_time.iter().filter(|time| **time > 0.0).count();
    if standing != 1 || stands(r.command, p.turning) {
        return 0.0;
    }
    let phases = c.contact_time.iter().zip(&c.air_time);
    phases.map(|(&contact, &air)| if contact > 0.0 { contact } else { air }).fold(p.threshold, f32::min)
}

/// Sum of the planar speeds of the feet that stand, m/s.
#[inline(always)]
fn feet_slide(p: &Force, r: &RobotView) -> f32 {
    let feet = r.morphology.feet.iter().zip(&r.feet.velocity);
    feet.filter(|(body, _)| r.contacts.peak_force[**body] > p.threshold).map(|(_, v)| norm(&v[..2])).sum()
}

/// 1 while no foot stands.
#[inline(always)]
fn desired_contacts(p: &Force, r: &RobotView) -> f32 {
    let stands = r.morphology.feet.iter().any(|&foot| r.contacts.peak_force[foot] > p.threshold);
    f32::from(u8::from(!stands))
}

/// Asymmetry of a gait: when a foot lands, the difference of its last flight from the opposite
/// foot's, s, summed over pairs.
#[inline(always)]
fn gait_symmetry(_: &NoParams, r: &RobotView) -> f32 {
    if norm(r.command) <= STANDING {
        return 0.0;
    }
    let c = r.contacts;
    // a contact time within the control step, give or take rounding
    let landed = |foot: usize| c.contact_time[foot] > 0.0 && c.contact_time[foot] < r.step_dt + 1e-5;
    // left feet come first, the right ones in the same order
    let pairs = c.last_air_time.len() / 2;
    let uneven: f32 = (0..pairs)
        .map(|left| (left, left + pairs))
        .filter(|&(left, right)| landed(left) || landed(right))
        .map(|(left, right)| (c.last_air_time[left], c.last_air_time[right]))
        .filter(|(left, right)| *left > 0.0 && *right > 0.0)
        .map(|(left, right)| (left - right).abs())
        .sum();
    let turn = r.command[2] / TURNING;
    uneven * exp(-0.5 * turn * turn)
}
