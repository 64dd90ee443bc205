//! Changes of a caller between control steps, in some envs: states, parameters, forces.
//!
//! An env depends on its seed, its actions and what was set in it. No change of one env reaches
//! another one's bits.

use bevy_ecs::prelude::*;
use glam::DVec3;

use super::Sim;
use crate::batch::Batch;
use crate::components::{
    ActuatorMemory, BasePose, BaseVelocity, Body, ConstraintImpulses, ContactForces, EnvId, EnvOrigin, Episode,
    JointEffort, JointState, LinkForce, LinkForces, Morphology, Robot, Stance, StartupBody,
};
use crate::dynamics::math::{cross, mul_vec, mul_vec_transposed, quat_to_mat};
use crate::engine::{Motion, Quantity};
use crate::error::Error;
use crate::morphology::{Morphologies, MorphologyModel};
use crate::simulation::named_link;
use crate::systems::{NewBody, ResetEnvs, ResetRequest, SavedComponents, StateWritten, restart_engine, run};
use crate::world::Ground;

/// Largest deviation of a quaternion's length from one. Numbers that were rounded to four digits
/// pass; a quaternion that was scaled or never set does not.
const UNIT_TOLERANCE: f32 = 1e-3;
/// Distance beyond a joint's limit up to which a position is taken, rad or m. Limits yield a little
/// in a simulated motion, and a state that was read can be set again.
const LIMIT_TOLERANCE: f32 = 0.1;

/// New states of some envs, row-major, a row for each of them. Absent quantities stay as
/// [`StateField`](crate::systems::StateField) shows them; frames and units are the same.
#[derive(Clone, Copy, Debug, Default)]
pub struct StateRows<'a> {
    /// Position of the base relative to the env's origin on the ground, m, `[envs, 3]`.
    pub base_pos: Option<&'a [f32]>,
    /// Orientation of the base, unit quaternion w, x, y, z, `[envs, 4]`.
    pub base_quat: Option<&'a [f32]>,
    /// Velocity of the base's centre of mass, base axes, m/s, `[envs, 3]`.
    pub base_lin_vel: Option<&'a [f32]>,
    /// Angular velocity of the base, base axes, rad/s, `[envs, 3]`.
    pub base_ang_vel: Option<&'a [f32]>,
    /// Joint positions in the columns of the batch's slots, rad, `[envs, slots]`.
    pub joint_pos: Option<&'a [f32]>,
    /// Joint velocities in the same columns, rad/s, `[envs, slots]`.
    pub joint_vel: Option<&'a [f32]>,
}

/// A force and a torque on a link of some envs; see [`Sim::apply_force`].
#[derive(Clone, Copy, Debug)]
pub struct ForceRows<'a> {
    /// Force, N, `[envs, 3]`.
    pub force: &'a [f32],
    /// Torque, N m, `[envs, 3]`; absent for none.
    pub torque: Option<&'a [f32]>,
    /// Whether force and torque are in world axes and keep them; else they are in the link's URDF
    /// axes and turn with it.
    pub in_world: bool,
    /// Point of the link at which the force acts, in its URDF frame, m, `[envs, 3]`; absent for
    /// the centre of mass.
    pub point: Option<&'a [f32]>,
    /// Number of control steps for which they act.
    pub steps: u32,
}

/// Present parameters of a robot's envs; see [`Sim::parameters`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParameterRows {
    /// Static friction between robot and ground, `[envs]`.
    pub static_friction: Vec<f32>,
    /// Dynamic friction between robot and ground, `[envs]`.
    pub dynamic_friction: Vec<f32>,
    /// Masses of the links, kg, `[envs, links]`.
    pub mass: Vec<f32>,
    /// Stiffness of the actuators in the columns of the batch's slots, N m/rad, `[envs, slots]`.
    pub stiffness: Vec<f32>,
    /// Damping of the actuators in the same columns, N m s/rad, `[envs, slots]`.
    pub damping: Vec<f32>,
}

/// State of a robot that is ready to be written.
struct NewMotion {
    pose: BasePose,
    velocity: BaseVelocity,
    joints: JointState,
}

