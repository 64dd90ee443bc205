//! Descriptions of a body's joints: place, axis, drive, and the links that they carry.

use super::{SensedRobot, Sensor};
use crate::components::JointDescriptors;
use crate::config::TaskConfig;
use crate::dynamics::math::{Spatial, dot, mul_vec, rotate_sym};
use crate::dynamics::{Parameters, Scalar, Workspace};
use crate::morphology::MorphologyModel;
use crate::systems::terms::JointMirror;

/// The observation term that shows them.
pub(in crate::systems) const TERM: &str = "joint_descriptors";

/// Change of each number of a joint in a mirror; the numbers are those of [`JointDescriptors`].
pub(in crate::systems) const MIRROR: [JointMirror; 19] = {
    use JointMirror::{Even, Lower, Odd, Opposite, Position, Upper};
    [
        Even, Odd, Even, Opposite, Position, Opposite, Position, Lower, Upper, Even, Even, Even, Even, Even, Even,
        Even, Even, Even, Even,
    ]
};

/// Numbers of a joint.
pub(in crate::systems) const COUNT: usize = MIRROR.len();

/// Limit of a joint without one, rad.
const TURN: f64 = std::f64::consts::PI;
/// Largest effort limit that is shown, N m; a joint without a limit shows it.
pub(in crate::systems) const MOST_EFFORT: f64 = 1000.0;
/// Largest speed limit that is shown, rad/s; a joint without a limit shows it.
const MOST_SPEED: f64 = 100.0;

impl Sensor for JointDescriptors {
    type Settings = ();

    const IS_SAVED: bool = false;

    fn settings(task: &TaskConfig) -> Option<()> {
        let observed = &task.observations;
        observed.policy.iter().chain(observed.groups.values().flatten()).any(|entry| entry.term == TERM).then_some(())
    }

    fn new((): &(), morphology: &MorphologyModel) -> Self {
        Self { numbers: vec![0.0; COUNT * morphology.slots.len()].into() }
    }

    /// A body changes between episodes alone.
    #[inline(always)]
    fn measure(&mut self, (): &(), _: &SensedRobot) {}

    fn begin(&mut self, (): &(), robot: &SensedRobot) {
        self.describe(robot);
    }

    fn renew(&mut self, (): &(), robot: &SensedRobot) {
        self.describe(robot);
    }
}

impl JointDescriptors {
    fn describe(&mut self, robot: &SensedRobot) {
        let (topology, slots) = (&robot.morphology.topology, &robot.morphology.slots);
        let p = Parameters::<f64>::from_scalars(topology, robot.body);
        let q: Vec<f64> = robot.stance.default_position.iter().map(|&q| f64::from(q)).collect();
        let mut work = Workspace::new(topology);
        f64::forward_kinematics(topology, &p, &q, &vec![0.0; q.len()], &Spatial::zero(), &mut work);
        let total: f64 = p.mass.iter().sum();
        for (own, slot) in slots.iter().enumerate() {
            let (j, sign) = (slot.joint(), f64::from(slot.sign));
            let link = &work.links[j + 1];
            let axis = mul_vec(&link.rotation, &topology.joints[j].axis.direction()).map(|x| sign * x);
            let (mut mass, mut inertia) = (0.0, 0.0);
            for below in 1..topology.num_links() {
                if !topology.chain(below).any(|joint| joint == j) {
                    continue;
                }
                let at = &work.links[below];
                let com = mul_vec(&at.rotation, &p.com[below]);
                let arm = [0, 1, 2].map(|i| at.position[i] + com[i] - link.position[i]);
                let along = dot(&arm, &axis);
                let [xx, yy, zz, xy, xz, yz] = rotate_sym(&at.rotation, &p.inertia[below]);
                let [x, y, z] = axis;
                mass += p.mass[below];
                inertia += p.mass[below] * (dot(&arm, &arm) - along * along);
                inertia += xx * x * x + yy * y * y + zz * z * z + 2.0 * (xy * x * y + xz * x * z + yz * y * z);
            }
            // from where the leg hangs straight, by less than half a turn
            let position = sign * q[j];
            let mut zero = robot.morphology.zero_of(slot);
            if zero.abs() > 0.0 {
                zero += 2.0 * TURN * ((position - zero) / (2.0 * TURN)).round();
            }
            let limit = |x: f64| (x - zero).clamp(-TURN, TURN);
            let (lower, upper) = if slot.sign < 0.0 { (-p.upper[j], -p.lower[j]) } else { (p.lower[j], p.upper[j]) };
            let speed = p.velocity_limit[j].min(p.motor_velocity_limit[j]).min(MOST_SPEED);
            let effort = f64::from(robot.morphology.max_effort(j, robot.body)).min(MOST_EFFORT);
            let numbers: [f64; COUNT] = [
                link.position[0],
                link.position[1],
                link.position[2],
                axis[0],
                axis[1],
                axis[2],
                position - zero,
                limit(lower),
                limit(upper),
                effort / 100.0,
                speed / 20.0,
                p.stiffness[j] / 100.0,
                p.damping[j] / 5.0,
                p.armature[j] * 10.0,
                p.joint_friction[j],
                inertia,
                mass / total,
                f64::from(robot.stance.action_scale),
                total / 50.0,
            ];
            for (block, number) in self.numbers.chunks_exact_mut(slots.len()).zip(numbers) {
                block[own] = number as f32;
            }
        }
    }
}
