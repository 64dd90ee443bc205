//! Whole control steps on a device: the columns of all envs stay there between steps, and only
//! actions go there and observations, rewards and ends come back. Components are up to date again
//! after [`leave_device`].
//!
//! A step that flows has its actions on the device, and leaves observations there. The host begins
//! it and goes on; what a step tells of ended episodes is read some steps later.

use std::sync::OnceLock;

use bevy_ecs::prelude::*;
use smallvec::SmallVec;

use super::physics::{PhysicsEngine, upload_bodies};
use super::sense::{describe_present_bodies, measure_states};
use super::startup::{changing_numbers, differs_as_resets_do, set_changing_numbers};
use super::terms::{CompiledTask, Registry};
use super::views::ViewParam;
use super::{BrokenStates, ControlStep, Logs, PolypodPlugins, ResetEnvs, faults};
use crate::batch::Batch;
use crate::blocks::{Block, BlockSizes, Blocks};
use crate::components::{
    Action, Body, Command, CommandNumbers, ContactForces, ContactSensor, CurriculumProgress, Env, EnvId, EnvOrigin,
    EnvRng, Episode, EpisodeSums, EventTimers, JointTargets, Robot, Stance, StartupBody,
};
use crate::engine::device::{
    Column, Device, DeviceError, DeviceRows, Ended, EnvHost, Flow, RowSizes, RowsOf, SLOTS, TaskTables, Word, flags,
};
use crate::engine::{BrokenRobot, DivergenceRecord, RobotColumns, RobotSlices, WholeSteps};
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::options::Autoreset;
use crate::workers::Workers;
use crate::world::Ground;

/// Control steps that the device has made alone, and what the host knows of them.
#[derive(Resource, Default)]
pub(crate) struct OnDevice {
    /// Number of steps since the components were up to date.
    steps: u64,
    /// Steps among these whose ended episodes the host has counted; the others flow.
    told: u64,
    /// Env with an action that is not finite or beyond the limit.
    refused: Option<usize>,
    /// Control steps of each env's simulation at that moment.
    before: Vec<u64>,
    /// Velocity commands after the last control step, `[num_envs, 3]`.
    pub(crate) commands: Vec<f32>,
}

impl OnDevice {
    /// The place of a step among those that flow.
    fn slot(step: u64) -> usize {
        (step % SLOTS as u64) as usize
    }
}

fn lost(error: &DeviceError) -> Error {
    let problem = format!("the card failed in the middle of a simulation: {error}");
    Error::argument("physics.engine", problem, "make the simulation anew, or restore a snapshot")
}

/// Why the device does not make the whole control step: what of the simulation has no form there.
pub(crate) fn lacks_on_device(world: &mut World) -> Option<String> {
    let whole = world.get_resource_mut::<PhysicsEngine>().and_then(|mut engine| engine.0.whole_steps().map(drop));
    if whole.is_none() {
        return Some("the engine has no device to itself".into());
    }
    if !has_own_systems_alone(world) {
        return Some("systems of a plugin".into());
    }
    tables(world).err()
}

/// Whether the engine could share the robots, so that somebody must time what is faster.
pub(crate) fn may_share_on_device(world: &mut World) -> bool {
    let mut engine = world.get_resource_mut::<PhysicsEngine>();
    engine.as_mut().and_then(|engine| engine.0.whole_steps()).is_some_and(|whole| whole.may_share())
}

/// Lets an engine that may share the robots do so.
pub(crate) fn share_with_device(world: &mut World, share: bool) {
    if let Some(whole) = world.get_resource_mut::<PhysicsEngine>().as_mut().and_then(|engine| engine.0.whole_steps()) {
        whole.share(share);
    }
}

/// Whether the schedules hold the systems of [`PolypodPlugins`] and no others.
fn has_own_systems_alone(world: &World) -> bool {
    static OWN: OnceLock<Option<[usize; 2]>> = OnceLock::new();
    let count = |world: &World| {
        let schedules = world.get_resource::<Schedules>()?;
        Some([schedules.get(ControlStep)?.systems_len(), schedules.get(ResetEnvs)?.systems_len()])
    };
    let own = OWN.get_or_init(|| {
        let mut plain = bevy_app::App::empty();
        plain.add_plugins(PolypodPlugins);
        count(plain.world())
    });
    count(world) == *own
}

