//! Input: TOML texts, each below a line `#! task`, `#! base`, `#! robot` or `#! set`. Text before
//! the first such line is a task.
//!
//! The task is `top.toml`, which may extend `base`; the robot is `fuzzed`; `set` has an override on
//! each line.

use polypod::config::{Library, TaskConfig, parse_params};
use polypod::morphology::{Morphologies, MorphologyModel};
use polypod::systems::{CompiledTask, Registry};
use polypod::{Sim, SimOptions};

use super::folder::{folder, put};

/// Largest counts of a scene that is built and stepped here: larger ones take time and show nothing
/// else.
const FEW: usize = 3;

/// Resolves the layers, checks what comes out, and steps the task if it is small.
pub fn run(data: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(data) else {
        return false;
    };
    let mut parts = [None, None, None, None];
    let mut at = 0;
    for line in text.split_inclusive('\n') {
        match ["task", "base", "robot", "set"].iter().position(|name| line.trim_end().strip_prefix("#! ") == Some(name))
        {
            Some(part) => at = part,
            None => parts[at].get_or_insert_with(String::new).push_str(line),
        }
    }
    let [task, base, robot, set] = parts;
    for (name, text) in
        [("configs/tasks/top.toml", task), ("configs/tasks/base.toml", base), ("configs/robots/fuzzed.toml", robot)]
    {
        put(name, text.as_ref().map(String::as_bytes));
    }
    let overrides: Vec<String> = set.iter().flat_map(|text| text.lines()).map(String::from).collect();
    resolve(overrides)
}

fn resolve(overrides: Vec<String>) -> bool {
    let library = Library::new(vec![folder()]);
    let says = |error: &dyn std::error::Error| assert!(!error.to_string().is_empty());
    let _ = library.robots().map_err(|error| says(&error));
    let _ = library.tasks().map_err(|error| says(&error));
    let _ = library.robot("fuzzed").map_err(|error| says(&error)).map(|robot| MorphologyModel::new(&robot));
    let task = match library.task("top", &overrides) {
        Ok(task) => task,
        Err(error) => {
            says(&error);
            return false;
        }
    };
    // the resolved config, written down and read again, means the same
    let text = task.resolved.to_string();
    let table = text.parse().unwrap_or_else(|error| panic!("{error}\n{text}"));
    let again: TaskConfig = parse_params("", "", &table).unwrap_or_else(|error| panic!("{error}\n{text}"));
    assert_eq!(again, task.config);
    let config = &task.config;
    if config.robots.len() > FEW {
        return true;
    }
    let Ok(robots) = config.robots.iter().map(|name| library.robot_in(name, config)).collect::<Result<Vec<_>, _>>()
    else {
        return true;
    };
    let Ok(morphologies) = robots.iter().map(MorphologyModel::new).collect::<Result<Vec<_>, _>>() else {
        return true;
    };
    let _ = CompiledTask::new(config, &Morphologies::in_batch(morphologies, &[]), &Registry::builtin());
    if is_small(config) {
        let num_envs = config.robots.len();
        let options =
            SimOptions { roots: vec![folder()], threads: Some(1), overrides, ..SimOptions::new("top", num_envs) };
        if let Ok(mut sim) = Sim::new(&options) {
            let actions = vec![0.5; sim.batch().actions.len()];
            (0..2).for_each(|_| sim.step(&actions).unwrap());
            let snapshot = sim.snapshot().unwrap();
            sim.restore(&snapshot).unwrap();
        }
    }
    true
}

fn is_small(config: &TaskConfig) -> bool {
    let rays: usize = config.sensors.height_scanner.as_ref().map_or(1, |scanner| scanner.counts().iter().product());
    let pixels = config.sensors.ray_caster_camera.as_ref().map_or(0, |camera| camera.pattern_cfg.num_pixels());
    config.scene.terrain.is_none()
        && config.scene.obstacles.len() <= FEW
        && config.sim.decimation <= 8
        && config.physics.solver_iterations <= 16
        && config.physics.avian_substeps <= 16
        && rays <= 1000
        && pixels <= 1000
}
