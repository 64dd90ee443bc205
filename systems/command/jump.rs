//! A jump: when it leaves the ground, how high the base rises and how far it goes.
//!
//! In flight the base follows a parabola under the ground's gravity: height and length say how fast
//! it leaves and for how long it flies. Reward terms: `systems/reward/jump_terms.rs`.

use serde::Deserialize;

use super::{CommandKind, CommandSpec, CommandedRobot};
use crate::components::EnvRng;
use crate::config::quantities::{Coordinate, Duration, Rise, Turns};
use crate::config::values;
use crate::engine::device::FormKind;
use crate::morphology::MorphologyModel;
use crate::systems::terms::{NoParams, Registry, TermKind, TermSpec};
use crate::systems::view::RobotView;

/// Name of the kind.
pub(in crate::systems) const JUMP: &str = "jump";

/// Time before and after the take-off that a policy sees, s.
const SEEN: f32 = 1.0;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct JumpParams {
    /// Time from the draw to the take-off, s.
    #[serde(deserialize_with = "values::range_of::<Duration, _, _>")]
    time: [f32; 2],
    /// Rise of the base above its default height, m. Default: `height_share`.
    #[serde(default, deserialize_with = "values::optional_range_of::<Rise, _, _>")]
    height: Option<[f32; 2]>,
    /// Rise of the base, as a share of the height of the hips in the default pose. Default: 0.5.
    #[serde(default = "half", deserialize_with = "values::range_of::<Turns, _, _>")]
    height_share: [f32; 2],
    /// Way forward between take-off and landing, m; negative backwards. Default: 0.
    #[serde(default, deserialize_with = "values::range_of::<Coordinate, _, _>")]
    length: [f32; 2],
}

fn half() -> [f32; 2] {
    [0.5, 0.5]
}

/// Ranges of time, height and length of a morphology.
struct JumpCommand {
    time: [f32; 2],
    height: [f32; 2],
    length: [f32; 2],
}

/// The kind, its observation and its name.
pub(super) fn register(registry: &mut Registry) {
    let columns = &["time", "height", "length"];
    let description = "time since the take-off, s, negative before it; rise of the base, m; way forward, m";
    registry.command(JUMP, CommandSpec { columns, description }, prepare);
    let description = "time since the take-off, within 1 s of it, rise of the base and way forward";
    let spec = TermSpec::new(TermKind::Scalar, "s, m", description);
    registry.observation("jump_commands", 3, spec, |_: &NoParams, r, out| {
        let [time, height, length] = r.commands.first(JUMP);
        out.copy_from_slice(&[time.clamp(-SEEN, SEEN), height, length]);
    });
    registry.needs_command("jump_commands", JUMP);
    registry.on_device(FormKind::Command, JUMP, |p, robot| {
        let JumpCommand { time, height, length } = prepare(p, robot).ok()?;
        Some(([time, height, length].concat(), Some(Vec::new())))
    });
    registry.on_device(FormKind::Observation, "jump_commands", |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
}

fn prepare(p: JumpParams, robot: &MorphologyModel) -> Result<JumpCommand, (String, String, String)> {
    let hips = robot.default_hip_height();
    let height = p.height.unwrap_or(p.height_share.map(|share| share * hips));
    Ok(JumpCommand { time: p.time, height, length: p.length })
}

impl CommandKind for JumpCommand {
    fn draw(&self, _: &CommandedRobot, numbers: &mut [f32], rng: &mut EnvRng) {
        let time = rng.uniform(self.time);
        numbers.copy_from_slice(&[-time, rng.uniform(self.height), rng.uniform(self.length)]);
    }

    fn advance(&self, numbers: &mut [f32], step_dt: f32) {
        numbers[0] += step_dt;
    }
}

/// The base of a jump at an instant.
#[derive(Clone, Copy)]
pub(in crate::systems) struct Jump {
    /// Whether the robot flies: no foot shall stand.
    pub flies: bool,
    /// Rise of the base above its default height, m.
    pub rise: f32,
    /// Velocity along the base's heading, m/s.
    pub speed: f32,
}

/// The jump that is commanded, now. Before take-off and after landing the robot stands.
#[inline(always)]
pub(in crate::systems) fn jump(r: &RobotView) -> Jump {
    let [time, height, length]: [f32; 3] = r.commands.first(JUMP);
    let gravity = r.ground.free_fall();
    let flight = if gravity > 0.0 { (8.0 * height / gravity).sqrt() } else { 0.0 };
    if time < 0.0 || time >= flight {
        return Jump { flies: false, rise: 0.0, speed: 0.0 };
    }
    let share = 2.0 * time / flight - 1.0;
    Jump { flies: true, rise: height * (1.0 - share * share), speed: length / flight }
}
