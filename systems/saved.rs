//! Snapshots of entities: the saved components, one line each.

use bevy_app::App;
use bevy_ecs::component::Mutable;
use bevy_ecs::prelude::*;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::terms::CompiledTask;
use crate::blocks::BlockMarker;
use crate::components::{
    Action, ActuatorDelay, ActuatorMemory, BasePose, BaseVelocity, Body, Command, CommandNumbers, ConstraintImpulses,
    ContactForces, ContactSensor, CurriculumProgress, Env, EnvId, EnvOrigin, EnvRng, Episode, EpisodeSums, EventTimers,
    ExternalWrench, Feet, HeightScan, Imu, JointDescriptors, JointEffort, JointState, JointTargets, LinkForces,
    Morphology, RayCasterCamera, Stance, StartupBody,
};
use crate::config::TaskConfig;
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::world::Ground;

/// Destination of a saved component.
pub struct Place<'a> {
    /// Morphology of the env.
    pub morphology: &'a MorphologyModel,
    /// Ground that the robots stand on.
    pub ground: &'a Ground,
}

/// A component that snapshots hold.
pub trait Saved: Component<Mutability = Mutable> + Clone + Serialize + DeserializeOwned {
    /// Whether this component of a snapshot can replace `present`: lists have the same lengths,
    /// indices exist.
    fn fits(&self, present: &Self, place: &Place) -> bool;
}

/// The rows of this simulation among those that a snapshot holds.
#[derive(Clone, Debug)]
pub(crate) struct HeldRows {
    /// The snapshot's row of each env of this simulation; absent for an env that stays as it is.
    pub(crate) own: Vec<Option<usize>>,
    /// The morphology of each row of the snapshot.
    pub(crate) morphologies: Vec<Morphology>,
}

/// Writes loaded data into the world.
type Write = Box<dyn FnOnce(&mut World)>;

struct SavedComponent {
    name: &'static str,
    is_on: IsOn,
    save: fn(&mut World, Option<&[usize]>) -> postcard::Result<Vec<u8>>,
    load: fn(&mut World, &[u8], &HeldRows, IsOn) -> Result<Write, String>,
}

/// Whether a morphology has a component in a task.
type IsOn = fn(&MorphologyModel, &TaskConfig) -> bool;

/// Components that snapshots hold, and callbacks that run after a restore.
#[derive(Resource, Default)]
pub(crate) struct SavedComponents {
    all: Vec<SavedComponent>,
    measured: Vec<fn(&mut World) -> Result<(), Error>>,
}

/// A component of all entities that have it, as bytes.
pub(crate) type SavedColumn = (String, Vec<u8>);

/// Adds a component to snapshots, in a plugin's `build`; every env has one.
pub fn save_component<C: Saved>(app: &mut App) {
    save_component_of::<C, Env>(app);
}

/// Adds a component of the entities of a kind to snapshots.
pub(super) fn save_component_of<C: Saved, K: BlockMarker>(app: &mut App) {
    let component =
        SavedComponent { name: std::any::type_name::<C>(), is_on: K::is_on, save: save::<C>, load: load::<C> };
    app.world_mut().get_resource_or_init::<SavedComponents>().all.push(component);
}

/// Registers a callback to run after a restore.
pub(super) fn measure_after_restore(app: &mut App, measure: fn(&mut World) -> Result<(), Error>) {
    app.world_mut().get_resource_or_init::<SavedComponents>().measured.push(measure);
}

impl SavedComponents {
    /// Saves all components, of all envs or of these in rising order.
    pub(crate) fn save(world: &mut World, envs: Option<&[usize]>) -> postcard::Result<Vec<SavedColumn>> {
        let all: Vec<_> = world.resource::<Self>().all.iter().map(|saved| (saved.name, saved.save)).collect();
        all.into_iter().map(|(name, save)| Ok((name.to_string(), save(world, envs)?))).collect()
    }

    /// Reads all components; nothing changes before the returned function is called.
    pub(crate) fn load(world: &mut World, columns: &[SavedColumn], rows: &HeldRows) -> Result<Vec<Write>, String> {
        let all: Vec<_> =
            world.resource::<Self>().all.iter().map(|saved| (saved.name, saved.load, saved.is_on)).collect();
        if !all.iter().map(|(name, ..)| *name).eq(columns.iter().map(|(name, _)| name.as_str())) {
            return Err("it holds other components than this simulation".into());
        }
        all.into_iter().zip(columns).map(|((_, load, is_on), (_, bytes))| load(world, bytes, rows, is_on)).collect()
    }

