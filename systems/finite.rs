//! Finds the systems of the pipeline that may have written a number that is not finite.

use std::collections::BTreeSet;

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use bevy_ecs::schedule::SystemKey;
use bevy_ecs::system::{System, SystemAccess};

use super::{ControlStep, PipelineSet, Setup};
use crate::blocks::{Block, Blocks};
use crate::components::{
    BasePose, BaseVelocity, Command, ContactSensor, Env, Episode, HeightScan, Imu, JointState, JointTargets, Robot,
};

/// Checks all robots after each set of a control step. A state that diverged in the physics is a
/// broken episode and no fault. Any other number that is not finite is logged as an error, with the
/// set after which it was found and that set's systems that write the component.
#[derive(Default)]
pub struct FinitePlugin;

/// A number that is not finite, where no broken episode explains it.
#[derive(Clone, Debug)]
pub struct NonFiniteNumber {
    /// Env that the number belongs to.
    pub env: usize,
    /// Name of the component that holds it.
    pub component: &'static str,
    /// The set after which it was found first.
    pub set: PipelineSet,
    /// The systems of this set that write the component.
    pub systems: Vec<String>,
}

/// Numbers that are not finite, the first one of each env and component.
#[derive(Resource, Default, Debug)]
pub struct NonFinite {
    /// Numbers that no broken episode explains.
    pub found: Vec<NonFiniteNumber>,
    fresh: Vec<(usize, &'static str, PipelineSet)>,
    known: BTreeSet<(usize, &'static str)>,
}

/// Components and the systems that write them.
#[derive(Resource, Default)]
struct Writers {
    /// The components that each system writes.
    written: Vec<(SystemKey, Vec<&'static str>)>,
    /// Set, component and name of each system that writes it.
    systems: Vec<(PipelineSet, &'static str, String)>,
}

/// The sets after which numbers are checked, in their order.
const SETS: [PipelineSet; 7] = [
    PipelineSet::Act,
    PipelineSet::Command,
    PipelineSet::Disturb,
    PipelineSet::Physics,
    PipelineSet::Sense,
    PipelineSet::Terminate,
    PipelineSet::Reset,
];

impl Plugin for FinitePlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<NonFinite>().init_resource::<Writers>();
        app.add_systems(Setup, name_writers.ambiguous_with_all());
        for (place, set) in SETS.iter().enumerate() {
            let checked = look(set.clone()).after(set.clone()).ambiguous_with_all();
            match SETS.get(place + 1) {
                Some(next) => app.add_systems(ControlStep, checked.before(next.clone())),
                None => app.add_systems(ControlStep, checked.before(PipelineSet::Observe)),
            };
        }
        app.add_systems(
            ControlStep,
            report.after(PipelineSet::Reset).before(PipelineSet::Observe).ambiguous_with_all(),
        );
    }

    fn cleanup(&self, app: &mut App) {
        note_written(app.world_mut());
    }
}

/// Records the components that each system writes. This comes before the schedule is built, which
/// hides them.
fn note_written(world: &mut World) {
    let components = [
        ("BasePose", world.register_component::<BasePose>()),
        ("BaseVelocity", world.register_component::<BaseVelocity>()),
        ("JointState", world.register_component::<JointState>()),
        ("JointTargets", world.register_component::<JointTargets>()),
        ("Command", world.register_component::<Command>()),
        ("Imu", world.register_component::<Imu>()),
        ("ContactSensor", world.register_component::<ContactSensor>()),
        ("HeightScan", world.register_component::<HeightScan>()),
    ];
    // without the schedule PipelinePlugin is missing, which another error reports
    let _ = world.try_schedule_scope(ControlStep, |world, schedule| {
        let systems = &mut schedule.graph_mut().systems;
        let keys: Vec<SystemKey> = systems.iter().map(|(key, ..)| key).collect();
        for key in keys {
            let Some(system) = systems.get_mut(key) else {
                continue;
            };
            let access = system.initialize(world);
            let writes = |id| match &access {
                SystemAccess::None => false,
                SystemAccess::Shared(access) => access.combined_access().has_write(id),
                SystemAccess::Exclusive => true,
            };
            let written = components.iter().filter(|(_, id)| writes(*id)).map(|(name, _)| *name).collect();
            world.resource_mut::<Writers>().written.push((key, written));
        }
    });
}

/// Names the systems of each set that write a component; the schedule is built and does not run
/// yet.
fn name_writers(world: &mut World) {
    let mut writers = std::mem::take(&mut *world.resource_mut::<Writers>());
    world.schedule_scope(ControlStep, |_, schedule| {
        for set in SETS {
            let (Ok(of_set), Ok(systems)) = (schedule.graph().systems_in_set(set.intern()), schedule.systems()) else {
                continue;
            };
            for (key, system) in systems.filter(|(key, _)| of_set.contains(key)) {
                let written = writers.written.iter().filter(|(of, _)| *of == key).flat_map(|(_, names)| names);
                for component in written {
                    writers.systems.push((set.clone(), component, system.name().to_string()));
                }
            }
        }
    });
    world.insert_resource(writers);
}

/// Records numbers that are not finite after a set and were finite before.
fn look(
    set: PipelineSet,
) -> impl FnMut(
    ResMut<NonFinite>,
    Blocks<(&'static BasePose, &'static BaseVelocity, &'static JointState, &'static JointTargets), Robot>,
    Blocks<&'static Command, Env>,
    Blocks<&'static Imu, Imu>,
    Blocks<&'static ContactSensor, ContactSensor>,
    Blocks<&'static HeightScan, HeightScan>,
) -> Result {
    move |mut non_finite, robots, commands, imus, contacts, scans| {
        let all = |numbers: &[f32]| numbers.iter().all(|x| x.is_finite());
        let blocks = robots.read()?.zip(commands.read()?).zip(imus.read()?).zip(contacts.read()?);
        for Block { envs, rows, .. } in blocks.zip_some(scans.read_some()?) {
            let (((((poses, velocities, joints, targets), commands), imus), contacts), scans) = rows;
            for (i, env) in envs.enumerate() {
                let imu = &imus[i];
                let finite = [
                    ("BasePose", all(&poses[i].position) && all(&poses[i].rotation)),
                    ("BaseVelocity", all(&velocities[i].linear) && all(&velocities[i].angular)),
                    ("JointState", all(&joints[i].position) && all(&joints[i].velocity)),
                    ("JointTargets", targets[i].history.iter().all(|targets| all(targets))),
                    ("Command", all(&commands[i].velocity)),
                    ("Imu", all(&imu.linear_velocity) && all(&imu.angular_velocity) && all(&imu.projected_gravity)),
                    ("ContactSensor", all(&contacts[i].peak_force)),
                    ("HeightScan", scans.is_none_or(|scans| all(&scans[i].hits))),
                ];
                for (component, is_finite) in finite {
                    if is_finite {
                        non_finite.known.remove(&(env, component));
                    } else if non_finite.known.insert((env, component)) {
                        non_finite.fresh.push((env, component, set.clone()));
                    }
                }
            }
        }
        Ok(())
    }
}

/// Reports numbers that no broken episode explains.
fn report(mut non_finite: ResMut<NonFinite>, writers: Res<Writers>, episodes: Blocks<&'static Episode, Env>) -> Result {
    let episodes = episodes.read()?;
    let fresh = std::mem::take(&mut non_finite.fresh);
    for (env, component, set) in fresh {
        let broke = episodes.at(env).is_some_and(|(episodes, row)| episodes[row].invalid || episodes[row].fresh);
        if broke && matches!(set, PipelineSet::Physics | PipelineSet::Sense) {
            continue;
        }
        let systems = writers.systems.iter().filter(|(of_set, of, _)| *of_set == set && *of == component);
        let systems: Vec<String> = systems.map(|(.., name)| name.clone()).collect();
        let names = systems.join(", ");
        tracing::error!(
            "env {env}: a number of {component} is not finite after {set:?}, where these systems write it: {names}"
        );
        non_finite.found.push(NonFiniteNumber { env, component, set, systems });
    }
    Ok(())
}
