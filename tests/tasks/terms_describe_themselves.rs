//! An observation term says what it is where it is registered, and its mirror image follows from
//! that.

use polypod::systems::{Block, Per, Registry, TermKind, TermSource, TermSpec};
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

#[test]
fn the_task_gives_what_a_term_takes_off_its_source() {
    let offset_with = |overrides: &[&str]| {
        let small = ["scene.terrain.num_rows=2", "scene.terrain.num_cols=2"];
        let overrides = small.iter().chain(overrides).map(|text| (*text).to_owned()).collect();
        let sim = Sim::new(&SimOptions { overrides, ..SimOptions::new("velocity_rough", ROBOTS.len()) }).unwrap();
        sim.task().observations.iter().map(|term| term.offset).collect::<Vec<_>>()
    };
    let offsets = offset_with(&[]);
    assert_eq!(offsets.last(), Some(&0.5));
    assert!(offsets[..offsets.len() - 1].iter().all(|offset| *offset == 0.0));
    assert_eq!(offset_with(&["observations.policy.height_scan.offset=0.3"]).last(), Some(&0.3));
}

#[test]
fn a_size_that_does_not_fit_the_kind_is_refused() {
    static BLOCKS: [Block; 2] = [Block::new(Per::Role, 2), Block::new(Per::Joint, 1)];
    let refused = |size: usize, spec: TermSpec| {
        #[derive(serde::Deserialize)]
        struct None {}
        let mut registry = Registry::builtin();
        registry.observation("own", size, spec, |_: &None, _, out| out.fill(0.0));
        let options = SimOptions {
            overrides: vec!["observations.policy=[{term=\"own\"}]".into()],
            ..SimOptions::new("velocity_flat", ROBOTS.len())
        };
        Sim::with_registry(&options, registry).err().map(|error| error.to_string())
    };
    let spec = |kind: TermKind| TermSpec::new(kind, "", "").from_source(TermSource::Measured);
    let body = spec(TermKind::Body).with_blocks(&BLOCKS);
    for (size, spec) in [(12, spec(TermKind::PerJoint)), (6, spec(TermKind::Vector)), (18, body)] {
        assert_eq!(refused(size, spec), None);
    }
    for (size, spec) in [(11, spec(TermKind::PerJoint)), (4, spec(TermKind::Vector)), (17, body)] {
        let error = refused(size, spec).unwrap();
        assert!(
            error.contains("observations.policy[0]") && error.contains("the term `own` is registered with"),
            "{error}"
        );
        assert!(error.contains("register it with another size"), "{error}");
    }
}
