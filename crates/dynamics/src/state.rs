//! The moving numbers of a pack, and the scratch memory of a step.

use super::articulation::Topology;
use super::blocks::BLOCK;
use super::factor::Factor;
use super::lanes::Real;
use super::math::{Mat3, Spatial, SpatialInertia, Vec3};
use super::rows::ContactWork;
use super::self_contact::{ColliderBox, PlacedCollider};

/// The state of one body or of a pack of bodies, and what one control step reports of it.
#[derive(Clone, Debug)]
pub struct State<S> {
    /// Base position in the env's frame, m.
    pub position: Vec3<S>,
    /// Base orientation (w, x, y, z).
    pub rotation: [S; 4],
    /// Velocity of the base origin in world axes, m/s.
    pub linear_velocity: Vec3<S>,
    /// Angular velocity of the base in base axes, rad/s.
    pub angular_velocity: Vec3<S>,
    /// Joint positions, rad, `[joints]`.
    pub joint_position: Vec<S>,
    /// Joint velocities, rad/s, `[joints]`.
    pub joint_velocity: Vec<S>,
    /// Contact impulses of the last physics step (along the contact's normal and two tangents), N
    /// s, `[contacts, then pairs]`, then with torsional or rolling friction the angular ones about
    /// these axes, N m s, `[contacts]`; they warm-start the next one.
    pub impulse: Vec<[S; 3]>,
    /// Contacts whose impulse is not zero in some lane: those of all others must be zero.
    pub pressing: Vec<u32>,
    /// Impulses of the joints' limits and dry friction in the last physics step, N m s, `[joints]`;
    /// they warm-start the next one.
    pub bound_impulse: Vec<S>,
}

/// Targets of the actuators during one control step.
#[derive(Clone, Debug)]
pub struct Drive<S> {
    /// Position targets, rad: `targets[age][joint]`, age in control steps, 0 the present one.
    pub targets: Vec<Vec<S>>,
    /// Delay of the targets in physics steps, `[joints]`.
    pub delay: Vec<S>,
    /// Effort on top of what the targets ask for, before the actuators' limits, N m, `[joints]`.
    pub feedforward: Vec<S>,
    /// Force on the base at its centre of mass, base axes, N.
    pub base_force: Vec3<S>,
    /// Torque on the base, base axes, N m.
    pub base_torque: Vec3<S>,
    /// Forces on links from outside, in rising order of [`LinkForce::key`]; usually empty.
    pub link_forces: Vec<LinkForce<S>>,
}

/// A force and a torque on a link from outside, held for the control step.
#[derive(Clone, Debug)]
pub struct LinkForce<S> {
    /// Number of the link.
    pub link: usize,
    /// Whether force and torque keep their directions in the world; else they turn with the link.
    pub in_world: bool,
    /// One where it acts, zero in the other lanes.
    pub acts: S,
    /// Point of the link at which the force acts, link axes, m.
    pub point: Vec3<S>,
    /// Force, N.
    pub force: Vec3<S>,
    /// Torque, N m.
    pub torque: Vec3<S>,
}

impl<S: Real> LinkForce<S> {
    /// No force in any lane.
    pub fn zero((link, in_world): (usize, bool)) -> Self {
        let z = S::zero();
        Self { link, in_world, acts: z, point: [z; 3], force: [z; 3], torque: [z; 3] }
    }

    /// Link and frame, which the lanes of a pack share. Forces are added in the order of their
    /// keys, so that no lane's sum depends on its neighbours.
    pub fn key(&self) -> (usize, bool) {
        (self.link, self.in_world)
    }
}

impl<S: Real> Drive<S> {
    /// The force with a [`key`](LinkForce::key), which is made if no lane has one yet.
    pub fn link_force_mut(&mut self, key: (usize, bool)) -> &mut LinkForce<S> {
        let place = self.link_forces.partition_point(|force| force.key() < key);
        if self.link_forces.get(place).is_none_or(|force| force.key() != key) {
            self.link_forces.insert(place, LinkForce::zero(key));
        }
        &mut self.link_forces[place]
    }
}

impl<S: Real> State<S> {
    /// State at rest at the origin, all joints at zero.
    pub fn zeros(topology: &Topology) -> Self {
        let z = S::zero();
        Self {
            position: [z; 3],
            rotation: [S::one(), z, z, z],
            linear_velocity: [z; 3],
            angular_velocity: [z; 3],
            joint_position: vec![z; topology.num_joints()],
            joint_velocity: vec![z; topology.num_joints()],
            impulse: vec![[z; 3]; topology.num_impulses()],
            pressing: Vec::new(),
            bound_impulse: vec![z; topology.num_joints()],
        }
    }
}