/// The task's tables for each morphology that has robots.
fn tables(world: &World) -> Result<Vec<TaskTables>, String> {
    let (task, registry) = (world.resource::<CompiledTask>(), world.get_resource::<Registry>());
    let registry = registry.ok_or("terms that are unknown")?;
    let (ground, autoreset) = (world.resource::<Ground>(), *world.resource::<Autoreset>());
    let num_actions = world.resource::<Batch>().num_actions;
    let robots = world.resource::<Morphologies>().0.iter().zip(&world.resource::<BlockSizes>().0).enumerate();
    let robots = robots.filter(|(_, (_, count))| **count > 0);
    robots.map(|(index, (robot, _))| task.on_device(registry, (index, robot), ground, autoreset, num_actions)).collect()
}

/// Tables that [`enter`] takes over, and the numbers of each env's body that observations show.
#[derive(Resource)]
struct NewTables(Vec<TaskTables>, Vec<Vec<f32>>);

/// Writes the numbers of bodies.
fn describe_bodies(
    task: Res<CompiledTask>,
    registry: Res<Registry>,
    workers: Res<Workers>,
    views: ViewParam,
    mut new: ResMut<NewTables>,
) -> Result {
    let mut envs = vec![Vec::new(); views.views(task.step_dt)?.into_iter().map(|block| block.envs.len()).sum()];
    let blocks = views.views(task.step_dt)?.zip_envs(&mut envs[..]);
    blocks.for_each_chunk(&workers, |Block { rows: (views, out), .. }| {
        for (row, out) in out.iter_mut().enumerate() {
            task.write_kept(&registry, &views.get(row), out);
        }
    });
    new.1 = envs;
    Ok(())
}

/// Hands all envs over to the device. Returns whether it could: see [`lacks_on_device`].
///
/// # Errors
/// A device that is lost; rows that are no blocks.
pub(crate) fn enter_device(world: &mut World) -> Result<bool, Error> {
    if lacks_on_device(world).is_some() {
        return Ok(false);
    }
    let Ok(tables) = tables(world) else { return Ok(false) };
    if !describe_present_bodies(world)? {
        return Ok(false);
    }
    if !are_bodies_of_resets(world) {
        return Ok(false);
    }
    faults::outcome::<(), ()>(world.run_system_cached(upload_bodies))?;
    world.insert_resource(NewTables(tables, Vec::new()));
    world.init_resource::<OnDevice>();
    faults::outcome::<(), ()>(world.run_system_cached(describe_bodies))?;
    let entered = faults::outcome(world.run_system_cached(enter));
    world.remove_resource::<NewTables>();
    entered
}

/// Whether all bodies are such as the device's resets make them: a caller may have changed more.
fn are_bodies_of_resets(world: &mut World) -> bool {
    let changes = !world.resource::<CompiledTask>().reset_body_events.is_empty();
    let mut robots = world.query_filtered::<(&Body, &Stance, &StartupBody), With<Robot>>();
    !changes || robots.iter(world).all(|(body, stance, startup)| differs_as_resets_do(&body.0, stance, startup))
}

/// Components of envs that the device keeps.
type EnvColumns = (
    &'static Episode,
    &'static EnvRng,
    (&'static Command, &'static CommandNumbers),
    &'static EventTimers,
    &'static EpisodeSums,
    &'static CurriculumProgress,
    &'static EnvOrigin,
);

