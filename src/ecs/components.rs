//! Components and tags of the simulated world.
//!
//! One env is three kinds of entities, all tagged with [`EnvId`] and [`Morphology`]: the env itself
//! ([`Env`]), its robot ([`Robot`]) and the robot's sensors ([`ContactSensor`], [`Imu`],
//! [`HeightScan`]). Entities of a kind and a morphology are a [block](crate::blocks): systems read
//! each of their components as one slice, in the order of their envs.
//!
//! Positions and velocities of joints are in [`JointState`], their targets in [`JointTargets`], and
//! their efforts and accelerations in [`JointEffort`].

use bevy_ecs::prelude::*;
use rand_pcg::Pcg32;
use rand_pcg::rand_core::Rng;
use serde::{Deserialize, Serialize};
use smallvec::{SmallVec, smallvec};

use crate::dynamics::lanes::{Real, read_lane};
use crate::dynamics::{Parameters, Report, SharedArray};
use crate::hash::fnv1a;

/// One number per joint of a robot, in physical order; inline for up to 12 joints.
pub type PerJoint = SmallVec<[f32; 12]>;
/// Inline capacity of lists of contact bodies: the largest number in a bundled robot.
const BODIES: usize = 19;
/// Inline capacity of lists of physics steps: the decimation of the bundled tasks.
const PHYSICS_STEPS: usize = 4;
/// One value per foot, in the order of the morphology's feet; inline for up to 4 feet.
pub type PerFoot<T = f32> = SmallVec<[T; 4]>;
/// One number per contact body of a robot; inline for robots of the library.
pub type PerBody = SmallVec<[f32; BODIES]>;

/// Independent world that an entity belongs to, `0..num_envs`.
#[derive(Component, Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct EnvId(pub u32);

/// Morphology of an entity: an index into [`Morphologies`](crate::morphology::Morphologies).
#[derive(Component, Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Morphology(pub u16);

/// Marks env entities.
#[derive(Component, Clone, Copy, Debug, Default)]
pub struct Env;

/// Marks robot entities.
#[derive(Component, Clone, Copy, Debug, Default)]
pub struct Robot;

// ---------------------------------------------------------------------------------------------------------------- envs

/// The env's only source of randomness. Its draws depend on the seed, the robot's name and the
/// env's index among the envs of that robot. Other envs and robots in the batch change none of
/// them.
#[derive(Component, Clone, Debug, Serialize, Deserialize)]
pub struct EnvRng(Pcg32);

/// Value of the lowest of 24 random bits.
const UNIT: f32 = 1.0 / 16_777_216.0;

impl EnvRng {
    /// The stream under `seed` of the env at `place` among those of the robot called `robot`.
    pub fn of_env(seed: u64, robot: &str, place: usize) -> Self {
        Self::new(seed, spread(fnv1a(robot.as_bytes())).wrapping_add(place as u64))
    }

    /// Stream `stream` under `seed`.
    pub fn new(seed: u64, stream: u64) -> Self {
        let state = spread(seed.wrapping_add(0x9e37_79b9_7f4a_7c15));
        Self(Pcg32::new(spread(state ^ stream), stream))
    }

    /// State and increment of the generator.
    pub(crate) fn parts(&self) -> (u64, u64) {
        // two numbers of up to ten bytes
        let mut bytes = [0; 32];
        let written = postcard::to_slice(&self.0, &mut bytes);
        written.ok().and_then(|bytes| postcard::from_bytes(bytes).ok()).unwrap_or_default()
    }

    /// Sets state and increment, as [`parts`](Self::parts) has them.
    pub(crate) fn set_parts(&mut self, parts: (u64, u64)) {
        let mut bytes = [0; 32];
        let written = postcard::to_slice(&parts, &mut bytes);
        if let Some(generator) = written.ok().and_then(|bytes| postcard::from_bytes(bytes).ok()) {
            self.0 = generator;
        }
    }

