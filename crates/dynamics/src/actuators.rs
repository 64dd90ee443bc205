//! Actuators: delayed position targets, PD gains, and the limits of motors.

use super::articulation::{EffortTable, Topology};
use super::lanes::Real;
use super::parameters::BodyNumbers;
use super::settings::{IMPLICIT_STIFFNESS, STIFFNESS_LOOK_AHEAD, StepSettings};
use super::state::{Drive, State, Workspace};

/// Selects the position target that each actuator sees in a physics step: the one from `delay`
/// physics steps ago.
#[inline(always)]
pub(super) fn select_targets<S: Real>(
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

/// PD and feed-forward effort, limited by the motor's torque-speed line and the effort limit (or
/// its table over the position).
///
/// Inside the limits the gains act implicitly: their share of the velocity change goes to
/// `effort_slope` and onto the mass matrix's diagonal. A saturated actuator gives its limit,
/// explicitly, and so does an explicit one always.
#[inline(always)]
pub(super) fn actuate<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    settings: &StepSettings,
    drive: &Drive<S>,
    state: &State<S>,
    work: &mut Workspace<S>,
) {
    let (z, one, dt) = (S::zero(), S::one(), S::splat(settings.dt));
    let (look_ahead, share) = (dt * S::splat(STIFFNESS_LOOK_AHEAD), dt * S::splat(IMPLICIT_STIFFNESS));
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

/// Effort limit from a table over the joint position, N m.
#[inline(always)]
fn table_limit<S: Real>(table: &EffortTable, position: S) -> S {
    S::load(&S::gather(table, [position]))
}
