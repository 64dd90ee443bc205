//! Meshes that are not there, as the cause of other errors.

use super::error::{Diagnosis, RobotError};
use super::model::Model;
use super::shapes::LEFT_OUT;

/// An error of [`detect`](super::detect) on `model`; where collision meshes were left out, it names the first of them and
/// what to do about it: without its shapes a leg has no foot.
#[must_use]
pub fn naming_missing_meshes(error: RobotError, model: &Model) -> RobotError {
    let RobotError::Roles(diagnosis) = error else {
        return error;
    };
    let is_missing = |warning: &&Diagnosis| warning.problem.starts_with("mesh ") && warning.problem.ends_with(LEFT_OUT);
    let mut missing = model.warnings.iter().filter(is_missing);
    let Some(first) = missing.next() else {
        return RobotError::Roles(diagnosis);
    };
    let count = 1 + missing.count();
    let what = first.problem.strip_suffix(LEFT_OUT).unwrap_or(&first.problem);
    let those = if count == 1 { "a collision mesh was".to_string() } else { format!("{count} collision meshes were") };
    RobotError::Roles(Diagnosis {
        problem: format!("{}; {those} left out: {}: {what}", diagnosis.problem, first.element),
        remedy: format!("{}; or {}", first.remedy, diagnosis.remedy),
        ..diagnosis
    })
}
