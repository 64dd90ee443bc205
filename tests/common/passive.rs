//! Passive bodies that nothing touches, for the tests of the integrator.

use polypod::dynamics::{
    ContactSettings, ControlStep, Drive, Parameters, Report, State, StepSettings, Topology, Workspace,
};

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
    ControlStep {
        topology,
        settings: &settings,
        terrain: None,
        parameters,
        nominal: None,
        drive: &Drive::zeros(topology, 1),
        substeps: 0..steps,
        state,
        report: &mut Report::zeros(topology, steps),
        work: &mut Workspace::new(topology),
    }
    .run();
}
