//! Randomisation in a robot's config: ranges that a task's `[events]` draw from.

use serde::{Deserialize, Serialize};

use super::quantities::{
    BodyFactor, Force, FrictionCoefficient, FrictionLength, Gain, MassOffset, Quantity, Shift, Strength,
};
use super::values;
use crate::bounds::Shown;

/// Least mass that randomisation must leave of a base, kg.
pub const LEAST_BASE_MASS: f64 = 0.01;

/// Ranges of a robot's randomisation; a task's `[events]` switches each on.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct RandomizationConfig {
    /// Coefficient of friction at rest. Default: 0.5 to 1.25.
    #[serde(deserialize_with = "values::range_of::<FrictionCoefficient, _, _>")]
    pub static_friction: [f64; 2],
    /// Coefficient of friction when sliding. Default: 0.4 to 1.
    #[serde(deserialize_with = "values::range_of::<FrictionCoefficient, _, _>")]
    pub dynamic_friction: [f64; 2],
    /// Coefficient of torsional friction, m. Default: the task's `robot_material`, and nothing is
    /// drawn.
    #[serde(
        deserialize_with = "values::optional_range_of::<FrictionLength, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub torsional_friction: Option<[f64; 2]>,
    /// Coefficient of rolling friction, m. Default: the task's `robot_material`, and nothing is
    /// drawn.
    #[serde(
        deserialize_with = "values::optional_range_of::<FrictionLength, _, _>",
        skip_serializing_if = "Option::is_none"
    )]
    pub rolling_friction: Option<[f64; 2]>,
    /// Mass added to the base, kg. Default: 0.
    #[serde(deserialize_with = "values::range_of::<MassOffset, _, _>")]
    pub base_mass_offset: [f64; 2],
    /// Shift of the base's centre of mass, base frame. Default: 0.
    pub base_com_offset: BaseComOffset,
    /// Stiffness of each actuator, N m/rad. Default: as it is.
    pub stiffness: Draw,
    /// Damping of each actuator, N m s/rad. Default: as it is.
    pub damping: Draw,
    /// Rotor inertia of each joint, kg m^2. Default: as it is.
    pub armature: Draw,
    /// Dry friction of each joint, N m. Default: as it is.
    pub joint_friction: Draw,
    /// Viscous friction of each joint, N m s/rad. Default: as it is, and nothing is drawn.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub joint_damping: Option<Draw>,
    /// Share of its torque that each motor gives. Default: all.
    #[serde(deserialize_with = "values::range_of::<Strength, _, _>")]
    pub motor_strength: [f64; 2],
    /// Each component of a force on the base, base frame, N. Default: 0.
    #[serde(deserialize_with = "values::range_of::<Force, _, _>")]
    pub external_force: [f64; 2],
    /// Each component of a torque on the base, base frame, N m. Default: 0.
    #[serde(deserialize_with = "values::range_of::<Force, _, _>")]
    pub external_torque: [f64; 2],
    /// Fewest and most physics steps by which all targets come late, on top of the actuators' own
    /// delays. Default: none.
    #[serde(deserialize_with = "values::step_range")]
    pub action_delay: [u32; 2],
}

impl Default for RandomizationConfig {
    fn default() -> Self {
        Self {
            static_friction: [0.5, 1.25],
            dynamic_friction: [0.4, 1.0],
            torsional_friction: None,
            rolling_friction: None,
            base_mass_offset: [0.0, 0.0],
            base_com_offset: BaseComOffset::default(),
            stiffness: Draw::default(),
            damping: Draw::default(),
            armature: Draw::default(),
            joint_friction: Draw::default(),
            joint_damping: None,
            motor_strength: [1.0, 1.0],
            external_force: [0.0, 0.0],
            external_torque: [0.0, 0.0],
            action_delay: [0, 0],
        }
    }
}

/// Shift of a centre of mass, m.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct BaseComOffset {
    /// Shift forward.
    #[serde(deserialize_with = "values::range_of::<Shift, _, _>")]
    pub x: [f64; 2],
    /// Shift to the left.
    #[serde(deserialize_with = "values::range_of::<Shift, _, _>")]
    pub y: [f64; 2],
    /// Shift upwards.
    #[serde(deserialize_with = "values::range_of::<Shift, _, _>")]
    pub z: [f64; 2],
}

/// Operation of a drawn number on a value; names and meaning are Isaac Lab's, but for
/// `add_effort_share`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Operation {
    /// The number is added to the value.
    Add,
    /// The number multiplies the value.
    #[default]
    Scale,
    /// The number replaces the value.
    Abs,
    /// The number times the joint's largest effort is added: one range fits small and large robots.
    /// A joint whose effort is unlimited keeps its value.
    AddEffortShare,
}

