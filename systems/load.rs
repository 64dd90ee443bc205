//! Reads the task and its robots.

use std::ops::Range;

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;

use super::terms::{BODY_VARIATION, CompiledTask, Registry};
use super::{Setup, SetupSet};
use crate::batch::Batch;
use crate::blocks::BlockSizes;
use crate::bounds::{BYTES_PER_ENV, check_num_envs, check_threads};
use crate::config::{ConfigError, JointPositionActionConfig, Library, LoadedRobot, LoadedTask, TaskConfig};
use crate::dynamics::ContactFriction;
use crate::dynamics::lanes::Simd;
use crate::engine::{Engines, history_length};
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::options::SimOptions;
use crate::robot::{Slot, summed_up};
use crate::workers::Workers;

/// Reads the task and its robots, and compiles the task's terms for them.
#[derive(Default)]
pub struct LoadPlugin;

impl Plugin for LoadPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(Setup, load.in_set(SetupSet::Load));
    }
}

/// The task and its robots as they were read, in the order of their blocks.
#[derive(Resource)]
pub(crate) struct Loaded {
    pub(crate) task: LoadedTask,
    pub(crate) robots: Vec<LoadedRobot>,
}

/// Instruction set of the simulation.
#[derive(Resource, Clone, Copy)]
pub(crate) struct InstructionSet(pub(crate) Simd);

/// Range of these envs within the whole batch.
#[derive(Resource, Clone, Debug, PartialEq, Eq)]
pub struct Share {
    /// Envs of the share in the whole batch. Row `i` is env `envs.start + i` there.
    pub envs: Range<usize>,
    /// Envs of the whole batch.
    pub num_envs: usize,
    /// Envs of each robot in the whole batch.
    pub counts: Vec<usize>,
    /// Place of each robot's first env here within that robot's block of the whole batch.
    pub first_places: Vec<usize>,
}

impl Share {
    /// The share `envs` of a batch with `totals` envs of each robot, and the number of its envs of
    /// each robot.
    fn new(envs: Range<usize>, totals: Vec<usize>) -> (Self, Vec<usize>) {
        let (mut first_places, mut counts, mut start) = (Vec::new(), Vec::new(), 0);
        for total in &totals {
            let end = start + total;
            let first = envs.start.clamp(start, end);
            first_places.push(first - start);
            counts.push(envs.end.clamp(first, end) - first);
            start = end;
        }
        (Self { envs, num_envs: start, counts: totals, first_places }, counts)
    }

    /// Places of the rows in their robots' blocks in the whole batch; `blocks` are the rows of each
    /// robot.
    pub fn places<'a>(&'a self, blocks: &'a BlockSizes) -> impl Iterator<Item = usize> + 'a {
        self.first_places.iter().zip(&blocks.0).flat_map(|(&first, &count)| first..first + count)
    }
}

/// Reads the task and robots of the options, unless they are loaded already.
fn load(world: &mut World) -> Result {
    Ok(load_into(world)?)
}

