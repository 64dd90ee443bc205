//! A gait: how often each foot steps, how long it stands, and in which order.
//!
//! Numbers, clocks and their names: Walk These Ways (MIT). A foot stands in the first part of its
//! cycle, as long as `duration` says, and swings in the rest.

use serde::Deserialize;

use super::{CommandKind, CommandSpec, CommandedRobot};
use crate::components::EnvRng;
use crate::config::quantities::{Frequency, Turns};
use crate::config::values;
use crate::dynamics::elementary::exp;
use crate::dynamics::lanes::Real;
use crate::engine::device::FormKind;
use crate::systems::terms::{NoParams, Registry, TermKind, TermSpec};
use crate::systems::view::RobotView;

/// Name of the kind.
pub(in crate::systems) const GAIT: &str = "gait";

/// Numbers of the command: the clock, then what is drawn.
const COLUMNS: &[&str] = &["clock", "frequency", "phase", "offset", "bound", "duration"];

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct GaitCommand {
    /// Steps of each foot per second, Hz.
    #[serde(deserialize_with = "values::range_of::<Frequency, _, _>")]
    frequency: [f32; 2],
    /// Cycle of the left front leg against the right one, as a share of the cycle; of the right
    /// hind leg against the left one. Default: 0.5, a trot; a walk of bipeds.
    #[serde(default = "half", deserialize_with = "values::range_of::<Turns, _, _>")]
    phase: [f32; 2],
    /// Lead of both front legs over the hind ones. Default: 0.
    #[serde(default, deserialize_with = "values::range_of::<Turns, _, _>")]
    offset: [f32; 2],
    /// Lead of both left legs over the right ones. Default: 0.
    #[serde(default, deserialize_with = "values::range_of::<Turns, _, _>")]
    bound: [f32; 2],
    /// Share of the cycle for which a foot stands. Default: 0.5.
    #[serde(default = "half", deserialize_with = "values::range_of::<Turns, _, _>")]
    duration: [f32; 2],
}

fn half() -> [f32; 2] {
    [0.5, 0.5]
}

/// The kind, its observations and its name.
pub(super) fn register(registry: &mut Registry) {
    let description = "clock, steps per second, phase, offset, bound and stance, as shares of the cycle";
    registry.command(GAIT, CommandSpec { columns: COLUMNS, description }, |p, _| {
        let command: GaitCommand = p;
        Ok(command)
    });
    let spec = TermSpec::new(TermKind::Scalar, "Hz, cycles", "steps per second and share of stance that are commanded");
    registry.observation("gait_commands", 2, spec, |_: &NoParams, r, out| {
        let [_, frequency, _, _, _, duration] = r.commands.first(GAIT);
        out.copy_from_slice(&[frequency, duration]);
    });
    let spec = TermSpec::new(TermKind::PerFoot, "", "sine of each foot's clock; positive while the foot is to stand");
    registry.foot_observation("clock_inputs", spec, |_: &NoParams, r, out| {
        for (foot, number) in out.iter_mut().enumerate() {
            *number = Real::sin_cos(std::f32::consts::TAU * foot_clock(r, foot)).0;
        }
    });
    registry.needs_command("gait_commands", GAIT);
    registry.needs_command("clock_inputs", GAIT);
    registry.on_device(FormKind::Command, GAIT, |p: GaitCommand, _| {
        Some(([p.frequency, p.phase, p.offset, p.bound, p.duration].concat(), Some(Vec::new())))
    });
    for name in ["gait_commands", "clock_inputs"] {
        registry.on_device(FormKind::Observation, name, |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
    }
}

impl CommandKind for GaitCommand {
    /// The clock runs on from draw to draw.
    fn draw(&self, _: &CommandedRobot, numbers: &mut [f32], rng: &mut EnvRng) {
        let ranges = [self.frequency, self.phase, self.offset, self.bound, self.duration];
        for (number, range) in numbers[1..].iter_mut().zip(ranges) {
            *number = rng.uniform(range);
        }
    }

    fn advance(&self, numbers: &mut [f32], step_dt: f32) {
        let clock = numbers[1].mul_add(step_dt, numbers[0]);
        numbers[0] = clock - clock.floor();
    }
}

/// Part of its cycle in which a foot is, 0 to 1, stretched so that stance is the first half.
///
/// Left feet come first, from front to back, then the right ones. Each second pair counts as a hind
/// one, so that six legs trot as a tripod.
#[inline(always)]
pub(in crate::systems) fn foot_clock(r: &RobotView, foot: usize) -> f32 {
    let [clock, _, phase, offset, bound, duration]: [f32; 6] = r.commands.first(GAIT);
    let pairs = (r.morphology.feet.len() / 2).max(1);
    let (is_right, is_hind) = (foot >= pairs, foot % pairs % 2 == 1);
    let lead = match (is_right, is_hind) {
        (false, false) => phase + offset + bound,
        (true, false) => offset,
        (false, true) => bound,
        (true, true) => phase,
    };
    let at = clock + lead;
    let at = at - at.floor();
    let stance = duration.clamp(0.01, 0.99);
    if at < stance { 0.5 * at / stance } else { 0.5 + 0.5 * (at - stance) / (1.0 - stance) }
}

/// Share of standing that a foot's clock asks for, 0 to 1: a step function smoothed over 7 % of a
/// cycle, as in Walk These Ways, with the logistic curve nearest to the normal distribution.
#[inline(always)]
pub(in crate::systems) fn desired_contact(clock: f32) -> f32 {
    const SMOOTHING: f32 = 0.07;
    let cdf = |x: f32| 1.0 / (1.0 + exp(-1.702 * x / SMOOTHING));
    cdf(clock) * (1.0 - cdf(clock - 0.5)) + cdf(clock - 1.0) * (1.0 - cdf(clock - 1.5))
}
