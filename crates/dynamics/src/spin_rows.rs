//! The rows of torsional and rolling friction: the angular velocity of a link about the axes of a
//! contact with the ground.
//!
//! An angular impulse about the normal, and one about an axis across it, are bounded by a
//! coefficient times the normal impulse. The coefficients are lengths: the radius at which sliding
//! friction of a patch of contact would give the same torque, and the distance by which the
//! pressure moves ahead of a rolling body's axis.

use super::articulation::{ContactFriction, Topology};
use super::blocks::BLOCK;
use super::factor::Factor;
use super::lanes::{Kernel, Real};
use super::math::Vec3;
use super::rows::{ContactWork, build_rows};
use super::settings::SolverSettings;
use super::sparse_rows::{JointRows, SparseRows};
use super::state::LinkState;

/// Torsional and rolling friction of a ground contact.
#[derive(Clone, Debug)]
pub(super) struct SpinRows<S: Real> {
    /// Angular velocities about the normal and two tangents. Torsional friction alone uses the
    /// first.
    pub(super) rows: SparseRows<S>,
    /// Couplings of the rows with each other: normal-tangent 1, normal-tangent 2, tangent 1-tangent
    /// 2.
    pub(super) coupling: [S; 3],
    pub(super) inverse: [S; 3],
    /// Inertia of a rolling step: the inverse of the largest eigenvalue of the tangents' block.
    pub(super) roll: S,
    /// Impulse of the friction, N m s.
    pub(super) impulse: [S; 3],
}

impl<S: Real> ContactWork<S> {
    /// The ground contacts' torsional and rolling friction; empty where the topology asks for
    /// neither.
    #[inline(always)]
    pub(super) fn spins(&self) -> &[SpinRows<S>] {
        &self.spins[..self.num_spins]
    }
}

/// Adds torsional and rolling friction to the contact that was added last.
pub(super) struct NewSpin<'a, S: Real> {
    pub(super) topology: &'a Topology,
    pub(super) solver: &'a SolverSettings,
    pub(super) factor: &'a Factor<S>,
    pub(super) links: &'a [LinkState<S>],
    /// Normal and tangents of the contact, in base axes.
    pub(super) frame: &'a [Vec3<S>; 3],
    pub(super) contact: usize,
    /// The lanes in which the contact takes part.
    pub(super) near: S::Mask,
    /// Impulse of the last physics step, N m s.
    pub(super) warm_start: &'a [S; 3],
    pub(super) rows: &'a mut ContactWork<S>,
}

impl<S: Real> Kernel<S> for NewSpin<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { topology, solver, factor, links, frame, contact, near, warm_start, rows: work } = self;
        let (z, one, half) = (S::zero(), S::one(), S::splat(0.5));
        if work.num_spins == work.spins.len() {
            work.spins.push(SpinRows::zero());
        }
        // the compliance of tangents at a lever of 1 m: robots turn more easily, but what is fixed
        // to the world may not turn at all
        let least = work.compliance * S::splat(solver.min_tangent_compliance);
        let spin = &mut work.spins[work.num_spins];
        let further = &mut work.spin_further[work.num_spins * work.stride..];
        for d in 0..3 {
            let [x, y, z] = frame[d];
            spin.rows.base[d] = [x, y, z, S::zero(), S::zero(), S::zero()];
        }
        build_rows(topology, factor, links, topology.contacts[contact].link, &mut spin.rows, further);
        let product = spin.rows.products(topology, further);
        let difference = (product[1] - product[2]) * half;
        let radius = difference.mul_add(difference, product[5] * product[5]).sqrt();
        spin.coupling = [product[3], product[4], product[5]];
        spin.inverse = [one / product[0].max(least), one / product[1].max(least), one / product[2].max(least)];
        spin.roll = one / (product[1] + product[2]).mul_add(half, radius).max(least);
        for d in 0..3 {
            spin.impulse[d] = S::select(near, warm_start[d], z);
        }
        work.num_spins += 1;
    }
}

impl<S: Real> SpinRows<S> {
    fn zero() -> Self {
        let z = S::zero();
        Self { rows: SparseRows::zero(), coupling: [z; 3], inverse: [z; 3], roll: z, impulse: [z; 3] }
    }

    /// Adds what angular impulses change to the velocity.
    #[inline(always)]
    pub(super) fn apply(
        &self,
        topology: &Topology,
        further: &[JointRows<S>],
        impulse: &[S; 3],
        y_base: &mut [S; 6],
        y_joint: &mut [[S; BLOCK]],
    ) {
        if topology.friction == ContactFriction::Rolling {
            self.rows.apply(topology, further, impulse, y_base, y_joint);
        } else {
            self.rows.apply_first(topology, further, impulse[0], y_base, y_joint);
        }
    }
}
