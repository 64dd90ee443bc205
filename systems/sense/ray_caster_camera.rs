//! A depth camera on a link: distances to the ground along the rays of its pixels.

use std::sync::OnceLock;

use super::{SensedRobot, Sensor};
use crate::blocks::BlockMarker;
use crate::components::{CameraFrame, EnvRng, RayCasterCamera};
use crate::config::{CameraMountConfig, ConfigError, DepthClipping, DepthData, RayCasterCameraConfig, TaskConfig};
use crate::dynamics::lanes::Real;
use crate::dynamics::math::{Mat3, Vec3, add, add_scaled, mul_mat, mul_vec, quat_to_mat};
use crate::dynamics::{HeightBounds, JointMotion, LARGE_GROUP, Rays, cast_rays};
use crate::morphology::MorphologyModel;
use crate::systems::terms::{Registry, TermKind, TermSpec};
use crate::systems::view::RobotView;

/// Stream of a camera's random numbers, next to those of its env.
const STREAM: u64 = 0x63616d;

impl BlockMarker for RayCasterCamera {
    const NAME: &'static str = "camera";

    fn is_on(morphology: &MorphologyModel, task: &TaskConfig) -> bool {
        let camera = task.sensors.ray_caster_camera.as_ref();
        camera.is_some_and(|camera| mount_of(morphology, camera.mount.as_ref()).is_some())
    }
}

impl Sensor for RayCasterCamera {
    type Settings = CameraSettings;

    const READS_TERRAIN: bool = true;
    const IS_RENEWED: bool = true;

    fn settings(task: &TaskConfig) -> Option<CameraSettings> {
        task.sensors.ray_caster_camera.as_ref().map(|camera| CameraSettings::new(camera, task.sim.step_dt()))
    }

    fn new(settings: &CameraSettings, _: &MorphologyModel) -> Self {
        Self {
            depth: vec![0.0; settings.num_pixels()].into(),
            is_new: true,
            shown: None,
            late: Vec::new(),
            wait: 0,
            delay: 0,
            most_delay: settings.delay[1],
            rng: EnvRng::new(0, STREAM),
        }
    }

    #[inline(always)]
    fn measure(&mut self, settings: &CameraSettings, robot: &SensedRobot) {
        self.is_new = false;
        let is_due = self.wait <= 1;
        self.wait = if is_due { settings.period } else { self.wait - 1 };
        let is_kept = !(is_due && settings.drop > 0.0 && self.rng.unit() < settings.drop);
        let frame = if is_due && is_kept { Some(self.take(settings, robot)) } else { None };
        self.late.push(frame);
        if self.late.len() as u32 > self.delay
            && let Some(frame) = self.late.remove(0)
        {
            self.show(frame, settings, robot);
        }
    }

    #[inline(always)]
    fn begin(&mut self, settings: &CameraSettings, robot: &SensedRobot) {
        let mut env = robot.rng.clone();
        let [high, low] = [(); 2].map(|()| u64::from(env.integer([0, u32::MAX])));
        self.rng = EnvRng::new(high << 32 | low, STREAM);
        self.delay = self.rng.integer(settings.delay);
        self.wait = self.rng.integer([1, settings.period]);
        self.late = vec![None; self.delay as usize];
        let frame = self.take(settings, robot);
        self.show(frame, settings, robot);
    }

    #[inline(always)]
    fn renew(&mut self, settings: &CameraSettings, robot: &SensedRobot) {
        self.depth = vec![0.0; settings.num_pixels()].into();
        self.is_new = true;
        if let Some(frame) = self.shown.take() {
            self.show(frame, settings, robot);
        }
    }
}

impl RayCasterCamera {
    /// The camera's pose and the random numbers of a frame that is taken now.
    #[inline(always)]
    fn take(&mut self, settings: &CameraSettings, robot: &SensedRobot) -> CameraFrame {
        let (position, rotation) = settings.pose(robot);
        let noise = self.rng.clone();
        if settings.noise != [0.0; 2] {
            self.rng = EnvRng::new(u64::from(self.rng.integer([0, u32::MAX])), STREAM);
        }
        CameraFrame { position, rotation, noise }
    }

    /// Makes a frame the one that is observed.
    #[inline(always)]
    fn show(&mut self, frame: CameraFrame, settings: &CameraSettings, robot: &SensedRobot) {
        settings.render(&frame, robot, &mut self.depth);
        self.is_new = true;
        self.shown = Some(frame);
    }
}

/// Mount of a robot's camera: by the robot's config, else by the task's.
fn mount_of<'a>(
    morphology: &'a MorphologyModel,
    of_task: Option<&'a CameraMountConfig>,
) -> Option<&'a CameraMountConfig> {
    morphology.config.camera.as_ref().or(of_task)
}

/// The link that carries a mount; the base where it names none.
fn link_of(morphology: &MorphologyModel, mount: &CameraMountConfig) -> Option<usize> {
    let links = &morphology.model.links;
    mount.body.as_ref().map_or(Some(0), |body| links.iter().position(|link| link.name == *body))
}

