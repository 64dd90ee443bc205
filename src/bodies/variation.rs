//! Bodies that differ from their URDF: stretched and heavier or lighter links, another standing
//! pose, another size, and the numbers that follow.
//!
//! Every parameter of a body may differ from its morphology's ([`Parameters`]), and varied bodies
//! step by the same instructions as equal ones. Their parameters come from memory, where those of
//! equal bodies stay in the cache, which costs some hundredths more time (docs/performance.md). A
//! link is stretched by a linear map of its points. Joint origins, centres of mass, collision
//! shapes, feet and the second moments of its mass follow the map. Spheres, capsules and cylinders
//! keep their radius unless the whole robot is scaled. Left and right legs are stretched equally
//! and stay mirror images. The pairs of shapes that can touch are the morphology's: parts that are
//! stretched by more than 1.15 times the size may reach a little where no contact is looked for.
//!
//! A body of another size is dynamically similar (Alexander and Jayes, A dynamic similarity
//! hypothesis for the gaits of quadrupedal mammals, 1983). Under the same gravity and with the same
//! density its motion takes a time that grows with the root of the size.

use crate::components::Stance;
use crate::dynamics::math::{Mat3, Spatial, Sym3, Vec3, dot, mul_vec, rotate_sym};
use crate::dynamics::{Parameters, Scalar, Topology, Workspace};
use crate::morphology::{MorphologyModel, UP, lowest_point};
use crate::robot::{LimbKind, Side};

/// Heights that differ by less are equal, m: parameters are in `f32`.
const ROUNDING: f64 = 1e-6;

/// Factors between a body and that of its URDF; lengths and masses by part of the body, the same
/// for all legs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyScales {
    /// Length of the base, along x.
    pub base_length: f64,
    /// Width of the base, along y.
    pub base_width: f64,
    /// Distance between abduction and flexion joint of the hip.
    pub hip_offset: f64,
    /// Distance between hip and knee.
    pub thigh_length: f64,
    /// Distance between knee and foot.
    pub shank_length: f64,
    /// Mass of the base.
    pub base_mass: f64,
    /// Mass of each link between the joints of a hip.
    pub hip_mass: f64,
    /// Mass of each thigh.
    pub thigh_mass: f64,
    /// Mass of each shank with its foot.
    pub shank_mass: f64,
    /// Range of each joint about its middle, as far as the default pose stays within.
    pub joint_range: f64,
    /// Stiffness of all actuators.
    pub stiffness: f64,
    /// Damping of all actuators.
    pub damping: f64,
    /// All lengths; masses, inertias, torques, gains and speeds follow by dynamic similarity.
    pub size: f64,
    /// Joint target per unit of action.
    pub action_scale: f64,
    /// Angles of hip flexion and knee in the default pose: straighter or more bent legs.
    pub default_flexion: f64,
    /// Angle by which the legs are spread more in the default pose, rad; not a factor.
    pub default_abduction: f64,
}

impl BodyScales {
    /// The body of the URDF.
    pub const NOMINAL: Self = Self {
        base_length: 1.0,
        base_width: 1.0,
        hip_offset: 1.0,
        thigh_length: 1.0,
        shank_length: 1.0,
        base_mass: 1.0,
        hip_mass: 1.0,
        thigh_mass: 1.0,
        shank_mass: 1.0,
        joint_range: 1.0,
        stiffness: 1.0,
        damping: 1.0,
        size: 1.0,
        action_scale: 1.0,
        default_flexion: 1.0,
        default_abduction: 0.0,
    };

