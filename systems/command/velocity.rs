//! The velocity command: drawn at reset and every few seconds, steered by heading in between.

use super::wrap_to_pi;
use crate::components::{BasePose, Command, CurriculumProgress, EnvRng};
use crate::config::{VELOCITY_COLUMNS, VELOCITY_COMMAND, VelocityCommandConfig};
use crate::dynamics::elementary::atan2;
use crate::dynamics::lanes::Kernel;
use crate::systems::commanded::CommandSpec;
use crate::systems::terms::Registry;
use crate::systems::terms::VelocityRanges;

/// Registers the kind. Its numbers stand in [`Command`].
pub(super) fn register(registry: &mut Registry) {
    let spec = CommandSpec {
        columns: &VELOCITY_COLUMNS,
        description: "forward and left velocity, m/s, and yaw rate, rad/s, base axes",
    };
    registry.velocity_command(VELOCITY_COMMAND, spec);
    registry.needs_command("velocity_commands", VELOCITY_COMMAND);
    for term in ["track_lin_vel_xy_exp", "track_ang_vel_z_exp", "base_linear_velocity", "base_angular_velocity"] {
        registry.needs_command(term, VELOCITY_COMMAND);
    }
}

/// Counts down, samples a command where the time is up, and lets the yaw rate follow the heading.
pub(super) struct CommandRows<'a> {
    pub(super) config: &'a VelocityCommandConfig,
    pub(super) ranges: &'a VelocityRanges,
    pub(super) step_dt: f32,
    pub(super) poses: &'a [BasePose],
    pub(super) progress: &'a [CurriculumProgress],
    pub(super) commands: &'a mut [Command],
    pub(super) rngs: &'a mut [EnvRng],
}

impl Kernel<f32> for CommandRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { config, ranges, step_dt, poses, progress, commands, rngs } = self;
        for (((pose, progress), command), rng) in poses.iter().zip(progress).zip(commands).zip(rngs) {
            if command.pinned {
                continue;
            }
            command.time_left -= step_dt;
            let ranges = ranges.at(progress);
            // half a step of tolerance: the sum of steps is not exact
            if command.time_left <= -0.5 * step_dt {
                draw_command(config, ranges, command, rng);
            }
            steer(config, ranges[2], command, heading(&pose.rotation));
        }
    }
}

/// Heading of the base's x axis in the world, rad.
#[inline(always)]
pub(in crate::systems) fn heading([w, x, y, z]: &[f32; 4]) -> f32 {
    atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
}

/// Draws a new command from the ranges of forward and left velocity and yaw rate, and restarts its
/// time.
pub(in crate::systems) fn draw_command(
    config: &VelocityCommandConfig,
    ranges: [[f32; 2]; 3],
    command: &mut Command,
    rng: &mut EnvRng,
) {
    let range = |r: [f64; 2]| r.map(|x| x as f32);
    command.velocity = ranges.map(|range| rng.uniform(range));
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

/// Lets the yaw rate follow the heading within its limits, rad/s, and a standing robot stand.
#[inline(always)]
pub(in crate::systems) fn steer(
    config: &VelocityCommandConfig,
    [low, high]: [f32; 2],
    command: &mut Command,
    heading: f32,
) {
    if command.holds_heading {
        let error = wrap_to_pi(command.heading - heading);
        command.velocity[2] = (config.heading_control_stiffness as f32 * error).clamp(low, high);
    }
    if command.standing {
        command.velocity = [0.0; 3];
    }
}
