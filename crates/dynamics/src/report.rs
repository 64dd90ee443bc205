//! The report of a control step: efforts and accelerations of joints, contact forces, and positions
//! of the sites. Also keeps the impulses for the next warm start.

use super::articulation::Topology;
use super::ground::{Plane, splat_frame};
use super::kinematics;
use super::lanes::Real;
use super::math::{Mat3, Spatial, Vec3, add, add_scaled, mul_vec, mul_vec_transposed, normalised, quat_to_mat, scale};
use super::parameters::BodyNumbers;
use super::rows::ContactWork;
use super::settings::ContactSettings;
use super::state::{State, Workspace};

/// Report of one control step.
#[derive(Clone, Debug)]
pub struct Report<S> {
    /// Actuator effort of the last physics step, N m, `[joints]`.
    pub joint_effort: Vec<S>,
    /// Joint acceleration over the last physics step, rad/s^2, `[joints]`.
    pub joint_acceleration: Vec<S>,
    /// Net contact force of the last physics step in world axes, N, `[bodies]`.
    pub body_force: Vec<Vec3<S>>,
    /// Sum of the normal forces of a body's contacts, N: `normal_force[physics step][body]`.
    pub normal_force: Vec<Vec<S>>,
    /// Bodies that had a contact in some lane and physics step: forces on all others are zero,
    /// `[bodies]`.
    pub touched: Vec<bool>,
    /// Demands of the last physics step, one or else zero each: bodies near the ground or another
    /// link, `[bodies]`, joints near a limit, `[blocks]`, and anything that was to be pushed out.
    pub demands: Vec<S>,
    /// Site positions in the env's frame, m, `[sites]`.
    pub site_position: Vec<Vec3<S>>,
    /// Site velocities in world axes, m/s, `[sites]`.
    pub site_velocity: Vec<Vec3<S>>,
}

impl<S: Real> Report<S> {
    /// All zero.
    pub fn zeros(topology: &Topology, decimation: usize) -> Self {
        let z = S::zero();
        Self {
            joint_effort: vec![z; topology.num_joints()],
            joint_acceleration: vec![z; topology.num_joints()],
            body_force: vec![[z; 3]; topology.num_bodies],
            normal_force: vec![vec![z; topology.num_bodies]; decimation],
            touched: vec![false; topology.num_bodies],
            demands: vec![z; topology.num_bodies + topology.blocks().len() + 1],
            site_position: vec![[z; 3]; topology.sites.len()],
            site_velocity: vec![[z; 3]; topology.sites.len()],
        }
    }

    /// Reports a joint after a physics step of `dt`: its actuator's effort, N m, and its velocities
    /// `before` and `after` the step, rad/s. Both engines call it.
    #[inline(always)]
    pub fn set_joint(&mut self, joint: usize, effort: S, [before, after]: [S; 2], dt: S) {
        self.joint_effort[joint] = effort;
        self.joint_acceleration[joint] = (after - before) / dt;
    }
}

/// Stores the impulses for the next warm start, and reports the contact forces of a physics step.
///
/// Every physics step reports the sum of normal forces per body, N, and which bodies are `touched`
/// in any lane. The `last` one of a control step also reports the force on each body in world axes,
/// N, and the [`demands`](Report::demands).
#[inline(always)]
pub(super) fn report_contacts<S: Real>(
    topology: &Topology,
    settings: &ContactSettings,
    inverse_dt: S,
    base_rotation: &Mat3<S>,
    work: &ContactWork<S>,
    state: &mut State<S>,
    substep: usize,
    last: bool,
    report: &mut Report<S>,
) {
    let z = S::zero();
    let Report { body_force, normal_force, touched, demands, .. } = report;
    let normal_force = &mut normal_force[substep];
    normal_force.fill(z);
    for (block, shape) in work.bounds.iter().zip(topology.blocks()) {
        for (row, &j) in block.joints.iter().zip(&shape.joints[..shape.len]) {
            // adding +0 turns -0 into +0, which alone could depend on a lane's neighbours
            state.bound_impulse[j] = if row.takes_part() { row.impulse() + z } else { z };
        }
    }
    for &contact in &state.pressing {
        state.impulse[contact as usize] = [z; 3];
    }
    state.pressing.clear();
    for row in work.contacts() {
        let impulse = normalised(&row.impulse);
        state.impulse[row.contact] = impulse;
        state.pressing.push(row.contact as u32);
        for &body in bodies(topology, row.contact) {
            normal_force[body] = impulse[0].mul_add(inverse_dt, normal_force[body]);
            touched[body] = true;
        }
    }
    for (row, spin) in work.contacts().iter().zip(work.spins()) {
        let impulse = topology.spin_impulse(row.contact);
        state.impulse[impulse] = normalised(&spin.impulse);
        state.pressing.push(impulse as u32);
    }
    if last {
        sum_forces(topology, settings, inverse_dt, base_rotation, work, body_force);
        note_demands(topology, work, demands);
    }
}

