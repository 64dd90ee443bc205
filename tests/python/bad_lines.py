"""Bad command lines of both programs: every flag with every bad value, and several at once."""

import random
import string
from collections.abc import Iterator

from hypothesis import strategies as st

from common import FLAT_POLICY, ROOT

GRAPH = FLAT_POLICY.parent / "exported" / "policy.onnx"
URDF = ROOT / "assets" / "robots" / "spot" / "robot.urdf"

Line = tuple[str, ...]
Commands = dict[str, tuple[Line, dict[str, list[str | None]]]]
"""By command: a line of arguments that is in order, and the bad values of each flag.

A bad value takes the place of what the line has for its flag: appended, it would end at the parser,
as a flag that is given twice or an argument too many. The flag "" stands for positional arguments,
the value None for a flag without a value. A command's name may be followed by a word that tells
several lines of it apart.
"""


class Positional(str):
    """A positional argument that bad values take the place of."""

    __slots__ = ()


UNKNOWN = "--x"
"""A flag that no command has."""

COUNTS = ["-1", "0", "1.5", "", "x", "nan", "-9223372036854775809", "18446744073709551616", "9" * 40, "0x10"]
COUNTS += ["\u0661", "2147483648", "9223372036854775807"]
FLOATS = ["nan", "inf", "-inf", "-1", "", "x", "1e999", "-1e-320", "1,5", "\u0663", "1e30"]
NAMES = ["", " ", ",", "spott", "spot,", "spot,spot", "..", "/", "/dev/null", "/dev/zero", "/dev/zero.toml", "a" * 5000]
NAMES += ["\u202e", "\udcff", "spot\n", "-", "--", "robots/spot", "~", "$HOME", "`true`", "%s%n", "nul.toml", "."]
FILES = ["", ".", "/", "/dev/null", "/dev/full", "/proc/self/mem", "/nothing/here", "a" * 5000, "loop", "binary"]
FILES += ["manifest.json", "empty.pt", "binary.pt", "\udcff", "../../../../etc/passwd", "folder"]
FILES += ["binary.toml", "empty.toml", "folder.toml", "binary.py", "binary.onnx", "empty.onnx", "loop.toml", "loop.pt"]
FILES += ["binary.urdf", "empty.urdf", "loop.urdf", "nothing.urdf"]
OUTPUTS = ["", ".", "/", "/proc/nothing", "/nothing/\x01/here", "loop", "folder", "a" * 5000, "file/below"]
OVERRIDES = ["", "=", "a", "sim.dt", "sim.dt=", "sim.dt=nan", "sim.dt=-1", "sim.dt=0", "sim.dt=1e-320", "sim.dt=[]"]
OVERRIDES += ["sim.dt=1=1", ".=1", "sim..dt=1", "sim.gravity=[nan,0,0]", "sim.gravity=[0,0]", "sim.decimation=0"]
OVERRIDES += ["sim.decimation=1000000000", "sim.decimation=-1", "[=1", "sim.dt='", "a.b.c.d=" + "[" * 5000, "sim=3"]
OVERRIDES += ["sim.episode_length_s=0", "sim.episode_length_s=1e300", "observations.policy=[]", "rewards=1"]
OVERRIDES += ["commands.base_velocity.ranges.lin_vel_x=[1e30,-1e30]", "scene.terrain.num_rows=1000000", "=" * 5000]
OVERRIDES += [
    "sim.dt=\udcff",
    "train.",
    "train.algorithm",
    "train.algorithm.gamma=nan",
    "train.run.num_envs=x",
    "train=3",
]
FILMS = [
    "/nothing/x.gif",
    "file/below.gif",
    "loop/x.webp",
    "folder.gif",
    ".gif",
    "x.mov",
    "a" * 5000 + ".gif",
    "\udcff.gif",
]
"""Names of films that cannot be written."""
PAGES = ["/nothing/x.html", "file/below.viser", "loop/x.html", "a" * 5000 + ".html"]
"""Names of recordings that cannot be written."""
SWITCH = [None, "x", ""]
"""Words after a flag without a value: nothing, or words that do not belong to it."""

_CHECKPOINT = ("--checkpoint", str(FLAT_POLICY))
_ONE_CONDITION = (*_CHECKPOINT, "--robots", "spot", "--conditions", "nominal")
_SEEDS = COUNTS[:9]
_COMMON = {"--robots": NAMES, "--set": OVERRIDES, "--seed": _SEEDS}
_WITH_TASK = _COMMON | {"--task": NAMES, "--threads": COUNTS}
_PACKAGES = ["", "=", "a", "a=", "=b", "a=/dev/zero"]
_LOCKS = [*_PACKAGES, "fl_hx=x", "fl_hx=nan", "fl_hx=1e999", "fl_hx=100", "nothing=0", "=0"]

