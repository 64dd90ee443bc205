//! The TOML of a draft, with the comments that its reader needs.

use std::fmt::{self, Write as _};

use toml::Value;

use super::{DAMPING, Findings, GRAVITY, round, stance};
use crate::robot::{CANONICAL_JOINT_NAMES, LEGS, ROLES};

/// Share of weight and mass that is drawn.
const SHARE: f64 = 0.1;

pub(super) fn write(findings: &Findings<'_>) -> String {
    let mut out = String::new();
    // a string takes all that is written to it
    let _ = head(findings, &mut out)
        .and_then(|()| roles(findings, &mut out))
        .and_then(|()| pose(findings, &mut out))
        .and_then(|()| actuators(findings, &mut out))
        .and_then(|()| ranges(findings, &mut out));
    out
}

fn text(value: &str) -> Value {
    Value::String(value.to_owned())
}

fn head(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    let mass = findings.model.total_mass();
    writeln!(out, "# Drafted by `polypod robot new` from the URDF alone: put in what you know of the robot.")?;
    writeln!(out, "# {mass:.2} kg, legs of {:.3} m.", findings.stance.leg_length)?;
    writeln!(out, "name = {}", text(findings.name))?;
    writeln!(out, "title = {}", text(&findings.title))?;
    writeln!(out, "urdf = {}", text(&findings.urdf.to_string_lossy()))?;
    writeln!(out, "reward_set = {}   # the [rewards.<set>] table of a task", text(&findings.reward_set))?;
    writeln!(out, "action_scale = 0.25           # rad of joint target per unit of action")?;
    writeln!(out, "self_collisions = false       # contact between the robot's own links")?;
    if !findings.options.package_dirs.is_empty() {
        writeln!(out, "\n[package_dirs]")?;
        for (package, folder) in &findings.options.package_dirs {
            writeln!(out, "{} = {}", text(package), text(&folder.to_string_lossy()))?;
        }
    }
    if !findings.locked.is_empty() {
        writeln!(out, "\n# Joints that are no leg's, held for good: rad or m.\n[locked_joints]")?;
        for (joint, position) in &findings.locked {
            writeln!(out, "{} = {position:?}", text(joint))?;
        }
    }
    Ok(())
}

fn roles(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    writeln!(out, "\n# Which joint of the URDF is which, as its geometry tells.\n[joint_roles]")?;
    for (slot, joint) in CANONICAL_JOINT_NAMES.iter().enumerate() {
        let name = &findings.model.joints[findings.roles.joint_of_slot[slot]].name;
        writeln!(out, "{joint} = {}", text(name))?;
    }
    writeln!(out, "\n# The link whose shape is each leg's foot.\n[feet]")?;
    for (leg, body) in LEGS.iter().zip(findings.roles.foot_body) {
        writeln!(out, "{leg} = {}", text(&findings.model.bodies[body].name))?;
    }
    Ok(())
}

fn pose(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    let stance = findings.stance;
    writeln!(
        out,
        "\n# Joint angles of the default pose, rad: feet level, the base frame {:.3} m above their soles.",
        stance.height
    )?;
    writeln!(out, "[default_pose]")?;
    for (slot, joint) in CANONICAL_JOINT_NAMES.iter().enumerate() {
        let range = stance::range(findings.model, findings.roles.joint_of_slot[slot]);
        let angle = (stance.angles[slot] * 1e3).round() / 1e3;
        let sign = findings.roles.sign_of_slot[slot];
        // no negative zero
        writeln!(out, "{joint} = {:?}", sign * angle.clamp(*range.start(), *range.end()) + 0.0)?;
    }
    Ok(())
}

