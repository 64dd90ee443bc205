//! Reward terms that follow commanded places of the feet.
//!
//! Formulas and names: Walk These Ways (MIT). Places are those of the robot's own default pose, for
//! any number of legs, and follow a sideways velocity, too.

use crate::config::VELOCITY_COMMAND;
use crate::engine::device::FormKind;
use crate::morphology::MorphologyModel;
use crate::systems::command::foot_placement::FOOT_PLACEMENT;
use crate::systems::command::gait::{GAIT, desired_contact, foot_clock};
use crate::systems::terms::{NoParams, Registry};
use crate::systems::view::RobotView;

/// Fewest steps per second for which a foot is placed ahead, Hz.
const LEAST_FREQUENCY: f32 = 0.1;

/// Feet in the default pose: places in base axes, and heights above the ground, m.
struct DefaultFeet {
    place: Vec<[f32; 2]>,
    height: Vec<f32>,
}

pub(super) fn register(registry: &mut Registry) {
    registry.reward_for("raibert_heuristic", prepare, raibert_heuristic);
    registry.reward_for("feet_clearance_cmd_linear", prepare, feet_clearance_cmd_linear);
    for command in [FOOT_PLACEMENT, GAIT] {
        registry.needs_command("raibert_heuristic", command);
        registry.needs_command("feet_clearance_cmd_linear", command);
    }
    registry.needs_command("raibert_heuristic", VELOCITY_COMMAND);
    for name in ["raibert_heuristic", "feet_clearance_cmd_linear"] {
        registry.on_device(FormKind::Reward, name, |p, robot| {
            let DefaultFeet { place, height } = prepare(p, robot).ok()?;
            Some((place.concat().into_iter().chain(height).collect(), Some(Vec::new())))
        });
    }
}

fn prepare(_: NoParams, robot: &MorphologyModel) -> Result<DefaultFeet, (String, String, String)> {
    let base = robot.default_height();
    Ok(DefaultFeet {
        place: robot.default_feet.iter().map(|[x, y, _]| [*x, *y]).collect(),
        height: robot.default_feet.iter().map(|[_, _, z]| base + z).collect(),
    })
}

/// Squared distance of the feet from where Raibert's rule sets them down, m^2: half a stance ahead
/// of the commanded velocity at touchdown, half a stance behind it at lift-off.
#[inline(always)]
fn raibert_heuristic(p: &DefaultFeet, r: &RobotView) -> f32 {
    let [width, length, _]: [f32; 3] = r.commands.first(FOOT_PLACEMENT);
    let [_, frequency]: [f32; 2] = r.commands.first(GAIT);
    let half_cycle = 0.5 / frequency.max(LEAST_FREQUENCY);
    let [vx, vy, turn] = *r.command;
    let [c, s] = r.pose.forward();
    let mut sum = 0.0;
    for (foot, [x, y]) in p.place.iter().enumerate() {
        let (x, y) = (x * length, y * width);
        let phase = (1.0 - 2.0 * foot_clock(r, foot)).abs() - 0.5;
        let ahead = [vx - turn * y, vy + turn * x].map(|speed| phase * speed * half_cycle);
        let [to_x, to_y] = [0, 1].map(|k| r.feet.position[foot][k] - r.pose.position[k]);
        let error = [c * to_x + s * to_y - x - ahead[0], c * to_y - s * to_x - y - ahead[1]];
        sum += error[0] * error[0] + error[1] * error[1];
    }
    sum
}

/// Squared error of the feet's heights while they are to swing, m^2: up to the commanded height in
/// the middle of the swing, and down again.
#[inline(always)]
fn feet_clearance_cmd_linear(p: &DefaultFeet, r: &RobotView) -> f32 {
    let [_, _, swing]: [f32; 3] = r.commands.first(FOOT_PLACEMENT);
    let mut sum = 0.0;
    for (foot, rest) in p.height.iter().enumerate() {
        let clock = foot_clock(r, foot);
        let phase = 1.0 - (1.0 - 2.0 * (2.0 * clock - 1.0).clamp(0.0, 1.0)).abs();
        let error = swing * phase + rest - r.feet.height[foot];
        sum += error * error * (1.0 - desired_contact(clock));
    }
    sum
}
