//! The obstacles of a scene as Avian's colliders.

use std::panic::{AssertUnwindSafe, catch_unwind};

use avian3d::prelude::{Collider, Position, Rotation};
use bevy_math::{EulerRot, Quat, Vec3};
use glam::DVec3;

use crate::config::{ObstacleConfig, TerrainConfig};
use crate::terrain::{self, Mesh, TerrainLayout};

/// One convex or triangulated part of an obstacle.
#[derive(Clone)]
pub(crate) struct Part {
    pub(crate) collider: Collider,
    pub(crate) position: Position,
    pub(crate) rotation: Rotation,
    /// Radius about `position` that holds the part, m.
    pub(crate) reach: f32,
}

/// The parts of an obstacle; empty where it has no volume for a hull.
pub(crate) fn parts(obstacle: &ObstacleConfig) -> Vec<Part> {
    let (position, [roll, pitch, yaw]) = obstacle.placement();
    let place = Vec3::from_array(position.map(|x| x as f32));
    // fixed axes: roll first
    let turn = Quat::from_euler(EulerRot::ZYX, yaw as f32, pitch as f32, roll as f32);
    // Avian's cylinders and capsules lie along y
    let upright = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2);
    let part = |collider: Collider, offset: Vec3, own: Quat, reach: f32| Part {
        collider,
        position: Position(place + turn * offset),
        rotation: Rotation(turn * own),
        reach,
    };
    match obstacle {
        ObstacleConfig::Box { size, .. } => {
            let size = Vec3::from_array(size.map(|x| x as f32));
            let collider = Collider::cuboid(size.x, size.y, size.z);
            vec![part(collider, Vec3::ZERO, Quat::IDENTITY, 0.5 * size.length())]
        }
        ObstacleConfig::Sphere { radius, .. } => {
            let radius = *radius as f32;
            vec![part(Collider::sphere(radius), Vec3::ZERO, Quat::IDENTITY, radius)]
        }
        ObstacleConfig::Cylinder { radius, length, .. } => {
            let (radius, length) = (*radius as f32, *length as f32);
            vec![part(Collider::cylinder(radius, length), Vec3::ZERO, upright, radius + 0.5 * length)]
        }
        ObstacleConfig::Capsule { radius, length, .. } => {
            let (radius, length) = (*radius as f32, *length as f32);
            vec![part(Collider::capsule(radius, length), Vec3::ZERO, upright, radius + 0.5 * length)]
        }
        ObstacleConfig::Ramp { size, .. } => {
            let [x, y, z] = size.map(|x| x as f32);
            let (x, y) = (0.5 * x, 0.5 * y);
            let corners = [[-x, -y, 0.0], [-x, y, 0.0], [x, -y, 0.0], [x, y, 0.0], [x, -y, z], [x, y, z]];
            let hull = hull(&corners.map(|corner| Vec3::from_array(corner).as_dvec3()));
            hull.map(|hull| part(hull, Vec3::ZERO, Quat::IDENTITY, Vec3::new(x, y, z).length())).into_iter().collect()
        }
        ObstacleConfig::Stairs { size, steps, .. } => {
            let [depth, width, height] = size.map(|x| x as f32);
            let half = 0.5 * depth * *steps as f32;
            let step = |i: u32| {
                let top = height * (i + 1) as f32;
                let middle = Vec3::new((i as f32 + 0.5) * depth - half, 0.0, 0.5 * top);
                let reach = 0.5 * Vec3::new(depth, width, top).length();
                part(Collider::cuboid(depth, width, top), middle, Quat::IDENTITY, reach)
            };
            (0..*steps).map(step).collect()
        }
        ObstacleConfig::Mesh { scale, vertices, triangles, .. } => {
            let scaled = |v: &[f64; 3]| Vec3::from_array(std::array::from_fn(|k| (v[k] * scale[k]) as f32));
            let vertices: Vec<Vec3> = vertices.iter().map(scaled).collect();
            let reach = vertices.iter().fold(0.0, |most: f32, v| most.max(v.length()));
            let surface = Collider::try_trimesh(vertices, triangles.clone()).ok();
            surface.map(|surface| part(surface, Vec3::ZERO, Quat::IDENTITY, reach)).into_iter().collect()
        }
        ObstacleConfig::Heightfield { size, heights, .. } => {
            let (rows, columns) = (heights.len(), heights[0].len());
            let along = |i: usize, n: usize, length: f64| ((i as f64 / (n - 1) as f64 - 0.5) * length) as f32;
            let vertices: Vec<Vec3> = (0..rows * columns)
                .map(|k| (k / columns, k % columns))
                .map(|(i, j)| Vec3::new(along(i, rows, size[0]), along(j, columns, size[1]), heights[i][j] as f32))
                .collect();
            let corner = |i: usize, j: usize| (i * columns + j) as u32;
            let triangles = (0..(rows - 1) * (columns - 1))
                .map(|k| (k / (columns - 1), k % (columns - 1)))
                .flat_map(|(i, j)| {
                    let [a, b, c, d] = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
                    [[a, b, c], [a, c, d]]
                })
                .collect();
            let reach = vertices.iter().fold(0.0, |most: f32, v| most.max(v.length()));
            let surface = Collider::try_trimesh(vertices, triangles).ok();
            surface.map(|surface| part(surface, Vec3::ZERO, Quat::IDENTITY, reach)).into_iter().collect()
        }
    }
}