    /// Scales a body of this morphology and its stance.
    pub fn apply(&self, model: &MorphologyModel, body: &mut Parameters<f32>, stance: &mut Stance) {
        let topology = &model.topology;
        let mut p = Parameters::<f64>::from_scalars(topology, body);
        // the maps come from the unscaled lengths, so all of them first
        let maps = self.maps(model, &p);
        for (link, (map, mass)) in maps.iter().enumerate() {
            p.com[link] = mul_vec(map, &p.com[link]);
            p.mass[link] *= mass;
            p.inertia[link] = stretched(map, *mass, &p.inertia[link]);
        }
        for (j, joint) in topology.joints.iter().enumerate() {
            p.joint_offset[j] = mul_vec(&maps[joint.parent].0, &p.joint_offset[j]);
        }
        for (s, &link) in topology.sites.iter().enumerate() {
            p.site_position[s] = mul_vec(&maps[link].0, &p.site_position[s]);
        }
        stretch_shapes(topology, &maps, self.size, &mut p);
        if (self.default_flexion, self.default_abduction) != (1.0, 0.0) {
            self.pose(model, &p, &mut stance.default_position);
        }
        stance.action_scale *= self.action_scale as f32;
        for j in 0..topology.num_joints() {
            p.stiffness[j] *= self.stiffness;
            p.damping[j] *= self.damping;
            let default = f64::from(stance.default_position[j]);
            let (lower, upper) = (p.lower[j], p.upper[j]);
            if lower.is_finite() && upper.is_finite() {
                let (middle, half) = (0.5 * (lower + upper), 0.5 * (upper - lower) * self.joint_range);
                p.lower[j] = (middle - half).min(default);
                p.upper[j] = (middle + half).max(default);
            }
        }
        self.drive(&mut p);
        stance.spawn_height = spawn_height(model, &p, &stance.default_position, self.size);
        body.zip_with(&p, |x, y| *x = *y as f32);
    }

    /// The default pose with legs more or less bent and spread, within the joints' limits.
    fn pose(&self, model: &MorphologyModel, p: &Parameters<f64>, position: &mut [f32]) {
        for (slot, &joint) in model.roles.slots.iter().zip(&model.roles.joint_of_slot) {
            let role = slot.role;
            let q = f64::from(position[joint]);
            let new = if role.is_abduction() {
                // a positive turn about the forward axis spreads the left legs
                let [forward, ..] = model.topology.joints[joint].axis.direction();
                let is_outward = (slot.place.side() == Side::Left) == (forward > 0.0);
                if is_outward { q + self.default_abduction } else { q - self.default_abduction }
            } else if role.is_flexion() {
                q * self.default_flexion
            } else {
                continue;
            };
            position[joint] = new.max(p.lower[joint]).min(p.upper[joint]) as f32;
        }
    }

    /// Scales the actuators' efforts and the joints' rates to a body of this size. A torque is a
    /// weight times a length, a time the root of a length.
    fn drive(&self, p: &mut Parameters<f64>) {
        let size = self.size;
        let (torque, time) = (size * size * size * size, size.sqrt());
        for (list, factor) in [
            (&mut p.stiffness, torque),
            (&mut p.effort_limit, torque),
            (&mut p.saturation_effort, torque),
            (&mut p.joint_friction, torque),
            (&mut p.damping, torque * time),
            (&mut p.joint_damping, torque * time),
            (&mut p.motor_velocity_limit, 1.0 / time),
            (&mut p.velocity_limit, 1.0 / time),
            (&mut p.armature, torque * size),
        ] {
            // infinity, no limit, stays infinity
            list.iter_mut().for_each(|x| *x *= factor);
        }
        p.spring.iter_mut().for_each(|[stiffness, _]| *stiffness *= torque);
    }

    /// Stretching map of each link, and the factor of its mass, `[links]`.
    fn maps(&self, model: &MorphologyModel, p: &Parameters<f64>) -> Vec<(Mat3<f64>, f64)> {
        let topology = &model.topology;
        let mut maps = vec![(stretch(&[0.0; 3], 1.0), 1.0); topology.num_links()];
        let mut base = stretch(&[0.0; 3], 1.0);
        (base[0][0], base[1][1]) = (self.base_length, self.base_width);
        maps[0] = (base, self.base_mass);
        let legs = model.roles.limbs.iter().filter(|limb| limb.kind == LimbKind::Leg);
        for (leg, limb) in legs.enumerate() {
            let knee = limb.joints.iter().position(|joint| joint.slot.role.is_knee());
            let Some(knee) = knee else {
                continue;
            };
            // a link reaches to the next joint, and the shank to the foot or the ankle
            for (at, joint) in limb.joints[..=knee].iter().enumerate() {
                let (length, mass) = match knee - at {
                    0 => (self.shank_length, self.shank_mass),
                    1 => (self.thigh_length, self.thigh_mass),
                    _ => (self.hip_offset, self.hip_mass),
                };
                let end = match limb.joints.get(at + 1) {
                    Some(next) if at < knee => p.joint_offset[next.joint],
                    _ => foot_in(topology, p, joint.joint + 1, leg),
                };
                maps[joint.joint + 1] = (stretch(&end, length), mass);
            }
        }
        for (map, mass) in &mut maps {
            map.iter_mut().flatten().for_each(|x| *x *= self.size);
            *mass *= self.size * self.size * self.size;
        }
        maps
    }
}