_POLYPOD: dict[str, tuple[Line, dict[str, list[str]]]] = {
    "eval": (
        (*_CHECKPOINT, "--num-envs", "8", "--steps", "1"),
        _WITH_TASK
        | {"--checkpoint": FILES, "--num-envs": COUNTS, "--episodes": COUNTS, "--steps": COUNTS, "--grid": COUNTS}
        | {"--json": OUTPUTS, "--plot": OUTPUTS, "--quadrupeds": NAMES, "--commands": NAMES}
        | {"--terms": FILES},
    ),
    "compare": (
        (Positional(FLAT_POLICY), Positional("flat"), "--robots", "spot", "--num-envs", "2", "--steps", "1"),
        _WITH_TASK
        | {"": FILES, "--num-seeds": COUNTS, "--num-envs": COUNTS, "--episodes": COUNTS, "--steps": COUNTS}
        | {"--json": OUTPUTS, "--commands": NAMES},
    ),
    "export": (
        (*_CHECKPOINT, "--formats", "onnx", "--out", "out"),
        {"--checkpoint": FILES, "--out": OUTPUTS, "--robots": NAMES, "--robot": NAMES, "--formats": NAMES},
    ),
    "deploy": (
        ("check", Positional(GRAPH), "--num-envs", "1", "--steps", "1", "--simulators", "polypod"),
        {"": [*NAMES, *FILES], "--checkpoint": FILES, "--num-envs": COUNTS, "--steps": COUNTS, "--json": OUTPUTS}
        | {"--simulators": [*NAMES, "polypod,x", "mujoco,"], "--robot": NAMES, "--set": OVERRIDES, "--seed": _SEEDS},
    ),
    "deploy write": (
        ("write", Positional(GRAPH), "--out", "out"),
        {"": FILES, "--out": OUTPUTS, "--steps": COUNTS},
    ),
    "play": (
        (*_CHECKPOINT, "--headless", "--seconds", "0.1"),
        _WITH_TASK
        | {"--checkpoint": FILES, "--num-envs": COUNTS, "--seconds": FLOATS, "--warm-up": FLOATS}
        | {"--command": FLOATS, "--robot": NAMES, "--terms": FILES},
    ),
    "play page": (
        (*_CHECKPOINT, "--robots", "spot", "--seconds", "0.1", "--port", "0"),
        {"--record": [*OUTPUTS, *PAGES], "--meshes": SWITCH}
        | {"--port": [*COUNTS, "99999"], "--host": ["", "x y", "256.1.1.1", "nowhere.invalid", "-", "\udcff"]},
    ),
    "play film": (
        (*_CHECKPOINT, "--robots", "spot", "--seconds", "0.1", "--video", "film.gif", "--size", "32", "32"),
        {"--fps": COUNTS, "--size": COUNTS, "--video": [*OUTPUTS, *FILMS]},
    ),
    "film": (
        (Positional("walk"), Positional("film.gif"), *_CHECKPOINT, "--seconds", "0.1", "--warm-up", "0"),
        _WITH_TASK
        | {"": [*NAMES, "training", "mujoco", *FILMS], "--checkpoint": FILES, "--seconds": FLOATS, "--warm-up": FLOATS}
        | {"--fps": COUNTS, "--size": COUNTS, "--command": FLOATS, "--parts": COUNTS, "--push": FLOATS}
        | {"--robot": NAMES},
    ),
    "sim2sim": (
        (*_CHECKPOINT, "--num-envs", "1", "--steps", "1", "--robots", "spot"),
        _COMMON
        | {"--checkpoint": FILES, "--num-envs": COUNTS, "--steps": COUNTS, "--dt": FLOATS, "--friction": FLOATS}
        | {"--json": OUTPUTS, "--command": FLOATS, "--integrator": NAMES, "--robot": NAMES}
        | {"--commands": NAMES, "--terms": FILES},
    ),
    "sim2sim model": (
        (*_CHECKPOINT, "--num-envs", "1", "--robots", "spot", "--model", "nothing.xml"),
        _COMMON
        | {"--model": FILES, "--map": FILES, "--num-envs": COUNTS, "--dt": FLOATS, "--friction": FLOATS}
        | {"--actuators": NAMES, "--contact": NAMES, "--phases": [*NAMES, "hop=1", "turn=nan", "stop=1", "turn=1e30"]}
        | {"--phase-s": FLOATS, "--rounds": COUNTS, "--video": [*OUTPUTS, *FILMS], "--commands": [*NAMES, "task"]},
    ),
    "robustness": (
        (*_ONE_CONDITION, "--num-envs", "1", "--mujoco-envs", "1", "--steps", "1", "--threads", "1"),
        _COMMON
        | {"--checkpoint": FILES, "--num-envs": COUNTS, "--mujoco-envs": COUNTS, "--steps": COUNTS}
        | {"--conditions": [*NAMES, "frction", "nominal,x"], "--simulators": [*NAMES, "polypod,x"]}
        | {"--condims": [*COUNTS, "3,", "3,x"], "--threads": COUNTS, "--json": OUTPUTS, "--picture": OUTPUTS}
        | {"--robot": NAMES, "--model": FILES, "--map": FILES, "--actuators": NAMES, "--contact": NAMES},
    ),
    "train": (
        ("--num-envs", "64", "--max-iterations", "1", "--logger", "none", "--robots", "spot"),
        _WITH_TASK
        | {"--num-envs": COUNTS, "--max-iterations": COUNTS[:11], "--train-config": [*NAMES, *FILES]}
        | {"--init": FILES, "--run-name": NAMES, "--log-dir": OUTPUTS, "--device": NAMES, "--logger": NAMES}
        | {"--until-walks": COUNTS[:11], "--log-project": NAMES, "--workers": COUNTS, "--ray": ["nowhere:1"]}
        | {"--quadrupeds": NAMES, "--learner": NAMES, "--terms": FILES},
    ),
    "adapt": (
        (Positional("spot"), *_CHECKPOINT, "--max-minutes", "0.0001", "--every", "1", "--threads", "1"),
        {"": [*NAMES, *FILES], "--checkpoint": FILES, "--neighbours": [*COUNTS[:5], "1001"], "--every": COUNTS[:11]}
        | {"--max-minutes": FLOATS, "--train-config": [*NAMES, *FILES], "--seed": _SEEDS, "--log-dir": OUTPUTS}
        | {"--device": NAMES, "--threads": COUNTS, "--set": OVERRIDES, "--package-dir": _PACKAGES, "--lock": _LOCKS}
        | {"--separate": NAMES, "--legs-alone": NAMES},
    ),
    "train resume": (
        ("--resume", "latest"),
        {"--resume": FILES, "--log-dir": [*OUTPUTS, "\udcff"], "--learner": NAMES},
    ),
    "train workers": (("--ray", "nowhere:1"), {"--workers": COUNTS}),
    "sweep": ((Positional("sweep.toml"),), {"": FILES, "--out": OUTPUTS, "--ray": ["nowhere:1"]}),
    "check": ((Positional(URDF),), {"": FILES, "--package-dir": _PACKAGES, "--lock": _LOCKS}),
    "robot": (
        ("new", Positional(URDF), "--out", "/nothing/spot.toml"),
        {
            "": FILES,
            "--name": NAMES,
            "--out": OUTPUTS,
            "--package-dir": _PACKAGES,
            "--foot": [*_PACKAGES, "LF=nothing", "XX=base"],
            "--role": [*_PACKAGES, "LF_HFE=nothing", "XX=fl_hx", "LF_HAA=fl_hy"],
            "--lock": _LOCKS,
        },
    ),
    "add": (
        (Positional(URDF), "--out", "/nothing/library"),
        {
            "": [*FILES, "robot_descriptions:", "robot_descriptions:../x", "mujoco_menagerie:a b", "nothing.zip", ":"],
            "--name": NAMES,
            "--out": OUTPUTS,
            "--file": NAMES,
            "--root": NAMES,
            "--package-dir": _PACKAGES,
            "--xacro-arg": _PACKAGES,
            "--foot": [*_PACKAGES, "LF=nothing", "XX=base"],
            "--role": [*_PACKAGES, "LF_HFE=nothing", "XX=fl_hx", "LF_HAA=fl_hy"],
            "--lock": _LOCKS,
        },
    ),
    "bodies": (
        ("generate", Positional("new"), "--count", "1"),
        {"": OUTPUTS, "--count": COUNTS, "--seed": _SEEDS[:1], "--kinds": NAMES, "--prefix": [*NAMES, "Spot", "a b"]},
    ),
    "terrain": (
        ("--out", "map.npz", "--task", "velocity_rough", "--set", "scene.terrain.num_rows=1"),
        {"--out": [*OUTPUTS, "folder/x.npz/y"], "--task": NAMES, "--set": OVERRIDES},
    ),
    "terrain heights": (
        ("--heights", "heights.npy", "--out", "map.toml"),
        {"--out": OUTPUTS, "--task": NAMES, "--heights": FILES, "--cell": FLOATS, "--range": FLOATS}
        | {"--scale": FLOATS, "--platform": FLOATS},
    ),
    "motions": (
        ("draw", Positional("squat"), "--robot", "unitree_g1", "--out", "squat.npz"),
        {"": [*NAMES, *FILES], "--robot": NAMES, "--out": [*OUTPUTS, "x.csv", "folder/x.npz/y"]},
    ),
    "motions import": (
        ("import", Positional("nothing.csv"), "--robot", "unitree_g1", "--out", "x.npz"),
        {"": FILES, "--fps": FLOATS, "--joints": NAMES},
    ),
    "motions eval": (
        ("eval", Positional("nothing")),
        {"": FILES, "--episodes": COUNTS, "--robots": NAMES, "--clips": NAMES, "--threads": COUNTS}
        | {"--seed": _SEEDS, "--json": OUTPUTS, "--set": OVERRIDES},
    ),
    "show": (
        (Positional("velocity_flat"), "--only", "sim"),
        {"": [*NAMES, *FILES], "--kind": NAMES, "--set": OVERRIDES, "--only": NAMES},
    ),
    "terms": ((Positional("gait"), "--kind", "rewards"), {"": [*NAMES, "x"], "--kind": NAMES, "--terms": FILES}),
    "schema": ((Positional("train"),), {"": NAMES}),
    "accuracy": (("--robots", "nobody"), {"--robots": ["", ",", "x"], "--quadrupeds": ["", ",", "x"]}),
    "bench": (
        ("--robot", "nobody"),
        {"--num-envs": COUNTS, "--threads": COUNTS, "--step-threads": COUNTS, "--largest": COUNTS, "--seed": _SEEDS}
        | {"--robot": NAMES, "--json": OUTPUTS, "--train-config": FILES}
        | {"--workers": ["", "x", "1,", "0", "-1", "1.5", "64", "9" * 40], "--device": ["", "gpu", "cuda:0"]},
    ),
    "list": ((), {"": NAMES}),
    "info": ((), {"": NAMES}),
    "": ((), {"": NAMES}),
}
_POLYPOD_SWITCHES = {
    "": ("--version", "-V"),
    "list": ("--json", "--no-json"),
    "show": ("--json", "--no-json"),
    "terms": ("--json", "--no-json"),
    "train": ("--headless", "--no-headless"),
    "adapt": ("--from-scratch", "--no-from-scratch"),
    "compare": ("--randomized", "--no-randomized", "--randomised", "--no-randomised", "--markdown", "--no-markdown"),
    "eval": ("--randomized", "--no-randomized", "--randomised", "--no-randomised", "--gate", "--no-gate"),
    "export": ("--fold", "--no-fold"),
    "play": ("--headless", "--no-headless", "--meshes", "--no-meshes"),
    "terrain": ("--tiles", "--no-tiles"),
    "add": ("--force", "--no-force"),
    "sim2sim": ("--soft-contact", "--no-soft-contact", "--differences", "--no-differences"),
    "robot": ("--force", "--no-force"),
    "motions": ("--ground", "--no-ground", "--mujoco", "--no-mujoco"),
    "bodies": ("--force", "--no-force", "--wide", "--no-wide"),
    "bench": ("--quick", "--no-quick", "--learner", "--no-learner"),
}
_SIM: dict[str, tuple[Line, dict[str, list[str]]]] = {
    "rollout": (
        ("--task", "velocity_flat", "--num-envs", "8", "--steps", "1"),
        _WITH_TASK
        | {"--num-envs": COUNTS, "--steps": [*COUNTS[:9], COUNTS[10]], "--actions": NAMES, "--engine": NAMES}
        | {"--dump-dir": OUTPUTS},
    ),
    "inspect": (("--robot", "spot"), {"--robot": NAMES}),
    "check": ((Positional(URDF),), {"": FILES, "--package-dir": _PACKAGES, "--lock": _LOCKS}),
    "replay": ((Positional("manifest.json"),), {"": [*FILES, "/dev/zero"], "--simd": NAMES}),
    "play": (
        ("--policy", str(FLAT_POLICY.parent / "exported" / "policy.onnx"), "--num-envs", "8", "--steps", "1"),
        _WITH_TASK
        | {"--policy": FILES, "--num-envs": COUNTS, "--steps": COUNTS[:7], "--command": FLOATS, "--robot": NAMES},
    ),
    "soak": (
        ("--minutes", "0"),
        {"--minutes": ["0", "-1", "nan", "x"], "--dt": FLOATS, "--robots": NAMES, "--num-envs": COUNTS}
        | {"--seed": _SEEDS, "--threads": COUNTS},
    ),
    "list": ((), {"": NAMES}),
    "help": ((), {"": NAMES}),
    "": ((), {"": NAMES}),
}
_SIM_SWITCHES = {"play": ("--json",), "replay": ("--steps-print",), "": ("--version", "-V")}

