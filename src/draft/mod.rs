//! A first config for a robot of which only the URDF is known: roles, a pose to stand in, gains, ranges.

mod quadruped;
mod stance;
mod text;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::config::{ConfigError, Library};
use crate::error::Error;
use crate::robot::{Joint, LEGS, LoadOptions, Model, ROLES, Warning, load, load_str};
use quadruped::{Roles, detect};
use stance::{GRAVITY, REACHED, Stance, nearest_to_zero};

/// Stiffness over weight times leg length. Legs as bent as these give way by about 0.15 rad; below 0.5 some buckle. The robots
/// in `configs/robots` have 0.20 to 0.49.
const STIFFNESS: f64 = 0.7;
/// Damping over stiffness, s; theirs is 1/50 to 1/31.
const DAMPING: f64 = 1.0 / 40.0;
/// Effort limit over weight times leg length where the URDF has none; theirs is 0.20 to 0.62.
const EFFORT: f64 = 0.35;
/// Share of the effort limit that standing may take.
const STANDING_EFFORT: f64 = 0.5;

/// A robot config as text, and what its writer has to look at.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Draft {
    /// The robot's name in configs.
    pub name: String,
    /// The text of `<name>.toml`.
    pub toml: String,
    /// What was assumed, for people; one line each.
    pub notes: Vec<String>,
}

/// What a draft cannot find out by itself.
#[derive(Clone, Debug, Default)]
pub struct DraftOptions {
    /// The robot's name in configs. Default: the URDF's, or the file's, in small letters.
    pub name: Option<String>,
    /// What the config says under `urdf`. Default: the file as given.
    pub urdf: Option<PathBuf>,
    /// ROS package -> folder.
    pub package_dirs: BTreeMap<String, PathBuf>,
    /// Leg -> link of the URDF that is its foot, where geometry alone does not tell.
    pub feet: BTreeMap<String, String>,
    /// Multiplies the gains that follow from mass and leg length. Default: 1.
    pub gain_factor: Option<f64>,
}

/// What the text is written from.
struct Findings<'a> {
    name: &'a str,
    title: String,
    urdf: PathBuf,
    /// Of the known robot whose mass is nearest.
    reward_set: String,
    options: &'a DraftOptions,
    model: &'a Model,
    roles: &'a Roles,
    stance: &'a Stance,
    locked: BTreeMap<String, f64>,
    groups: Vec<Group>,
    /// Of joints for which the URDF has none, N m.
    missing_effort: f64,
    stiffness: f64,
}

/// Joints with the same limits.
struct Group {
    slots: Vec<usize>,
    effort: f64,
    velocity: Option<f64>,
}

/// Drafts the config of the robot whose URDF is at `file`: a quadruped's roles and feet from geometry, every other joint
/// held, a standing pose with the feet level that policies of the known robots know, gains in proportion to weight times leg length, rewards as
/// of the known robot whose mass is nearest.
///
/// # Errors
/// A name without letters or digits; those of [`load`] and [`detect`](crate::robot::detect); a robot that is no quadruped of twelve joints; a robot of `POLYPOD_PATH` that cannot be read.
pub fn draft(file: &Path, options: &DraftOptions) -> Result<Draft, Error> {
    if let Some(name) = &options.name
        && !name.contains(|c: char| c.is_ascii_alphanumeric())
    {
        let problem = format!("`{name}` has no letter or digit");
        let remedy = "pass a name such as `my_robot`, or none: the URDF's is taken then";
        return Err(ConfigError::invalid(file.display().to_string(), "name", problem, remedy).into());
    }
    let mut load_options = LoadOptions { package_dirs: options.package_dirs.clone(), ..LoadOptions::default() };
    let whole = load(file, &load_options)?;
    let roles = detect(&whole, &options.feet)?;
    let others = whole.joints.iter().enumerate().filter(|(joint, _)| !roles.joint_of_slot.contains(joint));
    load_options.locked_joints = others.map(|(_, joint)| (joint.name.clone(), nearest_to_zero(joint))).collect();
    let (model, roles) = if load_options.locked_joints.is_empty() {
        (whole, roles)
    } else {
        let model = load(file, &load_options)?;
        let roles = detect(&model, &options.feet)?;
        (model, roles)
    };

    let stance = Stance::find(&model, &roles);
    let load = model.total_mass() * GRAVITY * stance.leg_length;
    let missing_effort = round(EFFORT * load);
    let stem = file.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    let given = if model.name.trim().is_empty() { &stem } else { &model.name };
    let name = identifier(options.name.as_deref().unwrap_or(given));
    let findings = Findings {
        name: &name,
        title: if model.name.trim().is_empty() { name.clone() } else { model.name.clone() },
        reward_set: reward_set(model.total_mass())?,
        urdf: options.urdf.clone().unwrap_or_else(|| file.to_path_buf()),
        options,
        model: &model,
        roles: &roles,
        stance: &stance,
        locked: load_options.locked_joints,
        groups: groups(&model, &roles, missing_effort),
        missing_effort,
        stiffness: round(STIFFNESS * load * options.gain_factor.unwrap_or(1.0)),
    };
    Ok(Draft { toml: text::write(&findings), notes: notes(&findings), name })
}

