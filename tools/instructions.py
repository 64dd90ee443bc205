"""Counts the instructions of a control step and compares them with stored counts.

Usage:
    tools/instructions.py                compare; exit code 1 if a count differs by more than 2 %
    tools/instructions.py --write        store the counts of this build in tools/instructions.json
    tools/instructions.py --program P    count another build of polypod-sim

A count does not depend on how busy the machine is, so it shows a slowdown that timings hide.
Valgrind runs `polypod-sim rollout` twice per task, on one thread and with AVX2 (valgrind has no
AVX-512). The difference of the two runs is the cost of the control steps without the start. A count
says nothing about caches, branches and latency. Needs valgrind, and the standard library alone.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STORED = ROOT / "tools" / "instructions.json"
PROGRAM = ROOT / "target" / "release" / "polypod-sim"
BOUND = 0.02
"""Largest difference from the stored count."""
STEPS = (2, 22)
"""Control steps of the two runs. No episode ends in them, so resets are not counted."""
ENVS_PER_ROBOT = 64
TASKS = {
    "velocity_flat": ("unitree_a1",),
    "velocity_rough": ("unitree_a1",),
    "velocity_flat_legged": ("unitree_a1", "bolt", "phantomx"),
}
"""The main tasks, with robots that start within seconds under valgrind."""


class CountError(Exception):
    """A count is impossible: the message says why and names the remedy."""


@dataclass(frozen=True)
class Run:
    """One run of the program."""

    program: Path
    task: str
    steps: int

    def count(self) -> int:
        """Returns the instructions of the whole run."""
        robots = TASKS[self.task]
        command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", str(self.program), "rollout"]
        command += ["--task", self.task, "--robots", ",".join(robots), "--threads", "1"]
        command += ["--num-envs", str(ENVS_PER_ROBOT * len(robots)), "--steps", str(self.steps)]
        env = os.environ | {"POLYPOD_SIMD": "avx2"}
        run = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        found = re.search(r"Collected : (\d+)", run.stderr)
        if run.returncode or not found:
            raise CountError(f"`{' '.join(command)}` failed: {run.stderr.strip()[-400:]}")
        return int(found[1])


def per_step(counts: list[int]) -> int:
    """Returns the instructions of one control step from those of the two runs."""
    (few, many), (first, second) = STEPS, counts
    return (second - first) // (many - few)


def compare(counts: dict[str, int], stored: dict[str, int]) -> list[str]:
    """Returns a complaint for each task whose count is not the stored one."""
    complaints = []
    for task, count in counts.items():
        if task not in stored:
            complaints.append(f"{task}: no count is stored; run tools/instructions.py --write")
            continue
        change = count / stored[task] - 1
        if abs(change) > BOUND:
            remedy = "find what costs them" if change > 0 else "keep the gain"
            complaints.append(
                f"{task}: {count:,} instructions per control step, {change:+.1%} from {stored[task]:,};"
                f" {remedy}, or store the new count: tools/instructions.py --write"
            )
    return complaints


def main(arguments: list[str] | None = None) -> int:
    """Compares or stores the counts, and returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--write", action="store_true", help=f"store the counts in {STORED.relative_to(ROOT)}")
    parser.add_argument("--program", type=Path, default=PROGRAM, help="a build of polypod-sim")
    asked = parser.parse_args(arguments)
    try:
        if shutil.which("valgrind") is None:
            raise CountError("valgrind is not installed; install it (apt-get install valgrind), on Linux x86-64")
        if not asked.program.is_file():
            raise CountError(f"{asked.program} does not exist; run make build")
        runs = [Run(asked.program, task, steps) for task in TASKS for steps in STEPS]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = list(pool.map(Run.count, runs))
        counts = {task: per_step(found[2 * i :][:2]) for i, task in enumerate(TASKS)}
        stored = json.loads(STORED.read_text()) if STORED.exists() else {}
    except (CountError, json.JSONDecodeError) as error:
        print(f"instructions: {error}", file=sys.stderr)
        return 2
    for task, count in counts.items():
        change = f"{count / stored[task] - 1:+.2%}" if task in stored else "new"
        print(f"{task:24}{count:>14,} instructions per control step  {change}")
    if asked.write:
        STORED.write_text(json.dumps(counts, indent=2) + "\n")
        return 0
    complaints = compare(counts, stored)
    for complaint in complaints:
        print(f"instructions: {complaint}", file=sys.stderr)
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
