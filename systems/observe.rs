//! Observations: the terms of the policy's observation, side by side, with their noise.

use bevy_ecs::prelude::*;

use super::terms::{CompiledTask, NoParams, Registry};
use super::view::{RobotView, ViewParam, Views};
use super::{Autoreset, ResetRequest};
use crate::batch::Batch;
use crate::components::{Env, EnvRng, Episode};
use crate::rows::{MatrixRows, Workers, read_rows, write_rows};

/// Observes all envs; after resets that the caller asked for only those that were reset, so that the others keep their
/// observation and their random streams.
pub(super) fn observe(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    request: Res<ResetRequest>,
    views: ViewParam,
    episodes: Query<&'static Episode>,
    mut batch: ResMut<Batch>,
    mut rngs: Query<&'static mut EnvRng, With<Env>>,
) {
    let views = views.views(task.step_dt);
    let width = batch.num_obs;
    let out = MatrixRows { data: &mut batch.observations[..], width };
    let rows = (read_rows(&episodes), write_rows(&mut rngs), out);
    workers.for_each_chunk(rows, views.len(), |first, n, (episodes, rngs, mut out)| {
        for i in 0..n {
            if request.0 && !episodes[i].fresh {
                continue;
            }
            write_observation(&task, &views, first + i, &episodes[i], &mut rngs[i], out.row(i));
        }
    });
}

/// Observes the envs whose episode has just ended and that are about to be reset.
pub(super) fn observe_final(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    request: Res<ResetRequest>,
    views: ViewParam,
    episodes: Query<&'static Episode>,
    mut batch: ResMut<Batch>,
    mut rngs: Query<&'static mut EnvRng, With<Env>>,
) {
    let wanted = *autoreset == Autoreset::SameStep && !request.0;
    let views = views.views(task.step_dt);
    let width = batch.num_obs;
    let batch = &mut *batch;
    let out = MatrixRows { data: &mut batch.final_observations[..], width };
    let rows = (read_rows(&episodes), write_rows(&mut rngs), out, &mut batch.has_final[..]);
    workers.for_each_chunk(rows, views.len(), |first, n, (episodes, rngs, mut out, has_final)| {
        for i in 0..n {
            has_final[i] = wanted && episodes[i].done();
            if has_final[i] {
                write_observation(&task, &views, first + i, &episodes[i], &mut rngs[i], out.row(i));
            }
        }
    });
}

/// A broken state is observed as zeros: no NaN reaches a learner.
fn write_observation(
    task: &CompiledTask,
    views: &Views,
    env: usize,
    episode: &Episode,
    rng: &mut EnvRng,
    out: &mut [f32],
) {
    if episode.invalid {
        out.fill(0.0);
        return;
    }
    let view = views.get(env);
    let mut rest = out;
    for term in &task.observations {
        let (mine, more) = rest.split_at_mut(term.size);
        (term.write)(&view, mine);
        if term.noise > 0.0 {
            for x in mine {
                *x += rng.uniform([-term.noise, term.noise]);
            }
        }
        rest = more;
    }
}

/// All built-in observation terms, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    registry.observation("base_lin_vel", 3, |_: &NoParams, r, out| out.copy_from_slice(&r.imu.linear_velocity));
    registry.observation("base_ang_vel", 3, |_: &NoParams, r, out| out.copy_from_slice(&r.imu.angular_velocity));
    registry.observation("projected_gravity", 3, |_: &NoParams, r, out| out.copy_from_slice(&r.imu.projected_gravity));
    registry.observation("velocity_commands", 3, |_: &NoParams, r, out| out.copy_from_slice(r.command));
    registry.observation("joint_pos_rel", 12, |_: &NoParams, r, out| {
        by_slot(r, out, |j| r.joints.position[j] - r.morphology.default_position[j]);
    });
    registry.observation("joint_vel_rel", 12, |_: &NoParams, r, out| by_slot(r, out, |j| r.joints.velocity[j]));
    registry.observation("last_action", 12, |_: &NoParams, r, out| out.copy_from_slice(&r.action.current));
}

/// Physical joints in canonical order.
fn by_slot(r: &RobotView, out: &mut [f32], f: impl Fn(usize) -> f32) {
    for (x, &joint) in out.iter_mut().zip(&r.morphology.joint_of_slot) {
        *x = f(joint);
    }
}
