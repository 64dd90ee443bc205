//! Contacts between a robot's own links.
//!
//! Most pairs are far apart in most steps, and are told by boxes along the base's axes: first those
//! of two links, whose colliders are placed only when these meet, then those of two colliders.
//! Pairs that are left out are further apart than the margin in every lane.

use super::articulation::Topology;
use super::gaps::{reach_in_step, separation};
use super::lanes::Real;
use super::math::{Mat3, Spatial, Vec3, add, add_scaled, cross, dot, mul_mat, mul_vec, scale, splat, sub};
use super::parameters::BodyNumbers;
use super::proximity::{
    Capsule, Proximity, capsule_and_box, capsules, may_touch_box, nearest_on_capsules, nearest_to_box,
};
use super::rows::NO_TARGET;
use super::settings::ContactSettings;
use super::state::{LinkState, State, Workspace};

/// A collider in base axes.
#[derive(Clone, Debug)]
pub struct PlacedCollider<S> {
    /// The capsule; of a box the centre, and half edge lengths along its own axes.
    pub capsule: Capsule<S>,
    /// Axes of a box.
    pub rotation: Mat3<S>,
    /// Half edge lengths of the box along the base's axes that holds the collider, m.
    pub extent: Vec3<S>,
}

impl<S: Real> PlacedCollider<S> {
    /// A point at the base's origin.
    pub fn zero() -> Self {
        let z = S::zero();
        let capsule = Capsule { centre: [z; 3], half: [z; 3], radius: z };
        Self { capsule, rotation: [[z; 3]; 3], extent: [z; 3] }
    }

    /// Largest distance of the two along an axis, m.
    #[inline(always)]
    fn distance(&self, other: &Self) -> S {
        box_distance([&self.capsule.centre, &self.extent], [&other.capsule.centre, &other.extent])
    }
}

/// A box along the base's axes that holds all colliders of a link.
#[derive(Clone, Debug)]
pub struct ColliderBox<S> {
    /// Centre, m.
    centre: Vec3<S>,
    /// Half edge lengths, m.
    extent: Vec3<S>,
    /// At least the speed of any point in it against the base, now or freely, m/s.
    speed: S,
    /// Whether the link's colliders are where the link is.
    placed: bool,
}

impl<S: Real> ColliderBox<S> {
    /// A point at the base's origin.
    pub fn zero() -> Self {
        let z = S::zero();
        Self { centre: [z; 3], extent: [z; 3], speed: z, placed: false }
    }

    /// Largest distance of the two along an axis, m.
    #[inline(always)]
    fn distance(&self, other: &Self) -> S {
        box_distance([&self.centre, &self.extent], [&other.centre, &other.extent])
    }
}

/// Largest distance along an axis of two boxes, each its centre and half edge lengths, m.
#[inline(always)]
fn box_distance<S: Real>(a: [&Vec3<S>; 2], b: [&Vec3<S>; 2]) -> S {
    let apart = sub(a[0], b[0]);
    let mut most = apart[0].abs() - (a[1][0] + b[1][0]);
    for i in 1..3 {
        most = most.max(apart[i].abs() - (a[1][i] + b[1][i]));
    }
    most
}

/// Half edge lengths of the box along some axes that holds a box with these half edges, turned by
/// `rotation` to those axes.
#[inline(always)]
fn turned_extent<S: Real>(rotation: &Mat3<S>, half: &Vec3<S>) -> Vec3<S> {
    let mut extent = *half;
    for (extent, row) in extent.iter_mut().zip(rotation) {
        *extent = row[0].abs().mul_add(half[0], row[1].abs().mul_add(half[1], row[2].abs() * half[2]));
    }
    extent
}

