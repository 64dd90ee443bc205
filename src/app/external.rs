//! A task's terms that the caller computes, and changes of a task between control steps: what
//! observations and curricula outside of the pipeline need.

use crate::bounds::MAX_COMMAND;
use crate::components::{EnvId, EnvOrigin};
use crate::config::VELOCITY_COLUMNS;
use crate::config::quantities::{Quantity, Weight};
use crate::error::Error;
use crate::systems::{CompiledTask, observe_external};
use crate::world::Ground;

use super::Sim;

impl Sim {
    /// Number of values of one control step that the caller computes for each env: those of the
    /// observation terms that are declared as `external`, side by side.
    pub fn num_external(&self) -> usize {
        let own = self.task().observations.iter().filter(|term| term.is_external);
        own.map(|term| term.size / term.history).sum()
    }

    /// Writes the observation terms that the caller computes, `[num_envs, num_external]`, in the
    /// order of the groups, with their noise and history. Called once after each control step, and
    /// after a reset with its mask. Numbers of joints and feet are in the batch's columns.
    ///
    /// # Errors
    /// The wrong number of values, one that is not finite, or a mask of the wrong length.
    pub fn observe_external(&mut self, values: &[f32], mask: Option<&[bool]>) -> Result<(), Error> {
        if let Some(at) = values.iter().position(|x| !x.is_finite()) {
            let problem = format!("{} for env {}", values[at], at / self.num_external().max(1));
            return Err(Error::argument("values", problem, "pass finite numbers"));
        }
        observe_external(self.world_mut(), values, mask)?;
        self.lacks_external = false;
        Ok(())
    }

    /// Sets the weight of a reward term of the robot at place `index`. It is no part of snapshots.
    ///
    /// # Errors
    /// An unknown term, a weight out of range, or a term whose weight the task's curriculum sets.
    pub fn set_reward_weight(&mut self, index: usize, name: &str, weight: f64) -> Result<(), Error> {
        if !(Weight::LEAST..=Weight::MOST).contains(&weight) {
            let problem = format!("{weight} for {name}");
            return Err(Error::argument(
                "weight",
                problem,
                format!("pass a number from {} to {}", Weight::LEAST, Weight::MOST),
            ));
        }
        let mut task = self.world_mut().resource_mut::<CompiledTask>();
        let mut terms = task.rewards.get_mut(index).into_iter().flatten();
        if let Some(term) = terms.find(|term| term.name == name) {
            if term.set_weight(weight as f32) {
                return Ok(());
            }
            let problem = format!("a curriculum of the task sets that of `{name}` by control steps");
            return Err(Error::argument("weight", problem, "take its entry out of the task"));
        }
        let known = self.reward_terms(index).join(", ");
        Err(Error::argument("term", format!("the robot has no reward term `{name}`"), format!("use one of {known}")))
    }

    /// Sets the ranges of the velocity commands of the robot at place `index`: forward and left
    /// velocity, m/s, and yaw rate, rad/s. Commands that are sampled later lie in them. They are
    /// no part of snapshots.
    ///
    /// # Errors
    /// A range that is not finite, out of bounds or has its ends exchanged; no such robot; stages
    /// of the task's curriculum set the ranges.
    pub fn set_command_ranges(&mut self, index: usize, ranges: [[f64; 2]; 3]) -> Result<(), Error> {
        for ([low, high], name) in ranges.into_iter().zip(VELOCITY_COLUMNS) {
            if !(-MAX_COMMAND <= low && low <= high && high <= MAX_COMMAND) {
                let problem = format!("{name} is [{low}, {high}]");
                let remedy = format!("pass lower and upper end, in this order, within {MAX_COMMAND}");
                return Err(Error::argument("ranges", problem, remedy));
            }
        }
        let mut task = self.world_mut().resource_mut::<CompiledTask>();
        if index >= task.commands.len() {
            let problem = format!("there is no robot {index}");
            return Err(Error::argument("index", problem, format!("use one below {}", task.commands.len())));
        }
        if !task.set_velocity_ranges(index, ranges) {
            let remedy = "take its stages out of the task";
            return Err(Error::argument("ranges", "a curriculum of the task sets the ranges by control steps", remedy));
        }
        Ok(())
    }

    /// Moves envs to levels of the terrain, `[num_envs]`, in their columns; a negative level leaves
    /// an env where it is. An env that is moved must be reset before the next step.
    ///
    /// # Errors
    /// The wrong number of levels, one that the terrain lacks, or a task without levels.
    pub fn set_terrain_levels(&mut self, levels: &[i64]) -> Result<(), Error> {
        let Some(layout) = self.world.resource::<Ground>().layout.clone() else {
            return Err(Error::argument("levels", "the ground has none", "use a task with scene.terrain"));
        };
        if levels.len() != self.num_envs() || levels.iter().any(|level| *level >= i64::from(layout.num_rows)) {
            let problem = format!("not {} numbers below {}", self.num_envs(), layout.num_rows);
            return Err(Error::argument("levels", problem, "pass one level per env"));
        }
        let world = self.world_mut();
        for (env, mut origin) in world.query::<(&EnvId, &mut EnvOrigin)>().iter_mut(world) {
            if let Ok(level) = u32::try_from(levels[env.0 as usize]) {
                origin.terrain_level = level;
                origin.position = layout.origin(level, origin.terrain_column);
            }
        }
        Ok(())
    }
}
