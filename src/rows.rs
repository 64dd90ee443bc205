//! Rows: one entity of a kind per env, its components as slices, row `i` belonging to env `i`.
//!
//! Systems join envs, robots and sensors by [`Rows`]. Each time that they are read, the entities' [`EnvId`]s are compared with
//! their rows: about a microsecond for 4096 envs. Where a component was inserted into one robot alone, a robot was despawned or
//! an entity spawned beside it, a row is an [`Error::Rows`] that names the entity, never another env's numbers.
//!
//! Bevy keeps entities with the same components in one table, and moves an entity into another table when it gains or loses a
//! component. Before each control step the entities of a table are put in the order of their env ids again.
//! Components with `#[component(storage = "SparseSet")]` move nothing: they may be given to single entities.

use bevy_ecs::change_detection::ContiguousMut;
use bevy_ecs::component::Mutable;
use bevy_ecs::prelude::*;
use bevy_ecs::query::ContiguousQueryData;
use bevy_ecs::system::SystemParam;

use crate::components::{ContactSensor, Env, EnvId, HeightScan, Imu, JointDescriptors, Robot};
use crate::error::Error;

/// Number of envs of the simulation.
#[derive(Resource, Clone, Copy, Debug, PartialEq, Eq)]
pub struct NumEnvs(pub usize);

/// Marks the entities of a kind of which every env has one.
pub trait RowKind: Component {
    /// What an entity of this kind is called in errors.
    const NAME: &'static str;
}

impl RowKind for Env {
    const NAME: &'static str = "env";
}
impl RowKind for Robot {
    const NAME: &'static str = "robot";
}
impl RowKind for ContactSensor {
    const NAME: &'static str = "contact sensor";
}
impl RowKind for Imu {
    const NAME: &'static str = "IMU";
}
impl RowKind for JointDescriptors {
    const NAME: &'static str = "joint descriptors";
}
impl RowKind for HeightScan {
    const NAME: &'static str = "height scanner";
}

/// System parameter: components `D` of the entities of kind `K`, such as `Rows<(&'static BasePose, &'static mut Feet), Robot>`.
#[derive(SystemParam)]
pub struct Rows<'w, 's, D: ContiguousQueryData<ReadOnly: ContiguousQueryData> + 'static, K: RowKind> {
    rows: Query<'w, 's, (&'static EnvId, D), With<K>>,
    all: Query<'w, 's, (Entity, &'static EnvId), With<K>>,
    num_envs: Res<'w, NumEnvs>,
}

impl<'s, D: ContiguousQueryData<ReadOnly: ContiguousQueryData> + 'static, K: RowKind> Rows<'_, 's, D, K> {
    /// The components as slices.
    ///
    /// # Errors
    /// The entities of this kind are not one per env, in the order of their env ids, in one table.
    #[inline]
    pub fn read<'a>(&'a self) -> Result<Slices<'a, 's, D::ReadOnly>, Error>
    where
        <D::ReadOnly as ContiguousQueryData>::Contiguous<'a, 's>: IntoSlices,
    {
        let mut tables = self.rows.contiguous_iter().into_iter().flatten().filter(|(ids, _)| !ids.is_empty());
        match (tables.next(), tables.next()) {
            (Some((ids, data)), None) if in_order(ids, self.num_envs.0) => Ok(data.into_slices()),
            _ => Err(self.fault()),
        }
    }

    /// The components as slices, to write. Bevy's change detection does not see it.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    #[inline]
    pub fn write<'a>(&'a mut self) -> Result<Slices<'a, 's, D>, Error>
    where
        D::Contiguous<'a, 's>: IntoSlices,
    {
        if !self.are_in_order() {
            return Err(self.fault());
        }
        let tables = self.rows.contiguous_iter_mut().into_iter().flatten();
        let (_, data) = tables.into_iter().find(|(ids, _)| !ids.is_empty()).ok_or_else(|| nothing(K::NAME))?;
        Ok(data.into_slices())
    }

    /// The components as slices, empty where there are no entities of this kind: a task may have no such sensor.
    ///
    /// # Errors
    /// As [`read`](Self::read), for some entities.
    #[inline]
    pub fn read_if_any<'a>(&'a self) -> Result<Slices<'a, 's, D::ReadOnly>, Error>
    where
        <D::ReadOnly as ContiguousQueryData>::Contiguous<'a, 's>: IntoSlices<Slices: Default>,
    {
        if self.all.is_empty() { Ok(Default::default()) } else { self.read() }
    }

    fn are_in_order(&self) -> bool {
        let mut tables = self.rows.contiguous_iter().into_iter().flatten().filter(|(ids, _)| !ids.is_empty());
        matches!((tables.next(), tables.next()), (Some((ids, _)), None) if in_order(ids, self.num_envs.0))
    }

    /// What is wrong with the rows.
    #[cold]
    fn fault(&self) -> Error {
        let error = |problem: String, remedy: &str| Error::Rows { kind: K::NAME, problem, remedy: remedy.into() };
        let n = self.num_envs.0;
        let mut of_env = vec![None; n];
        for (entity, EnvId(env)) in &self.all {
            match of_env.get_mut(*env as usize) {
                None => {
                    return error(
                        format!("entity {entity} has the env id {env}, and there are {n} envs"),
                        "despawn it",
                    );
                }
                Some(Some(other)) => {
                    return error(
                        format!("entities {other} and {entity} are both of env {env}"),
                        "give the second one a component of its own",
                    );
                }
                Some(place) => *place = Some(entity),
            }
        }
        if let Some(env) = of_env.iter().position(Option::is_none) {
            return error(format!("env {env} has none any more"), "keep the entities that the simulation has spawned");
        }
        let whole = self.rows.contiguous_iter().into_iter().flatten().map(|(ids, _)| ids).max_by_key(|ids| ids.len());
        let usual = whole.unwrap_or_default();
        let elsewhere = |env: &usize| !usual.contains(&EnvId(*env as u32));
        match (0..n).find(elsewhere).and_then(|env| Some((env, of_env[env]?))) {
            Some((env, entity)) => error(
                format!("entity {entity} of env {env} has other components than those of most envs"),
                "give a component to all entities of a kind, or let it have #[component(storage = \"SparseSet\")]",
            ),
            None => error(
                "components were inserted or removed in the middle of a control step".into(),
                "do so between control steps: their order is restored at the beginning of the next one",
            ),
        }
    }
}

