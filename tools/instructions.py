"""Counts what a control step executes, loads and stores, and compares with stored counts.

Usage:
    tools/instructions.py                compare; exit code 1 if a count differs by more than 1 %
    tools/instructions.py --write        store the counts of this build in tools/instructions.json
    tools/instructions.py --program P    count another build of polypod-sim

A count does not depend on how busy the machine is, so it shows a slowdown that timings hide.
Valgrind runs `polypod-sim rollout` twice per task, on one thread and with AVX2 (valgrind has no
AVX-512). The difference of the two runs is the cost of the control steps without the start. Loads
and stores are counted in pieces of at most eight bytes, so they show spilled registers and memory
that is set to zero, which are few instructions. Two counts of one build differ by 0.2 %. A count
says nothing about caches, branches, latency and the code for AVX-512. Needs valgrind, and the
standard library alone.
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
BOUND = 0.01
"""Largest difference from the stored count."""
KINDS = {"instructions": "Ir", "loads": "Dr", "stores": "Dw"}
"""Kinds of counts, each with the column of valgrind's events."""
STEPS = (2, 22)
"""Control steps of the two runs. No episode ends in them, so resets are not counted."""
ENVS_PER_ROBOT = 64
TASKS = {
    "velocity_flat": ("unitree_a1",),
    "velocity_rough": ("unitree_a1",),
    "velocity_flat_legged": ("unitree_a1", "bolt", "phantomx"),
}
"""The main tasks, with robots that start within seconds under valgrind."""


Counts = dict[str, int]
"""Counts by their kind, see [`KINDS`]."""


class CountError(Exception):
    """A count is impossible: the message says why and names the remedy."""


@dataclass(frozen=True)
class Run:
    """One run of the program."""

    program: Path
    task: str
    steps: int

    def count(self) -> Counts:
        """Returns the counts of the whole run."""
        robots = TASKS[self.task]
        command = ["valgrind", "--tool=callgrind", "--cache-sim=yes", "--callgrind-out-file=/dev/null"]
        command += [str(self.program), "rollout"]
        command += ["--task", self.task, "--robots", ",".join(robots), "--threads", "1"]
        command += ["--num-envs", str(ENVS_PER_ROBOT * len(robots)), "--steps", str(self.steps)]
        env = os.environ | {"POLYPOD_SIMD": "avx2"}
        run = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        counts = read_counts(run.stderr)
        if run.returncode or counts is None:
            raise CountError(f"`{' '.join(command)}` failed: {run.stderr.strip()[-400:]}")
        return counts


def read_counts(text: str) -> Counts | None:
    """Returns the counts in valgrind's summary, if there is one."""
    events, collected = (re.search(rf"{title} *: (.*)", text) for title in ("Events", "Collected"))
    if not events or not collected:
        return None
    by_event = dict(zip(events[1].split(), map(int, collected[1].split()), strict=True))
    return {kind: by_event[event] for kind, event in KINDS.items()}


def per_step(counts: list[Counts]) -> Counts:
    """Returns the counts of one control step from those of the two runs."""
    (few, many), (first, second) = STEPS, counts
    return {kind: (second[kind] - first[kind]) // (many - few) for kind in KINDS}


def compare(counts: dict[str, Counts], stored: dict[str, Counts]) -> list[str]:
    """Returns a complaint for each count of a task that is not the stored one."""
    complaints = []
    for task, of_task in counts.items():
        for kind, count in of_task.items():
            before = stored.get(task, {}).get(kind)
            if before is None:
                complaints.append(f"{task}: no count of {kind} is stored; run tools/instructions.py --write")
                continue
            change = count / before - 1
            if abs(change) > BOUND:
                remedy = "find what costs them" if change > 0 else "keep the gain"
                complaints.append(
                    f"{task}: {count:,} {kind} per control step, {change:+.1%} from {before:,};"
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
    for task, of_task in counts.items():
        for kind, count in of_task.items():
            before = stored.get(task, {}).get(kind)
            change = f"{count / before - 1:+.2%}" if before else "new"
            print(f"{task:24}{count:>14,} {kind:12} per control step  {change}")
    if asked.write:
        STORED.write_text(json.dumps(counts, indent=2) + "\n")
        return 0
    complaints = compare(counts, stored)
    for complaint in complaints:
        print(f"instructions: {complaint}", file=sys.stderr)
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
