//! A task says which joints the policy drives. All others hold their default pose by the gains of
//! their actuators, and have no column anywhere; the driven ones move with the bits of a policy
//! that gives zeros for the others.

use bevy_ecs::prelude::With;
use polypod::components::{EnvId, JointState, JointTargets, Morphology, Robot, Stance};
use polypod::morphology::Morphologies;
use polypod::systems::StateField;
use polypod::{Sim, SimOptions, StateRows};

use crate::common::{ROBOTS, bits, busy, ended, noise, step};

const LEGS: &str = "actions.joint_pos.joint_names=[\"*_HIP_*\", \"*_KNEE\", \"*_ANKLE_*\"]";

/// Two humanoids with short, eventful episodes and observations without noise, whose draws would
/// depend on the number of joints.
fn options(driven: &str) -> SimOptions {
    let mut options = busy(&["unitree_g1", "booster_t1"], 12);
    options.task = "velocity_flat_legged".into();
    options.overrides.push("observations.enable_noise=false".into());
    options.overrides.extend((!driven.is_empty()).then(|| driven.to_owned()));
    options
}

fn sim(driven: &str) -> Sim {
    Sim::new(&options(driven)).unwrap_or_else(|error| panic!("{error}"))
}

fn is_of_a_leg(name: &str) -> bool {
    ["_HIP_", "_KNEE", "_ANKLE_"].iter().any(|part| name.contains(part))
}

/// Column in `all` of each column of `some`.
fn columns(some: &Sim, all: &Sim) -> Vec<usize> {
    let of = all.slots().joint_names();
    let place = |name: String| of.iter().position(|other| *other == name).unwrap();
    some.slots().joint_names().into_iter().map(place).collect()
}

/// Number in an observation of `all` of each number of one of `some`.
fn observed(some: &Sim, all: &Sim) -> Vec<usize> {
    let (own, columns) = (columns(some, all), all.slots().joints.len());
    let mut first = 0;
    let mut at = Vec::new();
    for (less, more) in some.task().observations.iter().zip(&all.task().observations) {
        assert_eq!(less.name, more.name);
        match less.size == more.size {
            true => at.extend(first..first + more.size),
            false => at.extend(
                (0..more.size / columns).flat_map(|block| own.iter().map(move |own| first + block * columns + own)),
            ),
        }
        first += more.size;
    }
    at
}

/// Targets and default pose of the joints of each robot that the policy does not drive, and
/// their positions.
fn held(sim: &mut Sim) -> Vec<(Vec<Vec<f32>>, Vec<f32>, Vec<f32>)> {
    let world = sim.world_mut();
    let mut robots = world.query_filtered::<(&EnvId, &Morphology, &JointTargets, &Stance, &JointState), With<Robot>>();
    let models = world.resource::<Morphologies>();
    let of = |(_, tag, targets, stance, joints): (&EnvId, &Morphology, &JointTargets, &Stance, &JointState)| {
        let driven = models.get(*tag).joint_of_slot();
        let rest = |all: &[f32]| (0..all.len()).filter(|j| !driven.contains(j)).map(|j| all[j]).collect::<Vec<_>>();
        let past = targets.history.iter().map(|targets| rest(targets)).collect();
        (past, rest(&stance.default_position), rest(&joints.position))
    };
    robots.iter(world).map(of).collect()
}

#[test]
fn they_have_no_columns() {
    let (some, all) = (sim(LEGS), sim(""));
    let names = some.slots().joint_names();
    let expected: Vec<String> = all.slots().joint_names().into_iter().filter(|name| is_of_a_leg(name)).collect();
    assert_eq!(names, expected);
    assert_eq!(some.batch().num_actions, 12);
    assert_eq!(some.state_width(StateField::JointPos), 12);
    assert_eq!(some.action_mask(), vec![true; 12 * some.num_envs()]);
    assert_eq!(some.slots().feet_names(), all.slots().feet_names());
    for (robot, whole) in some.morphologies().iter().zip(all.morphologies()) {
        assert_eq!(robot.roles.slots, whole.roles.slots);
        let (one, other) = (robot.describe(), whole.describe());
        assert_eq!(one.slots, expected);
        // numbers of physical joints are those of the whole robot
        assert_eq!((&one.joint_names, &one.default_pose), (&other.joint_names, &other.default_pose));
        assert_eq!(one.stiffness, other.stiffness);
        let named = |name: &String| other.joint_of_slot[other.slots.iter().position(|slot| slot == name).unwrap()];
        assert_eq!(one.joint_of_slot, expected.iter().map(named).collect::<Vec<_>>());
        assert!(other.held_joints.is_empty());
        let mut joints: Vec<usize> = one.held_joints.iter().map(|held| held.joint).collect();
        joints.extend(&one.joint_of_slot);
        joints.sort_unstable();
        assert_eq!(joints, (0..one.joint_names.len()).collect::<Vec<_>>());
        assert!(one.held_joints.iter().all(|held| other.slots.contains(&held.slot)));
    }
}

