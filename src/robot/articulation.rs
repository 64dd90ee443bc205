//! The engine's view of a model, with the places of its numbers in the articulation.

use glam::{DMat3, DVec3};

use super::colliders::add_pairs;
use super::model::{BodySurface, Geometry, JointKind, Model, Shape};
use crate::dynamics::{
    Axis, ContactFriction, ContactKind, ContactTopology, JointMotion, JointTopology, Parameters, Topology,
};

/// Speed limit of a joint that has none, rad/s or m/s. It is finite, since the solver multiplies it
/// by impulses that may be zero.
pub const FASTEST: f64 = 1e9;
/// Rims of cylinders are represented by this many points each.
const RIM_POINTS: usize = 3;

/// A point of a link whose motion is reported.
#[derive(Clone, Copy, Debug)]
pub struct Site {
    /// Index in [`Model::links`].
    pub link: usize,
    /// Position in the link's own (URDF) frame, m.
    pub position: DVec3,
}

/// A model in the engine's terms. Link axes are parallel to the base's when all joints are at zero,
/// which leaves only joint offsets and axes; `align` leads there from the URDF's axes.
#[derive(Clone, Debug)]
pub struct Articulation {
    /// Topology that robots of the kind share.
    pub topology: Topology,
    /// Numbers of the body: those of the URDF, no gains, no friction with the ground but that of
    /// the surfaces.
    pub parameters: Parameters<f64>,
    /// Turns a link's own axes into base-aligned ones, `[links]`.
    pub align: Vec<DMat3>,
    /// Collision shapes that may touch each other, counted body after body; those of the topology's
    /// pairs.
    pub shape_pairs: Vec<[usize; 2]>,
}

impl Articulation {
    /// Makes the articulation of a model, `floating` or with the base fixed to the world. Joints
    /// have the efforts of the URDF as limits and no actuator gains; velocity limits are left to
    /// actuators. A position or effort limit that is absent is infinite.
    ///
    /// With `self_collision` links may touch each other; it is a pose (one position per joint, rad
    /// or m) in which none is meant to: shapes that overlap there do so by design and are left
    /// alone, as are links joined by one joint.
    pub fn new(model: &Model, floating: bool, sites: &[Site], self_collision: Option<&[f64]>) -> Self {
        let zero = vec![0.0; model.joints.len()];
        let align: Vec<DMat3> = model.forward_kinematics(&zero).iter().map(|pose| pose.rotation).collect();
        let joints = model
            .joints
            .iter()
            .enumerate()
            .map(|(j, joint)| JointTopology {
                parent: joint.parent,
                motion: match joint.kind {
                    JointKind::Prismatic => JointMotion::Prismatic,
                    JointKind::Revolute | JointKind::Continuous => JointMotion::Revolute,
                },
                axis: Axis::new((align[j + 1] * joint.axis).to_array()),
                effort_table: None,
                explicit: false,
            })
            .collect();

        let mut candidates: Vec<Candidate> = model
            .bodies
            .iter()
            .enumerate()
            // a fixed base feels no ground
            .filter(|(_, b)| floating || b.link != 0)
            .flat_map(|(body, b)| b.shapes.iter().flat_map(move |shape| candidates(shape, b.link, body)))
            .collect();
        candidates.sort_by_key(|c| c.topology.link);
        let spheres: Vec<usize> = (0..candidates.len()).filter(|&k| candidates[k].is_sphere()).collect();
        let hidden: Vec<bool> = (0..candidates.len()).map(|i| is_hidden(&candidates, &spheres, i)).collect();
        let mut hidden = hidden.into_iter();
        candidates.retain(|_| !hidden.next().unwrap_or(false));
        for c in &mut candidates {
            c.align(align[c.topology.link]);
        }
        let mut topology = Topology::new(
            floating,
            joints,
            candidates.iter().map(|c| c.topology).collect(),
            model.bodies.len(),
            sites.iter().map(|site| site.link).collect(),
            false,
        );

        topology.has_surfaces = !model.bodies.iter().all(|body| body.surface.has_friction_of_robot());
        let most = |coefficient: fn(&BodySurface) -> f64| {
            model.bodies.iter().map(|body| coefficient(&body.surface)).fold(0.0, f64::max)
        };
        topology.friction = ContactFriction::of(most(|s| s.torsional_friction), most(|s| s.rolling_friction));
        let mut p = Parameters::<f64>::zeros(&topology);
        for (l, link) in model.links.iter().enumerate() {
            p.mass[l] = link.mass;
            p.com[l] = (align[l] * link.com).to_array();
            p.inertia[l] = symmetric(align[l] * link.inertia * align[l].transpose());
        }
        for (j, joint) in model.joints.iter().enumerate() {
            p.joint_offset[j] = (align[joint.parent] * joint.origin.translation).to_array();
            p.lower[j] = joint.lower;
            p.upper[j] = joint.upper;
            p.armature[j] = joint.armature;
            p.joint_damping[j] = joint.damping;
            p.joint_friction[j] = joint.friction;
            p.effort_limit[j] = joint.effort;
            p.saturation_effort[j] = f64::INFINITY;
            p.motor_velocity_limit[j] = f64::INFINITY;
            p.velocity_limit[j] = FASTEST;
        }
        for (i, c) in candidates.iter().enumerate() {
            p.contact_position[i] = c.position.to_array();
            p.contact_radius[i] = c.radius + model.bodies[c.topology.body].surface.margin;
            p.contact_rim[i] = c.rim;
        }
        for (friction, c) in p.contact_friction.iter_mut().zip(&candidates) {
            let surface = &model.bodies[c.topology.body].surface;
            *friction = [surface.friction, surface.torsional_friction, surface.rolling_friction];
        }
        for (s, site) in sites.iter().enumerate() {
            p.site_position[s] = (align[site.link] * site.position).to_array();
        }
        let shape_pairs = self_collision
            .map_or_else(Vec::new, |reference| add_pairs(model, &align, reference, &mut topology, &mut p));
        p.box_links(&topology);
        Self { topology, parameters: p, align, shape_pairs }
    }
}

