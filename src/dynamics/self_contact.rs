//! Contacts between a robot's own links.

use super::articulation::{Parameters, Topology};
use super::contact::{ContactSettings, separation};
use super::lanes::Real;
use super::math::{Mat3, Vec3, add, add_scaled, cross, dot, mul_vec, scale, sub};
use super::proximity::{Capsule, OrientedBox, Proximity, capsule_and_box, capsules};
use super::state::{LinkState, State, Workspace};

/// A pair takes part in a physics step when its links are nearer to each other than this, m: two legs that swing at each
/// other at 10 m/s are noticed a 5 ms step before they meet.
const PAIR_MARGIN: f64 = 0.05;

/// Finds the pairs of links that are near each other and builds their rows, after those of the ground contacts.
#[inline(always)]
pub fn build_pairs<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    settings: &ContactSettings,
    dt: S,
    state: &mut State<S>,
    work: &mut Workspace<S>,
) {
    if topology.pairs.is_empty() {
        return;
    }
    place_colliders(topology, parameters, work);
    let Workspace { links, axes, factor, colliders, contact: rows, .. } = work;
    let margin = S::splat(PAIR_MARGIN);
    let inverse_dt = S::one() / dt;
    for pair in &topology.pairs {
        let impulses = pair.first_impulse..pair.first_impulse + pair.spans.len();
        if !S::any(may_touch(parameters, colliders, pair.colliders)) {
            state.impulse[impulses].fill([S::zero(); 3]);
            continue;
        }
        for (i, span) in impulses.zip(pair.spans) {
            let found = proximity(topology, parameters, links, colliders, pair.colliders, *span);
            let near = found.gap.lt(margin);
            if !S::any(near) {
                state.impulse[i] = [S::zero(); 3];
                continue;
            }
            let row = rows.pair_rows(topology, factor, axes, pair, i, &frame(&found.normal), &found.point);
            rows.push(row, near, separation(found.gap, settings, inverse_dt), &state.impulse[i]);
        }
    }
}

/// Distance of the two links of a pair, m (negative when they overlap); [`place_colliders`] must have been called.
#[inline(always)]
pub fn pair_gap<S: Real>(topology: &Topology, parameters: &Parameters<S>, work: &Workspace<S>, pair: usize) -> S {
    let gap = |span: &[f64; 2]| {
        proximity(topology, parameters, &work.links, &work.colliders, topology.pairs[pair].colliders, *span).gap
    };
    topology.pairs[pair].spans.iter().map(gap).fold(S::splat(f64::MAX), S::min)
}

/// Puts the colliders where the workspace's kinematics has their links.
#[inline(always)]
pub fn place_colliders<S: Real>(topology: &Topology, parameters: &Parameters<S>, work: &mut Workspace<S>) {
    for (c, collider) in topology.colliders.iter().enumerate() {
        let at = &work.links[collider.link];
        work.colliders[c] = add(&at.position, &mul_vec(&at.rotation, &parameters.collider_centre[c]));
    }
}

/// Whether the spheres about two colliders come within the margin.
#[inline(always)]
fn may_touch<S: Real>(parameters: &Parameters<S>, centres: &[Vec3<S>], [a, b]: [usize; 2]) -> S::Mask {
    let apart = sub(&centres[a], &centres[b]);
    let reach = |c: usize| {
        let half = &parameters.collider_half[c];
        dot(half, half).sqrt() + parameters.collider_radius[c]
    };
    let limit = reach(a) + reach(b) + S::splat(PAIR_MARGIN);
    dot(&apart, &apart).lt(limit * limit)
}

/// Distance of two colliders, in base axes.
#[inline(always)]
fn proximity<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    links: &[LinkState<S>],
    centres: &[Vec3<S>],
    [a, b]: [usize; 2],
    span: [f64; 2],
) -> Proximity<S> {
    let capsule = |c: usize| Capsule {
        centre: centres[c],
        half: mul_vec(&links[topology.colliders[c].link].rotation, &parameters.collider_half[c]),
        radius: parameters.collider_radius[c],
    };
    match &topology.colliders[b].box_rotation {
        None => capsules(&capsule(a), span, &capsule(b)),
        Some(rotation) => {
            let link = &links[topology.colliders[b].link].rotation;
            let rotation = product(link, &rotation.map(|row| row.map(S::splat)));
            let solid = OrientedBox { centre: centres[b], rotation, half: parameters.collider_half[b] };
            capsule_and_box(&capsule(a), span, &solid)
        }
    }
}

#[inline(always)]
fn product<S: Real>(a: &Mat3<S>, b: &Mat3<S>) -> Mat3<S> {
    std::array::from_fn(|i| {
        std::array::from_fn(|j| a[i][0].mul_add(b[0][j], a[i][1].mul_add(b[1][j], a[i][2] * b[2][j])))
    })
}

/// A normal and two tangents.
#[inline(always)]
fn frame<S: Real>(normal: &Vec3<S>) -> [Vec3<S>; 3] {
    let (z, one) = (S::zero(), S::one());
    // away from whichever of x and y the normal is further from
    let x_like = normal[1].abs().lt(normal[0].abs());
    let along = [S::select(x_like, z, one), S::select(x_like, one, z), z];
    let t = add_scaled(&along, normal, -dot(&along, normal));
    let t = scale(&t, one / dot(&t, &t).sqrt());
    [*normal, t, cross(normal, &t)]
}
