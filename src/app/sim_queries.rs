//! Queries and changes of a caller between control steps: states of the robots, ends of their
//! episodes.

use bevy_ecs::prelude::*;
use glam::{DMat3, DQuat, DVec3};

use super::Sim;
use crate::batch::Batch;
use crate::bounds::MAX_COMMAND;
use crate::components::{
    BasePose, BaseVelocity, Command, CommandNumbers, ContactForces, EnvId, Episode, JointState, Robot,
};
use crate::config::did_you_mean;
use crate::error::Error;
use crate::geometry_export::quaternion;
use crate::morphology::{BatchSlots, Morphologies};
use crate::options::Autoreset;
use crate::robot::Pose;
use crate::simulation::LinkPoses;
use crate::systems::{StateField, gather_state};

impl Sim {
    /// Writes one quantity of all robots, row-major `[num_envs, width]` with
    /// [`state_width`](Self::state_width); joints and feet are in the columns of
    /// [`slots`](Self::slots), zero where a robot has none.
    ///
    /// # Errors
    /// An array of another length.
    pub fn state(&mut self, field: StateField, out: &mut [f32]) -> Result<(), Error> {
        let wanted = self.num_envs() * self.state_width(field);
        if out.len() != wanted {
            let problem = format!("{} numbers for {} of {} envs", out.len(), field.name(), self.num_envs());
            return Err(Error::argument("state", problem, format!("pass an array of {wanted} numbers")));
        }
        gather_state(self.world_mut(), field, out)
    }

    /// Numbers per robot of a quantity.
    pub fn state_width(&self, field: StateField) -> usize {
        field.width(self.slots())
    }

    /// The columns of the batch: slots of joints, and legs of feet.
    pub fn slots(&self) -> &BatchSlots {
        &self.world().resource::<Morphologies>().1
    }

    /// Ends the episodes of these envs as failed, as a termination of the task would have in the
    /// last control step: the logs count them, and they must be reset. An episode that ran out of
    /// time in that step has failed instead.
    ///
    /// # Errors
    /// A mask of the wrong length, or a simulation that resets ended episodes by itself.
    pub fn terminate(&mut self, mask: &[bool]) -> Result<(), Error> {
        self.end_episodes(mask, true)
    }

    /// Ends the episodes of these envs as out of time, as a termination of the task with `time_out`
    /// would have in the last control step. An episode that failed in that step stays failed.
    ///
    /// # Errors
    /// As [`terminate`](Self::terminate).
    pub fn truncate(&mut self, mask: &[bool]) -> Result<(), Error> {
        self.end_episodes(mask, false)
    }

    fn end_episodes(&mut self, mask: &[bool], has_failed: bool) -> Result<(), Error> {
        if mask.len() != self.num_envs() {
            let problem = format!("{} entries for {} envs", mask.len(), self.num_envs());
            return Err(Error::argument("mask", problem, "pass one entry per env"));
        }
        if *self.world().resource::<Autoreset>() != Autoreset::Disabled {
            let problem = "this simulation resets ended episodes by itself, before anyone can end more";
            return Err(Error::argument("autoreset", problem, "make it with autoreset disabled"));
        }
        let world = self.world_mut();
        for (env, mut episode) in world.query::<(&EnvId, &mut Episode)>().iter_mut(world) {
            if mask[env.0 as usize] {
                episode.terminated |= has_failed;
                episode.truncated = !episode.terminated;
                episode.needs_reset = true;
            }
        }
        let mut batch = world.resource_mut::<Batch>();
        for (env, _) in mask.iter().enumerate().filter(|(_, ends)| **ends) {
            batch.terminated[env] |= has_failed;
            batch.truncated[env] = !batch.terminated[env];
        }
        Ok(())
    }