    /// Uniform in `[0, 1)`.
    #[inline]
    pub fn unit(&mut self) -> f32 {
        (self.0.next_u32() >> 8) as f32 * UNIT
    }

    /// Uniform between two numbers.
    #[inline(always)]
    pub fn uniform(&mut self, [low, high]: [f32; 2]) -> f32 {
        (high - low).mul_add(self.unit(), low)
    }

    /// Adds to each number, in order, a uniform one between two bounds.
    #[inline(always)]
    pub(crate) fn add_uniform(&mut self, [low, high]: [f32; 2], numbers: &mut [f32]) {
        /// Number of pieces of a group that are drawn side by side: each draw of a piece waits for
        /// the one before.
        const PIECES: usize = 4;
        const PIECE: usize = 16;
        let (groups, rest) = numbers.as_chunks_mut::<{ PIECES * PIECE }>();
        for group in groups {
            let mut streams = [(); PIECES].map(|()| {
                let stream = self.0.clone();
                self.0.advance(PIECE as u64);
                stream
            });
            let mut drawn = [0i32; PIECES * PIECE];
            for k in 0..PIECE {
                for (piece, stream) in streams.iter_mut().enumerate() {
                    drawn[piece * PIECE + k] = (stream.next_u32() >> 8) as i32;
                }
            }
            for k in 0..PIECES * PIECE {
                group[k] += (high - low).mul_add(drawn[k] as f32 * UNIT, low);
            }
        }
        for x in rest {
            *x += self.uniform([low, high]);
        }
    }

    /// Uniform integer in `low..=high`.
    pub fn integer(&mut self, [low, high]: [u32; 2]) -> u32 {
        let span = u64::from(high - low) + 1;
        low + ((u64::from(self.0.next_u32()) * span) >> 32) as u32
    }
}

/// splitmix64's finaliser: spreads neighbouring seeds and streams.
fn spread(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Progress of the episode, and the end of the last one.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct Episode {
    /// Control steps that count towards the time-out: those since the reset, unless a caller has
    /// set another number.
    pub length: u32,
    /// Control steps since the reset.
    pub lived: u32,
    /// The episode ended in a state that counts as failure, in the present control step.
    pub terminated: bool,
    /// The episode ran out of time, in the present control step.
    pub truncated: bool,
    /// Terms that ended it, as bits: the guard against broken states, then the task's terminations
    /// in their order. Zero where a caller ended it.
    pub causes: u32,
    /// The env must be reset before it goes on.
    pub needs_reset: bool,
    /// The state became non-finite or ran away; nothing of it may be used.
    pub invalid: bool,
    /// The logs have counted the episode.
    pub logged: bool,
    /// The episode has just begun: no control step since the reset.
    pub fresh: bool,
}

impl Episode {
    /// Whether the episode ended in the present control step.
    pub fn done(&self) -> bool {
        self.terminated || self.truncated
    }
}

/// The velocity command and its sources.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct Command {
    /// Forward and left velocity (m/s) and yaw rate (rad/s), in the base frame.
    pub velocity: [f32; 3],
    /// Heading to hold, rad.
    pub heading: f32,
    /// Whether the yaw rate follows the heading.
    pub holds_heading: bool,
    /// Whether the robot shall stand still.
    pub standing: bool,
    /// Seconds until the next command is sampled.
    pub time_left: f32,
    /// Set by the caller: the command is neither sampled again nor changed by the heading.
    pub pinned: bool,
}

/// The commands of the task other than the velocity.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct CommandNumbers {
    /// Numbers of each command, one command after the other.
    pub numbers: SmallVec<[f32; 8]>,
    /// Seconds until each command is drawn again; the time since the draw, negative, where a reset
    /// alone draws it.
    pub time_left: SmallVec<[f32; 2]>,
    /// Commands that the caller has set, as bits: they are not drawn again.
    pub pinned: u32,
}

impl CommandNumbers {
    /// Sets all numbers to zero, and releases the commands.
    pub fn clear(&mut self) {
        self.numbers.fill(0.0);
        self.time_left.fill(0.0);
        self.pinned = 0;
    }
}

