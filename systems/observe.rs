//! Observations: the terms of all groups, side by side, with their noise and what they remember.

use bevy_app::{App, Plugin};
use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::sense::joint_descriptors::{COUNT, MIRROR, MOST_EFFORT, TERM};
use super::sense::scaled_descriptors::joint_descriptors;
use super::terms::{Block, CompiledTask, NoParams, ObservationTerm, Per, Registry, TermKind, TermSource, TermSpec};
use super::view::RobotView;
use super::views::{ViewParam, Views};
use super::{PipelineSet, ResetRequest, ResetSet, for_both};
use crate::batch::Batch;
use crate::blocks::{BlockMarker, Blocks};
use crate::components::{Env, EnvId, EnvRng, Episode, Morphology};
use crate::config::quantities::Height;
use crate::config::{TaskConfig, values};
use crate::dynamics::lanes::Kernel;
use crate::engine::device::FormKind;
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel, SlotJoint};
use crate::options::Autoreset;
use crate::workers::{MatrixRows, Workers};

/// Observes the robots.
#[derive(Default)]
pub struct ObservePlugin;

impl Plugin for ObservePlugin {
    fn build(&self, app: &mut App) {
        for_both(app, || observe.in_set(PipelineSet::Observe));
        for_both(app, || observe_final.in_set(ResetSet::Observe));
    }
}

/// Observes all envs; after resets that the caller asked for only those that were reset, so that
/// the others keep their observation and their random streams.
pub(super) fn observe(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    request: Res<ResetRequest>,
    views: ViewParam,
    mut batch: ResMut<Batch>,
    mut envs: Blocks<(&'static Episode, &'static mut EnvRng), Env>,
) -> Result {
    let width = batch.num_obs;
    let out = MatrixRows { data: &mut batch.observations[..], width };
    let blocks = views.views(task.step_dt)?.zip(envs.write()?).zip_envs(out);
    blocks.for_each_chunk(&workers, |chunk| {
        let ((views, (episodes, rngs)), mut out) = chunk.rows;
        for i in 0..episodes.len() {
            if request.0 && !episodes[i].fresh {
                continue;
            }
            let (views, episode, rng) = (&views, &episodes[i], &mut rngs[i]);
            let row = out.row(i);
            let observation = Observation { task: &task, views, row: i, episode, rng, out: row, has_last: true };
            workers.dispatch().vectorize(observation);
        }
    });
    Ok(())
}

/// Observes the envs whose episode has just ended and that are about to be reset.
pub(super) fn observe_final(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    request: Res<ResetRequest>,
    views: ViewParam,
    mut batch: ResMut<Batch>,
    mut envs: Blocks<(&'static Episode, &'static mut EnvRng), Env>,
) -> Result {
    let wanted = *autoreset == Autoreset::SameStep && !request.0;
    let width = batch.num_obs;
    let batch = &mut *batch;
    let out = MatrixRows { data: &mut batch.final_observations[..], width };
    let before = MatrixRows { data: &mut batch.observations[..], width };
    let remembers = task.has_history();
    let arrays = (out, before, &mut batch.has_final[..]);
    let blocks = views.views(task.step_dt)?.zip(envs.write()?).zip_envs(arrays);
    blocks.for_each_chunk(&workers, |chunk| {
        let ((views, (episodes, rngs)), (mut out, mut before, has_final)) = chunk.rows;
        for i in 0..episodes.len() {
            has_final[i] = wanted && episodes[i].done();
            if has_final[i] {
                if remembers {
                    out.row(i).copy_from_slice(before.row(i));
                }
                let (views, episode, rng) = (&views, &episodes[i], &mut rngs[i]);
                let row = out.row(i);
                let observation = Observation { task: &task, views, row: i, episode, rng, out: row, has_last: false };
                workers.dispatch().vectorize(observation);
            }
        }
    });
    Ok(())
}

/// Writes the observation of one env. A broken state is observed as zeros: no NaN reaches a
/// learner.
struct Observation<'a> {
    task: &'a CompiledTask,
    views: &'a Views<'a>,
    row: usize,
    episode: &'a Episode,
    rng: &'a mut EnvRng,
    out: &'a mut [f32],
    /// Whether `out` holds the observation of the control step before.
    has_last: bool,
}

