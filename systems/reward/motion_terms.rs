//! Reward terms on the motion of base and joints.
//!
//! Formulas: Isaac Lab's velocity-tracking tasks and its task with gait terms (BSD-3-Clause), names
//! as there.

use serde::Deserialize;

use super::{norm, sum_of_squares};
use crate::config::quantities::{Factor, Gain, Height as HeightRange, SpeedThreshold, Width};
use crate::config::values;
use crate::dynamics::elementary::exp;
use crate::engine::device::FormKind;
use crate::morphology::MorphologyModel;
use crate::systems::terms::{NoParams, Registry};
use crate::systems::view::RobotView;

/// Width of a tracking reward, in the units of what is tracked.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Std {
    /// Width of the curve, in units of the error.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RampedStd {
    /// Width of the curve, m/s.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
    /// Commanded speed from which the reward grows, m/s.
    #[serde(deserialize_with = "values::number_of::<SpeedThreshold, _, _>")]
    ramp_at_vel: f32,
    /// Growth per m/s.
    #[serde(deserialize_with = "values::number_of::<Gain, _, _>")]
    ramp_rate: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Height {
    /// Wanted height of the base, m. Default: the height in the robot's default pose.
    #[serde(default, deserialize_with = "values::optional_of::<HeightRange, _, _>")]
    target_height: Option<f32>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StandStill {
    /// Factor for a robot that shall stand and stands.
    #[serde(deserialize_with = "values::number_of::<Factor, _, _>")]
    stand_still_scale: f32,
    /// Planar speed up to which it counts as standing, m/s.
    #[serde(deserialize_with = "values::number_of::<SpeedThreshold, _, _>")]
    velocity_threshold: f32,
}

pub(super) fn register(registry: &mut Registry) {
    registry.reward("track_lin_vel_xy_exp", track_lin_vel_xy_exp);
    registry.reward("track_ang_vel_z_exp", track_ang_vel_z_exp);
    // Squared vertical velocity of the base, base axes, m^2/s^2.
    registry.reward("lin_vel_z_l2", |_: &NoParams, r| r.imu.linear_velocity[2] * r.imu.linear_velocity[2]);
    // Sum of the squared roll and pitch rates of the base, rad^2/s^2.
    registry.reward("ang_vel_xy_l2", |_: &NoParams, r| sum_of_squares(&r.imu.angular_velocity[..2]));
    // Squared sine of the angle between base and vertical.
    registry.reward("flat_orientation_l2", |_: &NoParams, r| sum_of_squares(&r.imu.projected_gravity[..2]));
    registry.reward("base_angular_velocity", base_angular_velocity);
    registry.reward("base_linear_velocity", base_linear_velocity);
    registry.reward_for("base_height_l2", base_height, base_height_l2);
    registry.reward("base_motion", base_motion);
    // Sine of the angle between base and vertical.
    registry.reward("base_orientation", |_: &NoParams, r| norm(&r.imu.projected_gravity[..2]));
    // Euclidean norm of the joint accelerations, rad/s^2.
    registry.reward("joint_acc", |_: &NoParams, r| norm(&r.effort.acceleration));
    registry.reward("joint_pos", joint_pos);
    // Euclidean norm of the applied torques, N m.
    registry.reward("joint_torques", |_: &NoParams, r| norm(&r.effort.applied));
    // 1 unless the episode fails in this step.
    registry.reward("is_alive", |_: &NoParams, r| f32::from(u8::from(!r.terminated)));
    // 1 if the episode fails in this step.
    registry.reward("is_terminated", |_: &NoParams, r| f32::from(u8::from(r.terminated)));
    // Euclidean norm of the joint velocities, rad/s.
    registry.reward("joint_vel", |_: &NoParams, r| norm(&r.joints.velocity));
    on_device(registry);
}

/// The numbers of these terms in `device/env.h`.
fn on_device(registry: &mut Registry) {
    for name in ["track_lin_vel_xy_exp", "track_ang_vel_z_exp", "base_angular_velocity"] {
        registry.reward_on_device(name, |p: Std| vec![p.std]);
    }
    registry.reward_on_device("base_linear_velocity", |p: RampedStd| vec![p.std, p.ramp_at_vel, p.ramp_rate]);
    registry.reward_on_device("joint_pos", |p: StandStill| vec![p.stand_still_scale, p.velocity_threshold]);
    registry.on_device(FormKind::Reward, "base_height_l2", |p, robot| {
        Some((vec![base_height(p, robot).ok()?], Some(Vec::new())))
    });
    for name in [
        "lin_vel_z_l2",
        "ang_vel_xy_l2",
        "flat_orientation_l2",
        "base_motion",
        "base_orientation",
        "joint_acc",
        "joint_torques",
        "is_alive",
        "is_terminated",
        "joint_vel",
    ] {
        registry.reward_on_device(name, |_: NoParams| Vec::new());
    }
}

/// Planar velocity error: commanded less measured, m/s.
#[inline(always)]
fn velocity_error(r: &RobotView) -> [f32; 2] {
    [r.command[0] - r.imu.linear_velocity[0], r.command[1] - r.imu.linear_velocity[1]]
}

/// Whether the robot is told to move or moves faster than `threshold`, m/s.
#[inline(always)]
pub(super) fn is_moving(r: &RobotView, threshold: f32) -> bool {
    norm(r.command) > 0.0 || norm(&r.imu.linear_velocity[..2]) > threshold
}

/// exp(-e^2 / std^2) of the planar velocity error e, m/s.
#[inline(always)]
fn track_lin_vel_xy_exp(p: &Std, r: &RobotView) -> f32 {
    exp(-sum_of_squares(&velocity_error(r)) / (p.std * p.std))
}

/// exp(-e^2 / std^2) of the yaw rate error e, rad/s.
#[inline(always)]
fn track_ang_vel_z_exp(p: &Std, r: &RobotView) -> f32 {
    let error = r.command[2] - r.imu.angular_velocity[2];
    exp(-error * error / (p.std * p.std))
}

/// exp(-|e| / std) of the yaw rate error e, rad/s.
#[inline(always)]
fn base_angular_velocity(p: &Std, r: &RobotView) -> f32 {
    exp(-(r.command[2] - r.imu.angular_velocity[2]).abs() / p.std)
}

/// exp(-|e| / std) of the planar velocity error e, m/s, times a factor that grows with the
/// commanded speed.
#[inline(always)]
fn base_linear_velocity(p: &RampedStd, r: &RobotView) -> f32 {
    let ramp = (1.0 + p.ramp_rate * (norm(&r.command[..2]) - p.ramp_at_vel)).max(1.0);
    exp(-norm(&velocity_error(r)) / p.std) * ramp
}

/// 0.8 v_z^2 + 0.2 (|w_x| + |w_y|) of the velocities in base axes, m/s and rad/s.
#[inline(always)]
fn base_motion(_: &NoParams, r: &RobotView) -> f32 {
    let (v, w) = (&r.imu.linear_velocity, &r.imu.angular_velocity);
    0.8 * v[2] * v[2] + 0.2 * (w[0].abs() + w[1].abs())
}

fn base_height(p: Height, robot: &MorphologyModel) -> Result<f32, (String, String, String)> {
    let default = robot.default_height();
    Ok(p.target_height.unwrap_or(default))
}

/// Squared distance of the base's height from the wanted one, m^2.
#[inline(always)]
fn base_height_l2(target: &f32, r: &RobotView) -> f32 {
    let error = r.base_height() - target;
    error * error
}

/// Euclidean distance of the joints from the default pose, rad; scaled while the robot stands.
#[inline(always)]
fn joint_pos(p: &StandStill, r: &RobotView) -> f32 {
    let pairs = r.joints.position.iter().zip(&r.stance.default_position);
    let distance = pairs.fold(0.0, |sum: f32, (q, q0)| (q - q0).mul_add(q - q0, sum)).sqrt();
    if is_moving(r, p.velocity_threshold) { distance } else { p.stand_still_scale * distance }
}
