"""Ctrl-C is a KeyboardInterrupt everywhere, and ends a command with exit code 130."""

import os
import signal
import subprocess
import sys

import pytest

from common import FLAT_POLICY, ROBOT_FOLDER, size

DELAYS = size((0.02,), (0.001, 0.005, 0.02, 0.05))
"""Between the beginning of a call and the signal, s."""
CONSTRUCTION = """
import signal, sys, time
import polypod
from polypod import _core

def stop(*_):
    raise KeyboardInterrupt

calls = {
    "make": lambda: polypod.make("velocity_rough", num_envs=64),
    "simulation": lambda: polypod.Simulation("anymal_c", num_envs=20_000),
    "terrain": lambda: _core.terrain("velocity_rough"),
    "draft": lambda: _core.draft_robot(sys.argv[3]),
}
signal.signal(signal.SIGALRM, stop)
signal.setitimer(signal.ITIMER_REAL, float(sys.argv[2]))
try:
    calls[sys.argv[1]]()
    # a signal that came after the last line of Rust is raised here
    time.sleep(1.0)
except KeyboardInterrupt:
    print("interrupted")
# and the module is as good as before
print(polypod.Simulation("spot", num_envs=2).qpos.shape)
"""


@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("call", ["make", "simulation", "terrain", "draft"])
def test_an_interrupt_during_construction_is_no_panic(call, delay):
    """Runs in a fresh interpreter without arrays.

    The crate `numpy` loads NumPy with the first array.
    """
    urdf = str(ROBOT_FOLDER / "anymal_c" / "robot.urdf")
    command = [sys.executable, "-c", CONSTRUCTION, call, str(delay), urdf]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["interrupted", "(2, 19)"]
    assert "panic" not in done.stderr


COMMAND = """
import os, signal, sys
from polypod.__main__ import main

signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
signal.setitimer(signal.ITIMER_REAL, float(sys.argv.pop(1)))
code = main()
# a signal that has not come by now does not come: Python gives SIGALRM its default back as it ends
signal.setitimer(signal.ITIMER_REAL, 0.0)
sys.exit(code)
"""
COMMANDS = {
    "export": ("--checkpoint", str(FLAT_POLICY), "--out", "out", "--robots", "spot"),
    "terrain": ("--task", "velocity_rough", "--out", "map.npz"),
    "sim2sim": ("--checkpoint", str(FLAT_POLICY), "--num-envs", "8", "--robots", "spot"),
    "robustness": ("--checkpoint", str(FLAT_POLICY), "--robots", "spot", "--conditions", "nominal"),
    "eval": ("--checkpoint", str(FLAT_POLICY)),
    "play": ("--checkpoint", str(FLAT_POLICY), "--headless"),
    "robot": ("new", str(ROBOT_FOLDER / "anymal_c" / "robot.urdf"), "--out", "drafted.toml"),
    "train": ("--num-envs", "64", "--max-iterations", "1000", "--logger", "none"),
}


@pytest.mark.parametrize("seconds", size((0.3,), (0.1, 0.5, 1.0, 2.0, 4.0)))
@pytest.mark.parametrize("command", size(("export", "terrain", "robot"), tuple(COMMANDS)))
def test_an_interrupted_command_says_so(tmp_path, command, seconds):
    """Whether it still imports, builds, or is at work: 130, and no traceback."""
    for attempt in range(8):
        folder = tmp_path / str(attempt)  # a command that was done has written its files
        folder.mkdir()
        line = [sys.executable, "-c", COMMAND, str(seconds), command, *COMMANDS[command]]
        done = subprocess.run(line, capture_output=True, text=True, timeout=300, check=False, cwd=folder)
        if done.returncode not in {0, 3}:
            break
        seconds /= 2.0  # the command was done before the signal: a fast machine
    assert done.returncode == 130, (done.returncode, done.stderr)
    assert "Traceback" not in done.stderr
    assert "panic" not in done.stderr
    if command != "train":
        assert done.stderr.splitlines()[-1] == "polypod: interrupted"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_ended_as_it_starts_leaves_nothing(tmp_path, number):
    """Python's default: the process ends by the signal."""
    script = COMMAND.replace("signal.SIGINT", f"signal.{number.name}")
    line = [sys.executable, "-c", script, "0.3", "terrain", *COMMANDS["terrain"]]
    done = subprocess.run(line, capture_output=True, text=True, timeout=100, check=False, cwd=tmp_path)
    assert done.returncode == -number
    assert not done.stderr
    assert not list(tmp_path.iterdir())


def test_an_error_that_a_library_makes_of_an_interrupt_is_none(capsys, monkeypatch):
    """Torch and others catch what is raised within their import."""
    import polypod.cli
    from polypod import interrupts

    def wait_for_the_interrupt():
        os.kill(os.getpid(), signal.SIGINT)
        signal.pause()

    def fail(command):
        with pytest.raises(KeyboardInterrupt):
            wait_for_the_interrupt()
        raise ImportError("initialization failed")

    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        interrupts.watch()
        monkeypatch.setattr(polypod.cli, "_run", fail)
        assert polypod.cli.main(["list"]) == 130
        assert capsys.readouterr().err == "polypod: interrupted\n"
        interrupts.watch()
        assert not interrupts.happened()
    finally:
        signal.signal(signal.SIGINT, previous)
        interrupts.watch()
