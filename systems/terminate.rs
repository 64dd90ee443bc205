//! Which episodes end, and why.

use bevy_ecs::prelude::*;
use serde::{Deserialize, Serialize};

use super::Autoreset;
use super::terms::{CompiledTask, NoParams, Registry};
use super::view::{RobotView, ViewParam};
use crate::batch::Batch;
use crate::components::Episode;
use crate::dynamics::Real;
use crate::robot::BodyGroup;
use crate::rows::{Workers, write_rows};

/// Advances episodes and asks every termination term.
///
/// Under [`Autoreset::NextStep`] an env that ended before is only reset in this step: it neither ends nor advances.
pub(super) fn end_episodes(
    workers: Res<Workers>,
    task: Res<CompiledTask>,
    autoreset: Res<Autoreset>,
    views: ViewParam,
    mut batch: ResMut<Batch>,
    mut episodes: Query<&'static mut Episode>,
) {
    let views = views.views(task.step_dt);
    let batch = &mut *batch;
    let rows = (write_rows(&mut episodes), &mut batch.terminated[..], &mut batch.truncated[..]);
    workers.for_each_chunk(rows, views.len(), |first, n, (episodes, terminated, truncated)| {
        for i in 0..n {
            let episode = &mut episodes[i];
            episode.fresh = false;
            let view = views.get(first + i);
            let pending = *autoreset == Autoreset::NextStep && episode.needs_reset;
            if pending {
                (episode.terminated, episode.truncated, episode.causes) = (false, false, 0);
            } else {
                episode.length += 1;
                episode.invalid = !task.limits.allow(&view);
                episode.terminated = episode.invalid;
                episode.causes = u32::from(episode.invalid);
                episode.truncated = false;
                for (bit, term) in task.terminations.iter().enumerate() {
                    if (term.ends)(&view, episode, task.max_episode_length) {
                        episode.causes |= 1 << (bit + 1);
                        if term.time_out {
                            episode.truncated = true;
                        } else {
                            episode.terminated = true;
                        }
                    }
                }
                // an episode that fails in its last step has failed
                episode.truncated &= !episode.terminated;
                episode.needs_reset = episode.done();
            }
            terminated[i] = episode.terminated;
            truncated[i] = episode.truncated;
        }
    });
}

/// Speeds beyond which a state counts as broken.
#[derive(Serialize, Deserialize, Clone, Copy, Debug)]
#[serde(deny_unknown_fields, default)]
pub struct StateLimits {
    /// Of the base, m/s.
    pub max_lin_vel: f32,
    /// Of the base, rad/s.
    pub max_ang_vel: f32,
    /// Of any joint, rad/s.
    pub max_joint_vel: f32,
}

impl Default for StateLimits {
    fn default() -> Self {
        Self { max_lin_vel: 100.0, max_ang_vel: 200.0, max_joint_vel: 1000.0 }
    }
}

/// The quantities of a state that have a limit.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Position of the base, m.
    BasePosition,
    /// Orientation of the base, unit quaternion w, x, y, z.
    BaseRotation,
    /// Linear velocity of the base, m/s.
    BaseLinearVelocity,
    /// Angular velocity of the base, rad/s.
    BaseAngularVelocity,
    /// Joint positions, rad.
    JointPosition,
    /// Joint velocities, rad/s.
    JointVelocity,
    /// Efforts of the actuators, N m.
    JointEffort,
}

/// The numbers of one state, a slice for each [`Quantity`] in the order of that enum.
pub(super) type StateNumbers<'a, T> = [&'a [T]; 7];

/// A number of a state that is not finite or beyond its limit.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, PartialEq)]
pub struct Violation {
    /// What it belongs to.
    pub quantity: Quantity,
    /// Which number of the quantity: an axis, or a joint in physical order.
    pub index: usize,
    /// The number.
    pub value: f32,
    /// Largest allowed magnitude.
    pub limit: f32,
}