impl Sim {
    /// For each env its place among `envs`, where it is one of them.
    ///
    /// # Errors
    /// An env that does not exist or that is there twice.
    pub(super) fn places(&self, element: &'static str, envs: &[usize]) -> Result<Vec<Option<usize>>, Error> {
        let mut places = vec![None; self.num_envs()];
        for (row, &env) in envs.iter().enumerate() {
            match places.get_mut(env) {
                None => {
                    let remedy = format!("the envs are 0 to {}", self.num_envs() - 1);
                    return Err(Error::argument(element, format!("there is no env {env}"), remedy));
                }
                Some(Some(_)) => {
                    return Err(Error::argument(element, format!("env {env} is there twice"), "name each env once"));
                }
                Some(place) => *place = Some(row),
            }
        }
        Ok(places)
    }

    /// Sets the states of some envs, in the middle of their episodes. Actions, commands and episode
    /// lengths stay. All that follows from a state is computed as after a reset: sensors, feet,
    /// mirrors and the observation, whose history is filled with it. Impulses, efforts, contact
    /// forces and the memory of actuator networks are zero: no physics step has been made.
    ///
    /// Nothing lifts a robot out of the ground, and a joint up to 0.1 rad beyond a limit is taken
    /// as it is: the next physics steps push both back.
    ///
    /// # Errors
    /// The wrong number of numbers, a number that is not finite or beyond the limits of states, a
    /// quaternion that is no unit quaternion, a joint further beyond a limit, an env that does not
    /// exist or whose state has broken. The simulation is then as it was.
    pub fn set_states(&mut self, envs: &[usize], rows: &StateRows) -> Result<(), Error> {
        let places = self.places("set_state: env_ids", envs)?;
        let mut new = self.new_motions(&places, envs, rows, true)?;
        if envs.is_empty() {
            return Ok(());
        }
        let world = self.world_mut();
        let mut robots = world.query_filtered::<(
            &EnvId,
            (&mut BasePose, &mut BaseVelocity, &mut JointState),
            (&mut ActuatorMemory, &mut JointEffort, &mut ConstraintImpulses, &mut ContactForces),
        ), With<Robot>>();
        for (env, (mut pose, mut velocity, mut joints), past) in robots.iter_mut(world) {
            let (mut memory, mut effort, mut impulses, mut forces) = past;
            if let Some(motion) = places[env.0 as usize].and_then(|row| new[row].take()) {
                (*pose, *velocity, *joints) = (motion.pose, motion.velocity, motion.joints);
                memory.0.fill(0.0);
                effort.clear();
                impulses.contacts.clear();
                impulses.bounds.fill(0.0);
                forces.clear();
            }
        }
        restart_engine(world, envs);
        self.measure_written(&places)
    }

    /// Begins new episodes, in the envs of the mask or in all, in these states; absent quantities
    /// are those of the reset.
    ///
    /// # Errors
    /// As [`reset`](Self::reset) and [`set_states`](Self::set_states); the simulation is then as it
    /// was, unless a limit of a joint that the reset has drawn is exceeded.
    pub fn reset_to(&mut self, seed: Option<u64>, mask: Option<&[bool]>, rows: &StateRows) -> Result<(), Error> {
        let chosen = |env: &usize| mask.is_none_or(|mask| mask.get(*env).copied().unwrap_or_default());
        let envs: Vec<usize> = (0..self.num_envs()).filter(chosen).collect();
        let places = self.places("set_state: env_ids", &envs)?;
        self.new_motions(&places, &envs, rows, false)?;
        self.reset(seed, mask)?;
        self.set_states(&envs, rows)
    }

    /// Computes all that follows from the states of these envs, without resetting any.
    fn measure_written(&mut self, places: &[Option<usize>]) -> Result<(), Error> {
        let world = self.world_mut();
        let mut episodes = world.query::<(&EnvId, &mut Episode)>();
        let mut flags = vec![(false, false); places.len()];
        for (env, mut episode) in episodes.iter_mut(world) {
            let env = env.0 as usize;
            flags[env] = (episode.needs_reset, episode.fresh);
            (episode.needs_reset, episode.fresh) = (false, places[env].is_some());
        }
        let has_final = world.resource::<Batch>().has_final.clone();
        world.resource_mut::<ResetRequest>().0 = true;
        world.resource_mut::<StateWritten>().0 = true;
        let measured = run(world, ResetEnvs);
        world.resource_mut::<StateWritten>().0 = false;
        world.resource_mut::<Batch>().has_final = has_final;
        for (env, mut episode) in episodes.iter_mut(world) {
            (episode.needs_reset, episode.fresh) = flags[env.0 as usize];
        }
        measured
    }

