//! Sensors read the state that the physics left.

use bevy_ecs::prelude::*;

use super::command::heading;
use super::terms::CompiledTask;
use crate::components::{
    BasePose, BaseVelocity, Body, ContactForces, ContactSensor, EnvOrigin, FORCE_HISTORY, Feet, HeightScan, Imu,
    Morphology, PerFoot, Robot,
};
use crate::config::HeightScannerConfig;
use crate::dynamics::LARGE_GROUP;
use crate::dynamics::lanes::Kernel;
use crate::morphology::Morphologies;
use crate::rows::{OptionalRows, Workers, read_rows, write_rows};
use crate::world::Ground;

/// Normal force from which a body counts as in contact, N.
const FORCE_THRESHOLD: f32 = 1.0;

/// What sensors on the robots read: contact forces and, for feet, contact and air times, counted in physics steps; velocity and
/// gravity in the base frame. One pass over the robots, whose state it reads once.
pub(super) fn read_sensors(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    tags: Query<&'static Morphology, With<Robot>>,
    poses: Query<&'static BasePose>,
    velocities: Query<&'static BaseVelocity>,
    bodies: Query<&'static Body>,
    forces: Query<&'static ContactForces>,
    mut contacts: Query<&'static mut ContactSensor>,
    mut imus: Query<&'static mut Imu>,
) {
    let tags = read_rows(&tags);
    let dt = task.config.sim.dt as f32;
    let state = (read_rows(&poses), read_rows(&velocities), read_rows(&bodies));
    let rows = (tags, state, read_rows(&forces), write_rows(&mut contacts), write_rows(&mut imus));
    let morphologies = &morphologies;
    workers.vectorize_chunks(rows, tags.len(), |_, _, (tags, (poses, velocities, bodies), forces, contacts, imus)| {
        SensorRows { dt, morphologies, tags, poses, velocities, bodies, forces, contacts, imus }
    });
}

struct SensorRows<'a> {
    dt: f32,
    morphologies: &'a Morphologies,
    tags: &'a [Morphology],
    poses: &'a [BasePose],
    velocities: &'a [BaseVelocity],
    bodies: &'a [Body],
    forces: &'a [ContactForces],
    contacts: &'a mut [ContactSensor],
    imus: &'a mut [Imu],
}

impl Kernel<f32> for SensorRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { dt, morphologies, tags, poses, velocities, bodies, forces, contacts, imus } = self;
        for i in 0..tags.len() {
            contacts[i].read(&forces[i], &morphologies.get(tags[i]).feet, dt);
            imus[i] = measure(&poses[i], &velocities[i], &bodies[i].0.com[0]);
        }
    }
}

impl ContactSensor {
    /// The forces of a control step; `feet` are the contact bodies that are feet.
    #[inline(always)]
    fn read(&mut self, forces: &ContactForces, feet: &PerFoot<usize>, dt: f32) {
        let larger = |x: f32, other: f32| if other > x { other } else { x };
        let mut peaks = PerFoot::default();
        let steps = &forces.feet_normal[..];
        for normal in &steps[steps.len().saturating_sub(FORCE_HISTORY)..] {
            for (peak, normal) in peaks.iter_mut().zip(normal) {
                *peak = larger(*peak, *normal);
            }
        }
        self.peak_force.fill(0.0);
        for (&body, peak) in feet.iter().zip(peaks) {
            self.peak_force[body] = peak;
        }
        for force in &forces.others {
            self.peak_force[force.body as usize] = force.normal.into_iter().fold(0.0, larger);
        }
        let Self { contact_time: contact, air_time: air, last_contact_time, last_air_time, .. } = self;
        for normal in steps {
            // by selection: which foot stands when is hard to foresee
            for foot in 0..normal.len() {
                let stands = normal[foot] > FORCE_THRESHOLD;
                let (longer_contact, longer_air) = (contact[foot] + dt, air[foot] + dt);
                last_air_time[foot] = if stands & (air[foot] > 0.0) { longer_air } else { last_air_time[foot] };
                last_contact_time[foot] =
                    if !stands & (contact[foot] > 0.0) { longer_contact } else { last_contact_time[foot] };
                contact[foot] = if stands { longer_contact } else { 0.0 };
                air[foot] = if stands { 0.0 } else { longer_air };
            }
        }
    }
}

/// The IMU's reading; `com` is the base's centre of mass in its frame, m.
#[inline(always)]
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

/// Where the rays of the task's height scanner are about the base, m, in groups of which the last may have copies.
#[derive(Resource, Clone, Debug, Default)]
pub struct ScanRays {
    groups: Vec<[[f32; LARGE_GROUP]; 2]>,
    len: usize,
}

