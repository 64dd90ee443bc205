//! One control step of a pack: actuators, forward dynamics with contact, integration, substep after substep.

use super::articulation::{EffortTable, Topology};
use super::blocks::{BLOCK, gather};
use super::contact::{self, ContactSettings};
use super::kernels::Kernels;
use super::kinematics;
use super::lanes::{Kernel, Lanes, Real};
use super::math::{
    Spatial, add, add_scaled, cross, integrate_quat, mul_vec, mul_vec_transposed, normalised, quat_to_mat, splat,
};
use super::parameters::{BodyNumbers, Parameters, UniformParameters};
use super::rows::ContactWork;
use super::self_contact;
use super::solver;
use super::state::{Drive, Report, State, Workspace};
use super::terrain::Terrain;

/// What all packs of a simulation share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepSettings {
    /// Physics step, s.
    pub dt: f64,
    /// Physics steps per control step.
    pub decimation: usize,
    /// Gravity in world axes, m/s^2.
    pub gravity: [f64; 3],
    /// Contacts and joint bounds.
    pub contact: ContactSettings,
}

/// One control step.
pub struct ControlStep<'a, S: Real> {
    /// What the lanes share.
    pub topology: &'a Topology,
    /// Step sizes and solver settings.
    pub settings: &'a StepSettings,
    /// What the robots stand on where it is not the plane, which is then level.
    pub terrain: Option<Terrain<'a, S>>,
    /// The bodies.
    pub parameters: &'a Parameters<S>,
    /// The body of their kind, if they are all [alike](Parameters::is_alike) it: that makes the step faster and changes no bit of it.
    pub kind: Option<&'a Parameters<f32>>,
    /// What is asked of the actuators.
    pub drive: &'a Drive<S>,
    /// Moves forward by `decimation` physics steps.
    pub state: &'a mut State<S>,
    /// Filled in.
    pub report: &'a mut Report<S>,
    /// Scratch memory.
    pub work: &'a mut Workspace<S>,
}

impl<L: Kernels> ControlStep<'_, L> {
    /// Makes the step, on the lanes' instruction set.
    pub fn run(self) {
        L::control_step(self);
    }
}

impl<L: Lanes> ControlStep<'_, L> {
    /// The same, compiled where it is called: [`kernels`](super::kernels) does so once.
    pub(super) fn compute(self) {
        let parameters = self.parameters;
        match self.kind {
            Some(kind) if L::READS_ALIKE => {
                L::vectorize(StepOf { parameters: UniformParameters { kind, own: parameters }, step: self })
            }
            _ => L::vectorize(StepOf { parameters, step: self }),
        }
    }
}

/// A control step of bodies whose numbers are read as `B` has them.
struct StepOf<'a, S: Real, B> {
    parameters: B,
    step: ControlStep<'a, S>,
}

impl<S: Real, B: BodyNumbers<S>> Kernel<S> for StepOf<'_, S, B> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { parameters, step: ControlStep { topology, settings, terrain, drive, state, report, work, .. } } =
            self;
        report.touched.fill(false);
        for substep in 0..settings.decimation {
            select_targets(topology, settings, drive, substep, work);
            physics_step(topology, settings, terrain.as_ref(), parameters, drive, state, report, substep, work);
        }
        report_sites(topology, parameters, state, report, work);
    }
}

/// The position target that each joint's actuator sees in a physics step: the one from `delay` physics steps ago.
#[inline(always)]
fn select_targets<S: Real>(
    topology: &Topology,
    settings: &StepSettings,
    drive: &Drive<S>,
    substep: usize,
    work: &mut Workspace<S>,
) {
    work.target.copy_from_slice(&drive.targets[0]);
    if !topology.has_delay {
        return;
    }
    for (age, targets) in drive.targets.iter().enumerate().skip(1) {
        // a target of this age is seen by delays beyond `substep + (age - 1) decimation`
        let from = S::splat((substep + (age - 1) * settings.decimation) as f64 + 0.5);
        for j in 0..topology.num_joints() {
            work.target[j] = S::select(from.lt(drive.delay[j]), targets[j], work.target[j]);
        }
    }
}

