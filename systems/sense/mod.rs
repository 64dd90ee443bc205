//! Sensors read the state that the physics left.
//!
//! A sensor is a component of a separate entity, one per env, and an implementation of [`Sensor`];
//! one line, [`add_sensor`], registers it. It is then spawned, measured, cleared at the beginning
//! of an episode and saved in snapshots. [`BlockMarker::is_on`] says which morphologies have it.

mod contact;
mod feet;
mod height_scan;
mod imu;
pub(super) mod joint_descriptors;
pub(super) mod ray_caster_camera;
pub(super) mod scaled_descriptors;

use bevy_app::{App, Plugin};
use bevy_ecs::component::Mutable;
use bevy_ecs::prelude::*;
use bevy_ecs::system::SystemParam;

use super::spawn::spawn_robots;
use super::terms::CompiledTask;
use super::{ControlStep, PipelineSet, ResetSet, Setup, SetupSet, faults, for_both, keep_blocks, saved};
use crate::blocks::{Block, BlockMarker, Blocks};
use crate::components::{
    BasePose, BaseVelocity, Body, ContactForces, ContactSensor, Env, EnvId, EnvOrigin, EnvRng, Episode, HeightScan,
    Imu, JointDescriptors, JointState, Morphology, MountedOn, RayCasterCamera, Robot, Stance,
};
use crate::config::TaskConfig;
use crate::dynamics::Parameters;
use crate::dynamics::lanes::{Kernel, SimdToken};
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::workers::Workers;
use crate::world::Ground;

pub use height_scan::ScanRays;

/// A sensor's view of the robot that it is mounted on.
pub struct SensedRobot<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Place of the env on the ground.
    pub origin: &'a EnvOrigin,
    /// Pose of the base.
    pub pose: &'a BasePose,
    /// Velocity of the base.
    pub velocity: &'a BaseVelocity,
    /// Joint positions and velocities, physical order.
    pub joints: &'a JointState,
    /// Contact forces of the last control step.
    pub forces: &'a ContactForces,
    /// The robot's own numbers.
    pub body: &'a Parameters<f32>,
    /// Default pose and action scale of this body.
    pub stance: &'a Stance,
    /// Ground that the robots stand on.
    pub ground: &'a Ground,
    /// The env's random numbers. A sensor that draws from them makes a copy.
    pub rng: &'a EnvRng,
    /// Length of a physics step, s.
    pub dt: f32,
    /// Instruction set for kernels in lanes.
    pub simd: SimdToken,
}

/// A sensor: the component that holds its reading.
///
/// Functions that are `#[inline(always)]` are compiled for each instruction set.
pub trait Sensor: saved::Saved + BlockMarker + Component<Mutability = Mutable> {
    /// Data that all sensors of a kind share, such as the directions of rays.
    type Settings: Send + Sync + 'static;

    /// Whether it reads the terrain: robots on the same tile are then measured in turn, while its
    /// heights are in the cache.
    const READS_TERRAIN: bool = false;
    /// Whether snapshots hold it. A sensor that follows from the robot's state alone is measured
    /// after a restore instead.
    const IS_SAVED: bool = true;
    /// Whether it measures after a restore, with [`renew`](Self::renew). Default: where it is not
    /// saved.
    const IS_RENEWED: bool = !Self::IS_SAVED;

    /// The settings in a task; `None` where the task has no such sensor.
    fn settings(task: &TaskConfig) -> Option<Self::Settings>;
    /// A sensor on a robot of this kind.
    fn new(settings: &Self::Settings, morphology: &MorphologyModel) -> Self;
    /// Measures, after the physics of a control step.
    fn measure(&mut self, settings: &Self::Settings, robot: &SensedRobot);
    /// Begins a new episode. Default: measures.
    #[inline(always)]
    fn begin(&mut self, settings: &Self::Settings, robot: &SensedRobot) {
        self.measure(settings, robot);
    }
    /// Measures after a restore of a snapshot, see [`IS_RENEWED`](Self::IS_RENEWED). Default:
    /// measures.
    #[inline(always)]
    fn renew(&mut self, settings: &Self::Settings, robot: &SensedRobot) {
        self.measure(settings, robot);
    }
}

/// Settings of the sensors of a kind, where the task has them.
#[derive(Resource)]
pub struct SensorSettings<S: Sensor>(pub S::Settings);

