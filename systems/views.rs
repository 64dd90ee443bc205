//! The [`RobotView`]s of all robots, by blocks.

use bevy_ecs::prelude::*;
use bevy_ecs::system::SystemParam;

use super::commanded::{CommandTerm, CommandView};
use super::terms::CompiledTask;
use super::view::RobotView;
use crate::blocks::{Block, BlockIter, Blocks};
use crate::components::{
    Action, BasePose, BaseVelocity, Body, Command, CommandNumbers, ContactSensor, Env, EnvOrigin, Feet, HeightScan,
    Imu, JointDescriptors, JointEffort, JointState, RayCasterCamera, Robot, Stance,
};
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::workers::SplitRows;
use crate::world::Ground;

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
    images: Blocks<'w, 's, &'static RayCasterCamera, RayCasterCamera>,
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
        let blocks = of_all.zip_some(self.scans.read_some()?).zip_some(self.images.read_some()?);
        let blocks = blocks.zip_some(self.descriptors.read_some()?);
        Ok(blocks.map(move |morphology, ((((((robots, envs), imus), contacts), scans), images), descriptors)| {
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
                images: images.unwrap_or_default(),
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
    images: &'a [RayCasterCamera],
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
            image: self.images.get(row).map_or(&[], |camera| &camera.depth),
            is_new_image: self.images.get(row).is_some_and(|camera| camera.is_new),
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
