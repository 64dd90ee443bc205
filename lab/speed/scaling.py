"""The figures of `polypod bench`, and those of other robots, resets and actions, with a plot."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from polypod import _core
from polypod.bench.report import Options, Progress, row, step_rate
from polypod.bench.report import measure as measure_bench
from polypod.bench.report import table as table_of_bench
from polypod.drawing import pyplot_for, save


def measure(options: Options, progress: Progress) -> dict[str, Any]:
    """Runs all benchmarks.

    Raises ConfigError without MuJoCo, UnknownNameError for an unknown robot.
    """
    result = measure_bench(options, progress)
    names = _core.task_robots("velocity_flat")
    result["scaling_robots"] = {}
    for count in (1, 2, 4, 8):
        progress(f"{count} different robots")
        result["scaling_robots"][count] = step_rate(options, robots=names[:count])
    progress("each robot alone; robots that fall again and again")
    result["by_robot"] = {name: step_rate(options, robots=[name]) for name in names}
    result["reset_heavy"] = {"env_steps_per_s": step_rate(options, overrides=["sim.episode_length_s=0.1"])}
    result["random_actions"] = {"env_steps_per_s": step_rate(options, scale=1.0)}
    return result


def table(result: Mapping[str, Any]) -> str:
    """The figures as Markdown."""
    lines = [
        row("flat, episodes of 0.1 s", result["reset_heavy"]["env_steps_per_s"]),
        row("flat, actions of deviation 1", result["random_actions"]["env_steps_per_s"]),
        *(row(f"{count} different robots", rate) for count, rate in result["scaling_robots"].items()),
        *(row(name, rate) for name, rate in result["by_robot"].items()),
    ]
    return "\n".join([table_of_bench(result), *lines])


def picture(result: Mapping[str, Any], out: Path) -> None:
    """Plots the physics next to MuJoCo's, and the scaling.

    Raises ConfigError without matplotlib, or where it cannot be written.
    """
    pyplot = pyplot_for("--plot")
    figure, (rates, *axes) = pyplot.subplots(1, 4, figsize=(17, 4), layout="constrained")
    p = result["physics"]
    bars = {"polypod": p["env_steps_per_s"], "mujoco.rollout": p["mujoco_steps_per_s"]}
    if p["mujoco_batch_steps_per_s"] is not None:
        bars["mujoco.batch"] = p["mujoco_batch_steps_per_s"]
    rates.bar(list(bars), list(bars.values()))
    threads = result["threads"]
    rates.set(xlabel=f"physics of {result['robot']}, threads: {threads}", ylabel="env-physics-steps/s", yscale="log")
    for axis, (key, label) in zip(
        axes,
        (("scaling_num_envs", "envs"), ("scaling_threads", "threads"), ("scaling_robots", "different robots")),
        strict=True,
    ):
        values = result[key]
        axis.plot([int(x) for x in values], list(values.values()), marker="o")
        axis.set(xlabel=label, ylabel="env-steps/s", ylim=(0, None))
        axis.set_xscale("log", base=2)
        axis.grid(alpha=0.3)
    figure.suptitle(f"polypod {result['polypod']}, {result['cpu']}, {result['simd']}")
    save(figure, out, "--plot")
    pyplot.close(figure)