/// Adds a kind of sensor, in a plugin's `build`.
pub fn add_sensor<S: Sensor>(app: &mut App) {
    let exists = resource_exists::<SensorSettings<S>>;
    app.add_systems(Setup, spawn::<S>.after(spawn_robots).in_set(SetupSet::Spawn).ambiguous_with_all());
    app.add_systems(ControlStep, measure_all::<S>.run_if(exists).in_set(PipelineSet::Sense));
    for_both(app, || begin_episodes::<S>.run_if(resource_exists::<SensorSettings<S>>).in_set(ResetSet::Sensors));
    keep_blocks::<S>(app);
    if S::IS_SAVED {
        saved::save_component_of::<S, S>(app);
    }
    if S::IS_RENEWED {
        saved::measure_after_restore(app, measure_anew::<S>);
    }
}

/// Spawns a sensor on every robot of the morphologies that have it, in the order of the env ids.
fn spawn<S: Sensor>(world: &mut World) {
    let task = &world.resource::<CompiledTask>().config;
    let Some(settings) = S::settings(task) else {
        return;
    };
    let morphologies = world.resource::<Morphologies>();
    let is_on: Vec<bool> = morphologies.0.iter().map(|morphology| S::is_on(morphology, task)).collect();
    let mut robots: Vec<(EnvId, Morphology, Entity)> = world
        .query_filtered::<(&EnvId, &Morphology, Entity), With<Robot>>()
        .iter(world)
        .map(|(env, tag, robot)| (*env, *tag, robot))
        .filter(|(_, tag, _)| is_on[usize::from(tag.0)])
        .collect();
    robots.sort_unstable();
    for (env, tag, robot) in robots {
        let sensor = S::new(&settings, world.resource::<Morphologies>().get(tag));
        world.spawn((env, tag, MountedOn(robot), sensor));
    }
    world.insert_resource(SensorSettings::<S>(settings));
}

/// Components of robots that sensors read.
type SensedColumns = (
    &'static BasePose,
    &'static BaseVelocity,
    &'static JointState,
    &'static ContactForces,
    &'static Body,
    &'static Stance,
);

/// System parameter: the data for measuring on all robots.
#[derive(SystemParam)]
struct Sensing<'w, 's, S: Sensor> {
    workers: Res<'w, Workers>,
    morphologies: Res<'w, Morphologies>,
    task: Res<'w, CompiledTask>,
    ground: Res<'w, Ground>,
    settings: Res<'w, SensorSettings<S>>,
    robots: Blocks<'w, 's, SensedColumns, Robot>,
    envs: Blocks<'w, 's, (&'static EnvOrigin, &'static Episode, &'static EnvRng), Env>,
    sensors: Blocks<'w, 's, &'static mut S, S>,
}

impl<S: Sensor> Sensing<'_, '_, S> {
    /// Measures on all robots, or begins the episodes of those that have just been reset.
    fn run(&mut self, occasion: Occasion) -> Result<(), Error> {
        let envs = self.envs.read()?;
        let is_any_fresh = || envs.iter().any(|block| block.rows.1.iter().any(|episode| episode.fresh));
        if occasion == Occasion::Begin && !is_any_fresh() {
            return Ok(());
        }
        let (morphologies, dt) = (&self.morphologies, self.task.config.sim.dt);
        let (ground, settings, simd) = (&*self.ground, &self.settings.0, self.workers.simd());
        let blocks = self.robots.read()?.zip(envs).zip(self.sensors.write_some()?);
        blocks.vectorize_chunks(&self.workers, |Block { morphology, rows, .. }| {
            let common = Common { morphology: morphologies.get(morphology), ground, settings, dt, simd, occasion };
            SensorRows { common, rows }
        });
        Ok(())
    }
}

/// Measures on all robots.
fn measure_all<S: Sensor>(mut sensing: Sensing<S>) -> Result {
    Ok(sensing.run(Occasion::Measure)?)
}

fn renew_all<S: Sensor>(mut sensing: Sensing<S>) -> Result {
    Ok(sensing.run(Occasion::Renew)?)
}

/// Measures on all robots after a restore, where the task has such sensors.
fn measure_anew<S: Sensor>(world: &mut World) -> Result<(), Error> {
    if world.contains_resource::<SensorSettings<S>>() {
        faults::outcome::<(), ()>(world.run_system_cached(renew_all::<S>))?;
    }
    Ok(())
}

/// Measures the feet's heights, the IMUs and the height scans again, as a control step leaves them.
/// All follow from the robots' states alone.
pub(super) fn measure_states(world: &mut World) -> Result<(), Error> {
    faults::outcome::<(), ()>(world.run_system_cached(feet::measure_feet))?;
    measure_anew::<Imu>(world)?;
    measure_anew::<HeightScan>(world)
}

/// Whether all descriptions of joints are those of the present bodies: a body that a caller changes
/// in the middle of an episode is described when the next one begins.
pub(super) fn describe_present_bodies(world: &mut World) -> Result<bool, Error> {
    let mut all = world.query::<(Entity, &JointDescriptors)>();
    let before: Vec<(Entity, JointDescriptors)> =
        all.iter(world).map(|(entity, numbers)| (entity, numbers.clone())).collect();
    measure_anew::<JointDescriptors>(world)?;
    let mut are_same = true;
    for (entity, numbers) in before {
        if let Some(mut now) = world.get_mut::<JointDescriptors>(entity)
            && now.numbers.iter().zip(&numbers.numbers).any(|(now, before)| now.to_bits() != before.to_bits())
        {
            are_same = false;
            *now = numbers;
        }
    }
    Ok(are_same)
}

/// Begins the episodes of the robots that have just been reset.
fn begin_episodes<S: Sensor>(mut sensing: Sensing<S>) -> Result {
    Ok(sensing.run(Occasion::Begin)?)
}

/// Reason for reading a sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Occasion {
    /// The physics of a control step is done.
    Measure,
    /// An episode has just begun.
    Begin,
    /// A snapshot was restored.
    Renew,
}

