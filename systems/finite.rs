//! Says which set of the pipeline wrote a number that is not finite.

use std::collections::BTreeSet;

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;

use super::{ControlStep, PipelineSet};
use crate::components::{
    BasePose, BaseVelocity, Command, ContactSensor, Env, Episode, HeightScan, Imu, JointState, JointTargets, Robot,
};
use crate::rows::Rows;

/// Looks at all robots after each set of a control step. A state that broke in the physics is a broken episode and no fault; any
/// other number that is not finite is logged as an error, with the set that wrote it.
#[derive(Default)]
pub struct FinitePlugin;

/// Numbers that are not finite, by env and component, and the set that wrote the first one of each.
#[derive(Resource, Default, Debug)]
pub struct NonFinite {
    /// Env, component and set, of those that no broken episode explains.
    pub found: Vec<(usize, &'static str, PipelineSet)>,
    fresh: Vec<(usize, &'static str, PipelineSet)>,
    known: BTreeSet<(usize, &'static str)>,
}

impl Plugin for FinitePlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<NonFinite>();
        let sets = [
            PipelineSet::Act,
            PipelineSet::Command,
            PipelineSet::Disturb,
            PipelineSet::Physics,
            PipelineSet::Sense,
            PipelineSet::Terminate,
            PipelineSet::Reset,
        ];
        for (place, set) in sets.iter().enumerate() {
            let checked = look(set.clone()).after(set.clone()).ambiguous_with_all();
            match sets.get(place + 1) {
                Some(next) => app.add_systems(ControlStep, checked.before(next.clone())),
                None => app.add_systems(ControlStep, checked.before(PipelineSet::Observe)),
            };
        }
        app.add_systems(
            ControlStep,
            report.after(PipelineSet::Reset).before(PipelineSet::Observe).ambiguous_with_all(),
        );
    }
}

/// Notes what is not finite after a set and was before.
fn look(
    set: PipelineSet,
) -> impl FnMut(
    ResMut<NonFinite>,
    Rows<(&'static BasePose, &'static BaseVelocity, &'static JointState, &'static JointTargets), Robot>,
    Rows<&'static Command, Env>,
    Rows<&'static Imu, Imu>,
    Rows<&'static ContactSensor, ContactSensor>,
    Rows<&'static HeightScan, HeightScan>,
) -> Result {
    move |mut non_finite, robots, commands, imus, contacts, scans| {
        let (poses, velocities, joints, targets) = robots.read()?;
        let (commands, imus, contacts) = (commands.read()?, imus.read()?, contacts.read()?);
        let scans = if scans.exist() { scans.read()? } else { &[] };
        let all = |numbers: &[f32]| numbers.iter().all(|x| x.is_finite());
        for env in 0..poses.len() {
            let imu = &imus[env];
            let finite = [
                ("BasePose", all(&poses[env].position) && all(&poses[env].rotation)),
                ("BaseVelocity", all(&velocities[env].linear) && all(&velocities[env].angular)),
                ("JointState", all(&joints[env].position) && all(&joints[env].velocity)),
                ("JointTargets", targets[env].history.iter().all(|targets| all(targets))),
                ("Command", all(&commands[env].velocity)),
                ("Imu", all(&imu.linear_velocity) && all(&imu.angular_velocity) && all(&imu.projected_gravity)),
                ("ContactSensor", all(&contacts[env].peak_force)),
                ("HeightScan", scans.get(env).is_none_or(|scan| all(&scan.hits))),
            ];
            for (component, is_finite) in finite {
                if is_finite {
                    non_finite.known.remove(&(env, component));
                } else if non_finite.known.insert((env, component)) {
                    non_finite.fresh.push((env, component, set.clone()));
                }
            }
        }
        Ok(())
    }
}

/// Tells of what no broken episode explains.
fn report(mut non_finite: ResMut<NonFinite>, episodes: Rows<&'static Episode, Env>) -> Result {
    let episodes = episodes.read()?;
    let fresh = std::mem::take(&mut non_finite.fresh);
    for (env, component, set) in fresh {
        let broke = episodes[env].invalid || episodes[env].fresh;
        if broke && matches!(set, PipelineSet::Physics | PipelineSet::Sense) {
            continue;
        }
        tracing::error!("env {env}: a number of {component} is not finite after {set:?}");
        non_finite.found.push((env, component, set));
    }
    Ok(())
}