impl Kernel<f32> for Observation<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        if self.episode.invalid {
            self.out.fill(0.0);
            return;
        }
        let view = self.views.get(self.row);
        let mut rest = self.out;
        for term in &self.task.observations {
            let (mine, more) = rest.split_at_mut(term.size);
            let is_image = term.spec.kind == TermKind::Image;
            if is_image && view.image.is_empty() {
                // no noise where there is no camera
                mine.fill(0.0);
            } else if is_image && self.has_last && !view.is_new_image && term.is_plain() {
                // a held image stands there already
            } else if let Some(write) = &term.write {
                let (robot, columns) = (view.morphology, self.task.num_joints);
                term.observe(mine, self.episode.fresh, (robot, columns), self.rng, |newest| write(&view, newest));
            }
            rest = more;
        }
    }
}

/// Writes the terms that the caller computes, with noise and history, to the rows of the mask, or
/// to all. `values` are the present numbers of these terms side by side, `[num_envs, n]`.
///
/// # Errors
/// Values or a mask of another length.
pub(crate) fn observe_external(world: &mut World, values: &[f32], mask: Option<&[bool]>) -> Result<(), Error> {
    world.resource_scope(|world, task: Mut<CompiledTask>| {
        world.resource_scope(|world, morphologies: Mut<Morphologies>| {
            world.resource_scope(|world, mut batch: Mut<Batch>| {
                write_external(world, (&*task, &*morphologies, &mut *batch), values, mask)
            })
        })
    })
}

fn write_external(
    world: &mut World,
    (task, morphologies, batch): (&CompiledTask, &Morphologies, &mut Batch),
    values: &[f32],
    mask: Option<&[bool]>,
) -> Result<(), Error> {
    let now = |term: &ObservationTerm| term.size / term.history;
    let width: usize = task.observations.iter().filter(|term| term.is_external).map(now).sum();
    if values.len() != width * batch.num_envs || mask.is_some_and(|mask| mask.len() != batch.num_envs) {
        let problem = format!("{} numbers for {} envs of {width}", values.len(), batch.num_envs);
        return Err(Error::argument("values", problem, "pass one row per env, and a mask with one entry per env"));
    }
    let columns = task.num_joints;
    for (env, tag, episode, mut rng) in world.query::<(&EnvId, &Morphology, &Episode, &mut EnvRng)>().iter_mut(world) {
        let (env, robot) = (env.0 as usize, morphologies.get(*tag));
        if mask.is_some_and(|mask| !mask[env]) {
            continue;
        }
        let mut rest = &mut batch.observations[env * batch.num_obs..(env + 1) * batch.num_obs];
        let mut values = &values[env * width..(env + 1) * width];
        for term in &task.observations {
            let (row, more) = rest.split_at_mut(term.size);
            rest = more;
            if !term.is_external {
                continue;
            }
            let (given, others) = values.split_at(now(term));
            values = others;
            if episode.invalid || !term.is_of(robot, &task.config) {
                row.fill(0.0);
                continue;
            }
            term.observe(row, episode.fresh, (robot, columns), &mut rng, |own| match term.spec.kind {
                TermKind::PerJoint => gather(robot.slots.iter().map(SlotJoint::column), columns, given, own),
                TermKind::PerFoot => gather(robot.foot_columns.iter().copied(), given.len(), given, own),
                _ => own.copy_from_slice(given),
            });
        }
    }
    Ok(())
}

/// Takes the numbers of a robot's own joints or feet from the batch's columns: the reverse of
/// [`spread`].
fn gather(own_columns: impl Iterator<Item = usize> + Clone, columns: usize, from: &[f32], own: &mut [f32]) {
    let all = from.chunks_exact(columns.max(1)).flat_map(|block| own_columns.clone().map(|column| block[column]));
    for (to, number) in own.iter_mut().zip(all) {
        *to = number;
    }
}

/// Moves the numbers of a robot's own joints or feet, which come first, to their columns of the
/// batch's. Places from which they move become zero; all others keep their zeros. `own_columns` are
/// in rising order: none is overwritten before it has moved.
fn spread<I>(own_columns: I, columns: usize, numbers: &mut [f32])
where
    I: ExactSizeIterator<Item = usize> + DoubleEndedIterator + Clone,
{
    let (count, blocks) = (own_columns.len(), numbers.len() / columns);
    for block in (0..blocks).rev() {
        for (own, column) in own_columns.clone().enumerate().rev() {
            let number = std::mem::take(&mut numbers[block * count + own]);
            numbers[block * columns + column] = number;
        }
    }
}

