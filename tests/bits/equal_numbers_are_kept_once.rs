//! Numbers that all robots of a kind share are in memory once; a robot's own numbers are separate.

use polypod::components::{Body, EnvId};
use polypod::dynamics::{Parameters, SharedArray};
use polypod::{Sim, SimOptions};

fn sim(task: &str) -> Sim {
    let options = SimOptions { robots: Some(vec!["unitree_a1".into()]), threads: Some(1), ..SimOptions::new(task, 20) };
    Sim::new(&options).unwrap()
}

fn bodies(sim: &mut Sim) -> Vec<Parameters<f32>> {
    let world = sim.world_mut();
    let mut all: Vec<_> = world.query::<(&EnvId, &Body)>().iter(world).map(|(id, b)| (*id, (*b.0).clone())).collect();
    all.sort_by_key(|(id, _)| *id);
    all.into_iter().map(|(_, body)| body).collect()
}

/// Whether the shapes, which the flat task does not randomise, and the masses, which it does, are
/// in the same memory.
fn shared(a: &Parameters<f32>, b: &Parameters<f32>) -> (bool, bool) {
    let shapes = std::ptr::eq(&*a.contact_position, &*b.contact_position)
        && std::ptr::eq(&*a.joint_offset, &*b.joint_offset)
        && std::ptr::eq(&*a.stiffness, &*b.stiffness);
    (shapes, std::ptr::eq(&*a.mass, &*b.mass))
}

#[test]
fn envs_share_what_is_not_randomised() {
    let mut sim = sim("velocity_flat");
    let check = |sim: &mut Sim, when: &str| {
        let all = bodies(sim);
        let nominal = sim.morphologies()[0].nominal.clone();
        for (env, body) in all.iter().enumerate() {
            assert_eq!(shared(body, &nominal), (true, false), "env {env} {when}");
        }
        assert!(all.windows(2).all(|pair| pair[0].mass[0] != pair[1].mass[0]), "{when}: masses are drawn");
    };
    check(&mut sim, "at first");
    sim.reset(Some(3), None).unwrap();
    check(&mut sim, "after a reset with a seed");
    let snapshot = sim.snapshot().unwrap();
    sim.step(&[0.1; 20 * 12]).unwrap();
    sim.restore(&snapshot).unwrap();
    check(&mut sim, "after a restored snapshot");
}

#[test]
fn a_number_that_one_robot_is_given_is_its_own() {
    let (mut plain, mut changed) = (sim("velocity_flat"), sim("velocity_flat"));
    let world = changed.world_mut();
    for (id, mut body) in world.query::<(&EnvId, &mut Body)>().iter_mut(world) {
        if id.0 == 7 {
            body.0.stiffness[2] *= 0.5;
        }
    }
    for _ in 0..5 {
        for sim in [&mut plain, &mut changed] {
            sim.step(&[0.1; 20 * 12]).unwrap();
        }
    }
    let nominal = &plain.morphologies()[0].nominal;
    let own: Vec<usize> =
        (0..20).filter(|&env| bodies(&mut changed)[env].stiffness[2] != nominal.stiffness[2]).collect();
    assert_eq!(own, [7]);
    // and so is the way it goes: the neighbouring lanes do not see it
    let rows =
        |sim: &Sim| sim.batch().observations.chunks(sim.batch().num_obs).map(<[f32]>::to_vec).collect::<Vec<_>>();
    let differ: Vec<usize> =
        rows(&plain).iter().zip(&rows(&changed)).enumerate().filter(|(_, (a, b))| a != b).map(|(env, _)| env).collect();
    assert_eq!(differ, [7]);
}

#[test]
fn bodies_that_all_differ_are_each_whole() {
    let mut varied = sim("velocity_flat_variation");
    let all = bodies(&mut varied);
    assert!(all.windows(2).all(|pair| pair[0].joint_offset[1] != pair[1].joint_offset[1]));
}

#[test]
fn a_change_of_a_list_is_its_own() {
    let first = SharedArray::from(vec![1.0, 2.0]);
    let mut second = first.clone();
    assert!(std::ptr::eq(&*first, &*second));
    second[1] = 3.0;
    assert_eq!((&*first, &*second), (&[1.0, 2.0][..], &[1.0, 3.0][..]));
}
