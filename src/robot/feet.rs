//! Contact of a leg with the ground.

use glam::{DMat3, DVec3};

use super::chains::ZeroPose;
use super::model::{Geometry, Shape};

/// A sphere is the foot when it reaches at least this share of the leg's farthest reach, and no
/// shape reaches farther by more than its radius: a wheel or a spring below it stands on the
/// ground.
const SPHERE_REACH: f64 = 0.8;

/// Components of a unit vector below this are zero: makers write right angles as 1.5708, or as
/// 1.57.
const FLAT: f64 = 1e-3;

/// Height of the sole, m: parts of a foot no higher than this above its lowest part belong to the
/// sole.
const SOLE: f64 = 5e-3;

/// Points of a hull that are no higher than this above its lowest one are its sole, m.
const LEVEL: f64 = 1e-4;

/// Least length of the level part of a hull over that of its part no higher than `SOLE`. Soles of
/// scanned meshes are uneven: their lowest point alone says little.
const EVEN: f64 = 0.5;

/// The contact of a leg with the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Touch {
    /// Index of the contact body.
    pub body: usize,
    /// Index of the link that carries it.
    pub link: usize,
    /// Centre of the ball that touches the ground, in the link frame, m.
    pub point: DVec3,
    /// Radius of that ball, m; 0 for shapes without one.
    pub radius: f64,
    /// Distance from the knee to the far side of the ball at zero joint positions, m.
    reach: f64,
    is_sphere: bool,
}

/// The foot of the leg that ends in `knee`: of all shapes below the knee (or only those of body
/// `named`), the sphere farthest from the knee; any other shape only when it reaches clearly
/// farther. `None` when there are no shapes.
pub(super) fn find(pose: &ZeroPose<'_>, knee: usize, named: Option<usize>) -> Option<Touch> {
    let knee_position = pose.position(knee);
    let mut feet = Vec::new();
    for (index, body) in pose.model.bodies.iter().enumerate() {
        let wanted = match named {
            Some(named) => index == named,
            None => pose.is_below(body.link, knee),
        };
        if !wanted {
            continue;
        }
        let link = &pose.links[body.link];
        for shape in &body.shapes {
            for (point, radius) in contact_balls(shape, link.rotation.transpose() * -DVec3::Z) {
                feet.push(Touch {
                    body: index,
                    link: body.link,
                    point,
                    radius,
                    reach: link.transform_point(point).distance(knee_position) + radius,
                    is_sphere: matches!(shape.geometry, Geometry::Sphere { .. }),
                });
            }
        }
    }
    let farthest = |feet: &mut dyn Iterator<Item = &Touch>| feet.max_by(|a, b| a.reach.total_cmp(&b.reach)).copied();
    let any = farthest(&mut feet.iter())?;
    let sphere = farthest(&mut feet.iter().filter(|foot| foot.is_sphere));
    let touches = |foot: &Touch| foot.reach >= SPHERE_REACH * any.reach && foot.reach + foot.radius >= any.reach;
    Some(sphere.filter(touches).unwrap_or(any))
}

/// The foot of a leg that ends in a sole: the middle of the body's lowest part, at zero joint
/// positions. A single ball is taken as it is.
pub(super) fn sole(pose: &ZeroPose<'_>, body: usize) -> Option<(DVec3, f64)> {
    let body = &pose.model.bodies[body];
    let link = &pose.links[body.link];
    let to_link = link.rotation.transpose();
    let down = to_link * -DVec3::Z;
    let balls_of = |shape: &Shape| match uneven_sole(shape, to_link) {
        Some(middle) => vec![(middle, 0.0)],
        None => contact_balls(shape, down),
    };
    let balls: Vec<(DVec3, f64)> = body.shapes.iter().flat_map(balls_of).collect();
    let depth = |(point, radius): &(DVec3, f64)| point.dot(down) + radius;
    let deepest = balls.iter().map(depth).fold(f64::NEG_INFINITY, f64::max);
    let lowest: Vec<&(DVec3, f64)> = balls.iter().filter(|ball| depth(ball) > deepest - SOLE).collect();
    match lowest[..] {
        [] => None,
        [ball] => Some(*ball),
        _ => {
            let touching = lowest.iter().map(|(point, radius)| point + down * *radius);
            Some((touching.sum::<DVec3>() / lowest.len() as f64, 0.0))
        }
    }
}

