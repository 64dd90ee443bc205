//! The [`Topology`]: the structure that all lanes of a pack share.

use super::blocks::{BLOCK, Block, Blocks, Carrier, PathPart, Paths};
use super::lanes::{MOST_LANES, Table};
use super::lists::Lists;

/// Motion of a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointMotion {
    /// Turns about its axis; position in rad.
    Revolute,
    /// Slides along its axis; position in m.
    Prismatic,
}

/// A joint axis in the (base-aligned) frame of its link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Axis {
    /// The x axis with this sign.
    X(f64),
    /// The y axis with this sign.
    Y(f64),
    /// The z axis with this sign.
    Z(f64),
    /// Any unit vector.
    General([f64; 3]),
}

impl Axis {
    /// The cheapest form of a unit vector.
    pub fn new(direction: [f64; 3]) -> Self {
        const ALIGNED: f64 = 1.0 - 1e-14;
        let [x, y, z] = direction;
        if x.abs() > ALIGNED {
            Axis::X(x.signum())
        } else if y.abs() > ALIGNED {
            Axis::Y(y.signum())
        } else if z.abs() > ALIGNED {
            Axis::Z(z.signum())
        } else {
            Axis::General(direction)
        }
    }

    /// The unit vector.
    pub fn direction(self) -> [f64; 3] {
        match self {
            Axis::X(s) => [s, 0.0, 0.0],
            Axis::Y(s) => [0.0, s, 0.0],
            Axis::Z(s) => [0.0, 0.0, s],
            Axis::General(u) => u,
        }
    }
}

/// One joint and the link it moves: joint `j` moves link `j + 1`; link 0 is the base.
#[derive(Clone, Debug)]
pub struct JointTopology {
    /// The link that carries the joint; at most `j`.
    pub parent: usize,
    /// Revolute or prismatic.
    pub motion: JointMotion,
    /// Direction, in link axes, which are parallel to the base's when all joints are at zero.
    pub axis: Axis,
    /// A table of effort limits over the joint position, if the actuator has one: equally spaced.
    pub effort_table: Option<EffortTable>,
    /// Whether the actuator's gains act on the beginning of a physics step (as a motor controller
    /// at the step's rate would) instead of on its end.
    pub explicit: bool,
}

/// Effort limits over a joint position, linear in between, constant beyond the ends.
#[derive(Clone, Debug)]
pub struct EffortTable {
    /// Position of the first entry, rad.
    pub start: f32,
    /// One over the distance of two entries, 1/rad.
    pub inverse_step: f32,
    /// Effort limits at equally spaced positions, N m.
    pub limits: Vec<f32>,
}

impl EffortTable {
    /// The limit at a position, N m.
    #[inline(always)]
    pub fn limit_at(&self, position: f32) -> f32 {
        let last = self.limits.len() - 1;
        // a NaN becomes 0 in the cast
        let x = ((position - self.start) * self.inverse_step).clamp(0.0, last as f32);
        let i = (x as usize).min(last.saturating_sub(1));
        let (a, b) = (self.limits[i], self.limits[(i + 1).min(last)]);
        (b - a).mul_add(x - i as f32, a)
    }
}

/// Effort limits, N m, by positions, rad.
impl Table<1> for EffortTable {
    type Found = [f32; MOST_LANES];

    #[inline(always)]
    fn look_up(&self, [position]: &[[f32; MOST_LANES]; 1], lanes: usize) -> Self::Found {
        let mut found = [0.0; MOST_LANES];
        for lane in 0..lanes {
            found[lane] = self.limit_at(position[lane]);
        }
        found
    }
}

/// Place of a contact candidate on its link.
#[derive(Clone, Copy, Debug)]
pub enum ContactKind {
    /// A sphere (or, with radius 0, a corner) at a fixed place.
    Point,
    /// A point on the rim of a cylinder's end: the lowest one, turned by a fixed angle about the
    /// cylinder's axis.
    Rim {
        /// Two unit vectors across the axis, in link axes.
        across: [[f64; 3]; 2],
        /// Cosine and sine of the fixed angle.
        turn: [f64; 2],
    },
}