impl<S: Real> State<S> {
    /// Finds out which impulses are [`pressing`](Self::pressing), after they were set from outside.
    pub fn find_pressing(&mut self) {
        let presses = |impulse: &[S; 3]| (0..S::LANES).any(|lane| impulse.iter().any(|x| x.lane(lane) != 0.0));
        let contacts = self.impulse.iter().enumerate().filter(|(_, impulse)| presses(impulse));
        self.pressing = contacts.map(|(contact, _)| contact as u32).collect();
    }
}

impl<S: Real> Drive<S> {
    /// Targets, feed-forward and wrench zero, no delay, `ages` control steps remembered.
    pub fn zeros(topology: &Topology, ages: usize) -> Self {
        let joints = topology.num_joints();
        let zeros = vec![S::zero(); joints];
        Self {
            targets: vec![zeros.clone(); ages],
            delay: zeros.clone(),
            feedforward: zeros,
            base_force: [S::zero(); 3],
            base_torque: [S::zero(); 3],
            link_forces: Vec::new(),
        }
    }
}

/// Pose and velocity of a link, in base axes about the base origin.
#[derive(Clone, Debug)]
pub struct LinkState<S> {
    /// Link axes in base axes.
    pub rotation: Mat3<S>,
    /// Link origin, m.
    pub position: Vec3<S>,
    /// Spatial velocity.
    pub velocity: Spatial<S>,
    /// Spatial velocity that it would have after the step without constraints, relative to the
    /// base.
    pub free_velocity: Spatial<S>,
    /// Motion axis of the joint that moves it.
    pub axis: Spatial<S>,
}

/// Forces that the motion of a link needs, in base axes about the base origin.
#[derive(Clone, Debug)]
pub(super) struct LinkDynamics<S> {
    /// Velocity-product acceleration.
    pub(super) acceleration: Spatial<S>,
    /// Spatial inertia, then that of all it carries.
    pub(super) inertia: SpatialInertia<S>,
    /// Force, then forces summed towards the base.
    pub(super) force: Spatial<S>,
}

/// Scratch memory of one worker; its contents mean nothing between steps.
#[derive(Clone, Debug)]
pub struct Workspace<S: Real> {
    /// Base axes in world axes.
    pub(super) base_rotation: Mat3<S>,
    /// Poses and velocities of the links in base axes, `[links]`.
    pub links: Vec<LinkState<S>>,
    /// Links of the base and of one tree that it carries; the next tree takes the place of the
    /// last, `[slots]`.
    pub(super) dynamics: Vec<LinkDynamics<S>>,
    /// Generalised bias force: base (6, base axes) and joints.
    pub(super) bias_base: [S; 6],
    /// See `bias_base`.
    pub(super) bias_joint: Vec<S>,
    /// The factorised mass matrix.
    pub factor: Factor<S>,
    /// Base velocity in base axes: angular, linear.
    pub(super) velocity_base: [S; 6],
    /// Right-hand sides and solutions, `[blocks]`.
    pub(super) rhs_joint: Vec<[S; BLOCK]>,
    /// Actuator effort before the implicit correction, N m.
    pub(super) effort: Vec<S>,
    /// Loss of the actuator per unit of velocity change; zero when saturated.
    pub(super) effort_slope: Vec<S>,
    /// Target position of each joint in the current physics step.
    pub(super) target: Vec<S>,
    /// Places of the colliders.
    pub(super) colliders: Vec<PlacedCollider<S>>,
    /// Boxes around all colliders of a link, `[links]`; without meaning for a link without
    /// colliders.
    pub(super) collider_boxes: Vec<ColliderBox<S>>,
    /// Rows of active contacts and joint bounds.
    pub(super) contact: ContactWork<S>,
}

impl<S: Real> Workspace<S> {
    /// Memory for a topology.
    pub fn new(topology: &Topology) -> Self {
        let z = S::zero();
        let (joints, links) = (topology.num_joints(), topology.num_links());
        let identity = std::array::from_fn(|i| std::array::from_fn(|j| if i == j { S::one() } else { z }));
        let link = LinkState {
            rotation: identity,
            position: [z; 3],
            velocity: Spatial::zero(),
            free_velocity: Spatial::zero(),
            axis: Spatial::zero(),
        };
        let still =
            LinkDynamics { acceleration: Spatial::zero(), inertia: SpatialInertia::zero(), force: Spatial::zero() };
        Self {
            base_rotation: identity,
            links: vec![link; links],
            dynamics: vec![still; topology.num_slots()],
            bias_base: [z; 6],
            bias_joint: vec![z; joints],
            factor: Factor::new(topology),
            velocity_base: [z; 6],
            rhs_joint: vec![[z; BLOCK]; topology.blocks().len()],
            effort: vec![z; joints],
            effort_slope: vec![z; joints],
            target: vec![z; joints],
            colliders: vec![PlacedCollider::zero(); topology.colliders.len()],
            collider_boxes: vec![ColliderBox::zero(); links],
            contact: ContactWork::new(topology),
        }
    }
}
