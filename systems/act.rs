//! Actions become joint position targets.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;

use super::{ControlStep, PipelineSet};
use crate::batch::Batch;
use crate::blocks::{Block, Blocks};
use crate::components::{Action, JointTargets, Robot, Stance};
use crate::dynamics::lanes::Kernel;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::workers::{MatrixRows, Workers};

/// Turns actions into joint targets.
#[derive(Default)]
pub struct ActPlugin;

impl Plugin for ActPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(ControlStep, apply_actions.in_set(PipelineSet::Act));
    }
}

/// `target = default + scale * sign * action`, from slots to physical joints; the targets before
/// become history. Actions in columns of slots that a robot lacks, or that the task does not drive,
/// become zero.
///
/// Joints that the task does not drive keep the default pose as their target: a reset writes it to
/// the whole history.
///
/// The first action after a reset fills the whole history, so that a delayed actuator does not see
/// an older episode.
pub(super) fn apply_actions(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    mut batch: ResMut<Batch>,
    mut robots: Blocks<(&'static Stance, &'static mut Action, &'static mut JointTargets), Robot>,
) -> Result {
    let width = batch.num_actions;
    let raw = MatrixRows { data: &mut batch.actions[..], width };
    robots.write()?.zip_envs(raw).vectorize_chunks(&workers, |Block { morphology, rows, .. }| {
        let ((stances, actions, targets), raw) = rows;
        ActionRows { morphology: morphologies.get(morphology), stances, actions, targets, raw }
    });
    Ok(())
}

struct ActionRows<'a> {
    morphology: &'a MorphologyModel,
    stances: &'a [Stance],
    actions: &'a mut [Action],
    targets: &'a mut [JointTargets],
    raw: MatrixRows<'a, f32>,
}

impl Kernel<f32> for ActionRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { morphology, stances, actions, targets, mut raw } = self;
        let absent: Vec<usize> = (morphology.action_mask(raw.width).iter().enumerate())
            .filter_map(|(column, is_there)| (!is_there).then_some(column))
            .collect();
        for (i, stance) in stances.iter().enumerate() {
            let action = &mut actions[i];
            std::mem::swap(&mut action.current, &mut action.previous);
            let raw = raw.row(i);
            for (current, slot) in action.current.iter_mut().zip(&morphology.slots) {
                *current = raw[slot.column()];
            }
            for &column in &absent {
                raw[column] = 0.0;
            }
            let target = &mut targets[i];
            target.history.rotate_right(1);
            let Some((newest, older)) = target.history.split_first_mut() else {
                continue;
            };
            let (newest, default) = (&mut newest[..], &stance.default_position[..]);
            for (&action, slot) in action.current.iter().zip(&morphology.slots) {
                newest[slot.joint()] = stance.action_scale.mul_add(slot.sign * action, default[slot.joint()]);
            }
            if std::mem::take(&mut target.fresh) {
                for past in older {
                    past.copy_from_slice(newest);
                }
            }
        }
    }
}
