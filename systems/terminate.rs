//! Which episodes end, and why.

use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::Autoreset;
use super::terms::{CompiledTask, NoParams, Registry};
use super::view::{RobotView, ViewParam};
use crate::batch::Batch;
use crate::components::Episode;
use crate::robot::BodyGroup;
use crate::rows::{Workers, write_rows};

/// Advances episodes and asks every termination term.
///
/// Under [`Autoreset::NextStep`] an env that ended before is only reset in this step: it neither ends nor advances.
pub(super) fn end_episodes(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    views: ViewParam,
    mut batch: ResMut<Batch>,
    mut episodes: Query<&'static mut Episode>,
) {
    let views = views.views(task.step_dt);
    let batch = &mut *batch;
    let rows = (write_rows(&mut episodes), &mut batch.terminated[..], &mut batch.truncated[..]);
    workers.for_each_chunk(rows, views.len(), |first, n, (episodes, terminated, truncated)| {
        for i in 0..n {
            let episode = &mut episodes[i];
            episode.fresh = false;
            let view = views.get(first + i);
            let pending = *autoreset == Autoreset::NextStep && episode.needs_reset;
            if pending {
                (episode.terminated, episode.truncated, episode.causes) = (false, false, 0);
            } else {
                episode.length += 1;
                episode.invalid = !task.limits.allow(&view);
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
}

/// Speeds beyond which a state counts as broken.
#[derive(Deserialize, Clone, Copy, Debug)]
#[serde(deny_unknown_fields, default)]
pub struct StateLimits {
    /// Of the base, m/s.
    pub max_lin_vel: f32,
    /// Of the base, rad/s.
    pub max_ang_vel: f32,
    /// Of any joint, rad/s.
    pub max_joint_vel: f32,
}

impl Default for StateLimits {
    fn default() -> Self {
        Self { max_lin_vel: 100.0, max_ang_vel: 200.0, max_joint_vel: 1000.0 }
    }
}

impl StateLimits {
    /// Whether the state is finite and within the limits.
    fn allow(&self, view: &RobotView) -> bool {
        // written so that a NaN fails
        let below = |xs: &[f32], limit: f32| xs.iter().all(|x| x.abs() <= limit);
        below(&view.pose.position, 1e6)
            && below(&view.pose.rotation, 2.0)
            && below(&view.velocity.linear, self.max_lin_vel)
            && below(&view.velocity.angular, self.max_ang_vel)
            && below(&view.joints.velocity, self.max_joint_vel)
            && below(&view.joints.position, 1e6)
            && below(&view.effort.applied, 1e9)
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ContactThreshold {
    /// Normal force that ends the episode, N.
    threshold: f32,
}

/// All built-in terminations, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    registry.termination("time_out", true, |_: &NoParams, _, episode, most| episode.length >= most);
    registry.termination("base_contact", false, base_contact);
}

fn base_contact(p: &ContactThreshold, view: &RobotView, _: &Episode, _: u32) -> bool {
    let bodies = view.contacts.peak_force.iter().zip(&view.morphology.body_groups);
    bodies.into_iter().any(|(force, group)| *group == BodyGroup::Base && *force > p.threshold)
}
