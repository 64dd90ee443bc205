//! Sensors read the state that the physics left.

use bevy_ecs::prelude::*;

use super::command::heading;
use super::terms::CompiledTask;
use crate::components::{
    BasePose, BaseVelocity, Body, ContactForces, ContactSensor, EnvOrigin, Feet, HeightScan, Imu, Morphology, Robot,
};
use crate::config::HeightScannerConfig;
use crate::morphology::Morphologies;
use crate::rows::{Workers, read_rows, write_rows};
use crate::world::Ground;

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

/// How high the feet are above the ground.
pub(super) fn read_feet(
    workers: Res<Workers>,
    ground: Res<Ground>,
    origins: Query<&'static EnvOrigin>,
    mut feet: Query<&'static mut Feet>,
) {
    let origins = read_rows(&origins);
    workers.for_each_chunk((origins, write_rows(&mut feet)), origins.len(), |_, n, (origins, feet)| {
        for i in 0..n {
            let Feet { position, height, .. } = &mut feet[i];
            for ([x, y, z], height) in position.iter().zip(height) {
                *height = z - ground.height_at(&origins[i], [*x, *y]);
            }
        }
    });
}

/// Where the rays of the task's height scanner are about the base, m.
#[derive(Resource, Clone, Debug, Default)]
pub struct ScanRays(Vec<[f32; 2]>);

impl ScanRays {
    /// Of a task's scanner; none without one.
    pub fn new(scanner: Option<&HeightScannerConfig>) -> Self {
        Self(scanner.map(HeightScannerConfig::rays).unwrap_or_default())
    }

    /// Number of rays.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there is no scanner.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Looks down around a base; the grid turns with its heading alone.
    pub(super) fn scan(&self, ground: &Ground, origin: &EnvOrigin, pose: &BasePose, scan: &mut HeightScan) {
        let [w, x, y, z] = pose.rotation;
        // the base's x axis on the ground
        let (c, s) = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z));
        let length = (c * c + s * s).sqrt();
        // a base that points straight up has no heading
        let (c, s) = if length > 1e-6 { (c / length, s / length) } else { (1.0, 0.0) };
        for ([x, y], hit) in self.0.iter().zip(scan.hits.iter_mut()) {
            *hit = ground.height_at(origin, [pose.position[0] + (c * x - s * y), pose.position[1] + (s * x + c * y)]);
        }
    }
}

/// Heights of the ground around the bases.
pub(crate) fn scan_heights(
    workers: Res<Workers>,
    ground: Res<Ground>,
    rays: Res<ScanRays>,
    origins: Query<&'static EnvOrigin>,
    poses: Query<&'static BasePose>,
    mut scans: Query<&'static mut HeightScan>,
) {
    let scans = write_rows(&mut scans);
    let len = scans.len();
    let rows = (read_rows(&origins), read_rows(&poses), scans);
    if len > 0 {
        workers.for_each_chunk(rows, len, |_, n, (origins, poses, scans)| {
            for i in 0..n {
                rays.scan(&ground, &origins[i], &poses[i], &mut scans[i]);
            }
        });
    }
}