/// That of the known quadruped whose mass is nearest to `mass` (kg), as a ratio.
fn reward_set(mass: f64) -> Result<String, Error> {
    let library = Library::new(Vec::new());
    let mut nearest: Option<(f64, String)> = None;
    for entry in library.robots()?.into_iter().filter(|entry| entry.is_quadruped) {
        // a broken config of another robot is no reason to stop
        let Ok(robot) = library.robot(&entry.name) else {
            continue;
        };
        let options = LoadOptions { locked_joints: robot.config.locked_joints.clone(), ..LoadOptions::default() };
        let Ok(model) = load_str(&robot.urdf_text, &robot.urdf_path, &options) else {
            continue;
        };
        let distance = (model.total_mass() / mass).ln().abs();
        if nearest.as_ref().is_none_or(|(least, _)| distance < *least) {
            nearest = Some((distance, robot.config.reward_set));
        }
    }
    Ok(nearest.map(|(_, set)| set).unwrap_or_default())
}

/// Small letters, digits and underscores.
fn identifier(name: &str) -> String {
    let words = name.to_lowercase();
    let words: Vec<&str> = words.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty()).collect();
    if words.is_empty() { "robot".to_string() } else { words.join("_") }
}

/// Two significant digits: a draft knows no more.
fn round(value: f64) -> f64 {
    if value <= 0.0 || !value.is_finite() {
        return value;
    }
    let unit = 10.0_f64.powf(value.log10().floor() - 1.0);
    let rounded = (value / unit).round() * unit;
    // without the tail of the division
    format!("{rounded:.6}").parse().unwrap_or(rounded)
}

/// The effort limit of the URDF, if it has one that means something.
fn known_effort(joint: &Joint) -> Option<f64> {
    Some(joint.effort).filter(|effort| effort.is_finite() && *effort > 0.0)
}

/// The URDF's limits, joints with the same ones together.
fn groups(model: &Model, roles: &Roles, missing_effort: f64) -> Vec<Group> {
    let mut groups: Vec<Group> = Vec::new();
    for (slot, &joint) in roles.joint_of_slot.iter().enumerate() {
        let joint = &model.joints[joint];
        let effort = known_effort(joint).unwrap_or(missing_effort);
        let velocity = Some(joint.velocity).filter(|velocity| velocity.is_finite() && *velocity > 0.0);
        match groups.iter_mut().find(|group| (group.effort, group.velocity) == (effort, velocity)) {
            Some(group) => group.slots.push(slot),
            None => groups.push(Group { slots: vec![slot], effort, velocity }),
        }
    }
    groups
}

fn notes(findings: &Findings<'_>) -> Vec<String> {
    let Findings { model, roles, stance, .. } = findings;
    let mut notes: Vec<String> = model.warnings.iter().map(Warning::finding).collect();
    for (leg, miss) in LEGS.iter().zip(stance.misses) {
        if miss >= REACHED {
            notes.push(format!(
                "[default_pose]: within its joints' limits the foot of {leg} stays {:.0} mm from where it should stand; \
                 look at the limits, or write a pose of your own",
                1e3 * miss
            ));
        }
    }
    for (joint, position) in &findings.locked {
        notes.push(format!("[locked_joints]: {joint} is no leg's and is held at {position}"));
    }
    for joint in roles.joint_of_slot.map(|joint| &model.joints[joint]) {
        if known_effort(joint).is_none() {
            notes.push(format!(
                "[actuators]: the URDF has no effort limit for {}; {} N m follow from weight and leg length: write the motor's",
                joint.name, findings.missing_effort
            ));
        }
    }
    for (role, (name, torque)) in ROLES.into_iter().zip(stance.torques).enumerate() {
        let of_role = |group: &&Group| group.slots.iter().any(|slot| slot / LEGS.len() == role);
        let least = findings.groups.iter().filter(of_role).map(|group| group.effort).fold(f64::INFINITY, f64::min);
        if torque > STANDING_EFFORT * least {
            notes.push(format!(
                "[actuators]: standing takes {torque:.1} N m of the {least:.1} N m of {name}; the robot may be too heavy for its motors"
            ));
        }
    }
    notes
}
