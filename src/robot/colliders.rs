//! Pairs of parts that may touch each other, and the simple shapes that stand for the parts.

use std::f64::consts::PI;

use glam::{DMat3, DVec3};
use rand_pcg::Pcg32;
use rand_pcg::rand_core::Rng;

use super::model::{Geometry, Model, Shape};
use crate::dynamics::lanes::Simd;
use crate::dynamics::{ColliderTopology, Parameters, Topology, Workspace, pair_gaps};

/// Number of joint positions that are tried in the search for pairs that can meet at all.
const SAMPLES: usize = 2048;
/// Distance above which a pair is left out if no sample brings it nearer, m.
const NEVER_NEAR: f64 = 0.05;
/// Distance below which a pair in the reference pose is left out, m: their shapes overlap by
/// design.
const TOUCHES_BY_DESIGN: f64 = 0.005;
/// Range in which a joint without a limit is tried, rad or m.
const UNLIMITED_RANGE: f64 = PI;

/// One collider while it is being placed, in link axes of the engine.
struct Collider {
    topology: ColliderTopology,
    centre: DVec3,
    half: DVec3,
    radius: f64,
    volume: f64,
}

/// Adds colliders and the pairs of them that can meet to an articulation without any; `align` turns
/// a link's own axes into the engine's, `reference` is a pose (one position per joint) in which
/// nothing is meant to collide. Returns which shapes these pairs are of, counted body after body.
pub(super) fn add_pairs(
    model: &Model,
    align: &[DMat3],
    reference: &[f64],
    topology: &mut Topology,
    parameters: &mut Parameters<f64>,
) -> Vec<[usize; 2]> {
    let mut colliders: Vec<Collider> = Vec::new();
    // each shape as it is, and as a capsule: a box counts as a box against smaller shapes, as a
    // capsule against larger boxes
    let mut parts = Vec::new();
    for (body, b) in model.bodies.iter().enumerate() {
        for shape in &b.shapes {
            let whole = colliders.len();
            colliders.extend(shape_colliders(shape, b.link, body, align[b.link]));
            parts.push((whole, colliders.len() - 1));
        }
    }
    let is_box = |whole: usize| colliders[whole].topology.box_rotation.is_some();
    let (mut pairs, mut shapes) = (Vec::new(), Vec::new());
    for (i, a) in parts.iter().enumerate() {
        for (j, b) in parts[..i].iter().enumerate() {
            if !are_apart(model, colliders[a.0].topology.link, colliders[b.0].topology.link) {
                continue;
            }
            let (larger, smaller) = if colliders[a.0].volume < colliders[b.0].volume { (b, a) } else { (a, b) };
            let flat_in_round = is_box(smaller.0) && !is_box(larger.0);
            let pair = if flat_in_round { [larger.0, smaller.0] } else { [smaller.1, larger.0] };
            let capsule = &colliders[pair[0]];
            pairs.push((pair, capsule.half.length() > capsule.radius));
            shapes.push([j, i]);
        }
    }
    parameters.collider_centre = colliders.iter().map(|c| c.centre.to_array()).collect();
    parameters.collider_half = colliders.iter().map(|c| c.half.to_array()).collect();
    parameters.collider_radius = colliders.iter().map(|c| c.radius).collect();
    topology.set_pairs(colliders.iter().map(|c| c.topology).collect(), &pairs);

    let kept = can_meet(topology, parameters, reference);
    let shapes = shapes.into_iter().zip(&kept).filter_map(|(pair, keep)| keep.then_some(pair)).collect();
    let mut pairs: Vec<_> = pairs.into_iter().zip(kept).filter_map(|(pair, keep)| keep.then_some(pair)).collect();
    // put pairs of the same two links next to each other
    pairs.sort_by_key(|(pair, _)| pair.map(|c| colliders[c].topology.link));
    // keep only colliders that are in some pair
    let mut used: Vec<usize> = pairs.iter().flat_map(|(pair, _)| *pair).collect();
    used.sort_unstable();
    used.dedup();
    let place = |c: usize| used.partition_point(|&u| u < c);
    let pairs: Vec<_> = pairs.iter().map(|(pair, long)| (pair.map(place), *long)).collect();
    parameters.collider_centre = used.iter().map(|&c| colliders[c].centre.to_array()).collect();
    parameters.collider_half = used.iter().map(|&c| colliders[c].half.to_array()).collect();
    parameters.collider_radius = used.iter().map(|&c| colliders[c].radius).collect();
    topology.set_pairs(used.iter().map(|&c| colliders[c].topology).collect(), &pairs);
    shapes
}

