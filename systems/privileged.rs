//! Observation terms that no sensor of a robot measures: for a critic, a teacher, or an estimator.

use super::terms::{Block, NoParams, Per, Registry, TermKind, TermSpec};
use super::view::RobotView;
use crate::engine::device::FormKind;

const ONE_NUMBER: &[Block] = &[Block::new(Per::Body, 1)];
const TWO_NUMBERS: &[Block] = &[Block::new(Per::Body, 2)];

/// All terms of this file.
pub(super) fn register(registry: &mut Registry) {
    use TermKind::{Body, PerFoot, Vector};
    let spec = TermSpec::new(Body, "", "static and dynamic friction coefficient of robot and ground combined");
    registry.observation("contact_friction", 2, spec.with_blocks(TWO_NUMBERS), |_: &NoParams, r, out| {
        out.copy_from_slice(&[r.body.static_friction, r.body.dynamic_friction]);
    });
    let spec = TermSpec::new(Body, "kg", "mass of the base link, less what its robot's config says");
    registry.observation("base_mass_offset", 1, spec.with_blocks(ONE_NUMBER), |_: &NoParams, r, out| {
        out[0] = r.body.mass[0] - r.morphology.nominal.mass[0];
    });
    let spec =
        TermSpec::new(Vector, "m", "centre of mass of the base link, less what its robot's config says, base axes");
    registry.observation("base_com_offset", 3, spec.with_magnitude(0.1), |_: &NoParams, r, out| {
        let (own, usual) = (r.body.com[0], r.morphology.nominal.com[0]);
        out.copy_from_slice(&std::array::from_fn::<f32, 3, _>(|k| own[k] - usual[k]));
    });
    let spec = TermSpec::new(PerFoot, "N", "largest normal force on each foot over the last three physics steps");
    registry.foot_observation("feet_contact_force", spec.with_magnitude(100.0), feet_contact_force);
    let spec = TermSpec::new(PerFoot, "s", "how long each foot has been in the air");
    registry.foot_observation("feet_air_time", spec, |_: &NoParams, r, out| out.copy_from_slice(&r.contacts.air_time));
    let spec = TermSpec::new(PerFoot, "m", "height of each foot's centre above the ground below it");
    registry.foot_observation("feet_height", spec.with_magnitude(0.1), |_: &NoParams, r, out| {
        out.copy_from_slice(&r.feet.height);
    });
    for name in ["contact_friction", "base_mass_offset", "base_com_offset"] {
        registry.depends_on_body(name);
    }
    registry
        .on_device(FormKind::Observation, "contact_friction", |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
    registry.on_device(FormKind::Observation, "base_mass_offset", |NoParams {}, robot| {
        Some((vec![robot.nominal.mass[0]], Some(Vec::new())))
    });
    registry.on_device(FormKind::Observation, "base_com_offset", |NoParams {}, robot| {
        Some((robot.nominal.com[0].to_vec(), Some(Vec::new())))
    });
    for name in ["feet_contact_force", "feet_air_time", "feet_height"] {
        registry.on_device(FormKind::Observation, name, |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
    }
}

fn feet_contact_force(_: &NoParams, r: &RobotView, out: &mut [f32]) {
    for (force, &body) in out.iter_mut().zip(&r.morphology.feet) {
        *force = r.contacts.peak_force[body];
    }
}