_VALUES = {"--grid": 3, "--command": 3, "--size": 2}
"""Number of values of the flags that take several."""


def _completed(commands: dict[str, tuple[Line, dict[str, list[str]]]], switches: dict[str, Line]) -> Commands:
    """Lines for what all commands share.

    Each flag without a value, an unknown flag, and the two spellings of help.
    """
    return {
        command: (
            base,
            {flag: [*values, None] if flag else [*values] for flag, values in flags.items()}
            | dict.fromkeys(switches.get(command, ()), SWITCH)
            | {UNKNOWN: [None, *NAMES], "--help": [None, "x"], "-h": [None]},
        )
        for command, (base, flags) in commands.items()
    }


POLYPOD = _completed(_POLYPOD, _POLYPOD_SWITCHES)
POLYPOD_SIM = _completed(_SIM, _SIM_SWITCHES)


def single(commands: Commands) -> list[Line]:
    """Lines with one bad thing: every flag of every command with every value, in a mixed order."""
    lines = [
        _line(command, base, flag, value, place=place)
        for command, (base, flags) in commands.items()
        for flag, values in flags.items()
        for value in values
        for place in range(max(1, sum(isinstance(word, Positional) for word in base)) if not flag else 1)
    ]
    random.Random(0).shuffle(lines)
    return lines


