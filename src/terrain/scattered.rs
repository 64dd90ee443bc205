//! Tiles of bodies that stand on a floor or in a hole.

use super::mesh::Mesh;
use super::tiles::{Level, both};
use crate::components::EnvRng;
use crate::config::{
    BeamsConfig, BoxObjectConfig, RepeatedObject, RepeatedObjectsConfig, RoundObjectConfig, StarConfig, StonesConfig,
};
use crate::dynamics::lanes::Real;

/// Sides of a cylinder.
pub(super) const SIDES: usize = 16;

/// A hole within a flat edge, with the walls around it.
fn hole(level: &Level, border: f64, floor: f64) -> Mesh {
    let half = level.half();
    let inner = half.map(|x| x - border);
    if border > 0.0 {
        return Mesh::terraces(&[(half, 0.0), (inner, floor)]);
    }
    let mut mesh = Mesh::terraces(&[(half, floor)]);
    mesh.walls(both(half[0]), both(half[1]), [floor.min(0.0), 0.0]);
    mesh
}

/// Bars that cross in a platform, at equal angles.
pub(super) fn star(c: &StarConfig, level: &Level) -> Mesh {
    let floor = -level.rising(c.bar_height_range);
    let (half, width) = (level.half(), level.falling(c.bar_width_range));
    let edge = level.snap_width(c.bar_width_range[1]);
    let mut mesh = hole(level, edge, floor);
    let platform = both(level.snap(0.5 * c.platform_width));
    mesh.pillar(platform, platform, [floor, 0.0]);
    for bar in 0..c.num_bars {
        let angle = std::f64::consts::PI * f64::from(bar) / f64::from(c.num_bars);
        let (sin, cos) = Real::sin_cos(angle);
        // as far as the middle of the flat edge
        let [x, y] = half.map(|x| x - 0.5 * edge);
        let length = (x / cos.abs()).min(y / sin.abs());
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[u, v]| {
            let (along, across) = (u * length, 0.5 * v * width);
            [cos * along - sin * across, sin * along + cos * across]
        });
        mesh.body(&corners.map(|[x, y]| [x, y, floor]), &corners.map(|[x, y]| [x, y, 0.0]));
    }
    mesh
}

/// Parallel beams from a platform to the flat edge, on all four sides.
pub(super) fn beams(c: &BeamsConfig, level: &Level) -> Mesh {
    let floor = -level.rising(c.beam_height_range);
    let inner = level.half().map(|x| x - c.border_width);
    let mut mesh = hole(level, c.border_width, floor);
    let half = level.snap(0.5 * c.platform_width);
    mesh.pillar(both(half), both(half), [floor, 0.0]);
    let width = level.snap_width(level.falling(c.beam_width_range)).min(c.platform_width);
    for k in 0..c.num_beams {
        let middle = c.platform_width * ((f64::from(k) + 0.5) / f64::from(c.num_beams) - 0.5);
        let first = level.snap(middle - 0.5 * width);
        let across = [first, first + width];
        for [x, y] in [[half, inner[0]], [-inner[0], -half]].map(|along| [along, across]) {
            mesh.pillar(x, y, [floor, 0.0]);
        }
        for [x, y] in [[half, inner[1]], [-inner[1], -half]].map(|along| [across, along]) {
            mesh.pillar(x, y, [floor, 0.0]);
        }
    }
    mesh
}

/// Square stones in a hole, in rows along y, around a platform.
pub(super) fn stones(c: &StonesConfig, level: &Level, rng: &mut EnvRng) -> Mesh {
    let floor = c.holes_depth * level.scale;
    let inner = level.half().map(|x| x - c.border_width);
    let mut mesh = hole(level, c.border_width, floor);
    let half = level.snap(0.5 * c.platform_width);
    mesh.pillar(both(half), both(half), [floor, 0.0]);
    let width = level.snap_width(level.falling(c.stone_width_range));
    let distance = level.snap(level.rising(c.stone_distance_range));
    let mut x = -inner[0];
    while x < inner[0] - 1e-9 {
        let along_x = [x, (x + width).min(inner[0])];
        let mut y = -inner[1] - level.snap(f64::from(rng.unit()) * width);
        while y < inner[1] - 1e-9 {
            let along_y = [y.max(-inner[1]), (y + width).min(inner[1])];
            let height = (2.0 * f64::from(rng.unit()) - 1.0) * c.stone_height_max * level.scale;
            // no stone stands out of the platform
            let is_under = [along_x, along_y].iter().all(|[low, high]| *low < half && -half < *high);
            let height = if is_under { height.min(0.0) } else { height };
            if along_y[0] < along_y[1] - 1e-9 {
                mesh.pillar(along_x, along_y, [floor, height.max(floor)]);
            }
            y += width + distance;
        }
        x += width + distance;
    }
    mesh
}

/// Numbers of the objects of a level, between those of the easiest and the hardest one.
struct Objects {
    count: u32,
    height: f64,
    /// Largest angle of the tilt, rad.
    tilt: f64,
    /// Radius about its middle that holds an object, m.
    reach: f64,
    /// Height of their underside: below the ground, where they are tilted.
    root: f64,
    abs_noise: [f64; 2],
    rel_noise: [f64; 2],
    platform: f64,
    /// Height of the platform; that of the objects if it is negative.
    platform_height: f64,
}

