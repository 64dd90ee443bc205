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

/// What sensors on the robots read: contact forces and, for feet, contact and air times, counted in physics steps; velocity and
/// gravity in the base frame; how high the feet are above the ground. One pass over the robots, whose state it reads once.
pub(super) fn read_sensors(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    ground: Res<Ground>,
    tags: Query<&'static Morphology, With<Robot>>,
    origins: Query<&'static EnvOrigin>,
    poses: Query<&'static BasePose>,
    velocities: Query<&'static BaseVelocity>,
    bodies: Query<&'static Body>,
    forces: Query<&'static ContactForces>,
    mut contacts: Query<&'static mut ContactSensor>,
    mut imus: Query<&'static mut Imu>,
    mut feet: Query<&'static mut Feet>,
) {
    let tags = read_rows(&tags);
    let dt = task.config.sim.dt as f32;
    let state = (read_rows(&origins), read_rows(&poses), read_rows(&velocities), read_rows(&bodies));
    let sensors = (write_rows(&mut contacts), write_rows(&mut imus), write_rows(&mut feet));
    let rows = (tags, state, read_rows(&forces), sensors);
    workers.for_each_chunk(rows, tags.len(), |_, n, (tags, state, forces, (contacts, imus, feet))| {
        let (origins, poses, velocities, bodies) = state;
        for i in 0..n {
            contacts[i].read(&forces[i], &morphologies.get(tags[i]).feet, dt);
            imus[i] = measure(&poses[i], &velocities[i], &bodies[i].0.com[0]);
            feet[i].measure(&ground, &origins[i]);
        }
    });
}

impl ContactSensor {
    /// The forces of a control step; `feet` are the contact bodies that are feet.
    fn read(&mut self, forces: &ContactForces, feet: &[usize], dt: f32) {
        let Self { peak_force, contact_time, air_time, last_contact_time, last_air_time } = self;
        let steps = forces.normal.chunks_exact(peak_force.len().max(1));
        peak_force.fill(0.0);
        for normal in steps.clone().skip(steps.len().saturating_sub(HISTORY)) {
            for (peak, &force) in peak_force.iter_mut().zip(normal) {
                *peak = if force > *peak { force } else { *peak };
            }
        }
        let last = last_contact_time.iter_mut().zip(last_air_time);
        let times = contact_time.iter_mut().zip(air_time).zip(last);
        for (&body, ((contact, air), (last_contact, last_air))) in feet.iter().zip(times) {
            for normal in steps.clone() {
                if normal[body] > FORCE_THRESHOLD {
                    if *air > 0.0 {
                        *last_air = *air + dt;
                    }
                    *contact += dt;
                    *air = 0.0;
                } else {
                    if *contact > 0.0 {
                        *last_contact = *contact + dt;
                    }
                    *air += dt;
                    *contact = 0.0;
                }
            }
        }
    }
}

impl Feet {
    /// Their heights above the ground, from where they are.
    fn measure(&mut self, ground: &Ground, origin: &EnvOrigin) {
        let Self { position, height, .. } = self;
        ground.heights_at(origin, position.iter().map(|[x, y, _]| [*x, *y]), height);
        for ([_, _, z], height) in position.iter().zip(height) {
            *height = z - *height;
        }
    }
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
        let [x0, y0, _] = pose.position;
        let places = self.0.iter().map(|[x, y]| [x0 + (c * x - s * y), y0 + (s * x + c * y)]);
        ground.heights_at(origin, places, &mut scan.hits);
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
