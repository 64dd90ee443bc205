//! Events of a robot's body: randomisation when the envs are made, and at each reset.

use bevy_ecs::prelude::*;
use serde::Deserialize;

use super::ResetRequest;
use super::sampling::{self, Source};
use super::terms::{BODY_VARIATION, CompiledTask, NoParams, PHYSICS_MATERIAL, PhysicsMaterial, Registry};
use super::view::NewBody;
use crate::blocks::Blocks;
use crate::components::{Body, Env, EnvId, EnvRng, Episode, Morphology, Robot, Stance, StartupBody};
use crate::config::quantities::{Angle, BodyFactor, Power, Strength};
use crate::config::{Distribution, Draw, Operation, values};
use crate::dynamics::{ActuatorNetwork, Parameters, SharedArray};
use crate::engine::device::{BODY_NUMBERS, BodyList, DrawForm, FormKind};
use crate::morphology::{Morphologies, MorphologyModel};
use crate::options::Autoreset;
use crate::variation::BodyScales;
use crate::world::Ground;

/// Gives every robot its material and applies the task's startup events, each env from its own
/// stream.
pub fn randomise_at_startup(
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    ground: Res<Ground>,
    mut robots: Query<(&EnvId, &Morphology, &mut Body, &mut Stance, &mut StartupBody), With<Robot>>,
    mut envs: Blocks<&'static mut EnvRng, Env>,
) -> Result {
    let mut rngs = envs.write()?;
    for (env, tag, mut body, mut stance, mut startup) in &mut robots {
        let Some((rngs, row)) = rngs.at_mut(env.0 as usize) else {
            continue;
        };
        let rng = &mut rngs[row];
        let morphology = morphologies.get(*tag);
        stance.clone_from(&morphology.stance);
        let mut new = NewBody { morphology, ground: &ground, parameters: &mut body.0, stance: &mut stance };
        let material = &task.config.robot_material;
        new.set_material(material.static_friction as f32, material.dynamic_friction as f32);
        new.set_spin_friction(Some(material.torsional_friction as f32), Some(material.rolling_friction as f32));
        new.parameters.restitution = ground.restitution_with(material.restitution as f32);
        for event in &task.startup_events {
            event(&mut new, rng);
        }
        startup.0 = (!task.reset_body_events.is_empty()).then(|| Box::new((body.0.as_ref().clone(), stance.clone())));
    }
    Ok(())
}

/// Whether an env is reset now: in the schedule that `request` tells of.
pub(super) fn is_due(episode: &Episode, autoreset: Autoreset, request: ResetRequest) -> bool {
    episode.needs_reset
        && (request.0
            || match autoreset {
                Autoreset::SameStep => true,
                Autoreset::NextStep => !episode.done(),
                Autoreset::Disabled => false,
            })
}

