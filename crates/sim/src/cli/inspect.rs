//! `polypod-sim inspect`

use std::io::Write;

use clap::Args;
use polypod::Error;
use polypod::config::Library;
use polypod::morphology::MorphologyModel;
use polypod::robot::{Geometry, summed_up};

/// Arguments of `inspect`.
#[derive(Args)]
pub(super) struct Inspect {
    /// Name of the robot, or path of its config.
    #[arg(long)]
    robot: String,
}

impl Inspect {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        let loaded = Library::new(Vec::new()).robot(&self.robot).map_err(Error::from)?;
        let robot = MorphologyModel::new(&loaded)?;
        let model = &robot.model;
        writeln!(out, "{} ({}), {}", robot.name(), robot.config.title, loaded.urdf_path.display())?;
        writeln!(
            out,
            "{:.3} kg, {} links, {} joints, base {:.3} m above the ground in the default pose, reward set `{}`, action scale {}",
            model.total_mass(),
            model.links.len(),
            model.joints.len(),
            robot.describe().base_height,
            robot.config.reward_set,
            robot.stance.action_scale
        )?;
        writeln!(out, "\nlinks")?;
        for link in &model.links {
            let c = link.com;
            writeln!(out, "  {:<24} {:>9.4} kg, com ({:+.4}, {:+.4}, {:+.4}) m", link.name, link.mass, c.x, c.y, c.z)?;
        }
        writeln!(out, "\njoints (physical order)")?;
        writeln!(
            out,
            "  {:<18} {:<18} {:<20} {:>18} {:>8} {:>8} {:>8} {:>9} {:>9}",
            "joint", "slot", "parent", "limits (rad)", "default", "kp", "kd", "armature", "effort"
        )?;
        let description = robot.describe();
        for (j, joint) in model.joints.iter().enumerate() {
            let slot = robot.roles.joint_of_slot.iter().position(|&own| own == j).map(|at| robot.roles.slots[at]);
            let sign = if robot.sign_of(j) < 0.0 { "-" } else { "" };
            let slot = slot.map_or("-".to_owned(), |slot| format!("{sign}{slot}"));
            writeln!(
                out,
                "  {:<18} {:<18} {:<20} {:>8.3} .. {:>6.3} {:>8.3} {:>8.2} {:>8.2} {:>9.4} {:>9.2}",
                joint.name,
                slot,
                model.links[joint.parent].name,
                joint.lower,
                joint.upper,
                robot.stance.default_position[j],
                robot.nominal.stiffness[j],
                robot.nominal.damping[j],
                robot.nominal.armature[j],
                description.effort_limit[j]
            )?;
        }
        writeln!(out, "\ncontact bodies")?;
        for (body, group) in model.bodies.iter().zip(&robot.body_groups) {
            let shapes: Vec<&str> = body.shapes.iter().map(|shape| name(&shape.geometry)).collect();
            let link = &model.links[body.link].name;
            writeln!(
                out,
                "  {:<24} on {:<24} {:<6} {}",
                body.name,
                link,
                format!("{group:?}").to_lowercase(),
                shapes.join(", ")
            )?;
        }
        for warning in summed_up(&model.warnings) {
            writeln!(out, "\nwarning: {warning}")?;
        }
        Ok(())
    }
}

fn name(geometry: &Geometry) -> &'static str {
    match geometry {
        Geometry::Sphere { .. } => "sphere",
        Geometry::Box { .. } => "box",
        Geometry::Cylinder { .. } => "cylinder",
        Geometry::Capsule { .. } => "capsule",
        Geometry::Hull { .. } => "hull",
    }
}
