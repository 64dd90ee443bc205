//! Reward terms that follow a commanded jump.

use serde::Deserialize;

use super::sum_of_squares;
use crate::config::quantities::Width;
use crate::config::values;
use crate::dynamics::elementary::exp;
use crate::engine::device::FormKind;
use crate::morphology::MorphologyModel;
use crate::systems::command::jump::{JUMP, jump};
use crate::systems::terms::{NoParams, Registry};
use crate::systems::view::RobotView;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct HeightParams {
    /// Width of the bell curve over the error of height, as a share of the height of the hips in
    /// the default pose.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct VelocityParams {
    /// Width of the bell curve over the error of planar velocity, m/s.
    #[serde(deserialize_with = "values::number_of::<Width, _, _>")]
    std: f32,
}

struct JumpHeight {
    default: f32,
    /// 1 over width times height of the hips, squared, 1/m^2.
    inverse_square: f32,
}

pub(super) fn register(registry: &mut Registry) {
    registry.reward_for("jump_height_exp", prepare_height, jump_height_exp);
    registry.needs_command("jump_height_exp", JUMP);
    registry.reward("jump_velocity_exp", jump_velocity_exp);
    registry.needs_command("jump_velocity_exp", JUMP);
    registry.reward("jump_contacts", jump_contacts);
    registry.needs_command("jump_contacts", JUMP);
    registry.on_device(FormKind::Reward, "jump_height_exp", |p, robot| {
        let JumpHeight { default, inverse_square } = prepare_height(p, robot).ok()?;
        Some((vec![default, inverse_square], Some(Vec::new())))
    });
    registry.reward_on_device("jump_velocity_exp", |p: VelocityParams| vec![p.std]);
    registry.reward_on_device("jump_contacts", |_: NoParams| Vec::new());
}

fn prepare_height(p: HeightParams, robot: &MorphologyModel) -> Result<JumpHeight, (String, String, String)> {
    let unit = p.std * robot.default_hip_height().max(1e-3);
    Ok(JumpHeight { default: robot.default_height(), inverse_square: 1.0 / (unit * unit) })
}

/// Bell curve over the error of the base's height.
#[inline(always)]
fn jump_height_exp(p: &JumpHeight, r: &RobotView) -> f32 {
    let error = r.base_height() - p.default - jump(r).rise;
    exp(-error * error * p.inverse_square)
}

/// Bell curve over the error of the base's planar velocity, in axes of its heading.
#[inline(always)]
fn jump_velocity_exp(p: &VelocityParams, r: &RobotView) -> f32 {
    let [x, y, _] = r.velocity.linear;
    let [c, s] = r.pose.forward();
    let error = [c * x + s * y - jump(r).speed, c * y - s * x];
    exp(-sum_of_squares(&error) / (p.std * p.std))
}

/// Share of the feet that are in the air in flight, and stand else.
#[inline(always)]
fn jump_contacts(_: &NoParams, r: &RobotView) -> f32 {
    let flies = jump(r).flies;
    let feet = &r.morphology.feet;
    // Isaac Lab's threshold of a contact, N
    let right = feet.iter().filter(|body| (r.contacts.peak_force[**body] <= 1.0) == flies);
    right.count() as f32 / feet.len().max(1) as f32
}
