//! Spawns envs and robots; sensors are spawned by [`add_sensor`](super::add_sensor).

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use smallvec::smallvec;

use super::saved::save_component;
use super::terms::CompiledTask;
use super::{Setup, SetupSet, keep_blocks};
use crate::blocks::BlockSizes;
use crate::components::{
    Action, ActuatorDelay, ActuatorMemory, BasePose, BaseVelocity, Body, Command, CommandNumbers, ConstraintImpulses,
    ContactForces, CurriculumProgress, Env, EnvId, EnvOrigin, EnvRng, Episode, EpisodeSums, EventTimers,
    ExternalWrench, Feet, JointEffort, JointState, JointTargets, LinkForces, Morphology, PerJoint, Robot, Stance,
    StartupBody,
};
use crate::engine::history_length;
use crate::morphology::{Morphologies, MorphologyModel};

/// Spawns envs and robots, and registers their components for snapshots.
#[derive(Default)]
pub struct SpawnPlugin;

impl Plugin for SpawnPlugin {
    fn build(&self, app: &mut App) {
        app.add_systems(Setup, (spawn_envs, spawn_robots).chain().in_set(SetupSet::Spawn));
        keep_blocks::<Env>(app);
        keep_blocks::<Robot>(app);
        save_component::<EnvRng>(app);
        save_component::<Episode>(app);
        save_component::<Command>(app);
        save_component::<CommandNumbers>(app);
        save_component::<CurriculumProgress>(app);
        save_component::<EventTimers>(app);
        save_component::<EpisodeSums>(app);
        save_component::<EnvOrigin>(app);
        save_component::<BasePose>(app);
        save_component::<BaseVelocity>(app);
        save_component::<JointState>(app);
        save_component::<Action>(app);
        save_component::<JointTargets>(app);
        save_component::<ActuatorDelay>(app);
        save_component::<ActuatorMemory>(app);
        save_component::<JointEffort>(app);
        save_component::<ConstraintImpulses>(app);
        save_component::<ContactForces>(app);
        save_component::<Feet>(app);
        save_component::<Body>(app);
        save_component::<StartupBody>(app);
        save_component::<Stance>(app);
        save_component::<ExternalWrench>(app);
        save_component::<LinkForces>(app);
    }
}

/// The tags of each env, in the order of the env ids: a block of envs for each morphology.
fn tags(blocks: &BlockSizes) -> impl Iterator<Item = (EnvId, Morphology)> {
    blocks.iter().flat_map(|(morphology, envs)| envs.map(move |env| (EnvId(env as u32), morphology)))
}

/// Spawns envs in the order of their ids.
fn spawn_envs(mut commands: Commands, blocks: Res<BlockSizes>, task: Res<CompiledTask>) {
    for (id, tag) in tags(&blocks) {
        let rng = EnvRng::new(0, u64::from(id.0));
        let terms = smallvec![0.0; task.rewards[usize::from(tag.0)].len()];
        commands.spawn((
            (id, tag, Env, rng, Episode::default(), Command::default(), EnvOrigin::default()),
            (task.new_command_numbers(), CurriculumProgress::default()),
            EventTimers(smallvec![0.0; task.num_interval_events()]),
            EpisodeSums { terms, ..EpisodeSums::default() },
        ));
    }
}

/// Spawns robots in the order of their envs.
pub(super) fn spawn_robots(
    mut commands: Commands,
    blocks: Res<BlockSizes>,
    task: Res<CompiledTask>,
    morphologies: Res<Morphologies>,
) {
    let decimation = task.config.sim.decimation as usize;
    for (id, tag) in tags(&blocks) {
        commands.spawn((id, tag, Robot, robot_components(morphologies.get(tag), decimation)));
    }
}

fn robot_components(model: &MorphologyModel, decimation: usize) -> impl Bundle {
    let joints = model.topology.num_joints();
    let zeros: PerJoint = smallvec![0.0; joints];
    let ages = history_length(model.max_delay(), decimation);
    (
        BasePose { position: [0.0; 3], rotation: [1.0, 0.0, 0.0, 0.0] },
        BaseVelocity::default(),
        JointState::zeros(joints),
        Action::zeros(model.slots.len()),
        JointTargets { history: smallvec![zeros.clone(); ages], fresh: true },
        (ActuatorDelay(zeros.clone()), ActuatorMemory(vec![0.0; model.num_remembered()].into())),
        JointEffort::zeros(joints),
        ConstraintImpulses { contacts: smallvec![], bounds: zeros },
        ContactForces::zeros(model.feet.len(), decimation),
        Feet::zeros(model.feet.len()),
        (ExternalWrench::default(), LinkForces::default(), model.stance.clone(), StartupBody::default()),
        Body(Box::new(model.nominal.clone())),
    )
}