fn enter(
    workers: Res<Workers>,
    new: Res<NewTables>,
    batch: Res<Batch>,
    mut known: ResMut<OnDevice>,
    mut engine: ResMut<PhysicsEngine>,
    mut robots: Blocks<RobotColumns, Robot>,
    more: Blocks<(&'static Action, &'static Stance, &'static Body, &'static StartupBody), Robot>,
    sensors: Blocks<&'static ContactSensor, ContactSensor>,
    envs: Blocks<EnvColumns, Env>,
) -> Result<bool> {
    let Some(whole) = engine.0.whole_steps() else { return Ok(false) };
    let envs = envs.read()?;
    let fresh: Vec<Vec<bool>> =
        robots.read()?.into_iter().map(|block| block.rows.3.iter().map(|targets| targets.fresh).collect()).collect();
    let rows = robots.write()?.zip(envs.clone()).map(|_, (robots, envs)| RobotSlices::new(robots, envs.6)).collect();
    let sizes = RowSizes { envs: batch.num_envs, actions: batch.num_actions, observations: batch.num_obs };
    if !whole.enter(&workers, rows, new.0.clone(), sizes).map_err(|error| lost(&error))? {
        return Ok(false);
    }
    let device = whole.device().map_err(|error| lost(&error))?;
    show(device, &batch).map_err(|error| lost(&error))?;
    (known.steps, known.told, known.refused) = (0, 0, None);
    known.before.clear();
    known.commands.clear();
    let blocks = more.read()?.zip(sensors.read()?).zip(envs).into_iter().zip(whole.hosts()).zip(fresh);
    let mut tasks = Vec::new();
    for ((Block { envs, rows: (robots, of_envs), .. }, host), fresh) in blocks {
        known.before.extend(of_envs.5.iter().map(|progress| progress.steps));
        known.commands.extend(of_envs.2.0.iter().flat_map(|command| command.velocity));
        tasks.push((robots, of_envs, host, fresh, &new.1[envs]));
    }
    workers.for_each(tasks.into_iter(), |(robots, of_envs, mut host, fresh, kept)| {
        let ((actions, stances, bodies, startups), sensors) = robots;
        let (episodes, rngs, (commands, others), timers, sums, progress, origins) = of_envs;
        for env in 0..actions.len() {
            let rows = &mut host.rows;
            rows.write(env, Column::Action, &actions[env].current);
            rows.write(env, Column::Previous, &actions[env].previous);
            let command = &commands[env];
            rows.write(env, Column::Command, command.velocity.iter().chain([&command.heading, &command.time_left]));
            rows.write(env, Column::Timer, &timers[env].0);
            let sum = &sums[env];
            rows.write(env, Column::Sum, &sum.terms);
            rows.write(env, Column::Total, &totals(sum));
            let contact = &sensors[env];
            let times = [&contact.contact_time, &contact.air_time, &contact.last_contact_time, &contact.last_air_time];
            rows.write(env, Column::Time, times.into_iter().flatten());
            let stance = &stances[env];
            rows.write(env, Column::Default, stance.default_position.iter());
            rows.write(env, Column::Stance, &[stance.action_scale, stance.spawn_height, bodies[env].0.total_mass()]);
            rows.write(env, Column::Origin, &origins[env].position);
            rows.write(env, Column::Kept, &kept[env]);
            rows.write(env, Column::Progress, &[progress[env].widening, progress[env].tracking]);
            if let Some(startup) = &startups[env].0 {
                rows.write(env, Column::Startup, &changing_numbers(&startup.0));
                rows.write(env, Column::Body, &changing_numbers(&bodies[env].0));
            }
            rows.write_wide(env, Word::Clock, progress[env].steps);
            rows.write(env, Column::Numbers, &others[env].numbers);
            rows.write(env, Column::Wait, &others[env].time_left);
            rows.write_word(env, Word::Pinned, others[env].pinned);
            let (state, increment) = rngs[env].parts();
            rows.write_wide(env, Word::State, state);
            rows.write_wide(env, Word::Increment, increment);
            let episode = &episodes[env];
            rows.write_word(env, Word::Length, episode.length);
            rows.write_word(env, Word::Lived, episode.lived);
            rows.write_word(env, Word::Causes, episode.causes);
            rows.write_word(env, Word::Steps, sum.steps);
            rows.write_word(env, Word::Flags, flags_of(episode, command, fresh[env]));
            rows.write_word(env, Word::TileRow, origins[env].terrain_level);
            rows.write_word(env, Word::TileColumn, origins[env].terrain_column);
        }
    });
    whole.upload().map_err(|error| lost(&error))?;
    Ok(true)
}