impl ObservationTerm {
    /// Observes an env's numbers, or keeps those that last an episode: `write` is handed the
    /// numbers of its robot, in a batch of `columns` columns of joints. `row` holds the term's
    /// numbers as they were observed in the step before. A new episode's history is filled with its
    /// first numbers.
    ///
    /// `apply_noise_and_scale` is called from here and from no closure, so that it is compiled for
    /// the instruction set of its caller.
    #[inline(always)]
    fn observe(
        &self,
        row: &mut [f32],
        is_new: bool,
        (robot, columns): (&MorphologyModel, usize),
        rng: &mut EnvRng,
        write: impl FnOnce(&mut [f32]),
    ) {
        let size = self.size / self.history;
        if self.error > 0.0 && !is_new {
            return;
        }
        if self.history > 1 {
            row.copy_within(size.., 0);
        }
        let (older, newest) = row.split_at_mut(self.size - size);
        let own = match self.spec.kind {
            TermKind::PerJoint => size / columns * robot.slots.len(),
            TermKind::PerFoot => robot.foot_columns.len(),
            _ => size,
        };
        write(&mut newest[..own]);
        self.apply_noise_and_scale(&mut newest[..own], rng);
        if own != size {
            // columns of other robots' joints stay zero for the rest of the episode: where rows are
            // long, writing them costs more than the robot's own numbers
            if is_new {
                newest[own..].fill(0.0);
            }
            match self.spec.kind {
                TermKind::PerFoot => spread(robot.foot_columns.iter().copied(), size, newest),
                _ => spread(robot.slots.iter().map(SlotJoint::column), columns, newest),
            }
        }
        if is_new {
            older.chunks_exact_mut(size).for_each(|numbers| numbers.copy_from_slice(newest));
        }
    }

    /// Whether equal numbers are observed equally: without noise and history.
    fn is_plain(&self) -> bool {
        self.noise == 0.0 && self.error == 0.0 && self.history == 1
    }

    /// Adds errors and noise to what was written, limits and scales it.
    #[inline(always)]
    fn apply_noise_and_scale(&self, numbers: &mut [f32], rng: &mut EnvRng) {
        if self.error > 0.0 {
            for x in &mut *numbers {
                *x *= rng.uniform([1.0 - self.error, 1.0 + self.error]);
            }
        }
        if self.noise > 0.0 {
            rng.add_uniform([-self.noise, self.noise], numbers);
        }
        if let Some([low, high]) = self.clip {
            for x in &mut *numbers {
                *x = x.max(low).min(high);
            }
        }
        if self.scale != 1.0 {
            for x in numbers {
                *x *= self.scale;
            }
        }
    }
}

/// Adds an observation term that is read from a component of the entities of kind `K`, in a
/// plugin's `build`. Tasks name it like any other term. For morphologies without such entities
/// ([`BlockMarker::is_on`]) its numbers are zero and masked. One of the kind [`TermKind::PerJoint`]
/// or [`TermKind::PerFoot`] is handed the numbers of the robot's own joints or feet to write.
pub fn add_observation<C: Component, K: BlockMarker>(
    app: &mut App,
    name: &'static str,
    size: usize,
    spec: TermSpec,
    f: fn(&C, &mut [f32]),
) {
    app.world_mut().get_resource_or_insert_with(Registry::builtin).observation_by_system(name, size, spec, K::is_on);
    let write = move |is_final: bool| {
        move |task: Res<CompiledTask>,
              request: Res<ResetRequest>,
              mut batch: ResMut<Batch>,
              morphologies: Res<Morphologies>,
              mut envs: Blocks<(&'static Episode, &'static mut EnvRng), Env>,
              values: Blocks<&'static C, K>|
              -> Result {
            let values = match morphologies.0.iter().all(|morphology| K::is_on(morphology, &task.config)) {
                true => values.read()?,
                false => values.read_some()?,
            };
            let batch = &mut *batch;
            for block in envs.write()?.zip_some(values) {
                let ((episodes, rngs), values) = block.rows;
                let body = (morphologies.get(block.morphology), task.num_joints);
                let mut start = 0;
                for term in &task.observations {
                    let columns = start..start + term.size;
                    start = columns.end;
                    if term.name != name {
                        continue;
                    }
                    for (i, env) in block.envs.clone().enumerate() {
                        let (due, rows) = match is_final {
                            true => (batch.has_final[env], &mut batch.final_observations),
                            false => (!request.0 || episodes[i].fresh, &mut batch.observations),
                        };
                        if due {
                            let row = &mut rows[env * batch.num_obs..(env + 1) * batch.num_obs];
                            let out = &mut row[columns.clone()];
                            match values.filter(|_| !episodes[i].invalid) {
                                Some(values) => {
                                    let fresh = episodes[i].fresh;
                                    term.observe(out, fresh, body, &mut rngs[i], |newest| f(&values[i], newest));
                                }
                                None => out.fill(0.0),
                            }
                        }
                    }
                }
            }
            Ok(())
        }
    };
    for_both(app, || write(false).after(observe).in_set(PipelineSet::Observe).ambiguous_with_all());
    for_both(app, || write(true).after(observe_final).in_set(ResetSet::Observe).ambiguous_with_all());
}

