//! The promises that `polypod-sim` has a part in: a file each, in one executable.

use std::process::Command;

#[allow(dead_code, reason = "shared with the promises of the library, which use the rest")]
#[path = "../common/mod.rs"]
mod common;

mod a_broken_state_is_dumped_once_and_replays;
mod bad_input_is_refused_clearly;
mod check_describes_any_urdf;
mod hostile_files;
mod instruction_set_does_not_change_bits;
mod jammed_links_win_no_energy;
mod policies_run_without_python;

/// The folder of the project.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

/// The command line program.
fn polypod_sim(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_polypod-sim"));
    command.args(arguments);
    command
}
