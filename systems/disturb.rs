//! Interval events, which happen to a robot again and again within an episode.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::terms::{CompiledTask, FormLists, Registry};
use super::view::EventBody;
use super::{ControlStep, PipelineSet};
use crate::blocks::{Block, Blocks};
use crate::components::{BaseVelocity, Env, EnvRng, EventTimers, ExternalWrench, Robot};
use crate::config::quantities::{Force, Push as PushSpeed};
use crate::config::values;
use crate::engine::device::FormKind;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::workers::Workers;

/// Runs interval events.
#[derive(Default)]
pub struct DisturbPlugin;

impl Plugin for DisturbPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(ControlStep, apply_interval_events.in_set(PipelineSet::Disturb));
    }
}

/// Counts each event's timer down; where it is up, the event happens and the timer is set again.
pub(super) fn apply_interval_events(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    mut robots: Blocks<(&'static mut BaseVelocity, &'static mut ExternalWrench), Robot>,
    mut envs: Blocks<(&'static mut EventTimers, &'static mut EnvRng), Env>,
) -> Result {
    if task.interval_events.is_empty() {
        return Ok(());
    }
    robots.write()?.zip(envs.write()?).for_each_chunk(&workers, |Block { morphology, envs, rows }| {
        let ((velocities, wrenches), (timers, rngs)) = rows;
        let morphology = morphologies.get(morphology);
        for i in 0..envs.len() {
            for (event, left) in task.interval_events.iter().zip(timers[i].0.iter_mut()) {
                *left -= task.step_dt;
                if *left <= 0.0 {
                    *left = rngs[i].uniform(event.range_s);
                    let (velocity, wrench) = (&mut velocities[i], &mut wrenches[i]);
                    (event.apply)(&mut EventBody { morphology, velocity, wrench }, &mut rngs[i]);
                }
            }
        }
    });
    Ok(())
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Push {
    /// Range of the velocity added along world x and y, m/s.
    #[serde(deserialize_with = "values::range_of::<PushSpeed, _, _>")]
    velocity_range: [f32; 2],
}

/// All built-in interval events, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    registry.interval_event("push_robot", push_robot);
    // A random force and torque on the base, until the next reset or event.
    registry.interval_event(EXTERNAL_WRENCH, |p: &WrenchRanges, body, rng| {
        *body.wrench = p.draw(body.morphology, rng);
    });
    // the numbers of these events in `device/env.h`
    registry
        .on_device(FormKind::Interval, "push_robot", |p: Push, _| Some((p.velocity_range.to_vec(), Some(Vec::new()))));
    registry.on_device(FormKind::Interval, EXTERNAL_WRENCH, |p: WrenchRanges, robot| Some(p.lists(robot)));
}

/// The event that pulls at the base.
pub(super) const EXTERNAL_WRENCH: &str = "base_external_force_torque";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct WrenchRanges {
    /// Range of each component of the force, base axes, N. Default: each robot's own.
    #[serde(default, deserialize_with = "values::optional_range_of::<Force, _, _>")]
    force_range: Option<[f64; 2]>,
    /// Range of each component of the torque, base axes, N m. Default: each robot's own.
    #[serde(default, deserialize_with = "values::optional_range_of::<Force, _, _>")]
    torque_range: Option<[f64; 2]>,
}

impl WrenchRanges {
    /// Ranges of force and torque for a robot, as a device reads them.
    pub(super) fn lists(&self, morphology: &MorphologyModel) -> FormLists {
        let own = &morphology.config.randomization;
        let ranges = [self.force_range.unwrap_or(own.external_force), self.torque_range.unwrap_or(own.external_torque)];
        (ranges.as_flattened().iter().map(|x| *x as f32).collect(), Some(Vec::new()))
    }

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

/// Adds a random velocity along world x and y to the base, m/s.
fn push_robot(p: &Push, body: &mut EventBody, rng: &mut EnvRng) {
    body.velocity.linear[0] += rng.uniform(p.velocity_range);
    body.velocity.linear[1] += rng.uniform(p.velocity_range);
}
