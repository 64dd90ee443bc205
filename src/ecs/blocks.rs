//! Blocks: all entities of one morphology and one kind (envs, robots, a sensor), in the order of
//! their envs.
//!
//! A block is a table of Bevy's: its components are slices, row `i` belonging to env `first + i`.
//! Systems ask for the blocks of a kind with [`Blocks`], join them with those of other kinds by
//! [`BlockIter::zip`], and work on them in chunks.
//!
//! Each morphology has separate tables, so that its entities may have components that others lack,
//! and a kind may be missing for whole morphologies: see [`BlockMarker::is_on`]. Within a block all
//! entities have the same components. Each time that blocks are read, the entities' [`EnvId`]s are
//! compared with their rows: about a microsecond for 4096 envs. Where a component was inserted into
//! one robot alone, a robot was despawned or an entity spawned on top of it, the blocks are an
//! [`Error::Rows`] that names the entity, never another env's numbers.
//!
//! Bevy moves an entity into another table when it gains or loses a component. Before each control
//! step the entities of a table are put in the order of their env ids again. Components with
//! `#[component(storage = "SparseSet")]` move nothing: they may be given to single entities.

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
}

/// Finds the block that a table is.
struct BlockFinder<'a> {
    sizes: &'a [usize],
    /// First env of each morphology.
    starts: Vec<usize>,
}

impl<'a> BlockFinder<'a> {
    fn new(BlockSizes(sizes): &'a BlockSizes) -> Self {
        let starts = sizes.iter().scan(0, |next, count| Some(std::mem::replace(next, *next + count)));
        Self { sizes, starts: starts.collect() }
    }

    /// The block that rows with these env ids are: the morphology whose envs they all are, in their
    /// order.
    #[inline]
    fn find(&self, ids: &[EnvId]) -> Option<(Morphology, Range<usize>)> {
        let EnvId(id) = *ids.first()?;
        let first = id as usize;
        // morphologies without envs come before the one that begins with the same env
        let morphology = self.starts.partition_point(|start| *start <= first).checked_sub(1)?;
        let is_block = self.starts[morphology] == first && self.sizes[morphology] == ids.len() && in_order(ids, id);
        is_block.then(|| (Morphology(morphology as u16), first..first + ids.len()))
    }
}

/// Marks the entities of a kind of which every env, or every env of some morphologies, has one.
pub trait BlockMarker: Component {
    /// Name of an entity of this kind in errors.
    const NAME: &'static str;

    /// Whether envs of a morphology have such an entity in a task. Default: yes.
    fn is_on(_morphology: &MorphologyModel, _task: &TaskConfig) -> bool {
        true
    }
}

impl BlockMarker for Env {
    const NAME: &'static str = "env";
}
impl BlockMarker for Robot {
    const NAME: &'static str = "robot";
}
impl BlockMarker for ContactSensor {
    const NAME: &'static str = "contact sensor";
}
impl BlockMarker for Imu {
    const NAME: &'static str = "IMU";
}
impl BlockMarker for JointDescriptors {
    const NAME: &'static str = "joint descriptors";
}
impl BlockMarker for HeightScan {
    const NAME: &'static str = "height scanner";
}

/// All entities of a kind.
type Entities<'w, 's, K> = Query<'w, 's, (Entity, &'static EnvId, Option<&'static Morphology>), With<K>>;

/// System parameter: components `D` of the entities of kind `K`, such as `Blocks<(&'static
/// BasePose, &'static mut Feet), Robot>`.
#[derive(SystemParam)]
pub struct Blocks<'w, 's, D: ContiguousQueryData<ReadOnly: ContiguousQueryData> + 'static, K: BlockMarker> {
    rows: Query<'w, 's, (&'static EnvId, D), With<K>>,
    all: Entities<'w, 's, K>,
    sizes: Res<'w, BlockSizes>,
}

