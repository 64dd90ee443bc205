//! Forward kinematics, composite inertias and bias forces, all in base axes about the base origin.

use super::articulation::{Axis, JointMotion, Topology};
use super::blocks::BLOCK;
use super::lanes::Real;
use super::math::{
    Mat3, Spatial, SpatialInertia, Sym3, Vec3, add, add_scaled, cross, cross_add, mul_sym, mul_vec, rotate_sym, scale,
    splat,
};
use super::parameters::BodyNumbers;
use super::state::{LinkDynamics, LinkState, Workspace};

/// Rotation matrix `r` followed by a turn of `angle` about one of its axes, and that axis in the
/// outer frame.
#[inline(always)]
fn turned<S: Real>(r: &Mat3<S>, axis: Axis, angle: S) -> (Mat3<S>, Vec3<S>) {
    // a turn about a coordinate axis mixes the two other columns
    #[inline(always)]
    fn about<S: Real, const A: usize, const B: usize, const C: usize>(
        r: &Mat3<S>,
        sign: f64,
        angle: S,
    ) -> (Mat3<S>, Vec3<S>) {
        let (s, c) = angle.sin_cos();
        let s = s * S::splat(sign);
        let mut out = *r;
        for i in 0..3 {
            out[i][B] = c.mul_add(r[i][B], s * r[i][C]);
            out[i][C] = c.mul_add(r[i][C], -(s * r[i][B]));
        }
        let sign = S::splat(sign);
        (out, [r[0][A] * sign, r[1][A] * sign, r[2][A] * sign])
    }
    match axis {
        Axis::X(sign) => about::<S, 0, 1, 2>(r, sign, angle),
        Axis::Y(sign) => about::<S, 1, 2, 0>(r, sign, angle),
        Axis::Z(sign) => about::<S, 2, 0, 1>(r, sign, angle),
        Axis::General(u) => {
            let (s, c) = angle.sin_cos();
            let u: Vec3<S> = splat(&u);
            let versine = S::one() - c;
            let (vx, vy, vz) = (u[0] * versine, u[1] * versine, u[2] * versine);
            let (sx, sy, sz) = (u[0] * s, u[1] * s, u[2] * s);
            // Rodrigues' formula
            let turn = [
                [vx.mul_add(u[0], c), vx.mul_add(u[1], -sz), vx.mul_add(u[2], sy)],
                [vy.mul_add(u[0], sz), vy.mul_add(u[1], c), vy.mul_add(u[2], -sx)],
                [vz.mul_add(u[0], -sy), vz.mul_add(u[1], sx), vz.mul_add(u[2], c)],
            ];
            let mut out = *r;
            for i in 0..3 {
                for j in 0..3 {
                    out[i][j] = r[i][0].mul_add(turn[0][j], r[i][1].mul_add(turn[1][j], r[i][2] * turn[2][j]));
                }
            }
            (out, mul_vec(r, &u))
        }
    }
}

/// Sets the links' free velocities to those that joint velocities, `[blocks]`, give them against
/// the base.
#[inline(always)]
pub(super) fn free_links<S: Real>(topology: &Topology, velocity: &[[S; BLOCK]], links: &mut [LinkState<S>]) {
    links[0].free_velocity = Spatial::zero();
    for (block, velocity) in topology.blocks().iter().zip(velocity) {
        for place in 0..block.len {
            let j = block.joints[place];
            let (before, rest) = links.split_at_mut(j + 1);
            let (parent, link) = (&before[topology.joints[j].parent], &mut rest[0]);
            link.free_velocity = parent.free_velocity.plus_scaled(&link.axis, velocity[place]);
        }
    }
}

/// The axis of a joint that does not turn, in the outer frame.
#[inline(always)]
fn direction<S: Real>(r: &Mat3<S>, axis: Axis) -> Vec3<S> {
    mul_vec(r, &splat(&axis.direction()))
}

