//! A place to go to, and a heading to hold there.
//!
//! Ranges and reward terms: Isaac Lab's `UniformPose2dCommand` and its navigation task
//! (BSD-3-Clause).

use serde::Deserialize;

use super::{CommandKind, CommandSpec, CommandedRobot, heading, wrap_to_pi};
use crate::components::EnvRng;
use crate::config::quantities::{Angle, Coordinate};
use crate::config::values;
use crate::dynamics::elementary::atan2;
use crate::engine::device::FormKind;
use crate::systems::terms::{NoParams, Registry, TermKind, TermSpec};
use crate::systems::view::RobotView;

/// Name of the kind.
pub(in crate::systems) const POSITION: &str = "position";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PositionCommand {
    /// Range of x about the env's origin, m.
    #[serde(deserialize_with = "values::range_of::<Coordinate, _, _>")]
    pos_x: [f32; 2],
    /// Range of y about the env's origin, m.
    #[serde(deserialize_with = "values::range_of::<Coordinate, _, _>")]
    pos_y: [f32; 2],
    /// Heading at the place, rad. Default: the full turn.
    #[serde(default = "full_turn", deserialize_with = "values::range_of::<Angle, _, _>")]
    heading: [f32; 2],
    /// Whether the heading is the direction from the robot to the place in place of a drawn one.
    /// Default: no.
    #[serde(default)]
    simple_heading: bool,
}

fn full_turn() -> [f32; 2] {
    [-std::f32::consts::PI, std::f32::consts::PI]
}

/// The kind, its observation and its name.
pub(super) fn register(registry: &mut Registry) {
    let description = "place about the env's origin, m, and heading in the world, rad";
    registry.command(POSITION, CommandSpec { columns: &["pos_x", "pos_y", "heading"], description }, |p, _| {
        let command: PositionCommand = p;
        Ok(command)
    });
    let description = "way forward and left to the commanded place, and angle to turn left to the heading there";
    let spec = TermSpec::new(TermKind::PlanarVelocity, "m, rad", description);
    registry.observation("position_commands", 3, spec, |_: &NoParams, r, out| {
        out.copy_from_slice(&position_error(r));
    });
    registry.needs_command("position_commands", POSITION);
    registry.on_device(FormKind::Command, POSITION, |p: PositionCommand, _| {
        Some(([p.pos_x, p.pos_y, p.heading].concat(), Some(vec![i32::from(p.simple_heading)])))
    });
    registry
        .on_device(FormKind::Observation, "position_commands", |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
}

impl CommandKind for PositionCommand {
    fn draw(&self, robot: &CommandedRobot, numbers: &mut [f32], rng: &mut EnvRng) {
        let [x, y] = [rng.uniform(self.pos_x), rng.uniform(self.pos_y)];
        let drawn = rng.uniform(self.heading);
        let [from_x, from_y, _] = robot.pose.position;
        let heading = if self.simple_heading { atan2(y - from_y, x - from_x) } else { drawn };
        numbers.copy_from_slice(&[x, y, heading]);
    }
}

/// Way to the place along the heading of the base and to the left, m, and angle by which the robot
/// is to turn left, rad.
#[inline(always)]
pub(in crate::systems) fn position_error(r: &RobotView) -> [f32; 3] {
    let [x, y, wanted] = r.commands.first(POSITION);
    let (dx, dy) = (x - r.pose.position[0], y - r.pose.position[1]);
    let [c, s] = r.pose.forward();
    [c * dx + s * dy, c * dy - s * dx, wrap_to_pi(wanted - heading(&r.pose.rotation))]
}