@st.composite
def several(draw: st.DrawFn, commands: Commands, command: str) -> Line:
    """Lines of one command with two to four bad things, in both spellings."""
    base, flags = commands[command]
    line = base
    for flag in draw(st.lists(st.sampled_from(sorted(flags)), min_size=2, max_size=4)):
        values = flags[flag]
        value = draw(
            st.sampled_from(values) | st.text(string.printable, max_size=8) if flag else st.sampled_from(values)
        )
        line = _line(command, line, flag, value, draw(st.booleans()))[1 if name_of(command) else 0 :]
    return (*([name_of(command)] if name_of(command) else []), *line)


def name_of(command: str) -> str:
    """The command's name, without the word that tells lines of it apart."""
    return command.split(" ")[0]


def _line(command: str, base: Line, flag: str, value: str | None, joined: bool = False, place: int = 0) -> Line:
    """The line with a bad value for a flag, in the place of what it has.

    `place` counts positional arguments.
    """
    name = name_of(command)
    line = list(base)
    places = [index for index, word in enumerate(line) if isinstance(word, Positional)]
    if not flag and places and value is not None:
        line[places[place % len(places)]] = Bad(value)
    else:
        if flag in line:
            start = line.index(flag)
            del line[start : start + 1 + _VALUES.get(flag, 1)]
        line += _spelled(flag, value, joined)
    return (*([name] if name else []), *line)


class Bad(Positional):
    """A bad value in the place of a positional argument."""

    __slots__ = ()


def _spelled(flag: str, value: str | None, joined: bool) -> list[str]:
    if value is None:
        return [flag]
    if not flag:
        return [value]
    if joined and flag not in _VALUES:
        return [f"{flag}={value}"]
    return [flag, *[value] * _VALUES.get(flag, 1)]


HIDDEN = {"--quadrupeds", "--randomised", "--no-randomised"}
"""Flags that no help lists."""


def flags_of(commands: Commands) -> Iterator[tuple[str, set[str]]]:
    """Commands and their flags, without what no command has and no help lists."""
    found: dict[str, set[str]] = {}
    for command, (_, flags) in commands.items():
        found.setdefault(name_of(command), set()).update(flags)
    for command, flags in found.items():
        yield command, flags - {"", UNKNOWN} - HIDDEN
