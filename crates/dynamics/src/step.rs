//! One control step of a pack: physics steps, each a sequence of eight calls.

use std::ops::Range;

use super::actuators::{actuate, select_targets};
use super::articulation::Topology;
use super::blocks::{BLOCK, gather};
use super::factor::Factor;
use super::ground_contacts::build_ground_contacts;
use super::joint_bounds::build_joint_bounds;
use super::kernels::Kernels;
use super::kinematics;
use super::lanes::{Kernel, Lanes, Real};
use super::math::{
    Spatial, add, add_scaled, cross, integrate_quat, mul_vec, mul_vec_transposed, normalised, quat_to_mat, splat,
};
use super::parameters::{BodyNumbers, Parameters, UniformParameters};
use super::report::{Report, report_contacts, report_sites};
use super::rows::ContactWork;
use super::self_contact::build_pairs;
use super::settings::StepSettings;
use super::solver::solve;
use super::springs::{add_spring_impulses, add_spring_inertia};
use super::state::{Drive, State, Workspace};
use super::terrain::Terrain;

/// One control step, or some of its physics steps.
pub struct ControlStep<'a, S: Real> {
    /// Topology that the lanes share.
    pub topology: &'a Topology,
    /// Step sizes and solver settings.
    pub settings: &'a StepSettings,
    /// Terrain that the robots stand on instead of the settings' plane, which must be level then.
    pub terrain: Option<Terrain<'a, S>>,
    /// Masses, frames and actuators of the bodies.
    pub parameters: &'a Parameters<S>,
    /// Parameters of the morphology, if all bodies [have them](Parameters::is_uniform_with). The
    /// step is then faster, and its bits are the same.
    pub nominal: Option<&'a Parameters<f32>>,
    /// Targets of the actuators.
    pub drive: &'a Drive<S>,
    /// Physics steps of the `decimation` ones that are made. The first one begins the report, the
    /// last one completes it.
    pub substeps: Range<usize>,
    /// Moves forward by these physics steps.
    pub state: &'a mut State<S>,
    /// Forces and accelerations of these physics steps; the kernel writes them.
    pub report: &'a mut Report<S>,
    /// Scratch memory.
    pub work: &'a mut Workspace<S>,
}

impl<L: Kernels> ControlStep<'_, L> {
    /// Makes the step on the lanes' instruction set.
    pub fn run(self) {
        L::control_step(self);
    }
}

impl<L: Lanes> ControlStep<'_, L> {
    /// Makes the step in code that is compiled where this is called: [`kernels`](super::kernels)
    /// calls it once per lane type.
    pub(super) fn compute(self) {
        let parameters = self.parameters;
        match self.nominal {
            Some(shared) if L::READS_UNIFORM => {
                L::vectorize(StepOf { parameters: UniformParameters { shared, own: parameters }, step: self })
            }
            _ => L::vectorize(StepOf { parameters, step: self }),
        }
    }
}

/// A control step of bodies whose numbers are read through `B`.
struct StepOf<'a, S: Real, B> {
    parameters: B,
    step: ControlStep<'a, S>,
}

impl<S: Lanes, B: BodyNumbers<S>> Kernel<S> for StepOf<'_, S, B> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self {
            parameters,
            step: ControlStep { topology, settings, terrain, drive, substeps, state, report, work, .. },
        } = self;
        // a copy, which no store through a reference can change: loops convert its numbers once
        let settings = &{ *settings };
        if substeps.start == 0 {
            report.touched.fill(false);
        }
        let last = substeps.end == settings.decimation;
        for substep in substeps {
            select_targets(topology, settings, drive, substep, work);
            physics_step(topology, settings, terrain.as_ref(), parameters, drive, state, report, substep, work);
        }
        if last {
            report_sites(topology, parameters, state, report, work);
        }
    }
}

/// One physics step of length `settings.dt`. README.md derives it.
#[inline(always)]
fn physics_step<S: Lanes, B: BodyNumbers<S>>(
    topology: &Topology,
    settings: &StepSettings,
    terrain: Option<&Terrain<S>>,
    parameters: B,
    drive: &Drive<S>,
    state: &mut State<S>,
    report: &mut Report<S>,
    substep: usize,
    work: &mut Workspace<S>,
) {
    update_kinematics(topology, settings, parameters, state, work);
    add_link_forces(topology, drive, work);
    actuate(topology, parameters, settings, drive, state, work);
    factorise(topology, settings, parameters, work);
    let free_base = find_free_velocity(topology, settings, parameters, drive, state, work);
    build_constraints(topology, settings, terrain, parameters, state, &free_base, substep, work);
    S::call(EndOfStep { topology, settings, parameters: parameters.own(), state, report, substep, work });
}

/// The part of a physics step that reads no numbers of bodies but their friction.
struct EndOfStep<'a, S: Real> {
    topology: &'a Topology,
    settings: &'a StepSettings,
    parameters: &'a Parameters<S>,
    state: &'a mut State<S>,
    report: &'a mut Report<S>,
    substep: usize,
    work: &'a mut Workspace<S>,
}