/// Depth below the ground to which tilted objects reach, as a share of their radius: the tangent of
/// the largest tilt.
const ROOT: f64 = 1.8;

impl Objects {
    /// Objects of a level, whose middle is `radius` from their farthest point while they are
    /// upright.
    fn new<T: RepeatedObject>(c: &RepeatedObjectsConfig<T>, level: &Level, radius: f64) -> Self {
        let (a, b) = (&c.object_params_start, &c.object_params_end);
        let height = level.rising([a.height(), b.height()]);
        let tilt = level.ratio([a.tilt(), b.tilt()]).to_radians();
        let leaning = Real::sin_cos(tilt).0;
        Self {
            count: level.ratio([a.count(), b.count()].map(f64::from)).round() as u32,
            height,
            tilt,
            reach: radius + height * leaning,
            root: if tilt > 0.0 { -ROOT * radius } else { 0.0 },
            abs_noise: c.abs_height_noise,
            rel_noise: c.rel_height_noise,
            platform: c.platform_width,
            platform_height: c.platform_height,
        }
    }

    /// The level ground, the platform, and the objects, each drawn by `draw` at its height with its
    /// heading; objects are tilted about the middle of their underside.
    fn mesh(
        &self,
        level: &Level,
        rng: &mut EnvRng,
        draw: impl Fn(&mut Mesh, f64, &dyn Fn([f64; 3]) -> [f64; 3]),
    ) -> Mesh {
        let edges = level.half();
        let mut mesh = Mesh::terraces(&[(edges, 0.0)]);
        let half = level.snap(0.5 * self.platform);
        let top = if self.platform_height < 0.0 { self.height } else { self.platform_height * level.scale };
        if top > 0.0 {
            mesh.pillar(both(half), both(half), [0.0, top]);
        }
        for _ in 0..self.count {
            let noise = [self.rel_noise, self.abs_noise].map(|[low, high]| low + (high - low) * f64::from(rng.unit()));
            let height = self.height * noise[0] + noise[1] * level.scale;
            let [heading, about_x, about_y] = [std::f64::consts::TAU, self.tilt, self.tilt].map(|most| {
                let share = 2.0 * f64::from(rng.unit()) - 1.0;
                Real::sin_cos(share * most)
            });
            // off the platform along one axis, anywhere along the other
            let axis = rng.integer([0, 1]) as usize;
            let least = half + self.reach;
            let beside = least + ((edges[axis] - self.reach) - least).max(0.0) * f64::from(rng.unit());
            let along = (edges[1 - axis] - self.reach).max(0.0) * (2.0 * f64::from(rng.unit()) - 1.0);
            let beside = if rng.integer([0, 1]) == 0 { beside } else { -beside };
            if height <= 0.0 {
                continue;
            }
            let [x, y] = if axis == 0 { [beside, along] } else { [along, beside] };
            // tilted about x, then about y, then turned
            let move_to = |[u, v, w]: [f64; 3]| {
                let [v, w] = [about_x.1 * v - about_x.0 * w, about_x.0 * v + about_x.1 * w];
                let [u, w] = [about_y.1 * u + about_y.0 * w, about_y.1 * w - about_y.0 * u];
                [x + heading.1 * u - heading.0 * v, y + heading.0 * u + heading.1 * v, w]
            };
            draw(&mut mesh, height, &move_to);
        }
        mesh
    }
}

/// Boxes at random places.
pub(super) fn boxes(c: &RepeatedObjectsConfig<BoxObjectConfig>, level: &Level, rng: &mut EnvRng) -> Mesh {
    let (a, b) = (&c.object_params_start, &c.object_params_end);
    let size = [0, 1].map(|axis| level.ratio([a.size[axis], b.size[axis]]) * level.scale);
    let objects = Objects::new(c, level, 0.5 * (size[0] * size[0] + size[1] * size[1]).sqrt());
    objects.mesh(level, rng, |mesh, height, move_to| {
        let corners = |z: f64| {
            [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]].map(|[u, v]| move_to([u * size[0], v * size[1], z]))
        };
        mesh.body(&corners(objects.root), &corners(height));
    })
}

/// Pyramids of four sides, or cylinders of more, at random places.
pub(super) fn round(
    c: &RepeatedObjectsConfig<RoundObjectConfig>,
    level: &Level,
    sides: usize,
    rng: &mut EnvRng,
) -> Mesh {
    let radius = level.rising([c.object_params_start.radius, c.object_params_end.radius]);
    let objects = Objects::new(c, level, radius);
    objects.mesh(level, rng, |mesh, height, move_to| {
        let corners = |z: f64| -> Vec<[f64; 3]> {
            let corner = |k: usize| {
                let (sin, cos) = Real::sin_cos(std::f64::consts::TAU * k as f64 / sides as f64);
                move_to([radius * cos, radius * sin, z])
            };
            (0..sides).map(corner).collect()
        };
        if sides > 4 {
            mesh.body(&corners(objects.root), &corners(height));
        } else {
            let foot = corners(0.0);
            if objects.root < 0.0 {
                mesh.body(&corners(objects.root), &foot);
            }
            mesh.pyramid(&foot, move_to([0.0, 0.0, height]));
        }
    })
}