/// All built-in observation terms, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    use TermKind::{Body, PerJoint, PlanarVelocity, Pseudovector, Scan, Vector};
    let spec = TermSpec::new(Vector, "m/s", "velocity of the base's centre of mass, base axes")
        .from_source(TermSource::CenterOfMassVelocity);
    registry.observation("base_lin_vel", 3, spec, |_: &NoParams, r, out| out.copy_from_slice(&r.imu.linear_velocity));
    let spec = TermSpec::new(Pseudovector, "rad/s", "angular velocity of the base, base axes")
        .from_source(TermSource::BaseAngularVelocity);
    registry.observation("base_ang_vel", 3, spec, |_: &NoParams, r, out| out.copy_from_slice(&r.imu.angular_velocity));
    let spec = TermSpec::new(Vector, "", "unit vector of gravity, base axes").from_source(TermSource::ProjectedGravity);
    registry.observation("projected_gravity", 3, spec, |_: &NoParams, r, out| {
        out.copy_from_slice(&r.imu.projected_gravity);
    });
    let spec = TermSpec::new(PlanarVelocity, "m/s, rad/s", "forward and left velocity and yaw rate that are commanded")
        .from_source(TermSource::VelocityCommand);
    registry.observation("velocity_commands", 3, spec, |_: &NoParams, r, out| out.copy_from_slice(r.command));
    let spec = TermSpec::new(PerJoint, "rad", "joint positions less the default pose")
        .from_source(TermSource::JointPositionMinusDefault);
    registry.joint_observation("joint_pos_rel", 1, spec, |_: &NoParams, r, out| {
        by_slot(r, out, |j| r.joints.position[j] - r.stance.default_position[j]);
    });
    let spec = TermSpec::new(PerJoint, "rad/s", "joint velocities")
        .from_source(TermSource::JointVelocity)
        .with_magnitude(10.0);
    registry
        .joint_observation("joint_vel_rel", 1, spec, |_: &NoParams, r, out| by_slot(r, out, |j| r.joints.velocity[j]));
    let spec = TermSpec::new(PerJoint, "", "the last action").from_source(TermSource::LastAction);
    registry.joint_observation("last_action", 1, spec, |_: &NoParams, r, out| out.copy_from_slice(&r.action.current));
    let spec = TermSpec::new(Body, "", "what body this is, see docs/task.md")
        .from_source(TermSource::RobotConstant)
        .with_blocks(&MORPHOLOGY_BLOCKS);
    registry.observation("morphology", MORPHOLOGY_SIZE, spec, morphology);
    let spec = TermSpec::new(PerJoint, "", "what each joint is and what drives it, see docs/task.md")
        .from_source(TermSource::RobotConstant)
        .with_joint_mirror(&MIRROR);
    registry.joint_observation(TERM, COUNT, spec, joint_descriptors);
    let spec = TermSpec::new(Scan, "m", "height of the base above the ground below each ray, less the offset")
        .from_source(TermSource::HeightScan);
    registry.observation_of("height_scan", height_scan_size, spec, |p: &ScanOffset| p.offset, height_scan);
    for name in [
        "base_lin_vel",
        "base_ang_vel",
        "projected_gravity",
        "velocity_commands",
        "joint_pos_rel",
        "joint_vel_rel",
        "last_action",
    ] {
        registry.on_device(FormKind::Observation, name, |NoParams {}, _| Some((Vec::new(), Some(Vec::new()))));
    }
    registry
        .on_device(FormKind::Observation, "height_scan", |p: ScanOffset, _| Some((vec![p.offset], Some(Vec::new()))));
    registry.depends_on_body("morphology");
    registry.depends_on_body(TERM);
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ScanOffset {
    /// Height of the base above level ground that is observed as 0, m.
    #[serde(default = "half", deserialize_with = "values::number_of::<Height, _, _>")]
    offset: f32,
}

fn half() -> f32 {
    0.5
}