fn nothing(kind: &'static str) -> Error {
    Error::Rows { kind, problem: "there are none".into(), remedy: "add SpawnPlugin".into() }
}

#[inline]
fn in_order(ids: &[EnvId], num_envs: usize) -> bool {
    // all of them at once
    ids.len() == num_envs && ids.iter().zip(0..).fold(0, |differ, (id, row): (&EnvId, u32)| differ | (id.0 ^ row)) == 0
}

/// Slices of the components that a query matches in one table.
pub type Slices<'w, 's, D> = <<D as ContiguousQueryData>::Contiguous<'w, 's> as IntoSlices>::Slices;

/// Bevy's contiguous data as plain slices.
pub trait IntoSlices {
    /// A slice, or a tuple of them.
    type Slices;
    /// The same data.
    fn into_slices(self) -> Self::Slices;
}

impl<'w, T> IntoSlices for &'w [T] {
    type Slices = &'w [T];

    #[inline(always)]
    fn into_slices(self) -> &'w [T] {
        self
    }
}

impl<'w, T: Component<Mutability = Mutable>> IntoSlices for ContiguousMut<'w, T> {
    type Slices = &'w mut [T];

    #[inline(always)]
    fn into_slices(self) -> &'w mut [T] {
        ContiguousMut::split(self).0
    }
}

macro_rules! slices_of_tuple {
    ($($name:ident),*) => {
        impl<$($name: IntoSlices),*> IntoSlices for ($($name,)*) {
            type Slices = ($($name::Slices,)*);

            #[inline(always)]
            #[allow(non_snake_case)]
            fn into_slices(self) -> Self::Slices {
                let ($($name,)*) = self;
                ($($name.into_slices(),)*)
            }
        }
    };
}
slices_of_tuple!(A);
slices_of_tuple!(A, B);
slices_of_tuple!(A, B, C);
slices_of_tuple!(A, B, C, D);
slices_of_tuple!(A, B, C, D, E);
slices_of_tuple!(A, B, C, D, E, F);
slices_of_tuple!(A, B, C, D, E, F, G);
slices_of_tuple!(A, B, C, D, E, F, G, H);
slices_of_tuple!(A, B, C, D, E, F, G, H, I);
slices_of_tuple!(A, B, C, D, E, F, G, H, I, J);
slices_of_tuple!(A, B, C, D, E, F, G, H, I, J, K);
slices_of_tuple!(A, B, C, D, E, F, G, H, I, J, K, L);
slices_of_tuple!(A, B, C, D, E, F, G, H, I, J, K, L, M);
slices_of_tuple!(A, B, C, D, E, F, G, H, I, J, K, L, M, N);
slices_of_tuple!(A, B, C, D, E, F, G, H, I, J, K, L, M, N, O);

/// Moves entities from one table to another and back.
#[derive(Component)]
struct Moving;

/// Puts the entities of a kind in the order of their env ids again, where all are in one table.
pub(crate) fn restore_order<K: RowKind>(world: &mut World, entities: &mut QueryState<(Entity, &EnvId), With<K>>) {
    let num_envs = world.resource::<NumEnvs>().0;
    let query = entities.query(world);
    let mut tables = query.contiguous_iter().into_iter().flatten().filter(|(_, ids)| !ids.is_empty());
    let Some((entities, ids)) = tables.next() else {
        return;
    };
    if tables.next().is_some() || ids.len() != num_envs || in_order(ids, num_envs) {
        return;
    }
    let mut by_env: Vec<(EnvId, Entity)> = ids.iter().copied().zip(entities.iter().copied()).collect();
    by_env.sort_unstable();
    // a table that entities move into has them in the order of their moves
    for (_, entity) in &by_env {
        world.entity_mut(*entity).insert(Moving);
    }
    for (_, entity) in &by_env {
        world.entity_mut(*entity).remove::<Moving>();
    }
}
