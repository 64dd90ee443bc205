//! The command line of `polypod-sim`.

mod check;
mod inspect;
mod play;
mod replay;
mod rollout;
mod soak;

use std::io::Write;

use clap::{Parser, Subcommand};
use polypod::Error;
use polypod::config::Library;

/// Headless simulator of many different legged robots.
///
/// Exit codes: 0 success, 2 bad input, 1 any other failure, such as a replay with other bits.
#[derive(Parser)]
#[command(version, about, long_about = None)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Steps a task with random or zero actions and reports speed and statistics per robot.
    Rollout(rollout::Rollout),
    /// Lets an exported policy (`polypod export`) walk and reports its tracking errors.
    Play(play::Play),
    /// Prints a robot's articulation: links, joints, roles, actuators, contact bodies.
    Inspect(inspect::Inspect),
    /// Prints how a URDF file is read, with every warning; it needs no config.
    Check(check::Check),
    /// Steps a dumped broken state again and says whether it breaks with the same bits.
    Replay(replay::Replay),
    /// Steps robots for hours under random targets and fails when anything breaks.
    Soak(soak::Soak),
    /// Lists tasks and robots.
    List,
}

impl Cli {
    /// Runs the command.
    ///
    /// # Errors
    /// Bad input, as [`Error`] or [`PolicyError`](crate::policy::PolicyError); any other failure.
    pub fn run(self) -> anyhow::Result<()> {
        match self.command {
            Command::Rollout(rollout) => rollout.run(),
            Command::Play(play) => play.run(),
            Command::Inspect(inspect) => inspect.run(),
            Command::Check(check) => check.run(),
            Command::Replay(replay) => replay.run(),
            Command::Soak(soak) => soak.run(),
            Command::List => list(),
        }
    }
}

fn list() -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    let library = Library::new(Vec::new());
    writeln!(out, "robots")?;
    for robot in library.robots().map_err(Error::from)? {
        writeln!(out, "  {:<14} {}", robot.name, robot.title)?;
    }
    writeln!(out, "tasks")?;
    for task in library.tasks().map_err(Error::from)? {
        writeln!(out, "  {:<44} {}", task.name, task.aliases.join(", "))?;
    }
    for error in library.broken().map_err(Error::from)? {
        eprintln!("warning: {error}");
    }
    Ok(())
}
