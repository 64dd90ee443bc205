//! Exact snapshots: everything that decides what happens next, as bytes.

use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

use super::Sim;
use crate::batch::Batch;
use crate::components::{Body, Morphology, Stance};
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::robot::Slot;
use crate::sealed::{self, Header};
use crate::systems::{
    CompiledTask, HeldRows, Logs, SavedColumn, SavedComponents, check_engine, load_engine, mirror_all, save_engine,
};

const KIND: &str = "polypod snapshot of a task";
/// Changes whenever the layout of a snapshot does.
const FORMAT: u32 = 14;

#[derive(Serialize, Deserialize)]
struct Snapshot {
    seed: u64,
    /// Number of the share's first env in the whole batch.
    first_env: u64,
    /// The envs in the whole batch, in rising order, where it is a snapshot of some envs alone.
    envs: Option<Vec<u64>>,
    batch: Batch,
    /// Absent without [`LogsPlugin`](crate::systems::LogsPlugin).
    logs: Option<Logs>,
    engine: Vec<Vec<u8>>,
    components: Vec<SavedColumn>,
}

/// Shares the numbers that bodies have in common with their morphology, so that each is stored
/// once.
fn share_bodies(world: &mut World) {
    world.resource_scope(|world, morphologies: Mut<Morphologies>| {
        for (tag, mut body, mut stance) in world.query::<(&Morphology, &mut Body, &mut Stance)>().iter_mut(world) {
            let kind = morphologies.get(*tag);
            body.0.share(&kind.nominal);
            if stance.default_position == kind.stance.default_position {
                stance.default_position = kind.stance.default_position.clone();
            }
        }
    });
}

impl Sim {
    fn header(&self) -> Header {
        let robots: Vec<&str> = self.morphologies().iter().map(|m| m.name()).collect();
        let mut robots = robots.join(", ");
        // columns beyond those of the joints that the task drives
        let slots = self.slots().joints.iter();
        let is_own = |slot: &Slot, robot: &MorphologyModel| robot.slots.iter().any(|own| own.slot == *slot);
        let is_absent = |slot: &&Slot| !self.morphologies().iter().any(|robot| is_own(slot, robot));
        slots.filter(is_absent).for_each(|slot| robots += &format!(", {slot}"));
        Header::new(KIND, FORMAT, robots, self.config_hash(), self.share().num_envs)
    }

    /// All that decides what happens next, as bytes. A restored simulation steps on with the same
    /// bits.
    ///
    /// # Errors
    /// When it cannot be encoded.
    pub fn snapshot(&mut self) -> Result<Vec<u8>, Error> {
        self.snapshot_rows(None)
    }

    /// All that decides how some envs go on, as bytes for [`restore_some`](Self::restore_some).
    /// Statistics of episodes are no part of it.
    ///
    /// # Errors
    /// An env that does not exist or is there twice, or when it cannot be encoded.
    pub fn snapshot_of(&mut self, envs: &[usize]) -> Result<Vec<u8>, Error> {
        self.places("snapshot: env_ids", envs)?;
        let mut envs = envs.to_vec();
        envs.sort_unstable();
        self.snapshot_rows(Some(&envs))
    }

    fn snapshot_rows(&mut self, envs: Option<&[usize]>) -> Result<Vec<u8>, Error> {
        let unwritable = |error: postcard::Error| Error::Snapshot(error.to_string());
        let first_env = self.share().envs.start;
        self.return_to_host();
        let mut engine = save_engine(&self.world)?;
        let batch = match envs {
            None => self.batch().clone(),
            Some(envs) => {
                engine = envs.iter().filter_map(|&env| engine.get(env).cloned()).collect();
                let batch = self.batch().select(envs);
                batch.ok_or_else(|| Error::Snapshot("the arrays of the batch lack rows".into()))?
            }
        };
        let snapshot = Snapshot {
            seed: self.seed,
            first_env: first_env as u64,
            envs: envs.map(|envs| envs.iter().map(|env| (first_env + env) as u64).collect()),
            batch,
            logs: self.world.get_resource::<Logs>().filter(|_| envs.is_none()).cloned(),
            engine,
            components: SavedComponents::save(&mut self.world, envs).map_err(unwritable)?,
        };
        sealed::seal(&self.header(), &snapshot).map_err(unwritable)
    }

