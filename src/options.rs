//! Options of a simulation.

use std::ops::Range;
use std::path::PathBuf;

use bevy_ecs::prelude::{Resource, World};

use crate::dynamics::lanes::Simd;
use crate::error::Error;

/// Options from which a simulation is made.
#[derive(Resource, Clone, Debug)]
pub struct SimOptions {
    /// Name, alias or path of the task.
    pub task: String,
    /// Names or paths of the robots; the task's own list when absent.
    pub robots: Option<Vec<String>>,
    /// Slots of the batch in addition to those of its robots, by name, for a policy that knows
    /// other robots too.
    pub slots: Vec<String>,
    /// Number of envs, shared out among the robots.
    pub num_envs: usize,
    /// Envs that are simulated here, in the order of the robots' blocks; other processes have the
    /// rest. All when absent.
    pub share: Option<Range<usize>>,
    /// Seed of all random streams.
    pub seed: u64,
    /// Threads; all cores when absent. No more are made than there are packs of envs.
    pub threads: Option<usize>,
    /// `key=value` changes to the task.
    pub overrides: Vec<String>,
    /// Party that resets ended episodes.
    pub autoreset: Autoreset,
    /// Directories laid out like the project, in which configs and assets are looked up first.
    pub roots: Vec<PathBuf>,
    /// Instruction set of the physics; when absent the value of `POLYPOD_SIMD`, or the fastest one.
    pub simd: Option<Simd>,
    /// Directory for a dump of the first broken state of each robot; no dumps when absent.
    pub dump_dir: Option<PathBuf>,
}

impl SimOptions {
    /// Defaults for a task: its robots, seed 0, all cores.
    pub fn new(task: impl Into<String>, num_envs: usize) -> Self {
        Self {
            task: task.into(),
            robots: None,
            slots: Vec::new(),
            num_envs,
            share: None,
            seed: 0,
            threads: None,
            overrides: Vec::new(),
            autoreset: Autoreset::SameStep,
            roots: Vec::new(),
            simd: None,
            dump_dir: None,
        }
    }

    /// The options that an app has as a resource.
    pub(crate) fn of(world: &World) -> Result<Self, Error> {
        world.get_resource::<Self>().cloned().ok_or_else(|| {
            let remedy = "insert it as a resource: app.insert_resource(SimOptions::new(task, num_envs))";
            Error::argument("SimOptions", "the app has none", remedy)
        })
    }
}

/// Party that resets an env whose episode has ended.
#[derive(Resource, Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Autoreset {
    /// The control step in which the episode ended.
    #[default]
    SameStep,
    /// The next control step, which only resets this env.
    NextStep,
    /// The caller alone.
    Disabled,
}

impl std::str::FromStr for Autoreset {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self, Error> {
        match name {
            "same_step" => Ok(Self::SameStep),
            "next_step" => Ok(Self::NextStep),
            "disabled" => Ok(Self::Disabled),
            _ => Err(Error::Argument {
                element: "autoreset",
                problem: format!("there is no mode `{name}`"),
                remedy: "use same_step, next_step or disabled".into(),
            }),
        }
    }
}
