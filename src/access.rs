//! What a caller may read of the robots and change of their episodes between control steps.

use crate::app::{Sim, SimError, argument};
use crate::batch::Batch;
use crate::bounds::MAX_COMMAND;
use crate::components::{Command, EnvId, Episode};
use crate::systems::{Autoreset, StateField, gather_state};

impl Sim {
    /// Writes one quantity of all robots, row-major `[num_envs, field.width()]`; joints are in canonical order, feet in
    /// the order LF, LH, RF, RH.
    ///
    /// # Errors
    /// An array of another length.
    pub fn state(&mut self, field: StateField, out: &mut [f32]) -> Result<(), SimError> {
        let wanted = self.num_envs() * field.width();
        if out.len() != wanted {
            let problem = format!("{} numbers for {} of {} envs", out.len(), field.name(), self.num_envs());
            return Err(argument("state", problem, format!("pass an array of {wanted} numbers")));
        }
        gather_state(self.world_mut(), field, out);
        Ok(())
    }

    /// Ends the episodes of these envs as failed, as a termination of the task would have in the last control step: the
    /// logs count them, and they are to be reset. An episode that ran out of time in that step has failed instead.
    ///
    /// # Errors
    /// A mask of the wrong length, or a simulation that resets ended episodes by itself.
    pub fn terminate(&mut self, mask: &[bool]) -> Result<(), SimError> {
        if mask.len() != self.num_envs() {
            let problem = format!("{} entries for {} envs", mask.len(), self.num_envs());
            return Err(argument("mask", problem, "pass one entry per env"));
        }
        if *self.world().resource::<Autoreset>() != Autoreset::Disabled {
            let problem = "this simulation resets ended episodes by itself, before anyone can end more";
            return Err(argument("autoreset", problem, "make it with autoreset disabled"));
        }
        let world = self.world_mut();
        for (env, mut episode) in world.query::<(&EnvId, &mut Episode)>().iter_mut(world) {
            if mask[env.0 as usize] {
                (episode.terminated, episode.truncated, episode.needs_reset) = (true, false, true);
            }
        }
        let mut batch = world.resource_mut::<Batch>();
        for (env, _) in mask.iter().enumerate().filter(|(_, ends)| **ends) {
            (batch.terminated[env], batch.truncated[env]) = (true, false);
        }
        Ok(())
    }

    /// Changes episode lengths, control steps, `[num_envs]`: a learner spreads the resets that way.
    ///
    /// # Errors
    /// The wrong number of entries, or one beyond a full episode.
    pub fn set_episode_lengths(&mut self, lengths: &[i64]) -> Result<(), SimError> {
        let most = i64::from(self.task().max_episode_length);
        if lengths.len() != self.num_envs() || lengths.iter().any(|l| !(0..=most).contains(l)) {
            let problem = format!("not {} numbers between 0 and {most}", self.num_envs());
            return Err(argument("episode_length", problem, "pass one length per env, in control steps"));
        }
        let world = self.world_mut();
        for (env, mut episode) in world.query::<(&EnvId, &mut Episode)>().iter_mut(world) {
            episode.length = lengths[env.0 as usize] as u32;
        }
        Ok(())
    }

    /// Pins the commands to these, row-major `[num_envs, 3]`, or releases them.
    ///
    /// # Errors
    /// The wrong number of numbers, or a non-finite one.
    pub fn set_commands(&mut self, commands: Option<&[f32]>) -> Result<(), SimError> {
        if let Some(c) = commands
            && (c.len() != 3 * self.num_envs() || c.iter().any(|x| !x.is_finite()))
        {
            let problem = format!("not {} finite rows of vx, vy, yaw rate", self.num_envs());
            return Err(argument("command", problem, "pass one row per env"));
        }
        let beyond = |x: &f32| f64::from(x.abs()) > MAX_COMMAND;
        if let Some(c) = commands
            && let Some(at) = c.iter().position(beyond)
        {
            let problem = format!("{} of env {} is {}", ["vx", "vy", "the yaw rate"][at % 3], at / 3, c[at]);
            return Err(argument("command", problem, format!("pass numbers within {MAX_COMMAND}, m/s or rad/s")));
        }
        let world = self.world_mut();
        for (env, mut command) in world.query::<(&EnvId, &mut Command)>().iter_mut(world) {
            command.pinned = commands.is_some();
            if let Some(c) = commands {
                let at = 3 * env.0 as usize;
                command.velocity = [c[at], c[at + 1], c[at + 2]];
                command.standing = command.velocity == [0.0; 3];
                command.holds_heading = false;
            }
        }
        Ok(())
    }
}