/// Whether two links are neither the same nor joined by one joint.
fn are_apart(model: &Model, a: usize, b: usize) -> bool {
    a != b && model.parent(a) != Some(b) && model.parent(b) != Some(a)
}

/// Pairs that are apart in the reference pose and near each other in another.
fn can_meet(topology: &Topology, parameters: &Parameters<f64>, reference: &[f64]) -> Vec<bool> {
    let simd = Simd::available().first().map_or(Simd::Portable, |simd| *simd).dispatch();
    let (mut work, mut gaps) = (Workspace::new(topology), Vec::new());
    let all: Vec<usize> = (0..topology.pairs.len()).collect();
    pair_gaps(simd, topology, parameters, reference, &all, &mut work, &mut gaps);
    let mut open: Vec<usize> = all.into_iter().filter(|&pair| gaps[pair] > TOUCHES_BY_DESIGN).collect();
    let mut meet = vec![false; topology.pairs.len()];
    let mut rng = Pcg32::new(1, 1);
    let mut q = vec![0.0; topology.num_joints()];
    for _ in 0..SAMPLES {
        for (j, x) in q.iter_mut().enumerate() {
            let low = parameters.lower[j].max(reference[j] - UNLIMITED_RANGE);
            let high = parameters.upper[j].min(reference[j] + UNLIMITED_RANGE);
            *x = low + (high - low) * f64::from(rng.next_u32()) / f64::from(u32::MAX);
        }
        pair_gaps(simd, topology, parameters, &q, &open, &mut work, &mut gaps);
        open.iter().zip(&gaps).for_each(|(&pair, &gap)| meet[pair] = gap < NEVER_NEAR);
        open.retain(|&pair| !meet[pair]);
    }
    meet
}

/// Colliders of a shape: the shape itself where it is a sphere, a capsule or a long cylinder, else
/// a box followed by the longest capsule inside it.
fn shape_colliders(shape: &Shape, link: usize, body: usize, align: DMat3) -> Vec<Collider> {
    let centre = align * shape.origin.translation;
    let rotation = align * shape.origin.rotation;
    let capsule = |half: DVec3, radius: f64, volume: f64| Collider {
        topology: ColliderTopology { link, body, box_rotation: None },
        centre,
        half: rotation * half,
        radius,
        volume,
    };
    let of_box = |centre: DVec3, size: DVec3| {
        let half = 0.5 * size;
        let longest = (0..3).max_by(|&a, &b| half[a].total_cmp(&half[b])).unwrap_or(0);
        let radius = (0..3).filter(|&i| i != longest).map(|i| half[i]).fold(f64::INFINITY, f64::min);
        let mut axis = DVec3::ZERO;
        axis[longest] = half[longest] - radius;
        let volume = size.element_product();
        let rows = rotation.transpose();
        let solid = Collider {
            topology: ColliderTopology {
                link,
                body,
                box_rotation: Some([rows.x_axis, rows.y_axis, rows.z_axis].map(|row| row.to_array())),
            },
            centre,
            half,
            radius: 0.0,
            volume,
        };
        vec![solid, Collider { centre, ..capsule(axis, radius, volume) }]
    };
    match &shape.geometry {
        Geometry::Sphere { radius } => vec![capsule(DVec3::ZERO, *radius, radius.powi(3) * PI * 4.0 / 3.0)],
        Geometry::Capsule { radius, length } => {
            vec![capsule(DVec3::Z * (0.5 * length), *radius, radius.powi(2) * (length + radius) * PI)]
        }
        Geometry::Cylinder { radius, length } if *length >= 2.0 * radius => {
            vec![capsule(DVec3::Z * (0.5 * length - radius), *radius, radius.powi(2) * length * PI)]
        }
        // a disc: the box between the square inside and the square about it, of the same area
        Geometry::Cylinder { radius, length } => {
            let side = radius * PI.sqrt();
            of_box(centre, DVec3::new(side, side, *length))
        }
        Geometry::Box { size } => of_box(centre, *size),
        // the points' bounding box
        Geometry::Hull { points } => {
            let low = points.iter().copied().reduce(DVec3::min).unwrap_or_default();
            let high = points.iter().copied().reduce(DVec3::max).unwrap_or_default();
            of_box(align * shape.origin.transform_point(0.5 * (low + high)), high - low)
        }
    }
}