    /// Restores a snapshot of a simulation of the same version, task, robots and number of envs. A
    /// snapshot of a larger share of the envs works too: this simulation takes its envs, and the
    /// statistics of the episodes if it has the first env. A snapshot of some envs restores these.
    ///
    /// # Errors
    /// When the bytes are no snapshot, a damaged one or one of another simulation; the simulation
    /// is then as it was.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<(), Error> {
        self.restore_rows(bytes, None)
    }

    /// Restores some envs of a snapshot; all others, the seed and the statistics stay as they are.
    ///
    /// # Errors
    /// As [`restore`](Self::restore); an env that the snapshot does not hold, that does not exist
    /// or that is there twice.
    pub fn restore_some(&mut self, bytes: &[u8], envs: &[usize]) -> Result<(), Error> {
        self.places("restore: env_ids", envs)?;
        self.restore_rows(bytes, Some(envs))
    }

    fn restore_rows(&mut self, bytes: &[u8], envs: Option<&[usize]>) -> Result<(), Error> {
        let snapshot: Snapshot = sealed::open_as(bytes, &self.header()).map_err(Error::Snapshot)?;
        self.return_to_host();
        // check everything before anything is written
        let sizes = "its lists are of other lengths than this simulation's; pass what snapshot() gave";
        let is_whole = snapshot.envs.is_none() && envs.is_none();
        let rows = self.held_rows(&snapshot, envs)?;
        let logs_fit = match (&snapshot.logs, self.world.get_resource::<Logs>()) {
            _ if !is_whole => true,
            (Some(theirs), Some(ours)) => theirs.fits(ours),
            (theirs, ours) => theirs.is_none() && ours.is_none(),
        };
        let count = rows.morphologies.len();
        let mut batch = self.batch().clone();
        let theirs = snapshot.batch.rows(0..count).filter(|theirs| {
            let widths = |batch: &Batch| (batch.num_obs, batch.num_actions);
            theirs.num_envs == snapshot.batch.num_envs && widths(theirs) == widths(&batch)
        });
        let mut engine = save_engine(&self.world)?;
        let engine_fits = match snapshot.engine.len() {
            0 => engine.is_empty(),
            theirs => theirs == count && !engine.is_empty(),
        };
        let (true, true, Some(theirs)) = (logs_fit, engine_fits, theirs) else {
            return Err(Error::Snapshot(sizes.into()));
        };
        for (env, row) in rows.own.iter().enumerate() {
            let Some(row) = *row else {
                continue;
            };
            batch.put_row(env, &theirs, row);
            if let (Some(to), Some(from)) = (engine.get_mut(env), snapshot.engine.get(row)) {
                to.clone_from(from);
            }
        }
        check_engine(&self.world, &engine)?;
        let writes = SavedComponents::load(&mut self.world, &snapshot.components, &rows)
            .map_err(|problem| Error::Snapshot(format!("{problem}; pass what snapshot() gave")))?;
        writes.into_iter().for_each(|write| write(&mut self.world));
        share_bodies(&mut self.world);
        self.world.insert_resource(batch);
        if is_whole {
            if let Some(logs) = snapshot.logs {
                let has_first = rows.own.first() == Some(&Some(0));
                let logs = if has_first { logs } else { Logs::new(self.world.resource::<CompiledTask>()) };
                self.world.insert_resource(logs);
            }
            self.seed = snapshot.seed;
            self.forget_lost_state();
        }
        self.lacks_external = false;
        load_engine(&mut self.world, &engine)?;
        mirror_all(&mut self.world)?;
        SavedComponents::measure(&mut self.world)
    }

    /// The rows of a snapshot that this simulation takes: of all its envs, or of these.
    fn held_rows(&self, snapshot: &Snapshot, envs: Option<&[usize]>) -> Result<HeldRows, Error> {
        let (first, count) = (snapshot.first_env, snapshot.batch.num_envs);
        let own = &self.share().envs;
        let held: Vec<u64> = match &snapshot.envs {
            None => (first..first.saturating_add(count as u64)).take(self.share().num_envs + 1).collect(),
            Some(envs) => envs.clone(),
        };
        let morphologies = self.morphologies_of(&held);
        let ascend = held.windows(2).all(|pair| pair[0] < pair[1]);
        if held.len() != count || morphologies.len() != count || !ascend {
            let problem = format!("it holds {count} envs from env {first} on, which the batch does not have");
            return Err(Error::Snapshot(format!("{problem}; pass what snapshot() gave")));
        }
        let row_of = |env: usize| held.binary_search(&((own.start + env) as u64)).ok();
        let missing = |env: usize| {
            let problem = format!("it holds {count} envs from env {first} on");
            let here = format!("this simulation is of envs {} to {}", own.start, own.end);
            Error::Snapshot(format!("{problem}, without env {}, and {here}", own.start + env))
        };
        let wanted: Vec<usize> = match (envs, &snapshot.envs) {
            (Some(envs), _) => envs.to_vec(),
            (None, None) => (0..own.len()).collect(),
            (None, Some(_)) => {
                let local =
                    |env: &u64| usize::try_from(*env).ok()?.checked_sub(own.start).filter(|env| *env < own.len());
                let all: Option<Vec<usize>> = held.iter().map(local).collect();
                all.ok_or_else(|| missing(0))?
            }
        };
        let mut rows = vec![None; own.len()];
        for env in wanted {
            rows[env] = Some(row_of(env).ok_or_else(|| missing(env))?);
        }
        Ok(HeldRows { own: rows, morphologies })
    }

    /// The morphologies of envs of the whole batch, as far as it has them.
    fn morphologies_of(&self, envs: &[u64]) -> Vec<Morphology> {
        let counts = self.share().counts.iter().enumerate();
        let all: Vec<Morphology> =
            counts.flat_map(|(morphology, &count)| std::iter::repeat_n(Morphology(morphology as u16), count)).collect();
        envs.iter().filter_map(|&env| all.get(usize::try_from(env).ok()?).copied()).collect()
    }

    /// Statistics of the episodes since they were last taken, as bytes for [`Sim::add_logs`] of the
    /// simulation of another share.
    ///
    /// # Errors
    /// When they cannot be encoded.
    pub fn take_logs(&mut self) -> Result<Vec<u8>, Error> {
        self.settle();
        let empty = Logs::new(self.world.resource::<CompiledTask>());
        let logs = self.world.get_resource_mut::<Logs>().map(|mut logs| std::mem::replace(&mut *logs, empty));
        postcard::to_stdvec(&logs).map_err(|error| Error::Snapshot(error.to_string()))
    }

    /// Adds the statistics that [`Sim::take_logs`] returned.
    ///
    /// # Errors
    /// Invalid bytes, or statistics of another simulation.
    pub fn add_logs(&mut self, bytes: &[u8]) -> Result<(), Error> {
        let logs: Option<Option<Logs>> = postcard::from_bytes(bytes).ok();
        let ours = self.world.get_resource_mut::<Logs>();
        match (logs, ours) {
            (Some(None), None) => Ok(()),
            (Some(Some(logs)), Some(mut ours)) if logs.fits(&ours) => {
                ours.append(&logs);
                Ok(())
            }
            _ => Err(Error::Snapshot(
                "these are no statistics of this task's episodes; pass what take_logs() gave".into(),
            )),
        }
    }
}