/// One number per ray.
fn height_scan_size(task: &TaskConfig) -> Result<usize, (String, String)> {
    let rays = task.sensors.height_scanner.as_ref().map(|scanner| scanner.counts().iter().product());
    rays.ok_or_else(|| ("the task has no height scanner".into(), "add [sensors.height_scanner]".into()))
}

/// Height of the base above the ground below each ray, less the offset, m.
fn height_scan(p: &ScanOffset, r: &RobotView, out: &mut [f32]) {
    let base = r.pose.position[2] - p.offset;
    for (x, hit) in out.iter_mut().zip(r.height_scan) {
        *x = base - hit;
    }
}

/// Numbers of the term `morphology`.
const MORPHOLOGY_SIZE: usize = 35;

/// Blocks of these numbers; see [`morphology`].
const MORPHOLOGY_BLOCKS: [Block; 7] = [
    Block::new(Per::Body, 1),
    Block::new(Per::Length, 1),
    Block::new(Per::Width, 1),
    Block::new(Per::Body, 4),
    Block::new(Per::Role, 5),
    Block::new(Per::Joint, 1),
    Block::new(Per::Body, 1),
];

/// Description of the body, each number of the order of one: total mass / 50 kg; distance of the
/// hips along and across the base, m; upper and lower leg and offset of the hip, mean over the
/// legs, m; radians per unit of action; then per role (HAA, HFE, KFE), mean over the legs:
/// stiffness / 100, damping / 5, effort limit / 100 (at most 10, also of a joint without a limit),
/// armature * 10, and the torque of one unit of action / weight / leg length, 0 without gravity;
/// the default joint positions in canonical order, rad; the spawn height, m.
///
/// Randomised bodies describe themselves as they are. Bodies that are no quadrupeds have zeros.
fn morphology(_: &NoParams, r: &RobotView, out: &mut [f32]) {
    let (body, model, stance) = (r.body, r.morphology, r.stance);
    let Some(joints) = model.quadruped else {
        out.fill(0.0);
        return;
    };
    let length = |v: &[f32; 3]| v[0].mul_add(v[0], v[1].mul_add(v[1], v[2] * v[2])).sqrt();
    let joint = |role: usize, leg: usize| joints[role][leg];
    let mean = |f: &dyn Fn(usize) -> f32| (f(0) + f(1) + f(2) + f(3)) * 0.25;
    let (mass, free_fall) = (body.total_mass(), r.ground.free_fall());
    // legs come in the order LF, LH, RF, RH
    let hip = |leg: usize| body.joint_offset[joint(0, leg)];
    let along = 0.5 * (hip(0)[0] + hip(2)[0] - hip(1)[0] - hip(3)[0]);
    let across = 0.5 * (hip(0)[1] + hip(1)[1] - hip(2)[1] - hip(3)[1]);
    let offset = mean(&|leg| length(&body.joint_offset[joint(1, leg)]));
    let upper = mean(&|leg| length(&body.joint_offset[joint(2, leg)]));
    let lower = mean(&|leg| length(&body.site_position[leg]));
    out[..7].copy_from_slice(&[mass / 50.0, along, across, upper, lower, offset, stance.action_scale]);
    for role in 0..3 {
        let stiffness = mean(&|leg| body.stiffness[joint(role, leg)]);
        let damping = mean(&|leg| body.damping[joint(role, leg)]);
        let effort = mean(&|leg| model.max_effort(joint(role, leg), body).min(MOST_EFFORT as f32));
        let armature = mean(&|leg| body.armature[joint(role, leg)]);
        let torque = stiffness * stance.action_scale;
        let authority = if free_fall > 0.0 { torque / (mass * free_fall * (upper + lower)) } else { 0.0 };
        out[7 + 5 * role..12 + 5 * role].copy_from_slice(&[
            stiffness / 100.0,
            damping / 5.0,
            effort / 100.0,
            armature * 10.0,
            authority,
        ]);
    }
    for (x, &joint) in out[22..34].iter_mut().zip(joints.as_flattened()) {
        *x = model.sign_of(joint) * stance.default_position[joint];
    }
    out[34] = stance.spawn_height;
}

/// Numbers of physical joints that turn with them, in the order and directions of the robot's
/// slots.
#[inline(always)]
fn by_slot(r: &RobotView, out: &mut [f32], f: impl Fn(usize) -> f32) {
    for (x, slot) in out.iter_mut().zip(&r.morphology.slots) {
        *x = slot.sign * f(slot.joint());
    }
}
