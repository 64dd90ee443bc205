"""The batch as a `gymnasium.vector.VectorEnv`."""

import copy
import difflib
import json
import operator
import os
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError, ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from polypod import _core, simulated
from polypod.motions.names import observes_motions, split
from polypod.python_terms import Declared, Memory, Terms, TermSim, load
from polypod.python_terms.declarations import declared_by
from polypod.registration import NAMESPACE, num_robots, task_of
from polypod.state import State

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from polypod.render.pictures import Pictures

FloatArray = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]

Overrides = Mapping[str, Any] | Sequence[str]
"""Changes to a task's configuration, see `EnvOptions`."""

MAX_ACTION = 1e6
"""Largest magnitude of an action that the simulator takes."""
RENDER_MODES = ("rgb_array",)
_AUTORESET_MODES = {
    "same_step": AutoresetMode.SAME_STEP,
    "next_step": AutoresetMode.NEXT_STEP,
    "disabled": AutoresetMode.DISABLED,
}


class EnvOptions(TypedDict, total=False):
    """Keyword arguments of `make` and `VectorEnv`, all of them optional."""

    robots: Sequence[str] | None
    """Names of the robots (see `polypod.robots`). None, the default: those of the task."""
    seed: int | None
    """Seed of every random stream. None, the default: drawn from the operating system."""
    autoreset: str | AutoresetMode
    """"same_step" (the default), "next_step" or "disabled", as Gymnasium defines them."""
    threads: int | None
    """Worker threads. None, the default: one per core."""
    copy: bool
    """Hands out fresh arrays rather than the simulator's own, see `VectorEnv`. True by default."""
    overrides: Overrides
    """Changes to the task's configuration: a mapping, e.g. `{"sim.episode_length_s": 10.0}`, nested
    or with dotted keys, or `key=value` texts, e.g. `["sim.episode_length_s=10.0"]`."""
    render_mode: str | None
    """"rgb_array": `render` gives pictures, which needs the extra play. None, the default: it gives
    None."""
    share: tuple[int, int] | None
    """Envs [start, end) of `num_envs` that are simulated here; another process has the others. They
    are, bit for bit, these rows of the whole batch. None, the default: all."""
    dump_dir: str | os.PathLike[str] | None
    """Directory for a dump of the first state of each robot that breaks; `polypod-sim replay` steps
    it again. None, the default: no dump."""
    terms: "str | os.PathLike[str] | Terms | Sequence[Declared | Memory] | None"
    """Terms of the task that are written in Python, see `polypod.terms`: their file, or their
    declarations. None, the default: no such terms."""
    slots: Sequence[str]
    """Names of actions that the batch has on top of its robots' own: those of a policy that knows
    other robots too."""


def make(task_id: str, num_envs: int | None = None, **options: "Unpack[EnvOptions]") -> "VectorEnv":
    """Builds a vector env.

    Args:
        task_id: name or alias of a task (see `polypod.tasks`), with or without the `polypod/` of
            its Gymnasium id.
        num_envs: number of envs, at least one per robot. Each robot gets an equal, contiguous
            share. None: one env per robot.
        **options: robots, seed, autoreset, threads, copy, overrides, render_mode, share, dump_dir,
            terms and slots; `EnvOptions` documents them.

    Raises:
        ConfigError: for an unknown task or robot, too few envs, an unknown key or a value out of
            range.
        TypeError: for an option that does not exist.
    """
    return VectorEnv(task_id, num_envs, **options)


def make_for_gymnasium(task_id: str, num_envs: int, **options: "Unpack[EnvOptions]") -> "VectorEnv":
    """`make` for `gymnasium.make_vec`, which passes `num_envs=1` when its caller gives none.

    One env holds one robot. Where there are more robots, 1 stands for an env of each, with a
    warning that says so.
    """
    if num_envs != 1:
        return make(task_id, num_envs, **options)
    env = make(task_id, None, **options)
    if env.num_envs > 1:
        warnings.warn(
            f"gymnasium.make_vec gives {env.num_envs} envs, one for each robot, in the place of num_envs=1, which is "
            f"also what it passes where none is named; pass num_envs={env.num_envs} or more, or "
            f"robots=[{env.robots[0]!r}] for a single env",
            stacklevel=3,
        )
    return env


