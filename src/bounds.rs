//! Bounds of what a simulation takes: beyond them lies nothing but a mistake.

/// Most envs of a simulation: 2^24. A pack, an env and a row keep their numbers in 32 bits, and 2^24 envs of the smallest robots take
/// tens of gigabytes.
pub const MAX_ENVS: usize = 1 << 24;
/// Most threads of a simulation: more than any machine has cores. Each takes about 2 MB.
pub const MAX_THREADS: usize = 1024;
/// Most physics steps of one call: four months of simulated time at 5 ms.
pub const MAX_STEPS: usize = (1 << 31) - 1;
/// Largest magnitude of an action. Policies act within about 10; rewards square differences of actions in single precision.
pub const MAX_ACTION: f32 = 1e6;
/// Largest magnitude of a command, m/s or rad/s.
pub const MAX_COMMAND: f64 = 1e3;
/// Largest component of a push, m/s: pushes of trainings are about 1, and one of 100 is no push any more.
pub const MAX_PUSH: f32 = 100.0;
/// Shortest physics step, s: far below what contacts need, far above where single precision loses the change of a position.
pub const MIN_DT: f64 = 1e-6;
/// Most physics steps of a control step; usual are 1 to 20.
pub const MAX_DECIMATION: u32 = 1000;
/// Longest delay of a joint's target, physics steps; usual are 0 to 10. Every env keeps as many targets.
pub const MAX_DELAY: u32 = 1000;
/// Most control steps that an observation term remembers; usual are 1 to 20.
pub const MAX_HISTORY: u32 = 100;
/// Most sweeps of the articulated engine's solver; contacts no longer change after some hundred.
pub const MAX_SWEEPS: u32 = 10_000;
/// Most substeps of Avian's engine; usual are 1 to 20.
pub const MAX_SUBSTEPS: u32 = 1000;

/// Bytes that an env of a task takes: 4 to 12 KiB, by robots and task.
pub(crate) const BYTES_PER_ENV: usize = 8 << 10;
/// Bytes that a link takes in an env without a task.
pub(crate) const BYTES_PER_LINK: usize = 256;

/// Whether there may be so many threads: problem and remedy if not.
pub(crate) fn check_threads(threads: Option<usize>) -> Result<(), (String, String)> {
    match threads {
        Some(threads) if !(1..=MAX_THREADS).contains(&threads) => {
            let remedy = format!("ask for 1 to {MAX_THREADS}, or leave it out for all cores");
            Err((format!("{threads} threads"), remedy))
        }
        _ => Ok(()),
    }
}

/// Whether there may be `num_envs` envs of about `bytes_per_env` bytes: problem and remedy if not.
///
/// The allocator is asked for the whole once, ahead of the many small pieces, whose failure would end the process.
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
