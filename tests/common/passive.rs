//! Passive bodies that nothing touches, for the tests of the integrator.

use polypod::dynamics::{ContactSettings, Parameters, State, StepSettings, Topology};

use crate::common::control_step;

/// The engine's own steps, without ground.
pub fn move_freely(
    topology: &Topology,
    parameters: &Parameters<f64>,
    state: &mut State<f64>,
    gravity: [f64; 3],
    dt: f64,
    steps: usize,
) {
    let settings = StepSettings {
        dt,
        decimation: steps,
        gravity,
        contact: ContactSettings { ground: None, ..ContactSettings::default() },
    };
    control_step(topology, &settings, parameters, state);
}
