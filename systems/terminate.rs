//! Terminations: ends of episodes and their causes.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::groups::BodiesInContact;
use super::terms::{CompiledTask, NoParams, Registry};
use super::view::RobotView;
use super::views::ViewParam;
use super::{ControlStep, PipelineSet};
use crate::batch::Batch;
use crate::blocks::{Block, Blocks};
use crate::components::{Env, Episode};
use crate::config::quantities::{Coordinate, Factor, ForceThreshold, Quantity, Tilt as TiltRange};
use crate::config::values;
use crate::engine::StateLimits;
use crate::engine::device::FormKind;
use crate::options::Autoreset;
use crate::robot::BodyGroup;
use crate::workers::Workers;

/// Ends episodes.
#[derive(Default)]
pub struct TerminatePlugin;

impl Plugin for TerminatePlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(ControlStep, end_episodes.in_set(PipelineSet::Terminate));
    }
}

/// Advances episodes and asks every termination term.
///
/// Under [`Autoreset::NextStep`] an env that ended before is only reset in this step: it neither
/// ends nor advances.
pub(super) fn end_episodes(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    views: ViewParam,
    mut batch: ResMut<Batch>,
    mut envs: Blocks<&'static mut Episode, Env>,
) -> Result {
    let batch = &mut *batch;
    let flags = (&mut batch.terminated[..], &mut batch.truncated[..]);
    let blocks = views.views(task.step_dt)?.zip(envs.write()?).zip_envs(flags);
    blocks.for_each_chunk(&workers, |Block { envs, rows: ((views, episodes), (terminated, truncated)), .. }| {
        for i in 0..envs.len() {
            let episode = &mut episodes[i];
            episode.fresh = false;
            let view = views.get(i);
            let pending = *autoreset == Autoreset::NextStep && episode.needs_reset;
            if pending {
                (episode.terminated, episode.truncated) = (false, false);
            } else {
                episode.length += 1;
                episode.lived += 1;
                episode.invalid = !is_allowed(&task.limits, &view);
                episode.terminated = episode.invalid;
                episode.causes = u32::from(episode.invalid);
                episode.truncated = false;
                for (bit, term) in task.terminations.iter().enumerate() {
                    if (term.ends)(&view, episode, task.max_episode_length) {
                        episode.causes |= 1 << (bit + 1);
                        if term.time_out {
                            episode.truncated = true;
                        } else {
                            episode.terminated = true;
                        }
                    }
                }
                // an episode that fails in its last step has failed
                episode.truncated &= !episode.terminated;
                episode.needs_reset = episode.done();
            }
            terminated[i] = episode.terminated;
            truncated[i] = episode.truncated;
        }
    });
    Ok(())
}

