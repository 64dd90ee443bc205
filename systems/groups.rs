//! Groups of contact bodies, as terms name them.

use serde::Deserialize;

use crate::robot::BodyGroup;

/// A group of contact bodies, as configs name it.
#[derive(Deserialize, Clone, Copy)]
#[serde(rename_all = "snake_case")]
pub(super) enum Group {
    Base,
    Torso,
    Hip,
    Thigh,
    Shank,
    Foot,
    Arm,
    Head,
}

impl Group {
    #[inline(always)]
    pub(super) fn holds(self, group: BodyGroup) -> bool {
        let own = match self {
            Group::Base => BodyGroup::Base,
            Group::Torso => BodyGroup::Torso,
            Group::Hip => BodyGroup::Hip,
            Group::Thigh => BodyGroup::Thigh,
            Group::Shank => BodyGroup::Shank,
            Group::Foot => BodyGroup::Foot,
            Group::Arm => BodyGroup::Arm,
            Group::Head => BodyGroup::Head,
        };
        own == group
    }
}

/// Bodies that may not touch anything.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BodiesInContact {
    /// Normal force that counts, N.
    pub(super) threshold: f32,
    /// Their groups.
    pub(super) bodies: Vec<Group>,
}
