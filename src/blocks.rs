//! Blocks: all entities of one morphology and one kind (envs, robots, a sensor), in the order of their envs.
//!
//! A block is a table of Bevy's: its components are slices, row `i` belonging to env `first + i`. Systems ask for the blocks of a
//! kind with [`Blocks`], join them with those of other kinds by [`BlockList::zip`], and work on them in chunks.
//!
//! Each morphology has tables of its own, so that its entities may have components that others lack, and a kind may be missing
//! for whole morphologies: see [`RowKind::is_on`]. Within a block all entities have the same components. Each time that blocks are
//! read, the entities' [`EnvId`]s are compared with their rows: about a microsecond for 4096 envs. Where a component was inserted
//! into one robot alone, a robot was despawned or an entity spawned on top of it, the blocks are an [`Error::Rows`] that names the
//! entity, never another env's numbers.
//!
//! Bevy moves an entity into another table when it gains or loses a component. Before each control step the entities of a table
//! are put in the order of their env ids again. Components with `#[component(storage = "SparseSet")]` move nothing: they may be
//! given to single entities.

use std::ops::Range;

use bevy_ecs::change_detection::ContiguousMut;
use bevy_ecs::component::Mutable;
use bevy_ecs::lifecycle::Insert;
use bevy_ecs::prelude::*;
use bevy_ecs::query::ContiguousQueryData;
use bevy_ecs::system::SystemParam;

use crate::components::{ContactSensor, Env, EnvId, HeightScan, Imu, JointDescriptors, Morphology, Robot};
use crate::config::TaskConfig;
use crate::dynamics::lanes::Kernel;
use crate::error::Error;
use crate::morphology::MorphologyModel;
use crate::workers::{SplitRows, Workers};

/// Number of envs of each morphology, in the order of their blocks.
#[derive(Resource, Clone, Debug, PartialEq, Eq)]
pub struct BlockSizes(pub Vec<usize>);

impl BlockSizes {
    /// Number of envs of all morphologies.
    pub fn num_envs(&self) -> usize {
        self.0.iter().sum()
    }

    /// The envs of each morphology.
    pub fn iter(&self) -> impl Iterator<Item = (Morphology, Range<usize>)> + '_ {
        let mut next = 0;
        self.0.iter().enumerate().map(move |(morphology, &count)| {
            let first = next;
            next += count;
            (Morphology(morphology as u16), first..next)
        })
    }

    /// The block that rows with these env ids are: the morphology whose envs they all are, in their order.
    fn of(&self, ids: &[EnvId]) -> Option<(Morphology, Range<usize>)> {
        let first = ids.first()?.0;
        self.iter().find(|(_, envs)| envs.start == first as usize && envs.len() == ids.len() && in_order(ids, first))
    }
}

/// Marks the entities of a kind of which every env, or every env of some morphologies, has one.
pub trait RowKind: Component {
    /// What an entity of this kind is called in errors.
    const NAME: &'static str;

    /// Whether the envs of a morphology have one in a task. Default: they have.
    fn is_on(_morphology: &MorphologyModel, _task: &TaskConfig) -> bool {
        true
    }
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

/// Morphology and envs of tables, in the order in which Bevy has these.
type Places = Vec<(Morphology, Range<usize>)>;

/// System parameter: components `D` of the entities of kind `K`, such as `Blocks<(&'static BasePose, &'static mut Feet), Robot>`.
#[derive(SystemParam)]
pub struct Blocks<'w, 's, D: ContiguousQueryData<ReadOnly: ContiguousQueryData> + 'static, K: RowKind> {
    rows: Query<'w, 's, (&'static EnvId, D), With<K>>,
    all: Query<'w, 's, (Entity, &'static EnvId, Option<&'static Morphology>), With<K>>,
    sizes: Res<'w, BlockSizes>,
}

impl<'s, D: ContiguousQueryData<ReadOnly: ContiguousQueryData> + 'static, K: RowKind> Blocks<'_, 's, D, K> {
    /// The blocks of all morphologies.
    ///
    /// # Errors
    /// The entities of this kind are not one per env, those of a morphology in the order of their env ids in one table.
    #[inline]
    pub fn read<'a>(&'a self) -> Result<BlockList<Slices<'a, 's, D::ReadOnly>>, Error>
    where
        <D::ReadOnly as ContiguousQueryData>::Contiguous<'a, 's>: IntoSlices,
    {
        Ok(self.read_from(self.places(true)?))
    }

