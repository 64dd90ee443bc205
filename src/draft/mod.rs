//! A first config for a robot of which only the URDF is known: roles, a pose to stand in, gains, ranges.

mod stance;
mod text;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::config::Library;
use crate::morphology::MorphologyError;
use crate::robot::{CANONICAL_JOINT_NAMES, LEGS, LoadOptions, Model, Roles, detect, load, load_str};
use stance::{GRAVITY, REACHED, Stance};

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
    stiffness: f64,
}

/// Joints with the same limits.
struct Group {
    name: String,
    joints: Vec<String>,
    effort: f64,
    velocity: Option<f64>,
}

/// Drafts the config of the robot whose URDF is at `file`: a quadruped's roles and feet from geometry, every other joint
/// held, a standing pose with the feet level about the centre of mass, gains in proportion to weight times leg length, rewards as
/// of the known robot whose mass is nearest.
///
/// # Errors
/// Those of [`load`] and [`detect`]; a robot of `POLYPOD_PATH` that cannot be read.
pub fn draft(file: &Path, options: &DraftOptions) -> Result<Draft, MorphologyError> {
    let mut load_options = LoadOptions { package_dirs: options.package_dirs.clone(), ..LoadOptions::default() };
    let whole = load(file, &load_options)?;
    let roles = detect(&whole, &BTreeMap::new(), &BTreeMap::new())?;
    let others = whole.joints.iter().enumerate().filter(|(joint, _)| !roles.joint_of_slot.contains(joint));
    load_options.locked_joints =
        others.map(|(_, joint)| (joint.name.clone(), 0.0_f64.max(joint.lower).min(joint.upper))).collect();
    let (model, roles) = if load_options.locked_joints.is_empty() {
        (whole, roles)
    } else {
        let model = load(file, &load_options)?;
        let roles = detect(&model, &BTreeMap::new(), &BTreeMap::new())?;
        (model, roles)
    };

    let stance = Stance::find(&model, &roles);
    let load = model.total_mass() * GRAVITY * stance.leg_length;
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
        groups: groups(&model, &roles, round(EFFORT * load)),
        stiffness: round(STIFFNESS * load * options.gain_factor.unwrap_or(1.0)),
    };
    Ok(Draft { toml: text::write(&findings), notes: notes(&findings), name })
}

/// That of the known robot whose mass is nearest to `mass` (kg), as a ratio.
fn reward_set(mass: f64) -> Result<String, MorphologyError> {
    let library = Library::new(Vec::new());
    let mut nearest: Option<(f64, String)> = None;
    for entry in library.robots()? {
        let robot = library.robot(&entry.name)?;
        let package_dirs = robot.config.package_dirs.clone();
        let model =
            load_str(&robot.urdf_text, &robot.urdf_path, &LoadOptions { package_dirs, ..LoadOptions::default() })?;
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

/// The URDF's limits, joints with the same ones together.
fn groups(model: &Model, roles: &Roles, missing_effort: f64) -> Vec<Group> {
    let limits = |slot: usize| {
        let joint = &model.joints[roles.joint_of_slot[slot]];
        let effort = Some(joint.effort).filter(|effort| effort.is_finite() && *effort > 0.0).unwrap_or(missing_effort);
        (effort, Some(joint.velocity).filter(|velocity| velocity.is_finite() && *velocity > 0.0))
    };
    let slots = |group: &(f64, Option<f64>)| (0..12).filter(|&slot| limits(slot) == *group).collect::<Vec<_>>();
    let mut distinct: Vec<(f64, Option<f64>)> = Vec::new();
    for group in (0..12).map(limits) {
        if !distinct.contains(&group) {
            distinct.push(group);
        }
    }
    let named = distinct.iter().map(|group| {
        let slots = slots(group);
        let (name, joints) = pattern(&slots);
        Group { name, joints, effort: group.0, velocity: group.1 }
    });
    let mut groups: Vec<Group> = named.collect();
    // patterns of roles may meet in one name
    for index in 0..groups.len() {
        if groups[..index].iter().any(|other| other.name == groups[index].name) {
            groups[index].name = format!("{}_{index}", groups[index].name);
        }
    }
    groups
}

/// A name and patterns for these slots.
fn pattern(slots: &[usize]) -> (String, Vec<String>) {
    if slots.len() == 12 {
        return ("legs".to_string(), vec!["*".to_string()]);
    }
    let mut names = Vec::new();
    let mut patterns = Vec::new();
    for (role, (name, suffix)) in [("abductors", "HAA"), ("hips", "HFE"), ("knees", "KFE")].into_iter().enumerate() {
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

fn notes(findings: &Findings<'_>) -> Vec<String> {
    let Findings { model, roles, stance, .. } = findings;
    let mut notes: Vec<String> = model
        .warnings
        .iter()
        .map(|warning| format!("{}: {}; {}", warning.element, warning.problem, warning.remedy))
        .collect();
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
    for slot in 0..12 {
        let joint = &model.joints[roles.joint_of_slot[slot]];
        if !joint.effort.is_finite() || joint.effort <= 0.0 {
            notes.push(format!(
                "[actuators]: the URDF has no effort limit for {}; {} N m follow from weight and leg length: write the motor's",
                joint.name,
                round(EFFORT * model.total_mass() * GRAVITY * stance.leg_length)
            ));
        }
    }
    for (role, name) in ["HAA", "HFE", "KFE"].into_iter().enumerate() {
        let effort = findings
            .groups
            .iter()
            .filter(|group| group.joints.iter().any(|joint| joint == "*" || joint.ends_with(name)));
        let least = effort.map(|group| group.effort).fold(f64::INFINITY, f64::min);
        if stance.torques[role] > STANDING_EFFORT * least {
            notes.push(format!(
                "[actuators]: standing takes {:.1} N m of the {least:.1} N m of {name}; the robot may be too heavy for its motors",
                stance.torques[role]
            ));
        }
    }
    notes
}
