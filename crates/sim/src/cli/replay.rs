//! `polypod-sim replay`

use std::io::Write;
use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use polypod::Error;
use polypod::dump::{Dump, Replay as Replayed};
use polypod::dynamics::lanes::Simd;
use polypod::engine::{Motion, Quantity, Violation};

/// Arguments of `replay`.
#[derive(Args)]
pub(super) struct Replay {
    /// The dump, `broken_*.polypod`.
    file: PathBuf,
    /// Instruction set: avx512, avx2, neon or portable; by default the fastest one, or the value of
    /// POLYPOD_SIMD.
    #[arg(long)]
    simd: Option<String>,
    /// Print the state after every physics step too.
    #[arg(long)]
    steps_print: bool,
}

impl Replay {
    /// Fails when the state does not break again with the same bits.
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        let dump = Dump::read(&self.file)?;
        let replayed = dump.replay(self.simd.as_deref().map(instruction_set).transpose()?)?;
        let state = &dump.state;
        writeln!(
            out,
            "{}, env {}, control step {} of the simulation, {} of its episode; seed {}, polypod {}, {}",
            dump.robot, state.env.0, state.step, state.episode_step, dump.seed, dump.version, dump.simd
        )?;
        match state.after.violation(&state.limits) {
            Some(violation) => writeln!(out, "broken: {}", describe(&violation, &replayed))?,
            None => writeln!(out, "nothing of the dumped state is broken")?,
        }
        if let Some(violation) = state.before.violation(&state.limits) {
            writeln!(out, "broken before the control step already: {}", describe(&violation, &replayed))?;
        }
        writeln!(out, "\nbefore the control step")?;
        print(&mut out, &state.before, &replayed, Some(&dump))?;
        writeln!(out, "\nstepped again on {}", replayed.simd.name())?;
        for (i, step) in replayed.steps.iter().enumerate() {
            let finding = step.violation(&state.limits);
            let finding = finding.map_or_else(|| "within the limits".into(), |v| describe(&v, &replayed));
            writeln!(out, "physics step {} of {}: {finding}", i + 1, replayed.steps.len())?;
            if self.steps_print {
                print(&mut out, step, &replayed, None)?;
            }
        }
        if let Some((step, _)) = &replayed.broken {
            writeln!(out, "\nthe state broke in physics step {}", step + 1)?;
        }
        match (replayed.same_bits, replayed.broken.is_some()) {
            (true, true) => writeln!(out, "the same bits came out")?,
            (false, true) => bail!("the state breaks again, but other bits came out"),
            (_, false) => bail!("the state does not break again"),
        }
        Ok(())
    }
}

fn instruction_set(name: &str) -> Result<Simd, Error> {
    let available = Simd::available();
    available.iter().copied().find(|simd| simd.name() == name.to_lowercase()).ok_or_else(|| {
        let names: Vec<&str> = available.iter().map(|simd| simd.name()).collect();
        Error::Argument {
            element: "--simd",
            problem: format!("`{name}` is not available here"),
            remedy: format!("use one of {}", names.join(", ")),
        }
    })
}

/// Describes a violation: number, joint or axis, and value.
fn describe(violation: &Violation, replayed: &Replayed) -> String {
    let Violation { quantity, index, value, limit } = *violation;
    let axis = |names: &[&'static str]| names.get(index).copied().unwrap_or("?");
    let joint = || {
        let model = &replayed.morphology.model;
        match (model.joints.get(index), model.links.get(index + 1)) {
            (Some(joint), Some(link)) => format!("joint {} (it moves link {})", joint.name, link.name),
            _ => format!("joint {index}"),
        }
    };
    let (of, unit) = match quantity {
        Quantity::BasePosition => (format!("position {} of the base", axis(&["x", "y", "z"])), "m"),
        Quantity::BaseRotation => (format!("quaternion element {} of the base", axis(&["w", "x", "y", "z"])), ""),
        Quantity::BaseLinearVelocity => (format!("linear velocity {} of the base", axis(&["x", "y", "z"])), "m/s"),
        Quantity::BaseAngularVelocity => (format!("angular velocity {} of the base", axis(&["x", "y", "z"])), "rad/s"),
        Quantity::JointPosition => (format!("position of {}", joint()), "rad"),
        Quantity::JointVelocity => (format!("velocity of {}", joint()), "rad/s"),
        Quantity::JointEffort => (format!("effort of {}", joint()), "N m"),
    };
    format!("{of} is {value} {unit} (limit {limit})")
}

/// Prints the robot's numbers; with a dump its actuators' inputs, too.
fn print(out: &mut impl Write, motion: &Motion, replayed: &Replayed, dump: Option<&Dump>) -> std::io::Result<()> {
    // numbers that ran away would spoil the columns
    let number = |x: &f32| if x.abs() < 1e5 || !x.is_finite() { format!("{x:>12.6}") } else { format!("{x:>12.5e}") };
    let row = |numbers: &[f32]| numbers.iter().map(number).collect::<Vec<_>>().join(" ");
    writeln!(out, "  base position (m)                {}", row(&motion.pose.position))?;
    writeln!(out, "  base quaternion (w, x, y, z)     {}", row(&motion.pose.rotation))?;
    writeln!(out, "  base linear velocity (m/s)       {}", row(&motion.velocity.linear))?;
    writeln!(out, "  base angular velocity (rad/s)    {}", row(&motion.velocity.angular))?;
    write!(out, "  {:<24} {:>12} {:>12} {:>12}", "joint", "rad", "rad/s", "N m")?;
    writeln!(out, "{}", if dump.is_some() { "  target (rad)  delay (physics steps)" } else { "" })?;
    for (j, joint) in replayed.morphology.model.joints.iter().enumerate() {
        let numbers = [motion.joints.position[j], motion.joints.velocity[j], motion.effort.applied[j]];
        write!(out, "  {:<24} {}", joint.name, row(&numbers))?;
        if let Some(state) = dump.map(|dump| &dump.state) {
            write!(out, "  {:>12.6} {:>22}", state.targets.history[0][j], state.delay.0[j])?;
        }
        writeln!(out)?;
    }
    Ok(())
}