/// Copies the outcome of the last control step to the device.
fn show(device: &dyn Device, batch: &Batch) -> Result<(), DeviceError> {
    device.write_rows(RowsOf::Actions, &batch.actions)?;
    device.write_rows(RowsOf::Observations, &batch.observations)?;
    device.write_rows(RowsOf::Finals, &batch.final_observations)?;
    device.write_rows(RowsOf::Rewards, &batch.rewards)?;
    let ends: Vec<u8> = batch.terminated.iter().chain(&batch.truncated).map(|&ended| u8::from(ended)).collect();
    device.write_ends(&ends)
}

fn totals(sums: &EpisodeSums) -> [f32; 6] {
    let EpisodeSums { reward, error_vel_xy, error_vel_yaw, command_xy, command_yaw, speed_xy, .. } = *sums;
    [reward, error_vel_xy, error_vel_yaw, command_xy, command_yaw, speed_xy]
}

fn set_totals(sums: &mut EpisodeSums, totals: [f32; 6]) {
    [sums.reward, sums.error_vel_xy, sums.error_vel_yaw, sums.command_xy, sums.command_yaw, sums.speed_xy] = totals;
}

fn flags_of(episode: &Episode, command: &Command, fresh_targets: bool) -> u32 {
    let bits = [
        (episode.terminated, flags::TERMINATED),
        (episode.truncated, flags::TRUNCATED),
        (episode.needs_reset, flags::NEEDS_RESET),
        (episode.invalid, flags::INVALID),
        (episode.logged, flags::LOGGED),
        (episode.fresh, flags::FRESH),
        (fresh_targets, flags::FRESH_TARGETS),
        (command.holds_heading, flags::HOLDS_HEADING),
        (command.standing, flags::STANDING),
        (command.pinned, flags::PINNED),
    ];
    bits.into_iter().filter(|(is_set, _)| *is_set).fold(0, |all, (_, bit)| all | bit)
}

/// Calls `f` with the device, the batch and what is known of the steps.
fn with_device<T>(
    world: &mut World,
    f: impl FnOnce(&mut World, &mut dyn WholeSteps, &mut Batch, &mut OnDevice) -> Result<T, DeviceError>,
) -> Result<T, Error> {
    world.resource_scope(|world, mut engine: Mut<PhysicsEngine>| {
        world.resource_scope(|world, mut batch: Mut<Batch>| {
            world.resource_scope(|world, mut known: Mut<OnDevice>| {
                let whole = engine.0.whole_steps();
                let whole = whole.ok_or_else(|| Error::argument("physics.engine", "it has no device", "use cuda"))?;
                f(world, whole, &mut batch, &mut known).map_err(|error| lost(&error))
            })
        })
    })
}

/// One control step of all envs on the device, with the actions of the batch. No steps flow.
///
/// # Errors
/// A device that is lost.
pub(crate) fn step_on_device(world: &mut World) -> Result<(), Error> {
    with_device(world, |world, whole, batch, known| {
        step(world, whole, batch, known)?;
        known.steps += 1;
        tell(world, whole, batch, known, 0)
    })
}

/// Begins a control step of all envs with the actions that are given on the device. Returns an env
/// whose actions were refused in an earlier step.
///
/// # Errors
/// A device that is lost.
pub(crate) fn flow_on_device(world: &mut World, stream: u64) -> Result<Option<usize>, Error> {
    with_device(world, |world, whole, batch, known| {
        if known.steps - known.told == SLOTS as u64 {
            wait_for_one(world, whole, batch, known)?;
        }
        let watched: Vec<bool> = watched_blocks(world).into_iter().map(|(_, _, watched)| watched).collect();
        whole.step(&watched, Some(Flow { slot: OnDevice::slot(known.steps), stream }))?;
        known.steps += 1;
        Ok(known.refused.take())
    })
}

