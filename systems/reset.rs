//! Ended episodes begin anew.

use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::command::{draw_command, steer};
use super::curriculum::EpisodeEnd;
use super::disturb::{EXTERNAL_WRENCH, WrenchRanges};
use super::sense::{ScanRays, measure};
use super::terms::{CompiledTask, NoParams, Registry};
use super::{Autoreset, ResetRequest};
use crate::components::{
    Action, ActuatorDelay, BasePose, BaseVelocity, Body, Command, ConstraintImpulses, ContactForces, ContactSensor,
    Env, EnvOrigin, EnvRng, Episode, EpisodeSums, EventTimers, ExternalWrench, Feet, HeightScan, Imu, JointEffort,
    JointState, JointTargets, Morphology, Robot, Stance,
};
use crate::config::JointPositionMode;
use crate::dynamics::Parameters;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::rows::{OptionalRows, Workers, read_rows, write_rows};
use crate::world::Ground;

/// The state in which an episode begins, as reset events may change it.
pub struct NewState<'a> {
    /// What kind of robot it is.
    pub morphology: &'a MorphologyModel,
    /// Pose of the base; starts at the env's origin, at the spawn height, level. Afterwards it is lifted onto
    /// what stands there.
    pub pose: &'a mut BasePose,
    /// Velocity of the base; starts at rest.
    pub velocity: &'a mut BaseVelocity,
    /// Joints; start at rest in the default pose.
    pub joints: &'a mut JointState,
    /// How late each joint's targets come; starts as the actuators' own delays.
    pub delay: &'a mut ActuatorDelay,
    /// Force and torque from outside; start at zero.
    pub wrench: &'a mut ExternalWrench,
    /// The robot's own numbers.
    pub body: &'a Parameters<f32>,
}

type RobotRows<'w, 's> = (
    Query<'w, 's, &'static mut BasePose>,
    Query<'w, 's, &'static mut BaseVelocity>,
    Query<'w, 's, &'static mut JointState>,
    Query<'w, 's, &'static mut Action>,
    Query<'w, 's, &'static mut JointTargets>,
    Query<'w, 's, &'static mut ActuatorDelay>,
    Query<'w, 's, &'static mut JointEffort>,
    Query<'w, 's, &'static mut ConstraintImpulses>,
    Query<'w, 's, &'static mut Feet>,
    Query<'w, 's, &'static mut ExternalWrench>,
);

type EnvRows<'w, 's> = (
    Query<'w, 's, &'static mut Episode>,
    Query<'w, 's, &'static mut EnvRng, With<Env>>,
    Query<'w, 's, &'static mut Command>,
    Query<'w, 's, &'static mut EventTimers>,
    Query<'w, 's, &'static mut EpisodeSums>,
    Query<'w, 's, &'static mut EnvOrigin>,
);

type SensorRows<'w, 's> = (
    Query<'w, 's, &'static mut ContactForces>,
    Query<'w, 's, &'static mut ContactSensor>,
    Query<'w, 's, &'static mut Imu>,
    Query<'w, 's, &'static mut HeightScan>,
);

/// Half the side of the square about the base's origin in which a robot begins above everything, m.
const FOOTPRINT: f32 = 0.5;

/// Whether an env is reset now: in the schedule that `request` tells of.
pub(super) fn is_due(episode: &Episode, autoreset: Autoreset, request: ResetRequest) -> bool {
    episode.needs_reset
        && (request.0
            || match autoreset {
                Autoreset::SameStep => true,
                Autoreset::NextStep => !episode.done(),
                Autoreset::Disabled => false,
            })
}