fn load_into(world: &mut World) -> Result<(), Error> {
    let options = world.resource::<SimOptions>().clone();
    if !world.contains_resource::<Loaded>() {
        let loaded = read(&options)?;
        world.insert_resource(loaded);
    }
    let Loaded { task, robots } = world.resource::<Loaded>();
    let morphologies = robots.iter().map(MorphologyModel::new).collect::<Result<Vec<_>, Error>>()?;
    for warning in morphologies.iter().flat_map(|m| summed_up(&m.model.warnings)) {
        tracing::warn!("{warning}");
    }
    let morphologies = driven(morphologies, &task.config)?;
    let mut morphologies = Morphologies::in_batch(morphologies, &slots(&options.slots)?);
    let engine = world.resource::<Engines>().of(&task.config)?;
    let compiled = CompiledTask::new(&task.config, &morphologies, world.resource::<Registry>())?;
    let name = &task.config.physics.engine;
    if !engine.varies_shapes() && task.config.events.get(BODY_VARIATION).is_some_and(|event| event.enabled) {
        let problem = format!("the engine {name} cannot change the shapes of links");
        let remedy = "set physics.engine = \"articulated\", or enabled = false";
        let element = format!("events.{BODY_VARIATION}");
        return Err(ConfigError::invalid(task.config.name.clone(), element, problem, remedy).into());
    }
    for morphology in &mut morphologies.0 {
        morphology.allow_action_delay(compiled.max_action_delay(morphology));
        let friction = compiled.contact_friction(morphology);
        if friction != ContactFriction::Sliding && !engine.has_spin_friction() {
            let problem = format!(
                "the engine {name} has no torsional and rolling friction, which {} has here",
                morphology.name()
            );
            let remedy = "set physics.engine = \"articulated\", or leave torsional_friction and rolling_friction of ground, \
                          robot_material and [surfaces] out";
            return Err(ConfigError::invalid(task.config.name.clone(), "physics.engine", problem, remedy).into());
        }
        morphology.allow_friction(friction);
    }
    let own = options.share.clone().unwrap_or(0..options.num_envs);
    let (share, counts) = Share::new(own, counts_of(robots, &task.config, options.num_envs)?);
    let num_envs = share.envs.len();
    let most = morphologies.0.iter().map(|morphology| bytes_per_env(morphology, &compiled)).max();
    check_num_envs(num_envs, BYTES_PER_ENV + most.unwrap_or(0))
        .map_err(|(problem, remedy)| Error::argument("num_envs", problem, remedy))?;
    let simd = Simd::choose(options.simd)?;
    let blocks = BlockSizes(counts);
    let pieces = engine.pieces(&blocks);
    world.insert_resource(Workers::for_pieces(options.threads, pieces, simd));
    world.insert_resource(Batch::new(num_envs, compiled.num_obs(), compiled.num_joints));
    world.insert_resource(options.autoreset);
    world.insert_resource(InstructionSet(simd));
    world.insert_resource(blocks);
    world.insert_resource(share);
    world.insert_resource(morphologies);
    world.insert_resource(compiled);
    Ok(())
}

/// Bytes of an env beyond [`BYTES_PER_ENV`] for its task and its robot's config: observations,
/// rays, late targets and the memory of actuator networks.
fn bytes_per_env(morphology: &MorphologyModel, task: &CompiledTask) -> usize {
    let sensors = &task.config.sensors;
    let rays: usize = sensors.height_scanner.as_ref().map_or(0, |scanner| scanner.counts().iter().product());
    let rays = rays + sensors.ray_caster_camera.as_ref().map_or(0, |camera| camera.pattern_cfg.num_pixels());
    let late = history_length(morphology.max_delay(), task.config.sim.decimation as usize);
    // a row of observations is held twice, and the last one of an episode once more
    let numbers = [task.num_obs(); 3].into_iter().chain([rays, late * morphology.topology.num_joints()]);
    let forces = morphology.feet.len() * task.config.sim.decimation as usize;
    numbers.chain([morphology.num_remembered(), forces]).fold(0, usize::saturating_add).saturating_mul(size_of::<f32>())
}

/// The morphologies with the joints that the task's policy drives.
///
/// # Errors
/// A robot of which it would drive none.
fn driven(mut morphologies: Vec<MorphologyModel>, task: &TaskConfig) -> Result<Vec<MorphologyModel>, ConfigError> {
    let action = &task.actions.joint_pos;
    for morphology in &mut morphologies {
        morphology.drive_only(|slot| action.drives(slot));
        if morphology.slots.is_empty() {
            let problem = format!("no pattern matches a joint of {}", morphology.name());
            let names: Vec<String> = morphology.roles.slots.iter().map(Slot::to_string).collect();
            let remedy = format!("name some of its joints ({}), or leave the robot out", names.join(", "));
            return Err(ConfigError::invalid(&task.name, JointPositionActionConfig::JOINT_NAMES, problem, remedy));
        }
    }
    Ok(morphologies)
}