/// Waits for all steps that flow, and reads what they tell. Returns an env whose actions were
/// refused since the last call.
///
/// # Errors
/// A device that is lost.
pub(crate) fn settle_device(world: &mut World) -> Result<Option<usize>, Error> {
    with_device(world, |world, whole, batch, known| {
        while known.told < known.steps {
            wait_for_one(world, whole, batch, known)?;
        }
        Ok(known.refused.take())
    })
}

/// Brings the batch up to date, after steps that flowed.
///
/// # Errors
/// A device that is lost.
pub(crate) fn fetch_from_device(world: &mut World) -> Result<Option<usize>, Error> {
    let refused = settle_device(world)?;
    with_device(world, |world, whole, batch, known| {
        let device = whole.device()?;
        device.read_rows(RowsOf::Actions, &mut batch.actions)?;
        device.read_rows(RowsOf::Observations, &mut batch.observations)?;
        device.read_rows(RowsOf::Finals, &mut batch.final_observations)?;
        device.read_rows(RowsOf::Rewards, &mut batch.rewards)?;
        device.read_rows(RowsOf::Commands, &mut known.commands)?;
        mask_actions(world, batch);
        Ok(refused)
    })
}

/// The arrays of all envs on the device; `None` before it has made any.
pub(crate) fn device_rows(world: &mut World) -> Option<DeviceRows> {
    world.get_resource_mut::<PhysicsEngine>()?.0.whole_steps()?.device().ok()?.rows()
}

/// Reads the actions that are given on the device, for a step that the host makes.
///
/// # Errors
/// A device that is lost.
pub(crate) fn given_actions(world: &mut World, stream: u64) -> Result<Vec<f32>, Error> {
    with_device(world, |_, whole, batch, _| {
        let mut actions = vec![0.0; batch.actions.len()];
        let device = whole.device()?;
        device.wait_for_caller(stream)?;
        device.read_rows(RowsOf::Given, &mut actions)?;
        Ok(actions)
    })
}

/// Shows the outcome of a step of the host on the device.
///
/// # Errors
/// A device that is lost.
pub(crate) fn show_on_device(world: &mut World) -> Result<(), Error> {
    with_device(world, |_, whole, batch, _| show(whole.device()?, batch))
}

/// Waits for the oldest step that flows, and reads what it tells.
fn wait_for_one(
    world: &mut World,
    whole: &mut dyn WholeSteps,
    batch: &mut Batch,
    known: &mut OnDevice,
) -> Result<(), DeviceError> {
    let slot = OnDevice::slot(known.told);
    whole.device()?.wait(slot)?;
    tell(world, whole, batch, known, slot)
}

/// Morphology and envs of each block, and whether its broken states are watched.
fn watched_blocks(world: &World) -> Vec<(usize, std::ops::Range<usize>, bool)> {
    let watched = world.resource::<BrokenStates>().watched();
    let blocks = world.resource::<BlockSizes>().iter().filter(|(_, envs)| !envs.is_empty());
    let of = |(morphology, envs): (crate::components::Morphology, _)| {
        let index = usize::from(morphology.0);
        (index, envs, watched[index])
    };
    blocks.map(of).collect()
}

