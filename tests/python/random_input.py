"""Random numbers, words, tables and command lines, and a check of accepted configs.

A draw depends on `SEED` and its number alone, so that one input can be made again by itself.
"""

import os
import random
import re
import string
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from common import ROOT
from polypod.compat import tomllib

Line = tuple[str, ...]

SEED = int(os.environ.get("POLYPOD_TEST_SEED", "1"))
"""Seed of every draw; another one gives other inputs."""

PROGRAM = ROOT / "target" / "release" / "polypod-sim"
TASKS = ["velocity_flat"] * 8 + ["velocity_flat_legged"] * 3 + ["velocity_flat_humanoid", "velocity_flat_joints"]
TASKS += [
    "velocity_rough",
    "velocity_rough",
    "velocity_obstacles",
    "velocity_flat_variation",
    "velocity_flat_asymmetric",
]
ROBOTS = {
    "velocity_flat": ["spot", "unitree_a1", "unitree_b2", "anymal_b"],
    "velocity_flat_legged": ["bolt", "cassie", "phantomx", "solo12", "unitree_go2w", "box_quadruped", "limx_tron1"],
    "velocity_flat_humanoid": ["unitree_h1", "berkeley_humanoid"],
}
SMALL = ("scene.terrain.num_rows=2", "scene.terrain.num_cols=10", "scene.terrain.border_width=2.0")
STEPS = 50
"""Control steps that an accepted config takes."""

EXTREMES = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    1e-320,
    1e-46,
    1e-9,
    1e9,
    3.4e38,
    3.5e38,
    1e39,
    1e300,
    1e308,
    float("inf"),
    float("nan"),
]
INTEGERS = [0, 1, -1, 2, 255, 256, 65536, 2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**63 - 1, 2**63, 2**64, 10**40]
WORDS = [
    "",
    " ",
    "None",
    "null",
    "true",
    "inf",
    "nan",
    "spot",
    "LF_FOOT",
    "..",
    "/",
    "~",
    "{x}",
    "${x}",
    "%s",
    "*",
    "[",
    "\\",
]
WORDS += [
    "\N{GREEK SMALL LETTER ALPHA}",
    "\N{ARABIC-INDIC DIGIT THREE}",
    "\u202e",
    "\N{ROBOT FACE}",
    "e\u0301",
    "a" * 300,
    "0x10",
    "1_0",
    "\t",
]


def generator(*place: object) -> random.Random:
    """The stream of one input."""
    return random.Random(":".join(map(str, (SEED, *place))))


def number(draw: random.Random, near: float = 1.0) -> float:
    """A number: near `near` in most draws, else of any magnitude of a double, or an extreme."""
    kind = draw.random()
    if kind < 0.6:
        return near * 10.0 ** draw.gauss(0.0, 0.5) * draw.choice((1, 1, 1, -1)) if near else draw.gauss(0.0, 1.0)
    if kind < 0.85:
        return draw.choice((1.0, -1.0)) * 10.0 ** (
            draw.uniform(-9.0, 9.0) if draw.random() < 0.6 else draw.uniform(-320.0, 308.0)
        )
    return draw.choice(EXTREMES) * draw.choice((1.0, -1.0))


def integer(draw: random.Random, near: int = 4) -> int:
    """An integer near `near`, or one on either side of a power of two."""
    if draw.random() < 0.5:
        return draw.randint(-2, 4 * abs(near) + 2)
    return draw.choice(INTEGERS) * draw.choice((1, -1))


def word(draw: random.Random) -> str:
    """A word: one that is hard to read, or letters."""
    if draw.random() < 0.6:
        return draw.choice(WORDS)
    letters = string.ascii_letters + string.digits + "_-. /"
    return "".join(draw.choice(letters) for _ in range(draw.randint(1, 12)))