/// Progress of an env through the task's curriculum.
#[derive(Component, Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CurriculumProgress {
    /// Control steps since the simulation began.
    pub steps: u64,
    /// Amount by which the ranges of the velocity command are widened at each end, m/s or rad/s.
    pub widening: f32,
    /// Running mean over the env's last episodes of the tracking reward, as a share of the most
    /// that an episode can give.
    pub tracking: f32,
}

/// Place of an env on the ground.
#[derive(Component, Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EnvOrigin {
    /// x and y of the env's origin in the world, m; zero where each env has separate ground and
    /// obstacles.
    pub position: [f32; 2],
    /// Row of its tile, if the ground is generated terrain.
    pub terrain_level: u32,
    /// Column of its tile.
    pub terrain_column: u32,
}

/// Seconds until each interval event of the task happens next.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct EventTimers(pub SmallVec<[f32; 4]>);

/// Sums over the running episode, for the logs.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct EpisodeSums {
    /// Weighted value of each reward term of the robot's set, times the step's length.
    pub terms: SmallVec<[f32; 16]>,
    /// Sum of the rewards.
    pub reward: f32,
    /// Planar velocity error, m/s, summed over steps.
    pub error_vel_xy: f32,
    /// Yaw-rate error, rad/s, summed over steps.
    pub error_vel_yaw: f32,
    /// Planar speed that was commanded, m/s, summed over steps: the error of standing still.
    pub command_xy: f32,
    /// Yaw rate that was commanded, rad/s, summed over steps.
    pub command_yaw: f32,
    /// Planar speed, m/s, summed over steps.
    pub speed_xy: f32,
    /// Control steps that were summed.
    pub steps: u32,
}

// -------------------------------------------------------------------------------------------------------------- robots

/// Pose of the base link.
#[derive(Component, Clone, Copy, Debug, Serialize, Deserialize)]
pub struct BasePose {
    /// Position, m: x and y relative to the env's origin, z in the world.
    pub position: [f32; 3],
    /// Unit quaternion w, x, y, z.
    pub rotation: [f32; 4],
}

impl BasePose {
    /// Direction of the base's x axis on the ground, unit vector x, y; that of the world's for a
    /// base that points straight up.
    #[inline(always)]
    pub fn forward(&self) -> [f32; 2] {
        let [w, x, y, z] = self.rotation;
        let (c, s) = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z));
        let length = (c * c + s * s).sqrt();
        if length > 1e-6 { [c / length, s / length] } else { [1.0, 0.0] }
    }
}

/// Velocity of the base link.
#[derive(Component, Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct BaseVelocity {
    /// Velocity of the link's origin, world axes, m/s.
    pub linear: [f32; 3],
    /// Angular velocity, base axes, rad/s.
    pub angular: [f32; 3],
}

