//! A heading to turn to and hold.
//!
//! Ranges: Isaac Lab's `UniformVelocityCommand` (BSD-3-Clause), key `heading`. Reward terms:
//! `systems/reward/command_terms.rs`.

use serde::Deserialize;

use super::{CommandKind, CommandSpec, CommandedRobot, heading, wrap_to_pi};
use crate::components::EnvRng;
use crate::config::quantities::Angle;
use crate::config::values;
use crate::engine::device::FormKind;
use crate::systems::terms::{NoParams, Registry, TermKind, TermSpec};
use crate::systems::view::RobotView;

/// Name of the kind.
pub(in crate::systems) const HEADING: &str = "heading";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct HeadingCommand {
    /// Heading in the world, rad. Default: the full turn.
    #[serde(default = "full_turn", deserialize_with = "values::range_of::<Angle, _, _>")]
    heading: [f32; 2],
}

fn full_turn() -> [f32; 2] {
    [-std::f32::consts::PI, std::f32::consts::PI]
}

/// The kind, its observation and its name.
pub(super) fn register(registry: &mut Registry) {
    let spec = CommandSpec { columns: &["heading"], description: "heading of the base in the world, rad" };
    registry.command(HEADING, spec, |p: HeadingCommand, _| Ok(p));
    let spec = TermSpec::new(TermKind::Odd, "rad", "angle by which the base is to turn left to the commanded heading");
    registry.observation("heading_commands", 1, spec, |_: &NoParams, r, out| out[0] = heading_error(r));
    registry.needs_command("heading_commands", HEADING);
    registry.on_device(FormKind::Command, HEADING, |p: HeadingCommand, _| Some((p.heading.to_vec(), Some(Vec::new()))));
    registry
        .on_device(FormKind::Observation, "heading_commands", |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
}

impl CommandKind for HeadingCommand {
    fn draw(&self, _: &CommandedRobot, numbers: &mut [f32], rng: &mut EnvRng) {
        numbers[0] = rng.uniform(self.heading);
    }
}

/// Angle by which the robot is to turn left, rad.
#[inline(always)]
pub(in crate::systems) fn heading_error(r: &RobotView) -> f32 {
    let [wanted] = r.commands.first(HEADING);
    wrap_to_pi(wanted - heading(&r.pose.rotation))
}