def anything(draw: random.Random, depth: int = 0) -> Any:
    """A value of any type that TOML and JSON share."""
    kind = draw.randrange(7 if depth < 2 else 4)
    if kind == 0:
        return number(draw)
    if kind == 1:
        return integer(draw)
    if kind == 2:
        return word(draw)
    if kind == 3:
        return draw.random() < 0.5
    if kind in (4, 5):
        return [anything(draw, depth + 1) for _ in range(draw.randint(0, 4))]
    return {word(draw): anything(draw, depth + 1) for _ in range(draw.randint(0, 3))}


def changed(draw: random.Random, value: Any) -> Any:
    """A value like `value`: of its type in most draws."""
    if draw.random() < 0.06:
        return anything(draw)
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return integer(draw, value)
    if isinstance(value, float):
        return number(draw, value)
    if isinstance(value, str):
        return word(draw)
    if isinstance(value, list):
        new = list(value)
        for _ in range(draw.randint(1, 2)):
            kind = draw.random()
            if new and kind < 0.7:
                at = draw.randrange(len(new))
                new[at] = changed(draw, new[at])
            elif new and kind < 0.8:
                del new[draw.randrange(len(new))]
            elif kind < 0.9:
                new.append(changed(draw, new[0]) if new else anything(draw))
            else:
                new.reverse()
        return new
    if isinstance(value, dict) and value:
        return mutated(draw, value)
    return anything(draw)


def leaves(tables: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Paths and values of all that is no table."""
    if isinstance(tables, dict):
        for key, value in tables.items():
            yield from leaves(value, (*path, key))
    else:
        yield path, tables


def mutated(draw: random.Random, tables: dict[str, Any], times: int = 1) -> dict[str, Any]:
    """A copy with some values changed, renamed, removed or added."""
    copy = {key: mutated(draw, value, 0) if isinstance(value, dict) else value for key, value in tables.items()}
    for _ in range(times):
        table = copy
        while (inner := [key for key, value in table.items() if isinstance(value, dict) and value]) and (
            draw.random() < 0.8
        ):
            table = table[draw.choice(inner)]
        if not table:
            continue
        key, kind = draw.choice(list(table)), draw.random()
        if kind < 0.75:
            table[key] = changed(draw, table[key])
        elif kind < 0.85:
            del table[key]
        elif kind < 0.95:
            table[draw.choice([key + "x", word(draw) or "x"])] = table[key]
        else:
            table[key] = anything(draw)
    return copy


def toml(value: Any) -> str:
    """A value in the syntax of TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return "nan" if value != value else repr(value)
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml(key)} = {toml(inner)}" for key, inner in value.items()) + "}"
    return str(value)


def toml_file(tables: dict[str, Any]) -> str:
    """Tables as a file, one line for each key."""
    return "".join(f"{toml(key)} = {toml(value)}\n" for key, value in tables.items())


def task_and_robots(draw: random.Random) -> tuple[str, list[str]]:
    """A task, and one or two robots that can do it."""
    task = draw.choice(TASKS)
    robots = ROBOTS.get(task, ROBOTS["velocity_flat"])
    return task, draw.sample(robots, draw.choice((1, 1, 1, 2)))


@cache
def resolved(task: str, robots: tuple[str, ...]) -> dict[str, Any]:
    """All keys of a task that may be overridden, with their values."""
    from polypod import _core

    small = SMALL if "rough" in task else ()
    sim = _core.VecSim(task, num_envs=len(robots), robots=list(robots), threads=1, overrides=list(small))
    tables = tomllib.loads(sim.resolved_config())
    return {**tables["task"], "robot_overrides": tables["robots"]}


@cache
def train_keys() -> dict[str, Any]:
    from polypod.runs import config

    return {"train": config.load("quick").as_dict()}


def override(draw: random.Random, tables: dict[str, Any]) -> str:
    """A `KEY=VALUE` of `--set`: in most draws an existing key with a value of its type."""
    path, value = draw.choice(list(leaves(tables)))
    kind = draw.random()
    if kind < 0.03:
        path = path[:-1] or path
    elif kind < 0.06:
        path = (*path, draw.choice(["x", "0", "", "-1", word(draw)]))
    elif kind < 0.09:
        at = draw.randrange(len(path))
        path = (*path[:at], draw.choice([path[at].upper(), path[at] + "s", word(draw)]), *path[at + 1 :])
    new = changed(draw, value)
    text = str(new) if isinstance(new, str) and draw.random() < 0.3 else toml(new)
    return f"{'.'.join(path)}={text}"