    /// Changes episode lengths, control steps, `[num_envs]`: a learner spreads the resets that way.
    ///
    /// # Errors
    /// The wrong number of entries, or one beyond a full episode.
    pub fn set_episode_lengths(&mut self, lengths: &[i64]) -> Result<(), Error> {
        let most = i64::from(self.task().max_episode_length);
        if lengths.len() != self.num_envs() || lengths.iter().any(|l| !(0..=most).contains(l)) {
            let problem = format!("not {} numbers between 0 and {most}", self.num_envs());
            return Err(Error::argument("episode_length", problem, "pass one length per env, in control steps"));
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
    /// The wrong number of numbers, or a non-finite one; a task without a velocity command.
    pub fn set_commands(&mut self, commands: Option<&[f32]>) -> Result<(), Error> {
        let envs: Vec<usize> = (0..self.num_envs()).collect();
        self.set_commands_of(&envs, commands)
    }

    /// Pins the commands of some envs to these, row-major `[envs, 3]`, or releases them; those of
    /// other envs stay as they are.
    ///
    /// # Errors
    /// As [`set_commands`](Self::set_commands); an env that does not exist or is there twice.
    pub fn set_commands_of(&mut self, envs: &[usize], commands: Option<&[f32]>) -> Result<(), Error> {
        let places = self.places("set_command: env_ids", envs)?;
        if let Some(c) = commands
            && (c.len() != 3 * envs.len() || c.iter().any(|x| !x.is_finite()))
        {
            let problem = format!("not {} finite rows of vx, vy, yaw rate", envs.len());
            return Err(Error::argument("command", problem, "pass one row per env"));
        }
        let beyond = |x: &f32| f64::from(x.abs()) > MAX_COMMAND;
        if let Some(c) = commands
            && let Some(at) = c.iter().position(beyond)
        {
            let problem = format!("{} of env {} is {}", ["vx", "vy", "the yaw rate"][at % 3], envs[at / 3], c[at]);
            return Err(Error::argument(
                "command",
                problem,
                format!("pass numbers within {MAX_COMMAND}, m/s or rad/s"),
            ));
        }
        if commands.is_some() && !self.task().has_velocity_command() {
            let task = &self.task().config;
            let given: Vec<&str> = task.commands.names().collect();
            let given = if given.is_empty() { "no command".to_owned() } else { given.join(", ") };
            let problem = format!("{} gives {given}, and no velocity command (`base_velocity`)", task.name);
            return Err(Error::argument("command", problem, "use a task with [commands.base_velocity]"));
        }
        let world = self.world_mut();
        for (env, mut command) in world.query::<(&EnvId, &mut Command)>().iter_mut(world) {
            let Some(row) = places[env.0 as usize] else {
                continue;
            };
            command.pinned = commands.is_some();
            if let Some(c) = commands {
                command.velocity = [c[3 * row], c[3 * row + 1], c[3 * row + 2]];
                command.standing = command.velocity == [0.0; 3];
                command.holds_heading = false;
            }
        }
        Ok(())
    }
}

impl Sim {
    /// Pins a command other than the velocity to these numbers, row-major `[num_envs, columns]`, or
    /// releases it: the next draw follows its time.
    ///
    /// # Errors
    /// As [`pin_command_of`](Self::pin_command_of).
    pub fn pin_command(&mut self, name: &str, numbers: Option<&[f32]>) -> Result<(), Error> {
        let envs: Vec<usize> = (0..self.num_envs()).collect();
        self.pin_command_of(&envs, name, numbers)
    }

    /// Pins or releases a command in some envs, row-major `[envs, columns]`; other envs stay as
    /// they are.
    ///
    /// # Errors
    /// A command that the task does not give; the wrong number of numbers, or one that is not
    /// finite or beyond 1000; an env that does not exist or is there twice.
    pub fn pin_command_of(&mut self, envs: &[usize], name: &str, numbers: Option<&[f32]>) -> Result<(), Error> {
        let places = self.places("set_command: env_ids", envs)?;
        let bit = self.place_of_command(name)?;
        let term = &self.task().command_terms[bit];
        let (range, columns) = (term.range.clone(), term.columns);
        let is_allowed = |x: &f32| f64::from(x.abs()) <= MAX_COMMAND;
        if let Some(numbers) = numbers
            && (numbers.len() != columns.len() * envs.len() || !numbers.iter().all(is_allowed))
        {
            let problem = format!("not {} rows of {} within {MAX_COMMAND}", envs.len(), columns.join(", "));
            return Err(Error::argument("command", problem, "pass one row per env"));
        }
        let world = self.world_mut();
        for (env, mut command) in world.query::<(&EnvId, &mut CommandNumbers)>().iter_mut(world) {
            let Some(row) = places[env.0 as usize] else {
                continue;
            };
            match numbers {
                Some(numbers) => {
                    let at = columns.len() * row;
                    command.numbers[range.clone()].copy_from_slice(&numbers[at..at + columns.len()]);
                    command.pinned |= 1 << bit;
                }
                None => command.pinned &= !(1 << bit),
            }
        }
        Ok(())
    }

    /// Present numbers of a command other than the velocity, row-major `[num_envs, columns]`.
    ///
    /// # Errors
    /// A command that the task does not give.
    pub fn command_numbers(&mut self, name: &str) -> Result<Vec<f32>, Error> {
        let term = &self.task().command_terms[self.place_of_command(name)?];
        let (range, columns) = (term.range.clone(), term.columns.len());
        let mut numbers = vec![0.0; columns * self.num_envs()];
        let world = self.world_mut();
        for (env, command) in world.query::<(&EnvId, &CommandNumbers)>().iter(world) {
            let at = columns * env.0 as usize;
            numbers[at..at + columns].copy_from_slice(&command.numbers[range.clone()]);
        }
        Ok(numbers)
    }

    /// Place of a command among those other than the velocity.
    fn place_of_command(&self, name: &str) -> Result<usize, Error> {
        let terms = &self.task().command_terms;
        terms.iter().position(|term| term.name == name).ok_or_else(|| {
            let problem = format!("{} gives no command `{name}`", self.task().config.name);
            let known = did_you_mean(name, terms.iter().map(|term| term.name.as_str()), "commands");
            Error::argument("command", problem, known)
        })
    }
}

/// State of the robots of one kind, row-major, a row per env; see [`simulation`](crate::simulation)
/// for the layout.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotStates {
    /// `[envs, 7 + joints]`; the position is relative to the env's origin.
    pub qpos: Vec<f64>,
    /// `[envs, 6 + joints]`.
    pub qvel: Vec<f64>,
}

impl Sim {
    /// States of the envs of the robot at place `index`.
    pub fn robot_states(&mut self, index: usize) -> RobotStates {
        let envs = self.env_ids(index);
        let joints = self.morphologies().get(index).map_or(0, |model| model.topology.num_joints());
        let (nq, nv) = (7 + joints, 6 + joints);
        let mut states = RobotStates { qpos: vec![0.0; envs.len() * nq], qvel: vec![0.0; envs.len() * nv] };
        let world = self.world_mut();
        let mut robots = world.query_filtered::<(&EnvId, &BasePose, &BaseVelocity, &JointState), With<Robot>>();
        for (env, pose, velocity, joints) in robots.iter(world) {
            let env = env.0 as usize;
            if envs.contains(&env) {
                let row = env - envs.start;
                let position = pose.position.iter().chain(&pose.rotation).chain(&joints.position);
                let rate = velocity.linear.iter().chain(&velocity.angular).chain(&joints.velocity);
                copy(&mut states.qpos[row * nq..(row + 1) * nq], position);
                copy(&mut states.qvel[row * nv..(row + 1) * nv], rate);
            }
        }
        states
    }

