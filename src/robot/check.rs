//! Description of a URDF for people.

use std::collections::BTreeMap;
use std::fmt::{self, Write as _};
use std::path::Path;

use super::articulation::Articulation;
use super::error::RobotError;
use super::limbs::{LimbKind, Roles};
use super::model::{Geometry, JointKind, Model, Shape};
use super::roles::detect;
use super::symmetry::unequal_sides;
use super::urdf::{Coupled, LoadOptions, load};

/// Reads the URDF file at `path` and describes the result: links, joints, contact bodies, limbs,
/// and every warning. A robot without legs is no error. Joints that mimic others are held, with a
/// warning.
///
/// # Errors
/// Any error of [`load`].
pub fn check(path: &Path, options: &LoadOptions) -> Result<String, RobotError> {
    let model = load(path, &LoadOptions { coupled: Coupled::Held, ..options.clone() })?;
    let mut out = String::new();
    // Writing to a string never fails.
    let _ = describe(&model, &mut out);
    Ok(out)
}

fn describe(model: &Model, out: &mut String) -> fmt::Result {
    let articulation = Articulation::new(model, true, &[], None);
    let name = if model.name.trim().is_empty() { "robot without a name" } else { &model.name };
    writeln!(out, "{name} ({})", model.source.display())?;
    writeln!(
        out,
        "{:.3} kg, {} links, {} joints ({} degrees of freedom with a floating base), {} contact points",
        model.total_mass(),
        model.links.len(),
        model.joints.len(),
        model.joints.len() + 6,
        articulation.topology.contacts.len()
    )?;
    links(model, out)?;
    joints(model, out)?;
    bodies(model, out)?;
    let mut warnings = model.warnings.clone();
    match detect(model, &BTreeMap::new(), &BTreeMap::new()) {
        Ok(roles) => {
            limbs(model, &roles, out)?;
            warnings.extend(unequal_sides(model, &roles));
        }
        Err(error) => writeln!(out, "\nno legged robot: {}", error.diagnosis().problem)?,
    }
    writeln!(out, "\nwarnings: {}", warnings.len())?;
    for warning in &warnings {
        writeln!(out, "  {}", warning.finding())?;
    }
    Ok(())
}

fn links(model: &Model, out: &mut String) -> fmt::Result {
    let width = widest(model.links.iter().map(|link| &link.name));
    writeln!(out, "\nlinks (the base first)")?;
    for link in &model.links {
        let [x, y, z] = link.com.to_array();
        write!(out, "  {:<width$} {:>10.4} kg, com ({x:+.4}, {y:+.4}, {z:+.4}) m", link.name, link.mass)?;
        if !link.merged.is_empty() {
            write!(out, ", with {}", link.merged.join(", "))?;
        }
        writeln!(out)?;
    }
    Ok(())
}

fn joints(model: &Model, out: &mut String) -> fmt::Result {
    let width = widest(model.joints.iter().map(|joint| &joint.name));
    let parents = widest(model.joints.iter().map(|joint| &model.links[joint.parent].name));
    writeln!(out, "\njoints (rad, N m and rad/s, or m, N and m/s)")?;
    for joint in &model.joints {
        let kind = match joint.kind {
            JointKind::Revolute => "revolute",
            JointKind::Continuous => "continuous",
            JointKind::Prismatic => "prismatic",
        };
        writeln!(
            out,
            "  {:<width$} {kind:<10} on {:<parents$} {:>8.3} .. {:>6.3}, effort {:.2}, velocity {:.2}",
            joint.name, model.links[joint.parent].name, joint.lower, joint.upper, joint.effort, joint.velocity
        )?;
    }
    Ok(())
}

fn bodies(model: &Model, out: &mut String) -> fmt::Result {
    let width = widest(model.bodies.iter().map(|body| &body.name));
    writeln!(out, "\ncontact bodies")?;
    for body in &model.bodies {
        let shapes: Vec<String> = body.shapes.iter().map(shape).collect();
        writeln!(out, "  {:<width$} on {}: {}", body.name, model.links[body.link].name, shapes.join(", "))?;
    }
    Ok(())
}

/// A shape and its sizes.
fn shape(shape: &Shape) -> String {
    match &shape.geometry {
        Geometry::Sphere { radius } => format!("sphere of radius {radius:.4} m"),
        Geometry::Box { size } => format!("box of {:.4} x {:.4} x {:.4} m", size.x, size.y, size.z),
        Geometry::Cylinder { radius, length } => format!("cylinder of radius {radius:.4} m, length {length:.4} m"),
        Geometry::Capsule { radius, length } => format!("capsule of radius {radius:.4} m, length {length:.4} m"),
        Geometry::Hull { points } => format!("hull of {} points", points.len()),
    }
}

fn limbs(model: &Model, roles: &Roles, out: &mut String) -> fmt::Result {
    writeln!(out, "\n{} (+: the URDF's axis turns as the role does; -: the other way round)", roles.class())?;
    for limb in &roles.limbs {
        let joints: Vec<String> = limb
            .joints
            .iter()
            .map(|joint| {
                let sign = if joint.sign < 0.0 { '-' } else { '+' };
                format!("{} = {sign}{}", joint.slot, model.joints[joint.joint].name)
            })
            .collect();
        let kind = match limb.kind {
            LimbKind::Leg => "leg",
            LimbKind::Arm => "arm",
            LimbKind::Torso => "torso",
            LimbKind::Head => "head",
            LimbKind::Tail => "tail",
        };
        write!(out, "  {} {kind}: {}", limb.place.name(), joints.join(", "))?;
        if let Some(foot) = &limb.foot {
            write!(out, ", foot = {}", model.bodies[foot.body].name)?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// Length of the longest name.
fn widest<'a>(names: impl Iterator<Item = &'a String>) -> usize {
    names.map(|name| name.chars().count()).max().unwrap_or(0).min(40)
}
