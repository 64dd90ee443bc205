//! The border of the crate: every kernel is compiled here, once per type of number. Code of other
//! crates calls these functions and compiles no kernel itself, whatever types it is generic over.
//! The unit tests of this crate test its parts and leave them out.

use super::algorithms::Dynamics;
use super::articulation::Topology;
use super::ground;
use super::kinematics;
use super::lanes::{self, Kernel, Lanes, Proof, Real, SimdDispatch, SimdToken};
use super::math::{Mat3, Spatial, Vec3};
use super::networks::NetworkStep;
use super::parameters::Parameters;
use super::ray_cast::Rays;
use super::report;
use super::report::Report;
use super::self_contact;
use super::settings::ContactSettings;
use super::state::{State, Workspace};
use super::step::ControlStep;

/// A type of number that robots are stepped in: the lanes of an instruction set, or a single
/// number.
pub trait Kernels: Lanes {
    /// One control step; [`ControlStep::run`] calls it.
    fn control_step(step: ControlStep<Self>);
    /// Actuator networks at the beginning of a physics step; [`NetworkStep::run`] calls it.
    fn network_step(step: NetworkStep<Self>);
}

/// A computation that is written for any lane type that robots are stepped in.
pub trait WithKernels {
    /// Result of the computation.
    type Output;
    /// The computation.
    fn run<L: Kernels>(self) -> Self::Output;
}

/// Calls a computation with the lanes of an instruction set.
#[cfg(not(test))]
pub fn with_kernels<C: WithKernels>(simd: SimdToken, computation: C) -> C::Output {
    match simd {
        #[cfg(target_arch = "x86_64")]
        SimdToken::Avx512(_) => computation.run::<lanes::Avx512<Found>>(),
        #[cfg(target_arch = "x86_64")]
        SimdToken::Avx2(_) => computation.run::<lanes::Avx2<Found>>(),
        #[cfg(target_arch = "aarch64")]
        SimdToken::Neon => computation.run::<lanes::Neon<Found>>(),
        SimdToken::Portable => computation.run::<lanes::Portable>(),
    }
}

/// Proof behind [`with_kernels`].
#[derive(Clone, Copy, Debug)]
struct Found;

// SAFETY: the type is private, and `with_kernels` asks for the token
#[allow(unsafe_code)]
unsafe impl Proof for Found {}

