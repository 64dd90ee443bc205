//! Omitted meshes and held joints as the cause of other errors.

use super::error::{Diagnosis, RobotError, Topic};
use super::model::Model;
use super::shapes::LEFT_OUT;

/// An error of [`detect`](super::detect) on `model`; where collision meshes were left out or joints
/// held that mimic others, it names the first of them and what to do about it: without its shapes a
/// leg has no foot, without its joints it is no leg.
#[must_use]
pub fn naming_causes(error: RobotError, model: &Model) -> RobotError {
    let RobotError::Roles(mut diagnosis) = error else {
        return error;
    };
    let warnings_about = |topic: Topic| model.warnings.iter().filter(move |warning| warning.topic == topic);
    let mut coupled = warnings_about(Topic::Coupled);
    if let Some(first) = coupled.next() {
        let those = match coupled.count() {
            0 => String::new(),
            more => format!(" (as are {more} more)"),
        };
        diagnosis = Diagnosis {
            problem: format!("{}; {}: {}{those}", diagnosis.problem, first.element, first.problem),
            remedy: format!("{}; or {}", first.remedy, diagnosis.remedy),
            ..diagnosis
        };
    }
    let mut missing = warnings_about(Topic::MissingMesh);
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
