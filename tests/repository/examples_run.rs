//! The examples do what their first lines say.

use std::process::{Command, Output};

/// Cargo builds the examples together with the tests, in the folder next to theirs.
fn run(example: &str) -> Output {
    let tests = std::env::current_exe().unwrap();
    let program = tests
        .parent()
        .unwrap()
        .with_file_name("examples")
        .join(example)
        .with_extension(std::env::consts::EXE_EXTENSION);
    assert!(program.exists(), "{} is missing: cargo build --release --examples", program.display());
    let output = Command::new(program).output().unwrap();
    assert!(output.status.success(), "{example}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

#[test]
fn own_term_prints_what_its_term_gave_each_robot() {
    let text = String::from_utf8(run("own_term").stdout).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 2, "{text}");
    for (line, robot) in lines.iter().zip(["unitree_a1", "unitree_go2"]) {
        assert!(line.starts_with(robot), "{line}");
        // the term is a cost, so the sum is negative and finite
        let sum: f32 = line.split(' ').find_map(|word| word.parse().ok()).unwrap();
        assert!(sum < 0.0 && sum > -10.0, "{line}");
    }
}

#[test]
fn thrown_ball_prints_where_the_ball_is() {
    let text = String::from_utf8(run("thrown_ball").stdout).unwrap();
    assert_eq!(text.lines().count(), 5, "{text}");
    assert!(text.lines().all(|line| line.contains("m from the env's origin")), "{text}");
}

#[test]
fn headless_app_prints_what_the_policy_observes_of_its_component() {
    let text = String::from_utf8(run("headless_app").stdout).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 8, "{text}");
    for line in lines {
        let kelvin: f32 = line.trim_end_matches(" K").rsplit(' ').next().unwrap().parse().unwrap();
        assert!(kelvin > 0.0 && kelvin < 50.0, "{line}");
    }
}

#[test]
fn hosted_ends_by_the_clock_of_its_app() {
    let text = String::from_utf8(run("hosted").stdout).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 4, "{text}");
    for line in lines {
        let height: f32 = line.trim_end_matches(" m high").rsplit(' ').next().unwrap().parse().unwrap();
        assert!(height > 0.2 && height < 0.7, "{line}");
    }
}