class VectorEnv(gymnasium.vector.VectorEnv[FloatArray, FloatArray, npt.NDArray[Any]]):
    """Many legged robots that track velocity commands.

    Arrays that are handed out are yours to keep. With `copy=False` they are the simulator's own and
    cost nothing, and are guarded against writing: an observation stays valid until the step after
    the next one (two buffers alternate; `set_state` counts as a step), rewards and flags until the
    next step. `polypod.rsl_rl.VecEnv` reads the simulator's own arrays either way.

    An observation is float32 [num_envs, num_obs], see `observation_layout`; an action is [num_envs,
    num_actions], one number per canonical joint: the target is `default_pose + action_scale *
    action`. The action space ends where targets would leave the limits of every robot's joint;
    actions beyond it are accepted, and the joint then stops at its limit.

    Quadrupeds have twelve joints; a batch of different bodies has the joints of all of them, and
    `action_mask` says which an env's robot has. A missing joint is 0 in observations, and an action
    for it does nothing. Such a batch has `action_mask` in its infos.
    """

    def __init__(self, task_id: str, num_envs: int | None = None, **options: "Unpack[EnvOptions]") -> None:
        """Builds the envs; `make` and `EnvOptions` document the arguments."""
        for name in options:
            if name not in EnvOptions.__annotations__:
                (nearest,) = difflib.get_close_matches(name, EnvOptions.__annotations__, n=1, cutoff=0.0)
                raise TypeError(f"unknown option {name!r}; did you mean {nearest!r}?")
        mode = _autoreset_mode(options.get("autoreset", AutoresetMode.SAME_STEP))
        robots, seed = options.get("robots"), options.get("seed")
        if isinstance(robots, str):
            raise _core.ConfigError(f"robots={robots!r} is one string; pass a list of names, e.g. [{robots!r}]")
        task, overrides = task_of(task_id), override_texts(options.get("overrides", ()))
        if num_envs is None:
            num_envs = num_robots(task, split(overrides)[0]) if robots is None else len(robots)
        self._sim: _core.VecSim | None
        self._sim = simulator(
            terms_of(options.get("terms")),
            task,
            _index(num_envs, "num_envs"),
            robots=None if robots is None else list(robots),
            seed=fresh_seed() if seed is None else _index(seed, "seed"),
            threads=options.get("threads"),
            overrides=overrides,
            autoreset=next(name for name, value in _AUTORESET_MODES.items() if value is mode),
            dump_dir=options.get("dump_dir"),
            share=options.get("share"),
            slots=list(options.get("slots", ())),
        )
        self.copy = options.get("copy", True)
        self.autoreset_mode = mode
        self.render_mode = _render_mode(options.get("render_mode"))
        self.metadata = {
            "autoreset_mode": mode,
            "render_modes": list(RENDER_MODES),
            "render_fps": round(1.0 / self._sim.step_dt),
        }
        self.spec = _spec(task, self._sim.num_envs, options)
        self.num_envs = self._sim.num_envs
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self._sim.num_obs,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(*action_bounds(self._sim), dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._action_mask = self._sim.action_mask
        self._is_padded = self._sim.is_padded
        self._needs_reset = np.zeros(self.num_envs, dtype=np.bool_)
        self._thread: ThreadPoolExecutor | None = None
        self._pending: Future[None] | None = None
        self._pictures: Pictures | None = None

    @property
    def sim(self) -> _core.VecSim:
        """The simulator underneath. Raises ClosedEnvironmentError after `close`."""
        if self._sim is None:
            raise ClosedEnvironmentError("this env is closed; build a new one with polypod.make")
        return self._sim

    @property
    def state(self) -> State:
        """The robots' state as dense arrays, gathered when they are asked for."""
        return State(lambda: self.sim)

    @property
    def robots(self) -> list[str]:
        """Names of the robots, in the order of their blocks of envs."""
        return self.sim.robots

    @property
    def canonical_joint_names(self) -> list[str]:
        """Names of the action's columns, such as LF_HAA or L_HIP_YAW: limb and role of a joint."""
        return self.sim.canonical_joint_names

    @property
    def feet_names(self) -> list[str]:
        """Names of the legs whose feet `state` has, in order."""
        return self.sim.feet_names

    @property
    def action_mask(self) -> BoolArray:
        """Bool [num_envs, num_actions], True where an env's robot has a joint.

        A copy. It never changes.
        """
        return self._action_mask.copy()

    @property
    def observation_layout(self) -> list[tuple[str, int]]:
        """(term, size) of an observation, in order."""
        return self.sim.observation_layout

    @property
    def step_dt(self) -> float:
        """Seconds between control steps."""
        return self.sim.step_dt

    @property
    def max_episode_length(self) -> int:
        """Control steps until an episode is truncated."""
        return self.sim.max_episode_length

    def env_ids(self, robot: str) -> npt.NDArray[np.int64]:
        """The rows that hold `robot`. Raises UnknownNameError."""
        return np.arange(*self.sim.env_ids(robot), dtype=np.int64)

    def joint_map(self, robot: str) -> list[tuple[str, int]]:
        """Name and index of each joint, in the order of the action.

        Both are the robot's own.
        """
        return self.sim.joint_map(robot)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begins new episodes.

        Args:
            seed: restarts every random stream; None: they go on.
            options: `reset_mask`, bool [num_envs]: the envs to reset; without it all are. `state`:
                arguments of `VecSim.set_state` by name, such as {"joint_pos": ...}, with a row for
                each env that is reset: where these begin; what is absent is drawn.

        Raises:
            ConfigError: for an option that does not exist, for a mask of another shape or without a
                single True, and for a state that `set_state` refuses.
            TypeError: for a mask that is not a NumPy array of bools, for a state that is no dict,
                and for a seed that is not one int.
            ValueError: for a part of a state that does not exist or has another shape.
        """
        sim = self._ready("reset")
        if seed is not None:
            seed = _index(seed, "seed")
            super().reset(seed=seed)
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        state = options.pop("state", None)
        if options:
            raise _core.ConfigError(f"unknown reset option {next(iter(options))!r}; use 'reset_mask' or 'state'")
        if state is not None and not isinstance(state, Mapping):
            found = type(state).__name__
            raise TypeError(f"options['state'] is a {found}; pass a dict, e.g. {{'joint_pos': positions}}")
        values = None if state is None else cast("_core.StateValues", dict(state))
        if mask is None:
            sim.reset(seed, None, values)
            self._needs_reset[:] = False
        else:
            self._check_mask(mask)
            # `terminated` itself, which the reset writes to, may be the mask
            mask = mask.copy()
            sim.reset(seed, mask, values)
            self._needs_reset[mask] = False
        return self._handed_out(sim.observation), self._masks()

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Advances every env by one control step of `step_dt`.

        Args:
            actions: [num_envs, num_actions], in the order of `canonical_joint_names`: an array of
                any float or int type, a tensor on the CPU, or nested lists. float32 in C order is
                not copied.

        Returns:
            Observations, rewards, terminated, truncated and infos. In same-step mode the infos hold
            `final_obs`, an object array with the last observation of each episode that ended, its
            mask `_final_obs`, and `final_info`.

        Raises:
            TypeError: for actions that are not numbers.
            ValueError: for another shape, and for a NaN or an infinity.
            ResetNeeded: with autoreset disabled, when an env whose episode has ended was not reset.
        """
        sim = self._ready("step")
        sim.step(_float32(actions))
        return self._stepped(sim)

    def send(self, actions: FloatArray) -> None:
        """Starts a control step in another thread and returns at once.

        `recv` returns the results of `step`.

        With two envs, one is simulated while the policy acts on the other's observations. Until
        `recv` nothing else of this env may be used; arrays handed out before stay readable, as
        after a `step`.

        Args:
            actions: as in `step`; they are copied.

        Raises:
            AlreadyPendingCallError: when a step is on its way.
            TypeError: for actions that are not numbers.
            ResetNeeded: as `step`; whatever else is wrong with the actions is raised by `recv`.
        """
        sim = self._ready("send")
        if self._thread is None:
            self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="polypod-send")
        self._pending = self._thread.submit(sim.step, np.array(_float32(actions)))

    def recv(self) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Waits for the step that `send` began.

        Returns:
            As `step`.

        Raises:
            NoAsyncCallError: when no step is on its way.
            ValueError: for another shape of the actions, and for a NaN or an infinity.
        """
        if self._pending is None:
            raise NoAsyncCallError("recv without send; call send(actions) first", "recv")
        pending, self._pending = self._pending, None
        pending.result()
        return self._stepped(self.sim)

    def _ready(self, caller: str) -> _core.VecSim:
        """The simulator, if it may be stepped or reset."""
        if self._pending is not None:
            raise AlreadyPendingCallError(f"{caller} while a step is on its way; call recv() first", caller)
        if caller != "reset" and self.autoreset_mode is AutoresetMode.DISABLED and self._needs_reset.any():
            rows = np.flatnonzero(self._needs_reset)
            raise ResetNeeded(
                f"the episodes of envs {rows[:8].tolist()} ({rows.size} in all) have ended; "
                "call reset(options={'reset_mask': terminated | truncated}) before the next step"
            )
        return self.sim

    def _stepped(self, sim: _core.VecSim) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        if self.autoreset_mode is AutoresetMode.DISABLED:
            np.logical_or(sim.terminated, sim.truncated, out=self._needs_reset)
        return (
            self._handed_out(sim.observation),
            self._handed_out(sim.reward),
            self._handed_out(sim.terminated),
            self._handed_out(sim.truncated),
            {**self._masks(), **(self._final_infos(sim) if self.autoreset_mode is AutoresetMode.SAME_STEP else {})},
        )

    def _masks(self) -> dict[str, Any]:
        return {"action_mask": self.action_mask} if self._is_padded else {}

    def episode_stats(self, clear: bool = True) -> dict[str, dict[str, float]]:
        """Returns statistics of each robot's episodes that ended since the last `clear`.

        Keys: episodes, falls, fall_rate, episode_length_s, error_vel_xy (m/s), error_vel_yaw
        (rad/s), command_xy, command_yaw (the same errors, had the robot stood still) and
        reward_per_s.
        """
        return self.sim.episode_stats(clear)

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:
        """Pictures of the present state.

        Returns:
            For `render_mode="rgb_array"` one picture per env, each uint8 [360, 640, 3]; None
            without a render mode.

        Raises:
            ConfigError: where a package of the extra play is missing.
        """
        if self.render_mode is None:
            return None
        if self._pictures is None:
            # drawing needs an extra
            from polypod.render.pictures import Pictures

            self._pictures = Pictures(self.sim)
        return self._pictures.draw()

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Calls a method, or reads an attribute, of all envs at once.

        Returns:
            The one result, once per env: the envs share a simulator.
        """
        value = getattr(self, name)
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Reads an attribute, see `call`."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Sets an attribute that all envs share.

        Raises:
            ConfigError: for a list of values that differ from env to env.
        """
        if isinstance(values, list | tuple):
            first, *others = values
            if any(other != first for other in others):
                raise _core.ConfigError(f"set_attr({name!r}): all envs share one simulator; pass one value for all")
            values = first
        setattr(self, name, values)

    def close_extras(self, **kwargs: Any) -> None:
        """Lets go of the simulator, after a step that is on its way.

        Arrays that were handed out stay readable.
        """
        if self._thread is not None:
            self._thread.shutdown()
        self._sim = self._thread = self._pending = self._pictures = None

    def _handed_out(self, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return array.copy() if self.copy else array

    def _final_infos(self, sim: _core.VecSim) -> dict[str, Any]:
        rows = np.flatnonzero(sim.final_mask)
        if rows.size == 0:
            return {}
        final_obs = np.full(self.num_envs, None, dtype=object)
        for row, observation in zip(rows, sim.final_obs[rows], strict=True):
            final_obs[row] = observation
        mask = sim.final_mask.copy()
        return {"final_obs": final_obs, "_final_obs": mask, "final_info": {}, "_final_info": mask.copy()}

    def _check_mask(self, mask: Any) -> None:
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            found = f"a {mask.dtype} array" if isinstance(mask, np.ndarray) else type(mask).__name__
            raise TypeError(
                f"options['reset_mask'] is {found}; pass a NumPy array of bools, e.g. terminated | truncated"
            )
        if mask.shape != (self.num_envs,):
            raise _core.ConfigError(f"options['reset_mask'] has shape {mask.shape}; it must be ({self.num_envs},)")
        if not mask.any():
            raise _core.ConfigError("options['reset_mask'] selects no env; leave the call out or set at least one True")


def terms_of(terms: "str | os.PathLike[str] | Terms | Sequence[Declared | Memory] | None") -> Terms | None:
    """Terms of a file, or of declarations. Raises ConfigError as `polypod.terms.load`."""
    if terms is None or isinstance(terms, Terms):
        return terms
    if isinstance(terms, str | os.PathLike):
        return load(Path(terms))
    declared = list(declared_by(terms))
    if len(declared) != len(terms):
        raise _core.ConfigError(
            "terms holds what is no declaration; put a decorator of polypod.terms above each function"
        )
    return Terms.of(declared)


def simulator(terms: Terms | None, task: str, num_envs: int, *, play: bool = False, **options: Any) -> _core.VecSim:
    """A `VecSim`, with terms in Python if there are any.

    Args:
        terms: the terms; None: there are none.
        task: as in `VecSim`, and so are `num_envs` and the options.
        num_envs: number of envs.
        play: leave out curricula and the events that are not for play.
        **options: see `VecSim`.

    Raises:
        ConfigError: as `VecSim` and `polypod.python_terms.TermSim`; for options `motions.` of a
            task that tracks no motions.
    """
    changes, own = split(options.get("overrides", ()))
    options["overrides"] = changes
    if terms is None and not own and not observes_motions(task, changes):
        return _core.VecSim(task, num_envs, **options)
    if terms is None or terms.options is not None or own:
        from polypod.motions import tracking  # it needs an extra

        terms = tracking.again(terms, task, options.get("robots"), changes, own)
        options["overrides"] = tracking.widths(terms, changes)
    return TermSim(task, num_envs, terms=terms, play=play, **options)


def override_texts(overrides: Overrides) -> list[str]:
    """`key=value` texts of overrides that may be a mapping, nested or with dotted keys.

    Raises:
        ConfigError: for a value that TOML does not have.
    """
    if isinstance(overrides, str):
        raise _core.ConfigError(f"overrides={overrides!r} is one string; pass a list of them, or a dict")
    if not isinstance(overrides, Mapping):
        return list(overrides)
    texts = []
    for key, value in overrides.items():
        if isinstance(value, Mapping):
            texts += [f"{key}.{inner}" for inner in override_texts(value)]
        else:
            texts.append(f"{key}={'null' if value is None else _toml(value, str(key))}")
    return texts


def _toml(value: Any, key: str) -> str:
    """A value as TOML writes it; NumPy's numbers and arrays count as numbers and lists."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item, key) for item in value)}]"
    if isinstance(value, Mapping):
        inner = (f"{json.dumps(name)} = {_toml(item, key)}" for name, item in value.items())
        return f"{{ {', '.join(inner)} }}"
    raise _core.ConfigError(
        f"overrides[{key!r}] is a {type(value).__name__}; pass a number, a string, a bool, a list or a dict"
    )