impl<'s, D: ContiguousQueryData<ReadOnly: ContiguousQueryData> + 'static, K: BlockMarker> Blocks<'_, 's, D, K> {
    /// The blocks of all morphologies.
    ///
    /// # Errors
    /// The entities of this kind are not one per env, those of a morphology in the order of their
    /// env ids in one table.
    #[inline]
    pub fn read<'a>(&'a self) -> Result<BlockList<Slices<'a, 's, D::ReadOnly>>, Error>
    where
        <D::ReadOnly as ContiguousQueryData>::Contiguous<'a, 's>: IntoSlices,
    {
        self.read_blocks(true)
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
        self.read_blocks(false)
    }

    /// The blocks of all morphologies, to write. Bevy's change detection takes all of their rows as
    /// changed.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    #[inline]
    pub fn write<'a>(&'a mut self) -> Result<BlockList<Slices<'a, 's, D>>, Error>
    where
        D::Contiguous<'a, 's>: IntoSlices,
    {
        self.write_blocks(true)
    }

    /// The blocks of the morphologies that have entities of this kind with these components, to
    /// write. Bevy's change detection takes all of their rows as changed.
    ///
    /// # Errors
    /// As [`read_some`](Self::read_some).
    #[inline]
    pub fn write_some<'a>(&'a mut self) -> Result<BlockList<Slices<'a, 's, D>>, Error>
    where
        D::Contiguous<'a, 's>: IntoSlices,
    {
        self.write_blocks(false)
    }

    #[inline]
    fn read_blocks<'a>(&'a self, all: bool) -> Result<BlockList<Slices<'a, 's, D::ReadOnly>>, Error>
    where
        <D::ReadOnly as ContiguousQueryData>::Contiguous<'a, 's>: IntoSlices,
    {
        let tables = self.rows.contiguous_iter().into_iter().flatten();
        let tables = tables.map(|(ids, data)| (ids, data.into_slices()));
        BlockList::of_tables(tables, &self.sizes, all).map_err(|ids| fault(&self.all, &self.sizes, &ids, all))
    }

    #[inline]
    fn write_blocks<'a>(&'a mut self, all: bool) -> Result<BlockList<Slices<'a, 's, D>>, Error>
    where
        D::Contiguous<'a, 's>: IntoSlices,
    {
        let tables = self.rows.contiguous_iter_mut().into_iter().flatten();
        let tables = tables.map(|(ids, data)| (ids, data.into_slices()));
        BlockList::of_tables(tables, &self.sizes, all).map_err(|ids| fault(&self.all, &self.sizes, &ids, all))
    }
}

