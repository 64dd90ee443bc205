//! Views for terms: a robot, its body, its new state, the end of an episode.

use bevy_ecs::prelude::*;
use bevy_ecs::system::SystemParam;

use super::command::{CommandTerm, CommandView};
use super::terms::CompiledTask;
use crate::blocks::{Block, BlockIter, Blocks};
use crate::components::{
    Action, ActuatorDelay, BasePose, BaseVelocity, Body, Command, CommandNumbers, ContactSensor, CurriculumProgress,
    Env, EnvOrigin, Episode, EpisodeSums, ExternalWrench, Feet, HeightScan, Imu, JointDescriptors, JointEffort,
    JointState, Robot, Stance,
};
use crate::dynamics::Parameters;
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::terrain::TerrainLayout;
use crate::workers::SplitRows;
use crate::world::Ground;

/// All that reward, observation and termination terms may read of one robot and its env.
#[derive(Clone, Copy)]
pub struct RobotView<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Forward and left velocity (m/s) and yaw rate (rad/s) that it is to follow, base frame.
    pub command: &'a [f32; 3],
    /// Its other commands.
    pub commands: CommandView<'a>,
    /// Pose of the base; see [`base_height`](Self::base_height) for its height above the ground.
    pub pose: &'a BasePose,
    /// Velocity of the base.
    pub velocity: &'a BaseVelocity,
    /// Velocity and gravity in the base frame.
    pub imu: &'a Imu,
    /// Joint positions and velocities, physical order.
    pub joints: &'a JointState,
    /// Joint efforts and accelerations, physical order.
    pub effort: &'a JointEffort,
    /// Present and previous action, canonical order.
    pub action: &'a Action,
    /// Contact forces and times.
    pub contacts: &'a ContactSensor,
    /// Positions, velocities and heights of the feet.
    pub feet: &'a Feet,
    /// Heights of the ground where the height scanner's rays hit it, m; empty where the task has
    /// none.
    pub height_scan: &'a [f32],
    /// Descriptions of its joints, see [`JointDescriptors`]; empty where the task does not observe
    /// them.
    pub joint_descriptors: &'a [f32],
    /// The robot's own numbers, as randomised.
    pub body: &'a Parameters<f32>,
    /// Default pose and action scale of this body.
    pub stance: &'a Stance,
    /// Ground that the robots stand on, and gravity.
    pub ground: &'a Ground,
    /// Where the env is on the ground.
    pub origin: &'a EnvOrigin,
    /// Whether the episode ends as failed in this step. Rewards alone know: for other terms it is
    /// false.
    pub terminated: bool,
    /// Length of a control step, s.
    pub step_dt: f32,
}

impl RobotView<'_> {
    /// Height of the base's origin above the ground below it, m; above the mean of the ground below
    /// the height scanner's rays where the task has one, as Isaac Lab does.
    #[inline(always)]
    pub fn base_height(&self) -> f32 {
        let (scan, [x, y, z]) = (self.height_scan, self.pose.position);
        let ground = match scan.len() {
            0 => self.ground.height_at(self.origin, [x, y]),
            rays => scan.iter().sum::<f32>() / rays as f32,
        };
        z - ground
    }
}

/// System parameter that gives [`Views`].
#[derive(SystemParam)]
pub(super) struct ViewParam<'w, 's> {
    morphologies: Res<'w, Morphologies>,
    ground: Res<'w, Ground>,
    robots: Blocks<'w, 's, RobotColumns, Robot>,
    task: Res<'w, CompiledTask>,
    envs: Blocks<'w, 's, (&'static Command, &'static CommandNumbers, &'static EnvOrigin), Env>,
    imus: Blocks<'w, 's, &'static Imu, Imu>,
    contacts: Blocks<'w, 's, &'static ContactSensor, ContactSensor>,
    scans: Blocks<'w, 's, &'static HeightScan, HeightScan>,
    descriptors: Blocks<'w, 's, &'static JointDescriptors, JointDescriptors>,
}

/// Components of robots that terms read.
type RobotColumns = (
    &'static BasePose,
    &'static BaseVelocity,
    &'static JointState,
    &'static JointEffort,
    &'static Action,
    &'static Feet,
    &'static Body,
    &'static Stance,
);

impl ViewParam<'_, '_> {
    pub(super) fn views(&self, step_dt: f32) -> Result<BlockIter<impl Iterator<Item = Block<Views<'_>>>>, Error> {
        let of_all = self.robots.read()?.zip(self.envs.read()?).zip(self.imus.read()?).zip(self.contacts.read()?);
        let blocks = of_all.zip_some(self.scans.read_some()?).zip_some(self.descriptors.read_some()?);
        Ok(blocks.map(move |morphology, (((((robots, envs), imus), contacts), scans), descriptors)| {
            let (poses, velocities, joints, efforts, actions, feet, bodies, stances) = robots;
            let (commands, numbers, origins) = envs;
            Views {
                morphology: self.morphologies.get(morphology),
                ground: &self.ground,
                first: 0,
                commands,
                terms: &self.task.command_terms,
                numbers,
                origins,
                poses,
                velocities,
                imus,
                joints,
                efforts,
                actions,
                contacts,
                feet,
                scans: scans.unwrap_or_default(),
                descriptors: descriptors.unwrap_or_default(),
                bodies,
                stances,
                step_dt,
            }
        }))
    }
}