def action_bounds(sim: _core.VecSim) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest actions, [num_actions] each: where targets reach the limits of a joint.

    With several robots the wider limits count. Where a joint has no limit, half a turn from the
    default pose counts as one. No bound is beyond what `step` takes.
    """
    low, high = np.zeros(sim.num_actions), np.zeros(sim.num_actions)
    for numbers in simulated.robots(sim).values():
        scale = numbers["action_scale"]
        places = zip(numbers["columns"], numbers["joint_of_slot"], numbers["slot_signs"], strict=True)
        for column, joint, sign in places:
            ends = zip((numbers["lower"][joint], numbers["upper"][joint]), (-np.pi, np.pi), strict=True)
            pose = numbers["default_pose"][joint]
            turns = [turn if end is None else end - pose for end, turn in ends]
            reach = sorted(sign * turn / scale for turn in turns)
            low[column], high[column] = min(low[column], reach[0]), max(high[column], reach[1])
    low, high = np.clip(low, -MAX_ACTION, MAX_ACTION), np.clip(high, -MAX_ACTION, MAX_ACTION)
    return low.astype(np.float32), high.astype(np.float32)


def _float32(actions: Any) -> FloatArray:
    """Actions as the simulator takes them.

    Values beyond float32 become infinite, which the simulator refuses.
    """
    try:
        array = np.asarray(actions)
    except RuntimeError as error:  # torch's word for a tensor that is part of a gradient
        raise TypeError(f"actions are no plain array ({error}); pass actions.detach()") from None
    if array.dtype.kind not in "fiu":
        raise TypeError(f"actions of type {array.dtype} are no numbers; pass an array of floats")
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, dtype=np.float32)


def _render_mode(mode: str | None) -> str | None:
    if mode is not None and mode not in RENDER_MODES:
        raise _core.ConfigError(f"render_mode={mode!r} is not one of {', '.join(RENDER_MODES)}; leave it out for none")
    return mode


def _spec(task: str, num_envs: int, options: "EnvOptions") -> gymnasium.envs.registration.EnvSpec | None:
    """Gymnasium's spec, from which `make_vec` builds the same env.

    None for an unregistered task, such as a path.
    """
    known = {name: entry["name"] for entry in _core.tasks() for name in (entry["name"], *entry["aliases"])}
    registered = gymnasium.registry.get(NAMESPACE + known.get(task, task))
    if registered is None:
        return None
    spec = copy.deepcopy(registered)
    spec.kwargs |= {"num_envs": num_envs, **options}
    return spec


def _autoreset_mode(autoreset: str | AutoresetMode) -> AutoresetMode:
    if isinstance(autoreset, AutoresetMode):
        return autoreset
    if autoreset not in _AUTORESET_MODES:
        raise _core.ConfigError(f"autoreset={autoreset!r} is not one of {', '.join(_AUTORESET_MODES)}")
    return _AUTORESET_MODES[autoreset]


def _index(value: Any, name: str) -> int:
    """`value` as a non-negative int; NumPy's ints count as ints, floats and bools do not."""
    if isinstance(value, bool):
        raise TypeError(f"{name} must be one int, not a bool")
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be one int, not {type(value).__name__}") from None
    if number < 0:
        raise _core.ConfigError(f"{name}={number} is negative; pass zero or a positive number")
    return number


def fresh_seed() -> int:
    """A seed drawn from the operating system."""
    return int(np.random.SeedSequence().generate_state(1)[0])
