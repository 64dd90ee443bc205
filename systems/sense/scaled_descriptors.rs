//! Numbers of the term `joint_descriptors` in units of the body: one network for bodies of 2 and of
//! 90 kg.

use serde::Deserialize;

use super::joint_descriptors::COUNT;
use crate::config::EARTH_GRAVITY;
use crate::systems::view::RobotView;

/// Parameters of the term `joint_descriptors`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::systems) struct DescriptorUnits {
    /// Units of its numbers. Default: metric.
    #[serde(default)]
    units: Units,
}

#[derive(Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Units {
    /// m, kg, N m and rad, with constant factors.
    #[default]
    Metric,
    /// Height of the hips, weight times that height, and the time scale of its fall.
    Body,
}

/// Divisors of the numbers of [`JointDescriptors`](crate::components::JointDescriptors).
const METRIC: [f32; COUNT] =
    [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 100.0, 20.0, 100.0, 5.0, 0.1, 1.0, 1.0, 1.0, 1.0, 50.0];

/// Largest magnitude of a scaled number: limits that no motor reaches count as this.
const MOST: f32 = 4.0;

/// Hips lie at least this high above the soles, m, as a divisor.
const LOWEST: f32 = 0.02;

/// Height of the hips whose time scale counts as 1, m.
const USUAL: f32 = 0.4;

/// Writes the descriptions of the joints. In units of the body, lengths count in heights of the
/// hips above the soles h, torques in m g h and times in sqrt(h / g), each with a factor that makes
/// it of the order of one. The last number is the root of h over 0.4 m: bodies of the same shape
/// and strength differ by it alone. Without gravity that of the Earth counts.
pub(in crate::systems) fn joint_descriptors(units: &DescriptorUnits, r: &RobotView, out: &mut [f32]) {
    out.copy_from_slice(r.joint_descriptors);
    if units.units == Units::Metric {
        return;
    }
    let height = (r.default_height() + r.morphology.hip_height).max(LOWEST);
    let free_fall = r.ground.free_fall();
    let gravity = if free_fall > 0.0 { free_fall } else { EARTH_GRAVITY as f32 };
    let mass = r.body.total_mass();
    let (load, time) = (mass * gravity * height, (height / gravity).sqrt());
    let joints = out.len() / COUNT;
    for (number, (own, metric)) in out.chunks_exact_mut(joints.max(1)).zip(METRIC).enumerate() {
        // factor from SI units, and a spread of the order of one
        let factor = match number {
            0..3 => 1.0 / height,
            9 => 1.0 / load,
            10 => 0.25 * time,
            11 => 1.0 / load,
            12 => 10.0 / (load * time),
            13 => 100.0 / (mass * height * height),
            14 => 10.0 / load,
            15 => 10.0 / (mass * height * height),
            _ => 1.0 / metric,
        };
        for x in own {
            *x = match number {
                18 => (height / USUAL).sqrt(),
                _ => (*x * metric * factor).clamp(-MOST, MOST),
            };
        }
    }
}