/// Samples the bodies of the envs that are about to be reset, starting from the bodies of the
/// startup events.
pub(super) fn reset_bodies(
    morphologies: Res<Morphologies>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    request: Res<ResetRequest>,
    ground: Res<Ground>,
    mut robots: Query<(&EnvId, &Morphology, &mut Body, &mut Stance, &StartupBody), With<Robot>>,
    mut envs: Blocks<(&'static Episode, &'static mut EnvRng), Env>,
) -> Result {
    if task.reset_body_events.is_empty() {
        return Ok(());
    }
    let mut envs = envs.write()?;
    for (env, tag, mut body, mut stance, startup) in &mut robots {
        let Some(((episodes, rngs), row)) = envs.at_mut(env.0 as usize) else {
            continue;
        };
        if !is_due(&episodes[row], *autoreset, *request) {
            continue;
        }
        let rng = &mut rngs[row];
        if let Some(startup) = &startup.0 {
            *body.0 = startup.0.clone();
            *stance = startup.1.clone();
        }
        let morphology = morphologies.get(*tag);
        let mut new = NewBody { morphology, ground: &ground, parameters: &mut body.0, stance: &mut stance };
        for event in &task.reset_body_events {
            event(&mut new, rng);
        }
    }
    Ok(())
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BaseMass {
    /// Whether the inertia is scaled with the mass. Default: yes.
    #[serde(default = "yes")]
    recompute_inertia: bool,
    /// Range of factors on the base's mass in place of each robot's own offsets, kg. Default: the
    /// offsets.
    #[serde(default, deserialize_with = "values::optional_range_of::<BodyFactor, _, _>")]
    mass_scale_range: Option<[f64; 2]>,
}

fn yes() -> bool {
    true
}

/// Draws for stiffness and damping of each joint: the robots' own, or the task's.
#[derive(Deserialize)]
#[serde(try_from = "UncheckedGains")]
struct ActuatorGains(Source<[Option<Draw>; 2]>);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct UncheckedGains {
    /// Bounds of the draw for stiffness, or mean and deviation. Default: each robot's own.
    stiffness_distribution_params: Option<[f64; 2]>,
    /// Bounds of the draw for damping, or mean and deviation. Default: each robot's own.
    damping_distribution_params: Option<[f64; 2]>,
    /// Effect of the drawn number on the present one. Default: `scale`.
    operation: Option<Operation>,
    /// Distribution of the draw. Default: `uniform`.
    distribution: Option<Distribution>,
}

impl TryFrom<UncheckedGains> for ActuatorGains {
    type Error = String;

    fn try_from(p: UncheckedGains) -> Result<Self, String> {
        let params = [p.stiffness_distribution_params, p.damping_distribution_params];
        sampling::of_task(params, p.operation, p.distribution).map(Self)
    }
}

impl ActuatorGains {
    /// The draws for a robot.
    fn draws(&self, robot: &MorphologyModel) -> [Option<Draw>; 2] {
        let own = &robot.config.randomization;
        match &self.0 {
            Source::Robot => [Some(own.stiffness), Some(own.damping)],
            Source::Task(draws) => *draws,
        }
    }
}

/// Draws for armature, dry friction and viscous friction of each joint: the robots' own, or the
/// task's.
#[derive(Deserialize)]
#[serde(try_from = "UncheckedJoints")]
struct JointParameters(Source<[Option<Draw>; 3]>);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct UncheckedJoints {
    /// Bounds of the draw for armature, or mean and deviation. Default: each robot's own.
    armature_distribution_params: Option<[f64; 2]>,
    /// Bounds of the draw for dry friction, or mean and deviation. Default: each robot's own.
    friction_distribution_params: Option<[f64; 2]>,
    /// Bounds of the draw for viscous friction, or mean and deviation. Default: each robot's own.
    viscous_friction_distribution_params: Option<[f64; 2]>,
    /// Effect of the drawn number on the present one. Default: `scale`.
    operation: Option<Operation>,
    /// Distribution of the draw. Default: `uniform`.
    distribution: Option<Distribution>,
}

impl TryFrom<UncheckedJoints> for JointParameters {
    type Error = String;

    fn try_from(p: UncheckedJoints) -> Result<Self, String> {
        let params =
            [p.armature_distribution_params, p.friction_distribution_params, p.viscous_friction_distribution_params];
        sampling::of_task(params, p.operation, p.distribution).map(Self)
    }
}

impl JointParameters {
    /// The draws for a robot.
    fn draws(&self, robot: &MorphologyModel) -> [Option<Draw>; 3] {
        let own = &robot.config.randomization;
        match &self.0 {
            Source::Robot => [Some(own.armature), Some(own.joint_friction), own.joint_damping],
            Source::Task(draws) => *draws,
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MotorStrength {
    /// Share of its torque that each motor gives. Default: each robot's own range.
    #[serde(default, deserialize_with = "values::optional_range_of::<Strength, _, _>")]
    strength_range: Option<[f64; 2]>,
}

impl MotorStrength {
    /// The range for a robot.
    fn range(&self, robot: &MorphologyModel) -> [f32; 2] {
        self.strength_range.unwrap_or(robot.config.randomization.motor_strength).map(|x| x as f32)
    }
}

/// Variation that a task gives all robots, in addition to each robot's own `[variation]`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TaskVariation {
    /// Power to which the robots' own factors are raised: 1 as they are, 2 about twice as far from
    /// the URDF's body.
    #[serde(default = "one", deserialize_with = "values::number_of::<Power, _, _>")]
    range_power: f64,
    /// Factor on all lengths; the rest follows by dynamic similarity. Default: none.
    #[serde(default, deserialize_with = "values::optional_range_of::<BodyFactor, _, _>")]
    size: Option<[f64; 2]>,
    /// Factor on the joint target per unit of action. Default: none.
    #[serde(default, deserialize_with = "values::optional_range_of::<BodyFactor, _, _>")]
    action_scale: Option<[f64; 2]>,
    /// Factor on the angles of hip flexion and knee in the default pose. Default: none.
    #[serde(default, deserialize_with = "values::optional_range_of::<BodyFactor, _, _>")]
    default_flexion: Option<[f64; 2]>,
    /// Angle by which the legs are spread more in the default pose, rad. Default: 0.
    #[serde(default, deserialize_with = "values::optional_range_of::<Angle, _, _>")]
    default_abduction: Option<[f64; 2]>,
}

fn one() -> f64 {
    1.0
}

/// All built-in events of a robot's body, under Isaac Lab's names where it has them; they happen in
/// this order.
pub(super) fn register(registry: &mut Registry) {
    registry.body_event(BODY_VARIATION, body_variation);
    registry.body_event(PHYSICS_MATERIAL, physics_material);
    registry.body_event("add_base_mass", add_base_mass);
    registry.body_event("base_com", base_com);
    registry.body_event("randomize_actuator_gains", randomize_actuator_gains);
    registry.body_event("randomize_joint_parameters", randomize_joint_parameters);
    registry.body_event("randomize_motor_strength", randomize_motor_strength);
    on_device(registry);
}

/// Most values of a coefficient of friction that the device has a table of.
const MOST_VALUES: u32 = 4096;

/// The numbers of these events in `device/env.h`. [`BODY_VARIATION`] has none: it computes in
/// double precision.
fn on_device(registry: &mut Registry) {
    registry.on_device(FormKind::BodyEvent, PHYSICS_MATERIAL, |p: PhysicsMaterial, robot| {
        let ranges = &robot.config.randomization;
        let last = p.num_buckets.max(1) - 1;
        let spins = p.spin_ranges(robot);
        let two = [
            Some(p.static_friction_range.unwrap_or(ranges.static_friction)),
            Some(p.dynamic_friction_range.unwrap_or(ranges.dynamic_friction)),
        ];
        let values = two.into_iter().chain(spins).flatten();
        let values = values.flat_map(|range| (0..=last).map(move |at| bucket(range, last, at)));
        let integers = vec![last.cast_signed(), i32::from(spins[0].is_some()), i32::from(spins[1].is_some())];
        (last < MOST_VALUES).then(|| (values.collect(), Some(integers)))
    });
    registry.on_device(FormKind::BodyEvent, "add_base_mass", |p: BaseMass, robot| {
        let range = p.mass_scale_range.unwrap_or(robot.config.randomization.base_mass_offset);
        let integers = vec![i32::from(p.recompute_inertia), i32::from(p.mass_scale_range.is_some())];
        Some((range.map(|x| x as f32).to_vec(), Some(integers)))
    });
    registry.on_device(FormKind::BodyEvent, "base_com", |NoParams {}, robot| {
        let offset = &robot.config.randomization.base_com_offset;
        let ranges = [offset.x, offset.y, offset.z].map(|range| range.map(|x| x as f32));
        Some((ranges.as_flattened().to_vec(), Some(Vec::new())))
    });
    registry.on_device(FormKind::BodyEvent, "randomize_actuator_gains", |p: ActuatorGains, robot| {
        let [stiffness, damping] = p.draws(robot);
        draw_lists(robot, &[(stiffness, BodyList::Stiffness), (damping, BodyList::Damping)])
    });
    registry.on_device(FormKind::BodyEvent, "randomize_joint_parameters", |p: JointParameters, robot| {
        let [armature, friction, viscous] = p.draws(robot);
        let viscous = (viscous, BodyList::JointDamping);
        draw_lists(robot, &[(armature, BodyList::Armature), (friction, BodyList::JointFriction), viscous])
    });
    registry.on_device(FormKind::BodyEvent, "randomize_motor_strength", |p: MotorStrength, robot| {
        Some((p.range(robot).to_vec(), Some(Vec::new())))
    });
}

/// Numbers and integers of draws for each joint, if all are uniform: the others need the logarithm
/// in double precision.
fn draw_lists(robot: &MorphologyModel, draws: &[(Option<Draw>, BodyList)]) -> Option<(Vec<f32>, Option<Vec<i32>>)> {
    let (mut numbers, mut integers) = (Vec::new(), Vec::new());
    for (draw, list) in draws.iter().filter_map(|(draw, list)| draw.map(|draw| (draw, *list))) {
        if draw.distribution != Distribution::Uniform {
            return None;
        }
        let operation = match draw.operation {
            Operation::Add => DrawForm::Add,
            Operation::Scale => DrawForm::Scale,
            Operation::Abs => DrawForm::Abs,
            Operation::AddEffortShare => DrawForm::AddEffortShare,
        };
        numbers.extend(draw.distribution_params.map(|x| x as f32));
        integers.extend([list.code(), operation.code()]);
    }
    numbers.extend(robot.effort_shares());
    Some((numbers, Some(integers)))
}

/// Numbers of a body that events at resets change, as the device has them: see [`BodyList`].
pub(super) fn changing_numbers(p: &Parameters<f32>) -> Vec<f32> {
    let [com, inertia] = [p.com[0].as_slice(), p.inertia[0].as_slice()];
    let friction = [p.static_friction, p.dynamic_friction, p.torsional_friction, p.rolling_friction];
    let numbers = [&[p.mass[0]], com, inertia, &friction].concat();
    debug_assert_eq!(numbers.len(), BODY_NUMBERS);
    let lists = BodyList::ALL.iter().flat_map(|&list| list_of(p, list).iter());
    numbers.iter().chain(lists).copied().collect()
}

/// Gives a body those numbers. Lists that have them stay shared.
pub(super) fn set_changing_numbers(p: &mut Parameters<f32>, numbers: &[f32]) {
    let bits = |numbers: &[f32]| numbers.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    let (base, mut lists) = numbers.split_at(BODY_NUMBERS);
    p.mass[0] = base[0];
    p.com[0].copy_from_slice(&base[1..4]);
    p.inertia[0].copy_from_slice(&base[4..10]);
    (p.static_friction, p.dynamic_friction) = (base[10], base[11]);
    (p.torsional_friction, p.rolling_friction) = (base[12], base[13]);
    for list in BodyList::ALL {
        let joints = list_of(p, list).len();
        let (own, rest) = lists.split_at(joints);
        lists = rest;
        if bits(list_of(p, list)) != bits(own) {
            list_of_mut(p, list).iter_mut().zip(own).for_each(|(x, own)| *x = *own);
        }
    }
}

fn list_of(p: &Parameters<f32>, list: BodyList) -> &SharedArray<f32> {
    match list {
        BodyList::Stiffness => &p.stiffness,
        BodyList::Damping => &p.damping,
        BodyList::EffortLimit => &p.effort_limit,
        BodyList::SaturationEffort => &p.saturation_effort,
        BodyList::Armature => &p.armature,
        BodyList::JointFriction => &p.joint_friction,
        BodyList::JointDamping => &p.joint_damping,
    }
}

fn list_of_mut(p: &mut Parameters<f32>, list: BodyList) -> &mut SharedArray<f32> {
    match list {
        BodyList::Stiffness => &mut p.stiffness,
        BodyList::Damping => &mut p.damping,
        BodyList::EffortLimit => &mut p.effort_limit,
        BodyList::SaturationEffort => &mut p.saturation_effort,
        BodyList::Armature => &mut p.armature,
        BodyList::JointFriction => &mut p.joint_friction,
        BodyList::JointDamping => &mut p.joint_damping,
    }
}

/// Whether a reset that starts from the body of the startup events undoes all changes but those of
/// [`changing_numbers`].
pub(super) fn differs_as_resets_do(body: &Parameters<f32>, stance: &Stance, startup: &StartupBody) -> bool {
    let Some(startup) = &startup.0 else { return false };
    let mut changed = startup.0.clone();
    set_changing_numbers(&mut changed, &changing_numbers(body));
    *stance == startup.1 && !changed.any_with(body, |own, other| own.to_bits() != other.to_bits())
}

/// Varies the body, by the ranges of the robot's `[variation]` and of the task.
fn body_variation(p: &TaskVariation, body: &mut NewBody, rng: &mut EnvRng) {
    let ranges = &body.morphology.config.variation;
    let mut uniform = |range: [f64; 2]| f64::from(rng.uniform(range.map(|x| x as f32)));
    let mut draw =
        |range: [f64; 2]| uniform(range.map(|x| if p.range_power == 1.0 { x } else { libm::pow(x, p.range_power) }));
    let scales = BodyScales {
        base_length: draw(ranges.base_length),
        base_width: draw(ranges.base_width),
        hip_offset: draw(ranges.hip_offset),
        thigh_length: draw(ranges.thigh_length),
        shank_length: draw(ranges.shank_length),
        base_mass: draw(ranges.base_mass),
        hip_mass: draw(ranges.hip_mass),
        thigh_mass: draw(ranges.thigh_mass),
        shank_mass: draw(ranges.shank_mass),
        joint_range: draw(ranges.joint_range),
        stiffness: draw(ranges.stiffness),
        damping: draw(ranges.damping),
        size: p.size.map_or(1.0, &mut uniform),
        action_scale: p.action_scale.map_or(1.0, &mut uniform),
        default_flexion: p.default_flexion.map_or(1.0, &mut uniform),
        default_abduction: p.default_abduction.map_or(0.0, &mut uniform),
    };
    scales.apply(body.morphology, body.parameters, body.stance);
}

/// Samples each coefficient of friction that has a range from `num_buckets` values, the dynamic one
/// at most the static one.
fn physics_material(p: &PhysicsMaterial, body: &mut NewBody, rng: &mut EnvRng) {
    let ranges = &body.morphology.config.randomization;
    let last = p.num_buckets.max(1) - 1;
    let mut draw = |range: [f64; 2]| bucket(range, last, if last == 0 { 0 } else { rng.integer([0, last]) });
    let static_friction = draw(p.static_friction_range.unwrap_or(ranges.static_friction));
    let dynamic_friction = draw(p.dynamic_friction_range.unwrap_or(ranges.dynamic_friction)).min(static_friction);
    let [torsional, rolling] = p.spin_ranges(body.morphology).map(|range| range.map(&mut draw));
    body.set_material(static_friction, dynamic_friction);
    body.set_spin_friction(torsional, rolling);
}

/// A value between the ends of a range, one of `last` and one more that are equally spaced; the
/// middle where there is one.
fn bucket([low, high]: [f64; 2], last: u32, at: u32) -> f32 {
    let share = if last == 0 { 0.5 } else { f64::from(at) / f64::from(last) };
    (low + (high - low) * share) as f32
}

/// Adds mass to the base, or scales it, and, unless told otherwise, scales its inertia with it.
fn add_base_mass(p: &BaseMass, body: &mut NewBody, rng: &mut EnvRng) {
    const LIGHTEST: f32 = 0.01;
    let old = body.parameters.mass[0];
    let new = match p.mass_scale_range {
        None => old + rng.uniform(body.morphology.config.randomization.base_mass_offset.map(|x| x as f32)),
        Some(range) => old * rng.uniform(range.map(|x| x as f32)),
    };
    let new = new.max(LIGHTEST);
    body.parameters.mass[0] = new;
    if p.recompute_inertia {
        for x in &mut body.parameters.inertia[0] {
            *x *= new / old;
        }
    }
}

/// Moves the base's centre of mass.
fn base_com(_: &NoParams, body: &mut NewBody, rng: &mut EnvRng) {
    let offset = &body.morphology.config.randomization.base_com_offset;
    for (x, range) in body.parameters.com[0].iter_mut().zip([offset.x, offset.y, offset.z]) {
        *x += rng.uniform(range.map(|x| x as f32));
    }
}

/// Stiffness and damping of each actuator for itself; joints that a network drives keep none.
fn randomize_actuator_gains(p: &ActuatorGains, body: &mut NewBody, rng: &mut EnvRng) {
    let [stiffness, damping] = p.draws(body.morphology);
    each_joint(stiffness, body, |p| &mut p.stiffness, rng);
    each_joint(damping, body, |p| &mut p.damping, rng);
    // networks have no gains, whatever was drawn
    for &joint in body.morphology.networks.iter().flat_map(ActuatorNetwork::joints) {
        (body.parameters.stiffness[joint], body.parameters.damping[joint]) = (0.0, 0.0);
    }
}

/// Armature, dry friction and viscous friction of each joint for itself.
fn randomize_joint_parameters(p: &JointParameters, body: &mut NewBody, rng: &mut EnvRng) {
    let [armature, friction, viscous] = p.draws(body.morphology);
    each_joint(armature, body, |p| &mut p.armature, rng);
    each_joint(friction, body, |p| &mut p.joint_friction, rng);
    each_joint(viscous, body, |p| &mut p.joint_damping, rng);
}

/// A list of numbers of joints.
type JointList = fn(&mut Parameters<f32>) -> &mut SharedArray<f32>;

fn each_joint(draw: Option<Draw>, body: &mut NewBody, list: JointList, rng: &mut EnvRng) {
    let Some(draw) = draw else {
        return;
    };
    for joint in 0..body.morphology.topology.num_joints() {
        let effort = body.morphology.max_effort(joint, body.parameters);
        let value = &mut list(body.parameters)[joint];
        *value = sampling::apply(&draw, *value, effort, rng);
    }
}

/// Scales each motor: its torque at any target and its limits, so that the same targets give a
/// share of the torque. The speed without load stays. Where a network gives the torque, only the
/// limits are scaled.
fn randomize_motor_strength(p: &MotorStrength, body: &mut NewBody, rng: &mut EnvRng) {
    let range = p.range(body.morphology);
    let b = &mut *body.parameters;
    for j in 0..b.stiffness.len() {
        let share = rng.uniform(range);
        for x in [&mut b.stiffness[j], &mut b.damping[j]] {
            *x *= share;
        }
        // an absent limit has no share
        for x in [&mut b.effort_limit[j], &mut b.saturation_effort[j]] {
            if x.is_finite() {
                *x *= share;
            }
        }
    }
}
