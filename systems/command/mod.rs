//! Commands: what a policy is asked for. A kind of command is a file of this folder and a line in
//! [`register`].
//!
//! A kind has columns, ranges, a resampling time, an observation term and reward terms. A task
//! names it in `[commands]`. The velocity command stands in the component [`Command`], all others
//! in [`CommandNumbers`].

pub(super) mod foot_placement;
pub(super) mod gait;
pub(super) mod heading;
pub(super) mod jump;
pub(super) mod pose;
pub(super) mod position;
mod velocity;

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use smallvec::smallvec;

use self::velocity::CommandRows;
pub(super) use self::velocity::{draw_command, heading, steer};
use super::commanded::{CommandKind, CommandSpec, CommandedRobot};
use super::terms::{CompiledTask, NoParams, Registry};
use super::{ControlStep, PipelineSet};
use crate::blocks::{Block, Blocks};
use crate::components::{BasePose, Command, CommandNumbers, CurriculumProgress, Env, EnvRng, Robot};
use crate::engine::device::FormKind;
use crate::workers::Workers;

/// Draws commands, and lets those that follow the robot or the time follow it.
#[derive(Default)]
pub struct CommandPlugin;

impl Plugin for CommandPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(
            ControlStep,
            (update_commands, update_other_commands, count_steps).chain().in_set(PipelineSet::Command),
        );
    }
}

/// All built-in kinds.
pub(super) fn register(registry: &mut Registry) {
    velocity::register(registry);
    pose::register(registry);
    heading::register(registry);
    position::register(registry);
    gait::register(registry);
    foot_placement::register(registry);
    jump::register(registry);
    let description = "no command; a task that asks for nothing may say so";
    registry.command("none", CommandSpec { columns: &[], description }, |NoParams {}, _| Ok(Nothing));
    registry.on_device(FormKind::Command, "none", |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
}

/// The kind without numbers.
struct Nothing;

impl CommandKind for Nothing {
    fn draw(&self, _: &CommandedRobot, _: &mut [f32], _: &mut EnvRng) {}
}

impl CompiledTask {
    /// Numbers of the commands of an env, before the first draw.
    pub(super) fn new_command_numbers(&self) -> CommandNumbers {
        let count = self.command_terms.last().map_or(0, |term| term.range.end);
        CommandNumbers {
            numbers: smallvec![0.0; count],
            time_left: smallvec![0.0; self.command_terms.len()],
            pinned: 0,
        }
    }

    /// Draws all commands other than the velocity that the caller has not set.
    pub(super) fn draw_commands(
        &self,
        index: usize,
        robot: &CommandedRobot,
        commands: &mut CommandNumbers,
        rng: &mut EnvRng,
    ) {
        for (bit, term) in self.command_terms.iter().enumerate() {
            if commands.pinned >> bit & 1 == 0 {
                term.draw(index, robot, &mut commands.numbers, rng);
                commands.time_left[bit] = term.resampling_time_s.unwrap_or_default();
            }
        }
    }
}

/// Counts down, samples a velocity command where the time is up, and lets the yaw rate follow the
/// heading.
pub(super) fn update_commands(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    robots: Blocks<&'static BasePose, Robot>,
    mut envs: Blocks<(&'static CurriculumProgress, &'static mut Command, &'static mut EnvRng), Env>,
) -> Result {
    let step_dt = task.step_dt;
    if !task.has_velocity_command() {
        return Ok(());
    }
    robots.read()?.zip(envs.write()?).vectorize_chunks(&workers, |Block { morphology, rows, .. }| {
        let (poses, (progress, commands, rngs)) = rows;
        let index = usize::from(morphology.0);
        let (config, ranges) = (&task.commands[index], &task.velocity_ranges[index]);
        CommandRows { config, ranges, step_dt, poses, progress, commands, rngs }
    });
    Ok(())
}

/// Draws and updates all other commands.
pub(super) fn update_other_commands(
    workers: Res<Workers>,
    morphologies: Res<crate::morphology::Morphologies>,
    task: Res<CompiledTask>,
    robots: Blocks<&'static BasePose, Robot>,
    mut envs: Blocks<(&'static mut CommandNumbers, &'static mut EnvRng), Env>,
) -> Result {
    if task.command_terms.is_empty() {
        return Ok(());
    }
    robots.read()?.zip(envs.write()?).for_each_chunk(&workers, |Block { morphology, envs, rows }| {
        let (poses, (commands, rngs)) = rows;
        let index = usize::from(morphology.0);
        let morphology = morphologies.get(morphology);
        for i in 0..envs.len() {
            let commands = &mut commands[i];
            for (bit, term) in task.command_terms.iter().enumerate() {
                term.of_morphologies[index].advance(&mut commands.numbers[term.range.clone()], task.step_dt);
                if commands.pinned >> bit & 1 == 1 {
                    continue;
                }
                let Some(time) = term.resampling_time_s else {
                    continue;
                };
                commands.time_left[bit] -= task.step_dt;
                if commands.time_left[bit] <= -0.5 * task.step_dt {
                    let robot = CommandedRobot { morphology, pose: &poses[i] };
                    term.draw(index, &robot, &mut commands.numbers, &mut rngs[i]);
                    commands.time_left[bit] = time;
                }
            }
        }
    });
    Ok(())
}

/// Counts the control step, after all commands of the step.
fn count_steps(mut envs: Blocks<&'static mut CurriculumProgress, Env>) -> Result {
    for block in envs.write()? {
        for progress in block.rows {
            progress.steps += 1;
        }
    }
    Ok(())
}

/// Brings an angle within half a turn of zero, rad.
#[inline(always)]
pub(super) fn wrap_to_pi(angle: f32) -> f32 {
    const TURN: f32 = std::f32::consts::TAU;
    angle - TURN * (angle / TURN).round_ties_even()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_wrap_to_half_a_turn() {
        for k in -3..=3 {
            let wrapped = wrap_to_pi(1.0 + std::f32::consts::TAU * k as f32);
            assert!((wrapped - 1.0).abs() < 1e-5, "{wrapped}");
        }
    }
}