/// The slots with these names.
fn slots(names: &[String]) -> Result<Vec<Slot>, Error> {
    let parse = |name: &String| {
        Slot::parse(name).ok_or_else(|| {
            let remedy = "pass names such as LF_HAA or L_KNEE: those of a policy's manifest";
            Error::argument("slots", format!("there is no slot `{name}`"), remedy)
        })
    };
    let slots = names.iter().map(parse).collect::<Result<Vec<Slot>, Error>>()?;
    match (0..slots.len()).find(|&i| slots[..i].contains(&slots[i])) {
        Some(i) => {
            let problem = format!("`{}` is listed twice, last at place {i}", names[i]);
            Err(Error::argument("slots", problem, "name each slot once"))
        }
        None => Ok(slots),
    }
}

fn read(options: &SimOptions) -> Result<Loaded, Error> {
    let library = Library::new(options.roots.clone());
    let task = library.task(&options.task, &options.overrides)?;
    let names = options.robots.clone().unwrap_or_else(|| task.config.robots.clone());
    check_arguments(&names, options)?;
    let robots = library.robots_in(&names, &task.config)?;
    check_distinct(&robots)?;
    Ok(Loaded { task, robots })
}

/// Envs per robot, in contiguous blocks: each robot has envs for its shares, rounded down, and the
/// first ones one more, until all envs have a robot.
pub fn distribute(num_envs: usize, shares: &[usize]) -> Vec<usize> {
    let total: usize = shares.iter().sum();
    let mut counts: Vec<usize> = shares.iter().map(|share| num_envs * share / total).collect();
    let left = num_envs - counts.iter().sum::<usize>();
    counts.iter_mut().take(left).for_each(|count| *count += 1);
    counts
}

/// Envs of each robot in the whole batch.
fn counts_of(robots: &[LoadedRobot], task: &TaskConfig, num_envs: usize) -> Result<Vec<usize>, Error> {
    let shares = robots.iter().map(|robot| task.env_shares.get(&robot.config.name).map_or(1, |&share| share as usize));
    let counts = distribute(num_envs, &shares.collect::<Vec<_>>());
    match counts.iter().zip(robots).find(|(count, _)| **count == 0) {
        Some((_, robot)) => Err(Error::argument(
            "num_envs",
            format!("none of {num_envs} envs is left for {} with the task's env_shares", robot.config.name),
            "ask for more envs, or even out the shares".to_owned(),
        )),
        None => Ok(counts),
    }
}

fn check_arguments(robots: &[String], options: &SimOptions) -> Result<(), Error> {
    let SimOptions { num_envs, threads, .. } = *options;
    if robots.is_empty() {
        return Err(Error::argument("robots", "the list is empty", "name at least one robot"));
    }
    if robots.len() > num_envs {
        return Err(Error::argument(
            "num_envs",
            format!("{num_envs} envs for {} robots", robots.len()),
            format!("ask for at least {} envs, or for fewer robots", robots.len()),
        ));
    }
    if let Some(Range { start, end }) = options.share
        && !(start < end && end <= num_envs)
    {
        let problem = format!("envs {start} to {end} of {num_envs}");
        return Err(Error::argument("share", problem, format!("ask for some envs between 0 and {num_envs}")));
    }
    check_num_envs(num_envs, BYTES_PER_ENV)
        .map_err(|(problem, remedy)| Error::argument("num_envs", problem, remedy))?;
    check_threads(threads).map_err(|(problem, remedy)| Error::argument("threads", problem, remedy))
}

/// A name and a path may mean the same robot: the name in its config decides.
fn check_distinct(robots: &[LoadedRobot]) -> Result<(), Error> {
    let name = |i: usize| robots[i].config.name.as_str();
    match (0..robots.len()).find(|&i| (0..i).any(|j| name(j) == name(i))) {
        Some(i) => Err(Error::argument(
            "robots",
            format!("`{}` is listed twice, last at place {i}", name(i)),
            "name each robot once",
        )),
        None => Ok(()),
    }
}