impl<S: Lanes> Kernel<S> for EndOfStep<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { topology, settings, parameters, state, report, substep, work } = self;
        solve_constraints(topology, settings, parameters, state, report, substep, work);
        integrate(topology, settings, state, report, work);
    }
}

/// Factorises a mass matrix.
struct Factorise<'a, S> {
    topology: &'a Topology,
    factor: &'a mut Factor<S>,
}

impl<S: Real> Kernel<S> for Factorise<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        self.factor.factorise(self.topology);
    }
}

/// Finds poses and velocities of all links, bias forces and the mass matrix.
#[inline(always)]
fn update_kinematics<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    settings: &StepSettings,
    parameters: B,
    state: &State<S>,
    work: &mut Workspace<S>,
) {
    work.base_rotation = quat_to_mat(&state.rotation);
    let gravity = mul_vec_transposed(&work.base_rotation, &splat(&settings.gravity));
    let (position, velocity) = (&state.joint_position, &state.joint_velocity);
    kinematics::equations_of_motion(topology, parameters, position, velocity, &state.angular_velocity, &gravity, work);
}

/// Takes the forces on links from outside off the bias forces: each acts on the base and on the
/// joints that carry the link.
#[inline(always)]
fn add_link_forces<S: Real>(topology: &Topology, drive: &Drive<S>, work: &mut Workspace<S>) {
    let Workspace { links, base_rotation, bias_base, bias_joint, .. } = work;
    for force in &drive.link_forces {
        let link = &links[force.link];
        let (lin, torque) = if force.in_world {
            (mul_vec_transposed(base_rotation, &force.force), mul_vec_transposed(base_rotation, &force.torque))
        } else {
            (mul_vec(&link.rotation, &force.force), mul_vec(&link.rotation, &force.torque))
        };
        let at = add(&link.position, &mul_vec(&link.rotation, &force.point));
        let wrench = Spatial { ang: add(&torque, &cross(&at, &lin)), lin };
        // a lane without the force keeps its bits
        let acts = S::zero().lt(force.acts);
        for (bias, own) in bias_base.iter_mut().zip(wrench.to_array()) {
            *bias = S::select(acts, *bias - own, *bias);
        }
        for j in topology.chain(force.link) {
            bias_joint[j] = S::select(acts, bias_joint[j] - links[j + 1].axis.dot(&wrench), bias_joint[j]);
        }
    }
}

/// Factorises the mass matrix, with the damping of joints and the implicit shares of springs and
/// actuators on its diagonal.
#[inline(always)]
fn factorise<S: Lanes, B: BodyNumbers<S>>(
    topology: &Topology,
    settings: &StepSettings,
    parameters: B,
    work: &mut Workspace<S>,
) {
    let dt = S::splat(settings.dt);
    for (b, block) in topology.blocks().iter().enumerate() {
        for place in 0..block.len {
            let j = block.joints[place];
            let slope = work.effort_slope[j] + parameters.joint_damping(j);
            let diagonal = &mut work.factor.blocks[b].diagonal[place];
            *diagonal = slope.mul_add(dt, *diagonal);
        }
    }
    add_spring_inertia(topology, parameters, dt, work);
    S::call(Factorise { topology, factor: &mut work.factor });
}

/// Finds the velocity that the robot would have after the step without constraints, and returns the
/// base's in base axes.
///
/// Leaves the joints' free velocities in `rhs_joint`, the links' in `links`, the sparse velocity
/// before the step in the contact workspace's `base`, `joints`, and the free one in its
/// `moved_base`, `moved_joints`.
#[inline(always)]
fn find_free_velocity<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    settings: &StepSettings,
    parameters: B,
    drive: &Drive<S>,
    state: &State<S>,
    work: &mut Workspace<S>,
) -> Spatial<S> {
    let (z, dt) = (S::zero(), S::splat(settings.dt));
    for (b, block) in topology.blocks().iter().enumerate() {
        work.rhs_joint[b] = [z; BLOCK];
        for place in 0..block.len {
            let j = block.joints[place];
            let passive = parameters.joint_damping(j) * state.joint_velocity[j];
            work.rhs_joint[b][place] = (work.effort[j] - passive - work.bias_joint[j]) * dt;
        }
    }
    add_spring_impulses(topology, parameters, dt, state, work);
    let linear = mul_vec_transposed(&work.base_rotation, &state.linear_velocity);
    let w = state.angular_velocity;
    work.velocity_base = [w[0], w[1], w[2], linear[0], linear[1], linear[2]];
    let [tx, ty, tz] = add(&drive.base_torque, &cross(&parameters.com(0), &drive.base_force));
    let [fx, fy, fz] = drive.base_force;
    let mut impulse = [tx, ty, tz, fx, fy, fz];
    for r in 0..6 {
        impulse[r] = (impulse[r] - work.bias_base[r]) * dt;
    }
    // as sparse velocity: y = H u + H^-T r
    work.factor.half_solve(topology, &mut impulse, &mut work.rhs_joint);
    work.contact.base = if topology.floating { work.velocity_base } else { [z; 6] };
    gather(topology.blocks(), &state.joint_velocity, &mut work.contact.joints);
    let Workspace { factor, contact, links, rhs_joint, .. } = work;
    factor.to_sparse(topology, &mut contact.base, &mut contact.joints);
    let ContactWork { base, joints, moved_base, moved_joints, .. } = contact;
    for r in 0..6 {
        moved_base[r] = base[r] + impulse[r];
    }
    let joints = joints.as_flattened().iter().zip(moved_joints.as_flattened_mut());
    for ((y, moved), rhs) in joints.zip(rhs_joint.as_flattened_mut()) {
        *moved = *y + *rhs;
        *rhs = *moved;
    }
    let mut free_base = *moved_base;
    factor.to_dense(topology, &mut free_base, rhs_joint);
    kinematics::free_links(topology, rhs_joint, links);
    Spatial::from_array(free_base)
}