    /// The new states of the rows, checked. Envs whose state has broken are refused where `go_on`
    /// says that their episodes do.
    fn new_motions(
        &mut self,
        places: &[Option<usize>],
        envs: &[usize],
        rows: &StateRows,
        go_on: bool,
    ) -> Result<Vec<Option<NewMotion>>, Error> {
        let slots = self.slots().joints.len();
        let parts = [
            ("set_state: base_pos", rows.base_pos, 3),
            ("set_state: base_quat", rows.base_quat, 4),
            ("set_state: base_lin_vel", rows.base_lin_vel, 3),
            ("set_state: base_ang_vel", rows.base_ang_vel, 3),
            ("set_state: joint_pos", rows.joint_pos, slots),
            ("set_state: joint_vel", rows.joint_vel, slots),
        ];
        for (element, part, width) in parts {
            if let Some(numbers) = part {
                check_rows(element, numbers, envs, width)?;
            }
        }
        for (row, quaternion) in rows.base_quat.unwrap_or_default().chunks_exact(4).enumerate() {
            let length = length(quaternion);
            if (length - 1.0).abs() > UNIT_TOLERANCE {
                let problem = format!("the quaternion of env {} has the length {length}", envs[row]);
                return Err(Error::argument(
                    "set_state: base_quat",
                    problem,
                    "pass unit quaternions in the order w, x, y, z",
                ));
            }
        }
        let limits = self.task().limits;
        let world = self.world_mut();
        let mut of_envs = vec![(EnvOrigin::default(), false); places.len()];
        for (env, origin, episode) in world.query::<(&EnvId, &EnvOrigin, &Episode)>().iter(world) {
            of_envs[env.0 as usize] = (*origin, episode.invalid);
        }
        let mut new: Vec<Option<NewMotion>> = envs.iter().map(|_| None).collect();
        let mut robots =
            world.query_filtered::<(&EnvId, &Morphology, &BasePose, &BaseVelocity, &JointState, &Body), With<Robot>>();
        let (morphologies, ground) = (world.resource::<Morphologies>(), world.resource::<Ground>());
        for (env, tag, pose, velocity, joints, body) in robots.iter(world) {
            let env = env.0 as usize;
            let Some(row) = places[env] else {
                continue;
            };
            let (origin, invalid) = &of_envs[env];
            if *invalid && go_on {
                let problem = format!("the state of env {env} has broken, and its episode is over");
                return Err(Error::argument("set_state: env_ids", problem, "reset the env first"));
            }
            let present = (pose, velocity, joints, body);
            let height = ground.height_at(origin, [0.0; 2]);
            let motion = new_motion(morphologies.get(*tag), height, present, rows, (row, slots));
            check_joints(morphologies.get(*tag), body, env, rows.joint_pos.map(|_| &motion.joints))?;
            let numbers = Motion {
                pose: motion.pose,
                velocity: motion.velocity,
                joints: motion.joints.clone(),
                effort: JointEffort::zeros(0),
                impulses: ConstraintImpulses::default(),
            };
            if let Some(broken) = numbers.violation(&limits).filter(|_| !*invalid) {
                let element = match broken.quantity {
                    Quantity::BasePosition => "set_state: base_pos",
                    Quantity::BaseRotation => "set_state: base_quat",
                    Quantity::BaseLinearVelocity => "set_state: base_lin_vel",
                    Quantity::BaseAngularVelocity => "set_state: base_ang_vel",
                    Quantity::JointPosition => "set_state: joint_pos",
                    Quantity::JointVelocity | Quantity::JointEffort => "set_state: joint_vel",
                };
                let problem = format!("{} of env {env} is beyond {}", broken.value, broken.limit);
                return Err(Error::argument(element, problem, "pass smaller numbers: such a state counts as broken"));
            }
            new[row] = Some(motion);
        }
        Ok(new)
    }

