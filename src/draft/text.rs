//! The TOML of a draft, with the comments that its reader needs.

use std::fmt::{self, Write as _};

use toml::Value;

use super::{Drafted, Findings, GRAVITY, round};
use crate::config::{LEAST_BASE_MASS, matches};
use crate::robot::Side;

/// Share of weight and mass that is randomised.
const SHARE: f64 = 0.1;
/// Largest share of the base's mass that randomisation removes.
const HALF: f64 = 0.5;
/// Mass that randomisation leaves of a base, kg: what a simulation asks for, and more than
/// rounding.
const LEAST_BASE: f64 = 1.2 * LEAST_BASE_MASS;

pub(super) fn write(findings: &Findings<'_>) -> String {
    let mut out = String::new();
    // writing to a string never fails
    let _ = head(findings, &mut out)
        .and_then(|()| roles(findings, &mut out))
        .and_then(|()| pose(findings, &mut out))
        .and_then(|()| limits(findings, &mut out))
        .and_then(|()| actuators(findings, &mut out))
        .and_then(|()| commands(findings, &mut out))
        .and_then(|()| ranges(findings, &mut out));
    out
}

fn text(value: &str) -> Value {
    Value::String(value.to_owned())
}

fn head(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    let mass = findings.model.total_mass();
    writeln!(out, "# Drafted by `polypod robot new` from the URDF alone: put in what you know of the robot.")?;
    writeln!(out, "# {mass:.2} kg, legs of {:.3} m.", findings.leg_length)?;
    writeln!(out, "name = {}", text(findings.name))?;
    writeln!(out, "title = {}", text(&findings.title))?;
    writeln!(out, "urdf = {}", text(&findings.urdf.to_string_lossy()))?;
    writeln!(out, "reward_set = {}   # the [rewards.<set>] table of a task", text(&findings.reward_set))?;
    writeln!(out, "action_scale = {}           # rad of joint target per unit of action", findings.action_scale)?;
    writeln!(out, "self_collisions = false       # contact between the robot's own links")?;
    if !findings.options.package_dirs.is_empty() {
        writeln!(out, "\n[package_dirs]")?;
        for (package, folder) in &findings.options.package_dirs {
            writeln!(out, "{} = {}", text(package), text(&folder.to_string_lossy()))?;
        }
    }
    if !findings.locked.is_empty() {
        writeln!(out, "\n# Joints that the policy does not drive, held for good: rad or m.\n[locked_joints]")?;
        for (joint, position) in &findings.locked {
            writeln!(out, "{} = {position:?}", text(joint))?;
        }
    }
    Ok(())
}

fn roles(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    writeln!(out, "\n# Which joint of the URDF is which, as its geometry tells.\n[joint_roles]")?;
    for own in &findings.joints {
        writeln!(out, "{} = {}", own.name, text(&findings.model.joints[own.joint].name))?;
    }
    writeln!(out, "\n# The link whose shape is each leg's foot.\n[feet]")?;
    for (leg, body) in &findings.feet {
        writeln!(out, "{leg} = {}", text(&findings.model.bodies[*body].name))?;
    }
    Ok(())
}

fn pose(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    writeln!(
        out,
        "\n# Joint angles of the default pose, rad: feet level, the base frame {:.3} m above their soles.",
        findings.height
    )?;
    writeln!(out, "[default_pose]")?;
    for own in &findings.joints {
        // no negative zero
        writeln!(out, "{} = {:?}", own.name, own.sign * own.angle + 0.0)?;
    }
    Ok(())
}

fn limits(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    if findings.limits.is_empty() {
        return Ok(());
    }
    writeln!(out, "\n# Limits of joints that the URDF lets turn freely, rad, assumed: knees do not pass straight.")?;
    writeln!(out, "[joint_limits]")?;
    for (slot, limits) in &findings.limits {
        writeln!(out, "{slot} = {limits:?}")?;
    }
    Ok(())
}

fn actuators(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    writeln!(out, "\n# Gains by weight, leg length and effort, limits of the URDF where it has them.")?;
    let mut torques = String::new();
    for (at, (role, torque)) in findings.torques.iter().enumerate() {
        match at {
            0 => write!(torques, "{torque:.1} N m of {role}")?,
            _ => write!(torques, ", {torque:.1} of {role}")?,
        }
    }
    writeln!(out, "# Standing takes {torques}, at most.")?;
    let mut names: Vec<String> = Vec::new();
    for (index, (drive, slots)) in findings.groups().iter().enumerate() {
        let (mut name, patterns) = pattern(&findings.joints, slots);
        if names.contains(&name) {
            name = format!("{name}_{index}");
        }
        let joints: Vec<String> = patterns.iter().map(|joint| text(joint).to_string()).collect();
        writeln!(out, "[actuators.{name}]")?;
        writeln!(out, "joints = [{}]", joints.join(", "))?;
        names.push(name);
        writeln!(out, "model = \"ideal_pd\"            # ideal_pd | dc_motor | delayed_pd")?;
        writeln!(out, "stiffness = {:?}             # N m / rad", drive.stiffness)?;
        writeln!(out, "damping = {:?}               # N m s / rad", drive.damping)?;
        writeln!(out, "effort_limit = {:?}          # N m{}", drive.effort, drive.effort_is.comment())?;
        writeln!(out, "velocity_limit = {:?}        # rad/s{}", drive.velocity, drive.velocity_is.comment())?;
    }
    Ok(())
}

