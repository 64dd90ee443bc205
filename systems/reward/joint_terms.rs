//! Reward terms on joints: all of a robot's, or those that patterns name; their sum, or their mean.
//!
//! Formulas: Isaac Lab's velocity-tracking tasks (BSD-3-Clause), names as there. A sum grows with
//! the number of joints; a mean gives robots of 6 and of 29 joints the same weight.

use serde::Deserialize;

use super::{norm, sum_of_squares};
use crate::config::quantities::SpeedThreshold;
use crate::config::{check_pattern, matches, values};
use crate::engine::device::FormKind;
use crate::morphology::MorphologyModel;
use crate::robot::Slot;
use crate::systems::terms::{FormLists, NoParams, Registry};
use crate::systems::view::RobotView;

/// Joints of a term. The default: the sum over all of them.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Joints {
    /// Patterns on canonical names, such as `*_KNEE`; `*` stands for any run of letters. Default:
    /// all joints.
    joints: Option<Vec<String>>,
    /// Whether the mean over the joints is taken in place of the sum.
    #[serde(default)]
    mean: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Mean {
    /// The mean over joints in place of their sum.
    #[serde(default)]
    mean: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StandStill {
    /// Planar speed below which the robot is told to stand, m/s. Isaac Lab's default.
    #[serde(default = "command_threshold", deserialize_with = "values::number_of::<SpeedThreshold, _, _>")]
    command_threshold: f32,
    /// Patterns on canonical names, such as `*_KNEE`. Default: all joints.
    joints: Option<Vec<String>>,
    /// Whether the mean over the joints is taken in place of the sum.
    #[serde(default)]
    mean: bool,
}

fn command_threshold() -> f32 {
    0.06
}

/// The joints of a robot that a term is about.
struct OnJoints {
    /// Physical joints; None: all of them, in order.
    joints: Option<Vec<usize>>,
    /// 1 for the sum, 1 over their number for the mean.
    factor: f32,
}

impl OnJoints {
    /// Joints of the patterns. Errors hold key, problem and remedy of a pattern that no robot could
    /// match; a pattern without joints on this robot is an empty set.
    fn new(patterns: Option<&[String]>, mean: bool, robot: &MorphologyModel) -> Result<Self, (String, String, String)> {
        for (index, pattern) in patterns.iter().copied().flatten().enumerate() {
            check_pattern(&format!("joints[{index}]"), pattern)?;
        }
        let joints = patterns.map(|patterns| {
            let is_named = |slot: &Slot| patterns.iter().any(|pattern| matches(pattern, &slot.to_string()));
            // joints that the policy does not drive are among them
            let all = robot.roles.slots.iter().zip(&robot.roles.joint_of_slot);
            let mut joints: Vec<usize> = all.filter(|(slot, _)| is_named(slot)).map(|(_, &joint)| joint).collect();
            joints.sort_unstable();
            joints
        });
        let count = joints.as_ref().map_or(robot.roles.slots.len(), Vec::len);
        Ok(Self { joints, factor: if mean { 1.0 / count.max(1) as f32 } else { 1.0 } })
    }

    /// Sum or mean of `value` over the joints, by physical joint.
    #[inline(always)]
    fn of(&self, count: usize, value: impl Fn(usize) -> f32) -> f32 {
        let sum: f32 = match &self.joints {
            None => (0..count).map(value).sum(),
            Some(joints) => joints.iter().map(|&joint| value(joint)).sum(),
        };
        self.factor * sum
    }

    /// Factor, another number and joints, as a device reads them.
    fn lists(self, number: Option<f32>) -> FormLists {
        let joints = self.joints.map(|joints| joints.into_iter().map(|joint| joint as i32).collect());
        (std::iter::once(self.factor).chain(number).collect(), joints)
    }

    /// Sum or mean of the squares.
    #[inline(always)]
    fn squares(&self, x: &[f32]) -> f32 {
        let sum = match &self.joints {
            None => sum_of_squares(x),
            Some(joints) => joints.iter().fold(0.0, |sum: f32, &joint| x[joint].mul_add(x[joint], sum)),
        };
        self.factor * sum
    }
}

pub(super) fn register(registry: &mut Registry) {
    // Sum or mean of the squared applied torques, N^2 m^2.
    registry.reward_for("dof_torques_l2", joints, |on, r| on.squares(&r.effort.applied));
    // Sum or mean of the squared joint accelerations, rad^2/s^4.
    registry.reward_for("dof_acc_l2", joints, |on, r| on.squares(&r.effort.acceleration));
    // Sum or mean of the squared joint velocities, rad^2/s^2.
    registry.reward_for("joint_vel_l2", joints, |on, r| on.squares(&r.joints.velocity));
    registry.reward_for("joint_deviation_l1", joints, joint_deviation_l1);
    registry.reward_for("joint_pos_limits", joints, joint_pos_limits);
    registry.reward_for("stand_still_joint_deviation_l1", stand_still, stand_still_joint_deviation_l1);
    // Sum or mean of the squared changes of the action since the last control step.
    registry.reward_for("action_rate_l2", share, |factor, r| factor * action_change(r));
    // Euclidean norm of the change of the action since the last control step.
    registry.reward("action_smoothness", |_: &NoParams, r| action_change(r).sqrt());
    on_device(registry);
}

/// The numbers of these terms in `device/env.h`.
fn on_device(registry: &mut Registry) {
    for name in ["dof_torques_l2", "dof_acc_l2", "joint_vel_l2", "joint_deviation_l1", "joint_pos_limits"] {
        registry.on_device(FormKind::Reward, name, |p, robot| Some(joints(p, robot).ok()?.lists(None)));
    }
    registry.on_device(FormKind::Reward, "stand_still_joint_deviation_l1", |p, robot| {
        let (threshold, on) = stand_still(p, robot).ok()?;
        Some(on.lists(Some(threshold)))
    });
    registry.on_device(FormKind::Reward, "action_rate_l2", |p, robot| {
        Some((vec![share(p, robot).ok()?], Some(Vec::new())))
    });
    registry.reward_on_device("action_smoothness", |_: NoParams| Vec::new());
}

fn joints(p: Joints, robot: &MorphologyModel) -> Result<OnJoints, (String, String, String)> {
    OnJoints::new(p.joints.as_deref(), p.mean, robot)
}

fn share(p: Mean, robot: &MorphologyModel) -> Result<f32, (String, String, String)> {
    Ok(if p.mean { 1.0 / robot.slots.len().max(1) as f32 } else { 1.0 })
}

fn stand_still(p: StandStill, robot: &MorphologyModel) -> Result<(f32, OnJoints), (String, String, String)> {
    Ok((p.command_threshold, OnJoints::new(p.joints.as_deref(), p.mean, robot)?))
}

/// Squared change of the action. Columns of joints that the robot lacks are zero.
#[inline(always)]
fn action_change(r: &RobotView) -> f32 {
    let pairs = r.action.current.iter().zip(&r.action.previous);
    pairs.fold(0.0, |sum: f32, (a, b)| (a - b).mul_add(a - b, sum))
}

/// Sum or mean of the distances of the joints from the default pose, rad.
#[inline(always)]
fn joint_deviation_l1(on: &OnJoints, r: &RobotView) -> f32 {
    let (q, default) = (&r.joints.position, &r.stance.default_position);
    on.of(q.len(), |joint| (q[joint] - default[joint]).abs())
}

/// Sum of the distances of positions beyond the soft limits: `reset.soft_limit_factor` of each
/// joint's range, about its middle. A joint without two limits has no range, and its soft limits
/// are those that it has.
#[inline(always)]
fn joint_pos_limits(on: &OnJoints, r: &RobotView) -> f32 {
    let (q, lower, upper) = (&r.joints.position, &r.body.lower, &r.body.upper);
    let soft = r.morphology.config.reset.soft_limit_factor as f32;
    on.of(q.len(), |joint| {
        let (lower, upper) = (lower[joint], upper[joint]);
        let range = upper - lower;
        let margin = if range.is_finite() { 0.5 * (1.0 - soft) * range } else { 0.0 };
        (lower + margin - q[joint]).max(q[joint] - upper + margin).max(0.0)
    })
}

/// `joint_deviation_l1` while the robot is told to stand, else 0.
#[inline(always)]
fn stand_still_joint_deviation_l1((threshold, on): &(f32, OnJoints), r: &RobotView) -> f32 {
    if norm(&r.command[..2]) < *threshold { joint_deviation_l1(on, r) } else { 0.0 }
}
