//! Limbs on the left and on the right that are no mirror images of each other.

use glam::DVec3;

use super::error::Warning;
use super::limbs::{Limb, LimbJoint, Roles, Side};
use super::model::{Geometry, JointKind, Model};
use super::pose::Pose;

/// Masses and lengths of both sides differ by less than this share of the larger one.
const SHARE: f64 = 0.05;
/// Differences below these are rounding or cables: kg and m.
const LEAST_MASS: f64 = 0.02;
const LEAST_LENGTH: f64 = 0.004;
/// Inertias, as the sum of the principal moments, differ by less than this share.
const INERTIA_SHARE: f64 = 0.25;
/// Ranges of joints have at least this share of the smaller one in common.
const RANGE_SHARE: f64 = 0.5;
/// Cosine of the angle to the mirrored axis up to which two joints turn about the same axis.
const SAME_AXIS: f64 = 0.9;

/// Warnings for limbs whose counterpart on the other side has other joints, ranges, masses, lengths
/// or feet. A policy that learns from mirror images takes them for the same.
pub fn unequal_sides(model: &Model, roles: &Roles) -> Vec<Warning> {
    let mut warnings = Vec::new();
    let mut others: Vec<&Limb> = roles.limbs.iter().filter(|limb| limb.place.side() == Side::Right).collect();
    for left in roles.limbs.iter().filter(|limb| limb.place.side() == Side::Left) {
        let partner = others.iter().position(|limb| limb.place == left.place.mirrored() && limb.kind == left.kind);
        let Some(at) = partner else {
            continue;
        };
        let right = others.remove(at);
        let found = differences(model, left, right);
        if found.is_empty() {
            continue;
        }
        let (shown, more) = found.split_at(found.len().min(3));
        let and_more = if more.is_empty() { String::new() } else { format!(", and {} more", more.len()) };
        warnings.push(Warning::new(
            &model.source,
            format!("limbs {} and {}", left.place.name(), right.place.name()),
            format!("they are no mirror images: {}{and_more}", shown.join(", ")),
            "correct the file, or train without mirror images: --set train.run.symmetry=false",
        ));
    }
    warnings
}

/// Differences between two limbs, a clause each.
fn differences(model: &Model, left: &Limb, right: &Limb) -> Vec<String> {
    let mut found = Vec::new();
    let zero = model.forward_kinematics(&[]);
    if left.joints.len() != right.joints.len() {
        found.push(format!("{} joints against {}", left.joints.len(), right.joints.len()));
    }
    for own in &left.joints {
        let counterpart = |other: &&LimbJoint| other.slot.role == own.slot.role && other.slot.nth == own.slot.nth;
        let Some(other) = right.joints.iter().find(counterpart) else {
            let name = &model.joints[own.joint].name;
            found.push(format!("joint \"{name}\" ({}) has no counterpart", own.slot));
            continue;
        };
        let [a, b] = [own, other].map(|joint| &model.links[joint.joint + 1]);
        if differ(a.mass, b.mass, SHARE, LEAST_MASS) {
            found.push(format!("\"{}\" has {:.3} kg and \"{}\" {:.3} kg", a.name, a.mass, b.name, b.mass));
        } else if a.mass.max(b.mass) > LEAST_MASS {
            let [of_a, of_b] = [a, b].map(|link| link.inertia.x_axis.x + link.inertia.y_axis.y + link.inertia.z_axis.z);
            if differ(of_a, of_b, INERTIA_SHARE, 0.0) {
                found.push(format!("the inertia of \"{}\" is {:.2} times that of \"{}\"", a.name, of_a / of_b, b.name));
            }
        }
        let [of_a, of_b] = [own, other].map(|joint| model.joints[joint.joint].origin.translation.length());
        if differ(of_a, of_b, SHARE, LEAST_LENGTH) {
            let [a, b] = [own, other].map(|joint| &model.joints[joint.joint].name);
            found.push(format!("joint \"{a}\" lies {of_a:.4} m from the one before and \"{b}\" {of_b:.4} m"));
        }
        found.extend(ranges(model, &zero, own.joint, other.joint));
    }
    feet(model, left, right, &mut found);
    found
}