    /// Changes the robots' numbers in some envs: the present ones, and those from which the events
    /// of a reset start.
    fn edit_bodies(&mut self, places: &[Option<usize>], change: impl Fn(usize, &mut NewBody)) -> Result<(), Error> {
        let world = self.world_mut();
        let mut robots =
            world.query_filtered::<(&EnvId, &Morphology, &mut Body, &mut Stance, &mut StartupBody), With<Robot>>();
        world.resource_scope(|world, morphologies: Mut<Morphologies>| {
            world.resource_scope(|world, ground: Mut<Ground>| {
                for (env, tag, mut body, mut stance, mut startup) in robots.iter_mut(world) {
                    let Some(row) = places[env.0 as usize] else {
                        continue;
                    };
                    let (morphology, ground) = (morphologies.get(*tag), &*ground);
                    if let Some(start) = &mut startup.0 {
                        let (parameters, stance) = &mut **start;
                        change(row, &mut NewBody { morphology, ground, parameters, stance });
                    }
                    let (parameters, stance) = (&mut *body.0, &mut *stance);
                    change(row, &mut NewBody { morphology, ground, parameters, stance });
                }
            });
        });
        // sensors that describe the body
        SavedComponents::measure(world)
    }

    /// Sets the friction coefficients of the robots' surfaces in some envs, `[envs]`; the ground's
    /// are combined with them. The dynamic one is the static one unless given.
    ///
    /// This and the next two hold through resets until they are set again. A reset's event that
    /// draws the same number starts from the set one, and a reset with a seed draws all again.
    ///
    /// # Errors
    /// A negative coefficient, one that is not finite, another number of values, no such env.
    pub fn set_friction(
        &mut self,
        envs: &[usize],
        static_friction: &[f32],
        dynamic_friction: Option<&[f32]>,
    ) -> Result<(), Error> {
        let places = self.places("set_friction: env_ids", envs)?;
        let dynamic = dynamic_friction.unwrap_or(static_friction);
        check_not_negative("set_friction: static_friction", static_friction, envs, 1)?;
        check_not_negative("set_friction: dynamic_friction", dynamic, envs, 1)?;
        self.edit_bodies(&places, |row, body| body.set_material(static_friction[row], dynamic[row]))
    }

    /// Sets the mass of a link in some envs, kg, `[envs]`; the base's if no link is named. The
    /// inertia about its centre of mass is scaled along.
    ///
    /// # Errors
    /// A mass that is not positive and finite, another number of values, no such link or env.
    pub fn set_mass(&mut self, envs: &[usize], link: Option<&str>, mass: &[f32]) -> Result<(), Error> {
        let places = self.places("set_mass: env_ids", envs)?;
        check_rows("set_mass: mass", mass, envs, 1)?;
        if let Some(row) = mass.iter().position(|mass| *mass <= 0.0) {
            let problem = format!("{} kg in env {}", mass[row], envs[row]);
            return Err(Error::argument("set_mass: mass", problem, "pass positive masses"));
        }
        let links = self.links_of("set_mass: link", &places, link)?;
        self.edit_bodies(&places, |row, body| {
            let (link, p) = (links[row], &mut *body.parameters);
            let scale = mass[row] / p.mass[link];
            for x in &mut p.inertia[link] {
                *x *= scale;
            }
            p.mass[link] = mass[row];
        })
    }

    /// Sets stiffness (N m/rad), damping (N m s/rad) or both of the actuators in some envs, in the
    /// columns of the batch's slots, `[envs, slots]`; columns of missing joints do nothing.
    ///
    /// # Errors
    /// A negative gain, one that is not finite, another number of values, no such env, a robot
    /// whose actuators are networks.
    pub fn set_gains(
        &mut self,
        envs: &[usize],
        stiffness: Option<&[f32]>,
        damping: Option<&[f32]>,
    ) -> Result<(), Error> {
        let places = self.places("set_gains: env_ids", envs)?;
        let slots = self.slots().joints.len();
        for (element, gains) in [("set_gains: stiffness", stiffness), ("set_gains: damping", damping)] {
            if let Some(gains) = gains {
                check_not_negative(element, gains, envs, slots)?;
            }
        }
        for &env in envs {
            let model = self.model_of(env);
            if !model.networks.is_empty() {
                let problem = format!("the actuators of `{}` in env {env} are networks, without gains", model.name());
                return Err(Error::argument("set_gains: env_ids", problem, "leave this env out"));
            }
        }
        self.edit_bodies(&places, |row, body| {
            for slot in &body.morphology.slots {
                let at = row * slots + slot.column();
                if let Some(stiffness) = stiffness {
                    body.parameters.stiffness[slot.joint()] = stiffness[at];
                }
                if let Some(damping) = damping {
                    body.parameters.damping[slot.joint()] = damping[at];
                }
            }
        })
    }