/// Defines components of lists with a number for each joint.
macro_rules! joint_lists {
    ($($(#[$about:meta])* $component:ident { $($(#[$doc:meta])* $list:ident,)* })*) => {
        $(
            $(#[$about])*
            #[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
            pub struct $component {
                $($(#[$doc])* pub $list: PerJoint,)*
            }

            impl $component {
                /// Zeros for a number of joints.
                pub fn zeros(joints: usize) -> Self {
                    Self { $($list: smallvec![0.0; joints],)* }
                }

                /// Sets all numbers to zero.
                pub fn clear(&mut self) {
                    $(self.$list.fill(0.0);)*
                }

                /// Whether all lists are as long as those of `other`.
                pub fn has_sizes_of(&self, other: &Self) -> bool {
                    true $(&& self.$list.len() == other.$list.len())*
                }
            }
        )*
    };
}

joint_lists! {
    /// Joint positions (rad) and velocities (rad/s), physical order.
    JointState {
        /// Joint positions, rad.
        position,
        /// Joint velocities, rad/s.
        velocity,
    }

    /// Raw action of the policy, in the order of the robot's slots.
    Action {
        /// Action of the present control step.
        current,
        /// Action of the control step before.
        previous,
    }

    /// Efforts and accelerations of the joints in the last physics step, physical order.
    JointEffort {
        /// Effort that the actuators applied, N m.
        applied,
        /// Joint accelerations, rad/s^2.
        acceleration,
    }
}

impl JointEffort {
    /// Takes over a lane of a control step's report.
    #[inline(always)]
    pub(crate) fn set<L: Real>(&mut self, report: &Report<L>, lane: usize) {
        read_lane(&report.joint_effort, &mut self.applied, lane);
        read_lane(&report.joint_acceleration, &mut self.acceleration, lane);
    }
}

/// Joint position targets, rad, physical order.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct JointTargets {
    /// `history[age]`, age in control steps; 0 is the present control step's target.
    pub history: SmallVec<[PerJoint; 2]>,
    /// No action has been taken since the reset: the first one fills the whole history.
    pub fresh: bool,
}

/// Delay of each joint's target, physics steps, drawn at reset.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct ActuatorDelay(pub PerJoint);

/// Memory of the actuator networks: past position errors (rad) and velocities (rad/s), and states
/// of LSTMs; zero at reset. Empty for robots without networks. `[networks, slots, joints of the
/// network]`.
#[derive(Component, Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ActuatorMemory(pub Box<[f32]>);

/// A force and a torque from outside that hold until the next reset or event, base axes.
#[derive(Component, Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ExternalWrench {
    /// Force at the base's centre of mass, N.
    pub force: [f32; 3],
    /// Torque on the base, N m.
    pub torque: [f32; 3],
}

/// A force and a torque on a link from outside, for some control steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LinkForce {
    /// Number of the link.
    pub link: u32,
    /// Whether force and torque are in world axes and keep them; else they are in the engine's
    /// axes of the link and turn with it.
    pub in_world: bool,
    /// Control steps that are left, the next one included.
    pub steps: u32,
    /// Point of the link at which the force acts, in the engine's axes of the link, m.
    pub point: [f32; 3],
    /// Force on the link at that point, N.
    pub force: [f32; 3],
    /// Torque on the link in addition to the force's moment, N m.
    pub torque: [f32; 3],
}

/// Forces on links that a caller has set; at most one for each link. They end at a reset.
#[derive(Component, Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LinkForces(pub Vec<LinkForce>);

/// A contact's impulse.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ContactImpulse<T = f32> {
    /// Number of the contact candidate; pairs of links are counted after the candidates.
    pub contact: u32,
    /// Impulse along the normal and two tangents, N s.
    pub impulse: [T; 3],
}

/// Impulses of the last physics step, from which the solver of the next one starts.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct ConstraintImpulses {
    /// Contacts that press, by their number.
    pub contacts: SmallVec<[ContactImpulse; 6]>,
    /// Joint limits and dry friction, physical order, N m s.
    pub bounds: PerJoint,
}

/// Physics steps that a contact force is remembered for.
pub const FORCE_HISTORY: usize = 3;

/// Contact forces of the last control step: on the feet, and on other bodies that touched
/// something.
///
/// The normal force on a body is the sum of the normal forces of its contacts, along each contact's
/// own normal. Friction is no part of it, and pressures from two sides add up. Both engines count
/// so.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct ContactForces {
    /// Net force on each foot in the last physics step, world axes, N.
    pub feet: PerFoot<[f32; 3]>,
    /// Sum of the normal forces of each foot's contacts in each physics step of the control step,
    /// N, `[steps, feet]`; in place for the library's tasks.
    pub feet_normal: SmallVec<[f32; 4 * PHYSICS_STEPS]>,
    /// Forces on contact bodies other than feet, where they are not zero.
    pub others: SmallVec<[BodyForce; 4]>,
}

/// The contact force on a body.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct BodyForce {
    /// Number of the contact body.
    pub body: u32,
    /// Net force in the last physics step, world axes, N.
    pub net: [f32; 3],
    /// Sum of the normal forces of its contacts in each of the last physics steps, N; zero where
    /// the control step has fewer.
    pub normal: [f32; FORCE_HISTORY],
}