def settings(draw: random.Random, tables: dict[str, Any], most: int = 4) -> list[str]:
    """Words of one to `most` overrides."""
    words = []
    for _ in range(draw.choice((1, 1, 2, most))):
        flag = override(draw, tables)
        words += ["--set", flag] if draw.random() < 0.8 else [f"--set={flag}"]
    return words


_VALUES = {"--grid": 3, "--command": 3, "--size": 2}
"""Number of values of the flags that take several."""
_SMALL_COUNTS = {"--threads": 4, "--max-iterations": 1, "--steps": 20, "--workers": 1, "--count": 2, "--fps": 20}
_SMALL_COUNTS |= {"--num-envs": 64, "--seeds": 2, "--episodes": 2, "--parts": 3, "--size": 64, "--grid": 2}


def flag_value(draw: random.Random, flag: str) -> str:
    """A value of any type.

    One that asks for work asks for little of it, or for more than any machine has.
    """
    kind = draw.random()
    if flag in ("--minutes", "--seconds", "--warm-up"):
        return draw.choice(["0", "1e-9", "0.02", "-1", "nan", "-inf", "1e18", "1e308", word(draw)])
    if flag in _SMALL_COUNTS:
        most = _SMALL_COUNTS[flag]
        if kind < 0.4:
            return str(draw.randint(0, most))
        return draw.choice(
            [str(-draw.randint(1, 2**40)), str(10 ** draw.randint(19, 40)), word(draw), f"{number(draw)}e"]
        )
    if kind < 0.3:
        return repr(number(draw))
    if kind < 0.5:
        return str(integer(draw))
    if kind < 0.8:
        return word(draw)
    return toml(anything(draw))


def _flags(draw: random.Random, command: str, flags: dict[str, list[str | None]]) -> list[str]:
    words: list[str] = []
    left_out = {"--ray", "--logger", "--device", "--host", "--port"}
    if command == "bench":  # these measure for minutes, without a robot to be refused
        left_out |= {"--workers", "--learner", "--no-learner"}
    names = [
        flag
        for flag in sorted(flags)
        if flag not in left_out and (flag not in ("-h", "--help") or draw.random() < 0.05)
    ]
    for flag in draw.sample(names, min(len(names), draw.choice((1, 1, 2, 3)))):
        if not flag:
            words.append(flag_value(draw, flag))
        elif set(flags[flag]) <= {None, "x", ""} and draw.random() < 0.7:
            words.append(flag)
        elif command in ("bench", "accuracy") and flag in ("--robot", "--robots", "--quadrupeds"):
            words += [flag, "nobody" + word(draw)]
        elif draw.random() < 0.2:
            words.append(f"{flag}={flag_value(draw, flag)}")
        else:
            count = draw.choice((1, 1, 1, 0, 2, 3)) if draw.random() < 0.3 else _VALUES.get(flag, 1)
            words += [flag, *(flag_value(draw, flag) for _ in range(count))]
    return words


_CHECKPOINT = ("--checkpoint", "flat")
_ONE_ENV = ("--num-envs", "1", "--mujoco-envs", "1")
_OF_POLYPOD = {
    "eval": ("eval", *_CHECKPOINT, "--num-envs", "8", "--steps", "2"),
    "play": ("play", *_CHECKPOINT, "--headless", "--seconds", "0.1"),
    "terrain": ("terrain", "--out", "map.npz"),
    "sim2sim": ("sim2sim", *_CHECKPOINT, "--num-envs", "1", "--steps", "2"),
    "robustness": (
        "robustness",
        *_CHECKPOINT,
        "--num-envs",
        "1",
        "--mujoco-envs",
        "1",
        "--steps",
        "2",
        "--conditions",
        "nominal",
    ),
    "train": ("train", "--num-envs", "16", "--max-iterations", "1", "--logger", "none", "--train-config", "quick"),
}