/// Checks the links that the robots' cameras are on.
///
/// # Errors
/// A robot has no link of that name, or no robot of the task has a camera.
pub(in crate::systems) fn check(task: &TaskConfig, morphologies: &[MorphologyModel]) -> Result<(), ConfigError> {
    let Some(camera) = &task.sensors.ray_caster_camera else {
        return Ok(());
    };
    let mut any = false;
    for morphology in morphologies {
        let Some(mount) = mount_of(morphology, camera.mount.as_ref()) else {
            continue;
        };
        any = true;
        if link_of(morphology, mount).is_none() {
            let is_own = morphology.config.camera.is_some();
            let (file, element) = match is_own {
                true => (morphology.name().to_owned(), "camera.body"),
                false => (task.name.clone(), "sensors.ray_caster_camera.mount.body"),
            };
            let body = mount.body.as_deref().unwrap_or_default();
            let problem = format!("{} has no moving link `{body}`", morphology.name());
            let known: Vec<&str> = morphology.model.links.iter().map(|link| link.name.as_str()).collect();
            let remedy = format!("use one of {}, or leave body out for the base", known.join(", "));
            return Err(ConfigError::invalid(file, element, problem, remedy));
        }
    }
    if any {
        return Ok(());
    }
    let remedy = "add sensors.ray_caster_camera.mount = { pos = [x, y, z], rot = [w, x, y, z] }, or robot_overrides.<robot>.camera";
    Err(ConfigError::invalid(
        task.name.clone(),
        "sensors.ray_caster_camera",
        "no robot of the task has a camera",
        remedy,
    ))
}

/// The camera of a task.
pub struct CameraSettings {
    mount: Option<CameraMountConfig>,
    /// Directions of the pixels in the camera's axes, x, y and z, `[3][pixels]`: of length 1 where
    /// distances are along the rays; else x is 1, and distances are along the camera's axis.
    directions: [Vec<f32>; 3],
    /// No ray reaches farther from the camera, m.
    reach: f32,
    distance: [f32; 2],
    clipping: DepthClipping,
    /// Control steps between frames.
    period: u32,
    /// Fewest and most control steps by which a frame is late.
    delay: [u32; 2],
    drop: f32,
    /// Half widths of the noise, m and per m.
    noise: [f32; 2],
    bounds: OnceLock<HeightBounds>,
}

impl CameraSettings {
    fn new(camera: &RayCasterCameraConfig, step_dt: f64) -> Self {
        let pattern = &camera.pattern_cfg;
        let [width, height] = [pattern.width, pattern.height].map(|count| count as usize);
        let tangent = |angle: f64| {
            let (sin, cos) = Real::sin_cos(0.5 * angle);
            sin / cos
        };
        let tan_x = tangent(pattern.horizontal_fov);
        let tan_y = pattern.vertical_fov.map_or(tan_x * height as f64 / width as f64, tangent);
        let place = |index: usize, count: usize, tan: f64| tan * (1.0 - (2 * index + 1) as f64 / count as f64);
        let is_along_ray = camera.data_type == DepthData::DistanceToCamera;
        let pixel = |k: usize| [1.0, place(k % width, width, tan_x), place(k / width, height, tan_y)];
        let length = |k: usize| pixel(k).iter().map(|x| x * x).sum::<f64>().sqrt();
        let unit = |k: usize| if is_along_ray { length(k) } else { 1.0 };
        let pixels = 0..width * height;
        let farthest = pixels.clone().map(|k| length(k) / unit(k)).fold(0.0, f64::max);
        let steps = |time: f64| (time / step_dt).round().min(f64::from(u32::MAX)) as u32;
        Self {
            mount: camera.mount.clone(),
            directions: [0, 1, 2].map(|axis| pixels.clone().map(|k| (pixel(k)[axis] / unit(k)) as f32).collect()),
            reach: (camera.max_distance * farthest) as f32,
            distance: [camera.min_distance as f32, camera.max_distance as f32],
            clipping: camera.depth_clipping_behavior,
            period: steps(camera.update_period).max(1),
            delay: camera.delay.map(steps),
            drop: camera.drop_probability as f32,
            noise: [camera.noise as f32, camera.relative_noise as f32],
            bounds: OnceLock::new(),
        }
    }

    fn num_pixels(&self) -> usize {
        self.directions[0].len()
    }

    /// Position in the frame of the ground and axes of a robot's camera.
    #[inline(always)]
    fn pose(&self, robot: &SensedRobot) -> (Vec3<f32>, Mat3<f32>) {
        let Some(mount) = mount_of(robot.morphology, self.mount.as_ref()) else {
            return ([0.0; 3], quat_to_mat(&[1.0, 0.0, 0.0, 0.0]));
        };
        let link = link_of(robot.morphology, mount).unwrap_or(0);
        let (mut position, mut rotation) = link_pose(robot, link);
        let align = robot.morphology.align[link].transpose().to_cols_array_2d().map(|row| row.map(|x| x as f32));
        rotation = mul_mat(&rotation, &align);
        position = add(&position, &mul_vec(&rotation, &mount.pos.map(|x| x as f32)));
        rotation = mul_mat(&rotation, &quat_to_mat(&mount.rot.map(|x| x as f32)));
        let base = quat_to_mat(&robot.pose.rotation);
        let [x, y] = robot.origin.position;
        let at = add(&add(&robot.pose.position, &[x, y, 0.0]), &mul_vec(&base, &position));
        (at, mul_mat(&base, &rotation))
    }