impl ScanRays {
    /// Of a task's scanner; none without one.
    pub fn new(scanner: Option<&HeightScannerConfig>) -> Self {
        let rays = scanner.map(HeightScannerConfig::rays).unwrap_or_default();
        let group = |rays: &[[f32; 2]]| [0, 1].map(|axis| std::array::from_fn(|k| rays[k.min(rays.len() - 1)][axis]));
        Self { groups: rays.chunks(LARGE_GROUP).map(group).collect(), len: rays.len() }
    }

    /// Number of rays.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no scanner.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Looks down around a base; the grid turns with its heading alone.
    #[inline(always)]
    pub(super) fn scan(&self, ground: &Ground, origin: &EnvOrigin, pose: &BasePose, scan: &mut HeightScan) {
        let Some(grid) = &ground.terrain else {
            return scan.hits.fill(ground.height as f32);
        };
        let [w, x, y, z] = pose.rotation;
        // the base's x axis on the ground
        let (c, s) = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z));
        let length = (c * c + s * s).sqrt();
        // a base that points straight up has no heading
        let (c, s) = if length > 1e-6 { (c / length, s / length) } else { (1.0, 0.0) };
        let ([x0, y0, _], [x1, y1]) = (pose.position, origin.position);
        for ([x, y], heights) in self.groups.iter().zip(scan.hits.chunks_mut(LARGE_GROUP)) {
            let (mut at_x, mut at_y) = ([0.0; LARGE_GROUP], [0.0; LARGE_GROUP]);
            for k in 0..LARGE_GROUP {
                at_x[k] = x1 + (x0 + (c * x[k] - s * y[k]));
                at_y[k] = y1 + (y0 + (s * x[k] + c * y[k]));
            }
            grid.heights_below(&at_x, &at_y, heights);
        }
    }
}

/// How high the feet are above the ground, and heights of the ground around the bases.
pub(super) fn look_down(
    workers: Res<Workers>,
    ground: Res<Ground>,
    rays: Res<ScanRays>,
    origins: Query<&'static EnvOrigin>,
    poses: Query<&'static BasePose>,
    mut feet: Query<&'static mut Feet>,
    mut scans: Query<&'static mut HeightScan>,
) {
    let (origins, feet, scans) = (read_rows(&origins), write_rows(&mut feet), write_rows(&mut scans));
    let rows = (origins, read_rows(&poses), OptionalRows(feet), OptionalRows(scans));
    let (ground, rays) = (&ground, &rays);
    workers.vectorize_chunks(rows, origins.len(), |_, _, (origins, poses, feet, scans)| GroundRows {
        ground,
        rays,
        origins,
        poses,
        feet,
        scans,
    });
}

/// Heights of the ground around the bases alone.
pub(crate) fn scan_heights(
    workers: Res<Workers>,
    ground: Res<Ground>,
    rays: Res<ScanRays>,
    origins: Query<&'static EnvOrigin>,
    poses: Query<&'static BasePose>,
    mut scans: Query<&'static mut HeightScan>,
) {
    let origins = read_rows(&origins);
    let rows = (origins, read_rows(&poses), OptionalRows(write_rows(&mut scans)));
    let (ground, rays) = (&ground, &rays);
    workers.vectorize_chunks(rows, origins.len(), |_, _, (origins, poses, scans)| GroundRows {
        ground,
        rays,
        origins,
        poses,
        feet: OptionalRows(&mut []),
        scans,
    });
}

struct GroundRows<'a> {
    ground: &'a Ground,
    rays: &'a ScanRays,
    origins: &'a [EnvOrigin],
    poses: &'a [BasePose],
    feet: OptionalRows<'a, Feet>,
    scans: OptionalRows<'a, HeightScan>,
}

impl Kernel<f32> for GroundRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { ground, rays, origins, poses, feet, scans } = self;
        // those on the same tile in turn, which finds its heights in the cache
        let tile = |origin: &EnvOrigin| u64::from(origin.terrain_level) << 16 | u64::from(origin.terrain_column);
        let mut order: Vec<u64> = (0..).zip(origins).map(|(row, origin)| tile(origin) << 32 | row).collect();
        if ground.layout.is_some() {
            order.sort_unstable();
        }
        for row in order {
            let row = (row & u64::from(u32::MAX)) as usize;
            if let Some(feet) = feet.0.get_mut(row) {
                feet.measure(ground, &origins[row]);
            }
            if let Some(scan) = scans.0.get_mut(row) {
                rays.scan(ground, &origins[row], &poses[row], scan);
            }
        }
    }
}

impl Feet {
    /// Their heights above the ground, from where they are.
    #[inline(always)]
    fn measure(&mut self, ground: &Ground, origin: &EnvOrigin) {
        let Self { position, height, .. } = self;
        ground.heights_at(origin, position.iter().map(|[x, y, _]| [*x, *y]), height);
        for ([_, _, z], height) in position.iter().zip(height) {
            *height = z - *height;
        }
    }
}
