//! The robots' state as dense rows for callers outside, gathered on request.

use bevy_ecs::prelude::*;

use super::faults;
use super::terms::CompiledTask;
use super::view::RobotView;
use super::views::ViewParam;
use crate::blocks::{Block, Blocks};
use crate::components::{ContactForces, Env, Episode, PerFoot, Robot};
use crate::error::Error;
use crate::morphology::{BatchSlots, Morphologies};
use crate::workers::{MatrixRows, Workers};

/// One quantity of every robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StateField {
    /// Base position relative to the env's origin, which lies on the ground, m.
    BasePos,
    /// Height of the base above the ground, m: see [`RobotView::base_height`].
    BaseHeight,
    /// Base orientation w, x, y, z.
    BaseQuat,
    /// Velocity of the base's centre of mass, base axes, m/s.
    BaseLinVel,
    /// Angular velocity, base axes, rad/s.
    BaseAngVel,
    /// Unit vector of gravity, base axes; zeros without gravity.
    ProjectedGravity,
    /// Joint positions, canonical order, rad.
    JointPos,
    /// Joint velocities, canonical order, rad/s.
    JointVel,
    /// Joint accelerations over the last physics step, canonical order, rad/s^2.
    JointAcc,
    /// Efforts of the actuators in the last physics step, canonical order, N m.
    JointEffort,
    /// Joint positions of the default pose, canonical order, rad.
    DefaultJointPos,
    /// Net contact force on each foot in the last physics step, world axes, N.
    ContactForces,
    /// Centres of the feet relative to the env's origin, m.
    FeetPos,
    /// Heights of the feet's centres above the ground below them, m.
    FeetHeight,
    /// Velocities of the feet's centres, world axes, m/s.
    FeetVel,
    /// Time that each foot has been in the air, s.
    FeetAirTime,
    /// Time that each foot has been in contact, s.
    FeetContactTime,
    /// Commanded forward and left velocity (m/s) and yaw rate (rad/s), base axes.
    Command,
    /// Last action, canonical order.
    LastAction,
    /// The action before that.
    PreviousAction,
    /// 1, or 0 where the state broke; all else of such a robot is gathered as zeros.
    Valid,
}

impl StateField {
    /// Every field, in the order of the documentation.
    pub const ALL: [Self; 21] = [
        Self::BasePos,
        Self::BaseHeight,
        Self::BaseQuat,
        Self::BaseLinVel,
        Self::BaseAngVel,
        Self::ProjectedGravity,
        Self::JointPos,
        Self::JointVel,
        Self::JointAcc,
        Self::JointEffort,
        Self::DefaultJointPos,
        Self::ContactForces,
        Self::FeetPos,
        Self::FeetHeight,
        Self::FeetVel,
        Self::FeetAirTime,
        Self::FeetContactTime,
        Self::Command,
        Self::LastAction,
        Self::PreviousAction,
        Self::Valid,
    ];