/// Compiles the control step and actuator networks for types of numbers.
macro_rules! control_step_kernels {
    ($($(#[$attribute:meta])* $number:ty),*) => {
        $(
            #[cfg(not(test))]
            $(#[$attribute])*
            impl Kernels for $number {
                fn control_step(step: ControlStep<Self>) {
                    step.compute();
                }
                fn network_step(step: NetworkStep<Self>) {
                    step.compute();
                }
            }
        )*
    };
}

/// States the functions of [`Scalar`] and compiles each of them for `f32` and `f64`.
macro_rules! scalar_kernels {
    ($(
        $(#[$doc:meta])*
        fn $name:ident($($argument:ident: $type:ty),*) $(-> $output:ty)? = $kernel:expr;
    )*) => {
        /// `f32` or `f64`: the numbers that a single body is asked about its motion in.
        pub trait Scalar: Real {
            $( $(#[$doc])* fn $name($($argument: $type),*) $(-> $output)?; )*
        }
        scalar_kernels!(@for f32, $( fn $name($($argument: $type),*) $(-> $output)? = $kernel; )*);
        scalar_kernels!(@for f64, $( fn $name($($argument: $type),*) $(-> $output)? = $kernel; )*);
    };
    (@for $number:ty, $( fn $name:ident($($argument:ident: $type:ty),*) $(-> $output:ty)? = $kernel:expr; )*) => {
        #[cfg(not(test))]
        impl Scalar for $number {
            $( fn $name($($argument: $type),*) $(-> $output)? { ($kernel)($($argument),*) } )*
        }
    };
}

control_step_kernels!(
    #[cfg(target_arch = "x86_64")]
    lanes::Avx512<Found>,
    #[cfg(target_arch = "x86_64")]
    lanes::Avx2<Found>,
    #[cfg(target_arch = "aarch64")]
    lanes::Neon<Found>,
    lanes::Portable,
    f32,
    f64
);

scalar_kernels! {
    /// Leaves positions, axes and velocities of all links in [`Workspace::links`].
    ///
    /// `position` and `velocity` are those of the joints, rad and rad/s, `[joints]`;
    /// `base_velocity` is in base axes about the base's origin.
    fn forward_kinematics(
        topology: &Topology,
        parameters: &Parameters<Self>,
        position: &[Self],
        velocity: &[Self],
        base_velocity: &Spatial<Self>,
        work: &mut Workspace<Self>
    ) = kinematics::forward_kinematics;

    /// Writes positions and velocities of the sites to the report.
    fn report_sites(
        topology: &Topology,
        parameters: &Parameters<Self>,
        state: &State<Self>,
        report: &mut Report<Self>,
        work: &mut Workspace<Self>
    ) = report::report_sites;

    /// Puts the colliders where the workspace has their links.
    fn place_colliders(topology: &Topology, parameters: &Parameters<Self>, work: &mut Workspace<Self>)
        = self_contact::place_colliders;

    /// Distance of the two links of a pair of placed colliders, m, negative when they overlap.
    fn pair_gap(topology: &Topology, work: &Workspace<Self>, pair: usize) -> Self = self_contact::pair_gap;

    /// Distance of each contact candidate from the ground, m, `[contacts]` in the topology's order,
    /// negative inside the ground; empty where there is none.
    fn candidate_gaps(
        topology: &Topology,
        parameters: &Parameters<Self>,
        settings: &ContactSettings,
        state: &State<Self>,
        work: &mut Workspace<Self>
    ) -> Vec<Self> = ground::candidate_gaps;

    /// Mass matrix, armature included: symmetric, row-major `[nv, nv]`.
    fn mass_matrix(body: &mut Dynamics<Self>) -> Vec<Self> = Dynamics::mass_matrix;

    /// Bias force `c`, `[nv]`: `M qacc + c = force`. Holds gravity and the velocity terms (MuJoCo's
    /// `qfrc_bias`), no passive damping.
    fn bias_force(body: &mut Dynamics<Self>) -> Vec<Self> = Dynamics::bias_force;

    /// Acceleration `[nv]` that a generalised force `[nv]` causes without contacts, joint bounds,
    /// damping and friction.
    ///
    /// # Panics
    /// If `force` is shorter than [`num_dofs`](Dynamics::num_dofs).
    fn forward_dynamics(body: &mut Dynamics<Self>, force: &[Self]) -> Vec<Self> = Dynamics::forward_dynamics;

    /// Generalised force `[nv]` that causes an acceleration `[nv]` in the present state, armature
    /// included.
    ///
    /// # Panics
    /// If `qacc` is shorter than [`num_dofs`](Dynamics::num_dofs).
    fn inverse_dynamics(body: &mut Dynamics<Self>, qacc: &[Self]) -> Vec<Self> = Dynamics::inverse_dynamics;

    /// Jacobian of a point of a link, row-major `[6, nv]`: its linear velocity, then the link's
    /// angular velocity, both in world axes. `point` is in the link's (base-aligned) axes about its
    /// origin, m.
    ///
    /// # Panics
    /// If there is no such link.
    fn jacobian(body: &mut Dynamics<Self>, link: usize, point: &Vec3<Self>) -> Vec<Self> = Dynamics::jacobian;

    /// Origin of a link in the world, m, and the turn from its (base-aligned) axes to world axes.
    ///
    /// # Panics
    /// If there is no such link.
    fn link_pose(body: &mut Dynamics<Self>, link: usize) -> (Vec3<Self>, Mat3<Self>) = Dynamics::link_pose;

    /// Velocity of a link's origin, m/s, and angular velocity of the link, rad/s, both in world
    /// axes.
    ///
    /// # Panics
    /// If there is no such link.
    fn link_velocity(body: &mut Dynamics<Self>, link: usize) -> (Vec3<Self>, Vec3<Self>) = Dynamics::link_velocity;

    /// Kinetic energy, that of the rotors (armature) included, and potential energy in uniform
    /// gravity, zero for a mass at the world's origin, J.
    fn energy(body: &mut Dynamics<Self>) -> (Self, Self) = Dynamics::energy;

    /// Linear momentum, kg m/s, and angular momentum about the centre of mass, kg m^2/s, in world
    /// axes; without rotors.
    fn momentum(body: &mut Dynamics<Self>) -> (Vec3<Self>, Vec3<Self>) = Dynamics::momentum;

    /// Centre of mass in the world, m.
    fn center_of_mass(body: &mut Dynamics<Self>) -> Vec3<Self> = Dynamics::center_of_mass;
}

/// [`Scalar::forward_kinematics`] of single-precision numbers, compiled for an instruction set:
/// where it has fused multiply-adds, these are no function calls. Bits are the same.
#[cfg(not(test))]
pub fn forward_kinematics(
    simd: SimdDispatch,
    topology: &Topology,
    parameters: &Parameters<f32>,
    position: &[f32],
    velocity: &[f32],
    base_velocity: &Spatial<f32>,
    work: &mut Workspace<f32>,
) {
    simd.vectorize(ForwardKinematics { topology, parameters, position, velocity, base_velocity, work });
}

/// Arguments of [`forward_kinematics`].
struct ForwardKinematics<'a> {
    topology: &'a Topology,
    parameters: &'a Parameters<f32>,
    position: &'a [f32],
    velocity: &'a [f32],
    base_velocity: &'a Spatial<f32>,
    work: &'a mut Workspace<f32>,
}

impl Kernel<f32> for ForwardKinematics<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { topology, parameters, position, velocity, base_velocity, work } = self;
        kinematics::forward_kinematics(topology, parameters, position, velocity, base_velocity, work);
    }
}

/// Gaps of some `pairs` of links at joint positions, rad, `[joints]`, m: [`Scalar::pair_gap`] after
/// all that it asks for, compiled for an instruction set like [`forward_kinematics`].
#[cfg(not(test))]
pub fn pair_gaps(
    simd: SimdDispatch,
    topology: &Topology,
    parameters: &Parameters<f64>,
    position: &[f64],
    pairs: &[usize],
    work: &mut Workspace<f64>,
    gaps: &mut Vec<f64>,
) {
    simd.vectorize(PairGaps { topology, parameters, position, pairs, work, gaps });
}

/// Arguments of [`pair_gaps`].
struct PairGaps<'a> {
    topology: &'a Topology,
    parameters: &'a Parameters<f64>,
    position: &'a [f64],
    pairs: &'a [usize],
    work: &'a mut Workspace<f64>,
    gaps: &'a mut Vec<f64>,
}

impl Kernel<f32> for PairGaps<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { topology, parameters, position, pairs, work, gaps } = self;
        let still = vec![0.0; position.len()];
        kinematics::forward_kinematics(topology, parameters, position, &still, &Spatial::zero(), work);
        self_contact::place_colliders(topology, parameters, work);
        gaps.clear();
        for &pair in pairs {
            gaps.push(self_contact::pair_gap(topology, work, pair));
        }
    }
}

/// Finds where rays meet the ground, in lanes of an instruction set. Bits depend on no set.
#[cfg(not(test))]
pub fn cast_rays(simd: SimdToken, rays: Rays) {
    simd.with_sixteen_lanes(rays);
}
