"""The guard of the speed: a count that differs by more than its bound is a complaint."""

import importlib.util
import json
import subprocess
import sys

import pytest

from common import ROOT

SPEC = importlib.util.spec_from_file_location("instructions", ROOT / "tools" / "instructions.py")
instructions = importlib.util.module_from_spec(SPEC)
sys.modules["instructions"] = instructions
SPEC.loader.exec_module(instructions)
STORED = json.loads(instructions.STORED.read_text())


def test_every_main_task_has_a_count():
    assert STORED.keys() == instructions.TASKS.keys()
    assert min(STORED.values()) > 100_000


@pytest.mark.parametrize(("change", "words"), [(1.021, "find what costs them"), (0.979, "keep the gain")])
def test_a_count_beyond_the_bound_is_a_complaint(change, words):
    task = "velocity_rough"
    complaints = instructions.compare({**STORED, task: round(STORED[task] * change)}, STORED)
    assert len(complaints) == 1
    assert complaints[0].startswith(task)
    assert words in complaints[0]


def test_counts_within_the_bound_pass():
    for change in (0.981, 1.0, 1.019):
        assert not instructions.compare({task: round(count * change) for task, count in STORED.items()}, STORED)


def test_a_task_without_a_count_is_a_complaint():
    assert "--write" in instructions.compare({"new": 1}, STORED)[0]


def test_the_start_of_a_run_does_not_count():
    few, many = instructions.STEPS
    assert instructions.per_step([1000 + 7 * few, 1000 + 7 * many]) == 7


def test_one_line_says_that_valgrind_is_missing(tmp_path):
    command = [sys.executable, str(ROOT / "tools" / "instructions.py")]
    run = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert len(run.stderr.splitlines()) == 1
    assert "apt-get install valgrind" in run.stderr
