//! Comparison of a robot's config with its URDF. Errors name the config's file, the joint and its
//! range.

use crate::bounds::Shown;
use crate::config::{ConfigError, JointPositionMode, LEAST_BASE_MASS, LoadedRobot};
use crate::robot::{JointKind, Model, Roles, soft_limits};

/// Limits of a joint in the direction of its slot, rad or m.
#[derive(Clone, Copy)]
struct Limits {
    lower: f64,
    upper: f64,
}

impl Limits {
    /// Rounding of positions, rad: limits are often written with six digits.
    const ROUNDING: f64 = 1e-5;

    fn of([lower, upper]: [f64; 2], sign: f64) -> Self {
        if sign < 0.0 { Self { lower: -upper, upper: -lower } } else { Self { lower, upper } }
    }

    /// The soft limits that resets stay within.
    fn soft(self, share: f64) -> Self {
        let [lower, upper] = soft_limits([self.lower as f32, self.upper as f32], share as f32).map(f64::from);
        Self { lower, upper }
    }

    /// Whether a range of positions overlaps the limits.
    fn meet(self, [low, high]: [f64; 2]) -> bool {
        high >= self.lower - Self::ROUNDING && low <= self.upper + Self::ROUNDING
    }
}

impl std::fmt::Display for Limits {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} .. {}", Shown(self.lower), Shown(self.upper))
    }
}

/// Checks a robot's config against its URDF; `default_pose` is that of its slots, canonical
/// directions, rad.
///
/// # Errors
/// A joint that is locked, stands or begins beyond its limits; an actuator without any effort; a
/// base without mass.
pub(crate) fn check(
    loaded: &LoadedRobot,
    model: &Model,
    roles: &Roles,
    default_pose: &[f64],
) -> Result<(), ConfigError> {
    check_locks(loaded, model)?;
    check_positions(loaded, model, roles, default_pose)?;
    check_efforts(loaded, model, roles)?;
    check_base(loaded, model)
}

/// Narrows the limits of joints to those of `[joint_limits]`, which are in the direction of the
/// slot.
///
/// # Errors
/// Limits of a joint that the robot lacks, and limits that do not overlap those of the URDF.
pub(crate) fn narrow_limits(loaded: &LoadedRobot, model: &mut Model, roles: &Roles) -> Result<(), ConfigError> {
    for (name, &own) in &loaded.config.joint_limits {
        let element = || format!("joint_limits.{name}");
        let Some(at) = roles.slots.iter().position(|slot| slot.to_string() == *name) else {
            let remedy = "name a joint of [default_pose], or remove the line";
            return Err(invalid(loaded, element(), "the robot has no such joint".into(), remedy));
        };
        let joint = &mut model.joints[roles.joint_of_slot[at]];
        let stated = Limits::of([joint.lower, joint.upper], roles.sign_of_slot[at]);
        let both = Limits { lower: stated.lower.max(own[0]), upper: stated.upper.min(own[1]) };
        if both.lower >= both.upper {
            let own = Limits { lower: own[0], upper: own[1] };
            let problem =
                format!("{own} has nothing in common with the limits {stated} of the joint \"{}\"", joint.name);
            return Err(invalid(loaded, element(), problem, "write limits within those of the URDF, rad or m"));
        }
        let narrowed = Limits::of([both.lower, both.upper], roles.sign_of_slot[at]);
        (joint.lower, joint.upper) = (narrowed.lower, narrowed.upper);
        if joint.kind == JointKind::Continuous {
            joint.kind = JointKind::Revolute;
        }
    }
    Ok(())
}

fn check_locks(loaded: &LoadedRobot, model: &Model) -> Result<(), ConfigError> {
    for lock in &model.locked {
        let limits = Limits::of([lock.lower, lock.upper], 1.0);
        if !limits.meet([lock.position; 2]) {
            let problem = format!("{} is outside the joint's limits {limits}", Shown(lock.position));
            let remedy = "write a position between them, in rad or m";
            return Err(invalid(loaded, format!("locked_joints.{}", lock.name), problem, remedy));
        }
    }
    Ok(())
}

fn check_positions(
    loaded: &LoadedRobot,
    model: &Model,
    roles: &Roles,
    default_pose: &[f64],
) -> Result<(), ConfigError> {
    let reset = &loaded.config.reset;
    let [low, high] = reset.joint_position.range;
    for (i, (&pose, &j)) in default_pose.iter().zip(&roles.joint_of_slot).enumerate() {
        let (slot, joint) = (roles.slots[i], &model.joints[j]);
        let limits = Limits::of([joint.lower, joint.upper], roles.sign_of_slot[i]);
        if !limits.meet([pose; 2]) {
            let problem = format!("{} is outside the limits {limits} of the joint \"{}\"", Shown(pose), joint.name);
            let remedy = "write a position between them, in rad or m, or correct the <limit> in the URDF";
            return Err(invalid(loaded, format!("default_pose.{slot}"), problem, remedy));
        }
        let [a, b] = match reset.joint_position.mode {
            JointPositionMode::Scale => [pose * low, pose * high],
            JointPositionMode::Offset => [pose + low, pose + high],
        };
        let soft = limits.soft(reset.soft_limit_factor);
        if !soft.meet([a.min(b), a.max(b)]) {
            let problem = format!(
                "{slot} would begin at {} to {}, outside its soft limits {soft}",
                Shown(a.min(b)),
                Shown(a.max(b))
            );
            let remedy = "write a range that reaches between them, or raise reset.soft_limit_factor";
            return Err(invalid(loaded, "reset.joint_position.range".into(), problem, remedy));
        }
    }
    Ok(())
}

fn check_efforts(loaded: &LoadedRobot, model: &Model, roles: &Roles) -> Result<(), ConfigError> {
    let actuators = loaded.config.actuators_by_slot(&roles.slots)?;
    for ((group, actuator), &j) in actuators.iter().zip(&roles.joint_of_slot) {
        let joint = &model.joints[j];
        if actuator.effort_limit.is_none() && actuator.effort_table.is_empty() && joint.effort == 0.0 {
            let problem = format!("has no effort_limit, and the URDF's for the joint \"{}\" is 0", joint.name);
            return Err(invalid(loaded, format!("actuators.{group}"), problem, "write effort_limit, in N m"));
        }
    }
    Ok(())
}

fn check_base(loaded: &LoadedRobot, model: &Model) -> Result<(), ConfigError> {
    let (config, mass) = (&loaded.config, model.links.first().map_or(0.0, |base| base.mass));
    let lightest = mass * config.variation.base_mass[0].min(1.0);
    let offset = config.randomization.base_mass_offset[0];
    if lightest + offset < LEAST_BASE_MASS {
        let problem = format!("{} kg is more than the base has, which weighs {lightest:.3} kg at least", Shown(offset));
        let remedy = format!("write a lower end above {:.3}", LEAST_BASE_MASS - lightest);
        return Err(invalid(loaded, "randomization.base_mass_offset".into(), problem, &remedy));
    }
    Ok(())
}

fn invalid(loaded: &LoadedRobot, element: String, problem: String, remedy: &str) -> ConfigError {
    loaded.blame(ConfigError::invalid(loaded.config.name.clone(), element, problem, remedy))
}