/// Whether the state is finite and within the limits.
#[inline(always)]
fn is_allowed(limits: &StateLimits, view: &RobotView) -> bool {
    let numbers = [
        &view.pose.position[..],
        &view.pose.rotation,
        &view.velocity.linear,
        &view.velocity.angular,
        &view.joints.position,
        &view.joints.velocity,
        &view.effort.applied,
    ];
    // all of a quantity's numbers at once
    let within = |limit: f32, xs: &[f32]| xs.iter().fold(true, |all, x| all & (x.abs() <= limit));
    limits.of_quantities().into_iter().zip(numbers).all(|((_, limit), xs)| within(limit, xs))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ContactThreshold {
    /// Normal force that ends the episode, N.
    #[serde(deserialize_with = "values::number_of::<ForceThreshold, _, _>")]
    threshold: f32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Tilt {
    /// Angle between the base's z axis and the direction against gravity that ends the episode,
    /// rad.
    limit_angle: Angle,
}

/// An angle, rad.
#[derive(Deserialize)]
#[serde(try_from = "f64")]
struct Angle {
    cos: f32,
}

impl TryFrom<f64> for Angle {
    type Error = String;

    fn try_from(angle: f64) -> Result<Self, String> {
        let (least, most) = (TiltRange::LEAST, TiltRange::MOST);
        if !(least..=most).contains(&angle) {
            return Err(format!("{angle} is no such angle; write one from {least} to pi, rad"));
        }
        // a cosine in double precision is the same single number on every machine
        Ok(Self { cos: angle.cos() as f32 })
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LeastHeight {
    /// Height of the base below which the episode ends, m. Default: `minimum_share`.
    #[serde(default, deserialize_with = "values::optional_of::<Coordinate, _, _>")]
    minimum_height: Option<f32>,
    /// Least height as a share of the robot's height in its default pose, so that robots of all
    /// sizes share a task: see
    /// [`MorphologyModel::least_height`](crate::morphology::MorphologyModel::least_height).
    #[serde(default = "half", deserialize_with = "values::number_of::<Factor, _, _>")]
    minimum_share: f32,
}

fn half() -> f32 {
    0.5
}

/// All built-in terminations, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    // The episode has lasted `sim.episode_length_s`; a truncation.
    registry.termination("time_out", true, |_: &NoParams, _, episode, most| episode.length >= most);
    registry.termination("base_contact", false, base_contact);
    registry.termination("illegal_contact", false, illegal_contact);
    registry.termination("bad_orientation", false, bad_orientation);
    registry.termination("root_height_below_minimum", false, root_height_below_minimum);
    on_device(registry);
}

/// The numbers of these terms in `device/env.h`.
fn on_device(registry: &mut Registry) {
    registry.on_device(FormKind::End, "time_out", |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
    registry.on_device(FormKind::End, "base_contact", |p: ContactThreshold, _| {
        Some((vec![p.threshold], Some(vec![BodyGroup::Base as i32, BodyGroup::Torso as i32])))
    });
    registry.on_device(FormKind::End, "illegal_contact", |p: BodiesInContact, _| Some(p.lists()));
    registry
        .on_device(FormKind::End, "bad_orientation", |p: Tilt, _| Some((vec![p.limit_angle.cos], Some(Vec::new()))));
    registry.on_device(FormKind::End, "root_height_below_minimum", |p: LeastHeight, robot| {
        let has_height = f32::from(u8::from(p.minimum_height.is_some()));
        let numbers = vec![has_height, p.minimum_height.unwrap_or_default(), p.minimum_share, robot.hip_height];
        Some((numbers, Some(Vec::new())))
    });
}

/// A body of the groups touches with more than the threshold, N.
fn illegal_contact(p: &BodiesInContact, view: &RobotView, _: &Episode, _: u32) -> bool {
    let bodies = view.contacts.peak_force.iter().zip(&view.morphology.body_groups);
    bodies.into_iter().any(|(force, group)| *force > p.threshold && p.bodies.contains(group))
}

/// The base leans more than the limit.
fn bad_orientation(p: &Tilt, view: &RobotView, _: &Episode, _: u32) -> bool {
    let gravity = view.imu.projected_gravity;
    // the angle of gravity from the base's downward axis, without an inverse cosine; without
    // gravity there is no vertical
    -gravity[2] < p.limit_angle.cos && gravity != [0.0; 3]
}

/// The base is lower than the least height.
fn root_height_below_minimum(p: &LeastHeight, view: &RobotView, _: &Episode, _: u32) -> bool {
    let default = view.default_height();
    let least = p.minimum_height.unwrap_or_else(|| view.morphology.least_height(p.minimum_share, default));
    view.base_height() < least
}

/// The base or the torso touches with more than the threshold, N.
fn base_contact(p: &ContactThreshold, view: &RobotView, _: &Episode, _: u32) -> bool {
    let bodies = view.contacts.peak_force.iter().zip(&view.morphology.body_groups);
    bodies.into_iter().any(|(force, group)| matches!(group, BodyGroup::Base | BodyGroup::Torso) && *force > p.threshold)
}
