//! Reward terms on joints in units of the body, so that one weight serves bodies of 2 and of 90 kg.
//!
//! Units are those of dynamic similarity (Alexander and Jayes, 1983): a torque counts as a share of
//! the weight times the height of the base in the default pose, an acceleration as a share of
//! gravity over that height. All are means over the joints.

use super::sum_of_squares;
use crate::systems::terms::{NoParams, Registry};
use crate::systems::view::RobotView;

pub(super) fn register(registry: &mut Registry) {
    // Mean of the squared torques, each as a share of weight times height of the base.
    registry.reward("scaled_torques_l2", |_: &NoParams, r| {
        let load = weight(r) * r.default_height();
        if load > 0.0 { mean_square(&r.effort.applied) / (load * load) } else { 0.0 }
    });
    // Mean of the squared joint accelerations, each in units of gravity over height of the base.
    registry.reward("scaled_acc_l2", |_: &NoParams, r| {
        let gravity = r.ground.free_fall();
        let unit = if gravity > 0.0 { r.default_height() / gravity } else { 0.0 };
        mean_square(&r.effort.acceleration) * (unit * unit)
    });
    for name in ["scaled_torques_l2", "scaled_acc_l2"] {
        registry.reward_on_device(name, |_: NoParams| Vec::new());
    }
}

#[inline(always)]
fn mean_square(x: &[f32]) -> f32 {
    sum_of_squares(x) / x.len().max(1) as f32
}

/// Weight of the robot as randomised, N.
#[inline(always)]
fn weight(r: &RobotView) -> f32 {
    r.body.total_mass() * r.ground.free_fall()
}