    /// The present parameters of the robot at place `index`.
    pub fn parameters(&mut self, index: usize) -> ParameterRows {
        let (envs, slots) = (self.env_ids(index), self.slots().joints.len());
        let links = self.morphologies().get(index).map_or(0, |model| model.topology.num_links());
        let n = envs.len();
        let mut all = ParameterRows {
            static_friction: vec![0.0; n],
            dynamic_friction: vec![0.0; n],
            mass: vec![0.0; n * links],
            stiffness: vec![0.0; n * slots],
            damping: vec![0.0; n * slots],
        };
        let world = self.world_mut();
        let mut robots = world.query_filtered::<(&EnvId, &Morphology, &Body), With<Robot>>();
        let morphologies = world.resource::<Morphologies>();
        for (env, tag, Body(body)) in robots.iter(world).filter(|(env, ..)| envs.contains(&(env.0 as usize))) {
            let row = env.0 as usize - envs.start;
            all.static_friction[row] = body.static_friction;
            all.dynamic_friction[row] = body.dynamic_friction;
            all.mass[row * links..(row + 1) * links].copy_from_slice(&body.mass);
            for slot in &morphologies.get(*tag).slots {
                all.stiffness[row * slots + slot.column()] = body.stiffness[slot.joint()];
                all.damping[row * slots + slot.column()] = body.damping[slot.joint()];
            }
        }
        all
    }

    /// Lets a force and a torque act on a link in some envs, on the base if no link is named, for
    /// the next control steps. A later call for the same link of an env takes the place of this
    /// one; forces on different links add up. A reset ends them.
    ///
    /// # Errors
    /// Another number of values, one that is not finite, no such link or env, no step.
    pub fn apply_force(&mut self, envs: &[usize], link: Option<&str>, rows: &ForceRows) -> Result<(), Error> {
        let places = self.places("apply_force: env_ids", envs)?;
        check_rows("apply_force: force", rows.force, envs, 3)?;
        for (element, part) in [("apply_force: torque", rows.torque), ("apply_force: point", rows.point)] {
            if let Some(numbers) = part {
                check_rows(element, numbers, envs, 3)?;
            }
        }
        if rows.steps == 0 {
            return Err(Error::argument("apply_force: steps", "0", "pass one control step or more"));
        }
        let links = self.links_of("apply_force: link", &places, link)?;
        let world = self.world_mut();
        let mut robots = world.query_filtered::<(&EnvId, &Morphology, &Body, &mut LinkForces), With<Robot>>();
        world.resource_scope(|world, morphologies: Mut<Morphologies>| {
            for (env, tag, body, mut forces) in robots.iter_mut(world) {
                let Some(row) = places[env.0 as usize] else {
                    continue;
                };
                let (link, align) = (links[row], &morphologies.get(*tag).align[links[row]]);
                let vector = |numbers: &[f32]| -> [f32; 3] { std::array::from_fn(|k| numbers[3 * row + k]) };
                let aligned = |v: [f32; 3]| (align * DVec3::from_array(v.map(f64::from))).to_array().map(|x| x as f32);
                let axes = |v: [f32; 3]| if rows.in_world { v } else { aligned(v) };
                let force = LinkForce {
                    link: link as u32,
                    in_world: rows.in_world,
                    steps: rows.steps,
                    point: rows.point.map_or(body.0.com[link], |point| aligned(vector(point))),
                    force: axes(vector(rows.force)),
                    torque: axes(rows.torque.map_or([0.0; 3], vector)),
                };
                forces.0.retain(|other| other.link != force.link);
                forces.0.push(force);
            }
        });
        Ok(())
    }

    /// The model of an env's robot.
    fn model_of(&self, env: usize) -> &MorphologyModel {
        let place = (0..self.morphologies().len()).find(|&index| self.env_ids(index).contains(&env));
        &self.morphologies()[place.unwrap_or_default()]
    }

    /// The number of the link called `link`, or of the base, in each row's robot.
    fn links_of(
        &self,
        element: &'static str,
        places: &[Option<usize>],
        link: Option<&str>,
    ) -> Result<Vec<usize>, Error> {
        let mut links = vec![0; places.iter().flatten().count()];
        let Some(name) = link else {
            return Ok(links);
        };
        for (index, model) in self.morphologies().iter().enumerate() {
            let rows: Vec<usize> = places[self.env_ids(index)].iter().flatten().copied().collect();
            if rows.is_empty() {
                continue;
            }
            let link = named_link(&model.model, name, element)?;
            rows.into_iter().for_each(|row| links[row] = link);
        }
        Ok(links)
    }
}