    /// The blocks of the morphologies that have entities of this kind with these components.
    ///
    /// # Errors
    /// As [`read`](Self::read), for the envs of these morphologies.
    #[inline]
    pub fn read_some<'a>(&'a self) -> Result<BlockList<Slices<'a, 's, D::ReadOnly>>, Error>
    where
        <D::ReadOnly as ContiguousQueryData>::Contiguous<'a, 's>: IntoSlices,
    {
        Ok(self.read_from(self.places(false)?))
    }

    /// The blocks of all morphologies, to write. Bevy's change detection does not see it.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    #[inline]
    pub fn write<'a>(&'a mut self) -> Result<BlockList<Slices<'a, 's, D>>, Error>
    where
        D::Contiguous<'a, 's>: IntoSlices,
    {
        let places = self.places(true)?;
        Ok(self.write_to(places))
    }

    /// The blocks of the morphologies that have entities of this kind with these components, to write. Bevy's change detection does
    /// not see it.
    ///
    /// # Errors
    /// As [`read_some`](Self::read_some).
    #[inline]
    pub fn write_some<'a>(&'a mut self) -> Result<BlockList<Slices<'a, 's, D>>, Error>
    where
        D::Contiguous<'a, 's>: IntoSlices,
    {
        let places = self.places(false)?;
        Ok(self.write_to(places))
    }

    fn read_from<'a>(&'a self, places: Places) -> BlockList<Slices<'a, 's, D::ReadOnly>>
    where
        <D::ReadOnly as ContiguousQueryData>::Contiguous<'a, 's>: IntoSlices,
    {
        let tables = self.rows.contiguous_iter().into_iter().flatten().filter(|(ids, _)| !ids.is_empty());
        BlockList::new(places, tables.map(|(_, data)| data.into_slices()))
    }

    fn write_to<'a>(&'a mut self, places: Places) -> BlockList<Slices<'a, 's, D>>
    where
        D::Contiguous<'a, 's>: IntoSlices,
    {
        let tables = self.rows.contiguous_iter_mut().into_iter().flatten().filter(|(ids, _)| !ids.is_empty());
        BlockList::new(places, tables.map(|(_, data)| data.into_slices()))
    }

    /// Which block each table is that has rows: of `all` morphologies, or of some.
    fn places(&self, all: bool) -> Result<Places, Error> {
        let mut places = Vec::with_capacity(self.sizes.0.len());
        let mut is_there = vec![false; self.sizes.0.len()];
        for (ids, _) in self.rows.contiguous_iter().into_iter().flatten().filter(|(ids, _)| !ids.is_empty()) {
            match self.sizes.of(ids) {
                Some(block) if !std::mem::replace(&mut is_there[usize::from(block.0.0)], true) => places.push(block),
                _ => return Err(self.fault(all)),
            }
        }
        let is_missing = |(count, is_there): (&usize, &bool)| *count > 0 && !is_there;
        if all && self.sizes.0.iter().zip(&is_there).any(is_missing) {
            return Err(self.fault(all));
        }
        Ok(places)
    }

    /// What is wrong with the blocks.
    #[cold]
    fn fault(&self, all: bool) -> Error {
        let error = |problem: String, remedy: &str| Error::Rows { kind: K::NAME, problem, remedy: remedy.into() };
        let n = self.sizes.num_envs();
        let mut of_env = vec![None; n];
        let mut tags = vec![None; n];
        for (entity, EnvId(env), tag) in &self.all {
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
            tags[*env as usize] = tag.copied();
        }
        let tables: Vec<&[EnvId]> = self.rows.contiguous_iter().into_iter().flatten().map(|(ids, _)| ids).collect();
        for (morphology, envs) in self.sizes.iter() {
            let entities = &of_env[envs.clone()];
            if entities.iter().all(Option::is_none) && !all {
                continue;
            }
            if let Some(row) = entities.iter().position(Option::is_none) {
                let env = envs.start + row;
                let remedy = "keep the entities that the simulation has spawned";
                return error(format!("env {env} has none any more"), remedy);
            }
            let named = |env: usize| of_env[env].map_or_else(String::new, |entity| entity.to_string());
            if let Some(env) = envs.clone().find(|&env| tags[env] != Some(morphology)) {
                let problem = format!("entity {} of env {env} is not tagged with the env's morphology", named(env));
                return error(problem, "spawn it with the Morphology of its env");
            }
            let of_block = |ids: &&&[EnvId]| ids.iter().filter(|id| envs.contains(&(id.0 as usize))).count();
            let usual: &[EnvId] = tables.iter().max_by_key(of_block).copied().unwrap_or_default();
            if !usual.iter().any(|id| envs.contains(&(id.0 as usize))) {
                if all && !envs.is_empty() {
                    let problem = format!("entity {} of env {} lacks a component", named(envs.start), envs.start);
                    return error(problem, "give it to all morphologies, or ask for the blocks of some: read_some()");
                }
                continue;
            }
            if let Some(env) = envs.clone().find(|&env| !usual.contains(&EnvId(env as u32))) {
                return error(
                    format!("entity {} of env {env} has other components than those of most envs", named(env)),
                    "give a component to all entities of a morphology, or let it have \
                     #[component(storage = \"SparseSet\")]",
                );
            }
        }
        error(
            "components were inserted or removed in the middle of a control step".into(),
            "do so between control steps: their order is restored at the beginning of the next one",
        )
    }
}

