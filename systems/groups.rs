//! Groups of contact bodies, by the names of terms.

use serde::Deserialize;

use super::terms::FormLists;
use crate::config::quantities::ForceThreshold;
use crate::config::values;
use crate::robot::BodyGroup;

/// Bodies that may not touch anything.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BodiesInContact {
    /// Normal force that counts, N.
    #[serde(deserialize_with = "values::number_of::<ForceThreshold, _, _>")]
    pub(super) threshold: f32,
    /// Groups of the bodies whose contacts count.
    pub(super) bodies: Vec<BodyGroup>,
}

impl BodiesInContact {
    /// Threshold and groups, as a device reads them.
    pub(super) fn lists(&self) -> FormLists {
        (vec![self.threshold], Some(self.bodies.iter().map(|group| *group as i32).collect()))
    }
}
