//! The first state of each robot that breaks is dumped to a file that steps there again, bit for
//! bit.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use polypod::Autoreset;
use polypod::components::{ActuatorDelay, BasePose, BaseVelocity, Body, EnvId, JointState};
use polypod::dump::Dump;
use polypod::dynamics::lanes::Simd;
use polypod::engine::Quantity;
use polypod::{Sim, SimOptions};

use crate::common::{assert_all_same, busy, step, turning};

const ROBOTS: [&str; 3] = ["anymal_d", "spot", "unitree_a1"];
const NUM_ENVS: usize = 60;

/// An empty directory of the test's own.
fn directory(test: &str) -> PathBuf {
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("dump_{test}_{}", std::process::id()));
    let _ = fs::remove_dir_all(&dir);
    dir
}

fn options(dir: Option<&Path>) -> SimOptions {
    SimOptions { dump_dir: dir.map(Path::to_path_buf), ..busy(&ROBOTS, NUM_ENVS) }
}

/// A simulation in which much has happened, but no state has broken.
fn under_way(options: &SimOptions) -> Sim {
    let mut sim = Sim::new(options).unwrap();
    (0..10).for_each(|t| step(&mut sim, t));
    sim
}

/// Change of a robot by a test.
type Change = fn(&mut BasePose, &mut BaseVelocity, &mut JointState, &mut Body);

fn damage(sim: &mut Sim, env: usize, change: Change) {
    let world = sim.world_mut();
    let mut query = world.query::<(&EnvId, &mut BasePose, &mut BaseVelocity, &mut JointState, &mut Body)>();
    let mut found = query.iter_mut(world).find(|(id, ..)| id.0 as usize == env).unwrap();
    change(&mut found.1, &mut found.2, &mut found.3, &mut found.4);
}

