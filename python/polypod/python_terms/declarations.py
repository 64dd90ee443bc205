"""Declarations of terms: what decorators make of a user's functions."""

import inspect
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from polypod._core import ConfigError

Mirror = Literal["scalar", "vector", "pseudovector", "planar_velocity", "per_joint", "per_foot"]
"""Change of numbers in a mirror: see `observation`."""
Mode = Literal["startup", "reset", "interval"]
"""Occasion of an event: see `event`."""
MIRRORS = ("scalar", "vector", "pseudovector", "planar_velocity", "per_joint", "per_foot")
MODES = ("startup", "reset", "interval")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_DTYPES = ("float32", "float64", "int32", "int64", "uint8", "uint64", "bool")

Function = Callable[..., Any]
D = TypeVar("D", bound="Declared")


@dataclass(frozen=True)
class Reward:
    """A reward term: `weight * function(env) * step_dt` is added to the reward of each step.

    Attributes:
        function: the unweighted value per second, a number per env: [num_envs].
        weight: its factor.
        robots: names of the robots that are rewarded by it; None: all.
    """

    function: Callable[[Any], npt.ArrayLike]
    weight: float
    robots: Sequence[str] | None = None

    def __call__(self, env: Any) -> npt.ArrayLike:
        """The unweighted value."""
        return self.function(env)


@dataclass(frozen=True, eq=False, kw_only=True)
class Declared:
    """A function that a decorator has made a term of; it can still be called."""

    name: str
    function: Function
    robots: tuple[str, ...] | None = None
    """Names of the robots that have it; None: all."""

    def __call__(self, *args: Any) -> Any:
        """Calls the function."""
        return self.function(*args)


@dataclass(frozen=True, eq=False, kw_only=True)
class Termination(Declared):
    """A reason for an episode to end: bool [num_envs]."""

    time_out: bool = False
    """Whether the episode is truncated rather than failed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Metric(Declared):
    """A number per env and control step, whose mean over an episode is a curve."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Curriculum(Declared):
    """A change of difficulty when episodes end."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Event(Declared):
    """A change of the simulation, see `event`."""

    mode: Mode
    interval_range_s: tuple[float, float] | None = None
    play: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class Shown(Declared):
    """A term with columns in an observation."""

    size: int
    units: str = ""
    mirror: Mirror = "scalar"
    history_length: int = 1
    group: str | None = "policy"
    noise: float = 0.0
    scale: float = 1.0
    clip: tuple[float, float] | None = None
    hooks: dict[str, Function] = field(default_factory=dict)

    def update(self, function: Function) -> Function:
        """Registers `function(env)`, called once per control step.

        Observations are updated after the physics, before terminations and rewards; commands before
        the physics. Returns the function.
        """
        self.hooks["update"] = function
        return function

    def reset(self, function: Function) -> Function:
        """Registers `function(env, ids)`, called for the envs that begin an episode.

        Returns the function.
        """
        self.hooks["reset"] = function
        return function

    def override(self) -> str:
        """The `key=value` change of a task that reserves the columns."""
        description = (inspect.getdoc(self.function) or "").split("\n", 1)[0]
        external: dict[str, Any] = {"size": self.size, "kind": self.mirror, "units": self.units}
        external["description"] = description
        if self.robots is not None:
            external["robots"] = list(self.robots)
        term: dict[str, Any] = {"term": self.name, "history_length": self.history_length, "external": external}
        if self.noise:
            term["noise"] = self.noise
        if self.scale != 1.0:
            term["scale"] = self.scale
        if self.clip is not None:
            term["clip"] = list(self.clip)
        return f"observations.{self.group}.+={_toml(term)}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation(Shown):
    """An observation term, see `observation`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Command(Shown):
    """A command, see `command`."""

    resampling_time_s: tuple[float, float] = (math.inf, math.inf)


@dataclass(frozen=True, eq=False, kw_only=True)
class Memory:
    """An array that is kept between control steps, see `memory`."""

    name: str
    size: int = 1
    dtype: str = "float32"
    fill: float = 0.0
    per_env: bool = True
    keep: bool = False

    def array(self, num_envs: int) -> npt.NDArray[Any]:
        """The array in which everything begins."""
        return np.full((num_envs, self.size) if self.per_env else self.size, self.fill, dtype=self.dtype)


