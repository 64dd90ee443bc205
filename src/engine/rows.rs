//! The rows that an engine reads and writes, one robot each; their caller chooses numbers and
//! memory.

use smallvec::SmallVec;

use super::{DivergenceRecord, Motion};
use crate::components::{
    ActuatorDelay, ActuatorMemory, BasePose, BaseVelocity, ConstraintImpulses, ContactForces, ContactImpulse,
    EnvOrigin, ExternalWrench, Feet, JointEffort, JointState, JointTargets, LinkForces,
};
use crate::dynamics::lanes::{Real, prefetch, read_lane, write_lane};
use crate::dynamics::{Drive, Report, State};
use crate::workers::SplitRows;

/// Rows of one caller, for any lifetime of an engine's borrow.
pub(crate) trait RowFamily: 'static {
    /// Whether the engine keeps the robots' states between steps.
    /// [`RowEngine::fetch`](super::RowEngine::fetch) then reads them and
    /// [`RowEngine::restart`](super::RowEngine::restart) writes them; a step asks its rows for the
    /// drive alone. Else the rows keep them.
    const RESIDENT: bool;
    /// Type of the rows' numbers and of the robots' parameters.
    type Number: Real;
    /// Rows of the robots of one block.
    type Rows<'a>: RobotRows<Number = Self::Number>;
}

/// Contacts that press, and their impulses.
pub(crate) type Contacts<T> = SmallVec<[ContactImpulse<T>; 6]>;

/// Rows of robots. Lanes of packs are read from them and written to them.
pub(crate) trait RobotRows: SplitRows {
    /// Type of the numbers.
    type Number: Real;

    /// Origin of the env on the terrain, x and y, m.
    fn origin(&self, row: usize) -> [f32; 2];

    /// Reads poses and velocities of a row into a lane.
    fn read_motion<L: Real>(&self, row: usize, state: &mut State<L>, lane: usize);

    /// Writes poses and velocities of a lane into a row.
    fn write_motion<L: Real>(&mut self, row: usize, state: &State<L>, lane: usize);

    /// Reads the drive and the external wrench of a row. Values that a caller does not give are
    /// zero beforehand.
    fn read_drive<L: Real>(&self, row: usize, drive: &mut Drive<L>, lane: usize);

    /// Memory of the actuator networks, see
    /// [`NetworkStep::memory`](crate::dynamics::NetworkStep::memory).
    fn memory(&self, row: usize) -> &[Self::Number];

    /// Memory of the actuator networks, to write.
    fn memory_mut(&mut self, row: usize) -> &mut [Self::Number];

    /// Impulses of the contacts, and of joint limits and dry friction, `[joints]`.
    fn impulses(&self, row: usize) -> (&Contacts<Self::Number>, &[Self::Number]);

    /// Impulses to write.
    fn impulses_mut(&mut self, row: usize) -> (&mut Contacts<Self::Number>, &mut [Self::Number]);

    /// Writes the report of a control step. Forces act on the contact bodies `feet`, and on the
    /// other bodies `touching` that touch something.
    fn write_report<L: Real>(
        &mut self,
        row: usize,
        report: &Report<L>,
        feet: &[usize],
        touching: &[usize],
        lane: usize,
    );

    /// Reads the report of [resident](RowFamily::RESIDENT) robots, as far as rows hold it.
    fn read_report<L: Real>(&self, _row: usize, _report: &mut Report<L>, _lane: usize) {}

    /// Asks for the memory of a row well ahead.
    fn prefetch(&self, _row: usize) {}

    /// Asks for what a step reads of a row, right before it is read.
    fn prefetch_read(&self, _row: usize) {}

    /// Asks for what a step writes of a row and has not read, right before it is written.
    fn prefetch_written(&self, _row: usize) {}

    /// Writes new states. If a row diverged, returns its state before and after the step, where
    /// rows keep records. `first_env` is the env of the first row.
    fn record(
        &mut self,
        _diverged: Option<usize>,
        _morphology: usize,
        _first_env: usize,
        write: impl FnOnce(&mut Self),
    ) -> Option<DivergenceRecord> {
        write(self);
        None
    }
}

/// Rows of the pipeline: components of robots, in single precision.
pub(crate) struct Components;

impl RowFamily for Components {
    const RESIDENT: bool = false;
    type Number = f32;
    type Rows<'a> = RobotSlices<'a>;
}

