//! Whether the parts of a snapshot fit the simulation: every list is as long as the one whose place it takes, and every index exists.
//!
//! The checksum finds damage. It does not stop whoever writes a snapshot by hand, and a length or an index that does not fit would only
//! be found in the middle of a later step.

use crate::batch::Batch;
use crate::components::{
    Action, ActuatorDelay, BasePose, BaseVelocity, Body, Command, ConstraintImpulses, ContactForces, ContactSensor,
    EnvOrigin, EnvRng, Episode, EpisodeSums, EventTimers, ExternalWrench, Feet, Imu, JointEffort, JointState,
    JointTargets, Stance, StartupBody,
};
use crate::dynamics::Parameters;
use crate::simulation::parameter_lengths;
use crate::terrain::TerrainLayout;

/// Largest count of a snapshot. No run gets there, and what counts on from there does not overflow.
pub(crate) const MAX_COUNT: u32 = u32::MAX / 2;

/// What indices of an env's components must stay below.
pub(crate) struct Bounds<'a> {
    /// Contact candidates and pairs of links of the robot.
    pub num_impulses: usize,
    /// Contact bodies of the robot.
    pub num_bodies: usize,
    /// Tiles, where the ground is generated terrain.
    pub layout: Option<&'a TerrainLayout>,
}

/// A component that a snapshot holds.
pub(crate) trait Fits {
    /// Whether it may take the place of `here`.
    fn fits(&self, here: &Self, bounds: &Bounds) -> bool;
}

macro_rules! of_any_value {
    ($($component:ident)*) => {
        $(impl Fits for $component {
            fn fits(&self, _here: &Self, _bounds: &Bounds) -> bool {
                true
            }
        })*
    };
}
of_any_value!(EnvRng Command BasePose BaseVelocity ExternalWrench Feet Imu);

macro_rules! of_lists {
    ($($component:ident: $($list:tt),*;)*) => {
        $(impl Fits for $component {
            fn fits(&self, here: &Self, _bounds: &Bounds) -> bool {
                [$(self.$list.len()),*] == [$(here.$list.len()),*]
            }
        })*
    };
}
of_lists! {
    EventTimers: 0;
    JointState: position, velocity;
    Action: current, previous;
    ActuatorDelay: 0;
    JointEffort: applied, acceleration;
    Stance: default_position;
    ContactSensor: peak_force;
}

impl Fits for Episode {
    fn fits(&self, _here: &Self, _bounds: &Bounds) -> bool {
        self.length <= MAX_COUNT
    }
}

impl Fits for EpisodeSums {
    fn fits(&self, here: &Self, _bounds: &Bounds) -> bool {
        self.terms.len() == here.terms.len() && self.steps <= MAX_COUNT
    }
}

impl Fits for EnvOrigin {
    fn fits(&self, _here: &Self, bounds: &Bounds) -> bool {
        let exists =
            |layout: &TerrainLayout| self.terrain_level < layout.num_rows && self.terrain_column < layout.num_cols;
        bounds.layout.is_none_or(exists)
    }
}

impl Fits for JointTargets {
    fn fits(&self, here: &Self, _bounds: &Bounds) -> bool {
        let lengths = |targets: &Self| targets.history.iter().map(|past| past.len()).collect::<Vec<_>>();
        lengths(self) == lengths(here)
    }
}

impl Fits for ConstraintImpulses {
    fn fits(&self, here: &Self, bounds: &Bounds) -> bool {
        self.bounds.len() == here.bounds.len()
            && self.contacts.iter().all(|contact| (contact.contact as usize) < bounds.num_impulses)
    }
}

impl Fits for ContactForces {
    fn fits(&self, here: &Self, bounds: &Bounds) -> bool {
        self.feet_normal.len() == here.feet_normal.len()
            && self.others.iter().all(|force| (force.body as usize) < bounds.num_bodies)
    }
}

impl Fits for Parameters<f32> {
    fn fits(&self, here: &Self, _bounds: &Bounds) -> bool {
        parameter_lengths(self) == parameter_lengths(here)
    }
}

impl Fits for Body {
    fn fits(&self, here: &Self, bounds: &Bounds) -> bool {
        self.0.fits(&here.0, bounds)
    }
}

impl Fits for StartupBody {
    fn fits(&self, here: &Self, bounds: &Bounds) -> bool {
        match (&self.0, &here.0) {
            (Some(this), Some(here)) => this.0.fits(&here.0, bounds) && this.1.fits(&here.1, bounds),
            (this, here) => this.is_none() && here.is_none(),
        }
    }
}

/// Whether the arrays of a batch are as long as those of another.
pub(crate) fn same_lengths(a: &Batch, b: &Batch) -> bool {
    let lengths = |batch: &Batch| {
        // whole, so that an array that is added is not forgotten here
        let Batch {
            num_envs,
            num_obs,
            num_actions,
            actions,
            observations,
            rewards,
            terminated,
            truncated,
            final_observations,
            has_final,
        } = batch;
        let floats = [actions, observations, rewards, final_observations].map(Vec::len);
        let flags = [terminated, truncated, has_final].map(Vec::len);
        (*num_envs, *num_obs, *num_actions, floats, flags)
    };
    lengths(a) == lengths(b)
}