/// Reads what a step tells: how episodes have ended, for the batch and the logs, broken states and
/// refused actions.
fn tell(
    world: &mut World,
    whole: &mut dyn WholeSteps,
    batch: &mut Batch,
    known: &mut OnDevice,
    slot: usize,
) -> Result<(), DeviceError> {
    known.told += 1;
    let blocks = watched_blocks(world);
    let (mut ended, mut broken) = (Vec::new(), Vec::new());
    for (block, (told, (morphology, envs, watched))) in whole.told(slot).into_iter().zip(&blocks).enumerate() {
        let mut first_broken = None;
        for ((row, flags), env) in told.flags.iter().enumerate().zip(envs.clone()) {
            batch.terminated[env] = flags & flags::TERMINATED != 0;
            batch.truncated[env] = flags & flags::TRUNCATED != 0;
            batch.has_final[env] = flags & flags::HAS_FINAL != 0;
            if flags & flags::LOGGED != 0 {
                ended.push((*morphology, env, told.ended(row)));
            }
            if flags & flags::BROKEN != 0 {
                first_broken.get_or_insert(row);
            }
            if flags & flags::BAD_ACTION != 0 {
                known.refused.get_or_insert(env);
            }
        }
        broken.extend(first_broken.filter(|_| *watched).map(|robot| (block, *morphology, robot)));
    }
    let mut found = Vec::new();
    for (block, morphology, robot) in broken {
        if let Some(BrokenRobot { record, length, body: numbers }) = whole.record(block, robot)?
            && let Some(mut body) = body_of(world, record.env)
        {
            if let Some(numbers) = numbers {
                set_changing_numbers(&mut body.0, &numbers);
            }
            found.push((DivergenceRecord { morphology, ..record }, length, body));
        }
    }
    let limits = world.resource::<CompiledTask>().limits;
    world.resource_mut::<BrokenStates>().count_step(found, limits);
    let has_tiles = world.resource::<Ground>().layout.is_some();
    if let Some(mut logs) = world.get_resource_mut::<Logs>() {
        for (morphology, env, ended) in &ended {
            log(&mut logs, known, (*morphology, *env), ended, has_tiles.then_some(ended.level));
        }
    }
    Ok(())
}

/// The body of an env's robot.
fn body_of(world: &mut World, env: usize) -> Option<Body> {
    let mut bodies = world.query_filtered::<(&EnvId, &Body), With<Robot>>();
    bodies.iter(world).find(|(id, _)| id.0 as usize == env).map(|(_, body)| body.clone())
}

/// Counts an episode that has ended.
fn log(logs: &mut Logs, known: &OnDevice, (morphology, env): (usize, usize), ended: &Ended, level: Option<u32>) {
    let episode = Episode {
        terminated: ended.flags & flags::TERMINATED != 0,
        truncated: ended.flags & flags::TRUNCATED != 0,
        causes: ended.causes,
        ..Episode::default()
    };
    let terms = SmallVec::from_slice(&ended.terms);
    let mut sums = EpisodeSums { terms, steps: ended.steps, ..EpisodeSums::default() };
    set_totals(&mut sums, ended.totals);
    let steps = known.before[env] + known.told;
    let progress = CurriculumProgress { steps, widening: ended.widening, ..CurriculumProgress::default() };
    logs.add(morphology, &episode, &sums, &progress, level);
}

/// Rows of one block, of the batch and of the host's side.
struct Part<'a, 'b> {
    host: EnvHost<'a>,
    observations: &'b mut [f32],
    finals: &'b mut [f32],
    rewards: &'b mut [f32],
    commands: &'b mut [f32],
}

/// Sets actions for joints that a robot lacks to zero, as `apply_actions` does.
fn mask_rows(rows: &mut [f32], robot: &MorphologyModel, actions: usize) {
    if robot.slots.len() < actions {
        let mask = robot.action_mask(actions);
        for row in rows.chunks_exact_mut(actions) {
            row.iter_mut().zip(&mask).filter(|(_, is_there)| !**is_there).for_each(|(action, _)| *action = 0.0);
        }
    }
}

fn mask_actions(world: &World, batch: &mut Batch) {
    let (robots, width) = (&world.resource::<Morphologies>().0, batch.num_actions);
    for (morphology, envs) in world.resource::<BlockSizes>().iter().filter(|(_, envs)| !envs.is_empty()) {
        let rows = &mut batch.actions[envs.start * width..envs.end * width];
        mask_rows(rows, &robots[usize::from(morphology.0)], width);
    }
}

