//! Exact snapshots: everything that decides what happens next, as bytes.

use std::ops::Range;

use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

use super::Sim;
use crate::batch::Batch;
use crate::components::{Body, Morphology, Stance};
use crate::error::Error;
use crate::morphology::Morphologies;
use crate::robot::Slot;
use crate::sealed::{self, Header};
use crate::systems::{
    CompiledTask, HeldRows, Logs, SavedColumn, SavedComponents, check_engine, load_engine, mirror_all, save_engine,
};

const KIND: &str = "polypod snapshot of a task";
/// Changes whenever the layout of a snapshot does.
const FORMAT: u32 = 13;

#[derive(Serialize, Deserialize)]
struct Snapshot {
    seed: u64,
    /// Number of its first env in the whole batch.
    first_env: u64,
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
        // slots that none of the robots has
        let slots = self.slots().joints.iter();
        let is_absent = |slot: &&Slot| !self.morphologies().iter().any(|robot| robot.roles.slots.contains(slot));
        slots.filter(is_absent).for_each(|slot| robots += &format!(", {slot}"));
        Header::new(KIND, FORMAT, robots, self.config_hash(), self.share().num_envs)
    }

    /// All that decides what happens next, as bytes. A restored simulation steps on with the same
    /// bits.
    ///
    /// # Errors
    /// When it cannot be encoded.
    pub fn snapshot(&mut self) -> Result<Vec<u8>, Error> {
        let unwritable = |error: postcard::Error| Error::Snapshot(error.to_string());
        let snapshot = Snapshot {
            seed: self.seed,
            first_env: self.share().envs.start as u64,
            batch: self.batch().clone(),
            logs: self.world.get_resource::<Logs>().cloned(),
            engine: save_engine(&self.world)?,
            components: SavedComponents::save(&mut self.world).map_err(unwritable)?,
        };
        sealed::seal(&self.header(), &snapshot).map_err(unwritable)
    }

    /// Restores a snapshot of a simulation of the same version, task, robots and number of envs. A
    /// snapshot of a larger share of the envs works too: this simulation takes its envs, and the
    /// statistics of the episodes if it has the first env.
    ///
    /// # Errors
    /// When the bytes are no snapshot, a damaged one or one of another simulation; the simulation
    /// is then as it was.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<(), Error> {
        let snapshot: Snapshot = sealed::open_as(bytes, &self.header()).map_err(Error::Snapshot)?;
        // check everything before anything is written
        let sizes = "its lists are of other lengths than this simulation's; pass what snapshot() gave";
        let own = &self.share().envs;
        let rows = HeldRows {
            own: self.rows_in(snapshot.first_env, snapshot.batch.num_envs).ok_or_else(|| {
                let first = snapshot.first_env;
                let problem = format!("it holds {} envs from env {first} on", snapshot.batch.num_envs);
                Error::Snapshot(format!("{problem}, and this simulation is of envs {} to {}", own.start, own.end))
            })?,
            morphologies: self.morphologies_from(snapshot.first_env, snapshot.batch.num_envs),
        };
        let logs_fit = match (&snapshot.logs, self.world.get_resource::<Logs>()) {
            (Some(theirs), Some(ours)) => theirs.fits(ours),
            (theirs, ours) => theirs.is_none() && ours.is_none(),
        };
        let batch = snapshot.batch.rows(rows.own.clone()).filter(|batch| batch.has_sizes_of(self.batch()));
        let engine = match snapshot.engine.len() {
            0 => Some(Vec::new()),
            count if count == rows.morphologies.len() => snapshot.engine.get(rows.own.clone()).map(<[_]>::to_vec),
            _ => None,
        };
        let (true, Some(batch), Some(engine)) = (logs_fit, batch, engine) else {
            return Err(Error::Snapshot(sizes.into()));
        };
        check_engine(&self.world, &engine)?;
        let writes = SavedComponents::load(&mut self.world, &snapshot.components, &rows)
            .map_err(|problem| Error::Snapshot(format!("{problem}; pass what snapshot() gave")))?;
        writes.into_iter().for_each(|write| write(&mut self.world));
        share_bodies(&mut self.world);
        self.world.insert_resource(batch);
        if let Some(logs) = snapshot.logs {
            let logs = if rows.own.start == 0 { logs } else { Logs::new(self.world.resource::<CompiledTask>()) };
            self.world.insert_resource(logs);
        }
        self.seed = snapshot.seed;
        self.lacks_external = false;
        load_engine(&mut self.world, &engine)?;
        mirror_all(&mut self.world)?;
        SavedComponents::measure(&mut self.world)
    }

    /// The morphologies of `count` envs of the whole batch from env `first_env` on, as far as it
    /// has them.
    fn morphologies_from(&self, first_env: u64, count: usize) -> Vec<Morphology> {
        let counts = self.share().counts.iter().enumerate();
        let all = counts.flat_map(|(morphology, &count)| std::iter::repeat_n(Morphology(morphology as u16), count));
        all.skip(usize::try_from(first_env).unwrap_or(usize::MAX)).take(count).collect()
    }

    /// Rows of this simulation's envs in a snapshot of the `count` envs from `first_env` on.
    fn rows_in(&self, first_env: u64, count: usize) -> Option<Range<usize>> {
        let (first, own) = (usize::try_from(first_env).ok()?, &self.share().envs);
        let rows = own.start.checked_sub(first)?..own.end.checked_sub(first)?;
        (rows.end <= count).then_some(rows)
    }

    /// Statistics of the episodes since they were last taken, as bytes for [`Sim::add_logs`] of the
    /// simulation of another share.
    ///
    /// # Errors
    /// When they cannot be encoded.
    pub fn take_logs(&mut self) -> Result<Vec<u8>, Error> {
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