def line(program: str, index: int) -> Line:
    """The random line with this number of a program."""
    import bad_lines  # here, since it imports hypothesis, which what runs in forks has no use for

    draw = generator("line", program, index)
    if draw.random() < 0.6:
        task, robots = task_and_robots(draw)
        small = [word for key in SMALL for word in ("--set", key)] if "rough" in task else []
        tables = resolved(task, tuple(robots))
        if program == "polypod-sim":
            count = str(8 * len(robots))
            base = ["rollout", "--num-envs", count, "--steps", "2", "--task", task, "--robots", ",".join(robots)]
            return (*base, *small, *settings(draw, tables))
        command = draw.choice(["eval", "eval", "play", "terrain", "sim2sim", "robustness", "train", "train"])
        base = list(_OF_POLYPOD[command])
        if command == "terrain":
            task, small = "velocity_rough", [word for key in SMALL for word in ("--set", key)]
            return (*base, "--task", task, *small, *settings(draw, {"scene": resolved(task, ("spot",))["scene"]}))
        if command in ("sim2sim", "robustness"):
            robots = ["spot"]
            return (*base, "--robots", "spot", *settings(draw, resolved("velocity_flat", ("spot",))))
        if command == "train" and draw.random() < 0.5:
            tables = train_keys()
        if command in ("eval", "play"):
            task, robots, small = "velocity_flat", ["spot"], []
            tables = resolved(task, ("spot",))
        return (*base, "--task", task, "--robots", ",".join(robots), *small, *settings(draw, tables))
    commands = bad_lines.POLYPOD if program == "polypod" else bad_lines.POLYPOD_SIM
    command = draw.choice(sorted(commands))
    base, flags = commands[command]
    name = command.split(" ")[0]
    words = [*([name] if name else []), *map(str, base), *_flags(draw, name, flags)]
    if len(base) and draw.random() < 0.3 and "" in flags:
        at = draw.randrange(len(words))
        words[at] = flag_value(draw, "") if at or not name else name
    if draw.random() < 0.1 and len(words) > 1:
        at = draw.randrange(1, len(words))
        words[at], words[at - 1] = words[at - 1], words[at]
    if draw.random() < 0.05 and words:
        del words[draw.randrange(len(words))]
    return tuple(word.replace("\0", "") for word in words)


_FLAG = {"--task": "task", "-t": "task", "--robots": "robots", "-r": "robots", "--set": "overrides"}


def config_of(words: Line) -> dict[str, Any] | None:
    """Task, robots and overrides of an accepted line; None where it simulates nothing."""
    if not words or words[0] not in ("rollout", "eval", "play", "train"):
        return None
    found: dict[str, Any] = {"task": "velocity_flat", "robots": None, "overrides": []}
    rest = list(words[1:])
    while rest:
        flag, joined, value = rest.pop(0).partition("=")
        if flag not in _FLAG:
            continue
        if not joined:
            if not rest:
                return None
            value = rest.pop(0)
        if _FLAG[flag] == "overrides":
            found["overrides"].append(value)
        elif _FLAG[flag] == "robots":
            found["robots"] = value.split(",")
        else:
            found["task"] = value
    found["overrides"] = [text for text in found["overrides"] if not text.startswith("train.")]
    return found


def complaint_of(code: int, output: str, seconds: float, codes: tuple[int, ...]) -> str | None:
    """Fault in the end of a command; None for no fault."""
    if code in (-9, -24):
        return f"took more than {seconds:.0f} s"
    if bad := re.search(r"Traceback|this is a bug|panicked|memory allocation|Segmentation|core dumped", output):
        errors = re.findall(
            r"^[\w.]*(?:Error|Exception|Interrupt)\b.*|.*panicked.*|.*memory allocation.*", output, re.M
        )
        place = re.findall(r'File "[^"]*/(polypod/[^"]*)", line (\d+)', output)
        return f"{bad[0]}: exit {code}: {errors[-1][:400] if errors else output[-600:]} {place[-1:]}"
    if code not in codes:
        return f"exit {code}: {output[-600:]}"
    if code and not output.strip():
        return f"exit {code} without a word"
    return None