fn step(world: &World, whole: &mut dyn WholeSteps, batch: &mut Batch, known: &mut OnDevice) -> Result<(), DeviceError> {
    let (workers, sizes) = (world.resource::<Workers>(), world.resource::<BlockSizes>());
    let (morphologies, actions, observed) = (&world.resource::<Morphologies>().0, batch.num_actions, batch.num_obs);
    let blocks = || sizes.iter().filter(|(_, envs)| !envs.is_empty());
    let mut rest = &mut batch.actions[..];
    let mut tasks = Vec::new();
    for ((morphology, envs), host) in blocks().zip(whole.hosts()) {
        let (own, more) = rest.split_at_mut(envs.len() * actions);
        rest = more;
        tasks.push((own, host, &morphologies[usize::from(morphology.0)]));
    }
    workers.for_each(tasks.into_iter(), |(own, host, robot)| {
        mask_rows(own, robot, actions);
        host.actions.copy_from_slice(own);
    });
    let watched: Vec<bool> = watched_blocks(world).into_iter().map(|(_, _, watched)| watched).collect();
    whole.step(&watched, None)?;
    let Batch { observations, final_observations, rewards, .. } = batch;
    let mut rest = (&mut observations[..], &mut final_observations[..], &mut rewards[..], &mut known.commands[..]);
    let told = whole.told(0).into_iter().map(|told| told.flags.to_vec()).collect::<Vec<_>>();
    let mut parts = Vec::new();
    for (((_, envs), host), flags) in blocks().zip(whole.hosts()).zip(&told) {
        let ((o, f, r, c), n) = (rest, envs.len());
        let ((o, oo), (f, ff), (r, rr), (c, cc)) =
            (o.split_at_mut(n * observed), f.split_at_mut(n * observed), r.split_at_mut(n), c.split_at_mut(3 * n));
        rest = (oo, ff, rr, cc);
        parts.push((Part { host, observations: o, finals: f, rewards: r, commands: c }, flags));
    }
    workers.for_each(parts.into_iter(), |(part, flags)| part.copy(flags, observed));
    Ok(())
}

impl Part<'_, '_> {
    /// Copies the outcome of a control step.
    fn copy(self, flags: &[u32], width: usize) {
        let Self { host, observations, finals, rewards, commands } = self;
        observations.copy_from_slice(host.observations);
        rewards.copy_from_slice(host.rewards);
        commands.copy_from_slice(host.commands);
        let rows = flags.iter().enumerate().filter(|(_, flags)| **flags & flags::HAS_FINAL != 0);
        for (env, _) in rows {
            let row = env * width..(env + 1) * width;
            finals[row.clone()].copy_from_slice(&host.finals[row]);
        }
    }
}

/// Brings all components up to date, after steps on the device.
///
/// # Errors
/// A device that is lost; rows that are no blocks.
pub(crate) fn leave_device(world: &mut World) -> Result<(), Error> {
    faults::outcome::<(), ()>(world.run_system_cached(leave_robots))?;
    faults::outcome::<(), ()>(world.run_system_cached(leave_envs))?;
    faults::outcome::<(), ()>(world.run_system_cached(leave_bodies))?;
    measure_states(world)
}

/// Writes the components that the engine knows.
fn leave_robots(
    workers: Res<Workers>,
    mut engine: ResMut<PhysicsEngine>,
    mut robots: Blocks<RobotColumns, Robot>,
    envs: Blocks<&'static EnvOrigin, Env>,
) -> Result {
    let rows =
        robots.write()?.zip(envs.read()?).map(|_, (robots, origins)| RobotSlices::new(robots, origins)).collect();
    if let Some(whole) = engine.0.whole_steps() {
        whole.leave(&workers, rows).map_err(|error| lost(&error))?;
    }
    Ok(())
}

/// Writes the bodies that resets have changed.
fn leave_bodies(
    task: Res<CompiledTask>,
    sizes: Res<BlockSizes>,
    mut engine: ResMut<PhysicsEngine>,
    mut robots: Query<(&EnvId, &mut Body), With<Robot>>,
) {
    let Some(whole) = engine.0.whole_steps() else { return };
    if task.reset_body_events.is_empty() {
        return;
    }
    let blocks = sizes.iter().filter(|(_, envs)| !envs.is_empty()).zip(whole.hosts());
    let blocks: Vec<_> = blocks.map(|((_, envs), host)| (envs, host.rows)).collect();
    for (EnvId(env), mut body) in &mut robots {
        let env = *env as usize;
        let place = blocks.partition_point(|(envs, _)| envs.end <= env);
        let Some((envs, rows)) = blocks.get(place) else { continue };
        let before = changing_numbers(&body.0);
        let mut numbers = before.clone();
        rows.read(env - envs.start, Column::Body, &mut numbers);
        // bodies that stay go to no engine again
        if numbers.iter().zip(&before).any(|(now, before)| now.to_bits() != before.to_bits()) {
            set_changing_numbers(&mut body.0, &numbers);
        }
    }
}