/// Limits about the middle of a joint's range, `share` of which lies between them. A joint without
/// two limits has no range and keeps what limits it has.
pub fn soft_limits([lower, upper]: [f32; 2], share: f32) -> [f32; 2] {
    if !(lower.is_finite() && upper.is_finite()) {
        return [lower, upper];
    }
    let (middle, half) = (0.5 * (lower + upper), 0.5 * (upper - lower) * share);
    [middle - half, middle + half]
}

/// xx, yy, zz, xy, xz, yz of a symmetric matrix.
pub fn symmetric(m: DMat3) -> [f64; 6] {
    [m.x_axis.x, m.y_axis.y, m.z_axis.z, m.y_axis.x, m.z_axis.x, m.z_axis.y]
}

/// Largest stretch of a randomised body: a hidden candidate stays hidden.
const STRETCH: f64 = 1.15;

/// A contact candidate before it is placed.
struct Candidate {
    topology: ContactTopology,
    position: DVec3,
    radius: f64,
    rim: f64,
}

impl Candidate {
    fn point(link: usize, body: usize, position: DVec3, radius: f64) -> Self {
        Self { topology: ContactTopology { link, body, kind: ContactKind::Point }, position, radius, rim: 0.0 }
    }

    fn is_sphere(&self) -> bool {
        self.radius > 0.0 && matches!(self.topology.kind, ContactKind::Point)
    }

    fn align(&mut self, rotation: DMat3) {
        self.position = rotation * self.position;
        if let ContactKind::Rim { across, .. } = &mut self.topology.kind {
            *across = across.map(|u| (rotation * DVec3::from_array(u)).to_array());
        }
    }
}

/// Whether a candidate lies inside a sphere of the same link, which then always touches first: a
/// corner of the shank in the foot. Among equal candidates of a body the first is kept. Candidates
/// are in the order of their links; `spheres` are those that are one.
fn is_hidden(candidates: &[Candidate], spheres: &[usize], i: usize) -> bool {
    let c = &candidates[i];
    let covers = |k: usize, sphere: &Candidate| {
        let apart = (c.position - sphere.position) * STRETCH;
        // a rim reaches furthest on the far side of its axis
        let furthest = match c.topology.kind {
            ContactKind::Point => apart.length(),
            ContactKind::Rim { across, .. } => {
                let aside = across.map(|u| apart.dot(DVec3::from_array(u)));
                let aside = aside[0].hypot(aside[1]);
                let along = (apart.length_squared() - aside * aside).max(0.0).sqrt();
                along.hypot(aside + c.rim)
            }
        };
        let room = sphere.radius - (furthest + c.radius);
        room > 0.0 || (room == 0.0 && k < i && sphere.topology.body == c.topology.body)
    };
    let link = |k: &usize| candidates[*k].topology.link;
    let first = spheres.partition_point(|k| link(k) < c.topology.link);
    let of_link = spheres[first..].iter().take_while(|k| link(k) == c.topology.link);
    of_link.copied().any(|k| k != i && covers(k, &candidates[k]))
}

/// The points of a shape that can touch a plane first, in the frame of its link.
fn candidates(shape: &Shape, link: usize, body: usize) -> Vec<Candidate> {
    let at = |p: DVec3| shape.origin.transform_point(p);
    match &shape.geometry {
        Geometry::Sphere { radius } => vec![Candidate::point(link, body, at(DVec3::ZERO), *radius)],
        Geometry::Capsule { radius, length } => {
            [-0.5, 0.5].map(|end| Candidate::point(link, body, at(DVec3::Z * (end * length)), *radius)).into()
        }
        Geometry::Box { size } => (0..8)
            .map(|corner| {
                let sign = |bit: usize| if corner & bit == 0 { -0.5 } else { 0.5 };
                Candidate::point(link, body, at(DVec3::new(sign(1), sign(2), sign(4)) * *size), 0.0)
            })
            .collect(),
        Geometry::Cylinder { radius, length } => {
            let across = [DVec3::X, DVec3::Y].map(|u| (shape.origin.rotation * u).to_array());
            [-0.5, 0.5]
                .into_iter()
                .flat_map(|end| (0..RIM_POINTS).map(move |i| (end, i)))
                .map(|(end, i)| {
                    let angle = std::f64::consts::TAU * i as f64 / RIM_POINTS as f64;
                    let kind = ContactKind::Rim { across, turn: [angle.cos(), angle.sin()] };
                    Candidate {
                        topology: ContactTopology { link, body, kind },
                        position: at(DVec3::Z * (end * length)),
                        radius: 0.0,
                        rim: *radius,
                    }
                })
                .collect()
        }
        Geometry::Hull { points } => points.iter().map(|p| Candidate::point(link, body, at(*p), 0.0)).collect(),
    }
}
