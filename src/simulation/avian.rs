//! The engine avian behind the same interface as the articulated one.

use super::packs::{Actuation, JointField, Packs};
use super::robot::Robot;
use super::rows::{EnvIds, Rows};
use crate::dynamics::{Parameters, State, StepSettings, Topology};
use crate::engine::avian::{Engine, EngineError, Settings};
use crate::error::Error;
use crate::workers::Workers;

/// A world of Avian's per thread.
pub(super) fn packs(
    robot: &Robot,
    settings: &StepSettings,
    substeps: usize,
    num_envs: usize,
    threads: usize,
) -> Result<Box<dyn Packs>, Error> {
    let of_engine = Settings { dt: settings.dt, substeps, gravity: settings.gravity, ground: settings.contact.ground };
    let (topology, nominal) = (&robot.topology, &robot.nominal);
    Engine::new(&robot.model, &robot.align, &robot.shape_pairs, topology, nominal, &of_engine, &[], num_envs, threads)
        .map(|engine| Box::new(AvianPacks { engine, explicit: Vec::new() }) as Box<dyn Packs>)
        .map_err(|error| {
            let element = match error {
                EngineError::Step(_) => "dt",
                EngineError::Prismatic(_) | EngineError::Order => "engine",
            };
            Error::argument(element, error.to_string(), "use \"articulated\", or another step or robot")
        })
}

struct AvianPacks {
    engine: Engine,
    explicit: Vec<bool>,
}

impl Packs for AvianPacks {
    fn read_state(&self, env: usize, state: &mut State<f64>) {
        state.clone_from(self.engine.state(env));
    }

    fn write_state(&mut self, env: usize, state: &State<f64>) {
        self.engine.set_state(env, state);
    }

    fn read_parameters(&self, env: usize, parameters: &mut Parameters<f64>) {
        parameters.clone_from(self.engine.parameters(env));
    }

    fn write_parameters(&mut self, env: usize, parameters: &Parameters<f64>) {
        self.engine.set_parameters(env, parameters);
    }

    fn write_joints(&mut self, envs: &EnvIds, field: JointField, rows: &Rows) {
        for row in 0..envs.len() {
            let env = envs.get(row);
            for joint in 0..self.engine.effort(env).len() {
                self.engine.set_joint(env, joint, field, rows.get(row, joint));
            }
        }
    }

    fn read_report(&self, env: usize, effort: &mut [f64], force: &mut [[f64; 3]]) {
        effort.copy_from_slice(self.engine.effort(env));
        force.copy_from_slice(self.engine.force(env));
    }

    fn write_report(&mut self, env: usize, effort: &[f64], force: &[[f64; 3]]) {
        self.engine.set_report(env, effort, force);
    }

    fn step(
        &mut self,
        topology: &Topology,
        _settings: &StepSettings,
        workers: &Workers,
        actuation: Actuation,
        n: usize,
    ) {
        let gains = actuation == Actuation::Targets;
        if gains {
            self.engine.clear_efforts();
        }
        self.explicit.clear();
        self.explicit.extend(topology.joints.iter().map(|joint| joint.explicit));
        self.engine.step(workers, &self.explicit, gains, n);
    }

    fn save(&self, env: usize) -> Result<Vec<u8>, postcard::Error> {
        self.engine.save(env)
    }

    fn check_saved(&self, envs: &[&[u8]]) -> Result<(), postcard::Error> {
        self.engine.saved(envs.iter().copied()).map(|_| ())
    }

    fn load(&mut self, envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        self.engine.load(envs)
    }

    fn link_drift(&self, env: usize) -> f64 {
        self.engine.drift(env)
    }
}