/// Whether env ids ascend by one from `first` on.
#[inline]
fn in_order(ids: &[EnvId], first: u32) -> bool {
    // all of them at once
    ids.iter().zip(first..).fold(0, |differ, (id, env): (&EnvId, u32)| differ | (id.0 ^ env)) == 0
}

/// The rows of one morphology's entities, or some consecutive ones of them.
#[derive(Clone, Debug)]
pub struct Block<R> {
    /// The morphology.
    pub morphology: Morphology,
    /// The envs of the rows, in their order.
    pub envs: Range<usize>,
    /// Slices, one row for each env.
    pub rows: R,
}

/// Blocks in the order of their envs, each of another morphology.
#[derive(Clone, Debug)]
pub struct BlockList<R>(Vec<Block<R>>);

impl<R> BlockList<R> {
    fn new(places: Places, rows: impl Iterator<Item = R>) -> Self {
        let block = |((morphology, envs), rows)| Block { morphology, envs, rows };
        let mut blocks: Vec<Block<R>> = places.into_iter().zip(rows).map(block).collect();
        // tables are in the order in which they were made, which is this one unless components were inserted since
        blocks.sort_by_key(|block| block.morphology);
        Self(blocks)
    }

    /// The block of the first morphology, which has these envs.
    pub(crate) fn of_one(envs: Range<usize>, rows: R) -> Self {
        Self(vec![Block { morphology: Morphology(0), envs, rows }])
    }

    /// The blocks.
    pub fn iter(&self) -> impl Iterator<Item = &Block<R>> {
        self.0.iter()
    }

    /// Number of envs that the blocks have.
    pub fn num_envs(&self) -> usize {
        self.0.iter().map(|block| block.envs.len()).sum()
    }

    /// The rows of an env's block, and which of them is the env's.
    pub fn at(&self, env: usize) -> Option<(&R, usize)> {
        let place = self.0.partition_point(|block| block.envs.end <= env);
        let block = self.0.get(place).filter(|block| block.envs.start <= env)?;
        Some((&block.rows, env - block.envs.start))
    }

    /// The same, to write.
    pub fn at_mut(&mut self, env: usize) -> Option<(&mut R, usize)> {
        let place = self.0.partition_point(|block| block.envs.end <= env);
        let block = self.0.get_mut(place).filter(|block| block.envs.start <= env)?;
        Some((&mut block.rows, env - block.envs.start))
    }

