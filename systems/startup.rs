//! Startup events: what is randomised once, when the envs are made.

use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::terms::{CompiledTask, NoParams, Registry};
use crate::components::{Body, Env, EnvRng, Morphology, Robot};
use crate::dynamics::Parameters;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::world::Ground;

/// A new robot's numbers, as startup events may change them.
pub struct NewBody<'a> {
    /// What kind of robot it is.
    pub morphology: &'a MorphologyModel,
    /// What it will stand on.
    pub ground: &'a Ground,
    /// Masses, lengths, gains and friction; start as the morphology's.
    pub parameters: &'a mut Parameters<f32>,
}

/// Gives every robot its material and applies the task's startup events, each env from its own stream.
pub fn randomise_at_startup(
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    ground: Res<Ground>,
    mut robots: Query<(&Morphology, &mut Body), With<Robot>>,
    mut rngs: Query<&mut EnvRng, With<Env>>,
) {
    for ((tag, mut body), mut rng) in robots.iter_mut().zip(rngs.iter_mut()) {
        let morphology = morphologies.get(*tag);
        let mut new = NewBody { morphology, ground: &ground, parameters: &mut body.0 };
        let material = &task.config.robot_material;
        new.set_material(material.static_friction as f32, material.dynamic_friction as f32);
        new.parameters.restitution = ground.restitution_with(material.restitution as f32);
        for event in &task.startup_events {
            event(&mut new, &mut rng);
        }
    }
}

impl NewBody<'_> {
    /// Sets the robot's friction coefficients; the ground's are combined with them.
    pub fn set_material(&mut self, static_friction: f32, dynamic_friction: f32) {
        let [static_friction, dynamic_friction] = self.ground.friction_with([static_friction, dynamic_friction]);
        self.parameters.static_friction = static_friction;
        self.parameters.dynamic_friction = dynamic_friction;
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Buckets {
    /// Number of equally spaced materials that are drawn from.
    num_buckets: u32,
}

/// All built-in startup events, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    registry.startup_event("physics_material", physics_material);
    registry.startup_event("add_base_mass", add_base_mass);
    registry.startup_event("base_com", base_com);
}

/// One of `num_buckets` values of static and of dynamic friction, the dynamic one at most the static one.
fn physics_material(p: &Buckets, body: &mut NewBody, rng: &mut EnvRng) {
    let ranges = &body.morphology.config.randomization;
    let last = p.num_buckets.max(1) - 1;
    let mut draw = |[low, high]: [f64; 2]| {
        let share = if last == 0 { 0.5 } else { f64::from(rng.integer([0, last])) / f64::from(last) };
        (low + (high - low) * share) as f32
    };
    let static_friction = draw(ranges.static_friction);
    let dynamic_friction = draw(ranges.dynamic_friction).min(static_friction);
    body.set_material(static_friction, dynamic_friction);
}

/// Adds mass to the base and scales its inertia with it.
fn add_base_mass(_: &NoParams, body: &mut NewBody, rng: &mut EnvRng) {
    const LIGHTEST: f32 = 0.01;
    let range = body.morphology.config.randomization.base_mass_offset.map(|x| x as f32);
    let old = body.parameters.mass[0];
    let new = (old + rng.uniform(range)).max(LIGHTEST);
    body.parameters.mass[0] = new;
    for x in &mut body.parameters.inertia[0] {
        *x *= new / old;
    }
}

/// Moves the base's centre of mass.
fn base_com(_: &NoParams, body: &mut NewBody, rng: &mut EnvRng) {
    let offset = &body.morphology.config.randomization.base_com_offset;
    for (x, range) in body.parameters.com[0].iter_mut().zip([offset.x, offset.y, offset.z]) {
        *x += rng.uniform(range.map(|x| x as f32));
    }
}
