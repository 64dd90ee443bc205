"""No command line ends in a traceback, a panic or a hang; refusals say why."""

import os
import random
import re
import resource
import signal
import subprocess

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

import bad_lines
from common import size
from fork_server import Ended

PROGRAM = bad_lines.ROOT / "target" / "release" / "polypod-sim"
CHUNKS = 10
SINGLE = size(5, 1_000_000)
"""Lines of one bad thing in each chunk; in the extended tier all there are, about 3000."""
SEVERAL = size(2, 25)
"""Lines of several bad things, of each command."""
SECONDS = 20
MEMORY = 4 << 30


SWEEP = """
seeds = [1]
[train]
num_envs = 8
max_iterations = 1
device = "cpu"
threads = 1
set = ["sim.episode_length_s=0.2", "train.run.num_steps_per_env=2"]
[configs.plain]
[robots]
one = ["spot"]
"""


@pytest.fixture
def place(tmp_path):
    """A folder with files of several bad kinds."""
    for kind in ("", ".toml", ".pt", ".urdf"):
        (tmp_path / f"loop{kind}").symlink_to(f"loop{kind}")
    for name in ("folder", "folder.toml", "folder.gif"):
        (tmp_path / name).mkdir()
    (tmp_path / "file").write_text("")
    for name in ("binary", "manifest.json", *(f"binary.{kind}" for kind in ("pt", "toml", "py", "onnx", "urdf"))):
        (tmp_path / name).write_bytes(random.Random(0).randbytes(5000))
    for kind in ("pt", "toml", "onnx", "urdf"):
        (tmp_path / f"empty.{kind}").write_bytes(b"")
    (tmp_path / "sweep.toml").write_text(SWEEP)
    np.save(tmp_path / "heights.npy", np.zeros((3, 3)))
    return tmp_path


def of_polypod(fork_server, words, place):
    """Runs `polypod`.

    Its memory ends above `MEMORY`, so that the machine survives what is compared below.
    """
    return fork_server.run(*words, cwd=place, seconds=SECONDS, memory=MEMORY + (1 << 30))


def _limit():
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def of_the_program(fork_server, words, place):
    """Runs `polypod-sim`."""
    command = [PROGRAM, *(os.fsencode(word) for word in words)]
    options = {"encoding": "utf-8", "errors": "replace", "timeout": SECONDS, "stdin": subprocess.DEVNULL}
    try:
        done = subprocess.run(command, cwd=place, capture_output=True, preexec_fn=_limit, check=False, **options)
    except subprocess.TimeoutExpired:
        return Ended(-signal.SIGKILL, "", "", 0)
    return Ended(done.returncode, done.stdout, done.stderr, 0)


RUNS = {"polypod": (of_polypod, (0, 2, 3)), "polypod-sim": (of_the_program, (0, 1, 2))}
COMMANDS = {"polypod": bad_lines.POLYPOD, "polypod-sim": bad_lines.POLYPOD_SIM}


def complaint(fork_server, program, words, place):
    """Fault in the end of a line; None for no fault."""
    run, codes = RUNS[program]
    ended = run(fork_server, words, place)
    said = ended.output + ended.errors
    shown = [word if len(word) < 100 else f"{word[:20]}... ({len(word)})" for word in words]
    if ended.code == -signal.SIGKILL:
        return f"{shown}: took more than {SECONDS} s"
    if ended.memory > MEMORY:
        return f"{shown}: took {ended.memory >> 20} MiB"
    bad = [word for word in ("Traceback", "this is a bug", "panicked", "memory allocation") if word in said]
    if ended.code not in codes or bad:
        return f"{shown}: {ended.code} {said[-600:]}"
    # 3 is a verdict on a policy, which stands in the output
    if ended.code and not (said if ended.code == 3 else ended.errors).strip():
        return f"{shown}: {ended.code} without a word"
    return None


@pytest.mark.parametrize("chunk", range(CHUNKS))
@pytest.mark.parametrize("program", RUNS)
def test_every_flag_with_every_bad_value(fork_server, place, program, chunk):
    lines = bad_lines.single(COMMANDS[program])[chunk::CHUNKS][:SINGLE]
    complaints = [complaint(fork_server, program, line, place) for line in lines]
    assert not any(complaints), "\n".join(filter(None, complaints))


@pytest.mark.parametrize(
    ("program", "command"), [(program, command) for program, commands in COMMANDS.items() for command in commands]
)
def test_several_bad_flags_at_once(fork_server, place, program, command):
    @settings(
        max_examples=SEVERAL,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(bad_lines.several(COMMANDS[program], command))
    def check(line):
        assert (wrong := complaint(fork_server, program, line, place)) is None, wrong

    check()


_FLAG = re.compile(r"(?:^|[ ,│])(--?[A-Za-z][\w-]*)")


def flags_in(help_text):
    """The flags that the tables of a command's help begin their lines with."""
    found = set()
    for line in help_text.splitlines():
        text = line.strip("│ ")
        if text.startswith("-"):
            found |= set(_FLAG.findall(text.split("  ")[0]))
    return found | {
        flag for names in re.findall(r"\[alias(?:es)?: ([^]]*)\]", help_text) for flag in _FLAG.findall(names)
    }


def commands_in(help_text):
    """The commands of a program's help: tyro's list in braces, clap's table."""
    if braces := re.search(r"\{([\w,-]+)\}", help_text):
        return set(braces[1].split(","))
    table = help_text.partition("Commands:\n")[2].partition("\n\n")[0]
    return {line.split()[0] for line in table.splitlines()}


@pytest.mark.parametrize("program", RUNS)
def test_no_command_and_no_flag_is_left_out(fork_server, tmp_path, program):
    run, _ = RUNS[program]
    commands = COMMANDS[program]
    assert commands_in(run(fork_server, ["--help"], tmp_path).output) == {
        bad_lines.name_of(command) for command in commands
    } - {""}
    for command, flags in bad_lines.flags_of(commands):
        if command != "help":
            said = run(fork_server, [*([command] if command else []), "--help"], tmp_path).output
            assert flags_in(said) == flags, command


ENDS = {
    "polypod": ("Unrecognized options", "unexpected argument", "given more than once"),
    "polypod-sim": ("cannot be used multiple times", "unexpected argument"),
}
"""Messages of parsers about a line whose bad value has not taken the place of a good one."""


@pytest.mark.parametrize("program", RUNS)
def test_bad_values_take_the_place_of_good_ones(fork_server, place, program):
    """A value that is appended ends at the parser and tests nothing behind it."""
    run, _ = RUNS[program]
    for command, (base, flags) in COMMANDS[program].items():
        for flag in flags:
            if flag in ("", "--help", "-h", bad_lines.UNKNOWN):
                continue
            line = bad_lines._line(command, base, flag, "x")
            assert line.count(flag) == 1, line
        if any(isinstance(word, bad_lines.Positional) for word in base):
            line = bad_lines._line(command, base, "", "nothing.urdf")
            assert len(line) == len(base) + 1, line
            said = run(fork_server, line, place)
            assert not any(end in said.errors for end in ENDS[program]), (line, said.errors)


def test_the_lines_are_as_many_as_are_promised():
    single = sum(len(bad_lines.single(commands)) for commands in COMMANDS.values())
    assert single > 2000