    /// Joins the blocks of the morphologies that are in both lists.
    #[must_use]
    pub fn zip<T>(self, other: BlockList<T>) -> BlockList<(R, T)> {
        let mut others = other.0.into_iter().peekable();
        let joined = self.0.into_iter().filter_map(|Block { morphology, envs, rows }| {
            while others.next_if(|other| other.morphology < morphology).is_some() {}
            let other = others.next_if(|other| other.morphology == morphology)?;
            Some(Block { morphology, envs, rows: (rows, other.rows) })
        });
        BlockList(joined.collect())
    }

    /// Joins the blocks with those of another list, where that has the morphology.
    #[must_use]
    pub fn zip_some<T>(self, other: BlockList<T>) -> BlockList<(R, Option<T>)> {
        let mut others = other.0.into_iter().peekable();
        let joined = self.0.into_iter().map(|Block { morphology, envs, rows }| {
            while others.next_if(|other| other.morphology < morphology).is_some() {}
            let other = others.next_if(|other| other.morphology == morphology);
            Block { morphology, envs, rows: (rows, other.map(|other| other.rows)) }
        });
        BlockList(joined.collect())
    }

    /// Joins the blocks with their rows of what has a row for every env of the simulation, such as an array of the
    /// [`Batch`](crate::batch::Batch).
    #[must_use]
    pub fn zip_envs<T: SplitRows>(self, rows: T) -> BlockList<(R, T)> {
        let (mut rest, mut next) = (Some(rows), 0);
        let joined = self.0.into_iter().filter_map(|Block { morphology, envs, rows }| {
            let (_, from) = rest.take()?.split_rows(envs.start - next);
            let (own, more) = from.split_rows(envs.len());
            (rest, next) = (Some(more), envs.end);
            Some(Block { morphology, envs, rows: (rows, own) })
        });
        BlockList(joined.collect())
    }

    /// The same blocks with other rows.
    #[must_use]
    pub fn map<T>(self, mut f: impl FnMut(Morphology, R) -> T) -> BlockList<T> {
        let block = |Block { morphology, envs, rows }| Block { morphology, envs, rows: f(morphology, rows) };
        BlockList(self.0.into_iter().map(block).collect())
    }
}

impl<R> IntoIterator for BlockList<R> {
    type Item = Block<R>;
    type IntoIter = std::vec::IntoIter<Block<R>>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.into_iter()
    }
}

impl<R: SplitRows> BlockList<R> {
    /// Calls `f` on chunks of the blocks that together are all their rows, in parallel.
    pub fn for_each_chunk(self, workers: &Workers, f: impl Fn(Block<R>) + Sync) {
        let len = self.num_envs();
        let blocks =
            self.0.into_iter().map(|Block { morphology, envs, rows }| ((morphology, envs.start), envs.len(), rows));
        workers.for_each_chunk_of(blocks, len, |(morphology, start), first, n, rows| {
            f(Block { morphology, envs: start + first..start + first + n, rows });
        });
    }

    /// The same with a computation on each chunk that is compiled for the instruction set; `kernel` makes it of a chunk.
    pub fn vectorize_chunks<K: Kernel<f32, Output = ()>>(
        self,
        workers: &Workers,
        kernel: impl Fn(Block<R>) -> K + Sync,
    ) {
        self.for_each_chunk(workers, |chunk| workers.dispatch().vectorize(kernel(chunk)));
    }
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

/// A binary digit of a morphology's number. Entities of different morphologies have different digits, so that Bevy keeps them in
/// different tables.
#[derive(Component)]
struct TagDigit<const DIGIT: u32>;

/// Puts an entity of kind `K` into the tables of its morphology, when the component `K` is inserted.
pub(crate) fn separate_morphologies<K: RowKind>(
    inserted: On<Insert, K>,
    tags: Query<&Morphology>,
    mut commands: Commands,
) {
    let Ok(&Morphology(tag)) = tags.get(inserted.entity) else {
        return;
    };
    let mut entity = commands.entity(inserted.entity);
    macro_rules! insert_digits {
        ($($digit:literal)*) => {
            $(
                if tag >> $digit & 1 == 1 {
                    entity.insert_if_new(TagDigit::<$digit>);
                }
            )*
        };
    }
    insert_digits!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15);
}

