//! An observation term says what it is where it is registered, and its mirror image follows from that.

use polypod::systems::TermKind;
use polypod::{Sim, SimOptions};

use crate::common::ROBOTS;

#[test]
fn a_mirror_image_of_a_mirror_image_is_the_observation() {
    for task in ["velocity_flat_universal", "velocity_rough"] {
        let options = SimOptions {
            overrides: vec!["scene.terrain.num_rows=2".into(), "scene.terrain.num_cols=2".into()],
            ..SimOptions::new(task, ROBOTS.len())
        };
        let options = if task == "velocity_rough" { options } else { SimOptions { overrides: vec![], ..options } };
        let sim = Sim::new(&options).unwrap();
        for robot in sim.morphologies() {
            let mirror = sim.task().mirrored_observation(robot);
            assert_eq!(mirror.len(), sim.batch().num_obs);
            for (place, &(index, sign)) in mirror.iter().enumerate() {
                assert_eq!(mirror[index], (place, sign), "{task}, {}: number {place}", robot.name());
            }
            assert!(mirror.iter().any(|(_, sign)| *sign < 0.0));
        }
    }
}

#[test]
fn kinds_are_those_of_the_terms() {
    let sim = Sim::new(&SimOptions::new("velocity_flat_universal", ROBOTS.len())).unwrap();
    let kind = |name: &str| sim.task().observations.iter().find(|term| term.name == name).unwrap().spec.kind;
    assert_eq!(kind("base_lin_vel"), TermKind::Vector);
    assert_eq!(kind("base_ang_vel"), TermKind::Pseudovector);
    assert_eq!(kind("velocity_commands"), TermKind::PlanarVelocity);
    assert_eq!(kind("last_action"), TermKind::PerJoint);
    assert_eq!(kind("morphology"), TermKind::Body);
    let signs = |name: &str| {
        let start: usize =
            sim.task().observations.iter().take_while(|term| term.name != name).map(|term| term.size).sum();
        let mirror = sim.task().mirrored_observation(&sim.morphologies()[0]);
        mirror[start..start + 3].iter().map(|(_, sign)| *sign).collect::<Vec<_>>()
    };
    assert_eq!(signs("base_lin_vel"), [1.0, -1.0, 1.0]);
    assert_eq!(signs("base_ang_vel"), [-1.0, 1.0, -1.0]);
    assert_eq!(signs("velocity_commands"), [1.0, -1.0, -1.0]);
}