/// Effort limit from a table over the joint position.
#[inline(always)]
fn table_limit<S: Real>(table: &EffortTable, position: S) -> S {
    let mut limit = S::zero();
    for lane in 0..S::LANES {
        limit.set_lane_f32(lane, table.limit_at(position.lane_f32(lane)));
    }
    limit
}

/// Share of a step by which the PD law's stiffness looks ahead: numerical damping of `LOOK_AHEAD * dt * kp`.
///
/// 1 is the backward Euler method, whose damping at 5 ms is a quarter of the legs' own; 0 damps nothing. Values of 0.1
/// to 0.3 follow a step of the target most closely (measured by `polypod accuracy`).
const LOOK_AHEAD: f64 = 0.2;
/// Share of `dt^2 kp` that joins the diagonal: the least that keeps every stiffness and step stable. Newmark's beta
/// over his gamma = 1/2 + `LOOK_AHEAD`, `(gamma + 1/2)^2 / 4`.
const STIFFNESS_SHARE: f64 = (1.0 + LOOK_AHEAD) * (1.0 + LOOK_AHEAD) / 4.0;

/// PD and feed-forward effort, limited by the motor's torque-speed line and the effort limit (or its table over the position).
///
/// Inside the limits the gains act implicitly: their share of the velocity change goes to `effort_slope` and onto the
/// mass matrix's diagonal. A saturated actuator gives its limit, explicitly, and so does an explicit one always.
#[inline(always)]
fn actuate<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    drive: &Drive<S>,
    dt: S,
    state: &State<S>,
    work: &mut Workspace<S>,
) {
    let (z, one) = (S::zero(), S::one());
    let (look_ahead, share) = (dt * S::splat(LOOK_AHEAD), dt * S::splat(STIFFNESS_SHARE));
    for (j, joint) in topology.joints.iter().enumerate() {
        let (q, v) = (state.joint_position[j], state.joint_velocity[j]);
        let (kp, kd) = (parameters.stiffness(j), parameters.damping(j));
        let ahead = if joint.explicit { z } else { look_ahead };
        let spring = kp.mul_add(v.neg_mul_add(ahead, work.target[j] - q), -(kd * v));
        let wanted = spring + drive.feedforward[j];
        let mut limit = parameters.effort_limit(j);
        if let Some(table) = &joint.effort_table {
            limit = limit * table_limit(table, q);
        }
        let stall = parameters.saturation_effort(j);
        let speed = v / parameters.motor_velocity_limit(j);
        let most = (stall * (one - speed)).clamp(z, limit);
        let least = (stall * (-one - speed)).clamp(-limit, z);
        let effort = wanted.clamp(least, most);
        let saturated = S::or(wanted.lt(effort), effort.lt(wanted));
        work.effort[j] = effort;
        work.effort_slope[j] = if joint.explicit { z } else { S::select(saturated, z, kp.mul_add(share, kd)) };
    }
}

