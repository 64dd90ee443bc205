//! Points of a robot that touch the ground in a physics step, and the targets of their constraints.

use super::articulation::{ContactFriction, Topology};
use super::gaps::{reach_in_step, separation};
use super::ground::{candidate, on_terrain, splat_frame, world_place};
use super::lanes::Lanes;
use super::math::{Spatial, add, dot, mul_vec, mul_vec_transposed};
use super::parameters::BodyNumbers;
use super::rows::NO_TARGET;
use super::settings::ContactSettings;
use super::spin_rows::NewSpin;
use super::state::{State, Workspace};
use super::terrain::{Near, Terrain};

/// Gap of a candidate that no ground is near, m.
const NO_GROUND: f64 = 1e9;

/// Finds the contacts near the ground and builds their rows.
///
/// `free_base` is the velocity that the base would have without constraints, in base axes about its
/// origin.
#[inline(always)]
pub(super) fn build_ground_contacts<S: Lanes, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &ContactSettings,
    terrain: Option<&Terrain<S>>,
    dt: S,
    state: &State<S>,
    free_base: &Spatial<S>,
    work: &mut Workspace<S>,
) {
    let Workspace { base_rotation, links, dynamics, factor, velocity_base, contact: rows, .. } = work;
    let solver = &settings.solver;
    let margin = S::splat(solver.ground_margin);
    // link velocities leave the base's linear velocity out
    let base = Spatial { ang: [S::zero(); 3], lin: [velocity_base[3], velocity_base[4], velocity_base[5]] };
    // the base's inertia is composite: the whole robot's
    rows.clear(dynamics[0].inertia.mass);
    let Some(plane) = &settings.ground else {
        return;
    };
    let world = splat_frame(plane);
    let ground = dot(&world[0], &state.position) - S::splat(plane.offset);
    // normal and tangents in base axes
    let frame = [
        mul_vec_transposed(base_rotation, &world[0]),
        mul_vec_transposed(base_rotation, &world[1]),
        mul_vec_transposed(base_rotation, &world[2]),
    ];
    let inverse_dt = S::one() / dt;
    for (link, at) in links.iter().enumerate() {
        let candidates = topology.contacts_of(link);
        if candidates.is_empty() {
            continue;
        }
        let origin_height = ground + dot(&frame[0], &at.position);
        let up = mul_vec_transposed(&at.rotation, &frame[0]);
        let [cx, cy, cz, hx, hy, hz] = parameters.link_box(link);
        let (centre, half) = ([cx, cy, cz], [hx, hy, hz]);
        let mut highest = margin;
        if let Some(terrain) = terrain {
            let [x, y, _] = world_place(&frame, &state.position, &add(&at.position, &mul_vec(&at.rotation, &centre)));
            let bound = terrain.bound(Near::Link, x, y, dot(&half, &half).sqrt() + margin);
            highest = margin + bound - S::splat(plane.offset);
        }
        let below = half[0].mul_add(up[0].abs(), half[1].mul_add(up[1].abs(), half[2] * up[2].abs()));
        // a coarse test decides for its lane even where a neighbour's lane asks for the finer tests
        let Some(link_near) = S::when((origin_height + dot(&up, &centre) - below).lt(highest)) else {
            continue;
        };
        for c in candidates {
            // whichever way its rim points
            let reach = parameters.contact_radius(c) + parameters.contact_rim(c);
            let lowest = origin_height + dot(&up, &parameters.contact_position(c)) - reach;
            let Some(may_touch) = S::when(S::and(link_near, lowest.lt(highest))) else {
                continue;
            };
            let (local, mut gap) = candidate(parameters, c, topology.contacts[c].kind, &up, origin_height);
            let Some(mut may_touch) = S::when(S::and(may_touch, gap.lt(highest))) else {
                continue;
            };
            let (centre, radius) = (add(&at.position, &mul_vec(&at.rotation, &local)), parameters.contact_radius(c));
            let surface;
            let mut axes_here = &frame;
            if let Some(terrain) = terrain {
                let place = world_place(&frame, &state.position, &centre);
                let bound = terrain.bound(Near::Candidate, place[0], place[1], radius + margin);
                may_touch = S::and(may_touch, gap.lt(margin + bound - S::splat(plane.offset)));
                if S::when(may_touch).is_none() {
                    continue;
                }
                (gap, surface) = on_terrain(terrain, &frame, &place, radius);
                // the plane of a steep cell, which goes on beyond it, may be nearer than any ground
                gap = S::select(may_touch, gap, S::splat(NO_GROUND));
                if S::when(gap.lt(margin)).is_none() {
                    continue;
                }
                axes_here = &surface;
            }
            let now = dot(&axes_here[0], &at.velocity.plus(&base).at(&centre));
            let free = dot(&axes_here[0], &at.free_velocity.plus(free_base).at(&centre));
            let near = S::and(may_touch, gap.lt(reach_in_step(solver.ground_reach, now, free, dt).min(margin)));
            let Some(near) = S::when(near) else {
                continue;
            };
            rows.build_ground(topology, solver, factor, links, axes_here, c, &centre, radius);
            if terrain.is_some() {
                rows.ground_frames.push(*axes_here);
            }
            let target = separation(gap, settings, inverse_dt);
            let zero = S::zero();
            let mut bounce = S::splat(NO_TARGET);
            if let Some(elastic) = S::when(zero.lt(parameters.own().restitution)) {
                let (row, further) = rows.next();
                let approach = row.first_velocity(topology, further, &rows.base, &rows.joints);
                let bounces = S::and(approach.lt(S::splat(-settings.bounce_threshold)), gap.lt(-(approach * dt)));
                bounce = S::select(S::and(elastic, bounces), -(approach * parameters.own().restitution), bounce);
            }
            rows.add(near, target, bounce, &state.impulse[c]);
            if topology.friction != ContactFriction::Sliding {
                let warm_start = &state.impulse[topology.spin_impulse(c)];
                let frame = axes_here;
                S::call(NewSpin { topology, solver, factor, links, frame, contact: c, near, warm_start, rows });
            }
        }
    }
}