fn dumps(dir: &Path) -> Vec<String> {
    let Ok(entries) = fs::read_dir(dir) else {
        return Vec::new();
    };
    let mut names: Vec<String> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn replay(arguments: &[&str]) -> Output {
    crate::polypod_sim(&["replay"]).args(arguments).output().unwrap()
}

/// Breaks one env and replays the dump on every instruction set; returns the first replay's output.
#[track_caller]
fn check(test: &str, env: usize, change: Change, quantity: Quantity) -> String {
    check_in(&options(None), test, env, change, quantity)
}

/// The same in a task.
#[track_caller]
fn check_in(options: &SimOptions, test: &str, env: usize, change: Change, quantity: Quantity) -> String {
    let dir = directory(test);
    let mut sim = under_way(&SimOptions { dump_dir: Some(dir.clone()), ..options.clone() });
    assert!(dumps(&dir).is_empty(), "{test}: nothing has broken yet");
    damage(&mut sim, env, change);
    step(&mut sim, 10);
    let robot = ROBOTS[env / 20];
    let name = format!("broken_{robot}_env{env}_step10.polypod");
    assert_eq!(dumps(&dir), [name.as_str()], "{test}");

    let file = dir.join(name);
    let dump = Dump::read(&file).unwrap();
    assert_eq!((dump.robot.as_str(), dump.seed, dump.state.env.0 as usize), (robot, 7, env), "{test}");
    assert_eq!(dump.state.after.violation(&dump.state.limits).unwrap().quantity, quantity, "{test}");
    for simd in Simd::available() {
        let replayed = dump.replay(Some(simd)).unwrap();
        assert_eq!((replayed.simd, replayed.steps.len()), (simd, 4), "{test}");
        assert!(replayed.same_bits && replayed.broken.is_some(), "{test} on {}", simd.name());
    }
    let output = replay(&[file.to_str().unwrap()]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{text}{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.contains("the same bits came out"), "{text}");
    fs::remove_dir_all(dir).unwrap();
    text
}

#[test]
fn a_state_that_is_not_finite() {
    let text = check("nan", 5, |_, velocity, _, _| velocity.linear[1] = f32::NAN, Quantity::BasePosition);
    assert!(text.contains("anymal_d, env 5, control step 10"), "{text}");
    assert!(text.contains("broken before the control step already: linear velocity y of the base is NaN"), "{text}");
    check("inf", 33, |_, _, joints, _| joints.position[2] = f32::INFINITY, Quantity::BasePosition);
}

#[test]
fn a_state_that_runs_away() {
    check("bullet", 12, |_, velocity, _, _| velocity.linear = [900.0, 0.0, 0.0], Quantity::BaseLinearVelocity);
    check("rocket", 50, |_, velocity, _, _| velocity.linear[2] = 500.0, Quantity::BaseLinearVelocity);
}

#[test]
fn a_state_on_ground_that_resists_turning() {
    let options = turning(options(None));
    check_in(&options, "turning", 33, |_, velocity, _, _| velocity.angular[2] = 250.0, Quantity::BaseAngularVelocity);
}

/// The state is sound, the numbers of the robot are not: the control step itself breaks it.
#[test]
fn a_body_that_cannot_be_simulated() {
    let text = check("weightless", 25, |_, _, _, body| body.0.mass.fill(f32::NAN), Quantity::BasePosition);
    assert!(!text.contains("already"), "{text}");
    assert!(text.contains("physics step 1 of 4: position x of the base is NaN"), "{text}");
}

/// A replay has one physics step per control step: delayed targets must come out as they went in,
/// whatever the delay.
#[test]
fn delayed_targets_are_replayed() {
    let dir = directory("delay");
    let mut sim = under_way(&options(Some(&dir)));
    let with_delay = (0..NUM_ENVS).find(|&env| {
        let world = sim.world_mut();
        let mut delays = world.query::<(&EnvId, &ActuatorDelay)>();
        delays.iter(world).any(|(id, delay)| id.0 as usize == env && delay.0.iter().any(|&d| d > 0.0))
    });
    let env = with_delay.expect("one of the robots has delayed actuators");
    for most in 1..=4u32 {
        // the joints' motion depends on the targets; the base's speed is what breaks
        let mut sim = under_way(&options(Some(&dir)));
        let world = sim.world_mut();
        let mut robots = world.query::<(&EnvId, &mut ActuatorDelay, &mut BaseVelocity)>();
        for (id, mut delay, mut velocity) in robots.iter_mut(world) {
            if id.0 as usize == env {
                delay.0.fill(most as f32);
                velocity.linear[0] = 150.0;
            }
        }
        step(&mut sim, 10);
        let names = dumps(&dir);
        let dump = Dump::read(&dir.join(&names[0])).unwrap();
        let [newest, older, ..] = &dump.state.targets.history[..] else { panic!("no history") };
        assert_ne!(newest, older, "the targets must tell the delays apart");
        assert!(dump.replay(None).unwrap().same_bits, "delay {most}");
        fs::remove_dir_all(&dir).unwrap();
    }
}

#[test]
fn each_robot_is_dumped_once() {
    for threads in [1, 4] {
        let dir = directory(&format!("once_{threads}"));
        let mut sim = under_way(&SimOptions { threads: Some(threads), ..options(Some(&dir)) });
        // the lowest env counts, whichever thread comes first
        for env in [18, 7, 55] {
            damage(&mut sim, env, |_, velocity, _, _| velocity.linear[2] = f32::NAN);
        }
        step(&mut sim, 10);
        let first = ["broken_anymal_d_env7_step10.polypod", "broken_unitree_a1_env55_step10.polypod"];
        assert_eq!(dumps(&dir), first, "{threads} threads");
        for t in 11..20 {
            for env in [3, 7, 18, 55] {
                damage(&mut sim, env, |_, velocity, _, _| velocity.linear[2] = f32::NAN);
            }
            if t == 15 {
                // neither a new episode nor another directory makes a robot due again
                sim.reset(Some(1), None).unwrap();
                sim.set_dump_dir(None).unwrap();
                sim.set_dump_dir(Some(dir.clone())).unwrap();
            }
            step(&mut sim, t);
        }
        assert_eq!(dumps(&dir), first, "{threads} threads");
        damage(&mut sim, 30, |_, velocity, _, _| velocity.linear[2] = f32::NAN);
        step(&mut sim, 20);
        assert_eq!(dumps(&dir).len(), 3, "a robot that had not broken before");
        fs::remove_dir_all(dir).unwrap();
    }
}

#[test]
fn dumping_changes_no_bits() {
    let dir = directory("bits");
    for autoreset in [Autoreset::SameStep, Autoreset::NextStep] {
        let mut dumping = under_way(&SimOptions { autoreset, ..options(Some(&dir)) });
        let mut plain = under_way(&SimOptions { autoreset, ..options(None) });
        for t in 10..40 {
            for sim in [&mut dumping, &mut plain] {
                if t == 10 {
                    damage(sim, 6, |_, velocity, _, _| velocity.linear[0] = f32::NAN);
                    damage(sim, 44, |pose, _, _, _| pose.position[2] = f32::INFINITY);
                }
                step(sim, t);
            }
            assert_all_same(&mut dumping, &mut plain, &format!("{autoreset:?}, step {t}"));
        }
        assert!(dumping.snapshot().unwrap() == plain.snapshot().unwrap(), "{autoreset:?}");
        assert_eq!(dumps(&dir).len(), 2);
        fs::remove_dir_all(&dir).unwrap();
    }
}

#[test]
fn a_dump_that_cannot_be_written_stops_nothing() {
    let dir = directory("unwritable");
    fs::create_dir_all(&dir).unwrap();
    let file = dir.join("a file");
    fs::write(&file, "in the way").unwrap();
    let mut sim = under_way(&options(Some(&file)));
    damage(&mut sim, 6, |_, velocity, _, _| velocity.linear[0] = f32::NAN);
    step(&mut sim, 10);
    assert!(sim.batch().terminated[6]);
    step(&mut sim, 11);
    assert_eq!(fs::read_to_string(&file).unwrap(), "in the way");

    // a file of an earlier run is evidence too
    let taken = dir.join("broken_anymal_d_env6_step10.polypod");
    fs::write(&taken, "evidence").unwrap();
    let mut sim = under_way(&options(Some(&dir)));
    damage(&mut sim, 6, |_, velocity, _, _| velocity.linear[0] = f32::NAN);
    step(&mut sim, 10);
    assert_eq!(fs::read_to_string(&taken).unwrap(), "evidence");
    assert_eq!(dumps(&dir).len(), 2, "a temporary file was left behind");
    fs::remove_dir_all(dir).unwrap();
}

#[test]
fn other_files_are_refused_and_other_bits_are_told() {
    let dir = directory("files");
    let mut sim = under_way(&options(Some(&dir)));
    damage(&mut sim, 6, |_, velocity, _, _| velocity.linear[0] = 150.0);
    step(&mut sim, 10);
    let file = dir.join(&dumps(&dir)[0]);
    let dump = Dump::read(&file).unwrap();
    let bytes = fs::read(&file).unwrap();
    let check = |bytes: &[u8], word: &str| {
        let bad = dir.join("bad.polypod");
        fs::write(&bad, bytes).unwrap();
        let output = replay(&[bad.to_str().unwrap()]);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(error.contains("bad.polypod") && error.contains(word), "{error}");
    };
    check(b"", "is no dump");
    check(b"something else altogether", "is no dump");
    check(&sim.snapshot().unwrap(), "is no dump");
    check(&bytes[..bytes.len() - 1], "damaged");
    check(&bytes[..bytes.len() / 2], "damaged");
    for at in (40..bytes.len()).step_by(bytes.len() / 5) {
        let mut flipped = bytes.clone();
        flipped[at] ^= 4;
        check(&flipped, "damaged");
    }
    assert_eq!(replay(&[dir.join("missing.polypod").to_str().unwrap()]).status.code(), Some(2));
    assert_eq!(replay(&[file.to_str().unwrap(), "--simd", "mmx"]).status.code(), Some(2));

    // a dump in which one number is another one does not give the dumped bits, and one that is
    // sound does not break
    for (change, word) in [
        ((|dump| dump.state.before.joints.velocity[3] += 0.5) as fn(&mut Dump), "other bits"),
        (|dump| dump.state.before.velocity.linear[0] = 1.0, "does not break"),
    ] {
        let mut other = dump.clone();
        change(&mut other);
        let file = other.write(&dir.join(word.replace(' ', "_"))).unwrap();
        let output = replay(&[file.to_str().unwrap(), "--steps-print"]);
        assert_eq!(output.status.code(), Some(1));
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(error.contains(word), "{error}");
    }
    // nor is one of another robot stepped with this one's numbers
    let mut other = dump.clone();
    other.state.before.joints.position.pop();
    let output = replay(&[other.write(&dir.join("joints")).unwrap().to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(2));
    fs::remove_dir_all(dir).unwrap();
}
