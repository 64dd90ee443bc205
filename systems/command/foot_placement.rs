//! Commands of where feet are set down and of how high they swing.
//!
//! The numbers are those of Walk These Ways (MIT): width and length of the stance and height of the
//! swing. Widths and lengths are factors of the robot's own stance, so that they serve any number
//! of legs. Reward terms: `systems/reward/placement_terms.rs`.

use serde::Deserialize;

use super::{CommandKind, CommandSpec, CommandedRobot};
use crate::components::EnvRng;
use crate::config::quantities::{BodyFactor, Rise, Turns};
use crate::config::values;
use crate::engine::device::FormKind;
use crate::morphology::MorphologyModel;
use crate::systems::terms::{NoParams, Registry, TermKind, TermSpec};

/// Name of the kind.
pub(in crate::systems) const FOOT_PLACEMENT: &str = "foot_placement";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlacementParams {
    /// Distance of the feet from the middle plane, as a factor of that in the default pose.
    /// Default: 1.
    #[serde(default = "one", deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    stance_width: [f32; 2],
    /// Distance of the feet before and behind the base, as a factor of that in the default pose.
    /// Default: 1.
    #[serde(default = "one", deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    stance_length: [f32; 2],
    /// Height to which feet swing, m. Default: `swing_share`.
    #[serde(default, deserialize_with = "values::optional_range_of::<Rise, _, _>")]
    swing_height: Option<[f32; 2]>,
    /// Height to which feet swing, as a share of the height of the hips in the default pose.
    /// Default: 0.2.
    #[serde(default = "fifth", deserialize_with = "values::range_of::<Turns, _, _>")]
    swing_share: [f32; 2],
}

fn one() -> [f32; 2] {
    [1.0, 1.0]
}

fn fifth() -> [f32; 2] {
    [0.2, 0.2]
}

/// Ranges of width, length and height of a morphology.
struct PlacementCommand([[f32; 2]; 3]);

/// The kind, its observation and its name.
pub(super) fn register(registry: &mut Registry) {
    let columns = &["stance_width", "stance_length", "swing_height"];
    let description = "width and length of the stance as factors of the default pose's, height of the swing, m";
    registry.command(FOOT_PLACEMENT, CommandSpec { columns, description }, prepare);
    let description = "width and length of the stance and height of the swing that are commanded";
    let spec = TermSpec::new(TermKind::Scalar, "factors, m", description);
    registry.observation("foot_placement_commands", 3, spec, |_: &NoParams, r, out| {
        out.copy_from_slice(&r.commands.first::<3>(FOOT_PLACEMENT));
    });
    registry.needs_command("foot_placement_commands", FOOT_PLACEMENT);
    registry.on_device(FormKind::Command, FOOT_PLACEMENT, |p, robot| {
        Some((prepare(p, robot).ok()?.0.concat(), Some(Vec::new())))
    });
    registry.on_device(FormKind::Observation, "foot_placement_commands", |NoParams {}, _| {
        Some((Vec::new(), Some(Vec::new())))
    });
}

fn prepare(p: PlacementParams, robot: &MorphologyModel) -> Result<PlacementCommand, (String, String, String)> {
    let hips = robot.default_hip_height();
    let height = p.swing_height.unwrap_or(p.swing_share.map(|share| share * hips));
    Ok(PlacementCommand([p.stance_width, p.stance_length, height]))
}

impl CommandKind for PlacementCommand {
    fn draw(&self, _: &CommandedRobot, numbers: &mut [f32], rng: &mut EnvRng) {
        for (number, range) in numbers.iter_mut().zip(self.0) {
            *number = rng.uniform(range);
        }
    }
}