/// Motions of a contact with the ground that friction resists.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum ContactFriction {
    /// Sliding: MuJoCo's `condim` 3.
    #[default]
    Sliding,
    /// Turning about the normal, too: `condim` 4.
    Torsional,
    /// Rolling about the tangents, too: `condim` 6.
    Rolling,
}

impl ContactFriction {
    /// The fewest motions for coefficients of torsional and rolling friction up to these, m.
    pub fn of(torsional: f64, rolling: f64) -> Self {
        if rolling > 0.0 {
            Self::Rolling
        } else if torsional > 0.0 {
            Self::Torsional
        } else {
            Self::Sliding
        }
    }
}

/// A place on a robot that can touch the ground.
#[derive(Clone, Copy, Debug)]
pub struct ContactTopology {
    /// Link it is fixed to.
    pub link: usize,
    /// Contact body whose force it adds to.
    pub body: usize,
    /// Point or rim.
    pub kind: ContactKind,
}

/// A simple shape that stands for a part of a link when links of the same robot touch each other.
#[derive(Clone, Copy, Debug)]
pub struct ColliderTopology {
    /// Link it is fixed to.
    pub link: usize,
    /// Contact body whose force it adds to.
    pub body: usize,
    /// Axes of a box in link axes; none for a capsule.
    pub box_rotation: Option<[[f64; 3]; 3]>,
}

/// Two colliders of different links that may touch each other.
#[derive(Clone, Copy, Debug)]
pub struct PairTopology {
    /// Colliders: a capsule, then a capsule or a box.
    pub colliders: [usize; 2],
    /// Parts of the capsule's axis, whose ends are -1 and 1: each part is a separate contact, so
    /// that links can lie against each other.
    pub spans: &'static [[f64; 2]],
    /// Contact bodies of the two.
    pub(super) bodies: [usize; 2],
    /// The first of its impulses.
    pub(super) first_impulse: usize,
    /// Path that holds the joints on the ways from both links to the base.
    pub(super) path: usize,
}

/// The pairs between two links.
#[derive(Clone, Debug)]
pub(super) struct PairGroup {
    pub(super) links: [usize; 2],
    /// Range of the pairs in [`Topology::pairs`].
    pub(super) pairs: std::ops::Range<usize>,
}

/// The deepest chain of joints that bounds can be solved on.
pub const MAX_DEPTH: usize = 64;

/// The articulation of one morphology: all that must be equal in the lanes of a pack.
#[derive(Clone, Debug)]
pub struct Topology {
    /// Whether the base moves freely; else it is fixed to the world.
    pub floating: bool,
    /// Joints, parents before children.
    pub joints: Vec<JointTopology>,
    /// Contact candidates, sorted by link.
    pub contacts: Vec<ContactTopology>,
    /// Shapes for contact between the robot's own links.
    pub colliders: Vec<ColliderTopology>,
    /// Pairs of these shapes that are looked at.
    pub pairs: Vec<PairTopology>,
    /// These pairs by links.
    pub(super) pair_groups: Vec<PairGroup>,
    /// `link_colliders[link]`: its places in `colliders`.
    link_colliders: Lists<usize>,
    /// `sides[pair]`: the side of each joint of its path: 1 carries the first link only, -1 the
    /// second only, 0 both.
    sides: Lists<[f64; BLOCK]>,
    /// Number of contact bodies.
    pub num_bodies: usize,
    /// Link of each site (a point whose position and velocity are reported, such as a foot).
    pub sites: Vec<usize>,
    /// Whether any actuator delays its target.
    pub has_delay: bool,
    /// Whether any joint has a passive spring.
    pub has_springs: bool,
    /// Whether contacts with the ground differ in friction.
    pub has_surfaces: bool,
    /// Directions in which friction with the ground resists. Rows of torsional and rolling friction
    /// are built where it asks for them, whatever the coefficients.
    pub friction: ContactFriction,
    blocks: Blocks,
    /// `paths[link]`: the joints that carry the link; after the links' the paths of the pairs.
    paths: Paths,
    /// `link_contacts[link]`: its range in `contacts`.
    link_contacts: Vec<std::ops::Range<usize>>,
    pair_of_impulse: Vec<usize>,
}

