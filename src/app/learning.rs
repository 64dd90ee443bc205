//! Training without Python in the loop: the policy, the simulator and the update take turns on one
//! thread team.

use std::ops::Range;

use polypod_learner::{
    Episode, Learner, LearnerError, Losses, Network, Options, Peers, Robot, RolloutArrays, Settings, Symmetry, Team,
    Worker,
};

use super::Sim;
use crate::config::ConfigError;
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
    /// A learner for this simulation's envs, robots and observations, with the simulation's seed.
    /// Its networks begin with zeros.
    ///
    /// # Errors
    /// Options that are out of range; networks that name no columns of a task with several
    /// observation groups; a simulation of a share of the envs.
    pub fn learner(&self, options: Options) -> Result<Learner, Error> {
        self.check_share(Worker::ALONE)?;
        self.check_groups(&options)?;
        Ok(Learner::new(self.learner_settings(options), self.simd())?)
    }

    /// The native learner of one of several workers, which simulates its [`Worker::envs`] and
    /// learns with its peers.
    ///
    /// # Errors
    /// As [`Sim::learner`]; more workers than blocks of envs; a simulation of another share.
    pub fn learner_of_worker(&self, options: Options, worker: Worker, peers: Box<dyn Peers>) -> Result<Learner, Error> {
        self.check_share(worker)?;
        self.check_groups(&options)?;
        Ok(Learner::with_peers(self.learner_settings(options), self.simd(), worker, peers)?)
    }

    /// Share of envs whose robot has each number of an observation group; counts the envs of all
    /// workers.
    ///
    /// # Errors
    /// An unknown group.
    pub fn observation_shares(&self, group: &str) -> Result<Vec<f64>, ConfigError> {
        let (task, share) = (self.task(), self.share());
        let columns = task.group(group)?.columns.clone();
        let mut counts = vec![0usize; columns.len()];
        for (robot, &envs) in self.morphologies().iter().zip(&share.counts) {
            for (count, has) in counts.iter_mut().zip(&task.observation_mask(robot)[columns.clone()]) {
                *count += if *has { envs } else { 0 };
            }
        }
        Ok(counts.into_iter().map(|count| count as f64 / share.num_envs as f64).collect())
    }

    fn check_share(&self, worker: Worker) -> Result<(), Error> {
        let (share, wanted) = (self.share(), worker.envs(self.share().num_envs)?);
        if share.envs != wanted {
            let (Range { start, end }, Worker { index, count }) = (&share.envs, worker);
            let problem = format!("envs {start} to {end} of {} for worker {index} of {count}", share.num_envs);
            let remedy = format!("make the simulation with envs {} to {}", wanted.start, wanted.end);
            return Err(Error::argument("share", problem, remedy));
        }
        Ok(())
    }

    /// Refuses networks that do not say which groups they read, where there are several.
    fn check_groups(&self, options: &Options) -> Result<(), Error> {
        let says = |network: &Network| network.joints.is_some() || !network.columns.is_empty();
        match &self.task().groups[..] {
            [_, other, ..] if !(says(&options.actor) && says(&options.critic)) => {
                let problem = format!("the task has the observation group `{}` besides the policy's", other.name);
                Err(Error::argument("observations", problem, "name the columns that each network reads"))
            }
            _ => Ok(()),
        }
    }

    fn learner_settings(&self, options: Options) -> Settings {
        let has_mirrors = options.symmetry != Symmetry::None;
        let mut next = 0;
        let robots = self.morphologies().iter().zip(&self.share().counts).map(|(robot, count)| {
            let envs = next..next + count;
            next += count;
            let (observation_mirror, action_mirror) = if has_mirrors {
                (self.task().mirrored_observation(robot), robot.mirrored_columns(self.batch().num_actions))
            } else {
                (Vec::new(), Vec::new())
            };
            let unless_whole = |mask: Vec<bool>| if mask.contains(&false) { mask } else { Vec::new() };
            let observation_mask = unless_whole(self.task().observation_mask(robot));
            let action_mask = unless_whole(robot.action_mask(self.batch().num_actions));
            Robot { envs: (envs.start, envs.end), observation_mirror, action_mirror, observation_mask, action_mask }
        });
        let batch = self.batch();
        Settings {
            num_envs: self.share().num_envs,
            num_obs: batch.num_obs,
            num_actions: batch.num_actions,
            seed: self.seed(),
            robots: robots.collect(),
            options,
        }
    }

    /// Collects the samples of an iteration with the learner's policy; returns the episodes that
    /// ended, by steps and envs.
    ///
    /// The robots act with the policy's actions within `clip_actions` of 0; the samples hold them
    /// as they were drawn.
    ///
    /// # Errors
    /// A learner of another simulation, a limit that is not above 0, a step that fails, or another
    /// worker that is gone.
    pub fn collect(
        &mut self,
        learner: &mut Learner,
        iteration: u64,
        clip_actions: Option<f32>,
    ) -> Result<Vec<Episode>, Error> {
        self.fetch_batch()?;
        self.check_learner(learner)?;
        let limit = clip_actions.unwrap_or(f32::INFINITY);
        if limit.is_nan() || limit <= 0.0 {
            return Err(Error::argument("clip_actions", format!("it is {limit}"), "set a number above 0"));
        }
        let mut actions = vec![0.0; self.batch().actions.len()];
        let mut episodes = Vec::new();
        learner.begin(iteration);
        for _ in 0..learner.settings().options.num_steps_per_env {
            learner.act(self.world().resource::<Workers>(), &self.batch().observations, &mut actions);
            if clip_actions.is_some() {
                actions.iter_mut().for_each(|action| *action = action.clamp(-limit, limit));
            }
            self.step(&actions)?;
            let batch = self.batch();
            learner.record(&batch.rewards, &batch.terminated, &batch.truncated, &mut episodes);
        }
        learner.finish_rollout(self.world().resource::<Workers>(), &self.batch().observations)?;
        Ok(episodes)
    }

    /// Draws the actions of a step of [`Sim::collect`], for a caller who steps the simulation
    /// between [`Learner::begin`] and [`Sim::finish_rollout`]; [`Learner::record`] is told the
    /// outcome.
    ///
    /// # Errors
    /// A learner of another simulation, or actions of another size.
    ///
    /// # Panics
    /// If all steps of the iteration are taken.
    pub fn act(&self, learner: &mut Learner, actions: &mut [f32]) -> Result<(), Error> {
        self.check_learner(learner)?;
        if actions.len() != self.batch().actions.len() {
            let problem = format!("{} numbers, not {}", actions.len(), self.batch().actions.len());
            return Err(Error::argument("actions", problem, "pass room for one row of actions per env"));
        }
        learner.act(self.world().resource::<Workers>(), &self.batch().observations, actions);
        Ok(())
    }

    /// Estimates values and advantages of the steps that were taken with [`Sim::act`].
    ///
    /// # Errors
    /// A learner of another simulation, or another worker that is gone.
    pub fn finish_rollout(&self, learner: &mut Learner) -> Result<(), Error> {
        self.check_learner(learner)?;
        Ok(learner.finish_rollout(self.world().resource::<Workers>(), &self.batch().observations)?)
    }

    /// Learns from the samples of the iteration, with this simulation's threads.
    ///
    /// # Errors
    /// A learner of another simulation, losses that are not finite, or another worker that is gone.
    pub fn learn(&self, learner: &mut Learner, learning_rate: f64) -> Result<Losses, Error> {
        self.check_learner(learner)?;
        let losses = learner.update(self.world().resource::<Workers>(), learning_rate)?;
        if [losses.value, losses.surrogate, losses.entropy].iter().all(|loss| loss.is_finite()) {
            return Ok(losses);
        }
        let problem = format!("value loss {}, surrogate loss {}", losses.value, losses.surrogate);
        Err(Error::argument("update", problem, "resume from the checkpoint before it with a smaller learning rate"))
    }

    /// Writes the samples of the iteration, with this simulation's threads, for a learner
    /// elsewhere.
    ///
    /// # Errors
    /// A learner of another simulation, and arrays of other sizes.
    pub fn write_rollout(&self, learner: &Learner, arrays: RolloutArrays) -> Result<(), Error> {
        self.check_learner(learner)?;
        Ok(learner.write_rollout(self.world().resource::<Workers>(), arrays)?)
    }

    fn check_learner(&self, learner: &Learner) -> Result<(), Error> {
        if self.is_batch_behind() {
            let problem = "the batch is that of an earlier step, after steps that the host did not wait for";
            return Err(Error::argument("learner", problem, "bring the batch up to date first: fetch_batch()"));
        }
        let (batch, settings) = (self.batch(), learner.settings());
        let of = [learner.num_own_envs(), settings.num_obs, settings.num_actions];
        if of != [batch.num_envs, batch.num_obs, batch.num_actions] || settings.num_envs != self.share().num_envs {
            let problem = format!("it is for {} envs with {} observations and {} actions", of[0], of[1], of[2]);
            return Err(Error::argument("learner", problem, "make a learner with this simulation"));
        }
        Ok(())
    }
}
