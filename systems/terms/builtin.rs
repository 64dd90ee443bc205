//! The built-in terms: each file of the pipeline registers its own.

use super::super::sense::ray_caster_camera;
use super::super::{command, curriculum, disturb, observe, privileged, reset, reward, startup, terminate};
use super::registry::Registry;
use super::schedules;

impl Registry {
    /// The built-in terms.
    pub fn builtin() -> Self {
        let mut registry = Self::default();
        command::register(&mut registry);
        reward::register(&mut registry);
        observe::register(&mut registry);
        ray_caster_camera::register(&mut registry);
        privileged::register(&mut registry);
        terminate::register(&mut registry);
        startup::register(&mut registry);
        reset::register(&mut registry);
        disturb::register(&mut registry);
        curriculum::register(&mut registry);
        schedules::register(&mut registry);
        registry
    }
}
