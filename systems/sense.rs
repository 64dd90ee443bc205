//! Sensors read the state that the physics left.

use bevy_ecs::prelude::*;

use super::command::heading;
use super::terms::CompiledTask;
use crate::components::{BasePose, BaseVelocity, Body, ContactForces, ContactSensor, Imu, Morphology, Robot};
use crate::morphology::Morphologies;
use crate::rows::{Workers, read_rows, write_rows};

/// Physics steps that a contact force is remembered for.
const HISTORY: usize = 3;
/// Normal force from which a body counts as in contact, N.
const FORCE_THRESHOLD: f32 = 1.0;

/// Contact forces and, for feet, contact and air times, counted in physics steps.
pub(super) fn read_contacts(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    tags: Query<&'static Morphology, With<Robot>>,
    forces: Query<&'static ContactForces>,
    mut sensors: Query<&'static mut ContactSensor>,
) {
    let tags = read_rows(&tags);
    let dt = task.config.sim.dt as f32;
    let rows = (tags, read_rows(&forces), write_rows(&mut sensors));
    workers.for_each_chunk(rows, tags.len(), |_, n, (tags, forces, sensors)| {
        for i in 0..n {
            let sensor = &mut sensors[i];
            let bodies = sensor.peak_force.len();
            let steps = forces[i].normal.chunks_exact(bodies.max(1));
            let skip = steps.len().saturating_sub(HISTORY);
            sensor.peak_force.fill(0.0);
            for (k, normal) in steps.enumerate() {
                if k >= skip {
                    for (peak, &force) in sensor.peak_force.iter_mut().zip(normal) {
                        *peak = peak.max(force);
                    }
                }
                for (foot, &body) in morphologies.get(tags[i]).feet.iter().enumerate() {
                    sensor.advance(foot, normal[body] > FORCE_THRESHOLD, dt);
                }
            }
        }
    });
}

impl ContactSensor {
    /// One physics step of a foot's timers.
    fn advance(&mut self, foot: usize, touches: bool, dt: f32) {
        let (contact, air) = (&mut self.contact_time[foot], &mut self.air_time[foot]);
        if touches {
            if *air > 0.0 {
                self.last_air_time[foot] = *air + dt;
            }
            *contact += dt;
            *air = 0.0;
        } else {
            if *contact > 0.0 {
                self.last_contact_time[foot] = *contact + dt;
            }
            *air += dt;
            *contact = 0.0;
        }
    }
}

/// Velocity and gravity in the base frame.
pub(super) fn read_imus(
    workers: Res<Workers>,
    poses: Query<&'static BasePose>,
    velocities: Query<&'static BaseVelocity>,
    bodies: Query<&'static Body>,
    mut imus: Query<&'static mut Imu>,
) {
    let poses = read_rows(&poses);
    let rows = (poses, read_rows(&velocities), read_rows(&bodies), write_rows(&mut imus));
    workers.for_each_chunk(rows, poses.len(), |_, n, (poses, velocities, bodies, imus)| {
        for i in 0..n {
            imus[i] = measure(&poses[i], &velocities[i], &bodies[i].0.com[0]);
        }
    });
}

/// The IMU's reading; `com` is the base's centre of mass in its frame, m.
pub(super) fn measure(pose: &BasePose, velocity: &BaseVelocity, com: &[f32; 3]) -> Imu {
    use crate::dynamics::math::{add, cross, mul_vec_transposed, quat_to_mat};
    let rotation = quat_to_mat(&pose.rotation);
    Imu {
        linear_velocity: add(&mul_vec_transposed(&rotation, &velocity.linear), &cross(&velocity.angular, com)),
        angular_velocity: velocity.angular,
        projected_gravity: rotation[2].map(|x| -x),
        heading: heading(&pose.rotation),
    }
}