/// Positions, axes and velocities of all links.
///
/// `base_velocity` is in base axes about the base origin. `position` and `velocity` are the
/// joints'.
#[inline(always)]
pub fn forward_kinematics<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    position: &[S],
    velocity: &[S],
    base_velocity: &Spatial<S>,
    work: &mut Workspace<S>,
) {
    let links = &mut work.links[..];
    place_base(base_velocity, &mut links[0]);
    for j in 0..topology.num_joints() {
        place_link(topology, parameters, j, position[j], velocity[j], links);
    }
}

/// Position and velocity of the base.
#[inline(always)]
fn place_base<S: Real>(velocity: &Spatial<S>, base: &mut LinkState<S>) {
    let (z, one) = (S::zero(), S::one());
    base.rotation = [[one, z, z], [z, one, z], [z, z, one]];
    base.position = [z; 3];
    base.velocity = *velocity;
}

/// Position, axis and velocity of the link that a joint moves, after those of its parent.
#[inline(always)]
fn place_link<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    j: usize,
    position: S,
    velocity: S,
    links: &mut [LinkState<S>],
) {
    let joint = &topology.joints[j];
    // parents come before
    let (before, rest) = links.split_at_mut(j + 1);
    let (parent, link) = (&before[joint.parent], &mut rest[0]);
    let offset = &parameters.joint_offset(j);
    link.position = if joint.parent == 0 { *offset } else { add(&parent.position, &mul_vec(&parent.rotation, offset)) };
    match joint.motion {
        JointMotion::Revolute => {
            let (rotation, axis) = turned(&parent.rotation, joint.axis, position);
            link.rotation = rotation;
            link.axis = Spatial { ang: axis, lin: cross(&link.position, &axis) };
        }
        JointMotion::Prismatic => {
            let axis = direction(&parent.rotation, joint.axis);
            link.position = add_scaled(&link.position, &axis, position);
            link.rotation = parent.rotation;
            link.axis = Spatial { ang: [S::zero(); 3], lin: axis };
        }
    }
    link.velocity = parent.velocity.plus_scaled(&link.axis, velocity);
}

/// Centre of mass of a link and inertia about it.
#[inline(always)]
fn about_com<S: Real, B: BodyNumbers<S>>(parameters: B, link: usize, at: &LinkState<S>) -> (Vec3<S>, Sym3<S>) {
    let com = add(&at.position, &mul_vec(&at.rotation, &parameters.com(link)));
    (com, rotate_sym(&at.rotation, &parameters.inertia(link)))
}

/// Spatial inertia of a link where it is.
pub fn link_inertia<S: Real, B: BodyNumbers<S>>(parameters: B, link: usize, at: &LinkState<S>) -> SpatialInertia<S> {
    let (com, inertia) = about_com(parameters, link, at);
    SpatialInertia::new(parameters.mass(link), &com, &inertia)
}

/// The force that a link's motion and gravity ask for, by Newton's and Euler's equations about its
/// centre of mass `com`.
#[inline(always)]
fn link_force<S: Real>(
    mass: S,
    com: &Vec3<S>,
    inertia: &Sym3<S>,
    velocity: &Spatial<S>,
    acceleration: &Spatial<S>,
) -> Spatial<S> {
    let (w, turning) = (&velocity.ang, &acceleration.ang);
    let of_com = cross_add(w, com, &velocity.lin);
    let lin = scale(&cross_add(w, &of_com, &cross_add(turning, com, &acceleration.lin)), mass);
    let torque = cross_add(w, &mul_sym(inertia, w), &mul_sym(inertia, turning));
    Spatial { ang: cross_add(com, &lin, &torque), lin }
}

