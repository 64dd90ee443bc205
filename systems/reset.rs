//! Reset of ended episodes.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::ResetRequest;
use super::command::{draw_command, heading, steer};
use super::commanded::CommandedRobot;
use super::disturb::{EXTERNAL_WRENCH, WrenchRanges};
use super::place::place_robots;
use super::startup::is_due;
use super::terms::{ACTION_DELAY, ActionDelay, CompiledTask, EpisodeEnd, NoParams, Registry};
use super::view::NewState;
use super::{ResetSet, for_both, startup};
use crate::blocks::{Block, Blocks};
use crate::components::{
    Action, ActuatorDelay, ActuatorMemory, BasePose, BaseVelocity, Body, Command, CommandNumbers, ConstraintImpulses,
    ContactForces, CurriculumProgress, Env, EnvOrigin, EnvRng, Episode, EpisodeSums, EventTimers, ExternalWrench,
    JointEffort, JointState, JointTargets, LinkForces, Robot, Stance,
};
use crate::config::quantities::{Angle, Coordinate, Turns};
use crate::config::{JointPositionMode, values};
use crate::engine::device::FormKind;
use crate::morphology::Morphologies;
use crate::options::Autoreset;
use crate::robot::soft_limits;
use crate::workers::Workers;
use crate::world::Ground;

/// Begins new episodes.
#[derive(Default)]
pub struct ResetPlugin;

impl Plugin for ResetPlugin {
    fn build(&self, app: &mut App) {
        for_both(app, || {
            (
                startup::reset_bodies.in_set(ResetSet::Bodies),
                reset_envs.in_set(ResetSet::Envs),
                place_robots.in_set(ResetSet::Place),
            )
        });
    }
}

/// Components of robots that a reset reads and writes.
type RobotColumns = (
    &'static Body,
    &'static Stance,
    &'static mut BasePose,
    &'static mut BaseVelocity,
    &'static mut JointState,
    &'static mut Action,
    &'static mut JointTargets,
    &'static mut ActuatorDelay,
    &'static mut ActuatorMemory,
    &'static mut JointEffort,
    &'static mut ConstraintImpulses,
    &'static mut ContactForces,
    &'static mut ExternalWrench,
    &'static mut LinkForces,
);

/// Components of envs that a reset writes.
type EnvColumns = (
    &'static mut Episode,
    &'static mut EnvRng,
    &'static mut Command,
    &'static mut CommandNumbers,
    &'static mut CurriculumProgress,
    &'static mut EventTimers,
    &'static mut EpisodeSums,
    &'static mut EnvOrigin,
);

