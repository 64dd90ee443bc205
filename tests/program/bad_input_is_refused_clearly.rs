//! Bad input gives an error that names the element and says what to do; the command line says it in
//! one line.

use std::process::Output;

use polypod::config::ConfigErrorKind;
use polypod::simulation::Precision;
use polypod::{Error, Sim, SimOptions, Simulation, SimulationOptions};

use crate::common::{self, busy};

fn error(change: impl FnOnce(&mut SimOptions)) -> Error {
    let mut options = busy(&["anymal_c", "spot"], 4);
    change(&mut options);
    Sim::new(&options).err().expect("it must be refused")
}

#[track_caller]
fn assert_says(error: &Error, words: &[&str]) {
    let text = error.to_string();
    for word in words {
        assert!(text.contains(word), "`{text}` does not say `{word}`");
    }
    assert!(!text.contains('\n'), "more than a line: {text}");
}

#[track_caller]
fn assert_config(error: &Error, kind: ConfigErrorKind, words: &[&str]) {
    let found = match error {
        Error::Config(error) => error.kind,
        other => panic!("not a config error: {other:?}"),
    };
    assert_eq!(found, kind);
    assert_says(error, words);
}

#[track_caller]
fn assert_argument(error: &Error, name: &str, words: &[&str]) {
    assert!(matches!(error, Error::Argument { element, .. } if *element == name), "{error:?}");
    assert_says(error, &[name]);
    assert_says(error, words);
}

#[test]
fn names_that_do_not_exist() {
    let unknown = ConfigErrorKind::UnknownName;
    let e = error(|o| o.robots = Some(vec!["anymal_d".into(), "unitree_go3".into()]));
    assert_config(&e, unknown, &["unitree_go3", "did you mean `unitree_go"]);
    assert_config(&error(|o| o.task = "velocity_flatt".into()), unknown, &["velocity_flatt", "velocity_flat`"]);
    assert_config(
        &error(|o| o.task = "nonsense/task.toml".into()),
        ConfigErrorKind::Unreadable,
        &["nonsense/task.toml"],
    );
    let e = error(|o| o.overrides = vec!["observations.policy=[{ term = \"base_lin_vell\" }]".into()]);
    assert_config(&e, unknown, &["observations.policy[0]", "base_lin_vell", "did you mean `base_lin_vel`?"]);
}

#[test]
fn overrides_that_cannot_be_applied() {
    let overridden = |text: &str| error(|o| o.overrides = vec![text.into()]);
    let e = overridden("sim.decimatoin=2");
    assert_config(&e, ConfigErrorKind::UnknownKey, &["sim.decimatoin", "did you mean `decimation`?"]);
    let e = overridden("sim.decimation=-1");
    assert_config(&e, ConfigErrorKind::InvalidValue, &["sim.decimation"]);
    let e = overridden("rewards.spot.gait.stdd=0.1");
    assert_config(&e, ConfigErrorKind::UnknownKey, &["rewards.spot.gait", "stdd", "did you mean `std`?"]);
    assert!(matches!(overridden("sim.decimation"), Error::Config(_)));
    let e = error(|o| o.overrides = ["physics.engine=avian", "sim.dt=1e-6"].map(String::from).to_vec());
    assert_argument(&e, "physics.engine", &["too short", "sim.dt"]);
}

#[test]
fn arguments_out_of_range() {
    let robots = |names: &[&str]| Some(names.iter().map(|name| name.to_string()).collect::<Vec<_>>());
    assert_argument(&error(|o| o.robots = robots(&[])), "robots", &["empty", "at least one"]);
    assert_argument(
        &error(|o| o.robots = robots(&["spot", "anymal_c", "spot"])),
        "robots",
        &["`spot`", "twice", "once"],
    );
    assert_argument(&error(|o| o.num_envs = 1), "num_envs", &["1 envs for 2 robots", "at least 2"]);
    assert_argument(&error(|o| o.num_envs = 0), "num_envs", &["at least 2"]);
    assert_argument(&error(|o| o.threads = Some(0)), "threads", &["0 threads", "1 to 1024"]);
    for num_envs in [usize::MAX, 1 << 40, 1 << 31, (1 << 24) + 1] {
        assert_argument(&error(|o| o.num_envs = num_envs), "num_envs", &[&num_envs.to_string(), "16777216"]);
    }
    let spot = |num_envs| Simulation::new(&SimulationOptions::new("spot", num_envs)).err().unwrap().to_string();
    for num_envs in [usize::MAX, 1 << 31] {
        let message = spot(num_envs);
        assert!(message.starts_with("num_envs: ") && message.contains("16777216"), "{message}");
    }
}

#[test]
fn there_are_no_more_threads_than_work_for_them() {
    let mut options = busy(&["anymal_c", "spot"], 4);
    options.threads = Some(200);
    let sim = Sim::new(&options).unwrap();
    assert!(sim.threads() <= 4, "{} threads", sim.threads());
    for (engine, precision) in
        [("articulated", Precision::Single), ("articulated", Precision::Double), ("avian", Precision::Single)]
    {
        let options = SimulationOptions {
            engine: engine.into(),
            precision,
            threads: Some(200),
            ..SimulationOptions::new("spot", 5)
        };
        let sim = Simulation::new(&options).unwrap();
        assert!(sim.threads() <= 5, "{} threads, {engine}", sim.threads());
    }
}

