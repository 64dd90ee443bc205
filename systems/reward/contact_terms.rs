//! Reward terms on contacts and feet.
//!
//! Formulas: Isaac Lab's velocity-tracking tasks and its task with gait terms (BSD-3-Clause), names
//! as there.

use serde::Deserialize;

use super::motion_terms::is_moving;
use super::{norm, stands};
use crate::config::quantities::{ForceThreshold, Gain, Height, SpeedThreshold, Time, Width};
use crate::config::values;
use crate::dynamics::elementary::{exp, tanh_positive};
use crate::engine::device::FormKind;
use crate::systems::groups::BodiesInContact;
use crate::systems::terms::Registry;
use crate::systems::view::RobotView;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AirTimeThreshold {
    /// Flight time without reward or cost, s.
    #[serde(deserialize_with = "values::number_of::<Time, _, _>")]
    threshold: f32,
    /// Whether a pure turn is rewarded too, as in mjlab; Isaac Lab rewards strides on the way
    /// alone.
    #[serde(default)]
    turning: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ModeTime {
    /// Longest stride that is rewarded, s.
    #[serde(deserialize_with = "values::number_of::<Time, _, _>")]
    mode_time: f32,
    /// Planar speed from which an uncommanded robot counts as moving, m/s.
    #[serde(deserialize_with = "values::number_of::<SpeedThreshold, _, _>")]
    velocity_threshold: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MaxTime {
    /// Longer phases count as this long, s.
    #[serde(deserialize_with = "values::number_of::<Time, _, _>")]
    max_time: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Clearance {
    /// Error at which the reward has fallen to 1/e, m^2.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
    /// Growth of the weight of a foot with its speed, s/m.
    #[serde(deserialize_with = "values::number_of::<Gain, _, _>")]
    tanh_mult: f32,
    /// Height of a swinging foot's centre above the ground, m.
    #[serde(deserialize_with = "values::number_of::<Height, _, _>")]
    target_height: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Force {
    /// Normal force from which a foot stands, N.
    #[serde(deserialize_with = "values::number_of::<ForceThreshold, _, _>")]
    threshold: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Gait {
    /// Error at which the reward has fallen to 1/e, s^2.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
    /// Largest difference of two feet's phase times that counts, s.
    #[serde(deserialize_with = "values::number_of::<Time, _, _>")]
    max_err: f32,
    /// Planar speed from which an uncommanded robot counts as moving, m/s.
    #[serde(deserialize_with = "values::number_of::<SpeedThreshold, _, _>")]
    velocity_threshold: f32,
}

pub(super) fn register(registry: &mut Registry) {
    registry.reward("feet_air_time", feet_air_time);
    registry.reward("undesired_contacts", undesired_contacts);
    registry.reward("air_time", air_time);
    registry.reward("air_time_variance", air_time_variance);
    registry.reward("foot_clearance", foot_clearance);
    registry.reward("foot_slip", foot_slip);
    registry.reward("gait", gait);
    on_device(registry);
}

/// The numbers of these terms in `device/env.h`.
fn on_device(registry: &mut Registry) {
    registry.reward_on_device("feet_air_time", |p: AirTimeThreshold| vec![p.threshold, f32::from(u8::from(p.turning))]);
    registry.on_device(FormKind::Reward, "undesired_contacts", |p: BodiesInContact, _| Some(p.lists()));
    registry.reward_on_device("air_time", |p: ModeTime| vec![p.mode_time, p.velocity_threshold]);
    registry.reward_on_device("air_time_variance", |p: MaxTime| vec![p.max_time]);
    registry.reward_on_device("foot_clearance", |p: Clearance| vec![p.std, p.tanh_mult, p.target_height]);
    registry.reward_on_device("foot_slip", |p: Force| vec![p.threshold]);
    registry.reward_on_device("gait", |p: Gait| vec![p.std, p.max_err, p.velocity_threshold]);
}

/// Flight time less the threshold, s, summed over the feet that land in this control step; 0 for
/// robots that are told to stand.
#[inline(always)]
fn feet_air_time(p: &AirTimeThreshold, r: &RobotView) -> f32 {
    if stands(r.command, p.turning) {
        return 0.0;
    }
    let c = r.contacts;
    // a contact time within the control step, give or take rounding
    let first = |time: f32| time > 0.0 && time < r.step_dt + 1e-5;
    let landed = c.contact_time.iter().zip(&c.last_air_time).filter(|(contact, _)| first(**contact));
    landed.map(|(_, air)| air - p.threshold).sum()
}

/// Number of contact bodies of the groups whose normal force is above the threshold.
#[inline(always)]
fn undesired_contacts(p: &BodiesInContact, r: &RobotView) -> f32 {
    let bodies = r.contacts.peak_force.iter().zip(&r.morphology.body_groups);
    bodies.filter(|(force, group)| **force > p.threshold && p.bodies.contains(group)).count() as f32
}

/// Sum over the feet of the present phase of flight or contact, s, until `mode_time`; for a robot
/// that stands, contact less flight time.
#[inline(always)]
fn air_time(p: &ModeTime, r: &RobotView) -> f32 {
    let moving = is_moving(r, p.velocity_threshold);
    let c = r.contacts;
    let feet = c.air_time.iter().zip(&c.contact_time);
    feet.map(|(&air, &contact)| {
        if !moving {
            return (contact - air).clamp(-p.mode_time, p.mode_time);
        }
        let phase = air.max(contact);
        if phase < p.mode_time { phase } else { 0.0 }
    })
    .sum()
}

/// Variance over the feet of the last flight times plus that of the last contact times, s^2.
#[inline(always)]
fn air_time_variance(p: &MaxTime, r: &RobotView) -> f32 {
    let variance = |times: &[f32]| {
        let n = times.len() as f32;
        let mean = times.iter().map(|t| t.min(p.max_time)).sum::<f32>() / n;
        let squares: f32 = times.iter().map(|t| t.min(p.max_time) - mean).map(|d| d * d).sum();
        squares / (n - 1.0).max(1.0)
    };
    variance(&r.contacts.last_air_time) + variance(&r.contacts.last_contact_time)
}

/// exp(-e / std), where e sums over the feet the squared error of height, m^2, times
/// tanh(`tanh_mult` x planar speed).
#[inline(always)]
fn foot_clearance(p: &Clearance, r: &RobotView) -> f32 {
    let feet = r.feet.height.iter().zip(&r.feet.velocity);
    let error: f32 = feet
        .map(|(height, velocity)| {
            let height = height - p.target_height;
            height * height * tanh_positive(p.tanh_mult * norm(&velocity[..2]))
        })
        .sum();
    exp(-error / p.std)
}

/// Sum of the planar speeds of the feet that stand, m/s.
#[inline(always)]
fn foot_slip(p: &Force, r: &RobotView) -> f32 {
    let feet = r.morphology.feet.iter().zip(&r.feet.velocity);
    feet.filter(|(body, _)| r.contacts.peak_force[**body] > p.threshold).map(|(_, v)| norm(&v[..2])).sum()
}

/// Gait of diagonal pairs that alternate, for robots with four feet in the order LF, LH, RF, RH; 0
/// for others.
#[inline(always)]
fn gait(p: &Gait, r: &RobotView) -> f32 {
    if r.contacts.air_time.len() != 4 || !is_moving(r, p.velocity_threshold) {
        return 0.0;
    }
    let (air, contact) = (&r.contacts.air_time, &r.contacts.contact_time);
    let most = p.max_err * p.max_err;
    let square = |d: f32| (d * d).min(most);
    // exponents are added, which multiplies the factors
    let sync = |i: usize, j: usize| square(air[i] - air[j]) + square(contact[i] - contact[j]);
    let asynchronous = |i: usize, j: usize| square(air[i] - contact[j]) + square(contact[i] - air[j]);
    let (lf, lh, rf, rh) = (0, 1, 2, 3);
    let error = sync(lf, rh)
        + sync(rf, lh)
        + asynchronous(lf, rf)
        + asynchronous(lf, lh)
        + asynchronous(rh, rf)
        + asynchronous(rh, lh);
    exp(-error / p.std)
}