/// Resets the envs that are due: state, targets, delays, timers, sums and command, each from the
/// env's own stream.
///
/// Quantities of a physics step (efforts, accelerations, contact forces, impulses) are zero: none
/// has been made. [`place_robots`] and [`Sensor::begin`](super::Sensor::begin) then compute the
/// quantities that follow from the new state.
pub(super) fn reset_envs(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    request: Res<ResetRequest>,
    ground: Res<Ground>,
    mut robots: Blocks<RobotColumns, Robot>,
    mut envs: Blocks<EnvColumns, Env>,
) -> Result {
    robots.write()?.zip(envs.write()?).for_each_chunk(&workers, |Block { morphology, envs, rows }| {
        let (robots, (episodes, rngs, commands, other_commands, progress, timers, sums, origins)) = rows;
        let (
            bodies,
            stances,
            poses,
            velocities,
            joints,
            actions,
            targets,
            delays,
            memories,
            efforts,
            impulses,
            forces,
            wrenches,
            link_forces,
        ) = robots;
        let robot = usize::from(morphology.0);
        let (command_config, command_ranges) = (&task.commands[robot], &task.velocity_ranges[robot]);
        let morphology = morphologies.get(morphology);
        for i in 0..envs.len() {
            if !is_due(&episodes[i], *autoreset, *request) {
                continue;
            }
            let (rng, stance) = (&mut rngs[i], &stances[i]);
            let (pose, velocity, joints) = (&mut poses[i], &mut velocities[i], &mut joints[i]);
            let origin = &mut origins[i];
            // a caller's reset in the middle of an episode says nothing of the robot
            if episodes[i].lived > 0 && (episodes[i].done() || !request.0) {
                let episode = &episodes[i];
                let seconds = |steps: u32| steps as f32 * task.step_dt;
                // the time that a fall cuts off counts as the robot's
                let left = match task.has_failed(episode.causes) {
                    true => task.max_episode_length.saturating_sub(episode.length),
                    false => 0,
                };
                let mut end = EpisodeEnd {
                    episode,
                    pose,
                    command: &commands[i],
                    sums: &sums[i],
                    robot,
                    task: &task,
                    progress: &mut progress[i],
                    episode_length_s: seconds(task.max_episode_length),
                    lived_s: seconds(episode.lived),
                    given_s: seconds(episode.lived + left),
                    layout: ground.layout.as_ref(),
                    origin,
                };
                for term in &task.curriculum {
                    term(&mut end, rng);
                }
            }
            *pose = BasePose { position: [0.0, 0.0, stance.spawn_height], rotation: [1.0, 0.0, 0.0, 0.0] };
            *velocity = BaseVelocity::default();
            joints.position.copy_from_slice(&stance.default_position);
            joints.velocity.fill(0.0);
            let (delay, wrench) = (&mut delays[i], &mut wrenches[i]);
            delay.0.fill(0.0);
            memories[i].0.fill(0.0);
            for (range, group) in &morphology.delays {
                let steps = rng.integer(*range) as f32;
                for &joint in group {
                    delay.0[joint] = steps;
                }
            }
            *wrench = ExternalWrench::default();
            link_forces[i].0.clear();
            let body = &*bodies[i].0;
            for event in &task.reset_events {
                event(&mut NewState { morphology, pose, velocity, joints, delay, wrench, body }, rng);
            }
            actions[i].clear();
            for past in &mut targets[i].history {
                past.copy_from_slice(&stance.default_position);
            }
            targets[i].fresh = true;
            efforts[i].clear();
            impulses[i].contacts.clear();
            impulses[i].bounds.fill(0.0);
            forces[i].clear();

            for (event, left) in task.interval_events.iter().zip(timers[i].0.iter_mut()) {
                *left = rng.uniform(event.range_s);
            }
            if !commands[i].pinned && task.has_velocity_command() {
                let ranges = command_ranges.at(&progress[i]);
                draw_command(command_config, ranges, &mut commands[i], rng);
                steer(command_config, ranges[2], &mut commands[i], heading(&pose.rotation));
            }
            task.draw_commands(robot, &CommandedRobot { morphology, pose }, &mut other_commands[i], rng);
            sums[i].clear();
            episodes[i] = Episode { fresh: true, ..Episode::default() };
        }
    });
    Ok(())
}