impl Topology {
    /// Builds the derived tables.
    ///
    /// # Panics
    /// If a joint's parent is not an earlier link or contacts name links that do not exist; loaders
    /// guarantee both.
    pub fn new(
        floating: bool,
        joints: Vec<JointTopology>,
        mut contacts: Vec<ContactTopology>,
        num_bodies: usize,
        sites: Vec<usize>,
        has_delay: bool,
    ) -> Self {
        let blocks = Blocks::new(&joints);
        let mut paths = Paths::default();
        (0..=joints.len()).for_each(|link| paths.push(&blocks, &blocks.path(link)));
        contacts.sort_by_key(|c| c.link);
        let link_contacts = (0..paths.len())
            .map(|link| {
                let start = contacts.partition_point(|c| c.link < link);
                start..contacts.partition_point(|c| c.link <= link)
            })
            .collect();
        Self {
            floating,
            joints,
            contacts,
            colliders: Vec::new(),
            pairs: Vec::new(),
            pair_groups: Vec::new(),
            link_colliders: Lists::default(),
            sides: Lists::default(),
            num_bodies,
            sites,
            has_delay,
            has_springs: false,
            has_surfaces: false,
            friction: ContactFriction::Sliding,
            blocks,
            paths,
            link_contacts,
            pair_of_impulse: Vec::new(),
        }
    }

    /// Lets pairs of `colliders` touch each other: a capsule and a capsule or box, and whether the
    /// first capsule is long enough to touch in two points. Pairs of the same two links should
    /// stand together: they are then tested together.
    ///
    /// # Panics
    /// If indices name colliders or links that do not exist; loaders guarantee that they do.
    pub fn set_pairs(&mut self, colliders: Vec<ColliderTopology>, pairs: &[([usize; 2], bool)]) {
        self.paths.truncate(self.num_links());
        self.sides = Lists::default();
        let mut new: Vec<PairTopology> = Vec::new();
        let mut groups: Vec<PairGroup> = Vec::new();
        let mut pair_of_impulse = Vec::new();
        let links_of = |pair: [usize; 2]| pair.map(|c| colliders[c].link);
        for &(pair, long) in pairs {
            match groups.last_mut() {
                Some(group) if group.links == links_of(pair) => group.pairs.end += 1,
                _ => groups.push(PairGroup { links: links_of(pair), pairs: new.len()..new.len() + 1 }),
            }
            let [first, second] = links_of(pair).map(|link| self.blocks.path(link));
            let path = self.blocks.path_of_both(links_of(pair));
            let carries = |path: &[Carrier], block: usize, place: usize| {
                path.iter().any(|part| part.block == block && place < part.count)
            };
            let side_of = |part: &Carrier| {
                std::array::from_fn(|place| {
                    let [first, second] = [&first, &second].map(|path| i8::from(carries(path, part.block, place)));
                    f64::from(first - second)
                })
            };
            let spans: &[[f64; 2]] = if long { &[[-1.0, 0.0], [0.0, 1.0]] } else { &[[-1.0, 1.0]] };
            let first_impulse = self.contacts.len() + pair_of_impulse.len();
            pair_of_impulse.extend(spans.iter().map(|_| new.len()));
            new.push(PairTopology {
                colliders: pair,
                bodies: pair.map(|c| colliders[c].body),
                spans,
                first_impulse,
                path: self.paths.len(),
            });
            self.sides.push(path.iter().map(side_of));
            self.paths.push(&self.blocks, &path);
        }
        self.pairs = new;
        self.pair_groups = groups;
        self.pair_of_impulse = pair_of_impulse;
        self.colliders = colliders;
        let all = &self.colliders;
        let of_link = |link| (0..all.len()).filter(move |&c| all[c].link == link);
        self.link_colliders = (0..self.num_links()).map(of_link).collect();
    }

    /// The colliders of a link, as places in [`colliders`](Self::colliders).
    #[inline(always)]
    pub(super) fn colliders_of(&self, link: usize) -> &[usize] {
        if self.colliders.is_empty() { &[] } else { &self.link_colliders[link] }
    }