/// Resets what is due: state, targets, delays, timers, sums, sensors and command, each from the env's own stream.
pub(super) fn reset_envs(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    request: Res<ResetRequest>,
    (ground, rays): (Res<Ground>, Res<ScanRays>),
    tags: Query<&'static Morphology, With<Robot>>,
    bodies: Query<&'static Body>,
    stances: Query<&'static Stance>,
    (
        mut poses,
        mut velocities,
        mut joints,
        mut actions,
        mut targets,
        mut delays,
        mut efforts,
        mut impulses,
        mut feet,
        mut wrenches,
    ): RobotRows,
    (mut episodes, mut rngs, mut commands, mut timers, mut sums, mut origins): EnvRows,
    (mut forces, mut contacts, mut imus, mut scans): SensorRows,
) {
    let tags = read_rows(&tags);
    let robot_rows = (
        (write_rows(&mut poses), write_rows(&mut velocities), write_rows(&mut joints)),
        (write_rows(&mut actions), write_rows(&mut targets), write_rows(&mut delays)),
        (write_rows(&mut efforts), write_rows(&mut impulses), write_rows(&mut feet), write_rows(&mut wrenches)),
    );
    let env_rows = (
        write_rows(&mut episodes),
        write_rows(&mut rngs),
        write_rows(&mut commands),
        write_rows(&mut timers),
        write_rows(&mut sums),
        write_rows(&mut origins),
    );
    let scans = OptionalRows(write_rows(&mut scans));
    let sensor_rows = (write_rows(&mut forces), write_rows(&mut contacts), write_rows(&mut imus), scans);
    let rows = (tags, (read_rows(&bodies), read_rows(&stances)), robot_rows, env_rows, sensor_rows);
    workers.for_each_chunk(rows, tags.len(), |_, n, (tags, (bodies, stances), robots, envs, sensors)| {
        let ((poses, velocities, joints), (actions, targets, delays), (efforts, impulses, feet, wrenches)) = robots;
        let (episodes, rngs, commands, timers, sums, origins) = envs;
        let (forces, contacts, imus, scans) = sensors;
        for i in 0..n {
            if !is_due(&episodes[i], *autoreset, *request) {
                continue;
            }
            let morphology = morphologies.get(tags[i]);
            let (rng, stance) = (&mut rngs[i], &stances[i]);
            let (pose, velocity, joints) = (&mut poses[i], &mut velocities[i], &mut joints[i]);
            let origin = &mut origins[i];
            if episodes[i].length > 0 {
                let mut end = EpisodeEnd {
                    episode: &episodes[i],
                    pose,
                    command: &commands[i],
                    episode_length_s: task.max_episode_length as f32 * task.step_dt,
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
            for (range, group) in &morphology.delays {
                let steps = rng.integer(*range) as f32;
                for &joint in group {
                    delay.0[joint] = steps;
                }
            }
            *wrench = ExternalWrench::default();
            let body = &*bodies[i].0;
            for event in &task.reset_events {
                event(&mut NewState { morphology, pose, velocity, joints, delay, wrench, body }, rng);
            }
            if let Some(terrain) = &ground.terrain {
                let ([x, y, z], [x0, y0]) = (&mut pose.position, origin.position);
                *z += terrain.highest_near(x0 + *x, y0 + *y, FOOTPRINT) - ground.height as f32;
            }

            actions[i].current.fill(0.0);
            actions[i].previous.fill(0.0);
            for past in &mut targets[i].history {
                past.copy_from_slice(&stance.default_position);
            }
            targets[i].fresh = true;
            efforts[i].applied.fill(0.0);
            efforts[i].acceleration.fill(0.0);
            impulses[i].contacts.clear();
            impulses[i].bounds.fill(0.0);
            feet[i] = Feet::default();

            forces[i].clear();
            contacts[i].clear();
            imus[i] = measure(pose, velocity, &bodies[i].0.com[0]);
            if let Some(scan) = scans.0.get_mut(i) {
                rays.scan(&ground, origin, pose, scan);
            }

            for (event, left) in task.interval_events.iter().zip(timers[i].0.iter_mut()) {
                *left = rng.uniform(event.range_s);
            }
            let config = &task.config.commands.base_velocity;
            if !commands[i].pinned {
                draw_command(config, &mut commands[i], rng);
                steer(config, &mut commands[i], imus[i].heading);
            }
            sums[i].clear();
            episodes[i] = Episode { fresh: true, ..Episode::default() };
        }
    });
}

impl ContactSensor {
    fn clear(&mut self) {
        let mut peak_force = std::mem::take(&mut self.peak_force);
        peak_force.fill(0.0);
        *self = Self { peak_force, ..Self::default() };
    }
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
    x: [f32; 2],
    /// See `x`.
    y: [f32; 2],
    /// Range of its heading, rad.
    yaw: [f32; 2],
}

/// All built-in reset events.
pub(super) fn register(registry: &mut Registry) {
    registry.reset_event("reset_base", reset_base);
    registry.reset_event("reset_joints", reset_joints);
    registry.reset_event(EXTERNAL_WRENCH, |p: &WrenchRanges, state, rng| {
        *state.wrench = p.draw(state.morphology, rng);
    });
    registry.reset_event(ACTION_DELAY, |p: &ActionDelay, state, rng| {
        let steps = rng.integer(p.range(state.morphology)) as f32;
        state.delay.0.iter_mut().for_each(|delay| *delay += steps);
    });
}

/// The event that delays all targets of a robot.
pub(crate) const ACTION_DELAY: &str = "action_delay";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ActionDelay {
    /// Fewest and most physics steps, both included. Default: each robot's own range.
    #[serde(default, deserialize_with = "crate::config::values::optional_step_range")]
    delay_range: Option<[u32; 2]>,
}

impl ActionDelay {
    /// Fewest and most physics steps for a robot.
    pub(super) fn range(&self, morphology: &MorphologyModel) -> [u32; 2] {
        self.delay_range.unwrap_or(morphology.config.randomization.action_delay)
    }
}

/// Position and heading from the task's ranges, velocity from the robot's.
fn reset_base(p: &BaseRange, state: &mut NewState, rng: &mut EnvRng) {
    state.pose.position[0] += rng.uniform(p.x);
    state.pose.position[1] += rng.uniform(p.y);
    let (sin, cos) = crate::dynamics::Real::sin_cos(0.5 * rng.uniform(p.yaw));
    state.pose.rotation = [cos, 0.0, 0.0, sin];
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
        let (lower, upper) = (state.body.lower[j], state.body.upper[j]);
        let (middle, half) = (0.5 * (lower + upper), 0.5 * (upper - lower) * share);
        *q = moved.max(middle - half).min(middle + half);
    }
    for v in &mut state.joints.velocity {
        *v = rng.uniform(velocity);
    }
}
