//! Interval events: what happens to a robot again and again within an episode.

use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::terms::{CompiledTask, EventBody, Registry};
use crate::components::{BaseVelocity, Env, EnvRng, EventTimers, ExternalWrench, Morphology, Robot};
use crate::config::values;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::rows::{Workers, read_rows, write_rows};

/// Counts each event's timer down; where it is up, the event happens and the timer starts anew.
pub(super) fn apply_interval_events(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    tags: Query<&'static Morphology, With<Robot>>,
    mut timers: Query<&'static mut EventTimers>,
    mut rngs: Query<&'static mut EnvRng, With<Env>>,
    mut velocities: Query<&'static mut BaseVelocity>,
    mut wrenches: Query<&'static mut ExternalWrench>,
) {
    if task.interval_events.is_empty() {
        return;
    }
    let tags = read_rows(&tags);
    let own = (write_rows(&mut timers), write_rows(&mut rngs));
    let rows = (tags, own, write_rows(&mut velocities), write_rows(&mut wrenches));
    workers.for_each_chunk(rows, tags.len(), |_, n, (tags, (timers, rngs), velocities, wrenches)| {
        for i in 0..n {
            for (event, left) in task.interval_events.iter().zip(timers[i].0.iter_mut()) {
                *left -= task.step_dt;
                if *left <= 0.0 {
                    *left = rngs[i].uniform(event.range_s);
                    let (velocity, wrench) = (&mut velocities[i], &mut wrenches[i]);
                    let morphology = morphologies.get(tags[i]);
                    (event.apply)(&mut EventBody { morphology, velocity, wrench }, &mut rngs[i]);
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
    registry.interval_event(EXTERNAL_WRENCH, |p: &WrenchRanges, body, rng| {
        *body.wrench = p.draw(body.morphology, rng);
    });
}

/// The event that pulls at the base.
pub(super) const EXTERNAL_WRENCH: &str = "base_external_force_torque";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct WrenchRanges {
    /// Range of each component of the force, base axes, N. Default: each robot's own.
    #[serde(default, deserialize_with = "values::optional_range")]
    force_range: Option<[f64; 2]>,
    /// Range of each component of the torque, base axes, N m. Default: each robot's own.
    #[serde(default, deserialize_with = "values::optional_range")]
    torque_range: Option<[f64; 2]>,
}

impl WrenchRanges {
    /// A wrench for a robot.
    pub(super) fn draw(&self, morphology: &MorphologyModel, rng: &mut EnvRng) -> ExternalWrench {
        let own = &morphology.config.randomization;
        let mut each = |range: [f64; 2]| std::array::from_fn(|_| rng.uniform(range.map(|x| x as f32)));
        ExternalWrench {
            force: each(self.force_range.unwrap_or(own.external_force)),
            torque: each(self.torque_range.unwrap_or(own.external_torque)),
        }
    }
}

fn push_robot(p: &Push, body: &mut EventBody, rng: &mut EnvRng) {
    body.velocity.linear[0] += rng.uniform(p.velocity_range);
    body.velocity.linear[1] += rng.uniform(p.velocity_range);
}