#[test]
fn mirror_images_fit() {
    // patterns that leave slots out at the beginning, in the middle and at the end
    for driven in [LEGS, "actions.joint_pos.joint_names=[\"TORSO_*\", \"*_KNEE\", \"*_SHOULDER_PITCH\"]"] {
        let (some, all) = (sim(driven), sim(""));
        let (own, seen) = (columns(&some, &all), observed(&some, &all));
        for (robot, whole) in some.morphologies().iter().zip(all.morphologies()) {
            let image = robot.mirrored_columns(own.len());
            let of_whole = whole.mirrored_columns(all.slots().joints.len());
            let expected: Vec<(usize, f32)> = own.iter().map(|&column| of_whole[column]).collect();
            let found: Vec<(usize, f32)> = image.iter().map(|&(column, sign)| (own[column], sign)).collect();
            assert_eq!(found, expected, "{}", robot.name());
            let image = some.task().mirrored_observation(robot);
            let of_whole = all.task().mirrored_observation(whole);
            let expected: Vec<(usize, f32)> = seen.iter().map(|&at| of_whole[at]).collect();
            assert_eq!(image.iter().map(|&(at, sign)| (seen[at], sign)).collect::<Vec<_>>(), expected);
        }
    }
}

#[test]
fn they_hold_the_default_pose() {
    let mut sim = sim(LEGS);
    let (mut ends, mut farthest) = (0, 0.0_f32);
    for t in 0..150 {
        if t == 70 {
            let mut bent = vec![0.0; 12 * sim.num_envs()];
            sim.state(StateField::DefaultJointPos, &mut bent).unwrap();
            bent.truncate(12);
            sim.set_states(&[0], &StateRows { joint_pos: Some(&bent), ..StateRows::default() }).unwrap();
        }
        step(&mut sim, t);
        ends += ended(&sim);
        for (targets, default, position) in held(&mut sim) {
            assert!(targets.iter().all(|past| bits(past) == bits(&default)), "step {t}: {targets:?}, {default:?}");
            let off = default.iter().zip(&position).map(|(a, b)| (a - b).abs());
            farthest = off.fold(farthest, f32::max);
        }
    }
    assert!(ends > 10, "{ends}");
    // they are moved: gains hold them
    assert!((0.01..1.5).contains(&farthest), "{farthest}");
}

#[test]
fn a_varied_body_holds_its_own_pose() {
    let mut options = busy(&ROBOTS[..4], 16);
    options.task = "velocity_flat_any_body".into();
    options.overrides.push("observations.enable_noise=false".into());
    let whole = Sim::new(&options).unwrap();
    options.overrides.push("actions.joint_pos.joint_names=[\"*_KFE\"]".into());
    let (mut sim, mut whole) = (Sim::new(&options).unwrap(), whole);
    let mut poses = Vec::new();
    for t in 0..40 {
        step(&mut sim, t);
        for (targets, default, _) in held(&mut sim) {
            assert!(targets.iter().all(|past| bits(past) == bits(&default)), "step {t}");
            poses.push(bits(&default));
        }
    }
    poses.sort_unstable();
    poses.dedup();
    assert!(poses.len() > 8, "{}", poses.len());
    // bodies are drawn as where the policy drives all joints
    let all_poses = |sim: &mut Sim| {
        sim.reset(Some(5), None).unwrap();
        let world = sim.world_mut();
        let mut stances = world.query_filtered::<&Stance, With<Robot>>();
        stances.iter(world).map(|stance| bits(&stance.default_position)).collect::<Vec<_>>()
    };
    assert_eq!(all_poses(&mut sim), all_poses(&mut whole));
}