    /// Number of impulses that warm-start contacts: one per ground contact candidate, then those of
    /// the pairs, then with torsional or rolling friction the angular impulse of each candidate.
    pub fn num_impulses(&self) -> usize {
        self.num_contacts() + self.num_spins()
    }

    /// The most contacts at a time.
    pub(super) fn num_contacts(&self) -> usize {
        self.contacts.len() + self.pair_of_impulse.len()
    }

    /// The most contacts with torsional or rolling friction at a time.
    pub(super) fn num_spins(&self) -> usize {
        if self.friction == ContactFriction::Sliding { 0 } else { self.contacts.len() }
    }

    /// The angular impulse of a ground contact candidate among all impulses.
    #[inline(always)]
    pub(super) fn spin_impulse(&self, contact: usize) -> usize {
        self.num_contacts() + contact
    }

    /// The pair that an impulse belongs to; none for one of the ground's.
    #[inline(always)]
    pub(super) fn pair_of(&self, impulse: usize) -> Option<&PairTopology> {
        let i = impulse.checked_sub(self.contacts.len())?;
        Some(&self.pairs[self.pair_of_impulse[i]])
    }

    /// The most blocks that any contact acts on.
    pub(super) fn max_path(&self) -> usize {
        self.paths.longest()
    }

    /// Number of joints.
    pub fn num_joints(&self) -> usize {
        self.joints.len()
    }

    /// Number of links, the base included.
    pub fn num_links(&self) -> usize {
        self.joints.len() + 1
    }

    /// The joints that carry a link, those of the nearest block first; with numbers from
    /// [`num_links`](Self::num_links) on those of the pairs.
    #[inline(always)]
    pub(super) fn path(&self, link: usize) -> &[PathPart] {
        self.paths.parts(link)
    }

    /// Places in their path of the blocks that carry the block of a part.
    #[inline(always)]
    pub(super) fn carriers_in_path(&self, part: &PathPart) -> &[usize] {
        self.paths.carriers_of(part)
    }

    /// The side of each joint of a pair's path: 1 carries the first link only, -1 the second only,
    /// 0 both.
    #[inline(always)]
    pub(super) fn sides(&self, pair: &PairTopology) -> &[[f64; BLOCK]] {
        &self.sides[pair.path - self.num_links()]
    }

    /// The joints in blocks, each after those that carry it.
    #[inline(always)]
    pub fn blocks(&self) -> &[Block] {
        &self.blocks.blocks
    }

    /// The joints that carry all of a block, nearest block first.
    #[inline(always)]
    pub fn carriers_of(&self, block: &Block) -> &[Carrier] {
        self.blocks.carriers_of(block)
    }

    /// The blocks of each tree that the base carries, each after those that carry it.
    #[inline(always)]
    pub(super) fn trees(&self) -> impl DoubleEndedIterator<Item = &[usize]> {
        self.blocks.trees.iter()
    }

    /// The place of a link among those of its tree, after the links that carry it; that of the base
    /// is 0.
    #[inline(always)]
    pub(super) fn slot(&self, link: usize) -> usize {
        self.blocks.slots[link]
    }

    /// Number of such places.
    pub(super) fn num_slots(&self) -> usize {
        self.blocks.slots.iter().max().map_or(1, |last| last + 1)
    }

    /// Number of couplings between blocks.
    pub(super) fn num_couplings(&self) -> usize {
        self.blocks.carriers.len()
    }

    /// The joints that carry a link, nearest first.
    pub fn chain(&self, link: usize) -> impl Iterator<Item = usize> {
        let carrier = |link: usize| link.checked_sub(1);
        std::iter::successors(carrier(link), move |&joint| carrier(self.joints[joint].parent))
    }

    /// The longest chain of joints.
    pub fn max_depth(&self) -> usize {
        (0..self.num_links()).map(|link| self.chain(link).count()).max().unwrap_or(0)
    }

    /// The contact candidates of a link.
    #[inline(always)]
    pub fn contacts_of(&self, link: usize) -> std::ops::Range<usize> {
        self.link_contacts[link].clone()
    }
}
