//! A pose of the base: height, roll and pitch.
//!
//! The numbers are those of Walk These Ways (MIT): body height, roll and pitch. A share of the
//! robot's height serves robots of all sizes. Reward terms: `systems/reward/command_terms.rs`.

use serde::Deserialize;

use super::{CommandKind, CommandSpec, CommandedRobot};
use crate::components::EnvRng;
use crate::config::quantities::{Angle, BodyFactor, Height};
use crate::config::values;
use crate::engine::device::FormKind;
use crate::morphology::MorphologyModel;
use crate::systems::terms::{NoParams, Registry, TermKind, TermSpec};

/// Name of the kind.
pub(in crate::systems) const POSE: &str = "pose";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseParams {
    /// Height of the base above the ground, m. Default: `height_share`.
    #[serde(default, deserialize_with = "values::optional_range_of::<Height, _, _>")]
    height: Option<[f32; 2]>,
    /// Height as a share of that in the robot's default pose. Default: 1.
    #[serde(default = "one", deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    height_share: [f32; 2],
    /// Roll, rad. Default: 0.
    #[serde(default, deserialize_with = "values::range_of::<Angle, _, _>")]
    roll: [f32; 2],
    /// Pitch, rad; positive with the nose down. Default: 0.
    #[serde(default, deserialize_with = "values::range_of::<Angle, _, _>")]
    pitch: [f32; 2],
}

fn one() -> [f32; 2] {
    [1.0, 1.0]
}

/// Ranges of height, roll and pitch of a morphology.
struct PoseCommand([[f32; 2]; 3]);

/// The kind, its observation and its name.
pub(super) fn register(registry: &mut Registry) {
    let description = "height of the base above the ground, m, roll and pitch, rad";
    registry.command(POSE, CommandSpec { columns: &["height", "roll", "pitch"], description }, prepare);
    let spec = TermSpec::new(TermKind::Vector, "m, rad", "height, roll and pitch of the base that are commanded");
    registry.observation("pose_commands", 3, spec, |_: &NoParams, r, out| {
        out.copy_from_slice(&r.commands.first::<3>(POSE));
    });
    registry.needs_command("pose_commands", POSE);
    registry
        .on_device(FormKind::Command, POSE, |p, robot| Some((prepare(p, robot).ok()?.0.concat(), Some(Vec::new()))));
    registry.on_device(FormKind::Observation, "pose_commands", |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
}

fn prepare(p: PoseParams, robot: &MorphologyModel) -> Result<PoseCommand, (String, String, String)> {
    let default = robot.default_height();
    let height = p.height.unwrap_or(p.height_share.map(|share| robot.least_height(share, default)));
    Ok(PoseCommand([height, p.roll, p.pitch]))
}

impl CommandKind for PoseCommand {
    fn draw(&self, _: &CommandedRobot, numbers: &mut [f32], rng: &mut EnvRng) {
        for (number, range) in numbers.iter_mut().zip(self.0) {
            *number = rng.uniform(range);
        }
    }
}
