//! An exported policy acts in Rust as it does in Python, and walks.

use std::path::PathBuf;
use std::process::Output;

use polypod::Autoreset;
use polypod::{Sim, SimOptions};
use polypod_sim::policy::{Policy, PolicyManifest, sha256};
use serde::Deserialize;

/// Observations of the simulator and the actions that torch gives on them; written by
/// `tests/python/deploy/test_export.py`.
#[derive(Deserialize)]
struct Expected {
    observations: Vec<Vec<f32>>,
    actions: Vec<Vec<f32>>,
}

fn root() -> PathBuf {
    PathBuf::from(crate::ROOT)
}

fn shipped() -> PathBuf {
    root().join("python/polypod/policies/flat_universal/exported/policy.onnx")
}

#[test]
fn the_actions_are_those_of_python() {
    let text = std::fs::read_to_string(root().join("tests/data/policy_actions.json")).unwrap();
    let expected: Expected = serde_json::from_str(&text).unwrap();
    let rows = expected.observations.len();
    assert!(rows >= 16, "{rows} rows");
    let mut policy = Policy::load(&shipped(), rows).unwrap();
    let actions = policy.act(&expected.observations.concat()).unwrap();
    assert_eq!(actions.len(), rows * policy.manifest.num_actions);
    let wanted = expected.actions.concat();
    let spread = wanted.iter().fold(0.0f32, |most, x| most.max(x.abs()));
    assert!(spread > 1.0, "the actions say nothing: {spread}");
    for (i, (action, wanted)) in actions.iter().zip(&wanted).enumerate() {
        assert!((action - wanted).abs() < 1e-5 * wanted.abs().max(1.0), "number {i}: {action}, not {wanted}");
    }
}

#[test]
fn all_robots_follow_half_a_metre_per_second() {
    let manifest = PolicyManifest::beside(&shipped()).unwrap();
    let options = SimOptions {
        robots: Some(manifest.robots.clone()),
        autoreset: Autoreset::Disabled,
        seed: 3,
        ..SimOptions::new("Velocity-Flat-Universal-Play-v0", 4 * manifest.robots.len())
    };
    let mut sim = Sim::new(&options).unwrap();
    let envs = sim.num_envs();
    let mut policy = Policy::load(&shipped(), envs).unwrap();
    policy.check(&sim).unwrap();
    sim.set_commands(Some(&[0.5, 0.0, 0.0].repeat(envs))).unwrap();
    let width = sim.batch().num_obs;
    let mut forward = vec![0.0; envs];
    for step in 0..300 {
        let actions = policy.act(&sim.batch().observations).unwrap();
        sim.step(&actions).unwrap();
        assert!(!sim.batch().terminated.contains(&true), "a robot fell in step {step}");
        // the first second is for getting up to speed
        if step >= 50 {
            for (env, sum) in forward.iter_mut().enumerate() {
                *sum += sim.batch().observations[env * width] / 250.0;
            }
        }
    }
    for (env, speed) in forward.iter().enumerate() {
        let robot = env / 4;
        assert!((speed - 0.5).abs() < 0.25, "{} in env {env} walks at {speed} m/s", manifest.robots[robot]);
    }
}

#[test]
fn a_task_that_observes_something_else_is_refused() {
    let mut policy = Policy::load(&shipped(), 1).unwrap();
    let options = SimOptions { robots: Some(vec!["spot".into()]), ..SimOptions::new("velocity_flat", 1) };
    let error = policy.check(&Sim::new(&options).unwrap()).unwrap_err().to_string();
    for words in ["observation_layout", "morphology (35)", "Velocity-Flat-Universal-v0"] {
        assert!(error.contains(words), "{error}");
    }
    let error = policy.act(&[0.0; 5]).unwrap_err().to_string();
    assert!(error.contains("1 observations of 83 numbers"), "{error}");
}

fn play(arguments: &[&str]) -> Output {
    crate::polypod_sim(&["play"]).args(arguments).output().unwrap()
}

#[test]
fn the_command_line_reports_errors_falls_and_distance() {
    let policy = shipped();
    let arguments = ["--policy", policy.to_str().unwrap(), "--robot", "spot,unitree_a1", "--num-envs", "6"];
    let command = ["--steps", "150", "--command", "0.5", "-0.1", "0", "--json"];
    let output = play(&[&arguments[..], &command[..]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let played: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    for (robot, name) in played.as_array().unwrap().iter().zip(["spot", "unitree_a1"]) {
        let number = |key: &str| robot[key].as_f64().unwrap();
        assert_eq!(robot["robot"], name);
        assert_eq!(robot["envs"], 3);
        assert_eq!(robot["falls"], 0);
        assert!(number("error_vel_xy") < 0.3, "{robot}");
        assert!((number("distance") - 3.0 * 0.51).abs() < 0.5, "{robot}");
        assert!((number("episode_length_s") - 3.0).abs() < 1e-9, "{robot}");
    }
}

#[test]
fn bad_input_is_refused_in_one_line() {
    let folder = std::env::temp_dir().join(format!("polypod_policy_{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let manifest = std::fs::read_to_string(shipped().with_extension("json")).unwrap();
    let graph = std::fs::read(shipped()).unwrap();
    let mut flipped = graph.clone();
    *flipped.last_mut().unwrap() ^= 1;
    let broken = manifest.replace(&sha256(&graph), &sha256(b"no graph"));
    let folded = manifest.replace("\"kind\": \"policy\"", "\"kind\": \"robot\"");
    let future = manifest.replace("\"format\": 1", "\"format\": 9");
    let renamed = manifest.replace("\"policy.onnx\"", "\"policy_spot.onnx\"");
    let cases: [(&str, Option<&[u8]>, Option<&str>, &str); 6] = [
        ("missing", None, None, "keep a policy beside the manifest"),
        ("broken", Some(b"no graph"), Some(&broken), "is not the network of the manifest"),
        ("damaged", Some(&flipped), Some(&manifest), "its SHA-256 is not the manifest's"),
        ("renamed", Some(&graph), Some(&renamed), "is not of this manifest, whose files have no policy.onnx"),
        ("folded", Some(b""), Some(&folded), "pass policy.onnx"),
        ("future", Some(b""), Some(&future), "format: is 9, not 1"),
    ];
    for (name, graph, manifest, words) in cases {
        let file = folder.join(name).join("policy.onnx");
        std::fs::create_dir_all(folder.join(name)).unwrap();
        if let Some(graph) = graph {
            std::fs::write(&file, graph).unwrap();
        }
        if let Some(manifest) = manifest {
            std::fs::write(file.with_extension("json"), manifest).unwrap();
        }
        let output = play(&["--policy", file.to_str().unwrap(), "--robot", "spot", "--steps", "1"]);
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{name}: {errors}");
        assert!(errors.contains(words), "{name}: {errors}");
        assert_eq!(errors.trim_end().lines().count(), 1, "{name}: {errors}");
    }
    std::fs::remove_dir_all(&folder).unwrap();
}
