"""No command line, however bad, ends in a traceback, a panic or a hang. Who is refused is told why."""

import itertools
import os
import random
import resource
import signal
import subprocess
from pathlib import Path

import pytest

from common import FLAT_POLICY, size

ROOT = Path(__file__).parents[2]
PROGRAM = ROOT / "target" / "release" / "polypod-sim"
URDF = ROOT / "assets" / "robots" / "spot" / "spot.urdf"

LINES = size(150, 1500)
"""Command lines of each of the two programs."""
CHUNKS = 10
SECONDS = 20
MEMORY = 4 << 30

COUNTS = ["-1", "0", "1.5", "", "x", "nan", "-9223372036854775809", "18446744073709551616", "9" * 40, "0x10", "\u0661"]
FLOATS = ["nan", "inf", "-inf", "-1", "", "x", "1e999", "-1e-320", "1,5", "\u0663"]
NAMES = ["", " ", ",", "spott", "spot,", "spot,spot", "..", "/", "/dev/null", "/dev/zero", "/dev/zero.toml", "a" * 5000]
NAMES += ["\u202e", "\udcff", "spot\n", "-", "--", "robots/spot", "~", "$HOME", "`true`", "%s%n", "nul.toml", "."]
FILES = ["", ".", "/", "/dev/null", "/dev/full", "/proc/self/mem", "/nothing/here", "a" * 5000, "loop", "binary"]
FILES += ["manifest.json", "empty.pt", "binary.pt", "\udcff", "../../../../etc/passwd", "folder"]
OUTPUTS = ["", ".", "/", "/proc/nothing", "/nothing/\x01/here", "loop", "folder", "a" * 5000, "file/below"]
OVERRIDES = ["", "=", "a", "sim.dt", "sim.dt=", "sim.dt=nan", "sim.dt=-1", "sim.dt=0", "sim.dt=1e-320", "sim.dt=[]"]
OVERRIDES += ["sim.dt=1=1", ".=1", "sim..dt=1", "sim.gravity=[nan,0,0]", "sim.gravity=[0,0]", "sim.decimation=0"]
OVERRIDES += ["sim.decimation=1000000000", "sim.decimation=-1", "[=1", "sim.dt='", "a.b.c.d=" + "[" * 5000, "sim=3"]
OVERRIDES += [
    "sim.episode_length_s=0",
    "sim.episode_length_s=1e300",
    "commands.base_velocity.ranges.lin_vel_x=[1e30,-1e30]",
]
OVERRIDES += ["observations.policy=[]", "rewards=1", "scene.terrain.num_rows=1000000", "=" * 5000, "sim.dt=\udcff"]

CHECKPOINT = ("--checkpoint", str(FLAT_POLICY))
COMMON = {"--robots": NAMES, "--set": OVERRIDES, "--seed": COUNTS[:-3]}
WITH_TASK = COMMON | {"--task": NAMES, "--threads": COUNTS}
COMMANDS: dict[str, tuple[tuple[str, ...], dict[str, list[str]]]] = {
    "eval": (
        (*CHECKPOINT, "--num-envs", "8", "--steps", "1"),
        WITH_TASK
        | {"--checkpoint": FILES, "--num-envs": COUNTS, "--episodes": COUNTS, "--steps": COUNTS, "--grid": COUNTS}
        | {"--json": OUTPUTS, "--plot": OUTPUTS},
    ),
    "export": (
        (*CHECKPOINT, "--formats", "onnx", "--out", "out"),
        {"--checkpoint": FILES, "--out": OUTPUTS, "--robots": NAMES, "--formats": NAMES},
    ),
    "play": (
        (*CHECKPOINT, "--headless", "--seconds", "0.1"),
        WITH_TASK
        | {"--checkpoint": FILES, "--num-envs": COUNTS, "--seconds": FLOATS, "--warm-up": FLOATS, "--fps": COUNTS}
        | {
            "--port": [*COUNTS, "99999"],
            "--record": OUTPUTS,
            "--video": OUTPUTS,
            "--command": FLOATS,
            "--size": COUNTS,
        },
    ),
    "sim2sim": (
        (*CHECKPOINT, "--num-envs", "1", "--steps", "1", "--robots", "spot"),
        COMMON
        | {"--checkpoint": FILES, "--num-envs": COUNTS, "--steps": COUNTS, "--dt": FLOATS, "--friction": FLOATS}
        | {"--json": OUTPUTS, "--command": FLOATS, "--integrator": NAMES},
    ),
    "train": (
        ("--num-envs", "64", "--max-iterations", "1", "--logger", "none", "--robots", "spot"),
        WITH_TASK
        | {"--num-envs": COUNTS, "--max-iterations": COUNTS, "--train-config": [*NAMES, *FILES], "--resume": FILES}
        | {"--init": FILES, "--run-name": NAMES, "--log-dir": OUTPUTS, "--device": NAMES, "--logger": NAMES},
    ),
    "check": ((str(URDF),), {"": FILES, "--package-dir": ["", "=", "a", "a=", "=b", "a=/dev/zero"]}),
    "robot": (
        ("new", str(URDF), "--out", "/nothing/spot.toml"),
        {"--name": NAMES, "--out": OUTPUTS, "--package-dir": ["", "a"]},
    ),
    "terrain": (
        ("--out", "map.npz", "--task", "velocity_flat"),
        {"--out": OUTPUTS, "--task": NAMES, "--set": OVERRIDES},
    ),
    "results": (("folder",), {"--out": FILES, "--media": OUTPUTS, "--score": FLOATS, "--baseline": NAMES}),
    "accuracy": (("--robots", "nobody"), {"--robots": ["", ",", "x"], "--out": FILES, "--readme": FILES}),
    "bench": (
        ("--robot", "nobody"),
        {"--num-envs": COUNTS[:7], "--threads": COUNTS[:7], "--step-threads": COUNTS[:7], "--robot": NAMES},
    ),
    "list": ((), {"--x": NAMES, "": NAMES}),
    "info": ((), {"--x": NAMES, "": NAMES}),
    "": ((), {"": NAMES, "--version": NAMES, "-h": [""]}),
}
SIM_COMMANDS: dict[str, tuple[tuple[str, ...], dict[str, list[str]]]] = {
    "rollout": (
        ("--task", "velocity_flat", "--num-envs", "8", "--steps", "1"),
        WITH_TASK | {"--num-envs": COUNTS, "--actions": NAMES, "--engine": NAMES, "--dump-dir": OUTPUTS},
    ),
    "inspect": (("--robot", "spot"), {"--robot": NAMES}),
    "check": ((str(URDF),), {"": FILES, "--package-dir": ["", "=", "a", "a="]}),
    "replay": (("manifest.json",), {"": [*FILES, "/dev/zero"], "--simd": NAMES}),
    "play": (
        ("--policy", str(FLAT_POLICY.parent / "exported" / "policy.onnx"), "--num-envs", "8", "--steps", "1"),
        WITH_TASK | {"--policy": FILES, "--num-envs": COUNTS, "--steps": COUNTS[:7], "--command": FLOATS},
    ),
    "soak": (("--minutes", "0"), {"--minutes": ["0", "-1", "nan", "x"], "--dt": FLOATS, "--robots": NAMES}),
    "list": ((), {"--x": NAMES, "": NAMES}),
}