@dataclass(frozen=True, kw_only=True)
class Terms:
    """All terms of a task that are written in Python, each kind in the order of declaration."""

    source: str = ""
    """Origin of the declarations; errors begin with it."""
    path: Path | None = None
    """File that declares the terms, if one does."""
    sha256: str = ""
    """Checksum of the file, hexadecimal."""
    options: Mapping[str, Any] | None = None
    """Options of terms that polypod has itself and whose columns the task declares. None: the terms
    are a user's."""
    rewards: Mapping[str, Reward] = field(default_factory=dict)
    terminations: Mapping[str, Termination] = field(default_factory=dict)
    observations: Mapping[str, Observation] = field(default_factory=dict)
    commands: Mapping[str, Command] = field(default_factory=dict)
    events: Mapping[str, Event] = field(default_factory=dict)
    curricula: Mapping[str, Curriculum] = field(default_factory=dict)
    metrics: Mapping[str, Metric] = field(default_factory=dict)
    memories: Mapping[str, Memory] = field(default_factory=dict)

    @classmethod
    def of(cls, declared: Iterable["Declared | Memory | tuple[str, Reward]"], source: str = "", **more: Any) -> "Terms":
        """Sorts declarations by kind.

        Raises ConfigError for two of a kind with one name, and where commands and observations
        share one.
        """
        kinds: dict[type, str] = {
            Termination: "terminations",
            Observation: "observations",
            Command: "commands",
            Event: "events",
            Curriculum: "curricula",
            Metric: "metrics",
            Memory: "memories",
        }
        found: dict[str, dict[str, Any]] = {name: {} for name in ("rewards", *kinds.values())}
        for entry in declared:
            name, term = entry if isinstance(entry, tuple) else (entry.name, entry)
            kind = "rewards" if isinstance(term, Reward) else kinds[type(term)]
            if found[kind].get(name, term) is not term:
                raise ConfigError(f"{_begin(source)}there are two {kind} called {name!r}; give one another name=")
            found[kind][name] = term
        if both := found["observations"].keys() & found["commands"].keys():
            raise ConfigError(
                f"{_begin(source)}{min(both)!r} is an observation and a command; a command is observed by itself: "
                "rename one of them"
            )
        arguments: dict[str, Any] = {**found, **more}
        return cls(source=source, **arguments)

    @property
    def is_empty(self) -> bool:
        """Whether there are no terms."""
        kinds = (self.rewards, self.terminations, self.observations, self.commands, self.events, self.curricula)
        return not any((*kinds, self.metrics))

    @property
    def shown(self) -> list[Shown]:
        """Commands and observations with columns in an observation, commands first."""
        return [term for term in (*self.commands.values(), *self.observations.values()) if term.group is not None]

    def in_overrides(self, overrides: Sequence[str]) -> list[str]:
        """Changes of a task with those that reserve the columns, which are added once."""
        if self.options is not None:
            return list(overrides)
        return [*overrides, *(text for term in self.shown if (text := term.override()) not in overrides)]


def _begin(source: str) -> str:
    return f"{source}: " if source else ""


def observation(
    *,
    size: int,
    units: str = "",
    mirror: Mirror = "scalar",
    history_length: int = 1,
    group: str = "policy",
    noise: float = 0.0,
    scale: float = 1.0,
    clip: Sequence[float] | None = None,
    robots: Sequence[str] | None = None,
    name: str | None = None,
) -> Callable[[Function], Observation]:
    """Makes an observation term of `function(env)`, which returns [num_envs, size] or [num_envs].

    Its columns follow the task's own terms of the group, commands before observations, each in the
    order of declaration. Noise, limits, factor and history are applied by the simulator as to its
    own terms, noise from the env's random stream.

    Args:
        size: numbers of a control step; per joint or foot with those mirrors.
        units: SI units.
        mirror: how the numbers change when left and right are exchanged. "scalar": not at all;
            "vector": x, y, z; "pseudovector": such as an angular velocity; "planar_velocity":
            forward, left, yaw rate; "per_joint" and "per_foot": in the batch's columns, all joints'
            first number, then their next.
        history_length: control steps that are observed, the oldest first.
        group: "policy", "critic", or another one; a task without the group gets it.
        noise: half width of uniform noise, in `units`.
        scale: factor after noise and limits.
        clip: limits of the noisy numbers.
        robots: names of the robots that have the term; the others observe zeros, and their masks
            are false. None: all.
        name: of the term; None: that of the function.
    """

    def declare(function: Function) -> Observation:
        return Observation(
            name=_name(function, name),
            function=function,
            **_shown(
                "observation",
                _name(function, name),
                size,
                units,
                mirror,
                history_length,
                group,
                noise,
                scale,
                clip,
                robots,
            ),
        )

    return declare