/// Fills [`Report::demands`].
#[inline(always)]
fn note_demands<S: Real>(topology: &Topology, work: &ContactWork<S>, demands: &mut [S]) {
    let one = S::one();
    demands.fill(S::zero());
    for row in work.contacts() {
        for &body in bodies(topology, row.contact) {
            demands[body] = S::select(row.near, one, demands[body]);
        }
    }
    let (_, blocks) = demands.split_at_mut(topology.num_bodies);
    for (block, demand) in work.bounds.iter().zip(&mut *blocks) {
        for row in &block.joints {
            if row.limits {
                *demand = S::select(row.near, one, *demand);
            }
        }
    }
    blocks[work.bounds.len()] = S::select(S::zero().lt(work.violation), one, S::zero());
}

/// Contact bodies of a contact: one on the ground, two of a pair.
#[inline(always)]
fn bodies(topology: &Topology, contact: usize) -> &[usize] {
    match topology.pair_of(contact) {
        Some(pair) => &pair.bodies,
        None => std::slice::from_ref(&topology.contacts[contact].body),
    }
}

/// Net contact force of each body in world axes, N.
#[inline(always)]
fn sum_forces<S: Real>(
    topology: &Topology,
    settings: &ContactSettings,
    inverse_dt: S,
    base_rotation: &Mat3<S>,
    work: &ContactWork<S>,
    force: &mut [Vec3<S>],
) {
    force.fill([S::zero(); 3]);
    let ground = splat_frame(&settings.ground.unwrap_or(Plane::level(0.0)));
    let on_ground = work.contacts().len() - work.pair_frames.len();
    for (c, row) in work.contacts().iter().enumerate() {
        let f = scale(&normalised(&row.impulse), inverse_dt);
        if let Some(pair) = topology.pair_of(row.contact) {
            let frame = in_world(base_rotation, &work.pair_frames[c - on_ground]);
            let [first, second] = pair.bodies;
            add_force(&mut force[first], &frame, row.near, &f);
            add_force(&mut force[second], &frame, row.near, &scale(&f, -S::one()));
        } else {
            let body = topology.contacts[row.contact].body;
            match work.ground_frames.get(c) {
                Some(frame) => add_force(&mut force[body], &in_world(base_rotation, frame), row.near, &f),
                None => add_force(&mut force[body], &ground, row.near, &f),
            }
        }
    }
}

/// Turns axes from base axes into world axes.
#[inline(always)]
fn in_world<S: Real>(base_rotation: &Mat3<S>, frame: &[Vec3<S>; 3]) -> [Vec3<S>; 3] {
    [mul_vec(base_rotation, &frame[0]), mul_vec(base_rotation, &frame[1]), mul_vec(base_rotation, &frame[2])]
}

/// Adds a force along axes in the lanes that are `near`. In other lanes the axes may be NaN.
#[inline(always)]
fn add_force<S: Real>(sum: &mut Vec3<S>, frame: &[Vec3<S>; 3], near: S::Mask, f: &[S; 3]) {
    let mut new = *sum;
    for d in 0..3 {
        new = add_scaled(&new, &frame[d], f[d]);
    }
    for (sum, new) in sum.iter_mut().zip(new) {
        *sum = S::select(near, new, *sum);
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
