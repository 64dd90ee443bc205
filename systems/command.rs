//! Velocity commands: drawn at reset and every few seconds, steered by heading in between.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;

use super::terms::CompiledTask;
use super::{ControlStep, PipelineSet};
use crate::blocks::{Block, Blocks};
use crate::components::{BasePose, Command, Env, EnvRng, Robot};
use crate::config::VelocityCommandConfig;
use crate::dynamics::elementary::atan2;
use crate::dynamics::lanes::Kernel;
use crate::workers::Workers;

/// Draws and steers velocity commands.
#[derive(Default)]
pub struct CommandPlugin;

impl Plugin for CommandPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(ControlStep, update_commands.in_set(PipelineSet::Command));
    }
}

/// Counts down, samples a command where the time is up, and lets the yaw rate follow the heading.
pub(super) fn update_commands(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    robots: Blocks<&'static BasePose, Robot>,
    mut envs: Blocks<(&'static mut Command, &'static mut EnvRng), Env>,
) -> Result {
    let step_dt = task.step_dt;
    robots.read()?.zip(envs.write()?).vectorize_chunks(&workers, |Block { morphology, rows, .. }| {
        let (poses, (commands, rngs)) = rows;
        CommandRows { config: &task.commands[usize::from(morphology.0)], step_dt, poses, commands, rngs }
    });
    Ok(())
}

struct CommandRows<'a> {
    config: &'a VelocityCommandConfig,
    step_dt: f32,
    poses: &'a [BasePose],
    commands: &'a mut [Command],
    rngs: &'a mut [EnvRng],
}

impl Kernel<f32> for CommandRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { config, step_dt, poses, commands, rngs } = self;
        for ((pose, command), rng) in poses.iter().zip(commands).zip(rngs) {
            if command.pinned {
                continue;
            }
            command.time_left -= step_dt;
            // half a step of tolerance: the sum of steps is not exact
            if command.time_left <= -0.5 * step_dt {
                draw_command(config, command, rng);
            }
            steer(config, command, heading(&pose.rotation));
        }
    }
}

/// Heading of the base's x axis in the world, rad.
#[inline(always)]
pub(super) fn heading([w, x, y, z]: &[f32; 4]) -> f32 {
    atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
}

/// Draws a new command and restarts its time.
pub(super) fn draw_command(config: &VelocityCommandConfig, command: &mut Command, rng: &mut EnvRng) {
    let range = |r: [f64; 2]| r.map(|x| x as f32);
    command.velocity = [config.lin_vel_x, config.lin_vel_y, config.ang_vel_z].map(|r| rng.uniform(range(r)));
    command.heading = rng.uniform(range(config.heading));
    command.holds_heading = rng.unit() < config.rel_heading_envs as f32 && config.heading_command;
    command.standing = rng.unit() < config.rel_standing_envs as f32;
    let (turning, sideways) = (config.rel_turning_envs as f32, config.rel_sideways_envs as f32);
    // without such shares nothing is drawn
    if turning + sideways > 0.0 {
        let draw = rng.unit();
        if draw < turning {
            command.velocity[..2].fill(0.0);
            command.holds_heading = false;
        } else if draw < turning + sideways {
            (command.velocity[0], command.velocity[2]) = (0.0, 0.0);
            command.holds_heading = false;
        }
    }
    command.time_left = config.resampling_time_s as f32;
}

/// Lets the yaw rate follow the heading, and a standing robot stand.
#[inline(always)]
pub(super) fn steer(config: &VelocityCommandConfig, command: &mut Command, heading: f32) {
    if command.holds_heading {
        let [low, high] = config.ang_vel_z.map(|x| x as f32);
        let error = wrap_to_pi(command.heading - heading);
        command.velocity[2] = (config.heading_control_stiffness as f32 * error).clamp(low, high);
    }
    if command.standing {
        command.velocity = [0.0; 3];
    }
}

/// The same angle within half a turn of zero, rad.
#[inline(always)]
fn wrap_to_pi(angle: f32) -> f32 {
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