/// Finds the pairs of links that are near each other and builds their rows, after those of the
/// ground contacts. `first`: whether the bodies may be others than those of the physics step
/// before.
#[inline(always)]
pub(super) fn build_pairs<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &ContactSettings,
    dt: S,
    state: &State<S>,
    first: bool,
    work: &mut Workspace<S>,
) {
    if topology.pairs.is_empty() {
        return;
    }
    let Workspace { links, factor, colliders, collider_boxes, contact: rows, .. } = work;
    box_links(topology, parameters, links, first, collider_boxes);
    let (solver, inverse_dt) = (&settings.solver, S::one() / dt);
    let rounding = S::splat(solver.pair_rounding);
    for group in &topology.pair_groups {
        let [a, b] = group.links;
        let (a, b) = (&collider_boxes[a], &collider_boxes[b]);
        let margin = (a.speed + b.speed).mul_add(dt, S::splat(solver.pair_reach));
        let Some(links_near) = S::when(a.distance(b).lt(margin + rounding)) else {
            continue;
        };
        for link in group.links {
            if !std::mem::replace(&mut collider_boxes[link].placed, true) {
                for &c in topology.colliders_of(link) {
                    place_collider(topology, parameters, c, &links[link], &mut colliders[c]);
                }
            }
        }
        for pair in &topology.pairs[group.pairs.clone()] {
            let [a, b] = pair.colliders;
            let near = S::and(links_near, colliders[a].distance(&colliders[b]).lt(margin + rounding));
            let Some(near) = S::when(near) else {
                continue;
            };
            let shapes = PairShapes::new(topology, colliders, pair.colliders);
            // at speeds beyond all sense rounding may tell otherwise below: a lane's answer is that
            // of all tests
            let Some(may_touch) = S::when(S::and(near, shapes.may_touch(margin + rounding))) else {
                continue;
            };
            let places = shapes.nearest(pair.spans);
            for (i, place) in (pair.first_impulse..).zip(&places[..pair.spans.len()]) {
                let found = shapes.proximity(place);
                let (first, second) = (&links[topology.colliders[a].link], &links[topology.colliders[b].link]);
                let now = sub(&first.velocity.at(&found.point), &second.velocity.at(&found.point));
                let free = sub(&first.free_velocity.at(&found.point), &second.free_velocity.at(&found.point));
                let (now, free) = (dot(&found.normal, &now), dot(&found.normal, &free));
                let near = S::and(may_touch, found.gap.lt(reach_in_step(solver.pair_reach, now, free, dt)));
                let Some(near) = S::when(near) else {
                    continue;
                };
                rows.build_pair(topology, solver, factor, links, pair, i, &frame(&found.normal), &found.point);
                rows.add(near, separation(found.gap, settings, inverse_dt), S::splat(NO_TARGET), &state.impulse[i]);
            }
        }
    }
}

/// Distance of the two links of a pair, m (negative when they overlap); [`place_colliders`] must
/// have been called.
#[inline(always)]
pub fn pair_gap<S: Real>(topology: &Topology, work: &Workspace<S>, pair: usize) -> S {
    let pair = &topology.pairs[pair];
    let shapes = PairShapes::new(topology, &work.colliders, pair.colliders);
    let places = shapes.nearest(pair.spans);
    places[..pair.spans.len()].iter().map(|place| shapes.proximity(place).gap).fold(S::splat(f64::MAX), S::min)
}

/// Upper bound of half the square of the speed of a body's points within the root of
/// `squared_reach` of `centre`.
#[inline(always)]
fn half_squared_speed<S: Real>(velocity: &Spatial<S>, centre: &Vec3<S>, squared_reach: S) -> S {
    // (x + y)^2 <= 2 x^2 + 2 y^2 saves roots
    let point = velocity.at(centre);
    squared_reach.mul_add(dot(&velocity.ang, &velocity.ang), dot(&point, &point))
}

/// Puts a box around the colliders of each link, and finds how fast any point of it moves, now or
/// freely. The base, from which all is seen, stays as the `first` physics step of these bodies left
/// it.
#[inline(always)]
fn box_links<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    links: &[LinkState<S>],
    first: bool,
    boxes: &mut [ColliderBox<S>],
) {
    for (link, (at, out)) in links.iter().zip(boxes).enumerate().skip(usize::from(!first)) {
        if topology.colliders_of(link).is_empty() {
            continue;
        }
        let [cx, cy, cz, hx, hy, hz] = parameters.link_box(link);
        let half = [hx, hy, hz];
        out.centre = add(&at.position, &mul_vec(&at.rotation, &[cx, cy, cz]));
        out.extent = turned_extent(&at.rotation, &half);
        out.placed = false;
        // seen from itself, the base does not move
        if link > 0 {
            let squared_reach = dot(&half, &half);
            let now = half_squared_speed(&at.velocity.minus(&links[0].velocity), &out.centre, squared_reach);
            let free = half_squared_speed(&at.free_velocity, &out.centre, squared_reach);
            out.speed = (S::splat(2.0) * now.max(free)).sqrt();
        }
    }
}

/// Puts the colliders where the workspace's kinematics has their links. For tools and tests: a step
/// places those that it needs.
#[inline(always)]
pub fn place_colliders<S: Real, B: BodyNumbers<S>>(topology: &Topology, parameters: B, work: &mut Workspace<S>) {
    for (c, collider) in topology.colliders.iter().enumerate() {
        place_collider(topology, parameters, c, &work.links[collider.link], &mut work.colliders[c]);
    }
}

/// Puts a collider where its link is.
#[inline(always)]
fn place_collider<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    c: usize,
    at: &LinkState<S>,
    placed: &mut PlacedCollider<S>,
) {
    let radius = parameters.collider_radius(c);
    let (centre, half) = (&parameters.collider_centre(c), &parameters.collider_half(c));
    let centre = add(&at.position, &mul_vec(&at.rotation, centre));
    // a box is turned when it meets a capsule
    if let Some(rotation) = &topology.colliders[c].box_rotation {
        placed.rotation = mul_mat(&at.rotation, &[splat(&rotation[0]), splat(&rotation[1]), splat(&rotation[2])]);
        placed.capsule = Capsule { centre, half: *half, radius };
        placed.extent = turned_extent(&placed.rotation, half);
    } else {
        let half = mul_vec(&at.rotation, half);
        placed.capsule = Capsule { centre, half, radius };
        placed.extent = [half[0].abs() + radius, half[1].abs() + radius, half[2].abs() + radius];
    }
}

