//! Bounds of a simulation's inputs: beyond them lie mistakes alone.

use std::fmt;

/// Largest number of envs of a simulation: 2^24. A pack, an env and a row keep their numbers in 32
/// bits, and 2^24 envs of the smallest robots take tens of gigabytes.
pub const MAX_ENVS: usize = 1 << 24;
/// Largest number of threads of a simulation: more than any machine has cores. Each takes about 2
/// MB.
pub const MAX_THREADS: usize = 1024;
/// Largest number of physics steps of one call: four months of simulated time at 5 ms.
pub const MAX_STEPS: usize = (1 << 31) - 1;
/// Largest magnitude of an action. Policies act within about 10; rewards square differences of
/// actions in single precision.
pub const MAX_ACTION: f32 = 1e6;
/// Largest magnitude of a command, m/s or rad/s.
pub const MAX_COMMAND: f64 = 1e3;
/// Largest component of a push, m/s: pushes of trainings are about 1, and one of 100 is a
/// collision.
pub const MAX_PUSH: f32 = 100.0;
/// Largest magnitude of any number of a config, in its unit. Beyond it products of two leave single
/// precision.
pub const LARGEST: f64 = 1e9;
/// Longest physics step, s; usual are 0.001 to 0.02.
pub const MAX_DT: f64 = 1.0;
/// Largest component of gravity, m/s^2: four times Jupiter's.
pub const MAX_GRAVITY: f64 = 100.0;
/// Shortest physics step, s: far below what contacts need, far above where single precision loses
/// the change of a position.
pub const MIN_DT: f64 = 1e-6;
/// Largest number of physics steps of a control step; usual are 1 to 20.
pub const MAX_DECIMATION: u32 = 1000;
/// Longest delay of a joint's target, physics steps; usual are 0 to 10. Every env stores that many
/// targets.
pub const MAX_DELAY: u32 = 1000;
/// Largest number of values that the caller of a simulation computes for one observation term.
pub const MAX_EXTERNAL: u32 = 4096;
/// Largest number of control steps that an observation term remembers; usual are 1 to 20.
pub const MAX_HISTORY: u32 = 100;
/// Largest number of materials from which a robot's is sampled; 64 is usual.
pub const MAX_BUCKETS: u32 = 1_000_000;
/// Largest number of sweeps of the articulated engine's solver; contacts no longer change after
/// some hundred.
pub const MAX_SWEEPS: u32 = 10_000;
/// Largest number of substeps of Avian's engine; usual are 1 to 20.
pub const MAX_SUBSTEPS: u32 = 1000;

/// Bytes that an env of a task takes: 4 to 12 KiB, by robots and task.
pub(crate) const BYTES_PER_ENV: usize = 8 << 10;
/// Bytes that a link takes in an env without a task.
pub(crate) const BYTES_PER_LINK: usize = 256;

/// Checks a number of threads; the error holds problem and remedy.
pub(crate) fn check_threads(threads: Option<usize>) -> Result<(), (String, String)> {
    match threads {
        Some(threads) if !(1..=MAX_THREADS).contains(&threads) => {
            let remedy = format!("ask for 1 to {MAX_THREADS}, or leave it out for all cores");
            Err((format!("{threads} threads"), remedy))
        }
        _ => Ok(()),
    }
}

/// A number as messages show it: with a power of ten where digits would fill the line.
#[derive(Clone, Copy)]
pub(crate) struct Shown(pub(crate) f64);

impl fmt::Display for Shown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(x) = self;
        if *x == 0.0 || !x.is_finite() || (1e-4..1e6).contains(&x.abs()) {
            write!(f, "{x}")
        } else {
            write!(f, "{x:e}")
        }
    }
}

/// The same text with its long decimal numbers as [`Shown`]: serde and Rust write 1e308 with 309
/// digits.
pub(crate) fn with_short_numbers(text: String) -> String {
    /// Digits of the longest whole number of 64 bits.
    const LONGEST: usize = 20;
    let is_part = |c: char| c.is_ascii_digit() || c == '.';
    if !text.split(|c| !is_part(c)).any(|run| run.len() > LONGEST) {
        return text;
    }
    let mut short = String::with_capacity(text.len());
    let mut rest = text.as_str();
    while let Some(start) = rest.find(is_part) {
        let (before, from) = rest.split_at(start);
        let (run, after) = from.split_at(from.find(|c| !is_part(c)).unwrap_or(from.len()));
        short.push_str(before);
        // digits within a name stay
        let is_number = !before.ends_with(|c: char| c.is_alphanumeric() || matches!(c, '_' | '/'));
        match run.parse() {
            Ok(number) if is_number && run.len() > LONGEST => short.push_str(&Shown(number).to_string()),
            _ => short.push_str(run),
        }
        rest = after;
    }
    short + rest
}

/// Checks a number of envs of about `bytes_per_env` bytes; the error holds problem and remedy.
///
/// One request for the whole memory comes before the many small pieces, whose failure would end the
/// process.
pub(crate) fn check_num_envs(num_envs: usize, bytes_per_env: usize) -> Result<(), (String, String)> {
    if num_envs > MAX_ENVS {
        return Err((format!("{num_envs} envs"), format!("ask for at most {MAX_ENVS}")));
    }
    let bytes = num_envs.saturating_mul(bytes_per_env);
    Vec::<u8>::new().try_reserve_exact(bytes).map_err(|_| {
        let problem = format!("{num_envs} envs take about {} MiB, which this machine does not have", bytes >> 20);
        (problem, "ask for fewer envs".into())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_shown_short() {
        for (x, text) in [(1e308, "1e308"), (-1e39, "-1e39"), (1e-320, "1e-320"), (0.25, "0.25"), (-1.0, "-1")] {
            assert_eq!(Shown(x).to_string(), text);
            assert_eq!(
                with_short_numbers(format!("found `{x}`, not {x}; write 0.5")),
                format!("found `{text}`, not {text}; write 0.5")
            );
        }
        for text in ["robots/12345678901234567890123.toml", "18446744073709551615 envs", "1.2.3", ""] {
            assert_eq!(with_short_numbers(text.to_owned()), text);
        }
    }
}