/// Moves entities from one table to another and back.
#[derive(Component)]
struct Moving;

/// Puts the entities of a kind in the order of their env ids again, those of each table.
pub(crate) fn restore_order<K: RowKind>(world: &mut World, entities: &mut QueryState<(Entity, &EnvId), With<K>>) {
    let mut by_env: Vec<(EnvId, Entity)> = Vec::new();
    for (entities, ids) in entities.query(world).contiguous_iter().into_iter().flatten() {
        // all of them at once
        let ascend = ids.windows(2).fold(true, |all, pair| all & (pair[0] < pair[1]));
        if !ascend {
            by_env.extend(ids.iter().copied().zip(entities.iter().copied()));
        }
    }
    by_env.sort_unstable();
    // a table that entities move into has them in the order of their moves
    for (_, entity) in &by_env {
        world.entity_mut(*entity).insert(Moving);
    }
    for (_, entity) in &by_env {
        world.entity_mut(*entity).remove::<Moving>();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list<R>(rows: impl IntoIterator<Item = (u16, R)>, sizes: &BlockSizes) -> BlockList<R> {
        let (places, rows): (Vec<_>, Vec<R>) =
            rows.into_iter().map(|(tag, rows)| (sizes.iter().nth(usize::from(tag)).unwrap(), rows)).unzip();
        BlockList::new(places, rows.into_iter())
    }

    #[test]
    fn blocks_are_joined_by_morphology() {
        let sizes = BlockSizes(vec![3, 0, 2, 4]);
        let mut batch: Vec<usize> = (0..sizes.num_envs()).collect();
        // tables may come in another order
        let robots = || list([(3, "d"), (0, "a"), (2, "c")], &sizes);
        let sensors = || list([(2, "C")], &sizes);
        let joined: Vec<_> = robots().zip(sensors()).into_iter().map(|block| (block.envs, block.rows)).collect();
        assert_eq!(joined, [(3..5, ("c", "C"))]);
        let joined = robots().zip_some(sensors()).zip_envs(&mut batch[..]);
        let expected: [(&str, Option<&str>, &[usize]); 3] =
            [("a", None, &[0, 1, 2]), ("c", Some("C"), &[3, 4]), ("d", None, &[5, 6, 7, 8])];
        for (block, (robot, sensor, own)) in joined.iter().zip(expected) {
            assert_eq!((block.rows.0, &*block.rows.1), ((robot, sensor), own));
        }
        assert_eq!(joined.num_envs(), 9);
        let own: Vec<_> = sensors().zip_envs(&mut batch[..]).into_iter().map(|block| block.rows.1.to_vec()).collect();
        assert_eq!(own, [[3, 4]]);
        let at = |env| robots().at(env).map(|(rows, row)| (*rows, row));
        assert_eq!((at(2), at(3), at(8), at(9)), (Some(("a", 2)), Some(("c", 0)), Some(("d", 3)), None));
        assert!(sensors().at(5).is_none() && sensors().at_mut(2).is_none());
    }

    #[test]
    fn a_chunk_has_rows_of_one_block() {
        use crate::dynamics::lanes::Simd;
        for threads in [1, 3] {
            let workers = Workers::new(threads, Simd::Portable);
            let sizes = BlockSizes(vec![70, 0, 1, 300, 5]);
            let mut rows: Vec<(u16, usize)> = vec![(0, 0); sizes.num_envs()];
            let blocks =
                list([(0, ()), (2, ()), (3, ()), (4, ())], &sizes).zip_envs(&mut rows[..]).map(|_, (_, rows)| rows);
            blocks.for_each_chunk(&workers, |Block { morphology, envs, rows }| {
                assert_eq!(envs.len(), rows.len());
                envs.zip(rows).for_each(|(env, row)| *row = (morphology.0, row.1 + env));
            });
            for (morphology, envs) in sizes.iter() {
                assert!(envs.clone().all(|env| rows[env] == (morphology.0, env)), "{threads} threads");
            }
        }
    }
}
