//! Exact snapshots: everything that decides what happens next, as bytes.

use serde::{Deserialize, Serialize};

use super::Simulation;
use super::envs::{Env, EnvRows};
use super::options::Precision;
use super::robot::Robot;
use crate::dynamics::{Parameters, StepSettings};
use crate::error::Error;
use crate::hash::fnv1a;
use crate::sealed::{self, Header};

const KIND: &str = "polypod snapshot of a simulation";
/// Changes whenever the layout of a snapshot does.
const FORMAT: u32 = 9;

#[derive(Serialize, Deserialize)]
struct Snapshot {
    steps: u64,
    envs: Vec<Env>,
    bodies: Vec<Parameters<f64>>,
    /// Bytes that the engine keeps of each env beyond its numbers.
    engine: Vec<Vec<u8>>,
}

/// A hash of all that decides a step, except the state and the envs' own numbers. It covers the
/// substeps of the engine `avian`.
pub(super) fn fingerprint(robot: &Robot, settings: &StepSettings, avian_substeps: Option<usize>) -> u64 {
    let mut text = format!("{:?} {:?} {settings:?}", robot.topology, robot.nominal);
    if !robot.networks.is_empty() {
        text += &format!(" {:?}", robot.networks);
    }
    if let Some(substeps) = avian_substeps {
        text += &format!(" avian {substeps}");
    }
    fnv1a(text.as_bytes())
}

impl Simulation {
    fn header(&self) -> Header {
        let precision = if self.precision == Precision::Double { "double" } else { "single" };
        let robots = format!("{}, {precision} precision", self.robot.model.name);
        Header::new(KIND, FORMAT, robots, self.fingerprint, self.num_envs())
    }

    /// State, time, contact warm starts and all numbers of all envs. A restored simulation steps on
    /// with the same bits, for any number of threads and on any instruction set.
    ///
    /// # Errors
    /// When it cannot be encoded.
    pub fn snapshot(&self) -> Result<Vec<u8>, Error> {
        let unwritable = |error: postcard::Error| Error::Snapshot(error.to_string());
        let mut envs = vec![self.robot.env(); self.num_envs()];
        envs.iter_mut().enumerate().for_each(|(index, env)| self.engine.fetch(index, EnvRows::of(env)));
        let engine = self.engine.save().map_err(unwritable)?;
        let snapshot = Snapshot { steps: self.steps, envs, bodies: self.bodies.clone(), engine };
        sealed::seal(&self.header(), &snapshot).map_err(unwritable)
    }

    /// Restores a snapshot of a simulation with the same robot, options and number of envs.
    ///
    /// # Errors
    /// When the bytes are no snapshot, a damaged one or one of another simulation; the simulation
    /// is then as it was.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<(), Error> {
        let snapshot: Snapshot = sealed::open_as(bytes, &self.header()).map_err(Error::Snapshot)?;
        // check everything before anything is written
        let (topology, zeros) = (&self.robot.topology, self.robot.env());
        let envs_fit =
            snapshot.envs.len() == self.num_envs() && snapshot.envs.iter().all(|env| env.fits(&zeros, topology));
        let bodies_fit = snapshot.bodies.len() == self.num_envs()
            && snapshot.bodies.iter().zip(&self.bodies).all(|(body, ours)| body.has_sizes_of(ours));
        // steps are counted on from the snapshot's number
        if snapshot.steps > u64::MAX / 2 || !envs_fit || !bodies_fit {
            let problem = "its lists are of other lengths than this simulation's; pass what snapshot() gave";
            return Err(Error::Snapshot(problem.into()));
        }
        let unreadable = |error: postcard::Error| Error::Snapshot(format!("its engine's part cannot be read: {error}"));
        self.engine.check(&snapshot.engine).map_err(unreadable)?;
        self.steps = snapshot.steps;
        for (env, (mut state, mut body)) in snapshot.envs.into_iter().zip(snapshot.bodies).enumerate() {
            self.engine.restart(env, EnvRows::of(&mut state));
            // lists that did not change stay shared
            body.share(&self.bodies[env]);
            self.engine.upload(env, &body);
            self.bodies[env] = body;
        }
        self.engine.load(&snapshot.engine).map_err(unreadable)
    }
}
