//! Limits beyond which a state counts as broken.

use serde::{Deserialize, Serialize};

use crate::dynamics::lanes::Real;

/// Speeds beyond which a state counts as broken.
#[derive(Serialize, Deserialize, Clone, Copy, Debug)]
#[serde(deny_unknown_fields, default)]
pub struct StateLimits {
    /// Largest speed of the base, m/s.
    pub max_lin_vel: f32,
    /// Largest angular speed of the base, rad/s.
    pub max_ang_vel: f32,
    /// Largest speed of any joint, rad/s.
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
pub(crate) type StateNumbers<'a, T> = [&'a [T]; 7];

/// A number of a state that is not finite or beyond its limit.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, PartialEq)]
pub struct Violation {
    /// Quantity that the number belongs to.
    pub quantity: Quantity,
    /// Index within the quantity: an axis, or a joint in physical order.
    pub index: usize,
    /// Value of the number, in the unit of its quantity.
    pub value: f32,
    /// Largest allowed magnitude.
    pub limit: f32,
}

impl StateLimits {
    /// The first number that is not finite or beyond its limit; `value` reads it from a `T`.
    pub(crate) fn violation<T: Copy>(
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

    /// The largest allowed magnitude of each quantity.
    #[inline(always)]
    pub(crate) fn of_quantities(&self) -> [(Quantity, f32); 7] {
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
    pub(crate) fn broken_anywhere<S: Real>(&self, numbers: StateNumbers<'_, S>) -> bool {
        let mut allowed = S::one();
        for ((_, limit), xs) in self.of_quantities().into_iter().zip(numbers) {
            // a number below the next larger float is within the limit; a NaN is not below anything
            let limit = S::splat(f64::from(limit.next_up()));
            for x in xs {
                allowed = S::select(x.abs().lt(limit), allowed, S::zero());
            }
        }
        S::when(allowed.lt(S::one())).is_some()
    }
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
