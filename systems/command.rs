//! Velocity commands: drawn at reset and every few seconds, steered by heading in between.

use bevy_ecs::prelude::*;

use super::terms::CompiledTask;
use crate::components::{BasePose, Command, Env, EnvRng};
use crate::config::VelocityCommandConfig;
use crate::dynamics::lanes::Kernel;
use crate::rows::{Workers, read_rows, write_rows};

/// Counts down, draws anew where the time is up, and lets the yaw rate follow the heading.
pub(super) fn update_commands(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    poses: Query<&'static BasePose>,
    mut commands: Query<&'static mut Command>,
    mut rngs: Query<&'static mut EnvRng, With<Env>>,
) {
    let poses = read_rows(&poses);
    let (config, step_dt) = (&task.config.commands.base_velocity, task.step_dt);
    let rows = (poses, write_rows(&mut commands), write_rows(&mut rngs));
    workers.vectorize_chunks(rows, poses.len(), |_, _, (poses, commands, rngs)| CommandRows {
        config,
        step_dt,
        poses,
        commands,
        rngs,
    });
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
    // libm-free functions keep the bits the same on every machine
    atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
}

/// Draws a new command and restarts its time.
pub(super) fn draw_command(config: &VelocityCommandConfig, command: &mut Command, rng: &mut EnvRng) {
    let range = |r: [f64; 2]| r.map(|x| x as f32);
    command.velocity = [config.lin_vel_x, config.lin_vel_y, config.ang_vel_z].map(|r| rng.uniform(range(r)));
    command.heading = rng.uniform(range(config.heading));
    command.holds_heading = rng.unit() < config.rel_heading_envs as f32 && config.heading_command;
    command.standing = rng.unit() < config.rel_standing_envs as f32;
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

/// Angle of the vector (x, y), rad; error below 1e-6. A polynomial on the first octant (Abramowitz and Stegun 4.4.49)
/// and reflections, with IEEE operations only.
#[inline(always)]
fn atan2(y: f32, x: f32) -> f32 {
    use std::f32::consts::{FRAC_PI_2, PI};
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = if ay < ax { (ay, ax) } else { (ax, ay) };
    let t = if large > 0.0 { small / large } else { 0.0 };
    let t2 = t * t;
    let series = [
        0.002_866_225_7,
        -0.016_165_737,
        0.042_909_614,
        -0.075_289_64,
        0.106_562_64,
        -0.142_089,
        0.199_935_51,
        -0.333_331_45,
    ];
    let p = series.iter().fold(0.0f32, |p, &c: &f32| p.mul_add(t2, c));
    let a = (p * t2).mul_add(t, t);
    let a = if ay < ax { a } else { FRAC_PI_2 - a };
    let a = if x < 0.0 { PI - a } else { a };
    if y < 0.0 { -a } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn atan2_is_accurate_all_around() {
        for i in 0..10_000 {
            let angle = (f64::from(i) - 5000.0) * std::f64::consts::PI / 5000.0;
            for radius in [1e-3, 1.0, 50.0] {
                let (y, x) = ((radius * angle.sin()) as f32, (radius * angle.cos()) as f32);
                let exact = f64::from(y).atan2(f64::from(x));
                assert!((f64::from(atan2(y, x)) - exact).abs() < 1.5e-6, "{y} {x}");
            }
        }
    }

    #[test]
    fn angles_wrap_to_half_a_turn() {
        for k in -3..=3 {
            let wrapped = wrap_to_pi(1.0 + std::f32::consts::TAU * k as f32);
            assert!((wrapped - 1.0).abs() < 1e-5, "{wrapped}");
        }
    }
}
