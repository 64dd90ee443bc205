//! Reward terms on joints in units of the body, so that one weight serves bodies of 2 and of 90 kg.
//!
//! Units are those of dynamic similarity (Alexander and Jayes, 1983): a torque counts as a share of
//! the weight times the height at which the robot stands ([`MorphologyModel::standing_height`]), an
//! acceleration as a share of gravity over that height. All are means over the joints.

use super::sum_of_squares;
use crate::engine::device::FormKind;
#[cfg(doc)]
use crate::morphology::MorphologyModel;
use crate::systems::terms::{NoParams, Registry};
use crate::systems::view::RobotView;

pub(super) fn register(registry: &mut Registry) {
    // Mean of the squared torques, each as a share of weight times the height at which the robot
    // stands.
    registry.reward("scaled_torques_l2", |_: &NoParams, r| {
        let load = weight(r) * standing_height(r);
        if load > 0.0 { mean_square(&r.effort.applied) / (load * load) } else { 0.0 }
    });
    // Mean of the squared joint accelerations, each in units of gravity over the height at which
    // the robot stands.
    registry.reward("scaled_acc_l2", |_: &NoParams, r| {
        let gravity = r.ground.free_fall();
        let unit = if gravity > 0.0 { standing_height(r) / gravity } else { 0.0 };
        mean_square(&r.effort.acceleration) * (unit * unit)
    });
    for name in ["scaled_torques_l2", "scaled_acc_l2"] {
        registry
            .on_device(FormKind::Reward, name, |NoParams {}, robot| Some((vec![robot.hip_height], Some(Vec::new()))));
    }
}

#[inline(always)]
fn mean_square(x: &[f32]) -> f32 {
    sum_of_squares(x) / x.len().max(1) as f32
}

/// Height at which this body stands in its default pose, m.
#[inline(always)]
fn standing_height(r: &RobotView) -> f32 {
    r.morphology.standing_height(r.default_height())
}

/// Weight of the robot as randomised, N.
#[inline(always)]
fn weight(r: &RobotView) -> f32 {
    r.body.total_mass() * r.ground.free_fall()
}