impl ContactForces {
    /// Zero forces on `feet` feet, for control steps of `decimation` physics steps.
    pub fn zeros(feet: usize, decimation: usize) -> Self {
        Self { feet: smallvec![[0.0; 3]; feet], feet_normal: smallvec![0.0; feet * decimation], ..Self::default() }
    }

    /// Sets all forces to zero.
    pub fn clear(&mut self) {
        self.feet.fill([0.0; 3]);
        self.feet_normal.fill(0.0);
        self.others.clear();
    }

    /// Takes over the forces of a control step: on the contact bodies `feet`, and on `others` that
    /// may have touched something. `net(body)` and `normal(physics step, body)` give the forces of
    /// any body.
    #[inline(always)]
    pub fn set(
        &mut self,
        feet: &[usize],
        others: &[usize],
        net: impl Fn(usize) -> [f32; 3],
        normal: impl Fn(usize, usize) -> f32,
    ) {
        for (to, &foot) in self.feet.iter_mut().zip(feet) {
            *to = net(foot);
        }
        let steps = self.feet_normal.chunks_exact_mut(feet.len().max(1));
        let decimation = steps.len();
        for (step, to) in steps.enumerate() {
            for (to, &foot) in to.iter_mut().zip(feet) {
                *to = normal(step, foot);
            }
        }
        self.others.clear();
        for &body in others {
            let mut force = BodyForce { body: body as u32, net: net(body), normal: [0.0; FORCE_HISTORY] };
            let recent = decimation.saturating_sub(FORCE_HISTORY)..decimation;
            for (to, step) in force.normal.iter_mut().zip(recent) {
                *to = normal(step, body);
            }
            if force.net != [0.0; 3] || force.normal != [0.0; FORCE_HISTORY] {
                self.others.push(force);
            }
        }
    }

    /// Net force on each of a robot's `bodies` contact bodies in the last physics step, world axes,
    /// N; `feet` are the contact bodies that are feet.
    pub fn net(&self, bodies: usize, feet: &[usize]) -> Vec<[f32; 3]> {
        let mut net = vec![[0.0; 3]; bodies];
        self.write_net(feet, &mut net);
        net
    }

    /// Writes these forces to `net`, one for each contact body.
    pub fn write_net(&self, feet: &[usize], net: &mut [[f32; 3]]) {
        net.fill([0.0; 3]);
        for (&foot, &force) in feet.iter().zip(&self.feet) {
            net[foot] = force;
        }
        for force in &self.others {
            net[force.body as usize] = force.net;
        }
    }
}

/// Positions and velocities of the feet.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct Feet {
    /// Centres of the foot spheres, m: x and y relative to the env's origin, z in the world.
    pub position: PerFoot<[f32; 3]>,
    /// Velocities of the centres, world axes, m/s.
    pub velocity: PerFoot<[f32; 3]>,
    /// Heights of the centres above the ground below them, m.
    pub height: PerFoot,
}

impl Feet {
    /// `feet` feet at rest at the origin.
    pub fn zeros(feet: usize) -> Self {
        Self { position: smallvec![[0.0; 3]; feet], velocity: smallvec![[0.0; 3]; feet], height: smallvec![0.0; feet] }
    }

    /// Takes over a lane of a control step's report, which knows no heights.
    #[inline(always)]
    pub(crate) fn set<L: Real>(&mut self, report: &Report<L>, lane: usize) {
        for (from, to) in report.site_position.iter().zip(&mut self.position) {
            read_lane(from, to, lane);
        }
        for (from, to) in report.site_velocity.iter().zip(&mut self.velocity) {
            read_lane(from, to, lane);
        }
    }
}

/// The robot's own parameters: masses, lengths, gains, friction. They start as its morphology's and
/// may be randomised.
#[derive(Component, Clone, Debug, Serialize, Deserialize)]
pub struct Body(pub Box<Parameters<f32>>);

