//! Errors about a robot description: element, problem and remedy.

use std::fmt;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::bounds::with_short_numbers;

/// One finding about a robot description, displayed as `{file}: {element}: {problem}; {remedy}`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Diagnosis {
    /// The URDF file.
    pub file: PathBuf,
    /// The element at fault, e.g. `joint "hip"`.
    pub element: String,
    /// Problem of the element.
    pub problem: String,
    /// Remedy.
    pub remedy: String,
    /// Topic of the error.
    pub topic: Topic,
}

/// Topic of an error, where callers handle it separately.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Topic {
    /// Anything else.
    #[default]
    Other,
    /// A mesh is taken as a convex hull.
    Hull {
        /// Distance by which the mesh reaches beyond the hull, um.
        outside: u64,
    },
    /// A collision mesh is left out.
    MissingMesh,
    /// A joint that mimics another is held.
    Coupled,
}

impl Diagnosis {
    pub(super) fn new(
        file: &Path,
        element: impl Into<String>,
        problem: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Self {
            file: file.to_path_buf(),
            element: element.into(),
            problem: with_short_numbers(problem.into()),
            remedy: remedy.into(),
            topic: Topic::Other,
        }
    }

    pub(super) fn about(self, topic: Topic) -> Self {
        Self { topic, ..self }
    }

    /// The diagnosis without the file: `{element}: {problem}; {remedy}`.
    pub fn finding(&self) -> String {
        format!("{}: {}; {}", self.element, self.problem, self.remedy)
    }
}

impl fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.file.display(), self.finding())
    }
}

/// Assumption about the description that its author should know of.
pub type Warning = Diagnosis;

/// Reason why a URDF did not become a [`Model`](super::Model), or a model no quadruped.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum RobotError {
    /// The file cannot be read.
    #[error("{0}")]
    Read(Diagnosis),
    /// The text is not well-formed XML or not a URDF document.
    #[error("{0}")]
    Syntax(Diagnosis),
    /// An attribute or element is missing, repeated or holds a value that means nothing.
    #[error("{0}")]
    Value(Diagnosis),
    /// Links and joints do not form one tree.
    #[error("{0}")]
    Structure(Diagnosis),
    /// The description is valid, but asks for something the simulator does not model.
    #[error("{0}")]
    Unsupported(Diagnosis),
    /// A body that moves has no mass, or an inertia no rigid body can have.
    #[error("{0}")]
    Inertia(Diagnosis),
    /// A [`LoadOptions`](super::LoadOptions) entry or a role override does not fit the robot.
    #[error("{0}")]
    Options(Diagnosis),
    /// The URDF parser refused, changed or lost something that the checks let pass.
    #[error("{0}")]
    Parser(Diagnosis),
    /// Legs, joint roles or feet cannot be told apart.
    #[error("{0}")]
    Roles(Diagnosis),
}

impl RobotError {
    /// File, element, problem and remedy.
    pub fn diagnosis(&self) -> &Diagnosis {
        match self {
            Self::Read(d)
            | Self::Syntax(d)
            | Self::Value(d)
            | Self::Structure(d)
            | Self::Unsupported(d)
            | Self::Inertia(d)
            | Self::Options(d)
            | Self::Parser(d)
            | Self::Roles(d) => d,
        }
    }
}

/// The warnings with one in place of all meshes that are taken as hulls, and one in place of all
/// that are left out: [`check`](super::check) lists them.
pub fn summed_up(warnings: &[Warning]) -> Vec<Warning> {
    let is_missing = |warning: &Warning| warning.topic == Topic::MissingMesh;
    let outside = |warning: &Warning| match warning.topic {
        Topic::Hull { outside } => Some(outside),
        _ => None,
    };
    let hulls = warnings.iter().filter_map(outside).count();
    let missing = warnings.iter().filter(|warning| is_missing(warning)).count();
    let worst = warnings.iter().filter_map(outside).max().unwrap_or(0);
    let (mut has_hulls, mut has_missing) = (hulls < 2, missing < 2);
    let mut shown = Vec::new();
    for warning in warnings {
        let list = format!("`polypod check {}` lists them", warning.file.display());
        if hulls > 1 && outside(warning).is_some() {
            if !std::mem::replace(&mut has_hulls, true) {
                let problem = format!(
                    "{hulls} meshes are taken as convex hulls, which they leave by up to {:.1} mm",
                    1e-3 * worst as f64
                );
                shown.push(Warning::new(&warning.file, "collision meshes", problem, list));
            }
        } else if missing > 1 && is_missing(warning) {
            if !std::mem::replace(&mut has_missing, true) {
                let problem =
                    format!("{missing} meshes are left out; the first: {}: {}", warning.element, warning.problem);
                let remedy = format!("{}; {list}", warning.remedy);
                shown.push(Warning::new(&warning.file, "collision meshes", problem, remedy).about(Topic::MissingMesh));
            }
        } else {
            shown.push(warning.clone());
        }
    }
    shown
}

/// Remedy that locks a joint, for each way to load a robot.
pub(super) const LOCK: &str = "lock the joint in locked_joints (--lock JOINT=POSITION of check and robot new)";

/// Longest name that is compared with others, bytes: the comparison takes time that grows with its
/// square.
const COMPARED: usize = 256;
/// Number of names that an error lists.
const LISTED: usize = 24;

/// `did you mean "x"`, or the known names when none is close.
pub(super) fn nearest_name<'a>(wanted: &str, known: impl IntoIterator<Item = &'a str> + Clone) -> String {
    let closest = known
        .clone()
        .into_iter()
        .filter(|name| wanted.len().max(name.len()) <= COMPARED)
        .map(|name| (strsim::jaro_winkler(wanted, name), name))
        .max_by(|a, b| a.0.total_cmp(&b.0));
    match closest {
        Some((similarity, name)) if similarity > 0.8 => format!("did you mean \"{name}\"?"),
        _ => match listed(known) {
            names if names.is_empty() => "there are none to name".to_string(),
            names => format!("known are: {names}"),
        },
    }
}

/// The first names, and the number of the others.
pub(super) fn listed<'a>(names: impl IntoIterator<Item = &'a str>) -> String {
    let mut names = names.into_iter();
    let mut shown: Vec<String> = names.by_ref().take(LISTED).map(str::to_owned).collect();
    match names.count() {
        0 => {}
        more => shown.push(format!("and {more} more")),
    }
    shown.join(", ")
}