/// Middle of the sole of a hull whose lowest points lie close together, in the link frame and at
/// the height of the lowest one; None for other shapes. `to_link` rotates from the base to the
/// link.
fn uneven_sole(shape: &Shape, to_link: DMat3) -> Option<DVec3> {
    let Geometry::Hull { points } = &shape.geometry else {
        return None;
    };
    // along the axes of the base
    let points: Vec<DVec3> =
        points.iter().map(|point| to_link.transpose() * shape.origin.transform_point(*point)).collect();
    let lowest = points.iter().map(|point| point.z).fold(f64::INFINITY, f64::min);
    let part = |height: f64| {
        let part = points.iter().filter(|point| point.z < lowest + height);
        part.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), point| (low.min(*point), high.max(*point)))
    };
    let length = |(low, high): (DVec3, DVec3)| (high - low).truncate().length();
    let (low, high) = part(SOLE);
    let is_even = length(part(LEVEL)) >= EVEN * length((low, high));
    (!is_even).then(|| to_link * (0.5 * (low + high)).with_z(lowest))
}

/// Lowest z of shapes and joints below `joint`, at zero joint positions in the base frame, m.
pub(super) fn lowest_below(pose: &ZeroPose<'_>, joint: usize) -> f64 {
    let hangs = |link: usize| pose.is_below(link, joint);
    let joints = (0..pose.model.joints.len()).filter(|other| hangs(other + 1)).map(|other| pose.position(other).z);
    let bodies = pose.model.bodies.iter().filter(|body| hangs(body.link));
    let shapes = bodies.flat_map(|body| {
        let link = &pose.links[body.link];
        let down = link.rotation.transpose() * -DVec3::Z;
        body.shapes
            .iter()
            .flat_map(move |shape| contact_balls(shape, down))
            .map(|(point, radius)| link.transform_point(point).z - radius)
    });
    joints.chain(shapes).fold(f64::INFINITY, f64::min)
}

/// Centres (link frame) and radii of the balls with which a shape can touch ground that lies in the
/// direction `down` (link frame). A sphere is one ball, a capsule has one at each end, and for
/// other convex shapes it is the middle of the lowest part.
fn contact_balls(shape: &Shape, down: DVec3) -> Vec<(DVec3, f64)> {
    let down = shape.origin.rotation.transpose() * down;
    // A direction along a face or edge leaves its middle.
    let along = |component: f64, half: f64| {
        if component.abs() < FLAT { 0.0 } else { half * component.signum() }
    };
    let balls = match shape.geometry {
        Geometry::Sphere { radius } => vec![(DVec3::ZERO, radius)],
        Geometry::Capsule { radius, length } => {
            let end = DVec3::Z * (0.5 * length);
            vec![(end, radius), (-end, radius)]
        }
        Geometry::Box { size } => {
            let half = 0.5 * size;
            let corner = DVec3::new(along(down.x, half.x), along(down.y, half.y), along(down.z, half.z));
            vec![(corner, 0.0)]
        }
        Geometry::Cylinder { radius, length } => {
            let sideways = DVec3::new(down.x, down.y, 0.0);
            let rim = if sideways.length() < FLAT { DVec3::ZERO } else { sideways.normalize_or_zero() * radius };
            vec![(rim + DVec3::Z * along(down.z, 0.5 * length), 0.0)]
        }
        Geometry::Hull { ref points } => {
            let lowest = points.iter().map(|p| p.dot(down)).fold(f64::NEG_INFINITY, f64::max);
            let level: Vec<DVec3> = points.iter().copied().filter(|p| p.dot(down) > lowest - LEVEL).collect();
            vec![(level.iter().sum::<DVec3>() / level.len() as f64, 0.0)]
        }
    };
    balls.into_iter().map(|(point, radius)| (shape.origin.transform_point(point), radius)).collect()
}