def command(
    *,
    size: int,
    resampling_time_s: Sequence[float] = (math.inf, math.inf),
    units: str = "",
    mirror: Mirror = "scalar",
    history_length: int = 1,
    group: str | None = "policy",
    scale: float = 1.0,
    robots: Sequence[str] | None = None,
    name: str | None = None,
) -> Callable[[Function], Command]:
    """Makes a command of `function(env, ids)`, which samples [len(ids), size] new values.

    It is called when an episode begins, and when an env's time is up. `env.commands[name]` holds
    the present values, float32 [num_envs, size]; the policy observes them as a term of this name.

    Args:
        size: numbers of an env.
        resampling_time_s: shortest and longest time until the next sample, s. Default: an episode.
        units: as in `observation`, and so are the others.
        mirror: as in `observation`.
        history_length: as in `observation`.
        group: as in `observation`; None: no policy observes it.
        scale: as in `observation`.
        robots: as in `observation`.
        name: as in `observation`.
    """

    def declare(function: Function) -> Command:
        own = _name(function, name)
        low, high = _pair(f"command {own!r}: resampling_time_s", resampling_time_s, least=0.0)
        if high <= 0.0:
            raise ConfigError(f"command {own!r}: resampling_time_s ends at {high:g}; write an upper end above 0")
        shown = _shown("command", own, size, units, mirror, history_length, group, 0.0, scale, None, robots)
        return Command(name=own, function=function, resampling_time_s=(low, high), **shown)

    return declare