fn commands(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    let commands = findings.commands;
    writeln!(out, "\n# What the legs can be asked for: speeds of their length, m/s and rad/s.")?;
    writeln!(out, "[commands.base_velocity]")?;
    writeln!(out, "lin_vel_x = {:?}", commands.ahead)?;
    writeln!(out, "lin_vel_y = {:?}", [-commands.aside + 0.0, commands.aside])?;
    writeln!(out, "ang_vel_z = {:?}", [-commands.turn + 0.0, commands.turn])
}

/// Number of groups up to which a name lists them; larger ones are numbered.
const LISTED: usize = 3;

/// A name and patterns for these slots.
fn pattern(joints: &[Drafted], slots: &[usize]) -> (String, Vec<String>) {
    if slots.len() == joints.len() {
        return ("legs".to_string(), vec!["*".to_string()]);
    }
    let mut names: Vec<String> = Vec::new();
    let mut patterns = Vec::new();
    let mut done: Vec<&str> = Vec::new();
    for own in slots.iter().map(|slot| &joints[*slot]) {
        if own.side == Side::Middle {
            // torso, head, tail and middle arm have roles of the same names
            names.push(own.name.to_lowercase());
            patterns.push(own.name.clone());
            continue;
        }
        let suffix = own.suffix.as_str();
        if done.contains(&suffix) {
            continue;
        }
        done.push(suffix);
        names.push(match suffix {
            "HAA" => "abductors".to_string(),
            "HFE" => "hips".to_string(),
            "KFE" => "knees".to_string(),
            _ => suffix.to_lowercase(),
        });
        let is_of_role = |own: &Drafted| own.side != Side::Middle && own.suffix == suffix;
        let of_role = || slots.iter().filter(|slot| is_of_role(&joints[**slot]));
        // a pattern must not reach joints of other groups
        let whole = format!("*_{suffix}");
        let reached = joints.iter().enumerate().filter(|(_, own)| matches(&whole, &own.name));
        if of_role().count() > 1 && reached.map(|(slot, _)| slot).all(|slot| slots.contains(&slot)) {
            patterns.push(whole);
        } else {
            patterns.extend(of_role().map(|slot| joints[*slot].name.clone()));
        }
    }
    if names.len() > LISTED {
        names.truncate(LISTED);
        names.push("others".to_string());
    }
    // a pattern that reaches what another one names already adds nothing
    let all = patterns.clone();
    patterns.retain(|own| !all.iter().any(|other| other != own && matches(other, own)));
    (names.join("_and_"), patterns)
}

fn ranges(findings: &Findings<'_>, out: &mut String) -> fmt::Result {
    let mass = findings.model.total_mass();
    // a base may weigh less than a tenth of the robot
    let base = findings.model.links[0].mass;
    let lightest = -round((SHARE * mass).min(HALF * base).min(base - LEAST_BASE));
    let (kilograms, newtons) = (round(SHARE * mass), round(SHARE * mass * GRAVITY));
    let lever = 0.1 * findings.leg_length;
    let com = round(lever);
    // a robot on two legs begins exactly in its pose, as in tasks of humanoids
    let (pose, speed) =
        if findings.feet.len() > 2 { ("[0.9, 1.1]", "[-0.2, 0.2]") } else { ("[1.0, 1.0]", "[0.0, 0.0]") };
    writeln!(
        out,
        r#"
# How an episode begins.
[reset]
joint_position = {{ mode = "scale", range = {pose} }}   # of the default pose
joint_velocity = {{ range = [0.0, 0.0] }}                   # rad/s
base_velocity = {{ range = {speed} }}                   # each of the six components, world frame: m/s, rad/s
soft_limit_factor = 0.95                                  # share of the joint range that resets stay within
spawn_margin = 0.02                                       # m between the lowest foot of the default pose and the ground

# Ranges of the randomisation; a task's [events] switches it on.
[randomization]
static_friction = [0.5, 1.25]
dynamic_friction = [0.4, 1.0]
base_mass_offset = [{lightest:?}, {kilograms:?}]   # kg, a tenth of the robot's
base_com_offset = {{ x = [{:?}, {com:?}], y = [{:?}, {com:?}], z = [{:?}, {com:?}] }}   # m, a tenth of a leg
stiffness = {{ operation = "scale", distribution_params = [0.9, 1.1] }}
damping = {{ operation = "scale", distribution_params = [0.9, 1.1] }}
motor_strength = [0.9, 1.1]
external_force = [{:?}, {newtons:?}]       # N, a tenth of the weight
external_torque = [{:?}, {:?}]             # N m
action_delay = [0, 2]                      # physics steps"#,
        -com,
        -com,
        -com,
        -newtons,
        -round(newtons * lever),
        round(newtons * lever),
    )?;
    if !findings.has_variation {
        return Ok(());
    }
    writeln!(
        out,
        r#"
# Factors that the event body_variation draws a body from.
[variation]
base_length = [0.9, 1.1]
base_width = [0.9, 1.1]
thigh_length = [0.95, 1.05]
shank_length = [0.95, 1.05]
base_mass = [0.9, 1.1]
thigh_mass = [0.9, 1.1]
shank_mass = [0.9, 1.1]"#
    )
}
