//! What went wrong with a robot description, where, and what to do about it.

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
    /// What is wrong with it.
    pub problem: String,
    /// What the reader can do about it.
    pub remedy: String,
}

impl Diagnosis {
    pub(super) fn new(
        file: &Path,
        element: impl Into<String>,
        problem: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        let problem = with_short_numbers(problem.into());
        Self { file: file.to_path_buf(), element: element.into(), problem, remedy: remedy.into() }
    }

    /// All but the file: `{element}: {problem}; {remedy}`.
    pub fn finding(&self) -> String {
        format!("{}: {}; {}", self.element, self.problem, self.remedy)
    }
}

impl fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.file.display(), self.finding())
    }
}

/// Something in the description that was read with an assumption the reader should know of.
pub type Warning = Diagnosis;

/// Why a URDF did not become a [`Model`](super::Model), or a model no quadruped.
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

/// `did you mean "x"`, or the known names when none is close.
pub(super) fn nearest_name<'a>(wanted: &str, known: impl IntoIterator<Item = &'a str> + Clone) -> String {
    let closest = known
        .clone()
        .into_iter()
        .map(|name| (strsim::jaro_winkler(wanted, name), name))
        .max_by(|a, b| a.0.total_cmp(&b.0));
    match closest {
        Some((similarity, name)) if similarity > 0.8 => format!("did you mean \"{name}\"?"),
        Some(_) => {
            let names: Vec<&str> = known.into_iter().collect();
            format!("known are: {}", names.join(", "))
        }
        None => "there are none to name".to_string(),
    }
}