def reward(
    *, weight: float, robots: Sequence[str] | None = None, name: str | None = None
) -> Callable[[Function], Declared]:
    """Makes a reward term of `function(env)`, the unweighted value per second, [num_envs].

    Args:
        weight: its factor.
        robots: names of the robots that are rewarded by it; None: all.
        name: of the term; None: that of the function.
    """
    return lambda function: _Rewarded(
        name=_name(function, name),
        function=function,
        robots=_robots(robots),
        reward=Reward(function, weight, robots),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Rewarded(Declared):
    """A decorated reward."""

    reward: Reward


def termination(
    *, time_out: bool = False, robots: Sequence[str] | None = None, name: str | None = None
) -> Callable[[Function], Termination]:
    """Makes a termination of `function(env)`: bool [num_envs], True where an episode ends.

    Args:
        time_out: the episode is truncated, as by its time limit, rather than failed: a learner
            counts what would have followed. An env that fails in the same control step has failed.
        robots: names of the robots that have it; None: all.
        name: of the term; None: that of the function.
    """
    return lambda function: Termination(
        name=_name(function, name), function=function, robots=_robots(robots), time_out=time_out
    )


def metric(*, robots: Sequence[str] | None = None, name: str | None = None) -> Callable[[Function], Metric]:
    """Makes the curve `Metrics/<robot>/<name>` of `function(env)`, a number per env: [num_envs].

    The curve is the mean over the control steps of an episode, over the episodes that ended.
    """
    return lambda function: Metric(name=_name(function, name), function=function, robots=_robots(robots))


def curriculum(*, robots: Sequence[str] | None = None, name: str | None = None) -> Callable[[Function], Curriculum]:
    """Makes a curriculum of `function(env, ids)`, called with the envs whose episodes have ended.

    It runs before they are reset, so that `env` still has their last state and sums. A number that
    it returns, or a dict of numbers, is the curve `Curriculum/<name>`. `eval` and `play` leave
    curricula out.
    """
    return lambda function: Curriculum(name=_name(function, name), function=function, robots=_robots(robots))


def event(
    *,
    mode: Mode,
    interval_range_s: Sequence[float] | None = None,
    play: bool | None = None,
    robots: Sequence[str] | None = None,
    name: str | None = None,
) -> Callable[[Function], Event]:
    """Makes an event of `function(env, ids)`, which changes the envs `ids` through `env.sim`.

    Args:
        mode: "startup": once, when the simulation begins and after a reset with a seed; "reset":
            when an episode begins, after the task's own events; "interval": again and again within
            an episode, before the physics.
        interval_range_s: shortest and longest time between two occurrences, s; of interval events.
        play: whether `eval` and `play` have it without `--randomized`. None: reset events are
            kept, the others left out.
        robots: names of the robots that have it; None: all.
        name: of the term; None: that of the function.
    """

    def declare(function: Function) -> Event:
        own = _name(function, name)
        if mode not in MODES:
            raise ConfigError(f"event {own!r}: mode = {mode!r} is not one of {', '.join(MODES)}")
        if (mode == "interval") is (interval_range_s is None):
            raise ConfigError(f"event {own!r}: interval events alone have interval_range_s=(shortest, longest)")
        times = None
        if interval_range_s is not None:
            times = _pair(f"event {own!r}: interval_range_s", interval_range_s, least=0.0)
            if not 0.0 < times[1] < math.inf:
                raise ConfigError(f"event {own!r}: interval_range_s ends at {times[1]:g}; write a finite end above 0")
        kept = mode == "reset" if play is None else play
        return Event(name=own, function=function, robots=_robots(robots), mode=mode, interval_range_s=times, play=kept)

    return declare


def memory(
    name: str, *, size: int = 1, dtype: str = "float32", fill: float = 0.0, per_env: bool = True, keep: bool = False
) -> Memory:
    """Declares an array that terms keep between control steps, `env.memory[name]`.

    Checkpoints hold it.

    Args:
        name: of the array.
        size: numbers per env, or of the array without `per_env`.
        dtype: NumPy's name of a number type.
        fill: value in the beginning, and where an episode begins.
        per_env: whether it is [num_envs, size] rather than [size].
        keep: keep the numbers when an episode begins; always so without `per_env`.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(f"memory {name!r}: write a name of letters, digits and _")
    if dtype not in _DTYPES:
        raise ConfigError(f"memory {name!r}: dtype = {dtype!r} is not one of {', '.join(_DTYPES)}")
    _count(f"memory {name!r}: size", size, 1 << 20)
    return Memory(name=name, size=size, dtype=dtype, fill=fill, per_env=per_env, keep=keep or not per_env)


def declared_by(values: Iterable[Any]) -> Iterator["Declared | Memory | tuple[str, Reward]"]:
    """The declarations among values."""
    for value in values:
        if isinstance(value, _Rewarded):
            yield value.name, value.reward
        elif isinstance(value, Declared | Memory):
            yield value


def _name(function: Function, name: str | None) -> str:
    own = name if name is not None else getattr(function, "__name__", "")
    if not _NAME.fullmatch(own):
        raise ConfigError(f"the term {own!r} needs a name of letters, digits and _; pass name=")
    return own


def _robots(robots: Sequence[str] | None) -> tuple[str, ...] | None:
    if isinstance(robots, str):
        raise ConfigError(f"robots = {robots!r} is one string; pass a list of names, e.g. [{robots!r}]")
    return None if robots is None else tuple(robots)


def _count(what: str, value: Any, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise ConfigError(f"{what} = {value!r} must be a whole number from 1 to {most}")


def _pair(what: str, values: Sequence[float], least: float) -> tuple[float, float]:
    numbers = [float(value) for value in values]
    if len(numbers) != 2 or not least <= numbers[0] <= numbers[1]:
        raise ConfigError(f"{what} = {tuple(values)} must be (lower, upper), in this order")
    return numbers[0], numbers[1]


def _shown(
    kind: str,
    name: str,
    size: int,
    units: str,
    mirror: Mirror,
    history_length: int,
    group: str | None,
    noise: float,
    scale: float,
    clip: Sequence[float] | None,
    robots: Sequence[str] | None,
) -> dict[str, Any]:
    """Arguments of `Shown`, checked."""
    what = f"{kind} {name!r}"
    _count(f"{what}: size", size, 4096)
    _count(f"{what}: history_length", history_length, 100)
    if mirror not in MIRRORS:
        raise ConfigError(f"{what}: mirror = {mirror!r} is not one of {', '.join(MIRRORS)}")
    if group is not None and not _NAME.fullmatch(group):
        raise ConfigError(f"{what}: group = {group!r}; write a name of letters, digits and _")
    return {
        "size": size,
        "units": units,
        "mirror": mirror,
        "history_length": history_length,
        "group": group,
        "noise": noise,
        "scale": scale,
        "clip": None if clip is None else _pair(f"{what}: clip", clip, least=-math.inf),
        "robots": _robots(robots),
    }


def _toml(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(value)