/// Defines the struct of the components that engines read and write, and the operations over all of
/// them.
macro_rules! robot_slices {
    ($($(#[$doc:meta])* $name:ident: $component:ty,)*) => {
        /// The components that an engine reads and writes of one morphology's robots, one row for
        /// each robot.
        pub struct RobotSlices<'a> {
            /// Places of the envs on the ground. Read only.
            pub origins: &'a [EnvOrigin],
            $($(#[$doc])* pub $name: &'a mut [$component],)*
        }

        /// Query of these components, without those of envs.
        pub(crate) type RobotColumns = ($(&'static mut $component,)*);

        impl<'a> RobotSlices<'a> {
            /// Borrows the components in the order of [`RobotColumns`].
            pub(crate) fn new(($($name,)*): ($(&'a mut [$component],)*), origins: &'a [EnvOrigin]) -> Self {
                Self { origins, $($name,)* }
            }

            /// Borrows the slices for a shorter time.
            pub(crate) fn reborrow(&mut self) -> RobotSlices<'_> {
                RobotSlices { origins: self.origins, $($name: &mut *self.$name,)* }
            }

            /// Prefetches the memory of a row.
            #[inline]
            fn prefetch_row(&self, row: usize) {
                prefetch(&self.origins[row]);
                $(prefetch(&self.$name[row]);)*
            }
        }

        impl SplitRows for RobotSlices<'_> {
            fn split_rows(self, n: usize) -> (Self, Self) {
                let origins = self.origins.split_at(n);
                $(let $name = self.$name.split_at_mut(n);)*
                (Self { origins: origins.0, $($name: $name.0,)* }, Self { origins: origins.1, $($name: $name.1,)* })
            }
        }
    };
}

robot_slices! {
    /// Pose of the base: read, then written.
    poses: BasePose,
    /// Velocity of the base: read, then written.
    velocities: BaseVelocity,
    /// Joint positions and velocities: read, then written.
    joints: JointState,
    /// Joint position targets of this control step and the ones before.
    targets: JointTargets,
    /// Delay of each joint's target, physics steps.
    delays: ActuatorDelay,
    /// Memory of the actuator networks: read, then written.
    memories: ActuatorMemory,
    /// Force and torque on the base from outside.
    wrenches: ExternalWrench,
    /// Forces on links from outside.
    link_forces: LinkForces,
    /// Efforts and accelerations of the joints in the last physics step: written.
    efforts: JointEffort,
    /// Impulses from which the solver of the next step may start: read, then written.
    impulses: ConstraintImpulses,
    /// Contact forces: written.
    forces: ContactForces,
    /// Positions and velocities of the feet; the pipeline measures their heights. Written.
    feet: Feet,
}

impl RobotSlices<'_> {
    fn motion(&self, row: usize) -> Motion {
        Motion {
            pose: self.poses[row],
            velocity: self.velocities[row],
            joints: self.joints[row].clone(),
            effort: self.efforts[row].clone(),
            impulses: self.impulses[row].clone(),
        }
    }
}

impl RobotRows for RobotSlices<'_> {
    type Number = f32;

    #[inline]
    fn origin(&self, row: usize) -> [f32; 2] {
        self.origins[row].position
    }

    #[inline]
    fn read_motion<L: Real>(&self, row: usize, state: &mut State<L>, lane: usize) {
        write_lane(&mut state.position, &self.poses[row].position, lane);
        write_lane(&mut state.rotation, &self.poses[row].rotation, lane);
        write_lane(&mut state.linear_velocity, &self.velocities[row].linear, lane);
        write_lane(&mut state.angular_velocity, &self.velocities[row].angular, lane);
        write_lane(&mut state.joint_position, &self.joints[row].position, lane);
        write_lane(&mut state.joint_velocity, &self.joints[row].velocity, lane);
    }

    #[inline]
    fn write_motion<L: Real>(&mut self, row: usize, state: &State<L>, lane: usize) {
        read_lane(&state.position, &mut self.poses[row].position, lane);
        read_lane(&state.rotation, &mut self.poses[row].rotation, lane);
        read_lane(&state.linear_velocity, &mut self.velocities[row].linear, lane);
        read_lane(&state.angular_velocity, &mut self.velocities[row].angular, lane);
        read_lane(&state.joint_position, &mut self.joints[row].position, lane);
        read_lane(&state.joint_velocity, &mut self.joints[row].velocity, lane);
    }

    #[inline]
    fn read_drive<L: Real>(&self, row: usize, drive: &mut Drive<L>, lane: usize) {
        for (targets, from) in drive.targets.iter_mut().zip(&self.targets[row].history) {
            write_lane(targets, from, lane);
        }
        // without a history no actuator sees a delay
        if drive.targets.len() > 1 {
            write_lane(&mut drive.delay, &self.delays[row].0, lane);
        }
        write_lane(&mut drive.base_force, &self.wrenches[row].force, lane);
        write_lane(&mut drive.base_torque, &self.wrenches[row].torque, lane);
        for from in &self.link_forces[row].0 {
            let force = drive.link_force_mut((from.link as usize, from.in_world));
            force.acts.set_lane(lane, 1.0);
            write_lane(&mut force.point, &from.point, lane);
            write_lane(&mut force.force, &from.force, lane);
            write_lane(&mut force.torque, &from.torque, lane);
        }
    }

    #[inline]
    fn memory(&self, row: usize) -> &[f32] {
        &self.memories[row].0
    }

    #[inline]
    fn memory_mut(&mut self, row: usize) -> &mut [f32] {
        &mut self.memories[row].0
    }

    #[inline]
    fn impulses(&self, row: usize) -> (&Contacts<f32>, &[f32]) {
        (&self.impulses[row].contacts, &self.impulses[row].bounds)
    }

    #[inline]
    fn impulses_mut(&mut self, row: usize) -> (&mut Contacts<f32>, &mut [f32]) {
        let ConstraintImpulses { contacts, bounds } = &mut self.impulses[row];
        (contacts, bounds)
    }

    #[inline]
    fn write_report<L: Real>(
        &mut self,
        row: usize,
        report: &Report<L>,
        feet: &[usize],
        touching: &[usize],
        lane: usize,
    ) {
        self.efforts[row].set(report, lane);
        let net = |body: usize| {
            // number by number: the lanes of a force are long to copy
            let [x, y, z] = &report.body_force[body];
            [x.lane_f32(lane), y.lane_f32(lane), z.lane_f32(lane)]
        };
        let normal = |step: usize, body: usize| report.normal_force[step][body].lane_f32(lane);
        self.forces[row].set(feet, touching, net, normal);
        self.feet[row].set(report, lane);
    }

    #[inline]
    fn prefetch(&self, row: usize) {
        self.prefetch_row(row);
    }

    #[inline]
    fn prefetch_read(&self, row: usize) {
        prefetch(&self.origins[row]);
        prefetch(&self.poses[row]);
        prefetch(&self.velocities[row]);
        prefetch(&self.joints[row]);
        prefetch(&self.targets[row]);
        prefetch(&self.delays[row]);
        prefetch(&self.memories[row]);
        prefetch(&self.wrenches[row]);
        prefetch(&self.link_forces[row]);
        prefetch(&self.impulses[row]);
    }

    #[inline]
    fn prefetch_written(&self, row: usize) {
        prefetch(&self.efforts[row]);
        prefetch(&self.forces[row]);
        prefetch(&self.feet[row]);
    }

    fn record(
        &mut self,
        diverged: Option<usize>,
        morphology: usize,
        first_env: usize,
        write: impl FnOnce(&mut Self),
    ) -> Option<DivergenceRecord> {
        let before = diverged.map(|row| (row, self.motion(row), self.memories[row].clone()));
        write(self);
        before.map(|(row, before, memory)| DivergenceRecord {
            morphology,
            env: first_env + row,
            before,
            targets: self.targets[row].clone(),
            delay: self.delays[row].clone(),
            memory,
            wrench: self.wrenches[row],
            link_forces: self.link_forces[row].clone(),
            after: self.motion(row),
        })
    }
}

/// Leaves targets, feed-forward efforts and forces from outside zero.
pub(crate) fn clear_drive<L: Real>(drive: &mut Drive<L>) {
    drive.targets.iter_mut().for_each(|targets| targets.fill(L::zero()));
    drive.feedforward.fill(L::zero());
    drive.base_force = [L::zero(); 3];
    drive.base_torque = [L::zero(); 3];
    drive.link_forces.clear();
}