/// The views of a block's robots, or of some consecutive ones.
#[derive(Clone, Copy)]
pub(super) struct Views<'a> {
    morphology: &'a MorphologyModel,
    ground: &'a Ground,
    /// Row of the first robot in the slices.
    first: usize,
    commands: &'a [Command],
    terms: &'a [CommandTerm],
    numbers: &'a [CommandNumbers],
    origins: &'a [EnvOrigin],
    poses: &'a [BasePose],
    velocities: &'a [BaseVelocity],
    imus: &'a [Imu],
    joints: &'a [JointState],
    efforts: &'a [JointEffort],
    actions: &'a [Action],
    contacts: &'a [ContactSensor],
    feet: &'a [Feet],
    scans: &'a [HeightScan],
    descriptors: &'a [JointDescriptors],
    bodies: &'a [Body],
    stances: &'a [Stance],
    step_dt: f32,
}

impl SplitRows for Views<'_> {
    fn split_rows(self, n: usize) -> (Self, Self) {
        (self, Self { first: self.first + n, ..self })
    }
}

impl<'a> Views<'a> {
    /// The view of the robot in a row.
    #[inline(always)]
    pub(super) fn get(&self, row: usize) -> RobotView<'a> {
        let row = self.first + row;
        RobotView {
            morphology: self.morphology,
            command: &self.commands[row].velocity,
            commands: CommandView { terms: self.terms, numbers: &self.numbers[row].numbers },
            pose: &self.poses[row],
            velocity: &self.velocities[row],
            imu: &self.imus[row],
            joints: &self.joints[row],
            effort: &self.efforts[row],
            action: &self.actions[row],
            contacts: &self.contacts[row],
            feet: &self.feet[row],
            height_scan: self.scans.get(row).map_or(&[], |scan| &scan.hits),
            joint_descriptors: self.descriptors.get(row).map_or(&[], |of| &of.numbers),
            body: &self.bodies[row].0,
            stance: &self.stances[row],
            ground: self.ground,
            origin: &self.origins[row],
            terminated: false,
            step_dt: self.step_dt,
        }
    }
}

/// A robot's numbers, as events of its body may change them.
pub struct NewBody<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Ground that it will stand on.
    pub ground: &'a Ground,
    /// Masses, lengths, gains and friction: at startup the morphology's, at a reset the result of
    /// the startup events.
    pub parameters: &'a mut Parameters<f32>,
    /// Default pose, action scale and the height at which its episodes begin, with the same start.
    pub stance: &'a mut Stance,
}

impl NewBody<'_> {
    /// Sets the robot's friction coefficients; the ground's are combined with them.
    pub fn set_material(&mut self, static_friction: f32, dynamic_friction: f32) {
        let [static_friction, dynamic_friction] = self.ground.friction_with([static_friction, dynamic_friction]);
        self.parameters.static_friction = static_friction;
        self.parameters.dynamic_friction = dynamic_friction;
    }

    /// Sets the coefficients of torsional and rolling friction of the robot's surface, m; `None`
    /// leaves one as it is. The larger one of robot and ground acts. They act on robots for which
    /// the task has such friction: see
    /// [`CompiledTask::contact_friction`](super::CompiledTask::contact_friction).
    pub fn set_spin_friction(&mut self, torsional: Option<f32>, rolling: Option<f32>) {
        let of_robot = [torsional, rolling].map(Option::unwrap_or_default);
        let [combined_torsional, combined_rolling] = self.ground.spin_friction_with(of_robot);
        if torsional.is_some() {
            self.parameters.torsional_friction = combined_torsional;
        }
        if rolling.is_some() {
            self.parameters.rolling_friction = combined_rolling;
        }
    }
}

/// The state in which an episode begins, as reset events may change it.
pub struct NewState<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Pose of the base; starts at the env's origin, at the spawn height above level ground, level.
    /// Afterwards it is lifted onto what stands there, and further until no collision shape is
    /// nearer to the ground than the reset's `spawn_margin`.
    pub pose: &'a mut BasePose,
    /// Velocity of the base; starts at rest.
    pub velocity: &'a mut BaseVelocity,
    /// Joints; start at rest in the default pose.
    pub joints: &'a mut JointState,
    /// How late each joint's targets come; starts as the actuators' own delays.
    pub delay: &'a mut ActuatorDelay,
    /// Force and torque from outside; start at zero.
    pub wrench: &'a mut ExternalWrench,
    /// The robot's own numbers.
    pub body: &'a Parameters<f32>,
}

/// An episode that is over, and what its end may change.
pub struct EpisodeEnd<'a> {
    /// How it ended.
    pub episode: &'a Episode,
    /// Where the robot was then.
    pub pose: &'a BasePose,
    /// Command at the end.
    pub command: &'a Command,
    /// Sums of its rewards and errors.
    pub sums: &'a EpisodeSums,
    /// Morphology of the robot, as its place among those of the task.
    pub(super) robot: usize,
    /// The task.
    pub(super) task: &'a CompiledTask,
    /// Progress of the env through the curriculum.
    pub progress: &'a mut CurriculumProgress,
    /// Length of a full episode, s.
    pub episode_length_s: f32,
    /// Time since the episode's reset, s.
    pub lived_s: f32,
    /// Time that the robot was given, s: all until the time-out where a termination of the task
    /// ended the episode, and `lived_s` where the time ran out or a caller ended it.
    pub given_s: f32,
    /// The tiles, if the ground is generated terrain.
    pub layout: Option<&'a TerrainLayout>,
    /// Where the next episode begins.
    pub origin: &'a mut EnvOrigin,
}

/// Robot as an interval event may change it.
pub struct EventBody<'a> {
    /// Morphology of the robot.
    pub morphology: &'a MorphologyModel,
    /// Force and torque from outside; hold until the next reset or event.
    pub wrench: &'a mut ExternalWrench,
    /// Velocity of the base.
    pub velocity: &'a mut BaseVelocity,
}
