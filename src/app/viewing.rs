//! Viewer's interface between control steps: reads the robots and pushes them.

use bevy_ecs::prelude::*;

use super::Sim;
use crate::bounds::MAX_PUSH;
use crate::components::{BasePose, BaseVelocity, EnvId, EnvOrigin, EpisodeSums, HeightScan, Robot};
use crate::error::Error;

impl Sim {
    /// Adds a velocity to the base of each robot, world axes, m/s, row-major `[num_envs, 3]`; zero
    /// leaves a robot alone.
    ///
    /// Readings of sensors follow in the next control step.
    ///
    /// # Errors
    /// The wrong number of numbers, or one that is not finite or beyond [`MAX_PUSH`].
    pub fn push(&mut self, velocity: &[f32]) -> Result<(), Error> {
        let num_envs = self.num_envs();
        if velocity.len() != 3 * num_envs {
            let problem = format!("{} numbers for {num_envs} envs", velocity.len());
            return Err(Error::argument("velocity", problem, "pass x, y and z for each env"));
        }
        // a NaN is within no bound
        let within = |x: &f32| x.abs() <= MAX_PUSH;
        if let Some(at) = velocity.iter().position(|x| !within(x)) {
            let problem = format!("{} of env {} is {} m/s", ["x", "y", "z"][at % 3], at / 3, velocity[at]);
            return Err(Error::argument("velocity", problem, format!("pass numbers within {MAX_PUSH} m/s")));
        }
        let world = self.world_mut();
        let mut robots = world.query_filtered::<(&EnvId, &mut BaseVelocity), With<Robot>>();
        for (env, mut base) in robots.iter_mut(world) {
            let first = 3 * env.0 as usize;
            for (axis, added) in base.linear.iter_mut().zip(&velocity[first..first + 3]) {
                *axis += added;
            }
        }
        Ok(())
    }

    /// Names of the reward terms of the robot at place `index`, in the order of
    /// [`reward_sums`](Self::reward_sums).
    pub fn reward_terms(&self, index: usize) -> Vec<&str> {
        self.task().rewards.get(index).into_iter().flatten().map(|term| term.name.as_str()).collect()
    }

    /// Weighted reward terms of the robot at place `index`, each summed over the episode so far,
    /// row-major `[envs, terms]`. All of a row add up to the rewards of its episode.
    pub fn reward_sums(&mut self, index: usize) -> Vec<f32> {
        let (envs, terms) = (self.env_ids(index), self.reward_terms(index).len());
        let mut rows = vec![0.0; envs.len() * terms];
        let world = self.world_mut();
        for (env, sums) in world.query::<(&EnvId, &EpisodeSums)>().iter(world) {
            let env = env.0 as usize;
            if envs.contains(&env) {
                let row = env - envs.start;
                for (to, from) in rows[row * terms..(row + 1) * terms].iter_mut().zip(&sums.terms) {
                    *to = *from;
                }
            }
        }
        rows
    }

    /// Points on the ground that the rays of each robot's height scanner hit, in the world, m,
    /// row-major `[num_envs, rays, 3]`; empty where the task has no scanner.
    pub fn height_scan(&mut self) -> Vec<f32> {
        let Some(scanner) = &self.task().config.sensors.height_scanner else {
            return Vec::new();
        };
        let rays = scanner.rays();
        let mut rows = vec![0.0; self.num_envs() * rays.len() * 3];
        let world = self.world_mut();
        let mut poses = vec![([0.0; 2], [0.0; 2]); rows.len() / (3 * rays.len()).max(1)];
        let mut robots = world.query_filtered::<(&EnvId, &BasePose), With<Robot>>();
        for (env, pose) in robots.iter(world) {
            poses[env.0 as usize] = (pose.forward(), [pose.position[0], pose.position[1]]);
        }
        for (env, origin) in world.query::<(&EnvId, &EnvOrigin)>().iter(world) {
            let at = &mut poses[env.0 as usize].1;
            *at = [at[0] + origin.position[0], at[1] + origin.position[1]];
        }
        for (env, scan) in world.query::<(&EnvId, &HeightScan)>().iter(world) {
            let env = env.0 as usize;
            // the scanner turns with the heading of the base alone
            let ([c, s], [x0, y0]) = poses[env];
            let points = rows[env * rays.len() * 3..].chunks_exact_mut(3);
            for ((point, [u, v]), height) in points.zip(&rays).zip(&scan.hits) {
                point.copy_from_slice(&[x0 + c * u - s * v, y0 + s * u + c * v, *height]);
            }
        }
        rows
    }
}
