//! Position limits, velocity limits and dry frictions that act on the joints in a physics step, and
//! their targets.

use super::articulation::Topology;
use super::blocks::BLOCK;
use super::gaps::push_speed;
use super::lanes::Real;
use super::parameters::BodyNumbers;
use super::rows::{BoundRow, ContactWork, NO_TARGET};
use super::settings::{ContactSettings, SolverSettings};
use super::state::{State, Workspace};

/// Builds the rows of every block in which a joint is near a position limit or its velocity limit,
/// or has Coulomb friction.
///
/// `free` is the joints' velocity without constraints, `[blocks]`.
#[inline(always)]
pub(super) fn build_joint_bounds<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &ContactSettings,
    dt: S,
    state: &State<S>,
    free: &[[S; BLOCK]],
    work: &mut Workspace<S>,
) {
    let Workspace { factor, contact: work, .. } = work;
    let ContactWork { bounds, bound_further, stride, violation, .. } = work;
    let inverse_dt = S::one() / dt;
    let blocks = bounds.iter_mut().zip(topology.blocks()).zip(bound_further.chunks_exact_mut(*stride));
    for (b, ((block, shape), further)) in blocks.enumerate() {
        (block.limits, block.active) = (false, false);
        for place in 0..shape.len {
            let (j, row) = (shape.joints[place], &mut block.joints[place]);
            row.near = near_limits(parameters, &settings.solver, dt, state, j, free[b][place]);
            row.limits = S::when(row.near).is_some();
            row.has_friction = S::when(S::zero().lt(parameters.joint_friction(j))).is_some();
            block.limits |= row.limits;
            block.active |= row.takes_part();
        }
        if !block.active {
            continue;
        }
        for place in 0..shape.len {
            let (j, row) = (shape.joints[place], &mut block.joints[place]);
            row.max_friction = parameters.joint_friction(j) * dt;
            // the stored impulse is that of limit and friction together: friction takes as much of
            // it as it can
            row.friction_impulse = state.bound_impulse[j].clamp(-row.max_friction, row.max_friction);
            if block.limits {
                set_limits(parameters, settings, inverse_dt, state, j, row, violation);
            }
        }
        for place in shape.len..BLOCK {
            block.joints[place] = BoundRow::free();
        }
        block.rows.set_path(topology, shape.joints[shape.len - 1] + 1);
        block.rows.half_solve_units(topology, factor, further);
        let product = block.rows.products(topology, further);
        for place in 0..BLOCK {
            block.joints[place].diagonal = product[place];
            block.joints[place].inverse = S::one() / product[place];
        }
        let (second, third) = (block.joints[1].inverse, block.joints[2].inverse);
        block.coupling = [product[3], product[4], product[5]];
        block.friction_coupling = [product[3] * second, product[4] * third, product[5] * third];
    }
}

/// Lanes in which a joint is near a position limit or its velocity limit.
#[inline(always)]
fn near_limits<S: Real, B: BodyNumbers<S>>(
    parameters: B,
    solver: &SolverSettings,
    dt: S,
    state: &State<S>,
    j: usize,
    free: S,
) -> S::Mask {
    let (q, fastest) = (state.joint_position[j], parameters.velocity_limit(j));
    let margin = (fastest * dt).clamp(S::splat(solver.limit_reach), S::splat(solver.max_limit_reach));
    let speed = free.abs().max(state.joint_velocity[j].abs());
    let reach = speed.mul_add(dt + dt, margin);
    let position = S::or((q - reach).lt(parameters.lower(j)), parameters.upper(j).lt(q + reach));
    S::or(position, (fastest * S::splat(solver.velocity_limit_share)).lt(speed))
}

/// Sets the targets and the warm start of a joint's limits, in the lanes that are near them.
#[inline(always)]
fn set_limits<S: Real, B: BodyNumbers<S>>(
    parameters: B,
    settings: &ContactSettings,
    inverse_dt: S,
    state: &State<S>,
    j: usize,
    row: &mut BoundRow<S>,
    violation: &mut S,
) {
    let (z, no_target, near) = (S::zero(), S::splat(NO_TARGET), row.near);
    (row.lowest, row.highest, row.limit_impulse, row.push_impulse) = (no_target, -no_target, z, z);
    if row.limits {
        let (q, fastest) = (state.joint_position[j], parameters.velocity_limit(j));
        // a violated limit is pushed back at a bounded speed; one ahead may be reached but not
        // crossed
        let (low, high) = (q - parameters.lower(j), parameters.upper(j) - q);
        let push = |past| push_speed(past, settings.solver.limit_slop, settings, inverse_dt);
        let (up, down) = (push(-low), push(-high));
        let lowest = S::select(low.lt(z), up, -(low * inverse_dt)).max(-fastest);
        let highest = S::select(high.lt(z), -down, high * inverse_dt).min(fastest);
        *violation = violation.max(S::select(near, up.max(down), z));
        row.lowest = S::select(near, lowest, no_target);
        row.highest = S::select(near, highest, -no_target);
        row.limit_impulse = S::select(near, state.bound_impulse[j] - row.friction_impulse, z);
    }
}