/// Half the side of a plane that is open somewhere, m: farther than a robot walks in an episode,
/// about any env's origin.
pub(crate) const FLOOR: f32 = 500.0;

/// The plane at height zero with these rectangles left out; `None` without rectangles, when it is
/// whole.
pub(crate) fn floor(pits: &[[[f64; 2]; 2]]) -> Option<Part> {
    if pits.is_empty() {
        return None;
    }
    // cut along all edges of all rectangles, so that neighbouring pieces share their corners
    let cuts = |axis: usize| {
        let mut cuts: Vec<f32> = pits.iter().flatten().map(|corner| corner[axis] as f32).collect();
        cuts.extend([-FLOOR, FLOOR]);
        cuts.retain(|x| x.abs() <= FLOOR);
        cuts.sort_unstable_by(f32::total_cmp);
        cuts.dedup();
        cuts
    };
    let (x, y) = (cuts(0), cuts(1));
    let is_open = |middle: [f32; 2]| {
        pits.iter()
            .any(|[low, high]| (0..2).all(|axis| low[axis] as f32 <= middle[axis] && middle[axis] <= high[axis] as f32))
    };
    let mut mesh = Mesh::default();
    for along_x in x.windows(2) {
        for along_y in y.windows(2) {
            if !is_open([0.5 * (along_x[0] + along_x[1]), 0.5 * (along_y[0] + along_y[1])]) {
                let edges = |cuts: &[f32]| [f64::from(cuts[0]), f64::from(cuts[1])];
                mesh.top(edges(along_x), edges(along_y), 0.0);
            }
        }
    }
    let vertices = mesh.vertices.into_iter().map(Vec3::from_array).collect();
    let collider = Collider::try_trimesh(vertices, mesh.triangles).ok()?;
    Some(Part { collider, position: Position::default(), rotation: Rotation::default(), reach: FLOOR })
}

/// Generated terrain as one part: all tiles and the border.
pub(crate) fn terrain(config: &TerrainConfig, layout: &TerrainLayout) -> Option<Part> {
    let mut whole = terrain::border(config, layout);
    for tile in terrain::generate_in(config, layout) {
        whole.append(&tile.mesh, tile.origin);
    }
    let reach = whole.vertices.iter().map(|v| Vec3::from_array(*v).length()).fold(0.0, f32::max);
    let vertices = whole.vertices.into_iter().map(Vec3::from_array).collect();
    let collider = Collider::try_trimesh(vertices, whole.triangles).ok()?;
    Some(Part { collider, position: Position::default(), rotation: Rotation::default(), reach })
}

/// The hull of points that span a volume.
pub(crate) fn hull(points: &[DVec3]) -> Option<Collider> {
    let points: Vec<Vec3> = points.iter().map(|p| p.as_vec3()).collect();
    // the library panics on degenerate input
    catch_unwind(AssertUnwindSafe(|| Collider::convex_hull(&points))).ok().flatten()
}
