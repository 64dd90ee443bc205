//! `polypod-sim check`

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use polypod::Error;
use polypod::robot::{LoadOptions, check};

/// Arguments of `check`.
#[derive(Args)]
pub(super) struct Check {
    /// The URDF file.
    file: PathBuf,
    /// Folder of a ROS package in `package://` names; may be given several times.
    #[arg(long = "package-dir", value_name = "NAME=DIR", value_parser = package_dir)]
    package_dirs: Vec<(String, PathBuf)>,
    /// Holds a joint at a position, rad or m; may be given several times.
    #[arg(long = "lock", value_name = "JOINT=POSITION", value_parser = lock, allow_hyphen_values = true)]
    locks: Vec<(String, f64)>,
}

fn package_dir(text: &str) -> Result<(String, PathBuf), String> {
    match text.split_once('=') {
        Some((name, folder)) if !name.is_empty() && !folder.is_empty() => Ok((name.to_string(), folder.into())),
        _ => Err("write NAME=DIR".to_string()),
    }
}

fn lock(text: &str) -> Result<(String, f64), String> {
    let lock = text.rsplit_once('=').and_then(|(joint, position)| Some((joint.to_string(), position.parse().ok()?)));
    lock.filter(|(joint, _)| !joint.is_empty()).ok_or_else(|| "write JOINT=POSITION, in rad or m".to_string())
}

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let options = LoadOptions {
            package_dirs: self.package_dirs.into_iter().collect(),
            locked_joints: self.locks.into_iter().collect(),
            ..LoadOptions::default()
        };
        let text = check(&self.file, &options).map_err(Error::from)?;
        std::io::stdout().lock().write_all(text.as_bytes())?;
        Ok(())
    }
}