#[test]
fn driven_joints_have_the_bits_of_a_policy_that_gives_zeros_for_the_others() {
    let (mut some, mut all) = (sim(LEGS), sim(""));
    let (own, seen) = (columns(&some, &all), observed(&some, &all));
    let (width, num_obs) = (all.batch().num_actions, all.batch().num_obs);
    let mut ends = 0;
    for t in 0..100 {
        let envs = some.num_envs();
        let actions: Vec<f32> = (0..envs * 12).map(|i| noise(0, i / 12, t, i % 12)).collect();
        let mut spread = vec![0.0; envs * width];
        for (row, given) in spread.chunks_exact_mut(width).zip(actions.chunks_exact(12)) {
            own.iter().zip(given).for_each(|(&column, &action)| row[column] = action);
        }
        some.step(&actions).unwrap();
        all.step(&spread).unwrap();
        ends += ended(&some);
        let (one, other) = (some.batch(), all.batch());
        // rewards are of all joints, whether the policy drives them or not
        assert_eq!(bits(&one.rewards), bits(&other.rewards), "step {t}");
        assert_eq!((&one.terminated, &one.truncated), (&other.terminated, &other.truncated));
        for env in 0..envs {
            let row = &other.observations[env * num_obs..(env + 1) * num_obs];
            let expected: Vec<f32> = seen.iter().map(|&at| row[at]).collect();
            let width = one.num_obs;
            assert_eq!(bits(&one.observations[env * width..(env + 1) * width]), bits(&expected), "step {t}, env {env}");
        }
        let states = |sim: &mut Sim| {
            let world = sim.world_mut();
            let mut robots = world.query_filtered::<(&JointState, &JointTargets), With<Robot>>();
            let all = robots.iter(world).map(|(joints, targets)| (joints.clone(), targets.clone()));
            all.map(|(joints, targets)| (bits(&joints.position), bits(&targets.history[0]))).collect::<Vec<_>>()
        };
        assert_eq!(states(&mut some), states(&mut all), "step {t}");
    }
    assert!(ends > 10, "{ends}");
}

#[test]
fn snapshots_go_on() {
    let mut sim = sim(LEGS);
    (0..23).for_each(|t| step(&mut sim, t));
    let snapshot = sim.snapshot().unwrap();
    let mut other = Sim::new(&options(LEGS)).unwrap();
    other.restore(&snapshot).unwrap();
    for t in 23..50 {
        step(&mut sim, t);
        step(&mut other, t);
    }
    assert!(sim.snapshot().unwrap() == other.snapshot().unwrap());
    // a policy with a column for each joint makes another batch, whose snapshots are its own
    let names = self::sim("").slots().joint_names();
    let wide = SimOptions { slots: names.clone(), ..options(LEGS) };
    let mut wide = Sim::new(&wide).unwrap();
    assert_eq!(wide.slots().joint_names(), names);
    let driven: Vec<String> =
        names.iter().zip(wide.action_mask()).filter(|(_, on)| *on).map(|(n, _)| n.clone()).collect();
    assert_eq!(driven, sim.slots().joint_names());
    assert!(wide.restore(&snapshot).is_err());
    let error = Sim::new(&options("")).unwrap().restore(&snapshot).unwrap_err().to_string();
    assert!(error.contains("snapshot"), "{error}");
}

#[test]
fn all_joints_are_the_default() {
    let (plain, star) = (sim(""), sim("actions.joint_pos.joint_names=[\"*\"]"));
    assert_eq!(plain.config_hash(), star.config_hash());
    assert_eq!(plain.slots(), star.slots());
    assert!(!plain.resolved_config().contains("[task.actions"));
    assert_ne!(plain.config_hash(), sim(LEGS).config_hash());
}

#[test]
fn patterns_without_joints_are_refused() {
    let error = |setting: &str| Sim::new(&options(setting)).err().unwrap().to_string();
    let key = "actions.joint_pos.joint_names";
    let found = error(&format!("{key}=[\"*_KNEE\", \"*_KNEES\"]"));
    assert!(
        found.contains(&format!("{key}[1]")) && found.contains("`*_KNEES` matches the name of no joint"),
        "{found}"
    );
    assert!(found.contains("places: ") && found.contains("KNEE"), "{found}");
    let found = error(&format!("{key}=[]"));
    assert!(found.contains(key) && found.contains("the policy drives no joint"), "{found}");
    // the head of one of them
    let found = error(&format!("{key}=[\"HEAD_*\"]"));
    assert!(found.contains(key) && found.contains("no pattern matches a joint of unitree_g1"), "{found}");
    assert!(found.contains("L_KNEE") && found.contains("leave the robot out"), "{found}");
    for (slip, known) in [("joint_pos.joint_name", "joint_names"), ("joint_po.joint_names", "joint_pos")] {
        let found = error(&format!("actions.{slip}=[\"*\"]"));
        assert!(found.contains("unknown key") && found.contains(known), "{found}");
    }
}
