//! Set-up, steps and resets of a world, for a simulation and for a host app.

use bevy_ecs::prelude::*;
use bevy_ecs::schedule::{InternedScheduleLabel, ScheduleLabel};

use crate::batch::Batch;
use crate::blocks::BlockSizes;
use crate::bounds::MAX_ACTION;
use crate::components::{Body, Command, CommandNumbers, CurriculumProgress, EnvId, EnvRng, Episode, Morphology};
use crate::error::Error;
use crate::morphology::Morphologies;
use crate::systems::{
    ControlStep, ResetEnvs, ResetRequest, Setup, Share, outcome, place_envs, randomise_at_startup, run,
};

/// Loads the task and its robots, spawns everything and resets all envs.
///
/// # Errors
/// Any fault of the options, the configs, the URDFs or the plugins.
pub(super) fn set_up(world: &mut World, seed: u64) -> Result<(), Error> {
    for label in [Setup.intern(), ControlStep.intern(), ResetEnvs.intern()] {
        initialise(world, label)?;
    }
    run(world, Setup)?;
    reset(world, Some(seed), None)
}

/// One control step with the actions of the batch, which are checked.
///
/// # Errors
/// A system failed.
pub(super) fn take_step(world: &mut World) -> Result<(), Error> {
    world.resource_mut::<ResetRequest>().0 = false;
    run(world, ControlStep)
}

/// Checks the actions of a control step.
///
/// # Errors
/// The wrong number of actions, or one that is not finite or beyond [`MAX_ACTION`].
pub(super) fn check_actions(world: &World, actions: &[f32]) -> Result<(), Error> {
    let Batch { num_envs, num_actions, .. } = *world.resource::<Batch>();
    if actions.len() != num_envs * num_actions {
        return Err(Error::argument(
            "actions",
            format!("{} numbers for {num_envs} envs of {num_actions} actions", actions.len()),
            "pass one row of actions per env",
        ));
    }
    // all of them at once, then one by one to find the culprit
    let within = |a: &f32| a.abs() <= MAX_ACTION;
    let all_within = actions.iter().fold(true, |all, a| all & within(a));
    if !all_within && let Some(at) = actions.iter().position(|a| !within(a)) {
        let (env, column) = (at / num_actions, at % num_actions);
        let joint = world.resource::<Morphologies>().1.joints[column];
        return Err(Error::argument(
            "actions",
            format!("the action of env {env} for {joint} is {}", actions[at]),
            format!("pass finite numbers within {MAX_ACTION}; a policy that gives others has diverged"),
        ));
    }
    Ok(())
}

/// Begins new episodes: in the envs of the mask, or in all. A seed restarts the random streams and
/// repeats the startup events.
///
/// # Errors
/// A mask of the wrong length, or a seed together with a mask.
pub(super) fn reset(world: &mut World, seed: Option<u64>, mask: Option<&[bool]>) -> Result<(), Error> {
    let num_envs = world.resource::<BlockSizes>().num_envs();
    if let Some(mask) = mask {
        if mask.len() != num_envs {
            let problem = format!("{} entries for {num_envs} envs", mask.len());
            return Err(Error::argument("mask", problem, "pass one entry per env"));
        }
        if seed.is_some() {
            return Err(Error::argument("seed", "given together with a mask", "seed all envs at once, or reset some"));
        }
    }
    if let Some(seed) = seed {
        restart(world, seed)?;
    }
    for (env, mut episode) in world.query::<(&EnvId, &mut Episode)>().iter_mut(world) {
        episode.needs_reset = mask.is_none_or(|mask| mask[env.0 as usize]);
        episode.fresh = false;
    }
    world.resource_mut::<ResetRequest>().0 = true;
    run(world, ResetEnvs)
}

/// Puts random streams, bodies, commands, curricula and episodes where a new simulation has them.
fn restart(world: &mut World, seed: u64) -> Result<(), Error> {
    let names: Vec<String> = world.resource::<Morphologies>().0.iter().map(|m| m.name().to_string()).collect();
    let places: Vec<usize> = world.resource::<Share>().places(world.resource::<BlockSizes>()).collect();
    for (env, tag, mut rng) in world.query::<(&EnvId, &Morphology, &mut EnvRng)>().iter_mut(world) {
        *rng = EnvRng::of_env(seed, &names[usize::from(tag.0)], places[env.0 as usize]);
    }
    let nominal: Vec<_> = world.resource::<Morphologies>().0.iter().map(|m| m.nominal.clone()).collect();
    for (tag, mut body) in world.query::<(&Morphology, &mut Body)>().iter_mut(world) {
        *body.0 = nominal[usize::from(tag.0)].clone();
    }
    for mut command in world.query::<&mut Command>().iter_mut(world) {
        *command = Command::default();
    }
    for (mut commands, mut progress) in world.query::<(&mut CommandNumbers, &mut CurriculumProgress)>().iter_mut(world)
    {
        commands.clear();
        *progress = CurriculumProgress::default();
    }
    for mut episode in world.query::<&mut Episode>().iter_mut(world) {
        *episode = Episode::default();
    }
    outcome::<(), ()>(world.run_system_cached(randomise_at_startup))?;
    outcome(world.run_system_cached(place_envs))
}

/// Builds a schedule. A contradiction between a user's systems is an error here, not a panic.
fn initialise(world: &mut World, label: InternedScheduleLabel) -> Result<(), Error> {
    let failed =
        |problem: String| Error::argument("plugins", problem, "order the systems of your plugins by sets and .after()");
    let built = world.try_schedule_scope(label, |world, schedule| {
        schedule.initialize(world).map_err(|error| error.to_string(schedule.graph(), world))
    });
    match built {
        Ok(Ok(_)) => Ok(()),
        Ok(Err(problem)) => Err(failed(format!("{label:?}: {problem}"))),
        Err(_) => Err(failed(format!("there is no schedule {label:?}: PipelinePlugin is missing"))),
    }
}