def run_program(words: Line, folder: Path, seconds: float = 60.0, memory: int = 6 << 30) -> tuple[int, str]:
    """Runs `polypod-sim` with bounds on time and memory; returns its exit code and what it said."""
    import resource

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    command = [str(PROGRAM), *(os.fsencode(word) for word in words)]
    options: dict[str, Any] = {
        "encoding": "utf-8",
        "errors": "replace",
        "timeout": seconds,
        "stdin": subprocess.DEVNULL,
    }
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, preexec_fn=limit, check=False, **options)
    except subprocess.TimeoutExpired:
        return -9, ""
    return done.returncode, done.stdout + done.stderr


def steps_a_urdf(path: str) -> int:
    """Steps the robot of a URDF without a task.

    Returns 0 if its state is finite, 2 if it is refused, 4 if it is not finite.
    """
    import warnings

    import numpy as np

    from polypod import _core

    warnings.simplefilter("ignore")
    try:
        sim = _core.Simulation(path, num_envs=2, threads=1)
    except _core.PolypodError as error:
        print(error, file=sys.stderr)
        return 2
    for step in range(STEPS):
        sim.step(n=1)
        if not np.isfinite(sim.qpos).all() or not np.isfinite(sim.qvel).all():
            print(f"the state is not finite after {step + 1} steps", file=sys.stderr)
            return 4
    return 0


def steps_finitely(task: str, robots: list[str] | None, overrides: list[str], num_envs: int = 0) -> int:
    """Steps a config 50 times.

    Returns 0 if all it shows is finite, 2 if it is refused, 4 if not finite.

    Says so where every env ends in every step, which is in order. `fork_server.ForkServer.call`
    runs it in a process.
    """
    import numpy as np

    from polypod import _core

    np.seterr(all="ignore")
    count = num_envs or 8 * len(robots or "12345678")
    try:
        sim = _core.VecSim(task, num_envs=count, robots=robots, seed=3, threads=1, overrides=overrides)
    except _core.PolypodError as error:
        print(error, file=sys.stderr)
        return 2
    return _steps(sim, count)


def _steps(sim: Any, count: int) -> int:
    import numpy as np

    numbers = np.random.default_rng(0)
    ended = 0.0
    for step in range(STEPS):
        for name in ("observation", "reward", "final_obs"):
            finite = np.isfinite(getattr(sim, name)).reshape(sim.num_envs, -1).all(axis=1)
            if not finite.all():
                print(f"{name} of {(~finite).sum()} of {count} envs is not finite after {step} steps", file=sys.stderr)
                return 4
        sim.step(numbers.uniform(-1.0, 1.0, (sim.num_envs, sim.num_actions)).astype(np.float32))
        ended += float(np.mean(sim.terminated))
    if not np.isfinite(list(sim.log().values())).all():
        print(f"log is not finite: {sim.log()}", file=sys.stderr)
        return 4
    if ended == STEPS:
        print("every env ended in every step", file=sys.stderr)
    return 0


def reports_nan() -> int:
    """Result of `steps_finitely` for a reward that becomes infinite.

    It does so in two of four envs, from the third step on.
    """
    import numpy as np

    class Broken:
        num_envs, num_actions, steps = 4, 1, 0
        observation = final_obs = np.zeros((4, 3), np.float32)
        terminated = np.zeros(4, bool)

        @property
        def reward(self) -> Any:
            return np.array([0.0, 1.0, np.nan, np.inf] if self.steps > 2 else [0.0] * 4, np.float32)

        def step(self, actions: Any) -> None:
            self.steps += len(actions) // 4

    return _steps(Broken(), 4)
