//! Reward terms that follow commands other than the velocity.
//!
//! Formulas and names: Isaac Lab's navigation task (BSD-3-Clause) for headings and places, Walk
//! These Ways (MIT) for poses and gaits.

use serde::Deserialize;

use super::{norm, sum_of_squares};
use crate::config::quantities::{Gain, Width};
use crate::config::values;
use crate::dynamics::elementary::{exp, tanh_positive};
use crate::dynamics::lanes::Real;
use crate::engine::device::FormKind;
use crate::systems::command::gait::{GAIT, desired_contact, foot_clock};
use crate::systems::command::heading::{HEADING, heading_error};
use crate::systems::command::pose::POSE;
use crate::systems::command::position::{POSITION, position_error};
use crate::systems::terms::{NoParams, Registry};
use crate::systems::view::RobotView;

/// Width of a tracking reward, in the units of what is tracked.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Std {
    /// Width of the curve, m.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
}

/// Command whose heading counts.
#[derive(Clone, Copy, Default, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Heading {
    #[default]
    Heading,
    Position,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct HeadingOf {
    /// The command `heading` or `position`. Default: `heading`.
    #[serde(default)]
    command_name: Heading,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ForceSigma {
    /// Width of the bell curve over squared forces, N^2. Walk These Ways' default.
    #[serde(default = "hundred", deserialize_with = "values::number_of::<Gain, _, _>")]
    gait_force_sigma: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct VelocitySigma {
    /// Width of the bell curve over squared speeds, m^2/s^2. Walk These Ways' default.
    #[serde(default = "ten", deserialize_with = "values::number_of::<Gain, _, _>")]
    gait_vel_sigma: f32,
}

fn hundred() -> f32 {
    100.0
}

fn ten() -> f32 {
    10.0
}

pub(super) fn register(registry: &mut Registry) {
    registry.reward("track_base_height_exp", track_base_height_exp);
    registry.needs_command("track_base_height_exp", POSE);
    registry.reward("orientation_control", orientation_control);
    registry.needs_command("orientation_control", POSE);
    registry.reward("heading_command_error_abs", heading_command_error_abs);
    registry.needs_command("heading_command_error_abs", HEADING);
    registry.reward("position_command_error_tanh", position_command_error_tanh);
    registry.needs_command("position_command_error_tanh", POSITION);
    registry.reward("tracking_contacts_shaped_force", tracking_contacts_shaped_force);
    registry.needs_command("tracking_contacts_shaped_force", GAIT);
    registry.reward("tracking_contacts_shaped_vel", tracking_contacts_shaped_vel);
    registry.needs_command("tracking_contacts_shaped_vel", GAIT);
    on_device(registry);
}

/// The numbers of these terms in `device/env.h`.
fn on_device(registry: &mut Registry) {
    for name in ["track_base_height_exp", "position_command_error_tanh"] {
        registry.reward_on_device(name, |p: Std| vec![p.std]);
    }
    registry.reward_on_device("orientation_control", |_: NoParams| Vec::new());
    registry.on_device(FormKind::Reward, "heading_command_error_abs", |p: HeadingOf, _| {
        Some((Vec::new(), Some(vec![i32::from(p.command_name == Heading::Position)])))
    });
    registry.reward_on_device("tracking_contacts_shaped_force", |p: ForceSigma| vec![p.gait_force_sigma]);
    registry.reward_on_device("tracking_contacts_shaped_vel", |p: VelocitySigma| vec![p.gait_vel_sigma]);
}

/// exp(-e^2 / std^2) of the error e of the base's height, m.
#[inline(always)]
fn track_base_height_exp(p: &Std, r: &RobotView) -> f32 {
    let [height, ..]: [f32; 3] = r.commands.first(POSE);
    let error = height - r.base_height();
    exp(-error * error / (p.std * p.std))
}

/// Squared distance of gravity across the base from where the commanded roll and pitch put it.
#[inline(always)]
fn orientation_control(_: &NoParams, r: &RobotView) -> f32 {
    let [_, roll, pitch] = r.commands.first(POSE);
    let ((sin_roll, _), (sin_pitch, cos_pitch)) = (Real::sin_cos(roll), Real::sin_cos(pitch));
    let gravity = &r.imu.projected_gravity;
    sum_of_squares(&[gravity[0] - sin_pitch, gravity[1] + sin_roll * cos_pitch])
}

/// Angle between the heading and the commanded one, rad.
#[inline(always)]
fn heading_command_error_abs(p: &HeadingOf, r: &RobotView) -> f32 {
    match p.command_name {
        Heading::Heading => heading_error(r).abs(),
        Heading::Position => position_error(r)[2].abs(),
    }
}

/// 1 - tanh(d / std) of the distance d to the commanded place, m.
#[inline(always)]
fn position_command_error_tanh(p: &Std, r: &RobotView) -> f32 {
    1.0 - tanh_positive(norm(&position_error(r)[..2]) / p.std)
}

/// Cost of pressing on feet that are to swing: a mean over the feet, 0 to -1.
#[inline(always)]
fn tracking_contacts_shaped_force(p: &ForceSigma, r: &RobotView) -> f32 {
    mean_over_feet(r, |foot, wanted| {
        let force = r.contacts.peak_force[r.morphology.feet[foot]];
        (1.0 - wanted) * (1.0 - exp(-force * force / p.gait_force_sigma.max(f32::MIN_POSITIVE)))
    })
}

/// Cost of moving feet that are to stand: a mean over the feet, 0 to -1.
#[inline(always)]
fn tracking_contacts_shaped_vel(p: &VelocitySigma, r: &RobotView) -> f32 {
    mean_over_feet(r, |foot, wanted| {
        let speed = sum_of_squares(&r.feet.velocity[foot]);
        wanted * (1.0 - exp(-speed / p.gait_vel_sigma.max(f32::MIN_POSITIVE)))
    })
}

/// Mean of a cost by foot and wanted share of standing, negated.
#[inline(always)]
fn mean_over_feet(r: &RobotView, cost: impl Fn(usize, f32) -> f32) -> f32 {
    let feet = r.morphology.feet.len();
    let sum: f32 = (0..feet).map(|foot| cost(foot, desired_contact(foot_clock(r, foot)))).sum();
    -sum / feet.max(1) as f32
}