/// The state of a row: what is given, and the rest as it is.
fn new_motion(
    model: &MorphologyModel,
    origin: f32,
    (pose, velocity, joints, body): (&BasePose, &BaseVelocity, &JointState, &Body),
    rows: &StateRows,
    (row, slots): (usize, usize),
) -> NewMotion {
    let vector = |part: Option<&[f32]>| -> Option<[f32; 3]> {
        part.map(|numbers| std::array::from_fn(|k| numbers[3 * row + k]))
    };
    let mut new = NewMotion { pose: *pose, velocity: *velocity, joints: joints.clone() };
    if let Some([x, y, z]) = vector(rows.base_pos) {
        new.pose.position = [x, y, z + origin];
    }
    if let Some(quaternions) = rows.base_quat {
        let given = &quaternions[4 * row..4 * row + 4];
        let length = length(given);
        new.pose.rotation = std::array::from_fn(|k| given[k] / length);
    }
    let (linear, angular) = (vector(rows.base_lin_vel), vector(rows.base_ang_vel));
    // without these the velocity keeps its bits
    if rows.base_quat.is_some() || linear.is_some() || angular.is_some() {
        let com = &body.0.com[0];
        let old = mul_vec_transposed(&quat_to_mat(&pose.rotation), &velocity.linear);
        let turned = cross(&velocity.angular, com);
        let of_com = linear.unwrap_or(std::array::from_fn(|k| old[k] + turned[k]));
        new.velocity.angular = angular.unwrap_or(velocity.angular);
        let turned = cross(&new.velocity.angular, com);
        let of_origin = std::array::from_fn(|k| of_com[k] - turned[k]);
        new.velocity.linear = mul_vec(&quat_to_mat(&new.pose.rotation), &of_origin);
    }
    for (part, to) in [(rows.joint_pos, &mut new.joints.position), (rows.joint_vel, &mut new.joints.velocity)] {
        if let Some(numbers) = part {
            for slot in &model.slots {
                to[slot.joint()] = slot.sign * numbers[row * slots + slot.column()];
            }
        }
    }
    new
}

/// Refuses joints that are far beyond their limits.
fn check_joints(model: &MorphologyModel, body: &Body, env: usize, joints: Option<&JointState>) -> Result<(), Error> {
    for (j, &q) in joints.map_or(&[][..], |joints| &joints.position[..]).iter().enumerate() {
        let (lower, upper) = (body.0.lower[j], body.0.upper[j]);
        if q < lower - LIMIT_TOLERANCE || q > upper + LIMIT_TOLERANCE {
            let problem = format!(
                "joint `{}` of env {env} would be at {q} (in the URDF's direction), and its limits are {lower} and {upper}",
                model.model.joints[j].name
            );
            let remedy = format!("pass positions at most {LIMIT_TOLERANCE} beyond the limits, e.g. by np.clip");
            return Err(Error::argument("set_state: joint_pos", problem, remedy));
        }
    }
    Ok(())
}

fn length(numbers: &[f32]) -> f32 {
    numbers.iter().map(|x| x * x).sum::<f32>().sqrt()
}

/// Checks the number of the numbers and that they are finite.
fn check_rows(element: &'static str, numbers: &[f32], envs: &[usize], width: usize) -> Result<(), Error> {
    if numbers.len() != envs.len() * width {
        let problem = format!("{} numbers for {} envs", numbers.len(), envs.len());
        return Err(Error::argument(element, problem, format!("pass {width} for each env")));
    }
    match numbers.iter().position(|x| !x.is_finite()) {
        None => Ok(()),
        Some(at) => {
            let problem = format!("{} in column {} of env {}", numbers[at], at % width, envs[at / width]);
            Err(Error::argument(element, problem, "pass numbers that are finite in single precision"))
        }
    }
}

/// Checks rows whose numbers must not be below zero.
fn check_not_negative(element: &'static str, numbers: &[f32], envs: &[usize], width: usize) -> Result<(), Error> {
    check_rows(element, numbers, envs, width)?;
    match numbers.iter().position(|x| *x < 0.0) {
        None => Ok(()),
        Some(at) => {
            let problem = format!("{} in column {} of env {}", numbers[at], at % width, envs[at / width]);
            Err(Error::argument(element, problem, "pass no negative number"))
        }
    }
}
