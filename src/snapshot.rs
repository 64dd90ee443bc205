//! Exact snapshots: everything that decides what happens next, as bytes.

use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

use crate::app::{Sim, SimError};
use crate::batch::Batch;
use crate::components::{
    Action, ActuatorDelay, BasePose, BaseVelocity, Body, Command, ConstraintImpulses, ContactForces, ContactSensor,
    EnvId, EnvOrigin, EnvRng, Episode, EpisodeSums, EventTimers, ExternalWrench, Feet, Imu, JointEffort, JointState,
    JointTargets, Morphology, Robot, Stance, StartupBody,
};
use crate::config::fnv1a;
use crate::fits::{Bounds, Fits, same_lengths};
use crate::morphology::Morphologies;
use crate::systems::{Logs, check_engine, load_engine, mirror_all, save_engine, scan_heights};
use crate::world::Ground;

/// Changes whenever the layout of a snapshot does.
const FORMAT: u32 = 7;
/// Length of the checksum after the encoded snapshot: FNV-1a over it, little endian.
const CHECKSUM: usize = size_of::<u64>();

#[derive(Serialize, Deserialize, PartialEq, Debug)]
struct Header {
    format: u32,
    version: String,
    config_hash: u64,
    robots: Vec<String>,
    num_envs: usize,
}

macro_rules! snapshot {
    ($($name:ident: $component:ident),* $(,)?) => {
        /// Every component that moves, by env.
        #[derive(Serialize, Deserialize)]
        struct Snapshot {
            header: Header,
            seed: u64,
            batch: Batch,
            logs: Logs,
            engine: Vec<Vec<u8>>,
            $($name: Vec<$component>,)*
        }

        impl Snapshot {
            fn take(sim: &mut Sim) -> Result<Self, postcard::Error> {
                Ok(Self {
                    header: header(sim),
                    seed: sim.seed(),
                    batch: sim.batch().clone(),
                    logs: sim.world().resource::<Logs>().clone(),
                    engine: save_engine(sim.world())?,
                    $($name: read(sim.world_mut()),)*
                })
            }

            /// Whether each part may take the place of that of the simulation.
            fn fits(&self, sim: &mut Sim) -> bool {
                let world = sim.world_mut();
                let tags: Vec<Morphology> = read_of::<Morphology, Robot>(world);
                $(let $name: Vec<$component> = read(world);)*
                let (morphologies, ground) = (world.resource::<Morphologies>(), world.resource::<Ground>());
                let bounds = |env: usize| {
                    let kind = morphologies.get(tags[env]);
                    let (num_impulses, num_bodies) = (kind.topology.num_impulses(), kind.topology.num_bodies);
                    Bounds { num_impulses, num_bodies, layout: ground.layout.as_ref() }
                };
                same_lengths(&self.batch, world.resource::<Batch>())
                    && self.logs.fits(world.resource::<Logs>())
                    $(&& self.$name.len() == $name.len()
                        && self.$name.iter().zip(&$name).enumerate().all(|(env, (a, b))| a.fits(b, &bounds(env))))*
            }

            fn apply(self, sim: &mut Sim) -> Result<(), SimError> {
                // nothing is written before all is checked
                if !self.fits(sim) {
                    let problem = "its parts are not those of this simulation; pass what snapshot() gave";
                    return Err(SimError::Snapshot(problem.into()));
                }
                check_engine(sim.world(), &self.engine)?;
                let Self { header: _, seed, batch, logs, engine, $($name,)* } = self;
                $(write(sim.world_mut(), $name);)*
                share_bodies(sim.world_mut());
                sim.world_mut().insert_resource(batch);
                sim.world_mut().insert_resource(logs);
                sim.set_seed(seed);
                load_engine(sim.world_mut(), &engine)?;
                mirror_all(sim.world_mut());
                // what sensors see of the ground follows from the state
                let scanned = sim.world_mut().run_system_cached(scan_heights);
                scanned.map_err(|error| SimError::Snapshot(format!("the height scanner did not run: {error}")))
            }
        }
    };
}