/// Why tables with these env ids are not the blocks of `all` morphologies, or of some.
#[cold]
fn fault<K: BlockMarker>(entities: &Entities<K>, sizes: &BlockSizes, tables: &[Vec<EnvId>], all: bool) -> Error {
    let error = |problem: String, remedy: &str| Error::Rows { kind: K::NAME, problem, remedy: remedy.into() };
    let n = sizes.num_envs();
    let mut of_env = vec![None; n];
    let mut tags = vec![None; n];
    for (entity, EnvId(env), tag) in entities {
        match of_env.get_mut(*env as usize) {
            None => {
                return error(format!("entity {entity} has the env id {env}, and there are {n} envs"), "despawn it");
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
    for (morphology, envs) in sizes.iter() {
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
        let of_block = |ids: &&Vec<EnvId>| ids.iter().filter(|id| envs.contains(&(id.0 as usize))).count();
        let usual: &[EnvId] = tables.iter().max_by_key(of_block).map_or(&[], Vec::as_slice);
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

/// Blocks of an iterator `I`, one for each morphology, in the order of their envs.
#[derive(Clone, Debug)]
pub struct BlockIter<I> {
    blocks: I,
    /// Number of envs that the blocks have at most.
    most_envs: usize,
}

/// Blocks that are all there.
pub type BlockList<R> = BlockIter<OrderedBlocks<R>>;

/// Iterator over blocks in the order of their envs. They lie in the order of Bevy's tables, which
/// is any, and are not moved to be put in order.
#[derive(Clone, Debug)]
pub struct OrderedBlocks<R> {
    /// A block that has been returned is absent.
    blocks: Vec<Option<Block<R>>>,
    /// Indices of the blocks that are left, in the order of their envs.
    order: std::vec::IntoIter<usize>,
}

impl<R> Iterator for OrderedBlocks<R> {
    type Item = Block<R>;

    #[inline]
    fn next(&mut self) -> Option<Block<R>> {
        let place = self.order.next()?;
        self.blocks.get_mut(place)?.take()
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.order.size_hint()
    }
}

impl<R> BlockList<R> {
    /// The blocks that tables with these env ids are, of `all` morphologies or of some.
    ///
    /// # Errors
    /// The tables' env ids, where they are not one block each.
    #[inline]
    fn of_tables<'a>(
        tables: impl Iterator<Item = (&'a [EnvId], R)>,
        sizes: &BlockSizes,
        all: bool,
    ) -> Result<Self, Vec<Vec<EnvId>>> {
        const ABSENT: usize = usize::MAX;
        let (finder, mut others) = (BlockFinder::new(sizes), Vec::new());
        let mut blocks: Vec<Option<Block<R>>> = Vec::with_capacity(sizes.0.len());
        let mut order = vec![ABSENT; sizes.0.len()];
        let mut most_envs = 0;
        for (ids, rows) in tables.filter(|(ids, _)| !ids.is_empty()) {
            let free = finder.find(ids).filter(|(morphology, _)| order[usize::from(morphology.0)] == ABSENT);
            match free {
                Some((morphology, envs)) => {
                    order[usize::from(morphology.0)] = blocks.len();
                    most_envs += envs.len();
                    blocks.push(Some(Block { morphology, envs, rows }));
                }
                None => others.push(ids.to_vec()),
            }
        }
        if others.is_empty() && (!all || most_envs == sizes.num_envs()) {
            order.retain(|place| *place != ABSENT);
            return Ok(Self { blocks: OrderedBlocks { blocks, order: order.into_iter() }, most_envs });
        }
        let ids = |block: &Block<R>| block.envs.clone().map(|env| EnvId(env as u32)).collect();
        others.extend(blocks.iter().flatten().map(ids));
        Err(others)
    }

    /// Blocks that are in order.
    pub(crate) fn new(blocks: impl Iterator<Item = Block<R>>) -> Self {
        let mut most_envs = 0;
        let count = |block: &Block<R>| most_envs += block.envs.len();
        let blocks: Vec<Option<Block<R>>> = blocks.inspect(count).map(Some).collect();
        let order: Vec<usize> = (0..blocks.len()).collect();
        Self { blocks: OrderedBlocks { blocks, order: order.into_iter() }, most_envs }
    }

    /// The block of the first morphology, which has these envs.
    pub(crate) fn of_one(envs: Range<usize>, rows: R) -> Self {
        Self::new(std::iter::once(Block { morphology: Morphology(0), envs, rows }))
    }

    /// Blocks of the morphologies that have the component, in the order of their envs.
    pub fn iter(&self) -> impl Iterator<Item = &Block<R>> {
        let OrderedBlocks { blocks, order } = &self.blocks;
        order.as_slice().iter().filter_map(|place| blocks.get(*place)?.as_ref())
    }

    /// Number of envs that the blocks have.
    pub fn num_envs(&self) -> usize {
        self.most_envs
    }

    /// The rows of an env's block, and which of them is the env's.
    pub fn at(&self, env: usize) -> Option<(&R, usize)> {
        let block = self.blocks.blocks.get(self.place_of(env)?)?.as_ref()?;
        Some((&block.rows, env.checked_sub(block.envs.start)?))
    }

    /// The rows of an env's block to write, and which of them is the env's.
    pub fn at_mut(&mut self, env: usize) -> Option<(&mut R, usize)> {
        let place = self.place_of(env)?;
        let block = self.blocks.blocks.get_mut(place)?.as_mut()?;
        Some((&mut block.rows, env.checked_sub(block.envs.start)?))
    }

    /// Index of the block with this env; another one if there is no such block.
    fn place_of(&self, env: usize) -> Option<usize> {
        let OrderedBlocks { blocks, order } = &self.blocks;
        let ends_before = |place: &usize| blocks[*place].as_ref().is_some_and(|block| block.envs.end <= env);
        let order = order.as_slice();
        order.get(order.partition_point(ends_before)).copied()
    }
}

impl<R, I: Iterator<Item = Block<R>>> BlockIter<I> {
    /// Makes all blocks.
    pub fn collect(self) -> BlockList<R> {
        BlockList::new(self.blocks)
    }

    /// Joins the blocks of the morphologies that are in both lists.
    #[must_use]
    pub fn zip<T, J: Iterator<Item = Block<T>>>(
        self,
        other: BlockIter<J>,
    ) -> BlockIter<impl Iterator<Item = Block<(R, T)>>> {
        let mut others = Ahead { blocks: other.blocks, next: None };
        let join = move |Block { morphology, envs, rows }| {
            let other = others.of(morphology)?;
            Some(Block { morphology, envs, rows: (rows, other) })
        };
        BlockIter { blocks: self.blocks.filter_map(join), most_envs: self.most_envs.min(other.most_envs) }
    }

    /// Joins the blocks with those of another list, where that has the morphology.
    #[must_use]
    pub fn zip_some<T, J: Iterator<Item = Block<T>>>(
        self,
        other: BlockIter<J>,
    ) -> BlockIter<impl Iterator<Item = Block<(R, Option<T>)>>> {
        let mut others = Ahead { blocks: other.blocks, next: None };
        let join = move |Block { morphology, envs, rows }| {
            let other = others.of(morphology);
            Block { morphology, envs, rows: (rows, other) }
        };
        BlockIter { blocks: self.blocks.map(join), most_envs: self.most_envs }
    }

    /// Joins the blocks with their rows of what has a row for every env of the simulation, such as
    /// an array of the [`Batch`](crate::batch::Batch).
    #[must_use]
    pub fn zip_envs<T: SplitRows>(self, rows: T) -> BlockIter<impl Iterator<Item = Block<(R, T)>>> {
        let (mut rest, mut next) = (Some(rows), 0);
        let join = move |Block { morphology, envs, rows }: Block<R>| {
            let (_, from) = rest.take()?.split_rows(envs.start - next);
            let (own, more) = from.split_rows(envs.len());
            (rest, next) = (Some(more), envs.end);
            Some(Block { morphology, envs, rows: (rows, own) })
        };
        BlockIter { blocks: self.blocks.filter_map(join), most_envs: self.most_envs }
    }

    /// Blocks of the same envs with other rows.
    #[must_use]
    pub fn map<T>(self, mut f: impl FnMut(Morphology, R) -> T) -> BlockIter<impl Iterator<Item = Block<T>>> {
        let block = move |Block { morphology, envs, rows }| Block { morphology, envs, rows: f(morphology, rows) };
        BlockIter { blocks: self.blocks.map(block), most_envs: self.most_envs }
    }
}

/// Blocks that are asked for by morphology, in rising order.
struct Ahead<I: Iterator> {
    blocks: I,
    /// The next one, where it was asked for too early.
    next: Option<I::Item>,
}

impl<T, I: Iterator<Item = Block<T>>> Ahead<I> {
    /// The rows of a morphology, where there are such.
    #[inline]
    fn of(&mut self, morphology: Morphology) -> Option<T> {
        loop {
            let block = self.next.take().or_else(|| self.blocks.next())?;
            if block.morphology == morphology {
                return Some(block.rows);
            }
            if block.morphology > morphology {
                self.next = Some(block);
                return None;
            }
        }
    }
}

impl<R, I: Iterator<Item = Block<R>>> IntoIterator for BlockIter<I> {
    type Item = Block<R>;
    type IntoIter = I;

    fn into_iter(self) -> I {
        self.blocks
    }
}

impl<R: SplitRows, I: Iterator<Item = Block<R>>> BlockIter<I> {
    /// Calls `f` on chunks of the blocks that together are all their rows, in parallel.
    pub fn for_each_chunk(self, workers: &Workers, f: impl Fn(Block<R>) + Sync) {
        let piece = |Block { morphology, envs, rows }: Block<R>| ((morphology, envs.start), envs.len(), rows);
        workers.for_each_chunk_of(self.blocks.map(piece), self.most_envs, |(morphology, start), first, n, rows| {
            f(Block { morphology, envs: start + first..start + first + n, rows });
        });
    }

    /// Runs a computation on each of these chunks that is compiled for the instruction set;
    /// `kernel` makes it of a chunk.
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
    /// Returns the data as slices.
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

/// A binary digit of a morphology's number. Entities of different morphologies have different
/// digits, so that Bevy keeps them in different tables.
#[derive(Component)]
struct TagDigit<const DIGIT: u32>;

/// Puts an entity of kind `K` into the tables of its morphology, when the component `K` is
/// inserted.
pub(crate) fn separate_morphologies<K: BlockMarker>(
    inserted: On<Insert<K>>,
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
pub(crate) fn restore_order<K: BlockMarker>(world: &mut World, entities: &mut QueryState<(Entity, &EnvId), With<K>>) {
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
        let (tags, rows): (Vec<u16>, Vec<R>) = rows.into_iter().unzip();
        let envs = |tag: &u16| sizes.iter().nth(usize::from(*tag)).unwrap().1;
        let ids: Vec<Vec<EnvId>> = tags.iter().map(|tag| envs(tag).map(|env| EnvId(env as u32)).collect()).collect();
        BlockList::of_tables(ids.iter().map(Vec::as_slice).zip(rows), sizes, false).unwrap()
    }

    #[test]
    fn tables_that_are_no_blocks_are_refused() {
        let sizes = BlockSizes(vec![2, 0, 1]);
        let is_block = |tables: &[&[u32]], all: bool| {
            let ids: Vec<Vec<EnvId>> = tables.iter().map(|ids| ids.iter().copied().map(EnvId).collect()).collect();
            BlockList::of_tables(ids.iter().map(|ids| (ids.as_slice(), ())), &sizes, all).is_ok()
        };
        assert!(is_block(&[&[0, 1], &[], &[2]], true) && is_block(&[&[2], &[0, 1]], true));
        assert!(is_block(&[&[2]], false) && is_block(&[], false) && !is_block(&[&[2]], true));
        let wrong: [&[&[u32]]; 6] =
            [&[&[0]], &[&[1, 0]], &[&[0, 1, 2]], &[&[2], &[2]], &[&[0, 1], &[3]], &[&[0, 1], &[1]]];
        for tables in wrong {
            assert!(!is_block(tables, false), "{tables:?}");
        }
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
        for (block, (robot, sensor, own)) in joined.into_iter().zip(expected) {
            assert_eq!((block.rows.0, &*block.rows.1), ((robot, sensor), own));
        }
        assert_eq!((robots().num_envs(), sensors().num_envs()), (9, 2));
        let both = list([(0, 1), (3, 2)], &sizes).zip(list([(2, 3), (3, 4)], &sizes)).collect();
        assert_eq!(both.iter().map(|block| (block.envs.clone(), block.rows)).collect::<Vec<_>>(), [(5..9, (2, 4))]);
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