    /// Name of the field in Python.
    pub fn name(self) -> &'static str {
        match self {
            Self::BasePos => "base_pos",
            Self::BaseHeight => "base_height",
            Self::BaseQuat => "base_quat",
            Self::BaseLinVel => "base_lin_vel",
            Self::BaseAngVel => "base_ang_vel",
            Self::ProjectedGravity => "projected_gravity",
            Self::JointPos => "joint_pos",
            Self::JointVel => "joint_vel",
            Self::JointAcc => "joint_acc",
            Self::JointEffort => "joint_effort",
            Self::DefaultJointPos => "default_joint_pos",
            Self::ContactForces => "contact_forces",
            Self::FeetPos => "feet_pos",
            Self::FeetHeight => "feet_height",
            Self::FeetVel => "feet_vel",
            Self::FeetAirTime => "feet_air_time",
            Self::FeetContactTime => "feet_contact_time",
            Self::Command => "command",
            Self::LastAction => "last_action",
            Self::PreviousAction => "previous_action",
            Self::Valid => "valid",
        }
    }

    /// Numbers per robot in a batch with these columns.
    pub fn width(self, slots: &BatchSlots) -> usize {
        match self {
            Self::Valid | Self::BaseHeight => 1,
            Self::BasePos | Self::BaseLinVel | Self::BaseAngVel | Self::ProjectedGravity | Self::Command => 3,
            Self::BaseQuat => 4,
            Self::FeetHeight | Self::FeetAirTime | Self::FeetContactTime => slots.feet.len(),
            Self::ContactForces | Self::FeetPos | Self::FeetVel => 3 * slots.feet.len(),
            Self::JointPos
            | Self::JointVel
            | Self::JointAcc
            | Self::JointEffort
            | Self::DefaultJointPos
            | Self::LastAction
            | Self::PreviousAction => slots.joints.len(),
        }
    }

    /// `out` is zero where the robot has no such joint or foot.
    fn write(self, r: &RobotView, forces: &ContactForces, out: &mut [f32]) {
        let joints = |out: &mut [f32], values: &[f32]| {
            for slot in &r.morphology.slots {
                out[slot.column()] = slot.sign * values[slot.joint()];
            }
        };
        let actions = |out: &mut [f32], values: &[f32]| {
            for (slot, value) in r.morphology.slots.iter().zip(values) {
                out[slot.column()] = *value;
            }
        };
        let feet = |out: &mut [f32], values: &[[f32; 3]]| {
            for (column, value) in r.morphology.foot_columns.iter().zip(values) {
                out[3 * column..][..3].copy_from_slice(value);
            }
        };
        let by_foot = |out: &mut [f32], values: &[f32]| {
            for (column, value) in r.morphology.foot_columns.iter().zip(values) {
                out[*column] = *value;
            }
        };
        let origin = || r.ground.height_at(r.origin, [0.0; 2]);
        let about = |origin: f32, [x, y, z]: [f32; 3]| [x, y, z - origin];
        match self {
            Self::BasePos => out.copy_from_slice(&about(origin(), r.pose.position)),
            Self::BaseHeight => out[0] = r.base_height(),
            Self::BaseQuat => out.copy_from_slice(&r.pose.rotation),
            Self::BaseLinVel => out.copy_from_slice(&r.imu.linear_velocity),
            Self::BaseAngVel => out.copy_from_slice(&r.imu.angular_velocity),
            Self::ProjectedGravity => out.copy_from_slice(&r.imu.projected_gravity),
            Self::JointPos => joints(out, &r.joints.position),
            Self::JointVel => joints(out, &r.joints.velocity),
            Self::JointAcc => joints(out, &r.effort.acceleration),
            Self::JointEffort => joints(out, &r.effort.applied),
            Self::DefaultJointPos => joints(out, &r.stance.default_position),
            Self::ContactForces => feet(out, &forces.feet),
            Self::FeetPos => {
                let origin = origin();
                let positions: PerFoot<[f32; 3]> = r.feet.position.iter().map(|&foot| about(origin, foot)).collect();
                feet(out, &positions);
            }
            Self::FeetHeight => by_foot(out, &r.feet.height),
            Self::FeetVel => feet(out, &r.feet.velocity),
            Self::FeetAirTime => by_foot(out, &r.contacts.air_time),
            Self::FeetContactTime => by_foot(out, &r.contacts.contact_time),
            Self::Command => out.copy_from_slice(r.command),
            Self::LastAction => actions(out, &r.action.current),
            Self::PreviousAction => actions(out, &r.action.previous),
            Self::Valid => out.fill(1.0),
        }
    }
}

/// Writes one quantity of all robots, row-major `[num_envs, width]`. A broken state is written as
/// zeros.
pub(crate) fn gather_state(world: &mut World, field: StateField, out: &mut [f32]) -> Result<(), Error> {
    faults::outcome(world.run_system_cached_with(gather, (field, out)))
}

fn gather(
    (In(field), InMut(out)): (In<StateField>, InMut<[f32]>),
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    views: ViewParam,
    robots: Blocks<&'static ContactForces, Robot>,
    envs: Blocks<&'static Episode, Env>,
) -> Result {
    let out = MatrixRows { data: out, width: field.width(&morphologies.1) };
    let blocks = views.views(task.step_dt)?.zip(robots.read()?).zip(envs.read()?).zip_envs(out);
    blocks.for_each_chunk(&workers, |Block { envs, rows: (((views, forces), episodes), mut out), .. }| {
        for i in 0..envs.len() {
            out.row(i).fill(0.0);
            if !episodes[i].invalid {
                field.write(&views.get(i), &forces[i], out.row(i));
            }
        }
    });
    Ok(())
}