fn actuators(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    let [haa, hfe, kfe] = findings.stance.torques;
    writeln!(out, "\n# Gains in proportion to weight times leg length, limits of the URDF.")?;
    writeln!(out, "# Standing takes {haa:.1} N m of HAA, {hfe:.1} of HFE, {kfe:.1} of KFE, at most.")?;
    let mut names: Vec<String> = Vec::new();
    for (index, group) in findings.groups.iter().enumerate() {
        let (mut name, patterns) = pattern(&group.slots);
        if names.contains(&name) {
            name = format!("{name}_{index}");
        }
        let joints: Vec<String> = patterns.iter().map(|joint| text(joint).to_string()).collect();
        writeln!(out, "[actuators.{name}]")?;
        writeln!(out, "joints = [{}]", joints.join(", "))?;
        names.push(name);
        writeln!(out, "model = \"ideal_pd\"            # ideal_pd | dc_motor | delayed_pd")?;
        writeln!(out, "stiffness = {:?}             # N m / rad", findings.stiffness)?;
        writeln!(out, "damping = {:?}               # N m s / rad", round(DAMPING * findings.stiffness))?;
        writeln!(out, "effort_limit = {:?}          # N m", group.effort)?;
        if let Some(velocity) = group.velocity {
            writeln!(out, "velocity_limit = {velocity:?}        # rad/s")?;
        }
    }
    Ok(())
}

/// A name and patterns for these slots.
fn pattern(slots: &[usize]) -> (String, Vec<String>) {
    if slots.len() == CANONICAL_JOINT_NAMES.len() {
        return ("legs".to_string(), vec!["*".to_string()]);
    }
    let mut names = Vec::new();
    let mut patterns = Vec::new();
    for (role, (name, suffix)) in ["abductors", "hips", "knees"].into_iter().zip(ROLES).enumerate() {
        let of_role: Vec<usize> = slots.iter().copied().filter(|slot| slot / LEGS.len() == role).collect();
        if of_role.is_empty() {
            continue;
        }
        names.push(name);
        if of_role.len() == LEGS.len() {
            patterns.push(format!("*_{suffix}"));
        } else {
            patterns.extend(of_role.iter().map(|&slot| CANONICAL_JOINT_NAMES[slot].to_string()));
        }
    }
    (names.join("_and_"), patterns)
}

fn ranges(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    let mass = findings.model.total_mass();
    let (kilograms, newtons) = (round(SHARE * mass), round(SHARE * mass * GRAVITY));
    let lever = 0.1 * findings.stance.leg_length;
    let com = round(lever);
    writeln!(
        out,
        r#"
# How an episode begins.
[reset]
joint_position = {{ mode = "scale", range = [0.9, 1.1] }}   # of the default pose
joint_velocity = {{ range = [0.0, 0.0] }}                   # rad/s
base_velocity = {{ range = [-0.2, 0.2] }}                   # each of the six components, world frame: m/s, rad/s
soft_limit_factor = 0.95                                  # share of the joint range that resets stay within
spawn_margin = 0.02                                       # m between the lowest foot of the default pose and the ground

# Ranges of the randomisation; a task's [events] switches it on.
[randomization]
static_friction = [0.5, 1.25]
dynamic_friction = [0.4, 1.0]
base_mass_offset = [{:?}, {kilograms:?}]   # kg, a tenth of the robot's
base_com_offset = {{ x = [{:?}, {com:?}], y = [{:?}, {com:?}], z = [{:?}, {com:?}] }}   # m, a tenth of a leg
stiffness = {{ operation = "scale", distribution_params = [0.9, 1.1] }}
damping = {{ operation = "scale", distribution_params = [0.9, 1.1] }}
motor_strength = [0.9, 1.1]
external_force = [{:?}, {newtons:?}]       # N, a tenth of the weight
external_torque = [{:?}, {:?}]             # N m
action_delay = [0, 2]                      # physics steps

# Factors that the event body_variation draws a body from.
[variation]
base_length = [0.9, 1.1]
base_width = [0.9, 1.1]
thigh_length = [0.95, 1.05]
shank_length = [0.95, 1.05]
base_mass = [0.9, 1.1]
thigh_mass = [0.9, 1.1]
shank_mass = [0.9, 1.1]"#,
        -kilograms,
        -com,
        -com,
        -com,
        -newtons,
        -round(newtons * lever),
        round(newtons * lever),
    )
}
