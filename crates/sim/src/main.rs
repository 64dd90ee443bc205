//! `polypod-sim`: the simulator without Python.

use std::io::ErrorKind::BrokenPipe;
use std::process::ExitCode;

use clap::Parser;
use polypod_sim::cli::Cli;
use polypod_sim::policy::PolicyError;

fn main() -> ExitCode {
    tracing_subscriber::fmt()
        .with_env_filter(
            tracing_subscriber::EnvFilter::try_from_default_env()
                .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn")),
        )
        .with_writer(std::io::stderr)
        .without_time()
        .init();
    match Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        // the reader of the output has closed it
        Err(error) if error.downcast_ref().is_some_and(|e: &std::io::Error| e.kind() == BrokenPipe) => {
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error:#}");
            // an input that polypod refuses is bad input; anything else is a fault of the machine
            // or of the program
            ExitCode::from(if is_bad_input(&error) { 2 } else { 1 })
        }
    }
}

fn is_bad_input(error: &anyhow::Error) -> bool {
    error.is::<PolicyError>() || error.is::<polypod::Error>() || error.is::<polypod::config::ConfigError>()
}