#[inline(always)]
fn physics_step<S: Real, B: BodyNumbers<S>>(
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
    let z = S::zero();
    let dt = S::splat(settings.dt);
    work.base_rotation = quat_to_mat(&state.rotation);
    let gravity = mul_vec_transposed(&work.base_rotation, &splat(&settings.gravity));
    let (position, velocity) = (&state.joint_position, &state.joint_velocity);
    kinematics::equations_of_motion(topology, parameters, position, velocity, &state.angular_velocity, &gravity, work);

    actuate(topology, parameters, drive, dt, state, work);
    for (b, block) in topology.blocks().iter().enumerate() {
        work.rhs_joint[b] = [z; BLOCK];
        for place in 0..block.len {
            let j = block.joints[place];
            let slope = work.effort_slope[j] + parameters.joint_damping(j);
            let diagonal = &mut work.factor.blocks[b].diagonal[place];
            *diagonal = slope.mul_add(dt, *diagonal);
            let passive = parameters.joint_damping(j) * state.joint_velocity[j];
            work.rhs_joint[b][place] = (work.effort[j] - passive - work.bias_joint[j]) * dt;
        }
    }
    work.factor.factorise(topology);

    // the unconstrained velocity, first plain (for the bounds' sake), then as sparse velocity y = H u + H^-T r
    let linear = mul_vec_transposed(&work.base_rotation, &state.linear_velocity);
    let w = state.angular_velocity;
    work.velocity_base = [w[0], w[1], w[2], linear[0], linear[1], linear[2]];
    let [tx, ty, tz] = add(&drive.base_torque, &cross(&parameters.com(0), &drive.base_force));
    let [fx, fy, fz] = drive.base_force;
    let mut impulse = [tx, ty, tz, fx, fy, fz];
    for r in 0..6 {
        impulse[r] = (impulse[r] - work.bias_base[r]) * dt;
    }
    work.factor.half_solve(topology, &mut impulse, &mut work.rhs_joint);
    work.contact.base = if topology.floating { work.velocity_base } else { [z; 6] };
    gather(topology.blocks(), &state.joint_velocity, &mut work.contact.joints);
    {
        let Workspace { factor, contact, .. } = &mut *work;
        factor.to_sparse(topology, &mut contact.base, &mut contact.joints);
    }
    // as constraints leave it alone, aside until they have seen the one before it
    let ContactWork { base, joints, moved_base, moved_joints, .. } = &mut work.contact;
    for r in 0..6 {
        moved_base[r] = base[r] + impulse[r];
    }
    let joints = joints.as_flattened().iter().zip(moved_joints.as_flattened_mut());
    for ((y, moved), rhs) in joints.zip(work.rhs_joint.as_flattened_mut()) {
        *moved = *y + *rhs;
        *rhs = *moved;
    }
    let mut free_base = *moved_base;
    work.factor.to_dense(topology, &mut free_base, &mut work.rhs_joint);
    // `rhs_joint` now holds the free joint velocities
    kinematics::free_links(topology, &work.rhs_joint, &mut work.links);
    let free_base = Spatial::from_array(free_base);
    contact::build_contacts(topology, parameters, &settings.contact, terrain, dt, state, &free_base, work);
    self_contact::build_pairs(topology, parameters, &settings.contact, dt, state, substep == 0, work);
    work.contact.base = work.contact.moved_base;
    work.contact.joints.copy_from_slice(&work.contact.moved_joints);
    {
        let free = std::mem::take(&mut work.rhs_joint);
        contact::build_bounds(topology, parameters, &settings.contact, dt, state, &free, work);
        work.rhs_joint = free;
    }

    solver::solve(topology, parameters, &settings.contact, &mut work.contact);
    contact::report(
        topology,
        &settings.contact,
        S::one() / dt,
        &work.base_rotation,
        &work.contact,
        state,
        substep,
        substep + 1 == settings.decimation,
        report,
    );

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
            let change = new - state.joint_velocity[j];
            report.joint_effort[j] = effort_slope[j].neg_mul_add(change, effort[j]);
            report.joint_acceleration[j] = change / dt;
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

/// Positions and velocities of the sites at the end of the control step.
#[inline(always)]
pub(super) fn report_sites<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    state: &State<S>,
    report: &mut Report<S>,
    work: &mut Workspace<S>,
) {
    let rotation = quat_to_mat(&state.rotation);
    let base = Spatial { ang: state.angular_velocity, lin: mul_vec_transposed(&rotation, &state.linear_velocity) };
    kinematics::forward_kinematics(topology, parameters, &state.joint_position, &state.joint_velocity, &base, work);
    for (s, &link) in topology.sites.iter().enumerate() {
        let (at, velocity) = kinematics::point_motion(&work.links[link], &parameters.site_position(s));
        report.site_position[s] = add(&state.position, &mul_vec(&rotation, &at));
        report.site_velocity[s] = mul_vec(&rotation, &velocity);
    }
}
