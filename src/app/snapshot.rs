//! Exact snapshots: everything that decides what happens next, as bytes.

use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

use super::Sim;
use crate::batch::Batch;
use crate::components::{Body, Morphology, Stance};
use crate::error::Error;
use crate::morphology::Morphologies;
use crate::robot::Slot;
use crate::sealed::{self, Header};
use crate::systems::{Logs, SavedColumn, SavedComponents, check_engine, load_engine, mirror_all, save_engine};

const KIND: &str = "polypod snapshot of a task";
/// Changes whenever the layout of a snapshot does.
const FORMAT: u32 = 9;

#[derive(Serialize, Deserialize)]
struct Snapshot {
    seed: u64,
    batch: Batch,
    /// None without [`LogsPlugin`](crate::systems::LogsPlugin).
    logs: Option<Logs>,
    engine: Vec<Vec<u8>>,
    components: Vec<SavedColumn>,
}

/// What a robot's numbers have in common with its morphology's is kept once again.
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
        // slots that no robot has
        let slots = self.slots().joints.iter();
        let is_absent = |slot: &&Slot| !self.morphologies().iter().any(|robot| robot.roles.slots.contains(slot));
        slots.filter(is_absent).for_each(|slot| robots += &format!(", {slot}"));
        Header::new(KIND, FORMAT, robots, self.config_hash(), self.num_envs())
    }

    /// Everything that decides what happens next, as bytes: restoring them and stepping gives, bit for bit, what going on
    /// would have given.
    ///
    /// # Errors
    /// When it cannot be encoded.
    pub fn snapshot(&mut self) -> Result<Vec<u8>, Error> {
        let unwritable = |error: postcard::Error| Error::Snapshot(error.to_string());
        let snapshot = Snapshot {
            seed: self.seed,
            batch: self.batch().clone(),
            logs: self.world.get_resource::<Logs>().cloned(),
            engine: save_engine(&self.world).map_err(unwritable)?,
            components: SavedComponents::save(&mut self.world).map_err(unwritable)?,
        };
        sealed::seal(&self.header(), &snapshot).map_err(unwritable)
    }

    /// Goes back to a snapshot of a simulation of the same version, task, robots and number of envs.
    ///
    /// # Errors
    /// When the bytes are no snapshot, a damaged one or one of another simulation; the simulation is then as it was.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<(), Error> {
        let snapshot: Snapshot = sealed::open_as(bytes, &self.header()).map_err(Error::Snapshot)?;
        // nothing is written before all is checked
        let sizes = "its lists are of other lengths than this simulation's; pass what snapshot() gave";
        let logs_fit = match (&snapshot.logs, self.world.get_resource::<Logs>()) {
            (Some(theirs), Some(ours)) => theirs.fits(ours),
            (theirs, ours) => theirs.is_none() && ours.is_none(),
        };
        if !logs_fit || !snapshot.batch.has_sizes_of(self.batch()) {
            return Err(Error::Snapshot(sizes.into()));
        }
        check_engine(&self.world, &snapshot.engine)?;
        let writes = SavedComponents::load(&mut self.world, &snapshot.components)
            .map_err(|problem| Error::Snapshot(format!("{problem}; pass what snapshot() gave")))?;
        writes.into_iter().for_each(|write| write(&mut self.world));
        share_bodies(&mut self.world);
        self.world.insert_resource(snapshot.batch);
        if let Some(logs) = snapshot.logs {
            self.world.insert_resource(logs);
        }
        self.seed = snapshot.seed;
        load_engine(&mut self.world, &snapshot.engine)?;
        mirror_all(&mut self.world)?;
        SavedComponents::measure(&mut self.world)
    }
}
