//! Input: the bytes of a URDF file.

use std::path::Path;

use polypod::robot::{Coupled, LoadOptions, Model, RobotError, check, load_str};
use polypod::{Control, Simulation, SimulationOptions};

use super::folder::put;

/// Links of a robot that is stepped too: what a step does with more of them is the same.
const FEW_LINKS: usize = 24;

/// Describes the robot as `polypod-sim check` does, and steps it.
pub fn run(data: &[u8]) -> bool {
    let path = put("robot.urdf", Some(data));
    // as `check` and simulations do, which hold joints that mimic others
    let options = LoadOptions { coupled: Coupled::Held, ..LoadOptions::default() };
    let described = check(&path, &options);
    let Ok(text) = std::str::from_utf8(data) else {
        assert!(described.is_err());
        return false;
    };
    match load_str(text, &path, &options) {
        Ok(model) => {
            assert!(described.is_ok_and(|text| text.contains("\nwarnings: ")));
            sound(&model, &path);
            true
        }
        Err(error) => {
            assert!(described.is_err());
            assert!(!matches!(error, RobotError::Parser(_)), "{error}");
            assert!(error.to_string().starts_with(&path.display().to_string()), "{error}");
            assert!(!error.diagnosis().remedy.is_empty(), "{error}");
            false
        }
    }
}

/// Parents come first, numbers are finite, and the robot can be simulated.
fn sound(model: &Model, path: &Path) {
    assert_eq!(model.links.len(), model.joints.len() + 1);
    assert!(model.links.iter().all(|link| link.mass > 0.0 && (link.mass as f32).is_finite()));
    assert!(model.joints.iter().enumerate().all(|(j, joint)| joint.parent <= j && joint.lower <= joint.upper));
    assert!(model.bodies.iter().all(|body| body.link < model.links.len() && !body.shapes.is_empty()));
    if model.links.len() > FEW_LINKS {
        return;
    }
    for fixed_base in [false, true] {
        let robot = path.display().to_string();
        let options = SimulationOptions { fixed_base, threads: Some(1), ..SimulationOptions::new(robot, 1) };
        let mut sim = Simulation::new(&options).unwrap_or_else(|error| panic!("it loads, but: {error}"));
        sim.step(&Control::default(), 2).unwrap();
    }
}
