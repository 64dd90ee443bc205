//! The ground's plane, the points of a robot that may touch it, and their distances from it.

use super::articulation::{ContactKind, Topology};
use super::kinematics::forward_kinematics;
use super::lanes::Real;
use super::math::{Spatial, Vec3, add, add_scaled, cross, dot, mul_vec_transposed, quat_to_mat, scale, splat};
use super::parameters::BodyNumbers;
use super::settings::ContactSettings;
use super::state::{State, Workspace};
use super::terrain::Terrain;

/// A plane that bodies stay above: points `x` with `normal . x = offset`, world axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Unit vector that points away from the ground.
    pub normal: [f64; 3],
    /// Distance from the world's origin along the normal, m.
    pub offset: f64,
}

impl Plane {
    /// A level plane.
    pub fn level(height: f64) -> Self {
        Self { normal: [0.0, 0.0, 1.0], offset: height }
    }

    /// The normal and two tangents, world axes; a level plane's tangents are x and y.
    pub(super) fn frame(&self) -> [[f64; 3]; 3] {
        let n = self.normal;
        if n == [0.0, 0.0, 1.0] {
            return [n, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        }
        let along = if n[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
        let t = add_scaled(&along, &n, -dot(&along, &n));
        let t = scale(&t, 1.0 / dot(&t, &t).sqrt());
        [n, t, cross(&n, &t)]
    }
}

/// Normal and tangents of a plane, world axes, the same in every lane.
#[inline(always)]
pub(super) fn splat_frame<S: Real>(plane: &Plane) -> [Vec3<S>; 3] {
    let frame = plane.frame();
    [splat(&frame[0]), splat(&frame[1]), splat(&frame[2])]
}

/// The lowest point of a candidate, in link axes about the link's origin; `up` is the world's up in
/// link axes.
#[inline(always)]
fn candidate_point<S: Real, B: BodyNumbers<S>>(
    parameters: B,
    contact: usize,
    kind: ContactKind,
    up: &Vec3<S>,
) -> Vec3<S> {
    let centre = &parameters.contact_position(contact);
    match kind {
        ContactKind::Point => *centre,
        ContactKind::Rim { across, turn } => {
            let e = [splat(&across[0]), splat(&across[1])];
            let (c, s) = (-dot(&e[0], up), -dot(&e[1], up));
            let length = c.mul_add(c, s * s).sqrt();
            // an upright cylinder has no lowest rim point: take fixed ones
            let upright = length.lt(S::splat(1e-3));
            let inverse = S::one() / length;
            let (c, s) = (S::select(upright, S::one(), c * inverse), S::select(upright, S::zero(), s * inverse));
            let (tc, ts) = (S::splat(turn[0]), S::splat(turn[1]));
            let (c, s) = (c.mul_add(tc, -(s * ts)), s.mul_add(tc, c * ts));
            let rim = parameters.contact_rim(contact);
            add_scaled(&add_scaled(centre, &e[0], c * rim), &e[1], s * rim)
        }
    }
}

/// The lowest point of a candidate (see [`candidate_point`]) and its distance from the ground, m.
#[inline(always)]
pub(super) fn candidate<S: Real, B: BodyNumbers<S>>(
    parameters: B,
    contact: usize,
    kind: ContactKind,
    up: &Vec3<S>,
    origin_height: S,
) -> (Vec3<S>, S) {
    let local = candidate_point(parameters, contact, kind, up);
    (local, origin_height + dot(up, &local) - parameters.contact_radius(contact))
}

/// Distance of each contact candidate from the ground, m, `[contacts]` in the topology's order;
/// negative inside the ground, and empty where there is none. For tools and tests: a step finds its
/// contacts itself.
pub fn candidate_gaps<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &ContactSettings,
    state: &State<S>,
    work: &mut Workspace<S>,
) -> Vec<S> {
    let Some(plane) = &settings.ground else {
        return Vec::new();
    };
    let (positions, velocities) = (&state.joint_position, &state.joint_velocity);
    forward_kinematics(topology, parameters, positions, velocities, &Spatial::zero(), work);
    let normal = splat(&plane.normal);
    let ground = dot(&normal, &state.position) - S::splat(plane.offset);
    let normal = mul_vec_transposed(&quat_to_mat(&state.rotation), &normal);
    let gaps = topology.contacts.iter().enumerate().map(|(c, contact)| {
        let at = &work.links[contact.link];
        let up = mul_vec_transposed(&at.rotation, &normal);
        candidate(parameters, c, contact.kind, &up, ground + dot(&normal, &at.position)).1
    });
    gaps.collect()
}

/// World position of a point that is given in base axes about the base's origin. `level` holds the
/// world's z, x and y in base axes.
#[inline(always)]
pub(super) fn world_place<S: Real>(level: &[Vec3<S>; 3], position: &Vec3<S>, place: &Vec3<S>) -> Vec3<S> {
    add(position, &[dot(&level[1], place), dot(&level[2], place), dot(&level[0], place)])
}

/// Gap of a sphere at the world position `place` above terrain, m, and normal and tangents there in
/// base axes. `level` is that of [`world_place`].
#[inline(always)]
pub(super) fn on_terrain<S: Real>(
    terrain: &Terrain<S>,
    level: &[Vec3<S>; 3],
    place: &Vec3<S>,
    radius: S,
) -> (S, [Vec3<S>; 3]) {
    let (gap, n) = terrain.gap(place, radius);
    // the x axis, laid onto the surface; the normal points up a little at least, so that it is
    // never along x
    let along = [n[0].neg_mul_add(n[0], S::one()), -(n[0] * n[1]), -(n[0] * n[2])];
    let tangent = scale(&along, S::one() / along[0].sqrt());
    let (normal, tangent) = (to_base(level, &n), to_base(level, &tangent));
    (gap, [normal, tangent, cross(&normal, &tangent)])
}

/// Turns a vector from world axes into base axes. `level` is that of [`world_place`].
#[inline(always)]
fn to_base<S: Real>(level: &[Vec3<S>; 3], v: &Vec3<S>) -> Vec3<S> {
    add_scaled(&add_scaled(&scale(&level[0], v[2]), &level[1], v[0]), &level[2], v[1])
}