    /// Poses of the links of the robot at place `index`, relative to the env's origin.
    pub fn link_pose(&mut self, index: usize) -> LinkPoses {
        let states = self.robot_states(index);
        let envs = self.env_ids(index).len();
        let mut poses = LinkPoses { position: Vec::new(), quaternion: Vec::new() };
        let Some(robot) = self.morphologies().get(index) else {
            return poses;
        };
        for row in states.qpos.chunks_exact(states.qpos.len() / envs.max(1)) {
            let rotation = DQuat::from_xyzw(row[4], row[5], row[6], row[3]).normalize();
            let base = Pose { rotation: DMat3::from_quat(rotation), translation: DVec3::from_slice(row) };
            for link in robot.model.forward_kinematics(&row[7..]) {
                let link = base * link;
                poses.position.extend(link.translation.to_array());
                poses.quaternion.extend(quaternion(&link.rotation));
            }
        }
        poses
    }

    /// Net force on each contact body of the robot at place `index` in the last physics step, world
    /// axes, N, `[envs, bodies, 3]`.
    pub fn contact_forces(&mut self, index: usize) -> Vec<f64> {
        let envs = self.env_ids(index);
        let Some(model) = self.morphologies().get(index) else {
            return Vec::new();
        };
        let (bodies, feet) = (model.topology.num_bodies, model.feet.clone());
        let width = 3 * bodies;
        let mut forces = vec![0.0; envs.len() * width];
        let world = self.world_mut();
        for (env, touching) in world.query_filtered::<(&EnvId, &ContactForces), With<Robot>>().iter(world) {
            let env = env.0 as usize;
            if envs.contains(&env) {
                let row = env - envs.start;
                copy(&mut forces[row * width..(row + 1) * width], touching.net(bodies, &feet).as_flattened().iter());
            }
        }
        forces
    }
}

fn copy<'a>(to: &mut [f64], from: impl Iterator<Item = &'a f32>) {
    for (x, y) in to.iter_mut().zip(from) {
        *x = f64::from(*y);
    }
}