/// Place of a leg's foot in its shank, or of the part of the leg that carries the foot, m.
fn foot_in(topology: &Topology, p: &Parameters<f64>, shank: usize, leg: usize) -> Vec3<f64> {
    let below = topology.chain(topology.sites[leg]).find(|&joint| topology.joints[joint].parent == shank);
    match below {
        Some(joint) => p.joint_offset[joint],
        None => p.site_position[leg],
    }
}

/// The map that stretches by a factor along a direction and keeps directions across it.
fn stretch(along: &Vec3<f64>, factor: f64) -> Mat3<f64> {
    let square = dot(along, along);
    let more = if square > 0.0 { (factor - 1.0) / square } else { 0.0 };
    std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j)) + more * along[i] * along[j]))
}

/// Inertia of a link whose mass is spread by a map and weighed by a factor: the second moments
/// follow the map.
fn stretched(map: &Mat3<f64>, mass: f64, inertia: &Sym3<f64>) -> Sym3<f64> {
    let moments = complement(inertia, 0.5);
    // `rotate_sym` is a congruence: any map will do
    complement(&rotate_sym(map, &moments), 1.0).map(|x| x * mass)
}

/// `share tr(s) 1 - s`: from inertia to second moments with a share of 1/2, and back with 1.
fn complement(&[xx, yy, zz, xy, xz, yz]: &Sym3<f64>, share: f64) -> Sym3<f64> {
    let trace = share * (xx + yy + zz);
    [trace - xx, trace - yy, trace - zz, -xy, -xz, -yz]
}

fn stretch_shapes(topology: &Topology, maps: &[(Mat3<f64>, f64)], size: f64, p: &mut Parameters<f64>) {
    for (i, contact) in topology.contacts.iter().enumerate() {
        p.contact_position[i] = mul_vec(&maps[contact.link].0, &p.contact_position[i]);
        p.contact_radius[i] *= size;
        p.contact_rim[i] *= size;
    }
    for [_, torsional, rolling] in &mut p.contact_friction {
        *torsional *= size;
        *rolling *= size;
    }
    for (i, collider) in topology.colliders.iter().enumerate() {
        let map = &maps[collider.link].0;
        p.collider_centre[i] = mul_vec(map, &p.collider_centre[i]);
        match &collider.box_rotation {
            // from tip to tip a capsule is as long as what it stands for
            None => {
                let (half, radius) = (p.collider_half[i], p.collider_radius[i]);
                let (before, image) = (dot(&half, &half).sqrt(), mul_vec(map, &half));
                let after = dot(&image, &image).sqrt();
                if before > 0.0 && after > 0.0 {
                    let tip = (before + radius) * after / before;
                    p.collider_half[i] = image.map(|x| x * (tip - radius * size).max(0.0) / after);
                }
                p.collider_radius[i] *= size;
            }
            // a box stays one: its edges take the lengths of their images
            Some(rows) => {
                for k in 0..3 {
                    let edge = mul_vec(map, &[rows[0][k], rows[1][k], rows[2][k]]);
                    p.collider_half[i][k] *= dot(&edge, &edge).sqrt();
                }
            }
        }
    }
    p.box_links(topology);
}

/// Height of the base above level ground in the default pose, with the lowest point at the reset's
/// margin above it, m.
///
/// A foot that is a ball is measured at its site, from which its centre differs by rounding.
fn spawn_height(model: &MorphologyModel, p: &Parameters<f64>, position: &[f32], size: f64) -> f32 {
    let topology = &model.topology;
    let q: Vec<f64> = position.iter().map(|&q| f64::from(q)).collect();
    let mut work = Workspace::new(topology);
    f64::forward_kinematics(topology, p, &q, &vec![0.0; q.len()], &Spatial::zero(), &mut work);
    let feet = (0..topology.sites.len()).map(|leg| {
        let link = &work.links[topology.sites[leg]];
        let foot = mul_vec(&link.rotation, &p.site_position[leg]);
        link.position[2] + foot[2] - model.roles.foot_radius[leg] * size
    });
    let (feet, shapes) = (feet.fold(f64::INFINITY, f64::min), lowest_point(topology, p, &q, &UP));
    let lowest = if shapes < feet - ROUNDING { shapes } else { feet };
    (model.config.reset.spawn_margin - lowest) as f32
}