/// Components of envs that the device has changed.
type ChangedColumns = (
    &'static mut Episode,
    &'static mut EnvRng,
    (&'static mut Command, &'static mut CommandNumbers),
    &'static mut EventTimers,
    &'static mut EpisodeSums,
    &'static mut CurriculumProgress,
    &'static mut EnvOrigin,
);

/// Writes the other components.
fn leave_envs(
    workers: Res<Workers>,
    morphologies: Res<Morphologies>,
    mut known: ResMut<OnDevice>,
    mut engine: ResMut<PhysicsEngine>,
    mut robots: Blocks<(&'static mut Action, &'static mut JointTargets, &'static ContactForces), Robot>,
    mut sensors: Blocks<&'static mut ContactSensor, ContactSensor>,
    mut envs: Blocks<ChangedColumns, Env>,
) -> Result {
    let Some(whole) = engine.0.whole_steps() else { return Ok(()) };
    let steps = std::mem::take(&mut known.steps);
    let blocks = robots.write()?.zip(sensors.write()?).zip(envs.write()?).into_iter().zip(whole.hosts());
    workers.for_each(blocks, |(Block { morphology, rows, .. }, host)| {
        let ((robots, sensors), (episodes, rngs, (commands, others), timers, sums, progress, origins)) = rows;
        let ((actions, targets, forces), feet) = (robots, &morphologies.get(morphology).feet);
        for env in 0..actions.len() {
            let rows = &host.rows;
            rows.read(env, Column::Action, &mut actions[env].current);
            rows.read(env, Column::Previous, &mut actions[env].previous);
            let command = &mut commands[env];
            let Command { velocity, heading, time_left, .. } = command;
            rows.read(env, Column::Command, velocity.iter_mut().chain([heading, time_left]));
            rows.read(env, Column::Timer, &mut timers[env].0);
            rows.read(env, Column::Numbers, &mut others[env].numbers);
            rows.read(env, Column::Wait, &mut others[env].time_left);
            let sum = &mut sums[env];
            rows.read(env, Column::Sum, &mut sum.terms);
            let mut totals = [0.0; 6];
            rows.read(env, Column::Total, &mut totals);
            set_totals(sum, totals);
            sum.steps = rows.word(env, Word::Steps);
            let contact = &mut sensors[env];
            let times = [
                &mut contact.contact_time,
                &mut contact.air_time,
                &mut contact.last_contact_time,
                &mut contact.last_air_time,
            ];
            rows.read(env, Column::Time, times.into_iter().flatten());
            contact.read_peaks(&forces[env], feet);
            let state = (rows.wide(env, Word::State), rows.wide(env, Word::Increment));
            rngs[env].set_parts(state);
            progress[env].steps += steps;
            let CurriculumProgress { widening, tracking, .. } = &mut progress[env];
            rows.read(env, Column::Progress, [widening, tracking]);
            rows.read(env, Column::Origin, &mut origins[env].position);
            origins[env].terrain_level = rows.word(env, Word::TileRow);
            let bits = rows.word(env, Word::Flags);
            let has = |bit: u32| bits & bit != 0;
            episodes[env] = Episode {
                length: rows.word(env, Word::Length),
                lived: rows.word(env, Word::Lived),
                terminated: has(flags::TERMINATED),
                truncated: has(flags::TRUNCATED),
                causes: rows.word(env, Word::Causes),
                needs_reset: has(flags::NEEDS_RESET),
                invalid: has(flags::INVALID),
                logged: has(flags::LOGGED),
                fresh: has(flags::FRESH),
            };
            command.holds_heading = has(flags::HOLDS_HEADING);
            command.standing = has(flags::STANDING);
            command.pinned = has(flags::PINNED);
            targets[env].fresh = has(flags::FRESH_TARGETS);
        }
    });
    Ok(())
}
