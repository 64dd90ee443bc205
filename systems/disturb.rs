//! Interval events: what happens to a robot again and again within an episode.

use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::terms::{CompiledTask, EventBody, Registry};
use crate::components::{BaseVelocity, Env, EnvRng, EventTimers};
use crate::rows::{Workers, write_rows};

/// Counts each event's timer down; where it is up, the event happens and the timer starts anew.
pub(super) fn apply_interval_events(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    mut timers: Query<&'static mut EventTimers>,
    mut rngs: Query<&'static mut EnvRng, With<Env>>,
    mut velocities: Query<&'static mut BaseVelocity>,
) {
    if task.interval_events.is_empty() {
        return;
    }
    let timers = write_rows(&mut timers);
    let len = timers.len();
    let rows = (timers, write_rows(&mut rngs), write_rows(&mut velocities));
    workers.for_each_chunk(rows, len, |_, n, (timers, rngs, velocities)| {
        for i in 0..n {
            for (event, left) in task.interval_events.iter().zip(timers[i].0.iter_mut()) {
                *left -= task.step_dt;
                if *left <= 0.0 {
                    *left = rngs[i].uniform(event.range_s);
                    (event.apply)(&mut EventBody { velocity: &mut velocities[i] }, &mut rngs[i]);
                }
            }
        }
    });
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Push {
    /// Range of the velocity added along world x and y, m/s.
    velocity_range: [f32; 2],
}

/// All built-in interval events, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    registry.interval_event("push_robot", push_robot);
}

fn push_robot(p: &Push, body: &mut EventBody, rng: &mut EnvRng) {
    body.velocity.linear[0] += rng.uniform(p.velocity_range);
    body.velocity.linear[1] += rng.uniform(p.velocity_range);
}
