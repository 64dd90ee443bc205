//! The numbers of bodies: [`Parameters`], of one or of all in a pack, and how kernels read them,
//! [`BodyNumbers`].

use serde::{Deserialize, Serialize};

use super::articulation::{ContactKind, Topology};
use super::lanes::Real;
use super::math::{Sym3, Vec3};
use super::shared_array::SharedArray;

macro_rules! parameters {
    (
        lists { $( $(#[$doc:meta])* $name:ident: $t:ty, $visit:ident, $own:expr; )* }
        numbers { $( $(#[$one_doc:meta])* $one:ident; )* }
    ) => {
        /// The numbers of one body (`S = f32` or `f64`) or of a pack of bodies (`S` a lane type).
        ///
        /// Frames: every link's axes are parallel to the base's when all joints are at zero. Clones
        /// share what neither changes.
        #[derive(Clone, Debug, Serialize, Deserialize)]
        pub struct Parameters<S> {
            $( $(#[$doc])* pub $name: SharedArray<$t>, )*
            $( $(#[$one_doc])* pub $one: S, )*
        }

        /// The numbers of the bodies in a pack as kernels read them.
        #[allow(dead_code, reason = "the solver reads the friction of contacts as `own` has it")]
        pub trait BodyNumbers<S: Real>: Copy {
            /// Numbers of each body: coefficients of friction and restitution, and where bodies are
            /// uniform also their common numbers, once per lane.
            fn own<'a>(self) -> &'a Parameters<S>
            where
                Self: 'a;
            $(
                /// See [`Parameters`].
                fn $name(self, i: usize) -> $t;
            )*
        }

        impl<S: Real> BodyNumbers<S> for &Parameters<S> {
            #[inline(always)]
            fn own<'a>(self) -> &'a Parameters<S>
            where
                Self: 'a,
            {
                self
            }
            $(
                #[inline(always)]
                fn $name(self, i: usize) -> $t {
                    self.$name[i]
                }
            )*
        }

        impl<S: Real> BodyNumbers<S> for UniformParameters<'_, S> {
            #[inline(always)]
            fn own<'a>(self) -> &'a Parameters<S>
            where
                Self: 'a,
            {
                self.own
            }
            $(
                #[inline(always)]
                fn $name(self, i: usize) -> $t {
                    if i < $own { self.own.$name[i] } else { $visit::splat(&self.shared.$name[i]) }
                }
            )*
        }

        impl<S: Real> Parameters<S> {
            /// Calls `f` on every number together with its counterpart in `other`, which must have
            /// the same sizes.
            pub fn zip_with<T: Real>(&mut self, other: &Parameters<T>, mut f: impl FnMut(&mut S, &T)) {
                $( $visit::zip(&mut self.$name, &other.$name, &mut f); )*
                $( f(&mut self.$one, &other.$one); )*
            }

            /// Whether `f` says yes to any number together with its counterpart in `other`, which
            /// must have the same sizes; those after the first yes are not asked.
            pub fn any_with<T: Real>(&self, other: &Parameters<T>, mut f: impl FnMut(&S, &T) -> bool) -> bool {
                false $( || $visit::any(&self.$name, &other.$name, &mut f) )* $( || f(&self.$one, &other.$one) )*
            }

            /// Whether all lists are as long as those of `other`.
            pub fn has_sizes_of<T>(&self, other: &Parameters<T>) -> bool {
                true $( && self.$name.len() == other.$name.len() )*
            }

            /// Whether the first lane differs from the morphology's body only in numbers that
            /// [`UniformParameters`] keep per env.
            pub fn is_uniform_with<T: Real>(&self, nominal: &Parameters<T>) -> bool {
                let mut differ = |x: &S, y: &T| x.lane_f32(0).to_bits() != y.lane_f32(0).to_bits();
                true $( && !$visit::any(&self.$name[$own..], &nominal.$name[$own..], &mut differ) )*
            }

            /// Writes one robot's numbers into a lane. Lists that hold them already stay shared.
            pub fn set_lane<T: Real>(&mut self, lane: usize, scalars: &Parameters<T>) {
                let mut differ = |x: &S, y: &T| x.lane(lane).to_bits() != y.lane(0).to_bits();
                $(
                    if $visit::any(&self.$name, &scalars.$name, &mut differ) {
                        $visit::zip(&mut self.$name, &scalars.$name, &mut |x, y| x.set_lane(lane, y.lane(0)));
                    }
                )*
                $( self.$one.set_lane(lane, scalars.$one.lane(0)); )*
            }

            /// Calls `f` with some of all numbers, and which of the `places` it is: these ascend
            /// and count in the order in which [`zip_with`](Self::zip_with) comes to the numbers.
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
                $(
                    if let Some((k, _)) = left.next_if(|&(_, &place)| place == first) {
                        f(k, &mut self.$one);
                    }
                    first += 1;
                )*
                debug_assert!(left.next().is_none(), "there are {first} numbers");
            }

            /// Shares the memory of the lists that hold the same numbers in another body of the
            /// same sizes.
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

/// Bodies of a pack that differ only in their bases' mass properties and their surfaces. The
/// numbers that they have in common are held once, not once per lane.
#[derive(Clone, Copy, Debug)]
pub(super) struct UniformParameters<'a, S> {
    /// Parameters of the morphology, which the bodies share.
    pub(super) shared: &'a Parameters<f32>,
    /// Parameters that differ between bodies; the rest is not read.
    pub(super) own: &'a Parameters<S>,
}

/// Number of entries of per-link lists in which [`UniformParameters`] bodies differ: the base's,
/// the first.
const BASE: usize = 1;
/// Number of entries of other lists in which these bodies differ.
const NONE: usize = 0;

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
    #[inline(always)]
    pub(super) fn splat<S: super::Real>(x: &f32) -> S {
        S::splat(f64::from(*x))
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
    #[inline(always)]
    pub(super) fn splat<S: super::Real, const N: usize>(x: &[f32; N]) -> [S; N] {
        // a closure would lose the instruction set
        let mut out = [S::zero(); N];
        for (y, &x) in out.iter_mut().zip(x) {
            *y = S::splat(f64::from(x));
        }
        out
    }
}

parameters! {
    lists {
        /// Joint origin in the parent link's frame, m, `[joints]`.
        joint_offset: Vec3<S>, arrays, NONE;
        /// Link masses, kg, `[links]`.
        mass: S, list, BASE;
        /// Link centres of mass in the link frame, m, `[links]`.
        com: Vec3<S>, arrays, BASE;
        /// Link inertias about the centre of mass in link axes, kg m^2, `[links]`.
        inertia: Sym3<S>, arrays, BASE;
        /// Actuator stiffness, N m/rad, `[joints]`.
        stiffness: S, list, NONE;
        /// Actuator damping, N m s/rad, `[joints]`.
        damping: S, list, NONE;
        /// Largest actuator effort, N m, `[joints]`; multiplies the effort table where there is
        /// one.
        effort_limit: S, list, NONE;
        /// Stall effort of a DC motor, N m, `[joints]`.
        saturation_effort: S, list, NONE;
        /// No-load speed of a DC motor, rad/s, `[joints]`.
        motor_velocity_limit: S, list, NONE;
        /// Reflected rotor inertia, kg m^2, `[joints]`.
        armature: S, list, NONE;
        /// Passive viscous damping, N m s/rad, `[joints]`.
        joint_damping: S, list, NONE;
        /// Coulomb friction, N m, `[joints]`.
        joint_friction: S, list, NONE;
        /// Stiffness, N m/rad, and position at rest, rad, of a joint's passive spring, `[joints]`;
        /// empty without [`has_springs`](Topology::has_springs).
        spring: [S; 2], arrays, NONE;
        /// Lower position limit, rad, `[joints]`.
        lower: S, list, NONE;
        /// Upper position limit, rad, `[joints]`.
        upper: S, list, NONE;
        /// Largest joint speed, rad/s, `[joints]`.
        velocity_limit: S, list, NONE;
        /// Centre of a contact candidate in its link's frame, m, `[contacts]`.
        contact_position: Vec3<S>, arrays, NONE;
        /// Sphere radius of a contact candidate, m, `[contacts]`.
        contact_radius: S, list, NONE;
        /// Rim radius of a contact candidate, m, `[contacts]`.
        contact_rim: S, list, NONE;
        /// Surface of a contact candidate on the ground: the factor on the coefficients of sliding
        /// friction, and the least coefficients of torsional and rolling friction, m, `[contacts]`;
        /// empty without [`has_surfaces`](Topology::has_surfaces).
        contact_friction: Vec3<S>, arrays, NONE;
        /// The box along a link's axes that holds all its contact candidates and colliders: its
        /// centre in the link's frame, then half edge lengths, m, `[links]`. One list, since a list
        /// costs every env 16 bytes.
        link_box: [S; 6], arrays, NONE;
        /// Centre of a collider in its link's frame, m, `[colliders]`.
        collider_centre: Vec3<S>, arrays, NONE;
        /// Way from a capsule's centre to the end of its axis in link axes, or half edge lengths
        /// of a box, m, `[colliders]`.
        collider_half: Vec3<S>, arrays, NONE;
        /// Radius of a capsule, m, `[colliders]`.
        collider_radius: S, list, NONE;
        /// Position of a site in its link's frame, m, `[sites]`.
        site_position: Vec3<S>, arrays, NONE;
    }
    numbers {
        /// Friction coefficient of sticking contacts (robot and ground combined).
        static_friction;
        /// Friction coefficient of sliding contacts (robot and ground combined).
        dynamic_friction;
        /// Restitution coefficient (robot and ground combined).
        restitution;
        /// Coefficient of torsional friction (robot and ground combined), m; read where the
        /// topology's friction asks for it.
        torsional_friction;
        /// Coefficient of rolling friction (robot and ground combined), m; read where the
        /// topology's friction asks for it.
        rolling_friction;
    }
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
            spring: vec![[z; 2]; if topology.has_springs { joints } else { 0 }].into(),
            lower: vec![z; joints].into(),
            upper: vec![z; joints].into(),
            velocity_limit: vec![z; joints].into(),
            contact_position: vec![[z; 3]; contacts].into(),
            contact_radius: vec![z; contacts].into(),
            contact_rim: vec![z; contacts].into(),
            contact_friction: vec![[z; 3]; if topology.has_surfaces { contacts } else { 0 }].into(),
            link_box: vec![[z; 6]; links].into(),
            collider_centre: vec![[z; 3]; topology.colliders.len()].into(),
            collider_half: vec![[z; 3]; topology.colliders.len()].into(),
            collider_radius: vec![z; topology.colliders.len()].into(),
            site_position: vec![[z; 3]; sites].into(),
            static_friction: z,
            dynamic_friction: z,
            restitution: z,
            torsional_friction: z,
            rolling_friction: z,
        }
    }

    /// Copies numbers of another precision into every lane.
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
