"""Command lines drawn at random end in order, and what they take steps on with finite numbers.

The lists of `bad_lines` hold what somebody thought of. Here keys of resolved configs, flags, types
and magnitudes are drawn: `POLYPOD_TEST_SEED=7 make test TIER=extended` draws others. A complaint
names the draw, which `random_input.line(program, index)` makes again.
"""

import random

import numpy as np
import pytest

import random_input
from common import size

LINES = {"polypod": size(6, 1000), "polypod-sim": size(40, 1000)}
CHUNKS = size(1, 20)
CODES = {"polypod": (0, 2, 3), "polypod-sim": (0, 1, 2)}
"""3: `sim2sim` or `robustness` found falls; 1: `replay` found other bits."""
SECONDS = 60
MEMORY = 6 << 30


@pytest.fixture
def place(tmp_path):
    """A folder with files of several bad kinds, which some lines name."""
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    for name in ("binary", "binary.pt", "manifest.json"):
        (tmp_path / name).write_bytes(random.Random(0).randbytes(5000))
    (tmp_path / "empty.pt").write_bytes(b"")
    np.save(tmp_path / "heights.npy", np.zeros((3, 3)))
    return tmp_path


def complaint(fork_server, program, index, place):
    """Fault in the end of a line, or in its config's simulation; None for no fault."""
    words = random_input.line(program, index)
    shown = f"line {index} of {program} ({' '.join(words)[:600]!r})"
    if program == "polypod":
        ended = fork_server.run(*words, cwd=place, seconds=SECONDS, memory=MEMORY)
        code, said = ended.code, ended.output + ended.errors
    else:
        code, said = random_input.run_program(words, place, SECONDS, MEMORY)
    if wrong := random_input.complaint_of(code, said, SECONDS, CODES[program]):
        return f"{shown}: {wrong}"
    config = random_input.config_of(words) if code == 0 else None
    if config is None or not config["overrides"]:
        return None
    stepped = fork_server.call("random_input:steps_finitely", cwd=place, seconds=SECONDS, memory=MEMORY, **config)
    return None if stepped.code in (0, 2) else f"{shown}: accepted, then exit {stepped.code}: {stepped.errors[-600:]}"


@pytest.mark.parametrize("chunk", range(CHUNKS))
@pytest.mark.parametrize("program", LINES)
def test_lines_drawn_at_random(fork_server, place, program, chunk):
    complaints = [complaint(fork_server, program, index, place) for index in range(chunk, LINES[program], CHUNKS)]
    assert not any(complaints), "\n".join(filter(None, complaints))


def test_the_lines_are_of_every_command_and_some_are_taken(fork_server, place):
    """Else nothing would be tested: lines that all end at the parser reach no reader."""
    drawn = [random_input.line(program, index) for program in LINES for index in range(120)]
    assert len({words[0] for words in drawn if words and words[0].isalpha()}) > 12
    configs = [config for words in drawn if (config := random_input.config_of(words)) and config["overrides"]]
    assert len(configs) > 60
    taken = [
        fork_server.call("random_input:steps_finitely", cwd=place, seconds=SECONDS, **config).code == 0
        for config in configs[: size(20, 60)]
    ]
    assert 0.1 < sum(taken) / len(taken) < 0.9


@pytest.mark.parametrize(
    "override", ["rewards.spot.joint_pos.weight=1e5", "observations.policy.base_lin_vel.scale=2.0"]
)
def test_finite_configs_pass(fork_server, tmp_path, override):
    options = {"task": "velocity_flat", "robots": ["spot"], "overrides": [override]}
    assert fork_server.call("random_input:steps_finitely", cwd=tmp_path, **options).code == 0


def test_numbers_that_are_not_finite_are_seen(fork_server, tmp_path):
    """The check itself: a state that breaks in every env shows in what `steps_finitely` returns."""
    ended = fork_server.call("random_input:reports_nan", cwd=tmp_path)
    assert ended.code == 4
    assert "reward of 2 of 4 envs is not finite after 3 steps" in ended.errors


@pytest.mark.parametrize(
    ("code", "said", "wrong"),
    [
        (0, "", None),
        (2, "error: no", None),
        (2, "", "without a word"),
        (-9, "", "took more"),
        (-6, "memory allocation of 9 bytes failed", "memory allocation"),
        (1, "x", "exit 1"),
        (2, "thread panicked", "panicked"),
    ],
)
def test_complaints(code, said, wrong):
    found = random_input.complaint_of(code, said, 60, (0, 2))
    assert found is None if wrong is None else wrong in found