    /// Adds the rows of other columns to those of the same components.
    pub(crate) fn append(columns: &mut [SavedColumn], other: &[SavedColumn]) -> Result<(), String> {
        let names = |columns: &[SavedColumn]| columns.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
        if names(columns) != names(other) {
            return Err("they hold different components".into());
        }
        for ((name, bytes), (_, other)) in columns.iter_mut().zip(other) {
            // a list is its length, then its elements
            let list = |bytes| postcard::take_from_bytes::<u64>(bytes).map_err(|error| format!("{name}: {error}"));
            let ((count, rows), (more, others)) = (list(bytes)?, list(other)?);
            let mut joined =
                postcard::to_stdvec(&count.saturating_add(more)).map_err(|error| format!("{name}: {error}"))?;
            joined.extend_from_slice(rows);
            joined.extend_from_slice(others);
            *bytes = joined;
        }
        Ok(())
    }

    /// Runs the callbacks, which measure quantities that snapshots do not hold.
    pub(crate) fn measure(world: &mut World) -> Result<(), Error> {
        let measured = world.resource::<Self>().measured.clone();
        measured.into_iter().try_for_each(|measure| measure(world))
    }
}

fn save<C: Saved>(world: &mut World, envs: Option<&[usize]>) -> postcard::Result<Vec<u8>> {
    let mut rows: Vec<(EnvId, &C)> = Vec::new();
    let mut query = world.query::<(&EnvId, &C)>();
    let is_saved = |id: &EnvId| envs.is_none_or(|envs| envs.binary_search(&(id.0 as usize)).is_ok());
    let all = query.iter(world).filter(|(id, _)| is_saved(id));
    rows.extend(all.map(|(id, component)| (*id, component)));
    rows.sort_by_key(|(id, _)| *id);
    postcard::to_stdvec(&rows.into_iter().map(|(_, component)| component).collect::<Vec<_>>())
}

fn load<C: Saved>(world: &mut World, bytes: &[u8], rows: &HeldRows, is_on: IsOn) -> Result<Write, String> {
    let name = std::any::type_name::<C>();
    let values: Vec<C> = postcard::from_bytes(bytes).map_err(|error| format!("{name} cannot be read: {error}"))?;
    let mut query = world.query::<(&EnvId, &Morphology, &C)>();
    let (morphologies, ground) = (world.resource::<Morphologies>(), world.resource::<Ground>());
    let task = &world.resource::<CompiledTask>().config;
    let has: Vec<bool> = morphologies.0.iter().map(|morphology| is_on(morphology, task)).collect();
    let has = |morphology: &Morphology| has[usize::from(morphology.0)];
    let count = rows.morphologies.iter().filter(|morphology| has(morphology)).count();
    if values.len() != count {
        return Err(format!("{name}: there are {}, which is another number of envs", values.len()));
    }
    let mut values = values.into_iter();
    let of_env = rows.morphologies.iter().map(|morphology| if has(morphology) { values.next() } else { None });
    let mut values: Vec<Option<C>> = of_env.collect();
    let own = rows.own.clone();
    let row_of = move |env: &EnvId| own.get(env.0 as usize).copied().flatten();
    for (env, tag, present) in query.iter(world) {
        let Some(row) = row_of(env) else {
            continue;
        };
        let place = Place { morphology: morphologies.get(*tag), ground };
        let value = values.get(row).and_then(Option::as_ref);
        if !value.is_some_and(|value| value.fits(present, &place)) {
            return Err(format!("{name} of env {} has other sizes than here", env.0));
        }
    }
    Ok(Box::new(move |world| {
        for (env, mut component) in world.query::<(&EnvId, &mut C)>().iter_mut(world) {
            let row = row_of(env).and_then(|row| values.get_mut(row));
            if let Some(value) = row.and_then(Option::take) {
                *component = value;
            }
        }
    }))
}

/// Components without lists or indices.
macro_rules! of_any_value {
    ($($component:ident),*) => {
        $(
            impl Saved for $component {
                fn fits(&self, _: &Self, _: &Place) -> bool {
                    true
                }
            }
        )*
    };
}
of_any_value!(EnvRng, Command, BasePose, BaseVelocity, ExternalWrench, Imu);