/// The robot as the startup events left it, from which events of its body at a reset start; absent
/// where the task has no such events.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct StartupBody(pub Option<Box<(Parameters<f32>, Stance)>>);

/// The robot's pose for zero actions, and the effect of an action. It starts as its morphology's
/// and may be varied.
#[derive(Component, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stance {
    /// Joint positions of the default pose, physical order, rad.
    pub default_position: SharedArray<f32>,
    /// Joint target per unit of action, rad.
    pub action_scale: f32,
    /// Height of the base above the ground at which an episode begins: that of the default pose on
    /// this body's own legs, the reset's margin included, m.
    pub spawn_height: f32,
}

// ------------------------------------------------------------------------------------------------------------- sensors

/// The robot that a sensor is mounted on. A robot knows its [`Sensors`]; they are despawned with
/// it.
#[derive(Component, Clone, Copy, Debug)]
#[relationship(relationship_target = Sensors)]
pub struct MountedOn(pub Entity);

/// The sensors that are mounted on a robot.
#[derive(Component, Debug, Default)]
#[relationship_target(relationship = MountedOn, linked_spawn)]
pub struct Sensors(Vec<Entity>);

/// Contact sensor over all contact bodies of a robot.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct ContactSensor {
    /// Largest normal force over the last three physics steps, N, `[bodies]`: see
    /// [`ContactForces`].
    pub peak_force: PerBody,
    /// Time that each foot has been in contact, s.
    pub contact_time: PerFoot,
    /// Time that each foot has been in the air, s.
    pub air_time: PerFoot,
    /// Length of each foot's last contact, s.
    pub last_contact_time: PerFoot,
    /// Length of each foot's last flight, s.
    pub last_air_time: PerFoot,
}

/// Descriptions of a robot's joints, as its body is in this episode, for networks that read bodies
/// joint by joint.
///
/// A row describes a joint in the default pose, in the base frame and the direction of its slot:
/// position (3, m), axis (3), default position, lower and upper limit (rad, at most half a turn),
/// largest effort (100 N m), largest speed (20 rad/s), stiffness (100 N m/rad), damping (5 N m
/// s/rad), rotor inertia (0.1 kg m^2), dry friction (N m), inertia of the links that it carries
/// about its axis (kg m^2), their share of the robot's mass, radians per unit of action, and the
/// robot's mass (50 kg).
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct JointDescriptors {
    /// All joints' first number, then their next, `[19, slots]`.
    pub numbers: Box<[f32]>,
}

/// Height scanner on the base; the task's config gives its rays.
#[derive(Component, Clone, Debug, Default, Serialize, Deserialize)]
pub struct HeightScan {
    /// Height of the ground where each ray hits it, m.
    pub hits: Box<[f32]>,
}

/// Depth camera on a link; the task's config gives its pixels.
#[derive(Component, Clone, Debug, Serialize, Deserialize)]
pub struct RayCasterCamera {
    /// Distance of each pixel, rows from top to bottom, each from left to right, m. Follows from
    /// the frame that is shown.
    #[serde(skip)]
    pub depth: Box<[f32]>,
    /// Whether the distances are others than in the control step before.
    #[serde(skip)]
    pub is_new: bool,
    /// The frame that is observed.
    pub shown: Option<CameraFrame>,
    /// Frames of the last control steps, the oldest first, that are not shown yet; empty for steps
    /// without a frame.
    pub late: Vec<Option<CameraFrame>>,
    /// Control steps until the next frame.
    pub wait: u32,
    /// Control steps by which frames are late in this episode.
    pub delay: u32,
    /// Most control steps by which frames are late.
    pub most_delay: u32,
    /// Source of the camera's randomness.
    pub rng: EnvRng,
}

/// A camera's view at a moment: the ground does not move, so that a late frame follows from it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct CameraFrame {
    /// Place of the camera in the frame in which envs have their origins, m.
    pub position: [f32; 3],
    /// Turns the camera's axes to the world's.
    pub rotation: [[f32; 3]; 3],
    /// Source of the frame's noise.
    pub noise: EnvRng,
}