impl StateLimits {
    /// The first number that is not finite or beyond its limit; `value` reads one.
    pub(super) fn violation<T: Copy>(
        &self,
        numbers: StateNumbers<'_, T>,
        value: impl Fn(T) -> f32,
    ) -> Option<Violation> {
        self.of_quantities().into_iter().zip(numbers).find_map(|((quantity, limit), xs)| {
            // a NaN is not below anything
            let is_allowed = |x: f32| x.abs() <= limit;
            let index = xs.iter().position(|&x| !is_allowed(value(x)))?;
            Some(Violation { quantity, index, value: value(xs[index]), limit })
        })
    }

    /// The largest allowed magnitudes.
    #[inline(always)]
    fn of_quantities(&self) -> [(Quantity, f32); 7] {
        [
            (Quantity::BasePosition, 1e6),
            (Quantity::BaseRotation, 2.0),
            (Quantity::BaseLinearVelocity, self.max_lin_vel),
            (Quantity::BaseAngularVelocity, self.max_ang_vel),
            (Quantity::JointPosition, 1e6),
            (Quantity::JointVelocity, self.max_joint_vel),
            (Quantity::JointEffort, 1e9),
        ]
    }

    /// Whether some number of some lane is not finite or beyond its limit.
    #[inline(always)]
    pub(super) fn broken_anywhere<S: Real>(&self, numbers: StateNumbers<'_, S>) -> bool {
        let mut allowed = S::one();
        for ((_, limit), xs) in self.of_quantities().into_iter().zip(numbers) {
            // what is below the next number is not beyond the limit, and a NaN is not below anything
            let limit = S::splat(f64::from(limit.next_up()));
            for x in xs {
                allowed = S::select(x.abs().lt(limit), allowed, S::zero());
            }
        }
        S::any(allowed.lt(S::one()))
    }

    /// Whether the state is finite and within the limits.
    #[inline(always)]
    fn allow(&self, view: &RobotView) -> bool {
        let numbers = [
            &view.pose.position[..],
            &view.pose.rotation,
            &view.velocity.linear,
            &view.velocity.angular,
            &view.joints.position,
            &view.joints.velocity,
            &view.effort.applied,
        ];
        // all of a quantity's numbers at once
        let within = |limit: f32, xs: &[f32]| xs.iter().fold(true, |all, x| all & (x.abs() <= limit));
        self.of_quantities().into_iter().zip(numbers).all(|((_, limit), xs)| within(limit, xs))
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ContactThreshold {
    /// Normal force that ends the episode, N.
    threshold: f32,
}

/// All built-in terminations, under Isaac Lab's names.
pub(super) fn register(registry: &mut Registry) {
    registry.termination("time_out", true, |_: &NoParams, _, episode, most| episode.length >= most);
    registry.termination("base_contact", false, base_contact);
}

fn base_contact(p: &ContactThreshold, view: &RobotView, _: &Episode, _: u32) -> bool {
    let bodies = view.contacts.peak_force.iter().zip(&view.morphology.body_groups);
    bodies.into_iter().any(|(force, group)| *group == BodyGroup::Base && *force > p.threshold)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_broken_number_is_found_among_all() {
        let limits = StateLimits { max_lin_vel: 100.0, ..StateLimits::default() };
        let broken = |velocity: f32| {
            let (zeros, velocities) = ([0.0; 4], [3.0, velocity, -5.0]);
            let numbers: StateNumbers<f32> = [&zeros[..3], &zeros, &velocities, &zeros[..3], &zeros, &zeros, &zeros];
            let found = limits.violation(numbers, |x| x).is_some();
            assert_eq!(limits.broken_anywhere(numbers), found, "{velocity}");
            found
        };
        assert!([0.0, -0.0, 100.0, -100.0, 100.0f32.next_down()].into_iter().all(|x| !broken(x)));
        assert!([100.0f32.next_up(), -1e30, f32::NAN, f32::INFINITY, f32::NEG_INFINITY].into_iter().all(broken));
    }
}
