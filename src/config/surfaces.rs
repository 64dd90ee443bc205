//! Surfaces of parts of a robot: `[surfaces.<name>]` in its TOML.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::robot::BodySurface;

use super::error::ConfigError;
use super::quantities::{FrictionCoefficient, FrictionLength, Rise};
use super::robot::{RobotConfig, matches};
use super::suggest::did_you_mean;
use super::values;

/// BodySurface of some links where they touch the ground.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SurfaceConfig {
    /// Patterns on names of links with a collision shape; `*` stands for any run of letters.
    pub bodies: Vec<String>,
    /// Factor on the coefficients of sliding friction of robot and ground. Default: 1.
    #[serde(default = "one", deserialize_with = "values::number_of::<FrictionCoefficient, _, _>")]
    pub friction: f64,
    /// Coefficient of torsional friction, m; the larger one of this and of the robot's and the
    /// ground's acts. Default: 0.
    #[serde(
        default,
        deserialize_with = "values::number_of::<FrictionLength, _, _>",
        skip_serializing_if = "values::is_zero"
    )]
    pub torsional_friction: f64,
    /// Coefficient of rolling friction, m; the larger one of this and of the robot's and the
    /// ground's acts. Default: 0.
    #[serde(
        default,
        deserialize_with = "values::number_of::<FrictionLength, _, _>",
        skip_serializing_if = "values::is_zero"
    )]
    pub rolling_friction: f64,
    /// Distance from the ground at which contact begins, m. Default: 0.
    #[serde(default, deserialize_with = "values::number_of::<Rise, _, _>", skip_serializing_if = "values::is_zero")]
    pub contact_margin: f64,
}

fn one() -> f64 {
    1.0
}

/// Largest contact margin, m. A robot with more would hover.
const MOST_MARGIN: f64 = 0.1;

impl RobotConfig {
    /// BodySurface of each of the contact bodies with these names.
    ///
    /// # Errors
    /// A pattern that matches no body, or a body in several surfaces.
    pub(crate) fn surfaces_of(&self, bodies: &[&str]) -> Result<Vec<BodySurface>, ConfigError> {
        let mut owner: BTreeMap<&str, &str> = BTreeMap::new();
        let mut surfaces = vec![BodySurface::default(); bodies.len()];
        for (name, surface) in &self.surfaces {
            for (index, pattern) in surface.bodies.iter().enumerate() {
                let element = format!("surfaces.{name}.bodies[{index}]");
                let mut found = bodies.iter().zip(&mut surfaces).filter(|(body, _)| matches(pattern, body)).peekable();
                if found.peek().is_none() {
                    let problem = format!("`{pattern}` matches no link with a collision shape");
                    let remedy = did_you_mean(pattern, bodies.iter().copied(), "links");
                    return Err(ConfigError::invalid(self.name.clone(), element, problem, remedy));
                }
                for (&body, of_body) in found {
                    if let Some(other) = owner.insert(body, name.as_str()).filter(|other| *other != name.as_str()) {
                        let problem = format!("`{body}` is in surfaces.{other}, too");
                        let remedy = "let the `bodies` patterns name every link in one surface at most";
                        return Err(ConfigError::invalid(self.name.clone(), element, problem, remedy));
                    }
                    *of_body = BodySurface {
                        friction: surface.friction,
                        torsional_friction: surface.torsional_friction,
                        rolling_friction: surface.rolling_friction,
                        margin: surface.contact_margin,
                    };
                }
            }
        }
        Ok(surfaces)
    }

    /// Checks what a URDF does not decide.
    pub(super) fn validate_surfaces(&self) -> Result<(), ConfigError> {
        for (name, surface) in &self.surfaces {
            let element = |key: &str| format!("surfaces.{name}.{key}");
            if surface.bodies.is_empty() {
                let remedy = "name links with a collision shape, or remove the surface";
                return Err(ConfigError::invalid(self.name.clone(), element("bodies"), "is empty", remedy));
            }
            if surface.contact_margin > MOST_MARGIN {
                let problem = format!("{} m is more than {MOST_MARGIN} m", surface.contact_margin);
                let remedy = "write the distance from the ground at which contact begins, in m";
                return Err(ConfigError::invalid(self.name.clone(), element("contact_margin"), problem, remedy));
            }
        }
        Ok(())
    }
}