/// Builds the rows of ground contacts, of contacts between links and of joint bounds. The sparse
/// velocity is the free one afterwards.
#[inline(always)]
fn build_constraints<S: Lanes, B: BodyNumbers<S>>(
    topology: &Topology,
    settings: &StepSettings,
    terrain: Option<&Terrain<S>>,
    parameters: B,
    state: &State<S>,
    free_base: &Spatial<S>,
    substep: usize,
    work: &mut Workspace<S>,
) {
    let (settings, dt) = (&settings.contact, S::splat(settings.dt));
    // restitution reads the velocity before the step
    build_ground_contacts(topology, parameters, settings, terrain, dt, state, free_base, work);
    build_pairs(topology, parameters, settings, dt, state, substep == 0, work);
    work.contact.base = work.contact.moved_base;
    work.contact.joints.copy_from_slice(&work.contact.moved_joints);
    let free_joints = std::mem::take(&mut work.rhs_joint);
    build_joint_bounds(topology, parameters, settings, dt, state, &free_joints, work);
    work.rhs_joint = free_joints;
}

/// Solves the constraints, stores their impulses for the next warm start, and reports the contact
/// forces.
#[inline(always)]
fn solve_constraints<S: Lanes>(
    topology: &Topology,
    settings: &StepSettings,
    parameters: &Parameters<S>,
    state: &mut State<S>,
    report: &mut Report<S>,
    substep: usize,
    work: &mut Workspace<S>,
) {
    solve(topology, parameters, &settings.contact, &mut work.contact);
    let inverse_dt = S::one() / S::splat(settings.dt);
    let last = substep + 1 == settings.decimation;
    let Workspace { base_rotation, contact, .. } = work;
    report_contacts(topology, &settings.contact, inverse_dt, base_rotation, contact, state, substep, last, report);
}

/// Takes over the new velocities, and moves positions with them and the push (semi-implicit Euler).
/// Reports joint efforts and accelerations.
#[inline(always)]
fn integrate<S: Real>(
    topology: &Topology,
    settings: &StepSettings,
    state: &mut State<S>,
    report: &mut Report<S>,
    work: &mut Workspace<S>,
) {
    let (z, dt) = (S::zero(), S::splat(settings.dt));
    let Workspace { factor, contact, effort, effort_slope, base_rotation, .. } = work;
    factor.to_dense(topology, &mut contact.base, &mut contact.joints);
    if contact.pushes() {
        factor.to_dense(topology, &mut contact.moved_base, &mut contact.moved_joints);
    } else {
        contact.moved_base = contact.base;
        contact.moved_joints.copy_from_slice(&contact.joints);
    }
    let moves = contact.joints.iter().zip(&contact.moved_joints);
    for (block, (velocity, moved)) in topology.blocks().iter().zip(moves) {
        for place in 0..block.len {
            let j = block.joints[place];
            // +0 turns -0 into +0
            let new = velocity[place] + z;
            let velocity = [state.joint_velocity[j], new];
            let effort = effort_slope[j].neg_mul_add(new - velocity[0], effort[j]);
            report.set_joint(j, effort, velocity, dt);
            state.joint_velocity[j] = new;
            state.joint_position[j] = (moved[place] + z).mul_add(dt, state.joint_position[j]);
        }
    }
    if topology.floating {
        let u = normalised(&contact.base);
        state.angular_velocity = [u[0], u[1], u[2]];
        state.linear_velocity = normalised(&mul_vec(base_rotation, &[u[3], u[4], u[5]]));
        let m = normalised(&contact.moved_base);
        let moved = normalised(&mul_vec(base_rotation, &[m[3], m[4], m[5]]));
        state.position = add_scaled(&state.position, &moved, dt);
        state.rotation = integrate_quat(&state.rotation, &[m[0] * dt, m[1] * dt, m[2] * dt]);
    }
}
