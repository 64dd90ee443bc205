//! A robot's collision shapes as Avian's colliders.

use avian3d::prelude::Collider;
use bevy_math::{Quat, Vec3};
use glam::{DMat3, DQuat, DVec3};

use crate::obstacles::hull;
use crate::robot::{Geometry, Model};

/// A box that stands for a shape without volume is at least this thick, m.
const MIN_THICKNESS: f32 = 1e-3;

/// One collider of a link.
#[derive(Clone)]
pub(super) struct LinkCollider {
    pub(super) link: usize,
    /// Contact body whose force it adds to.
    pub(super) body: usize,
    /// Number of the robot's shape, counted body after body.
    pub(super) shape: usize,
    /// Factor on sliding friction.
    pub(super) friction: f32,
    /// Distance from the ground at which contact begins, m.
    pub(super) margin: f32,
    pub(super) collider: Collider,
    /// Origin of the collider in the frame of the link, whose axes are the engine's.
    pub(super) translation: Vec3,
    pub(super) rotation: Quat,
}

/// The colliders of a robot; `align` turns a link's URDF axes into the engine's. Links that cannot
/// move have none.
pub(super) fn colliders(model: &Model, align: &[DMat3], floating: bool) -> Vec<LinkCollider> {
    // cylinders and capsules lie along z in a URDF and along y in Avian
    let upright = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2);
    let mut all = Vec::new();
    let shapes =
        model.bodies.iter().enumerate().flat_map(|(body, b)| b.shapes.iter().map(move |shape| (body, b, shape)));
    for (place, (body, b, shape)) in shapes.enumerate() {
        if floating || b.link != 0 {
            let mut translation = (align[b.link] * shape.origin.translation).as_vec3();
            let mut rotation = DQuat::from_mat3(&(align[b.link] * shape.origin.rotation)).normalize().as_quat();
            let collider = match &shape.geometry {
                Geometry::Sphere { radius } => Collider::sphere(*radius as f32),
                Geometry::Box { size } => Collider::cuboid(size.x as f32, size.y as f32, size.z as f32),
                Geometry::Cylinder { radius, length } => {
                    rotation *= upright;
                    Collider::cylinder(*radius as f32, *length as f32)
                }
                Geometry::Capsule { radius, length } => {
                    rotation *= upright;
                    Collider::capsule(*radius as f32, *length as f32)
                }
                Geometry::Hull { points } => hull(points).unwrap_or_else(|| {
                    let least = points.iter().copied().reduce(DVec3::min).unwrap_or_default().as_vec3();
                    let most = points.iter().copied().reduce(DVec3::max).unwrap_or_default().as_vec3();
                    translation += rotation * ((least + most) * 0.5);
                    let size = (most - least).max(Vec3::splat(MIN_THICKNESS));
                    Collider::cuboid(size.x, size.y, size.z)
                }),
            };
            let (friction, margin) = (b.surface.friction as f32, b.surface.margin as f32);
            all.push(LinkCollider {
                link: b.link,
                body,
                shape: place,
                friction,
                margin,
                collider,
                translation,
                rotation,
            });
        }
    }
    all
}

/// One collider for each link that has any, in the links' URDF frames.
pub(crate) fn link_colliders(model: &Model) -> Vec<Option<Collider>> {
    let mut parts: Vec<Vec<(Vec3, Quat, Collider)>> = vec![Vec::new(); model.links.len()];
    for c in colliders(model, &vec![DMat3::IDENTITY; model.links.len()], true) {
        parts[c.link].push((c.translation, c.rotation, c.collider));
    }
    parts.into_iter().map(|parts| (!parts.is_empty()).then(|| Collider::compound(parts))).collect()
}
