//! A target is the default pose plus the scaled action, joint by joint, unclipped; the first one
//! after a reset fills the history.

use polypod::Sim;
use polypod::components::{EnvId, JointTargets};

use crate::common::{ROBOTS, busy, noise};

fn targets(sim: &mut Sim) -> Vec<JointTargets> {
    let world = sim.world_mut();
    let mut rows: Vec<_> =
        world.query::<(&EnvId, &JointTargets)>().iter(world).map(|(id, t)| (id.0, t.clone())).collect();
    rows.sort_by_key(|(id, _)| *id);
    rows.into_iter().map(|(_, targets)| targets).collect()
}

#[test]
fn targets_are_the_default_pose_plus_scaled_actions() {
    let mut sim = Sim::new(&busy(&ROBOTS, 16)).unwrap();
    let models = sim.morphologies().to_vec();
    for t in 0..3 {
        // far beyond any joint's range at times
        let actions: Vec<f32> = (0..sim.batch().actions.len()).map(|i| noise(0, i / 12, t, i % 12) * 50.0).collect();
        sim.step(&actions).unwrap();
        let ended: Vec<bool> =
            sim.batch().terminated.iter().zip(&sim.batch().truncated).map(|(a, b)| *a || *b).collect();
        for (env, targets) in targets(&mut sim).iter().enumerate().filter(|(env, _)| !ended[*env]) {
            let model = &models[env / 2];
            for (slot, joint) in model.joint_of_slot().into_iter().enumerate() {
                let expected =
                    model.stance.default_position[joint] + model.stance.action_scale * actions[12 * env + slot];
                let found = targets.history[0][joint];
                assert!(
                    (found - expected).abs() < 1e-5 * (1.0 + expected.abs()),
                    "{}: {found} {expected}",
                    model.name()
                );
                if t == 0 {
                    assert!(targets.history.iter().all(|past| past[joint] == found), "an older episode is remembered");
                }
            }
        }
    }
}