/// Joins snapshots of consecutive shares into the snapshot of the whole batch, byte for byte.
///
/// # Errors
/// Bytes that are no snapshots, or shares that do not follow one another.
pub fn join(parts: &[impl AsRef<[u8]>]) -> Result<Vec<u8>, Error> {
    let failed = |problem: String| Error::Snapshot(format!("{problem}; pass one snapshot of each share, in order"));
    let Some(header) = parts.first().and_then(|part| sealed::header(part.as_ref(), KIND)) else {
        return Err(failed("there are none to join".into()));
    };
    let mut joined: Option<Snapshot> = None;
    for part in parts {
        let next: Snapshot = sealed::open_as(part.as_ref(), &header).map_err(Error::Snapshot)?;
        if next.envs.is_some() {
            return Err(failed("one is of some envs alone".into()));
        }
        let Some(joined) = &mut joined else {
            joined = Some(next);
            continue;
        };
        let end = joined.first_env.saturating_add(joined.batch.num_envs as u64);
        if (next.first_env, next.seed) != (end, joined.seed) {
            return Err(failed(format!("after env {end} comes one that begins with env {}", next.first_env)));
        }
        match (&mut joined.logs, &next.logs) {
            (Some(ours), Some(theirs)) if theirs.fits(ours) => ours.append(theirs),
            (None, None) => {}
            _ => return Err(failed("their statistics are of different robots".into())),
        }
        joined.batch.append(next.batch);
        joined.engine.extend(next.engine);
        SavedComponents::append(&mut joined.components, &next.components).map_err(failed)?;
    }
    let joined = joined.ok_or_else(|| failed("there are none to join".into()))?;
    sealed::seal(&header, &joined).map_err(|error| Error::Snapshot(error.to_string()))
}
