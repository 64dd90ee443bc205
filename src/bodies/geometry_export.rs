//! Poses and geometry of a running simulation, for viewers and other simulators.

use glam::{DMat3, DQuat};
use serde::Serialize;

use crate::morphology::MorphologyModel;
use crate::robot::{BodyGroup, Geometry, hull_triangles};

/// Links and collision shapes of a robot; SI units.
#[derive(Clone, Debug, Serialize)]
pub struct Outline {
    /// Names of the links, the base first; parts that are fixed to a link belong to it.
    pub links: Vec<String>,
    /// Centre of mass of the base in its frame, m.
    pub base_com: [f64; 3],
    /// Contact bodies: links of the URDF with collision shapes.
    pub bodies: Vec<BodyOutline>,
}

/// A contact body.
#[derive(Clone, Debug, Serialize)]
pub struct BodyOutline {
    /// Name of the link in the URDF.
    pub name: String,
    /// Index in [`Outline::links`] of the link that carries it.
    pub link: usize,
    /// base, hip, thigh, shank, foot or other.
    pub group: String,
    /// Collision shapes of the body, in the axes of its link.
    pub shapes: Vec<ShapeOutline>,
}

/// A collision shape; cylinders and capsules lie along z.
#[derive(Clone, Debug, Serialize)]
pub struct ShapeOutline {
    /// Kind and sizes of the shape, m.
    #[serde(flatten)]
    pub geometry: Geometry,
    /// Faces of a convex hull, outward, as indices of its points; None where they cannot be
    /// computed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub triangles: Option<Vec<[usize; 3]>>,
    /// Position of the shape's frame in the frame of its link, m.
    pub position: [f64; 3],
    /// Orientation of the shape's frame in the frame of its link; w, x, y, z.
    pub quaternion: [f64; 4],
}

/// An orientation as w, x, y, z with `w >= 0`.
pub(crate) fn quaternion(rotation: &DMat3) -> [f64; 4] {
    let q = DQuat::from_mat3(rotation).normalize();
    let q = if q.w < 0.0 { -q } else { q };
    [q.w, q.x, q.y, q.z]
}

impl MorphologyModel {
    /// Links and collision shapes of the robot.
    pub fn outline(&self) -> Outline {
        let shape = |shape: &crate::robot::Shape| ShapeOutline {
            geometry: shape.geometry.clone(),
            triangles: match &shape.geometry {
                Geometry::Hull { points } => Some(hull_triangles(points)),
                _ => None,
            },
            position: shape.origin.translation.to_array(),
            quaternion: quaternion(&shape.origin.rotation),
        };
        let body = |(body, group): (&crate::robot::Body, &BodyGroup)| BodyOutline {
            name: body.name.clone(),
            link: body.link,
            group: format!("{group:?}").to_lowercase(),
            shapes: body.shapes.iter().map(shape).collect(),
        };
        Outline {
            links: self.model.links.iter().map(|link| link.name.clone()).collect(),
            base_com: self.model.links.first().map_or([0.0; 3], |base| base.com.to_array()),
            bodies: self.model.bodies.iter().zip(&self.body_groups).map(body).collect(),
        }
    }
}