    /// Writes the distances of a frame.
    #[inline(always)]
    fn render(&self, frame: &CameraFrame, robot: &SensedRobot, depth: &mut [f32]) {
        let ([least, most], rotation, position) = (self.distance, &frame.rotation, frame.position);
        let is_pose = position.iter().all(|x| x.abs() < 1e5) && rotation.as_flattened().iter().all(|x| x.abs() < 1.1);
        if !is_pose {
            depth.fill(0.0);
            return;
        }
        let [x, y, z] = &self.directions;
        if let Some(grid) = &robot.ground.terrain {
            let bounds = self.bounds.get_or_init(|| HeightBounds::new(grid));
            let (directions, reach) = ([&x[..], &y[..], &z[..]], self.reach);
            let rays = Rays { grid, bounds, position, rotation, directions, end: most, reach, distances: depth };
            cast_rays(robot.simd, rays);
        } else {
            let above = position[2] - robot.ground.height as f32;
            let r = &rotation[2];
            for (((x, y), z), depth) in x.iter().zip(y).zip(z).zip(&mut *depth) {
                *depth = plane(above, r[0] * x + (r[1] * y + r[2] * z), most);
            }
        }
        let mut rng = frame.noise.clone();
        for depth in depth.chunks_mut(LARGE_GROUP) {
            let mut noise = [0.0; LARGE_GROUP];
            if self.noise != [0.0; 2] {
                rng.add_uniform([-1.0, 1.0], &mut noise);
            }
            for (depth, noise) in depth.iter_mut().zip(noise) {
                let exact = *depth;
                let is_met = exact < most;
                let seen = exact + if is_met { noise * (self.noise[0] + self.noise[1] * exact) } else { 0.0 };
                *depth = match self.clipping {
                    DepthClipping::Max => seen.max(least).min(most),
                    DepthClipping::Zero if is_met && seen >= least && seen <= most => seen,
                    DepthClipping::Zero => 0.0,
                };
            }
        }
    }
}

/// Distance at which a ray that starts `above` a level plane meets it, at most `end`, m.
#[inline(always)]
fn plane(above: f32, z: f32, end: f32) -> f32 {
    let met = if z < -1e-9 { above / -z } else { end };
    if above <= 0.0 { 0.0 } else { met.min(end) }
}

/// Position and axes of a link about the base's origin, base axes.
#[inline(always)]
fn link_pose(robot: &SensedRobot, link: usize) -> (Vec3<f32>, Mat3<f32>) {
    let topology = &robot.morphology.topology;
    let mut chain = [0; LARGE_GROUP];
    let (mut at, mut count) = (link, 0);
    while at > 0 && count < chain.len() {
        chain[count] = at - 1;
        count += 1;
        at = topology.joints[at - 1].parent;
    }
    let (mut position, mut rotation) = ([0.0; 3], quat_to_mat(&[1.0, 0.0, 0.0, 0.0]));
    for &j in chain[..count].iter().rev() {
        let (joint, q) = (&topology.joints[j], robot.joints.position[j]);
        position = add(&position, &mul_vec(&rotation, &robot.body.joint_offset[j]));
        let axis = joint.axis.direction().map(|x| x as f32);
        match joint.motion {
            JointMotion::Revolute => {
                let (sin, cos) = Real::sin_cos(0.5 * q);
                rotation = mul_mat(&rotation, &quat_to_mat(&[cos, sin * axis[0], sin * axis[1], sin * axis[2]]));
            }
            JointMotion::Prismatic => position = add_scaled(&position, &mul_vec(&rotation, &axis), q),
        }
    }
    (position, rotation)
}

/// The term of the camera, under Isaac Lab's name.
pub(in crate::systems) fn register(registry: &mut Registry) {
    let spec = TermSpec::new(TermKind::Image, "m", "distance to the ground along each pixel of the depth camera");
    registry.sensor_observation("image", image_size, spec, RayCasterCamera::is_on, image);
}

/// One number per pixel.
fn image_size(task: &TaskConfig) -> Result<usize, (String, String)> {
    let camera = task.sensors.ray_caster_camera.as_ref();
    let pixels = camera.map(|camera| camera.pattern_cfg.num_pixels());
    pixels.ok_or_else(|| ("the task has no depth camera".into(), "add [sensors.ray_caster_camera]".into()))
}

/// Distance of each pixel, rows from top to bottom, each from left to right, m.
fn image(robot: &RobotView, out: &mut [f32]) {
    out.copy_from_slice(robot.image);
}
