//! Training without Python in the loop: the policy, the simulator and the update take turns on one team of threads.

use polypod_learner::{Episode, Learner, LearnerError, Losses, Options, Robot, Settings, Symmetry, Team};

use super::Sim;
use crate::error::Error;
use crate::workers::Workers;

impl Team for Workers {
    fn for_each<T: Send>(&self, tasks: Vec<T>, f: impl Fn(T) + Sync) {
        Workers::for_each(self, tasks.into_iter(), f);
    }
}

impl From<LearnerError> for Error {
    fn from(error: LearnerError) -> Self {
        Error::argument(error.element, error.problem, "change the train config, or pass what fits it")
    }
}

impl Sim {
    /// A learner for this simulation's envs, robots and observations, with the simulation's seed. Its networks' numbers are zero.
    ///
    /// # Errors
    /// Options that are out of range; a task of several observation groups.
    pub fn learner(&self, options: Options) -> Result<Learner, Error> {
        if let [_, other, ..] = &self.task().groups[..] {
            let problem = format!("the task has the observation group `{}` beside the policy's", other.name);
            return Err(Error::argument("observations", problem, "learn with rsl_rl, or from a task of one group"));
        }
        let has_mirrors = options.symmetry != Symmetry::None;
        let robots = self.morphologies().iter().enumerate().map(|(index, robot)| {
            let envs = self.env_ids(index);
            let (observation_mirror, action_mirror) = if has_mirrors {
                (self.task().mirrored_observation(robot), robot.mirrored_columns(self.batch().num_actions))
            } else {
                (Vec::new(), Vec::new())
            };
            let is_padded = robot.slots.len() < self.batch().num_actions;
            let (observation_mask, action_mask) = if is_padded {
                (self.task().observation_mask(robot), robot.action_mask(self.batch().num_actions))
            } else {
                (Vec::new(), Vec::new())
            };
            Robot { envs: (envs.start, envs.end), observation_mirror, action_mirror, observation_mask, action_mask }
        });
        let batch = self.batch();
        let settings = Settings {
            num_envs: batch.num_envs,
            num_obs: batch.num_obs,
            num_actions: batch.num_actions,
            seed: self.seed(),
            robots: robots.collect(),
            options,
        };
        Ok(Learner::new(settings, self.simd())?)
    }

    /// Collects the samples of an iteration with the learner's policy; returns the episodes that ended, by steps and envs.
    ///
    /// # Errors
    /// A learner of another simulation, or a step that fails.
    pub fn collect(&mut self, learner: &mut Learner, iteration: u64) -> Result<Vec<Episode>, Error> {
        self.check_learner(learner)?;
        let mut actions = vec![0.0; self.batch().actions.len()];
        let mut episodes = Vec::new();
        learner.begin(iteration);
        for _ in 0..learner.settings().options.num_steps_per_env {
            learner.act(self.world().resource::<Workers>(), &self.batch().observations, &mut actions);
            self.step(&actions)?;
            let batch = self.batch();
            learner.record(&batch.rewards, &batch.terminated, &batch.truncated, &mut episodes);
        }
        learner.finish_rollout(self.world().resource::<Workers>(), &self.batch().observations);
        Ok(episodes)
    }

    /// Learns from the samples of the iteration, with this simulation's threads.
    ///
    /// # Errors
    /// A learner of another simulation, or losses that are not finite.
    pub fn learn(&self, learner: &mut Learner, learning_rate: f64) -> Result<Losses, Error> {
        self.check_learner(learner)?;
        let losses = learner.update(self.world().resource::<Workers>(), learning_rate);
        if [losses.value, losses.surrogate, losses.entropy].iter().all(|loss| loss.is_finite()) {
            return Ok(losses);
        }
        let problem = format!("value loss {}, surrogate loss {}", losses.value, losses.surrogate);
        Err(Error::argument("update", problem, "resume from the checkpoint before it with a smaller learning rate"))
    }

    fn check_learner(&self, learner: &Learner) -> Result<(), Error> {
        let (batch, settings) = (self.batch(), learner.settings());
        let of = [settings.num_envs, settings.num_obs, settings.num_actions];
        if of != [batch.num_envs, batch.num_obs, batch.num_actions] {
            let problem = format!("it is for {} envs with {} observations and {} actions", of[0], of[1], of[2]);
            return Err(Error::argument("learner", problem, "make a learner with this simulation"));
        }
        Ok(())
    }
}