/// Inertial sensor on the base.
#[derive(Component, Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Imu {
    /// Velocity of the base's centre of mass, base axes, m/s.
    pub linear_velocity: [f32; 3],
    /// Angular velocity, base axes, rad/s.
    pub angular_velocity: [f32; 3],
    /// Unit vector of gravity, base axes; zeros without gravity.
    pub projected_gravity: [f32; 3],
    /// Heading of the base's x axis in the world, rad.
    pub heading: f32,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Library;
    use crate::morphology::MorphologyModel;

    #[test]
    fn quadrupeds_have_room_in_place_and_need_it() {
        let library = Library::new(Vec::new());
        let (mut bodies, mut joints) = (0, 0);
        let task = library.task("velocity_flat", &[]).unwrap();
        for name in &task.config.robots {
            let topology = MorphologyModel::new(&library.robot(name).unwrap()).unwrap().topology;
            (bodies, joints) = (bodies.max(topology.num_bodies), joints.max(topology.num_joints()));
        }
        assert_eq!((bodies, joints), (BODIES, PerJoint::new().inline_size()));
        assert_eq!(task.config.sim.decimation as usize, PHYSICS_STEPS);
    }

    #[test]
    fn contact_forces_are_those_of_every_body() {
        let feet = [2, 5, 6, 0];
        // seven bodies: 1 touched nothing, 3 pressed in the first physics step alone, 4 in the last
        let net = |body: usize| if [1, 3].contains(&body) { [0.0; 3] } else { [0.5, -1.0, body as f32] };
        for decimation in [1, 2, 4] {
            let normal = |step: usize, body: usize| match body {
                1 => 0.0,
                3 => f32::from(u8::from(step == 0)),
                4 => f32::from(u8::from(step + 1 == decimation)),
                _ => (10 * step + body) as f32,
            };
            let mut forces = ContactForces::zeros(feet.len(), decimation);
            for _ in 0..2 {
                forces.set(&feet, &[1, 3, 4], net, normal);
                let expected: Vec<[f32; 3]> = (0..7).map(net).collect();
                assert_eq!(forces.net(7, &feet), expected);
                for (step, found) in forces.feet_normal.chunks(feet.len()).enumerate() {
                    assert_eq!(*found, feet.map(|foot| normal(step, foot)));
                }
                let others: Vec<(u32, [f32; 3])> =
                    forces.others.iter().map(|force| (force.body, force.normal)).collect();
                let expected: &[(u32, [f32; 3])] = match decimation {
                    1 => &[(3, [1.0, 0.0, 0.0]), (4, [1.0, 0.0, 0.0])],
                    2 => &[(3, [1.0, 0.0, 0.0]), (4, [0.0, 1.0, 0.0])],
                    _ => &[(4, [0.0, 0.0, 1.0])],
                };
                assert_eq!(others, expected, "{decimation} physics steps");
            }
            forces.clear();
            assert_eq!(forces.net(7, &feet), [[0.0; 3]; 7]);
            assert_eq!((forces.feet_normal.len(), forces.others.len()), (feet.len() * decimation, 0));
        }
    }

    #[test]
    fn numbers_drawn_together_are_those_drawn_one_by_one() {
        let (mut one, mut other) = (EnvRng::new(5, 9), EnvRng::new(5, 9));
        for count in [0, 1, 3, 63, 64, 65, 187] {
            let start: Vec<f32> = (0..count).map(|k| 0.37 * k as f32 - 8.0).collect();
            let expected: Vec<f32> = start.iter().map(|x| x + one.uniform([-0.1, 0.3])).collect();
            let mut drawn = start;
            other.add_uniform([-0.1, 0.3], &mut drawn);
            assert!(expected.iter().zip(&drawn).all(|(a, b)| a.to_bits() == b.to_bits()), "{count}");
        }
        assert_eq!(one.unit(), other.unit());
    }
}