def lines(commands, seed):
    """Bad command lines, every flag with every value before one comes twice; some have two bad flags."""
    draw = random.Random(seed)
    single = [
        (command, (*base, *_flag(flag, value)))
        for command, (base, flags) in commands.items()
        for flag, values in flags.items()
        for value in values
    ]
    draw.shuffle(single)
    yield from single
    while True:
        command = draw.choice(list(commands))
        base, flags = commands[command]
        pairs = [_flag(flag, draw.choice(flags[flag])) for flag in draw.choices(list(flags), k=2)]
        yield command, (*base, *itertools.chain(*pairs))


def _flag(flag, value):
    if not flag:
        return (value,)
    count = {"--grid": 3, "--command": 3, "--size": 2}.get(flag, 1)
    return (flag, *[value] * count)


@pytest.fixture
def place(tmp_path):
    """A folder with files of several bad kinds."""
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    for name in ("binary", "binary.pt", "manifest.json"):
        (tmp_path / name).write_bytes(random.Random(0).randbytes(5000))
    (tmp_path / "empty.pt").write_bytes(b"")
    return tmp_path


class TooLongError(Exception):
    """A command took more than `SECONDS`."""


def _alarm(number, frame):
    raise TooLongError


def chunk_of(commands, chunk):
    return itertools.islice(lines(commands, 0), chunk * LINES // CHUNKS, (chunk + 1) * LINES // CHUNKS)


@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_polypod(cli, place, chunk):
    bad = []
    previous = signal.signal(signal.SIGALRM, _alarm)
    try:
        for command, arguments in chunk_of(COMMANDS, chunk):
            words = (*([command] if command else []), *arguments)
            signal.alarm(SECONDS)
            try:
                done = cli(*words, cwd=place)
            except TooLongError:
                bad.append(f"{words}: took more than {SECONDS} s")
                continue
            except BaseException as error:  # PanicException is no Exception
                bad.append(f"{words}: {type(error).__name__}: {error}")
                continue
            finally:
                signal.alarm(0)
            said = done.stdout + done.stderr
            if done.returncode not in (0, 2, 3) or "Traceback" in said or "bug" in said or "panicked" in said:
                bad.append(f"{words}: {done.returncode} {said[-600:]}")
            elif done.returncode == 2 and not done.stderr.strip():
                bad.append(f"{words}: no word")
    finally:
        signal.signal(signal.SIGALRM, previous)
    assert not bad, "\n".join(bad)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 < MEMORY


def _limit():
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_polypod_sim(place, chunk):
    bad = []
    for command, arguments in chunk_of(SIM_COMMANDS, chunk):
        words = [os.fsencode(word) for word in (command, *arguments)]
        try:
            done = subprocess.run(
                [PROGRAM, *words], cwd=place, capture_output=True, timeout=SECONDS, preexec_fn=_limit, check=False
            )
        except subprocess.TimeoutExpired:
            bad.append(f"{words}: took more than {SECONDS} s")
            continue
        said = done.stdout + done.stderr
        if done.returncode not in (0, 1, 2) or b"panicked" in said or b"memory allocation" in said:
            bad.append(f"{words}: {done.returncode} {said[-600:]!r}")
        elif done.returncode and not done.stderr.strip():
            bad.append(f"{words}: no word")
    assert not bad, "\n".join(bad)