/// Distribution of a drawn number; names and meaning are Isaac Lab's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Distribution {
    /// The number is uniform between two numbers.
    #[default]
    Uniform,
    /// The logarithm is uniform between those of two positive numbers.
    LogUniform,
    /// The number is normal, of this mean and standard deviation.
    Gaussian,
}

/// Randomisation of a non-negative value.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, try_from = "UncheckedDraw")]
pub struct Draw {
    /// Operation of the drawn number on the value; a negative result becomes 0. Default: scale.
    pub operation: Operation,
    /// Distribution of the number. Default: uniform.
    pub distribution: Distribution,
    /// Lower and upper end, or mean and standard deviation; in the value's unit, for `scale`
    /// without one, and for `add_effort_share` in the value's unit per N m.
    pub distribution_params: [f64; 2],
}

impl Default for Draw {
    fn default() -> Self {
        Self { operation: Operation::Scale, distribution: Distribution::Uniform, distribution_params: [1.0, 1.0] }
    }
}

impl Draw {
    /// A checked draw.
    ///
    /// # Errors
    /// Parameters that the distribution cannot have: problem and remedy, with a semicolon in
    /// between.
    pub fn new(
        operation: Operation,
        distribution: Distribution,
        distribution_params: [f64; 2],
    ) -> Result<Self, String> {
        let [a, b] = distribution_params;
        let most = match operation {
            Operation::Scale | Operation::AddEffortShare => BodyFactor::MOST,
            Operation::Add | Operation::Abs => Gain::MOST,
        };
        if let Some(beyond) = distribution_params.iter().find(|x| x.is_nan() || x.abs() > most) {
            return Err(format!(
                "{} is beyond {}; write numbers from -{} to {}",
                Shown(*beyond),
                Shown(most),
                Shown(most),
                Shown(most)
            ));
        }
        match distribution {
            Distribution::Uniform | Distribution::LogUniform if a > b => {
                Err(format!("the lower end {a} is above the upper end {b}; write [lower, upper]"))
            }
            Distribution::LogUniform if a <= 0.0 => {
                Err(format!("the lower end {a} has no logarithm; write a range above 0"))
            }
            Distribution::Gaussian if b < 0.0 => {
                Err(format!("the standard deviation {b} is negative; write [mean, standard deviation]"))
            }
            _ => Ok(Self { operation, distribution, distribution_params }),
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct UncheckedDraw {
    #[serde(default)]
    operation: Operation,
    #[serde(default)]
    distribution: Distribution,
    distribution_params: [f64; 2],
}

impl TryFrom<UncheckedDraw> for Draw {
    type Error = String;

    fn try_from(draw: UncheckedDraw) -> Result<Self, String> {
        Self::new(draw.operation, draw.distribution, draw.distribution_params)
    }
}

/// Ranges of factors from which the event `body_variation` samples a body, each uniformly and
/// independently. A factor of a leg holds for all legs. Default: 1, the body of the URDF.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct VariationConfig {
    /// Length of the base: all that is on it, along x.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub base_length: [f64; 2],
    /// Width of the base, along y.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub base_width: [f64; 2],
    /// Distance between abduction and flexion joint of the hip.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub hip_offset: [f64; 2],
    /// Distance between hip and knee.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub thigh_length: [f64; 2],
    /// Distance between knee and foot.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub shank_length: [f64; 2],
    /// Mass of the base.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub base_mass: [f64; 2],
    /// Mass of each link between the joints of a hip.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub hip_mass: [f64; 2],
    /// Mass of each thigh.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub thigh_mass: [f64; 2],
    /// Mass of each shank with its foot.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub shank_mass: [f64; 2],
    /// Range of each joint about its middle; the default pose stays within.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub joint_range: [f64; 2],
    /// Stiffness of all actuators.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub stiffness: [f64; 2],
    /// Damping of all actuators.
    #[serde(deserialize_with = "values::range_of::<BodyFactor, _, _>")]
    pub damping: [f64; 2],
}

impl Default for VariationConfig {
    fn default() -> Self {
        const ONE: [f64; 2] = [1.0, 1.0];
        Self {
            base_length: ONE,
            base_width: ONE,
            hip_offset: ONE,
            thigh_length: ONE,
            shank_length: ONE,
            base_mass: ONE,
            hip_mass: ONE,
            thigh_mass: ONE,
            shank_mass: ONE,
            joint_range: ONE,
            stiffness: ONE,
            damping: ONE,
        }
    }
}
