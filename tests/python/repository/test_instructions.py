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


def changed(task, kind, change):
    """Returns the stored counts with one of them multiplied."""
    return {**STORED, task: {**STORED[task], kind: round(STORED[task][kind] * change)}}


def test_every_main_task_has_all_counts():
    assert STORED.keys() == instructions.TASKS.keys()
    for counts in STORED.values():
        assert counts.keys() == instructions.KINDS.keys()
        assert min(counts.values()) > 100_000


@pytest.mark.parametrize("kind", instructions.KINDS)
@pytest.mark.parametrize(("change", "words"), [(1.011, "find what costs them"), (0.989, "keep the gain")])
def test_a_count_beyond_the_bound_is_a_complaint(kind, change, words):
    task = "velocity_rough"
    complaints = instructions.compare(changed(task, kind, change), STORED)
    assert len(complaints) == 1
    assert complaints[0].startswith(task)
    assert kind in complaints[0]
    assert words in complaints[0]


@pytest.mark.parametrize("kind", instructions.KINDS)
def test_counts_within_the_bound_pass(kind):
    for change in (0.991, 1.0, 1.009):
        assert not instructions.compare(changed("velocity_flat", kind, change), STORED)


def test_a_task_without_a_count_is_a_complaint():
    complaints = instructions.compare({"new": dict.fromkeys(instructions.KINDS, 1)}, STORED)
    assert len(complaints) == len(instructions.KINDS)
    assert all("--write" in complaint for complaint in complaints)


def test_the_start_of_a_run_does_not_count():
    few, many = instructions.STEPS
    runs = [dict.fromkeys(instructions.KINDS, 1000 + 7 * steps) for steps in (few, many)]
    assert instructions.per_step(runs) == dict.fromkeys(instructions.KINDS, 7)


def test_counts_are_read_by_the_names_of_their_events():
    summary = "==7== Events    : Ir Dr Dw I1mr\n==7== Collected : 44 13 7 2\n"
    assert instructions.read_counts(summary) == {"instructions": 44, "loads": 13, "stores": 7}
    assert instructions.read_counts("valgrind: no such program") is None


def test_one_line_says_that_valgrind_is_missing(tmp_path):
    command = [sys.executable, str(ROOT / "tools" / "instructions.py")]
    run = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert len(run.stderr.splitlines()) == 1
    assert "apt-get install valgrind" in run.stderr