/// Largest count in a snapshot. No run gets there, and later counts do not overflow.
const MAX_COUNT: u32 = u32::MAX / 2;

impl Saved for Episode {
    fn fits(&self, _: &Self, _: &Place) -> bool {
        self.length.max(self.lived) <= MAX_COUNT
    }
}

impl Saved for CommandNumbers {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        (self.numbers.len(), self.time_left.len()) == (present.numbers.len(), present.time_left.len())
    }
}

/// Largest count of control steps in a snapshot: later counts do not overflow.
const MAX_STEPS: u64 = u64::MAX / 2;

impl Saved for CurriculumProgress {
    fn fits(&self, _: &Self, _: &Place) -> bool {
        self.steps <= MAX_STEPS && self.widening.is_finite() && self.tracking.is_finite()
    }
}

impl Saved for EventTimers {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.0.len() == present.0.len()
    }
}

impl Saved for EpisodeSums {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.terms.len() == present.terms.len() && self.steps <= MAX_COUNT
    }
}

impl Saved for EnvOrigin {
    fn fits(&self, _: &Self, place: &Place) -> bool {
        place
            .ground
            .layout
            .as_ref()
            .is_none_or(|layout| self.terrain_level < layout.num_rows && self.terrain_column < layout.num_cols)
    }
}

impl Saved for JointState {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.has_sizes_of(present)
    }
}

impl Saved for Action {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.has_sizes_of(present)
    }
}

impl Saved for JointTargets {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.history.iter().map(|targets| targets.len()).eq(present.history.iter().map(|targets| targets.len()))
    }
}

impl Saved for ActuatorDelay {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.0.len() == present.0.len()
    }
}

impl Saved for ActuatorMemory {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.0.len() == present.0.len()
    }
}

impl Saved for JointEffort {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.has_sizes_of(present)
    }
}

impl Saved for ConstraintImpulses {
    fn fits(&self, present: &Self, place: &Place) -> bool {
        let contacts = place.morphology.topology.num_impulses();
        self.bounds.len() == present.bounds.len() && self.contacts.iter().all(|c| (c.contact as usize) < contacts)
    }
}

impl Saved for Feet {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        let sizes = |feet: &Self| (feet.position.len(), feet.velocity.len(), feet.height.len());
        sizes(self) == sizes(present)
    }
}

impl Saved for ContactForces {
    fn fits(&self, present: &Self, place: &Place) -> bool {
        let bodies = place.morphology.topology.num_bodies;
        (self.feet.len(), self.feet_normal.len()) == (present.feet.len(), present.feet_normal.len())
            && self.others.iter().all(|force| (force.body as usize) < bodies)
    }
}

impl Saved for LinkForces {
    fn fits(&self, _: &Self, place: &Place) -> bool {
        let links = place.morphology.topology.num_links();
        self.0.iter().all(|force| (force.link as usize) < links && force.steps > 0)
    }
}

impl Saved for Body {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.0.has_sizes_of(&present.0)
    }
}

impl Saved for StartupBody {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        match (&self.0, &present.0) {
            (Some(ours), Some(theirs)) => {
                let (positions, others) = (&ours.1.default_position, &theirs.1.default_position);
                ours.0.has_sizes_of(&theirs.0) && positions.len() == others.len()
            }
            (ours, theirs) => ours.is_none() && theirs.is_none(),
        }
    }
}

impl Saved for Stance {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.default_position.len() == present.default_position.len()
    }
}

impl Saved for ContactSensor {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        let times = |sensor: &Self| {
            [&sensor.contact_time, &sensor.air_time, &sensor.last_contact_time, &sensor.last_air_time]
                .map(|times| times.len())
        };
        self.peak_force.len() == present.peak_force.len() && times(self) == times(present)
    }
}

impl Saved for JointDescriptors {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.numbers.len() == present.numbers.len()
    }
}

impl Saved for RayCasterCamera {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.most_delay == present.most_delay
            && self.delay <= self.most_delay
            && self.late.len() == self.delay as usize
            && self.shown.is_some()
    }
}

impl Saved for HeightScan {
    fn fits(&self, present: &Self, _: &Place) -> bool {
        self.hits.len() == present.hits.len()
    }
}