/// Data that all rows share.
struct Common<'a, S: Sensor> {
    morphology: &'a MorphologyModel,
    ground: &'a Ground,
    settings: &'a S::Settings,
    dt: f64,
    simd: SimdToken,
    occasion: Occasion,
}

impl<S: Sensor> Clone for Common<'_, S> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Sensor> Copy for Common<'_, S> {}

type Columns<'a, S> = (
    (
        (&'a [BasePose], &'a [BaseVelocity], &'a [JointState], &'a [ContactForces], &'a [Body], &'a [Stance]),
        (&'a [EnvOrigin], &'a [Episode], &'a [EnvRng]),
    ),
    &'a mut [S],
);

struct SensorRows<'a, S: Sensor> {
    common: Common<'a, S>,
    rows: Columns<'a, S>,
}

impl<S: Sensor> Kernel<f32> for SensorRows<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { common: Common { morphology, ground, settings, dt, simd, occasion }, rows } = self;
        let (((poses, velocities, joints, forces, bodies, stances), (origins, episodes, rngs)), sensors) = rows;
        let order = if S::READS_TERRAIN { ground.order_of_tiles(origins) } else { None };
        for k in 0..poses.len() {
            let row = order.as_ref().map_or(k, |order| order[k] as usize);
            let robot = SensedRobot {
                morphology,
                origin: &origins[row],
                pose: &poses[row],
                velocity: &velocities[row],
                joints: &joints[row],
                forces: &forces[row],
                body: &bodies[row].0,
                stance: &stances[row],
                ground,
                rng: &rngs[row],
                dt: dt as f32,
                simd,
            };
            match occasion {
                Occasion::Measure => sensors[row].measure(settings, &robot),
                Occasion::Begin if episodes[row].fresh => sensors[row].begin(settings, &robot),
                Occasion::Begin => {}
                Occasion::Renew => sensors[row].renew(settings, &robot),
            }
        }
    }
}

/// Refuses cameras on links that are not there.
fn check_cameras(task: Res<CompiledTask>, morphologies: Res<Morphologies>) -> Result {
    Ok(ray_caster_camera::check(&task.config, &morphologies.0)?)
}

/// Adds the built-in sensors.
#[derive(Default)]
pub struct SensePlugin;

impl Plugin for SensePlugin {
    fn build(&self, app: &mut App) {
        add_sensor::<ContactSensor>(app);
        add_sensor::<Imu>(app);
        add_sensor::<HeightScan>(app);
        add_sensor::<RayCasterCamera>(app);
        add_sensor::<JointDescriptors>(app);
        app.add_systems(Setup, check_cameras.in_set(SetupSet::Spawn).ambiguous_with_all());
        app.add_systems(ControlStep, feet::measure_feet.in_set(PipelineSet::Sense));
    }
}
