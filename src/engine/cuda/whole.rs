//! Whole control steps on the device: the robots' state stays there.

use polypod_cuda::{Device, DeviceBlock, DeviceError, EnvBlock, EnvHost, Flow, RowSizes, TaskTables, Told};

use super::robots::{self, Means, Robots};
use super::{DeviceEngine, Placed};
use crate::blocks::{Block, BlockList};
use crate::engine::{DivergenceRecord, RobotSlices, Run, StateLimits};
use crate::workers::Workers;

/// A robot whose state broke in a whole control step.
pub struct BrokenRobot {
    /// Its state before the physics and after it.
    pub record: DivergenceRecord,
    /// Length of its episode before, control steps.
    pub length: u32,
    /// Numbers of its body, where resets change them, as `Column::Body` of `polypod-cuda` has them.
    pub body: Option<Vec<f32>>,
}

/// An engine whose device makes whole control steps. Blocks are those of the morphologies that have
/// robots, in their order. An error means that the device is lost.
pub trait WholeSteps {
    /// Takes over tasks and the robots' components. Returns whether it could: some states of robots
    /// the device steps with the host alone. [`upload`](Self::upload) follows when the columns of
    /// all [`hosts`](Self::hosts) are written.
    ///
    /// # Errors
    /// Too little memory, or a device that is lost.
    fn enter(
        &mut self,
        workers: &Workers,
        robots: BlockList<RobotSlices<'_>>,
        tasks: Vec<TaskTables>,
        sizes: RowSizes,
    ) -> Result<bool, DeviceError>;

    /// Whether steps of the host may share the robots between the device and the CPU, as is
    /// fastest: then somebody must time whether whole steps on the device are faster.
    fn may_share(&self) -> bool;

    /// Lets steps of the host share the robots, or leaves all robots to the CPU in such steps.
    fn share(&mut self, share: bool);

    /// The device, which has the arrays of all envs.
    ///
    /// # Errors
    /// A device that is lost.
    fn device(&self) -> Result<&dyn Device, DeviceError>;

    /// The host's side of each block.
    fn hosts(&mut self) -> Vec<EnvHost<'_>>;

    /// Flags and ended episodes of each block in the control step of a slot, which has ended.
    fn told(&mut self, slot: usize) -> Vec<Told<'_>>;

    /// Sends all to the device.
    ///
    /// # Errors
    /// A device that is lost.
    fn upload(&mut self) -> Result<(), DeviceError>;

    /// Makes a whole control step of all envs, and keeps the states of the blocks that are watched.
    /// Waits for it unless it flows.
    ///
    /// # Errors
    /// A device that is lost.
    fn step(&mut self, watched: &[bool], flow: Option<Flow>) -> Result<(), DeviceError>;

    /// A robot of a watched block whose state broke; `None` if it was not watched. The block is no
    /// longer watched.
    ///
    /// # Errors
    /// A device that is lost.
    fn record(&mut self, block: usize, robot: usize) -> Result<Option<BrokenRobot>, DeviceError>;

    /// Brings everything to the host's side, and writes the robots' components.
    ///
    /// # Errors
    /// A device that is lost.
    fn leave(&mut self, workers: &Workers, robots: BlockList<RobotSlices<'_>>) -> Result<(), DeviceError>;
}

fn envs(block: &mut dyn DeviceBlock) -> Result<&mut dyn EnvBlock, DeviceError> {
    block.envs().ok_or_else(DeviceError::no_envs)
}

impl DeviceEngine {
    fn placed(&mut self) -> Result<&mut Placed, DeviceError> {
        self.placed.as_mut().ok_or_else(DeviceError::no_envs)
    }
}

impl WholeSteps for DeviceEngine {
    fn enter(
        &mut self,
        workers: &Workers,
        blocks: BlockList<RobotSlices<'_>>,
        tasks: Vec<TaskTables>,
        sizes: RowSizes,
    ) -> Result<bool, DeviceError> {
        let Placed { device, settings, heights, robots, .. } = self.placed()?;
        let means = Means { device: &**device, settings, heights: heights.as_ref(), workers };
        let mut blocks: Vec<Block<RobotSlices<'_>>> = blocks.into_iter().collect();
        if blocks.iter().any(|block| block.rows.link_forces.iter().any(|forces| !forces.0.is_empty())) {
            return Ok(false);
        }
        device.place_rows(sizes)?;
        for (robots, task) in robots.iter_mut().zip(tasks) {
            robots.place(&means, task)?;
        }
        robots::read_rows(workers, robots.iter_mut().zip(&mut blocks).collect());
        robots::read_efforts(workers, robots.iter_mut().zip(&mut blocks).collect());
        robots.iter_mut().try_for_each(Robots::send_parameters)?;
        Ok(true)
    }

    fn may_share(&self) -> bool {
        self.shares
    }

    fn share(&mut self, share: bool) {
        self.waits = self.shares && !share;
    }

    fn device(&self) -> Result<&dyn Device, DeviceError> {
        self.placed.as_ref().map(|placed| &*placed.device).ok_or_else(DeviceError::no_envs)
    }

    fn told(&mut self, slot: usize) -> Vec<Told<'_>> {
        let robots = self.placed.iter_mut().flat_map(|placed| &mut placed.robots);
        robots.filter_map(|robots| robots.device_block().envs()?.told(slot)).collect()
    }

    fn hosts(&mut self) -> Vec<EnvHost<'_>> {
        let robots = self.placed.iter_mut().flat_map(|placed| &mut placed.robots);
        robots.filter_map(|robots| robots.device_block().envs()?.host()).collect()
    }

    fn upload(&mut self) -> Result<(), DeviceError> {
        let robots = &mut self.placed()?.robots;
        robots.iter_mut().try_for_each(|robots| envs(robots.device_block())?.upload())
    }

    fn step(&mut self, watched: &[bool], flow: Option<Flow>) -> Result<(), DeviceError> {
        let Placed { device, robots, order, .. } = self.placed()?;
        for &place in &*order {
            let envs = envs(robots[place].device_block())?;
            envs.watch(watched.get(place).copied().unwrap_or(false))?;
            envs.start(flow.map(|flow| flow.slot))?;
        }
        device.step_envs(flow)?;
        if let Some(times) = self.times.as_mut().filter(|_| flow.is_none()) {
            times.steps += 1;
            times.kernel += self.placed.as_ref().and_then(|placed| placed.device.seconds()).unwrap_or(0.0);
        }
        Ok(())
    }

    fn record(&mut self, block: usize, robot: usize) -> Result<Option<BrokenRobot>, DeviceError> {
        let robots = &mut self.placed()?.robots[block];
        let record = robots.record(robot)?;
        envs(robots.device_block())?.watch(false)?;
        Ok(record)
    }

    fn leave(&mut self, workers: &Workers, blocks: BlockList<RobotSlices<'_>>) -> Result<(), DeviceError> {
        let robots = &mut self.placed()?.robots;
        robots.iter_mut().try_for_each(|robots| envs(robots.device_block())?.download())?;
        let mut blocks: Vec<Block<RobotSlices<'_>>> = blocks.into_iter().collect();
        let watched = vec![false; 1 + blocks.iter().map(|block| usize::from(block.morphology.0)).max().unwrap_or(0)];
        let run = Run { steps: 0, gains: true, limits: &StateLimits::default(), watched: &watched };
        robots::write_rows(workers, robots.iter_mut().zip(&mut blocks).collect(), &run);
        robots::write_drives(workers, robots.iter_mut().zip(&mut blocks).collect());
        Ok(())
    }
}
