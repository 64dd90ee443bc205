//! Tiles of concentric squares.

use super::mesh::Mesh;
use super::tiles::Level;
use crate::config::{GapConfig, RailsConfig, RampsConfig, RingConfig, SECOND_STEP, StairsConfig};

/// Begin of the outer rail on the way from the platform to the tile's edge, as a share of it.
const OUTER_RAIL: f64 = 0.6;

/// A square about the middle with this half edge length.
fn square(half: f64) -> [f64; 2] {
    [half; 2]
}

/// Stairs with landings or open risers; `step` is negative where they go down.
///
/// Seen from above, an open riser is an opening between the tread and the riser of the higher step.
/// This opening reaches down to the foot of the stairs.
pub(super) fn flights(c: &StairsConfig, level: &Level, step: f64) -> Mesh {
    let mut half = level.half().map(|x| x - c.border_width);
    let mut treads = Vec::new();
    loop {
        let is_landing = c.landing_every > 0 && (treads.len() as u32 + 1).is_multiple_of(c.landing_every);
        let width = if is_landing { c.landing_width } else { c.step_width };
        if 2.0 * (half[0].min(half[1]) - width) < c.platform_width - 1e-9 {
            break;
        }
        treads.push((half, width));
        half = half.map(|x| x - width);
    }
    let count = treads.len() as f64 + 1.0;
    let foot = if step < 0.0 { count * step } else { 0.0 };
    let mut rings = vec![(level.half(), 0.0)];
    for (k, (outer, width)) in treads.into_iter().enumerate() {
        let height = (k + 1) as f64 * step;
        if c.riser_gap <= 0.0 {
            rings.push((outer, height));
        } else if step < 0.0 {
            // the higher step is the one before
            rings.extend([(outer, foot), (outer.map(|x| x - c.riser_gap), height)]);
        } else {
            rings.extend([(outer, height), (outer.map(|x| x - width + c.riser_gap), foot)]);
        }
    }
    rings.push((half, count * step));
    Mesh::terraces(&rings)
}

/// Rings of a step and a ramp each, and a platform one step beyond the last ramp; down where `sign`
/// is negative.
pub(super) fn ramps(c: &RampsConfig, level: &Level, sign: f64) -> Mesh {
    let (step, rise) = (sign * level.rising(c.step_height_range), sign * level.ratio(c.slope_range) * c.ramp_width);
    let mut half = level.half().map(|x| x - c.border_width);
    let mut mesh = Mesh::default();
    if c.border_width > 0.0 {
        mesh.frame(level.half(), half, 0.0);
    }
    let mut height = 0.0;
    let wall = |mesh: &mut Mesh, [x, y]: [f64; 2], height: f64| {
        if step != 0.0 {
            mesh.walls([-x, x], [-y, y], [height.min(height + step), height.max(height + step)]);
        }
    };
    while 2.0 * (half[0].min(half[1]) - c.ramp_width) >= c.platform_width - 1e-9 {
        let inner = half.map(|x| x - c.ramp_width);
        wall(&mut mesh, half, height);
        height += step;
        mesh.slanted_frame(half, inner, [height, height + rise]);
        (half, height) = (inner, height + rise);
    }
    wall(&mut mesh, half, height);
    mesh.top([-half[0], half[0]], [-half[1], half[1]], height + step);
    mesh
}

/// A platform at `height` above the ground, or below it; of two steps, at twice that.
pub(super) fn platform(level: &Level, width: f64, height: f64, is_double: bool) -> Mesh {
    let half = level.snap(0.5 * width);
    let mut rings = vec![(level.half(), 0.0)];
    if is_double {
        rings.push((square(level.snap(half + SECOND_STEP)), height));
    }
    rings.push((square(half), height * if is_double { 2.0 } else { 1.0 }));
    Mesh::terraces(&rings)
}

/// A ditch around a platform.
pub(super) fn gap(c: &GapConfig, level: &Level) -> Mesh {
    let half = level.snap(0.5 * c.platform_width);
    let width = within(level, half, level.snap(level.rising(c.gap_width_range)));
    Mesh::terraces(&[(level.half(), 0.0), (square(half + width), -c.gap_depth * level.scale), (square(half), 0.0)])
}

/// A wall around a platform.
pub(super) fn ring(c: &RingConfig, level: &Level) -> Mesh {
    let half = level.snap(0.5 * c.platform_width);
    let width = within(level, half, level.snap_width(level.rising(c.ring_width_range)));
    let top = level.rising(c.ring_height_range) + c.ring_thickness * level.scale;
    Mesh::terraces(&[(level.half(), 0.0), (square(half + width), top), (square(half), 0.0)])
}

/// Two walls around a platform.
pub(super) fn rails(c: &RailsConfig, level: &Level) -> Mesh {
    let [x, y] = level.half();
    let (half, top) = (level.snap(0.5 * c.platform_width), level.rising(c.rail_height_range));
    let [inner, outer] = c.rail_thickness_range.map(|x| level.snap_width(x));
    let far = level.snap(half + OUTER_RAIL * (x.min(y) - half));
    Mesh::terraces(&[
        (level.half(), 0.0),
        (square(far + outer), top),
        (square(far), 0.0),
        (square(half + inner), top),
        (square(half), 0.0),
    ])
}

/// The width, m, or less where a scaled tile has no room for it beyond `half`.
fn within(level: &Level, half: f64, width: f64) -> f64 {
    let [x, y] = level.half();
    width.min(x.min(y) - half - level.config.edge_step).max(0.0)
}