snapshot! {
    rngs: EnvRng, episodes: Episode, commands: Command, timers: EventTimers, sums: EpisodeSums,
    poses: BasePose, velocities: BaseVelocity, joints: JointState, actions: Action, targets: JointTargets,
    delays: ActuatorDelay, efforts: JointEffort, impulses: ConstraintImpulses, forces: ContactForces, feet: Feet,
    bodies: Body, startup_bodies: StartupBody, stances: Stance, wrenches: ExternalWrench, contacts: ContactSensor,
    imus: Imu, origins: EnvOrigin,
}

/// A value as bytes, with a checksum at the end.
pub(crate) fn seal(value: &impl Serialize) -> Result<Vec<u8>, postcard::Error> {
    let mut bytes = postcard::to_stdvec(value)?;
    bytes.extend(fnv1a(&bytes).to_le_bytes());
    Ok(bytes)
}

/// What [`seal`] encoded, if the checksum fits.
pub(crate) fn unseal(bytes: &[u8]) -> Option<&[u8]> {
    let (data, sum) = bytes.split_last_chunk::<CHECKSUM>()?;
    (fnv1a(data).to_le_bytes() == *sum).then_some(data)
}

fn header(sim: &Sim) -> Header {
    Header {
        format: FORMAT,
        version: env!("CARGO_PKG_VERSION").to_string(),
        config_hash: sim.config_hash(),
        robots: sim.morphologies().iter().map(|m| m.name().to_string()).collect(),
        num_envs: sim.num_envs(),
    }
}

fn read<C: Component + Clone>(world: &mut World) -> Vec<C> {
    read_of::<C, EnvId>(world)
}

/// The component of those entities that have the marker `M` as well.
fn read_of<C: Component + Clone, M: Component>(world: &mut World) -> Vec<C> {
    let mut query = world.query_filtered::<(&EnvId, &C), With<M>>();
    let mut rows: Vec<(EnvId, C)> = query.iter(world).map(|(id, c)| (*id, c.clone())).collect();
    rows.sort_by_key(|(id, _)| *id);
    rows.into_iter().map(|(_, c)| c).collect()
}

fn write<C: Component<Mutability = bevy_ecs::component::Mutable>>(world: &mut World, values: Vec<C>) {
    let mut values: Vec<Option<C>> = values.into_iter().map(Some).collect();
    for (id, mut component) in world.query::<(&EnvId, &mut C)>().iter_mut(world) {
        if let Some(value) = values.get_mut(id.0 as usize).and_then(Option::take) {
            *component = value;
        }
    }
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
    /// Everything that decides what happens next, as bytes: restoring them and stepping gives, bit for bit, what going on
    /// would have given.
    ///
    /// # Errors
    /// When it cannot be encoded.
    pub fn snapshot(&mut self) -> Result<Vec<u8>, SimError> {
        let sealed = Snapshot::take(self).and_then(|snapshot| seal(&snapshot));
        sealed.map_err(|error| SimError::Snapshot(error.to_string()))
    }

    /// Goes back to a snapshot of a simulation of the same version, task, robots and number of envs.
    ///
    /// # Errors
    /// When the bytes are no snapshot, a damaged one or one of another simulation; the simulation is then as it was.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<(), SimError> {
        let unreadable = |error: postcard::Error| SimError::Snapshot(format!("not a snapshot of polypod: {error}"));
        let (theirs, _) = postcard::take_from_bytes::<Header>(bytes).map_err(unreadable)?;
        let ours = header(self);
        if theirs != ours {
            return Err(SimError::Snapshot(format!(
                "it is of another simulation ({theirs:?}) than this one ({ours:?})"
            )));
        }
        // a length that no longer fits would only be found in the middle of a later step
        let Some(data) = unseal(bytes) else {
            return Err(SimError::Snapshot("it is damaged: its checksum does not fit; take it again".into()));
        };
        postcard::from_bytes::<Snapshot>(data).map_err(unreadable)?.apply(self)
    }
}
