//! The contact solver: warm-started Gauss-Seidel sweeps over contacts and joint bounds.

mod bounds;
mod contacts;
mod jammed;
mod push;
mod spins;
mod warm_start;

use super::articulation::Topology;
use super::lanes::{Kernel, Lanes, Real};
use super::parameters::Parameters;
use super::rows::ContactWork;
use super::settings::{ContactSettings, SWEEPS, SolverSettings};
use bounds::{settle_limits, sweep_bounds};
use contacts::sweep_contacts;
use jammed::{sweep_jammed, unsettled};
use push::push;
use spins::sweep_spins;
use warm_start::warm_start;

/// Solves the constraints: warm start, regular sweeps, extra rounds where contacts are jammed, and
/// the push out of penetrations.
///
/// Afterwards the sparse velocity `base`, `joints` of the workspace satisfies the constraints. If
/// anything [`pushes`](ContactWork::pushes), `moved_base`, `moved_joints` is the velocity that
/// moves the bodies. Velocities, forces and friction leave the push out: with it they would win
/// energy, and friction would resist it where links are jammed.
#[inline(always)]
pub(super) fn solve<S: Lanes>(
    topology: &Topology,
    parameters: &Parameters<S>,
    settings: &ContactSettings,
    work: &mut ContactWork<S>,
) {
    let solver = &settings.solver;
    warm_start(topology, work);
    let all = S::zero().lt(S::one());
    sweep_regularly(topology, parameters, settings, all, work);
    let mut rounds = S::repeat(1 + solver.max_extra_rounds, all);
    while let Some(active) = rounds.next() {
        if rounds.round() > 1 {
            S::call(ExtraRound { topology, parameters, settings, active, work });
        }
        // contacts come after dry friction, or feet would creep; limits have the last word
        settle_limits(topology, solver, active, false, work);
        if let Some(active) = rounds.keep(unsettled(topology, solver, work)) {
            mark_active(active, work);
        }
    }
    if work.pushes() {
        work.moved_base = work.base;
        work.moved_joints.copy_from_slice(&work.joints);
        S::call(Push { topology, solver, work });
    }
}

/// A round of sweeps over contacts that the regular sweeps left jammed.
struct ExtraRound<'a, S: Real> {
    topology: &'a Topology,
    parameters: &'a Parameters<S>,
    settings: &'a ContactSettings,
    active: S::Mask,
    work: &'a mut ContactWork<S>,
}

impl<S: Real> Kernel<S> for ExtraRound<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { topology, parameters, settings, active, work } = self;
        let solver = &settings.solver;
        for _ in 0..settings.iterations.min(solver.sweeps_per_round) {
            sweep_bounds(topology, active, work);
            sweep_spins(topology, parameters, active, work);
            sweep_jammed(topology, parameters, solver, active, work);
        }
    }
}

/// See [`push`](push::push).
struct Push<'a, S: Real> {
    topology: &'a Topology,
    solver: &'a SolverSettings,
    work: &'a mut ContactWork<S>,
}

impl<S: Real> Kernel<S> for Push<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        push(self.topology, self.solver, self.work);
    }
}

/// The regular sweeps: as many as the settings ask for, fewer in lanes where they change little.
#[inline(always)]
fn sweep_regularly<S: Real>(
    topology: &Topology,
    parameters: &Parameters<S>,
    settings: &ContactSettings,
    all: S::Mask,
    work: &mut ContactWork<S>,
) {
    let mut sweeps = S::repeat(settings.iterations, all);
    while let Some(active) = sweeps.next() {
        // a caller who asks for more sweeps gets all of them: many small changes settle a load that
        // many points share
        let measures = settings.iterations <= SWEEPS
            && sweeps.round().is_multiple_of(settings.solver.check_interval)
            && sweeps.round() < settings.iterations;
        if measures {
            // the velocity before, in memory that the moved velocity takes over later
            work.moved_base = work.base;
            work.moved_joints.copy_from_slice(&work.joints);
        }
        sweep_bounds(topology, active, work);
        // contacts come last: they hold the normal impulses that bound the turning
        sweep_spins(topology, parameters, active, work);
        sweep_contacts(topology, parameters, active, work);
        if measures && let Some(active) = sweeps.keep(changed(&settings.solver, work)) {
            mark_active(active, work);
        }
    }
}

/// Lanes in which the velocity differs from the one kept in `moved_base`, `moved_joints` by more
/// than [`min_change`](SolverSettings::min_change).
#[inline(always)]
fn changed<S: Real>(solver: &SolverSettings, work: &ContactWork<S>) -> S::Mask {
    let mut energy = S::zero();
    let now = work.joints.as_flattened().iter().chain(&work.base);
    for (&now, &before) in now.zip(work.moved_joints.as_flattened().iter().chain(&work.moved_base)) {
        let change = now - before;
        energy = change.mul_add(change, energy);
    }
    S::splat(solver.min_change * solver.min_change).lt(energy * work.compliance)
}

/// Marks the contacts and bounds that take part in one of these lanes. Sweeps skip the others,
/// which have no impulse there.
#[inline(always)]
fn mark_active<S: Real>(active: S::Mask, work: &mut ContactWork<S>) {
    for row in &mut work.contacts[..work.num_contacts] {
        row.active = S::when(S::and(active, row.near)).is_some();
    }
    for block in &mut work.bounds {
        block.active = false;
        for row in &block.joints {
            if row.limits {
                block.active |= S::when(S::and(active, row.near)).is_some();
            }
            if row.has_friction {
                block.active |= S::when(S::and(active, S::zero().lt(row.max_friction))).is_some();
            }
        }
    }
}