/// Positions, axes and velocities of all links, bias forces and the mass matrix: tree after tree,
/// each from the base to the leaves and back, so that what a leg needs is at hand.
///
/// Bias forces are what the present motion asks for at zero acceleration, by the recursive
/// Newton-Euler algorithm (Featherstone, Rigid Body Dynamics Algorithms, 2008, table 5.1); into
/// `bias_base` and `bias_joint`. The mass matrix is that of the composite-rigid-body algorithm
/// (table 6.2), with `armature` on the joints' diagonal; into the factor. The base's inertia is
/// composite afterwards: that of the whole robot.
///
/// The base's acceleration is the classical one of its origin in inertial axes. This makes the
/// result independent of the base's linear velocity (Galilean invariance), which link velocities
/// therefore leave out: of the base's motion they have the `turning` alone. `gravity` is in base
/// axes, `position` and `velocity` are the joints'.
#[inline(always)]
pub fn equations_of_motion<S: Real, B: BodyNumbers<S>>(
    topology: &Topology,
    parameters: B,
    position: &[S],
    velocity: &[S],
    turning: &Vec3<S>,
    gravity: &Vec3<S>,
    work: &mut Workspace<S>,
) {
    let Workspace { links, dynamics, bias_base, bias_joint, factor, .. } = work;
    let (links, dynamics) = (&mut links[..], &mut dynamics[..]);
    let base = &mut links[0];
    place_base(&Spatial { ang: *turning, lin: [S::zero(); 3] }, base);
    let falling = Spatial { ang: [S::zero(); 3], lin: scale(gravity, -S::one()) };
    let (mass, com, about) = (parameters.mass(0), &parameters.com(0), &parameters.inertia(0));
    dynamics[0] = LinkDynamics {
        acceleration: falling,
        inertia: SpatialInertia::new(mass, com, about),
        force: link_force(mass, com, about, &base.velocity, &falling),
    };
    for tree in topology.trees().rev() {
        for &b in tree {
            let block = &topology.blocks()[b];
            for place in 0..block.len {
                let j = block.joints[place];
                place_link(topology, parameters, j, position[j], velocity[j], links);
            }
            for place in 0..block.len {
                let j = block.joints[place];
                let (before, rest) = dynamics.split_at_mut(topology.slot(j + 1));
                let (parent, own, link) =
                    (&before[topology.slot(topology.joints[j].parent)], &mut rest[0], &links[j + 1]);
                let relative =
                    Spatial { ang: scale(&link.axis.ang, velocity[j]), lin: scale(&link.axis.lin, velocity[j]) };
                own.acceleration = parent.acceleration.plus(&link.velocity.cross_motion(&relative));
                let (mass, (com, about)) = (parameters.mass(j + 1), about_com(parameters, j + 1, link));
                own.inertia = SpatialInertia::new(mass, &com, &about);
                own.force = link_force(mass, &com, &about, &link.velocity, &own.acceleration);
            }
        }
        for &b in tree.iter().rev() {
            let block = &topology.blocks()[b];
            for place in (0..block.len).rev() {
                let j = block.joints[place];
                let (before, rest) = dynamics.split_at_mut(topology.slot(j + 1));
                let (parent, own) = (&mut before[topology.slot(topology.joints[j].parent)], &rest[0]);
                factor.set_joint(topology, b, place, links, &own.inertia, parameters.armature(j));
                bias_joint[j] = links[j + 1].axis.dot(&own.force);
                parent.force = parent.force.plus(&own.force);
                parent.inertia = parent.inertia.plus(&own.inertia);
            }
            factor.set_empty_places(block, b);
        }
    }
    *bias_base = dynamics[0].force.to_array();
    factor.set_base(&dynamics[0].inertia);
}

/// Position and velocity, in base axes, of a point fixed to a link.
#[inline(always)]
pub fn point_motion<S: Real>(link: &LinkState<S>, point: &Vec3<S>) -> (Vec3<S>, Vec3<S>) {
    let at = add(&link.position, &mul_vec(&link.rotation, point));
    let velocity = add(&link.velocity.lin, &cross(&link.velocity.ang, &at));
    (at, velocity)
}
