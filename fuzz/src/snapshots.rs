//! Input: a simulation and a way to read the rest (one byte); then edits of a sound snapshot, or
//! bytes that follow its header.

use std::cell::RefCell;
use std::path::Path;

use polypod::morphology::Morphologies;
use polypod::systems::{CompiledTask, Logs};
use polypod::{Control, Sim, SimOptions, Simulation, SimulationOptions};

use super::edits::{edited, sealed, unsealed};

/// Steps after a restore.
const STEPS: usize = 3;
/// Bytes that a header has at most.
const HEADER: usize = 64;

/// Simulations that can be restored and stepped.
trait Restores {
    fn snapshot(&mut self) -> Vec<u8>;
    fn restore(&mut self, bytes: &[u8]) -> Result<(), String>;
    fn step(&mut self);
}

impl Restores for Sim {
    fn snapshot(&mut self) -> Vec<u8> {
        Sim::snapshot(self).unwrap()
    }
    fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        Sim::restore(self, bytes).map_err(|error| error.to_string())
    }
    fn step(&mut self) {
        let actions = vec![0.5; self.batch().actions.len()];
        Sim::step(self, &actions).unwrap();
        self.world_mut().resource_scope::<Logs, ()>(|world, mut logs| {
            let (task, morphologies) = (world.resource::<CompiledTask>(), world.resource::<Morphologies>());
            let _ = logs.stats(task, morphologies, false);
        });
    }
}

impl Restores for Simulation {
    fn snapshot(&mut self) -> Vec<u8> {
        Simulation::snapshot(self).unwrap()
    }
    fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        Simulation::restore(self, bytes).map_err(|error| error.to_string())
    }
    fn step(&mut self) {
        Simulation::step(self, &Control::default(), 1).unwrap();
    }
}

/// A simulation under way, and snapshots of it.
struct Target {
    sim: Box<dyn Restores>,
    /// Where it is before every input.
    home: Vec<u8>,
    /// Snapshot that is edited: an earlier state.
    base: Vec<u8>,
}

impl Target {
    fn new(mut sim: Box<dyn Restores>) -> Self {
        (0..7).for_each(|_| sim.step());
        let base = sim.snapshot();
        sim.step();
        Self { home: sim.snapshot(), base, sim }
    }
}

thread_local! {
    static TARGETS: RefCell<Vec<Target>> = RefCell::new(vec![
        Target::new(Box::new(Sim::new(&task("velocity_flat", &[])).unwrap())),
        Target::new(Box::new(Sim::new(&task("velocity_flat", &["physics.engine=avian"])).unwrap())),
        Target::new(Box::new(Sim::new(&task("velocity_rough", &SMALL_TERRAIN)).unwrap())),
        Target::new(Box::new(Simulation::new(&biped("articulated")).unwrap())),
        Target::new(Box::new(Simulation::new(&biped("avian")).unwrap())),
    ]);
}

const SMALL_TERRAIN: [&str; 5] = [
    "scene.terrain.num_rows=2",
    "scene.terrain.num_cols=2",
    "scene.terrain.border_width=1.0",
    "events.body_variation={ enabled = true }",
    "events.push_robot.interval_range_s=[0.02, 0.04]",
];

/// Two robots, short episodes and frequent commands: a few steps meet all of them.
fn task(name: &str, overrides: &[&str]) -> SimOptions {
    let usual = ["sim.episode_length_s=0.2", "commands.base_velocity.resampling_time_s=0.06"];
    SimOptions {
        robots: Some(vec!["unitree_a1".into(), "spot".into()]),
        threads: Some(1),
        overrides: usual.iter().chain(overrides).map(|text| text.to_string()).collect(),
        ..SimOptions::new(name, 2)
    }
}

fn biped(engine: &str) -> SimulationOptions {
    // fuzz targets and the tests of the program, from folders of two depths, compile this file
    let mut above = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().map(|of| of.join("tests/data/urdf/biped.urdf"));
    let robot = above.find(|file| file.exists()).unwrap_or_default().display().to_string();
    SimulationOptions { engine: engine.into(), threads: Some(1), ..SimulationOptions::new(robot, 2) }
}

/// Restores the bytes, and steps on if they are accepted. If not, the simulation is as it was.
pub fn run(data: &[u8]) -> bool {
    let Some((&mode, rest)) = data.split_first() else {
        return false;
    };
    TARGETS.with_borrow_mut(|targets| {
        let target = usize::from(mode) % targets.len();
        let Target { sim, home, base } = &mut targets[target];
        let body = unsealed(base);
        let bytes = match mode / 64 {
            0 | 1 => sealed(edited(body, rest)),
            2 => {
                let header = body.len().min(HEADER);
                sealed([&body[..header], rest].concat())
            }
            _ => rest.to_vec(),
        };
        match sim.restore(&bytes) {
            Ok(()) => {
                let _ = sim.snapshot();
                (0..STEPS).for_each(|_| sim.step());
                sim.restore(home).unwrap();
                assert!(sim.snapshot() == *home, "the simulation does not come back from what was restored");
                true
            }
            Err(error) => {
                assert!(error.starts_with("snapshot: "), "{error}");
                assert!(sim.snapshot() == *home, "a refused snapshot has changed the simulation: {error}");
                false
            }
        }
    })
}