impl EpisodeSums {
    fn clear(&mut self) {
        self.terms.fill(0.0);
        let terms = std::mem::take(&mut self.terms);
        *self = Self { terms, ..Self::default() };
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BaseRange {
    /// Range of the base's position, m.
    #[serde(deserialize_with = "values::range_of::<Coordinate, _, _>")]
    x: [f32; 2],
    /// Range of y, like `x`.
    #[serde(deserialize_with = "values::range_of::<Coordinate, _, _>")]
    y: [f32; 2],
    /// Range of its heading, rad.
    #[serde(deserialize_with = "values::range_of::<Angle, _, _>")]
    yaw: [f32; 2],
    /// Range of its roll, rad; -pi to pi with the same pitch reaches all directions. Default: 0.
    #[serde(default, deserialize_with = "values::optional_range_of::<Angle, _, _>")]
    roll: Option<[f32; 2]>,
    /// Range of its pitch, rad. Default: 0.
    #[serde(default, deserialize_with = "values::optional_range_of::<Angle, _, _>")]
    pitch: Option<[f32; 2]>,
}

/// All built-in reset events.
pub(super) fn register(registry: &mut Registry) {
    registry.reset_event("reset_base", reset_base);
    registry.reset_event("reset_joints", reset_joints);
    registry.reset_event("reset_joints_within_limits_range", reset_joints_within_limits);
    // A random force and torque on the base, until the next reset or event.
    registry.reset_event(EXTERNAL_WRENCH, |p: &WrenchRanges, state, rng| {
        *state.wrench = p.draw(state.morphology, rng);
    });
    // A random delay of the targets, in whole physics steps, on top of the actuators' own.
    registry.reset_event(ACTION_DELAY, |p: &ActionDelay, state, rng| {
        let steps = rng.integer(p.range(state.morphology)) as f32;
        state.delay.0.iter_mut().for_each(|delay| *delay += steps);
    });
    on_device(registry);
}

/// The numbers of these events in `device/env.h`.
fn on_device(registry: &mut Registry) {
    registry.on_device(FormKind::Reset, "reset_base", |p: BaseRange, _| {
        let ranges = [p.x, p.y, p.yaw, p.roll.unwrap_or_default(), p.pitch.unwrap_or_default()];
        Some((ranges.as_flattened().to_vec(), Some(vec![i32::from(p.roll.is_some() || p.pitch.is_some())])))
    });
    registry.on_device(FormKind::Reset, "reset_joints", |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
    registry.on_device(FormKind::Reset, "reset_joints_within_limits_range", |p: WithinLimits, _| {
        Some((p.position_range.to_vec(), Some(Vec::new())))
    });
    registry.on_device(FormKind::Reset, EXTERNAL_WRENCH, |p: WrenchRanges, robot| Some(p.lists(robot)));
    registry.on_device(FormKind::Reset, ACTION_DELAY, |p: ActionDelay, robot| {
        Some((Vec::new(), Some(p.range(robot).map(|steps| steps as i32).to_vec())))
    });
}

/// Position, heading, roll and pitch from the task's ranges, velocity from the robot's.
fn reset_base(p: &BaseRange, state: &mut NewState, rng: &mut EnvRng) {
    state.pose.position[0] += rng.uniform(p.x);
    state.pose.position[1] += rng.uniform(p.y);
    let (sin, cos) = crate::dynamics::lanes::Real::sin_cos(0.5 * rng.uniform(p.yaw));
    state.pose.rotation = [cos, 0.0, 0.0, sin];
    if p.roll.is_some() || p.pitch.is_some() {
        // roll about the base's x axis, after pitch about its y axis, after yaw
        let mut half = |range: Option<[f32; 2]>| {
            crate::dynamics::lanes::Real::sin_cos(0.5 * rng.uniform(range.unwrap_or_default()))
        };
        let ((sr, cr), (sp, cp)) = (half(p.roll), half(p.pitch));
        state.pose.rotation = [
            cos * cp * cr + sin * sp * sr,
            cos * cp * sr - sin * sp * cr,
            cos * sp * cr + sin * cp * sr,
            sin * cp * cr - cos * sp * sr,
        ];
    }
    let range = state.morphology.config.reset.base_velocity.range.map(|x| x as f32);
    state.velocity.linear = std::array::from_fn(|_| rng.uniform(range));
    let world: [f32; 3] = std::array::from_fn(|_| rng.uniform(range));
    let rotation = crate::dynamics::math::quat_to_mat(&state.pose.rotation);
    state.velocity.angular = crate::dynamics::math::mul_vec_transposed(&rotation, &world);
}

/// Joints about the default pose, within the soft limits, from the robot's ranges.
fn reset_joints(_: &NoParams, state: &mut NewState, rng: &mut EnvRng) {
    let config = &state.morphology.config.reset;
    let position = config.joint_position.range.map(|x| x as f32);
    let velocity = config.joint_velocity.range.map(|x| x as f32);
    let share = config.soft_limit_factor as f32;
    for (j, q) in state.joints.position.iter_mut().enumerate() {
        let drawn = rng.uniform(position);
        let moved = match config.joint_position.mode {
            JointPositionMode::Scale => *q * drawn,
            JointPositionMode::Offset => *q + drawn,
        };
        let [lower, upper] = soft_limits([state.body.lower[j], state.body.upper[j]], share);
        *q = moved.max(lower).min(upper);
    }
    for v in &mut state.joints.velocity {
        *v = rng.uniform(velocity);
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WithinLimits {
    /// Share of the way from the lower to the upper soft limit, drawn for each joint. Default: all
    /// of it.
    #[serde(default = "all", deserialize_with = "values::range_of::<Turns, _, _>")]
    position_range: [f32; 2],
}

fn all() -> [f32; 2] {
    [0.0, 1.0]
}

/// Joints anywhere between their soft limits, at rest. A joint without two limits keeps its
/// position.
fn reset_joints_within_limits(p: &WithinLimits, state: &mut NewState, rng: &mut EnvRng) {
    let share = state.morphology.config.reset.soft_limit_factor as f32;
    for (j, q) in state.joints.position.iter_mut().enumerate() {
        let drawn = rng.uniform(p.position_range);
        let [lower, upper] = soft_limits([state.body.lower[j], state.body.upper[j]], share);
        if (upper - lower).is_finite() {
            *q = (upper - lower).mul_add(drawn, lower);
        }
    }
    state.joints.velocity.fill(0.0);
}
