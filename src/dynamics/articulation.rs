//! What a pack of robots shares (the [`Topology`]) and what each lane has of its own (the [`Parameters`]).

use serde::{Deserialize, Serialize};

use super::blocks::{BLOCK, Block, Blocks, PathPart};
use super::lanes::Real;
use super::math::{Sym3, Vec3};
use super::numbers::Numbers;

/// How a joint moves.
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
    /// Along x with this sign.
    X(f64),
    /// Along y with this sign.
    Y(f64),
    /// Along z with this sign.
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
    /// Whether the actuator's gains act on the beginning of a physics step (as a motor controller at the step's rate
    /// would) instead of on its end.
    pub explicit: bool,
}

/// Effort limits over a joint position, linear in between, constant beyond the ends.
#[derive(Clone, Debug)]
pub struct EffortTable {
    /// Position of the first entry, rad.
    pub start: f32,
    /// One over the distance of two entries, 1/rad.
    pub inverse_step: f32,
    /// Limits, N m.
    pub limits: Vec<f32>,
}

impl EffortTable {
    /// The limit at a position, N m.
    #[inline(always)]
    pub(crate) fn limit_at(&self, position: f32) -> f32 {
        let last = self.limits.len() - 1;
        // a NaN becomes 0 in the cast
        let x = ((position - self.start) * self.inverse_step).clamp(0.0, last as f32);
        let i = (x as usize).min(last.saturating_sub(1));
        let (a, b) = (self.limits[i], self.limits[(i + 1).min(last)]);
        (b - a).mul_add(x - i as f32, a)
    }
}

/// Where a contact candidate sits on its link.
#[derive(Clone, Copy, Debug)]
pub enum ContactKind {
    /// A sphere (or, with radius 0, a corner) at a fixed place.
    Point,
    /// A point on the rim of a cylinder's end: the lowest one, turned by a fixed angle about the cylinder's axis.
    Rim {
        /// Two unit vectors across the axis, in link axes.
        across: [[f64; 3]; 2],
        /// Cosine and sine of the fixed angle.
        turn: [f64; 2],
    },
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
#[derive(Clone, Debug)]
pub struct PairTopology {
    /// Colliders: a capsule, then a capsule or a box.
    pub colliders: [usize; 2],
    /// Parts of the capsule's axis, whose ends are -1 and 1: each part is a contact of its own, so that links can lie
    /// against each other.
    pub spans: &'static [[f64; 2]],
    /// Contact bodies of the two.
    pub(super) bodies: [usize; 2],
    /// The first of its impulses.
    pub(super) first_impulse: usize,
    /// Which path holds the joints on the ways from both links to the base; and the side of each of its joints: 1 carries the
    /// first link only, -1 the second only, 0 both.
    pub(super) path: usize,
    pub(super) side: Vec<[f64; BLOCK]>,
}

/// The pairs between two links.
#[derive(Clone, Debug)]
pub(super) struct PairGroup {
    pub(super) links: [usize; 2],
    /// Where they stand in [`Topology::pairs`].
    pub(super) pairs: std::ops::Range<usize>,
}

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
    /// Pairs of them that are looked at.
    pub pairs: Vec<PairTopology>,
    /// The same by links.
    pub(super) pair_groups: Vec<PairGroup>,
    /// `link_colliders[link]`: its places in `colliders`.
    link_colliders: Vec<Vec<usize>>,
    /// Number of contact bodies.
    pub num_bodies: usize,
    /// Link of each site (a point whose position and velocity are reported, such as a foot).
    pub sites: Vec<usize>,
    /// Whether any actuator delays its target.
    pub has_delay: bool,
    blocks: Blocks,
    /// `paths[link]`: the joints that carry the link; after the links' the paths of the pairs.
    paths: Vec<Vec<PathPart>>,
    /// `link_contacts[link]`: its range in `contacts`.
    link_contacts: Vec<std::ops::Range<usize>>,
    pair_of_impulse: Vec<usize>,
}

