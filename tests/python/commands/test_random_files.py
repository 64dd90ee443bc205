"""Randomly changed files are taken or refused in order; taken ones stay finite.

Robots, meshes, configs, manifests, checkpoints, graphs, dumps and snapshots: `random_files.KINDS`.
Another `POLYPOD_TEST_SEED` draws others. A complaint names the draw; `random_files.case(kind,
index, folder)` writes it again.
"""

import shutil

import pytest

import random_files
import random_input
from common import size

SHARE = size(0.02, 1.0)
"""How many of a kind's files are drawn, of the thousand that all kinds have."""
CODES = {"polypod": (0, 2, 3), "polypod-sim": (0, 1, 2)}
"""3: `sim2sim` or `robustness` found falls; 1: `replay` found other bits."""
SECONDS = 60
MEMORY = 6 << 30


def complaints(fork_server, kind, index, folder):
    """Faults in the ends of a draw's commands, or in the results of what they accept."""
    case = random_files.case(kind, index, folder)
    limits = {"cwd": folder, "seconds": SECONDS, "memory": MEMORY}
    codes = []
    for program, words in case.commands:
        if program == "polypod":
            ended = fork_server.run(*words, **limits)
            code, said = ended.code, ended.output + ended.errors
        else:
            code, said = random_input.run_program(tuple(words), folder, SECONDS, MEMORY)
        codes.append(code)
        if wrong := random_input.complaint_of(code, said, SECONDS, CODES[program]):
            yield f"{program} {' '.join(words)}: {wrong}"
    calls = []
    if case.task and codes[0] == 0:
        calls.append(("random_input:steps_finitely", case.task, (0, 2)))
    if case.urdf and codes[-1] == 0:
        calls.append(("random_input:steps_a_urdf", {"path": case.urdf}, (0, 2)))
    if case.call:
        calls.append(("random_files:reads_snapshots", case.call, (0,)))
    for function, arguments, allowed in calls:
        ended = fork_server.call(function, **limits, **arguments)
        if ended.code not in allowed:
            yield f"{function}({arguments}): exit {ended.code}: {(ended.output + ended.errors)[-800:]}"
    if (folder / "PWNED").exists():
        yield "the file was executed"


@pytest.mark.parametrize("kind", random_files.KINDS)
def test_files_drawn_at_random(fork_server, tmp_path, kind):
    wrong = []
    for index in range(max(1, int(SHARE * random_files.KINDS[kind][1]))):
        folder = tmp_path / str(index)
        folder.mkdir()
        wrong += [f"{kind} {index}: {what}" for what in complaints(fork_server, kind, index, folder)]
        shutil.rmtree(folder, ignore_errors=True)
    assert not wrong, "\n".join(wrong)


def test_a_thousand_files_are_drawn_of_all_kinds():
    assert sum(count for _, count in random_files.KINDS.values()) >= 1000


@pytest.mark.parametrize("kind", ["urdf", "robot config", "task config", "graph", "checkpoint", "manifest"])
def test_a_draw_is_the_same_again(tmp_path, kind):
    """So that a finding can be made again, and two draws differ."""
    written = []
    for name, index in (("a", 0), ("b", 0), ("c", 1)):
        folder = tmp_path / name
        folder.mkdir()
        random_files.case(kind, index, folder)
        written.append({path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()})
    assert written[0] == written[1]
    assert written[0] != written[2]