#[test]
fn a_refused_call_leaves_the_simulation_as_it_was() {
    let mut sim = Sim::new(&busy(&["anymal_c", "spot"], 4)).unwrap();
    common::step(&mut sim, 0);
    let before = sim.snapshot().unwrap();
    let good = vec![0.1; 48];

    assert_argument(&sim.step(&good[..47]).unwrap_err(), "actions", &["47 numbers", "4 envs of 12"]);
    assert_argument(&sim.step(&[]).unwrap_err(), "actions", &["0 numbers"]);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut actions = good.clone();
        actions[2 * 12 + 5] = bad;
        assert_argument(&sim.step(&actions).unwrap_err(), "actions", &["env 2", "LH_HFE", "finite"]);
    }
    for bad in [1e19, -1e19, 1.1e6, f32::MAX] {
        let mut actions = good.clone();
        actions[2 * 12 + 5] = bad;
        assert_argument(&sim.step(&actions).unwrap_err(), "actions", &["env 2", "LH_HFE", "1000000"]);
    }
    assert_argument(&sim.reset(None, Some(&[true; 3])).unwrap_err(), "mask", &["3 entries for 4 envs"]);
    assert_argument(&sim.reset(Some(1), Some(&[true; 4])).unwrap_err(), "seed", &["mask"]);
    assert_argument(&sim.set_episode_lengths(&[0; 3]).unwrap_err(), "episode_length", &["4 numbers"]);
    assert_argument(&sim.set_episode_lengths(&[0, 1, 2, -1]).unwrap_err(), "episode_length", &["between 0 and 60"]);
    assert_argument(&sim.set_episode_lengths(&[0, 1, 2, 61]).unwrap_err(), "episode_length", &["between 0 and 60"]);
    assert_argument(&sim.set_commands(Some(&[0.0; 11])).unwrap_err(), "command", &["4 finite rows"]);
    assert_argument(&sim.set_commands(Some(&[f32::NAN; 12])).unwrap_err(), "command", &["4 finite rows"]);

    let mut commands = [0.5; 12];
    commands[3 + 2] = -1e30;
    assert_argument(&sim.set_commands(Some(&commands)).unwrap_err(), "command", &["env 1", "yaw rate", "1000"]);

    assert!(sim.snapshot().unwrap() == before);
    assert_eq!(sim.seed(), 7);
    sim.step(&good).unwrap();
}

fn polypod_sim(arguments: &[&str]) -> Output {
    crate::polypod_sim(arguments).env("RUST_BACKTRACE", "1").output().unwrap()
}

#[test]
fn the_command_line_refuses_bad_input_with_one_line_and_exit_code_2() {
    for (arguments, words) in [
        (&["rollout", "--robots", "unitree_go3"][..], &["unitree_go3", "did you mean"][..]),
        (&["rollout", "--robots", "spot,spot"], &["`spot`", "twice"]),
        (&["rollout", "--task", "velocity_flatt"], &["velocity_flatt", "did you mean"]),
        (&["rollout", "--num-envs", "3"], &["num_envs", "at least 8"]),
        (&["rollout", "--threads", "0"], &["threads", "1 to 1024"]),
        (&["rollout", "--set", "sim.decimatoin=2"], &["sim.decimatoin", "did you mean `decimation`?"]),
        (&["rollout", "--num-envs", "18446744073709551615"], &["num_envs", "16777216"]),
        (&["rollout", "--set", "sim.decimation=1000000000"], &["sim.decimation", "1 to 1000"]),
        (&["soak", "--minutes", "0"], &["minutes", "at least 1"]),
        (&["soak", "--robots", "spot", "--num-envs", "0"], &["num_envs", "at least 1"]),
        (&["soak", "--robots", "spot", "--num-envs", "1", "--dt", "nan"], &["dt"]),
        (&["inspect", "--robot", "spott"], &["spott", "did you mean `spot`?"]),
    ] {
        let output = polypod_sim(arguments);
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {text}");
        assert!(text.starts_with("error: ") && text.trim_end().lines().count() == 1, "{arguments:?}: {text}");
        assert!(words.iter().all(|word| text.contains(word)), "{arguments:?}: {text}");
        assert!(output.stdout.is_empty(), "{arguments:?}");
    }
    // an error of clap is bad input, too
    assert_eq!(polypod_sim(&["rollout", "--num-envs", "many"]).status.code(), Some(2));
}

#[test]
fn the_command_line_lists_inspects_and_steps() {
    let output = polypod_sim(&["list"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!((output.status.code(), output.stderr.as_slice()), (Some(0), &b""[..]));
    for name in common::ROBOTS.into_iter().chain(["velocity_flat"]) {
        assert!(text.contains(name), "{name} is not listed:\n{text}");
    }
    for arguments in
        [&["inspect", "--robot", "spot"][..], &["rollout", "--num-envs", "8", "--steps", "2", "--threads", "1"]]
    {
        let output = polypod_sim(arguments);
        assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
        assert!(String::from_utf8(output.stdout).unwrap().contains("spot"), "{arguments:?}");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn endless_files_are_refused() {
    use std::os::unix::fs::symlink;

    let root = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("endless");
    let _ = std::fs::remove_dir_all(&root);
    std::fs::create_dir_all(root.join("configs/robots")).unwrap();
    let robot = root.join("configs/robots/endless.toml");
    symlink("/dev/zero", &robot).unwrap();
    let robot = robot.to_str().unwrap();
    for arguments in [&["replay", "/dev/zero"][..], &["inspect", "--robot", robot]] {
        let output = polypod_sim(arguments);
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {text}");
        assert!(text.contains("larger than 64 MiB") && text.trim_end().lines().count() == 1, "{arguments:?}: {text}");
    }
}