/// The shapes of a pair, made ready to be compared.
enum PairShapes<'a, S> {
    Capsules([&'a Capsule<S>; 2]),
    /// The capsule as seen from the box; the box.
    CapsuleAndBox(Capsule<S>, &'a PlacedCollider<S>),
}

impl<'a, S: Real> PairShapes<'a, S> {
    #[inline(always)]
    fn new(topology: &Topology, colliders: &'a [PlacedCollider<S>], [a, b]: [usize; 2]) -> Self {
        if topology.colliders[b].box_rotation.is_none() {
            return Self::Capsules([&colliders[a].capsule, &colliders[b].capsule]);
        }
        let solid = &colliders[b];
        Self::CapsuleAndBox(colliders[a].capsule.seen_from(&solid.capsule.centre, &solid.rotation), solid)
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
            Self::CapsuleAndBox(capsule, solid) => may_touch_box(capsule, &solid.capsule.half, margin),
        }
    }

    /// Nearest places of each part of the first capsule: on the axis of the first, and of the
    /// second if it is a capsule.
    #[inline(always)]
    fn nearest(&self, spans: &[[f64; 2]]) -> [[S; 2]; 2] {
        match self {
            Self::Capsules([a, b]) => {
                let first = nearest_on_capsules(a, spans[0], b);
                [first, if let [_, second] = spans { nearest_on_capsules(a, *second, b) } else { first }]
            }
            Self::CapsuleAndBox(capsule, solid) => {
                nearest_to_box(capsule, &solid.capsule.half, spans.len() == 2).map(|t| [t; 2])
            }
        }
    }

    /// Proximity of the shapes in base axes.
    #[inline(always)]
    fn proximity(&self, [s, t]: &[S; 2]) -> Proximity<S> {
        match self {
            Self::Capsules([a, b]) => capsules(a, *s, b, *t),
            Self::CapsuleAndBox(capsule, solid) => {
                let Capsule { centre, half, .. } = &solid.capsule;
                capsule_and_box(capsule, *s, half).out_of_frame(centre, &solid.rotation)
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

#[cfg(test)]
mod tests {
    use super::super::articulation::{Axis, ColliderTopology, JointMotion, JointTopology};
    use super::super::kinematics::forward_kinematics;
    use super::super::math::Spatial;
    use super::super::parameters::Parameters;
    use super::*;

    /// Boxes along the base's axes never call two shapes further apart than they are.
    #[test]
    fn no_pair_is_left_out_that_is_near() {
        let mut x = 1u64;
        let mut random = || {
            x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (x >> 33) as f64 / f64::from(1u32 << 31) * 2.0 - 1.0
        };
        let axis = Axis::General([0.6, 0.0, 0.8]);
        let joint =
            JointTopology { parent: 0, motion: JointMotion::Revolute, axis, effort_table: None, explicit: false };
        let turned = [[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, 0.6]];
        let collider = |link, box_rotation| ColliderTopology { link, body: 0, box_rotation };
        let mut topology = Topology::new(true, vec![joint], Vec::new(), 1, Vec::new(), false);
        let colliders =
            vec![collider(1, None), collider(0, Some(turned)), collider(0, None), collider(1, Some(turned))];
        topology.set_pairs(colliders, &[([0, 1], true), ([0, 2], false), ([2, 3], true)]);
        let mut parameters = Parameters::<f64>::zeros(&topology);
        let mut work = Workspace::new(&topology);
        let mut near = 0;
        for _ in 0..2000 {
            for c in 0..4 {
                parameters.collider_centre[c] = std::array::from_fn(|_| 0.5 * random());
                let half: Vec3<f64> = std::array::from_fn(|_| 0.3 * random());
                parameters.collider_half[c] = if c % 2 == 0 { half } else { half.map(f64::abs) };
                parameters.collider_radius[c] = if c % 2 == 0 { 0.1 * random().abs() } else { 0.0 };
            }
            parameters.box_links(&topology);
            forward_kinematics(&topology, &parameters, &[3.0 * random()], &[0.0], &Spatial::zero(), &mut work);
            place_colliders(&topology, &parameters, &mut work);
            let mut boxes = vec![ColliderBox::zero(); topology.num_links()];
            box_links(&topology, &parameters, &work.links, true, &mut boxes);
            for (p, pair) in topology.pairs.iter().enumerate() {
                let gap = pair_gap(&topology, &work, p);
                let [a, b] = pair.colliders;
                let alone = work.colliders[a].distance(&work.colliders[b]);
                let [a, b] = [a, b].map(|c| &boxes[topology.colliders[c].link]);
                // a search that has not quite ended finds more, never less
                let most = gap.max(0.0) + 1e-9;
                assert!(alone <= most && a.distance(b) <= most, "{alone} and {} for {gap}", a.distance(b));
                near += usize::from(gap > 0.0 && alone > 0.0);
            }
        }
        assert!(near > 500, "only {near} pairs were told apart");
    }
}