impl Topology {
    /// Builds the derived tables.
    ///
    /// # Panics
    /// If a joint's parent is not an earlier link or contacts name links that do not exist; loaders guarantee both.
    pub fn new(
        floating: bool,
        joints: Vec<JointTopology>,
        mut contacts: Vec<ContactTopology>,
        num_bodies: usize,
        sites: Vec<usize>,
        has_delay: bool,
    ) -> Self {
        let blocks = Blocks::new(&joints);
        let paths: Vec<_> = (0..=joints.len()).map(|link| blocks.path(link)).collect();
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
            link_colliders: Vec::new(),
            num_bodies,
            sites,
            has_delay,
            blocks,
            paths,
            link_contacts,
            pair_of_impulse: Vec::new(),
        }
    }

    /// Lets pairs of `colliders` touch each other: a capsule and a capsule or box, and whether the first capsule is long
    /// enough to touch in two points. Those of the same two links should stand together: they are then looked at together.
    ///
    /// # Panics
    /// If indices name colliders or links that do not exist; loaders guarantee that they do.
    pub fn set_pairs(&mut self, colliders: Vec<ColliderTopology>, pairs: &[([usize; 2], bool)]) {
        let mut paths = self.paths[..self.num_links()].to_vec();
        let mut new: Vec<PairTopology> = Vec::new();
        let mut groups: Vec<PairGroup> = Vec::new();
        let mut pair_of_impulse = Vec::new();
        let links_of = |pair: [usize; 2]| pair.map(|c| colliders[c].link);
        for &(pair, long) in pairs {
            match groups.last_mut() {
                Some(group) if group.links == links_of(pair) => group.pairs.end += 1,
                _ => groups.push(PairGroup { links: links_of(pair), pairs: new.len()..new.len() + 1 }),
            }
            let [first, second] = links_of(pair).map(|link| self.path(link));
            let path = self.blocks.path_of_both(links_of(pair));
            let carries = |path: &[PathPart], block: usize, place: usize| {
                path.iter().any(|part| part.joints.block == block && place < part.joints.count)
            };
            let side_of = |part: &PathPart| {
                let block = part.joints.block;
                std::array::from_fn(|place| {
                    f64::from(i8::from(carries(first, block, place)) - i8::from(carries(second, block, place)))
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
                side: path.iter().map(side_of).collect(),
                path: paths.len(),
            });
            paths.push(path);
        }
        self.paths = paths;
        self.pairs = new;
        self.pair_groups = groups;
        self.pair_of_impulse = pair_of_impulse;
        self.link_colliders = vec![Vec::new(); self.num_links()];
        for (c, collider) in colliders.iter().enumerate() {
            self.link_colliders[collider.link].push(c);
        }
        self.colliders = colliders;
    }

    /// The colliders of a link, as places in [`colliders`](Self::colliders).
    #[inline(always)]
    pub(super) fn colliders_of(&self, link: usize) -> &[usize] {
        self.link_colliders.get(link).map_or(&[], |colliders| colliders)
    }

    /// Number of impulses that warm-start contacts: one per ground contact candidate, then those of the pairs.
    pub fn num_impulses(&self) -> usize {
        self.contacts.len() + self.pair_of_impulse.len()
    }

    /// The pair that an impulse belongs to; none for one of the ground's.
    #[inline(always)]
    pub(super) fn pair_of(&self, impulse: usize) -> Option<&PairTopology> {
        let i = impulse.checked_sub(self.contacts.len())?;
        Some(&self.pairs[self.pair_of_impulse[i]])
    }

    /// The most blocks that any contact acts on.
    pub(super) fn max_path(&self) -> usize {
        self.paths.iter().map(Vec::len).max().unwrap_or(0)
    }

    /// Number of joints.
    pub fn num_joints(&self) -> usize {
        self.joints.len()
    }

    /// Number of links, the base included.
    pub fn num_links(&self) -> usize {
        self.joints.len() + 1
    }

    /// The joints that carry a link, those of the nearest block first; with numbers from [`num_links`](Self::num_links) on those of
    /// the pairs.
    #[inline(always)]
    pub(super) fn path(&self, link: usize) -> &[PathPart] {
        &self.paths[link]
    }

    /// The joints in blocks, each after those that carry it.
    #[inline(always)]
    pub fn blocks(&self) -> &[Block] {
        &self.blocks.blocks
    }

    /// Number of couplings between blocks.
    pub(super) fn num_couplings(&self) -> usize {
        self.blocks.num_couplings
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

macro_rules! parameters {
    ($( $(#[$doc:meta])* $name:ident: $t:ty, $visit:ident; )*) => {
        /// The numbers of one body (`S = f32` or `f64`) or of a pack of bodies (`S` a lane type).
        ///
        /// Frames: every link's axes are parallel to the base's when all joints are at zero. Clones share what neither changes.
        #[derive(Clone, Debug, Serialize, Deserialize)]
        pub struct Parameters<S> {
            $( $(#[$doc])* pub $name: $t, )*
        }

        impl<S: Real> Parameters<S> {
            /// Calls `f` on every number together with its counterpart in `other`, which must have the same sizes.
            pub fn zip_with<T: Real>(&mut self, other: &Parameters<T>, mut f: impl FnMut(&mut S, &T)) {
                $( $visit::zip(&mut self.$name, &other.$name, &mut f); )*
            }

            /// Whether `f` says yes to any number together with its counterpart in `other`, which must have the same sizes; those
            /// after the first yes are not asked.
            pub fn any_with<T: Real>(&self, other: &Parameters<T>, mut f: impl FnMut(&S, &T) -> bool) -> bool {
                false $( || $visit::any(&self.$name, &other.$name, &mut f) )*
            }

            /// Writes one robot's numbers into a lane. Lists that hold them already stay shared.
            pub fn set_lane<T: Real>(&mut self, lane: usize, scalars: &Parameters<T>) {
                let mut differ = |x: &S, y: &T| x.lane(lane).to_bits() != y.lane(0).to_bits();
                $(
                    if $visit::any(&self.$name, &scalars.$name, &mut differ) {
                        $visit::zip(&mut self.$name, &scalars.$name, &mut |x, y| x.set_lane(lane, y.lane(0)));
                    }
                )*
            }

            /// Calls `f` with some of all numbers, and which of the `places` it is: these ascend and count in the order in which
            /// [`zip_with`](Self::zip_with) comes to the numbers.
            pub fn for_each_at(&mut self, places: &[u32], mut f: impl FnMut(usize, &mut S)) {
                let mut first = 0;
                let mut left = places.iter().enumerate().peekable();
                $(
                    let end = first + $visit::count(&self.$name) as u32;
                    while let Some((k, place)) = left.next_if(|&(_, &place)| place < end) {
                        if let Some(x) = $visit::number_mut(&mut self.$name, (place - first) as usize) {
                            f(k, x);
                        }
                    }
                    first = end;
                )*
                debug_assert!(left.next().is_none(), "there are {first} numbers");
            }

            /// Shares the memory of the lists that hold the same numbers in another body of the same sizes.
            pub fn share(&mut self, other: &Self) {
                let mut differ = |x: &S, y: &S| (0..S::LANES).any(|k| x.lane(k).to_bits() != y.lane(k).to_bits());
                $(
                    if !$visit::any(&self.$name, &other.$name, &mut differ) {
                        self.$name = other.$name.clone();
                    }
                )*
            }
        }
    };
}

/// Visits of a number.
mod one {
    pub(super) fn zip<S, T>(a: &mut S, b: &T, f: &mut impl FnMut(&mut S, &T)) {
        f(a, b);
    }
    pub(super) fn any<S, T>(a: &S, b: &T, f: &mut impl FnMut(&S, &T) -> bool) -> bool {
        f(a, b)
    }
    pub(super) fn count<S>(_: &S) -> usize {
        1
    }
    pub(super) fn number_mut<S>(a: &mut S, _: usize) -> Option<&mut S> {
        Some(a)
    }
}

/// Visits of a list of numbers.
mod list {
    pub(super) fn zip<S, T>(a: &mut [S], b: &[T], f: &mut impl FnMut(&mut S, &T)) {
        for (x, y) in a.iter_mut().zip(b) {
            f(x, y);
        }
    }
    pub(super) fn any<S, T>(a: &[S], b: &[T], f: &mut impl FnMut(&S, &T) -> bool) -> bool {
        a.iter().zip(b).any(|(x, y)| f(x, y))
    }
    pub(super) fn count<S>(a: &[S]) -> usize {
        a.len()
    }
    pub(super) fn number_mut<S>(a: &mut [S], index: usize) -> Option<&mut S> {
        a.get_mut(index)
    }
}

/// Visits of a list of vectors or matrices.
mod arrays {
    pub(super) fn zip<S, T, const N: usize>(a: &mut [[S; N]], b: &[[T; N]], f: &mut impl FnMut(&mut S, &T)) {
        super::list::zip(a.as_flattened_mut(), b.as_flattened(), f);
    }
    pub(super) fn any<S, T, const N: usize>(a: &[[S; N]], b: &[[T; N]], f: &mut impl FnMut(&S, &T) -> bool) -> bool {
        super::list::any(a.as_flattened(), b.as_flattened(), f)
    }
    pub(super) fn count<S, const N: usize>(a: &[[S; N]]) -> usize {
        a.as_flattened().len()
    }
    pub(super) fn number_mut<S, const N: usize>(a: &mut [[S; N]], index: usize) -> Option<&mut S> {
        a.as_flattened_mut().get_mut(index)
    }
}

parameters! {
    /// Joint origin in the parent link's frame, m, `[joints]`.
    joint_offset: Numbers<Vec3<S>>, arrays;
    /// Link masses, kg, `[links]`.
    mass: Numbers<S>, list;
    /// Link centres of mass in the link frame, m, `[links]`.
    com: Numbers<Vec3<S>>, arrays;
    /// Link inertias about the centre of mass in link axes, kg m^2, `[links]`.
    inertia: Numbers<Sym3<S>>, arrays;
    /// Actuator stiffness, N m/rad, `[joints]`.
    stiffness: Numbers<S>, list;
    /// Actuator damping, N m s/rad, `[joints]`.
    damping: Numbers<S>, list;
    /// Largest actuator effort, N m, `[joints]`; multiplies the effort table where there is one.
    effort_limit: Numbers<S>, list;
    /// Stall effort of a DC motor, N m, `[joints]`.
    saturation_effort: Numbers<S>, list;
    /// No-load speed of a DC motor, rad/s, `[joints]`.
    motor_velocity_limit: Numbers<S>, list;
    /// Reflected rotor inertia, kg m^2, `[joints]`.
    armature: Numbers<S>, list;
    /// Passive viscous damping, N m s/rad, `[joints]`.
    joint_damping: Numbers<S>, list;
    /// Coulomb friction, N m, `[joints]`.
    joint_friction: Numbers<S>, list;
    /// Lower position limit, rad, `[joints]`.
    lower: Numbers<S>, list;
    /// Upper position limit, rad, `[joints]`.
    upper: Numbers<S>, list;
    /// Largest joint speed, rad/s, `[joints]`.
    velocity_limit: Numbers<S>, list;
    /// Centre of a contact candidate in its link's frame, m, `[contacts]`.
    contact_position: Numbers<Vec3<S>>, arrays;
    /// Sphere radius of a contact candidate, m, `[contacts]`.
    contact_radius: Numbers<S>, list;
    /// Rim radius of a contact candidate, m, `[contacts]`.
    contact_rim: Numbers<S>, list;
    /// The box along a link's axes that holds all its contact candidates and colliders: its centre in the link's frame, then half edge
    /// lengths, m, `[links]`. One list, since a list costs every env 16 bytes.
    link_box: Numbers<[S; 6]>, arrays;
    /// Centre of a collider in its link's frame, m, `[colliders]`.
    collider_centre: Numbers<Vec3<S>>, arrays;
    /// From a capsule's centre to the end of its axis in link axes, or half edge lengths of a box, m, `[colliders]`.
    collider_half: Numbers<Vec3<S>>, arrays;
    /// Radius of a capsule, m, `[colliders]`.
    collider_radius: Numbers<S>, list;
    /// Position of a site in its link's frame, m, `[sites]`.
    site_position: Numbers<Vec3<S>>, arrays;
    /// Friction coefficient of sticking contacts (robot and ground combined).
    static_friction: S, one;
    /// Friction coefficient of sliding contacts (robot and ground combined).
    dynamic_friction: S, one;
    /// Restitution coefficient (robot and ground combined).
    restitution: S, one;
}

impl<S: Real> Parameters<S> {
    /// All numbers zero, with the sizes of a topology.
    pub fn zeros(topology: &Topology) -> Self {
        let (joints, links) = (topology.num_joints(), topology.num_links());
        let (contacts, sites) = (topology.contacts.len(), topology.sites.len());
        let z = S::zero();
        Self {
            joint_offset: vec![[z; 3]; joints].into(),
            mass: vec![z; links].into(),
            com: vec![[z; 3]; links].into(),
            inertia: vec![[z; 6]; links].into(),
            stiffness: vec![z; joints].into(),
            damping: vec![z; joints].into(),
            effort_limit: vec![z; joints].into(),
            saturation_effort: vec![z; joints].into(),
            motor_velocity_limit: vec![z; joints].into(),
            armature: vec![z; joints].into(),
            joint_damping: vec![z; joints].into(),
            joint_friction: vec![z; joints].into(),
            lower: vec![z; joints].into(),
            upper: vec![z; joints].into(),
            velocity_limit: vec![z; joints].into(),
            contact_position: vec![[z; 3]; contacts].into(),
            contact_radius: vec![z; contacts].into(),
            contact_rim: vec![z; contacts].into(),
            link_box: vec![[z; 6]; links].into(),
            collider_centre: vec![[z; 3]; topology.colliders.len()].into(),
            collider_half: vec![[z; 3]; topology.colliders.len()].into(),
            collider_radius: vec![z; topology.colliders.len()].into(),
            site_position: vec![[z; 3]; sites].into(),
            static_friction: z,
            dynamic_friction: z,
            restitution: z,
        }
    }

    /// The same numbers in another precision, in every lane.
    pub fn from_scalars<T: Real>(topology: &Topology, scalars: &Parameters<T>) -> Self {
        let mut new = Self::zeros(topology);
        new.zip_with(scalars, |x, y| *x = S::splat(y.lane(0)));
        new
    }

    /// Total mass, kg.
    pub fn total_mass(&self) -> S {
        self.mass.iter().fold(S::zero(), |a, &m| a + m)
    }
}

impl Parameters<f64> {
    /// Fits the boxes that hold the links' contact candidates and colliders to these.
    pub fn box_links(&mut self, topology: &Topology) {
        for link in 0..topology.num_links() {
            let (mut lower, mut upper) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
            let mut hold = |axis: usize, at: f64, reach: f64| {
                (lower[axis], upper[axis]) = (lower[axis].min(at - reach), upper[axis].max(at + reach));
            };
            for contact in topology.contacts_of(link) {
                for axis in 0..3 {
                    let rim = match topology.contacts[contact].kind {
                        ContactKind::Point => 0.0,
                        ContactKind::Rim { across: [a, b], .. } => a[axis].hypot(b[axis]),
                    };
                    let reach = rim.mul_add(self.contact_rim[contact], self.contact_radius[contact]);
                    hold(axis, self.contact_position[contact][axis], reach);
                }
            }
            for &c in topology.colliders_of(link) {
                let half = self.collider_half[c];
                for axis in 0..3 {
                    let reach = match &topology.colliders[c].box_rotation {
                        Some(rows) => (0..3).map(|k| rows[axis][k].abs() * half[k]).sum(),
                        None => half[axis].abs() + self.collider_radius[c],
                    };
                    hold(axis, self.collider_centre[c][axis], reach);
                }
            }
            self.link_box[link] = [0.0; 6];
            // a link without any has an empty one at its origin
            for axis in (0..3).filter(|&axis| lower[axis] <= upper[axis]) {
                self.link_box[link][axis] = 0.5 * (upper[axis] + lower[axis]);
                self.link_box[link][3 + axis] = 0.5 * (upper[axis] - lower[axis]);
            }
        }
    }
}
