//! Rewards: the weighted sum of the terms of each robot's own reward set.

mod command_terms;
mod contact_terms;
mod gait_terms;
mod joint_terms;
mod jump_terms;
mod motion_terms;
mod placement_terms;
mod posture_terms;
mod scaled_terms;

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;

use super::terms::{CompiledTask, Registry, RewardTerm};
use super::view::RobotView;
use super::views::ViewParam;
use super::{ControlStep, PipelineSet};
use crate::batch::Batch;
use crate::blocks::{Block, Blocks};
use crate::components::{CurriculumProgress, Env, Episode, EpisodeSums};
use crate::options::Autoreset;
use crate::workers::Workers;

/// Computes rewards.
#[derive(Default)]
pub struct RewardPlugin;

impl Plugin for RewardPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(ControlStep, compute_rewards.in_set(PipelineSet::Reward));
    }
}

/// `reward = sum of weight * value * step_dt`, summed per term for the logs, as are the tracking
/// errors.
///
/// A robot computes only the terms of its own set. An env gets 0 if its state broke or if this step
/// does nothing but reset it.
pub(super) fn compute_rewards(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    views: ViewParam,
    mut batch: ResMut<Batch>,
    mut envs: Blocks<(&'static Episode, &'static CurriculumProgress, &'static mut EpisodeSums), Env>,
) -> Result {
    let blocks = views.views(task.step_dt)?.zip(envs.write()?).zip_envs(&mut batch.rewards[..]);
    blocks.for_each_chunk(
        &workers,
        |Block { morphology, envs, rows: ((views, (episodes, progress, sums)), rewards) }| {
            let terms = &task.rewards[usize::from(morphology.0)];
            // without them, the search costs as much as a cheap term
            let scheduled = terms.iter().any(RewardTerm::is_scheduled);
            for i in 0..envs.len() {
                let episode = &episodes[i];
                let resetting = *autoreset == Autoreset::NextStep && episode.needs_reset && !episode.done();
                if episode.invalid || resetting {
                    rewards[i] = 0.0;
                    continue;
                }
                let view = RobotView { terminated: episode.terminated, ..views.get(i) };
                let sums = &mut sums[i];
                sums.add_errors(&view);
                let mut total = 0.0;
                for (term, sum) in terms.iter().zip(sums.terms.iter_mut()) {
                    let weight = if scheduled { term.weight_at(progress[i].steps) } else { term.weight };
                    let value = weight * (term.value)(&view, workers.dispatch()) * task.step_dt;
                    *sum += value;
                    total += value;
                }
                sums.reward += total;
                rewards[i] = total;
            }
        },
    );
    Ok(())
}

/// All built-in reward terms, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    motion_terms::register(registry);
    joint_terms::register(registry);
    contact_terms::register(registry);
    gait_terms::register(registry);
    command_terms::register(registry);
    placement_terms::register(registry);
    jump_terms::register(registry);
    posture_terms::register(registry);
    scaled_terms::register(registry);
}

/// Sum of squares.
#[inline(always)]
fn sum_of_squares(x: &[f32]) -> f32 {
    x.iter().fold(0.0, |sum: f32, &x| x.mul_add(x, sum))
}

/// Planar speed up to which a robot is told to stand, m/s, and yaw rate where turns count, rad/s.
const STANDING: f32 = 0.1;

/// Whether a velocity command tells a robot to stand. A pure turn does, unless `turning` counts.
#[inline(always)]
fn stands(command: &[f32], turning: bool) -> bool {
    norm(&command[..2]) <= STANDING && !(turning && command[2].abs() > STANDING)
}

/// Euclidean norm.
#[inline(always)]
fn norm(x: &[f32]) -> f32 {
    sum_of_squares(x).sqrt()
}