/// Says that two joints turn to different sides: their ranges, mirrored, have little in common.
fn ranges(model: &Model, zero: &[Pose], left: usize, right: usize) -> Option<String> {
    let [a, b] = [left, right].map(|joint| &model.joints[joint]);
    let [of_a, of_b] = [(left, a), (right, b)].map(|(joint, own)| zero[joint + 1].rotation * own.axis);
    // a mirror turns the direction of a rotation about x or z round, and that of a slide along y
    let mirror = if a.kind == JointKind::Prismatic { DVec3::new(1.0, -1.0, 1.0) } else { DVec3::new(-1.0, 1.0, -1.0) };
    let direction = (mirror * of_a).dot(of_b);
    let is_limited = [a.lower, a.upper, b.lower, b.upper].iter().all(|limit| limit.is_finite());
    if !is_limited || a.kind != b.kind || direction.abs() < SAME_AXIS {
        return None;
    }
    let (lower, upper) = if direction > 0.0 { (b.lower, b.upper) } else { (-b.upper, -b.lower) };
    let common = a.upper.min(upper) - a.lower.max(lower);
    let unit = if a.kind == JointKind::Prismatic { "m" } else { "rad" };
    (common < RANGE_SHARE * (a.upper - a.lower).min(upper - lower)).then(|| {
        format!(
            "joint \"{}\" reaches from {:.2} to {:.2} {unit} and \"{}\", mirrored, from {lower:.2} to {upper:.2}",
            a.name, a.lower, a.upper, b.name
        )
    })
}

fn feet(model: &Model, left: &Limb, right: &Limb, found: &mut Vec<String>) {
    let (Some(a), Some(b)) = (&left.foot, &right.foot) else {
        return;
    };
    let [of_a, of_b] = [a, b].map(|foot| &model.bodies[foot.body]);
    let place = |limb: &Limb, link: usize| limb.joints.iter().position(|joint| joint.joint + 1 == link);
    if place(left, of_a.link) != place(right, of_b.link) {
        let [a, b] = [of_a, of_b].map(|body| &body.name);
        found.push(format!("the feet \"{a}\" and \"{b}\" are moved by joints of other roles"));
        return;
    }
    let [(size_a, reach_a), (size_b, reach_b)] = [of_a.link, of_b.link].map(|link| foot_size(model, link));
    let lengths = [(reach_a, reach_b), (size_a.x, size_b.x), (size_a.y, size_b.y), (size_a.z, size_b.z)];
    if lengths.iter().any(|(a, b)| differ(*a, *b, SHARE, LEAST_LENGTH)) {
        let show = |size: DVec3, reach: f64| {
            format!("{:.3} x {:.3} x {:.3} m, {reach:.3} m from its joint", size.x, size.y, size.z)
        };
        let (a, b) = (show(size_a, reach_a), show(size_b, reach_b));
        found.push(format!("foot \"{}\" is {a}, and \"{}\" {b}", of_a.name, of_b.name));
    }
}

/// Sides of the box about the shapes of a link, joints at zero and along the axes of the base, and
/// distance of its middle from the link's joint, m.
fn foot_size(model: &Model, link: usize) -> (DVec3, f64) {
    let pose = model.forward_kinematics(&[])[link];
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for shape in model.bodies.iter().filter(|body| body.link == link).flat_map(|body| &body.shapes) {
        let (points, round): (Vec<DVec3>, f64) = match &shape.geometry {
            Geometry::Sphere { radius } => (vec![DVec3::ZERO], *radius),
            Geometry::Capsule { radius, length } => {
                (vec![DVec3::Z * (0.5 * length), DVec3::Z * (-0.5 * length)], *radius)
            }
            Geometry::Cylinder { radius, length } => (corners(DVec3::new(2.0 * radius, 2.0 * radius, *length)), 0.0),
            Geometry::Box { size } => (corners(*size), 0.0),
            Geometry::Hull { points } => (points.clone(), 0.0),
        };
        for point in points {
            let point = pose.transform_point(shape.origin.transform_point(point));
            low = low.min(point - round);
            high = high.max(point + round);
        }
    }
    ((high - low).max(DVec3::ZERO), (0.5 * (high + low)).distance(pose.translation))
}

fn corners(size: DVec3) -> Vec<DVec3> {
    let side = |corner: u32, bit: u32| f64::from(corner >> bit & 1) - 0.5;
    (0..8).map(|corner| size * DVec3::new(side(corner, 0), side(corner, 1), side(corner, 2))).collect()
}

fn differ(a: f64, b: f64, share: f64, least: f64) -> bool {
    (a - b).abs() > (share * a.max(b)).max(least)
}
