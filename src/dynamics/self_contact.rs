//! Contacts between a robot's own links.

use super::articulation::{Parameters, Topology};
use super::contact::{ContactSettings, NEVER, separation};
use super::lanes::Real;
use super::math::{Mat3, Spatial, Vec3, add, add_scaled, cross, dot, mul_mat, mul_vec, scale, sub};
use super::proximity::{Capsule, Proximity, capsule_and_box, capsules, may_touch_box};
use super::state::{LinkState, State, Workspace};

/// A pair takes part in a physics step when its links are nearer to each other than this, m, or could come so in the step.
const PAIR_MARGIN: f64 = 0.01;

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
    let Workspace { links, axes, factor, colliders, collider_speed, contact: rows, .. } = work;
    let inverse_dt = S::one() / dt;
    for pair in &topology.pairs {
        let impulses = pair.first_impulse..pair.first_impulse + pair.spans.len();
        let shapes = PairShapes::new(topology, parameters, links, colliders, pair.colliders);
        let [a, b] = pair.colliders;
        let margin = (collider_speed[a] + collider_speed[b]).mul_add(dt, S::splat(PAIR_MARGIN));
        if !S::any(shapes.may_touch(margin)) {
            state.impulse[impulses].fill([S::zero(); 3]);
            continue;
        }
        for (i, span) in impulses.zip(pair.spans) {
            let found = shapes.proximity(*span);
            let near = found.gap.lt(margin);
            if !S::any(near) {
                state.impulse[i] = [S::zero(); 3];
                continue;
            }
            let row = rows.pair_rows(topology, factor, axes, pair, i, &frame(&found.normal), &found.point);
            rows.push(row, near, separation(found.gap, settings, inverse_dt), S::splat(NEVER), &state.impulse[i]);
        }
    }
}

/// Distance of the two links of a pair, m (negative when they overlap); [`place_colliders`] must have been called.
#[inline(always)]
pub fn pair_gap<S: Real>(topology: &Topology, parameters: &Parameters<S>, work: &Workspace<S>, pair: usize) -> S {
    let pair = &topology.pairs[pair];
    let shapes = PairShapes::new(topology, parameters, &work.links, &work.colliders, pair.colliders);
    pair.spans.iter().map(|span| shapes.proximity(*span).gap).fold(S::splat(f64::MAX), S::min)
}

/// Puts the colliders where the workspace's kinematics has their links, and finds how fast any of their points moves
/// against the base's frame.
#[inline(always)]
pub fn place_colliders<S: Real>(topology: &Topology, parameters: &Parameters<S>, work: &mut Workspace<S>) {
    for (c, collider) in topology.colliders.iter().enumerate() {
        let at = &work.links[collider.link];
        let radius = parameters.collider_radius[c];
        let (centre, half) = (&parameters.collider_centre[c], &parameters.collider_half[c]);
        // a box is turned when it meets a capsule
        let half = if collider.box_rotation.is_some() { *half } else { mul_vec(&at.rotation, half) };
        let centre = add(&at.position, &mul_vec(&at.rotation, centre));
        let Spatial { ang, lin } = &at.velocity;
        let speed = length(&add(lin, &cross(ang, &centre)));
        work.collider_speed[c] = (length(&half) + radius).mul_add(length(ang), speed);
        work.colliders[c] = Capsule { centre, half, radius };
    }
}

/// The shapes of a pair, made ready to be compared.
enum PairShapes<'a, S> {
    Capsules([&'a Capsule<S>; 2]),
    /// The capsule as seen from the box; the box's half edge lengths, place and axes.
    CapsuleAndBox(Capsule<S>, &'a Vec3<S>, &'a Vec3<S>, Mat3<S>),
}

impl<'a, S: Real> PairShapes<'a, S> {
    #[inline(always)]
    fn new(
        topology: &Topology,
        parameters: &'a Parameters<S>,
        links: &[LinkState<S>],
        colliders: &'a [Capsule<S>],
        [a, b]: [usize; 2],
    ) -> Self {
        match &topology.colliders[b].box_rotation {
            None => Self::Capsules([&colliders[a], &colliders[b]]),
            Some(rotation) => {
                let link = topology.colliders[b].link;
                let turn = rotation.map(|row| row.map(S::splat));
                // the base's axes are those that everything is expressed in
                let rotation = if link == 0 { turn } else { mul_mat(&links[link].rotation, &turn) };
                let centre = &colliders[b].centre;
                let capsule = colliders[a].seen_from(centre, &rotation);
                Self::CapsuleAndBox(capsule, &parameters.collider_half[b], centre, rotation)
            }
        }
    }

    /// False only where the two are further apart than `margin`.
    #[inline(always)]
    fn may_touch(&self, margin: S) -> S::Mask {
        match self {
            Self::Capsules([a, b]) => {
                let apart = sub(&a.centre, &b.centre);
                // (x + y)^2 <= 2 x^2 + 2 y^2 saves the roots
                let two = S::splat(2.0);
                let rest = a.radius + b.radius + margin;
                let lengths = two * (dot(&a.half, &a.half) + dot(&b.half, &b.half));
                dot(&apart, &apart).lt(two * (rest * rest + lengths))
            }
            Self::CapsuleAndBox(capsule, half, ..) => may_touch_box(capsule, half, margin),
        }
    }

    /// In base axes.
    #[inline(always)]
    fn proximity(&self, span: [f64; 2]) -> Proximity<S> {
        match self {
            Self::Capsules([a, b]) => capsules(a, span, b),
            Self::CapsuleAndBox(capsule, half, centre, rotation) => {
                capsule_and_box(capsule, span, half).from_frame(centre, rotation)
            }
        }
    }
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

#[inline(always)]
fn length<S: Real>(v: &Vec3<S>) -> S {
    dot(v, v).sqrt()
}
