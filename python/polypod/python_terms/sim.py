"""The simulator of a task with terms in Python."""

import io
import json
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, simulated
from polypod.python_terms.checks import Checks
from polypod.python_terms.declarations import Command, Event, Shown, Terms
from polypod.python_terms.env import TermEnv
from polypod.python_terms.file import failed
from polypod.python_terms.random import EnvRandom

FloatArray = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]
Ids = npt.NDArray[np.int64]

MAGIC = b"polypod terms 1\n"
"""First bytes of a snapshot that holds the memory of terms."""
POLICY = "policy"


def declared_in(config: dict[str, Any]) -> list[tuple[str, str]]:
    """Group and name of the observation terms that a resolved task declares as `external`.

    They are in the order of the observation's columns.
    """
    groups = {key: value for key, value in config["observations"].items() if isinstance(value, list)}
    names = [POLICY, *sorted(key for key in groups if key != POLICY)]
    return [(group, term["term"]) for group in names for term in groups[group] if "external" in term]


class TermSim(_core.VecSim):
    """A `VecSim` whose task has terms in Python: it steps, resets and observes with them.

    A control step is, in this order: commands are sampled where their time is up, and updated;
    interval events; the task's own step, without resets; updates of observations; terminations;
    rewards; metrics; observations. Where episodes have ended under same-step autoreset, these are
    final observations. Then come curricula, the task's own resets, commands and reset events, and
    the observations of the new episodes.
    """

    def __new__(cls, task: str, num_envs: int, *, terms: Terms, play: bool = False, **options: Any) -> "TermSim":
        """Builds the simulator; `__init__` adds the terms."""
        mode = options.pop("autoreset", "same_step")
        if mode == "next_step":
            raise _core.ConfigError(
                "autoreset='next_step' has no place for terms in Python; use same_step or disabled, or leave the terms "
                "out"
            )
        if (share := options.get("share")) is not None and tuple(share) != (0, num_envs):
            raise _core.ConfigError("terms in Python are of simulations in one process; leave out share, or the terms")
        options["overrides"] = terms.in_overrides(list(options.get("overrides", ())))
        build: Any = super().__new__
        sim: TermSim = build(cls, task, num_envs, autoreset="disabled", **options)
        return sim

    def __init__(self, task: str, num_envs: int, *, terms: Terms, play: bool = False, **options: Any) -> None:
        """Begins all episodes with the terms.

        Args:
            task: as in `VecSim`, and so are `num_envs` and the options.
            num_envs: number of envs.
            terms: the terms.
            play: leave out curricula and the events that are not for play.
            **options: see `VecSim`.

        Raises:
            ConfigError: as `VecSim`; for a term that fails, and for one that the task declares and
                `terms` lack.
        """
        self.terms = terms
        self.same_step = options.get("autoreset", "same_step") == "same_step"
        self._checks = Checks(terms.source)
        self._robots = self.robots
        self._blocks = [(robot, *self.env_ids(robot)) for robot in self._robots]
        self._check_robots()
        self._columns = self._find_columns()
        n = self.num_envs
        self._commands = {name: np.zeros((n, term.size), dtype=np.float32) for name, term in terms.commands.items()}
        self._memory = {name: memory.array(n) for name, memory in terms.memories.items()}
        self._random = EnvRandom(self.seed, self._blocks)
        self._events = [event for event in terms.events.values() if event.play or not play]
        self._curricula = [] if play else list(terms.curricula.values())
        timed = [*terms.commands, *(event.name for event in self._events if event.mode == "interval")]
        self._timers = {name: np.zeros(n, dtype=np.float32) for name in timed}
        self._weights = {name: float(term.weight) for name, term in terms.rewards.items()}
        self._rewarded = {name: self._mask(term.robots) for name, term in terms.rewards.items()}
        self._sums = {name: np.zeros(n) for name in terms.rewards}
        self._measured = {name: np.zeros(n) for name in terms.metrics}
        self._steps = np.zeros(n, dtype=np.int64)
        self._finished: dict[str, list[float]] = {}
        self._ends: dict[str, int] = {}
        self._levels: dict[str, float] = {}
        self._changed: dict[str, dict[str, Any]] = {"weights": {}, "ranges": {}}
        self._first: dict[str, dict[str, Any]] = {"weights": {}, "ranges": {}}
        self._reward: FloatArray = super().reward.copy()
        self._terminated: BoolArray = np.zeros(n, dtype=np.bool_)
        self._truncated: BoolArray = np.zeros(n, dtype=np.bool_)
        self._final_mask: BoolArray = np.zeros(n, dtype=np.bool_)
        self._final: dict[str, FloatArray] = {}
        self.seconds: dict[str, float] = {}
        """Time that each term has taken, s, and all control steps together as `step`."""
        self._env = TermEnv(self, self, self._commands, self._memory, self._random)
        self._begin(np.ones(n, dtype=np.bool_), is_startup=True)
        self.seconds.clear()  # preparations are no share of a step

    # -- what VecSim hands out ---------------------------------------------------------------------

    @property
    def observation(self) -> FloatArray:
        """A copy of the observations, [num_envs, num_obs]."""
        return self.observation_of(POLICY)

    def observation_of(self, group: str) -> FloatArray:
        """A copy of an observation group, [num_envs, n]."""
        return np.array(super().observation_of(group))

    @property
    def reward(self) -> FloatArray:
        """Rewards of the last step, those of the terms included, [num_envs]."""
        return self._reward

    @property
    def terminated(self) -> BoolArray:
        """Whether each episode has failed in the last step, [num_envs]."""
        return self._terminated

    @property
    def truncated(self) -> BoolArray:
        """Whether each episode has run out of time in the last step, [num_envs]."""
        return self._truncated

    @property
    def final_obs(self) -> FloatArray:
        """Last observations of ended episodes, [num_envs, num_obs], see `final_mask`."""
        return self.final_obs_of(POLICY)

    def final_obs_of(self, group: str) -> FloatArray:
        """Last observations of a group, [num_envs, n]; valid in the rows of `final_mask`."""
        return self._final[group] if group in self._final else super().final_obs_of(group)

    @property
    def final_mask(self) -> BoolArray:
        """Whether rows of `final_obs` are valid, [num_envs]."""
        return self._final_mask

    # -- stepping ----------------------------------------------------------------------------------

    def step(self, actions: FloatArray) -> None:
        """Advances every env by one control step."""
        started = time.perf_counter()
        n = self.num_envs
        self.before_physics()
        super().step(actions)
        self._final = {}
        ends, causes = self.after_physics()
        self._reward = self._add_rewards(super().reward)
        if ends[False].any():
            super().terminate(ends[False])
        if ends[True].any():
            super().truncate(ends[True])
        self._terminated, self._truncated = super().terminated.copy(), super().truncated.copy()
        self._measure()
        self._observe(None)
        done = self._terminated | self._truncated
        self._final_mask = done if self.same_step else np.zeros(n, dtype=np.bool_)
        if done.any():
            self._log(done, causes)
            if self.same_step:
                self._final = {group: self.observation_of(group) for group in self.observation_groups}
                self._begin(done, ended=np.flatnonzero(done))
        self.seconds["step"] = self.seconds.get("step", 0.0) + time.perf_counter() - started

    def before_physics(self) -> None:
        """First part of a control step: commands and interval events."""
        self._env.refresh()
        for command in self.terms.commands.values():
            due = self._due(command.name)
            if due.size:
                self._sample(command, due)
            self._hook(command, "update", self._env)
        for event in self._events:
            if event.mode == "interval":
                due = self._due(event.name)
                if due.size:
                    self._wait(event.name, event.interval_range_s, due)
                    self._happen(event, due)

    def after_physics(self) -> tuple[dict[bool, BoolArray], dict[str, BoolArray]]:
        """Updates of observations, and ends.

        Returns the envs that the terms end, by whether they time out, and those that each term
        ends.
        """
        self._env.refresh()
        for observation in self.terms.observations.values():
            self._hook(observation, "update", self._env)
        return self.ended()

    def observed(self, group: str = POLICY) -> dict[str, FloatArray]:
        """Present values of the terms that a group observes, [num_envs, width], without noise."""
        return {term.name: self._value(term, width) for term, width in self._columns if (term.group or POLICY) == group}

    def look_at(self, view: TermEnv) -> None:
        """Lets the terms see `view` in the place of the simulator's own state."""
        self._env = view

    def reset(self, seed: int | None = None, mask: BoolArray | None = None, state: Any = None) -> None:
        """Begins new episodes, see `VecSim.reset`."""
        n = self.num_envs
        if mask is not None and (mask.dtype != np.bool_ or mask.shape != (n,) or seed is not None):
            super().reset(seed, mask, state)  # an error that names the argument
        rows = np.ones(n, dtype=np.bool_) if mask is None else mask.copy()
        ended = rows & (self._terminated | self._truncated)
        if seed is not None or self.same_step:  # curricula are told of ends once, and of none after a seed
            ended[:] = False
        self._begin(rows, ended=np.flatnonzero(ended), seed=seed, state=state)
        self._terminated, self._truncated = self._terminated & ~rows, self._truncated & ~rows

    def device_arrays(self) -> None:
        """None: terms in Python take part in each control step, on the host."""
        return

    def step_device(self, stream: int = 0) -> None:
        """Raises ConfigError, see `device_arrays`."""
        raise _core.ConfigError("step_device: terms in Python take part in each control step; call step")

    def terminate(self, mask: BoolArray) -> None:
        """See `VecSim.terminate`."""
        super().terminate(mask)
        self._terminated, self._truncated = self._terminated | mask, self._truncated & ~mask

    def truncate(self, mask: BoolArray) -> None:
        """See `VecSim.truncate`."""
        super().truncate(mask)
        self._truncated = self._truncated | (mask & ~self._terminated)

    def _begin(
        self,
        rows: BoolArray,
        *,
        ended: Ids | None = None,
        seed: int | None = None,
        state: Any = None,
        is_startup: bool = False,
    ) -> None:
        """Begins the episodes of these rows; the curricula are told those that have ended."""
        env, ids = self._env, np.flatnonzero(rows)
        if ended is not None and ended.size:
            env.refresh()
            for curriculum in self._curricula:
                mine = self._own(curriculum.robots, ended)
                if mine.size:
                    self._note(curriculum.name, self._call(curriculum.name, curriculum.function, env, mine))
        if not is_startup:
            super().reset(seed, rows if seed is None else None, state)
        is_startup = is_startup or seed is not None
        env.refresh()
        if is_startup:
            self._random.begin(self.seed)
        for name, memory in self.terms.memories.items():
            if is_startup:
                self._memory[name][:] = memory.fill
            elif memory.per_env and not memory.keep:
                self._memory[name][ids] = memory.fill
        for sums in (*self._sums.values(), *self._measured.values(), self._steps):
            sums[ids] = 0
        if is_startup:
            for event in self._events:
                if event.mode == "startup":
                    self._happen(event, ids)
        for command in self.terms.commands.values():
            self._sample(command, ids)
        for event in self._events:
            if event.mode == "interval":
                self._wait(event.name, event.interval_range_s, ids)
            elif event.mode == "reset":
                self._happen(event, ids)
        for term in (*self.terms.commands.values(), *self.terms.observations.values()):
            self._hook(term, "reset", env, ids)
        self._observe(None if rows.all() else rows)

    # -- the terms ---------------------------------------------------------------------------------

    def _call(self, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Calls a term: errors name file, line and term, and the time is counted."""
        started = time.perf_counter()
        try:
            return function(*arguments)
        except Exception as error:
            raise failed(self.terms.source, self.terms.path, f"the term {name!r} failed", error) from error
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    def _hook(self, term: Shown, hook: str, *arguments: Any) -> None:
        function = term.hooks.get(hook)
        if function is not None:
            self._call(term.name, function, *arguments)

    def _happen(self, event: Event, ids: Ids) -> None:
        mine = self._own(event.robots, ids)
        if mine.size:
            self._call(event.name, event.function, self._env, mine)
            self._env.refresh()

    def _sample(self, command: Command, ids: Ids) -> None:
        self._wait(command.name, command.resampling_time_s, ids)
        what = f"commands[{command.name!r}]"
        value = self._call(command.name, command.function, self._env, ids)
        shape = (ids.size, command.size)
        self._commands[command.name][ids] = self._checks.rows(what, value, shape, np.ones(ids.size, dtype=np.bool_))

    def _wait(self, name: str, times: tuple[float, float] | None, ids: Ids) -> None:
        """Draws the time until a command or an event is due again."""
        low, high = times or (0.0, 0.0)
        if low < high < np.inf:
            self._timers[name][ids] = self._random.uniform(low, high, ids)[:, 0]
        else:
            self._timers[name][ids] = low

    def _due(self, name: str) -> Ids:
        """Lets a control step pass; the rows whose time is up."""
        timer = self._timers[name]
        timer -= np.float32(self.step_dt)
        return np.flatnonzero(timer <= 0.0)

    def ended(self) -> tuple[dict[bool, BoolArray], dict[str, BoolArray]]:
        """Envs that the terms end, by whether they time out, and envs that each term ends."""
        ends, causes = {kind: np.zeros(self.num_envs, dtype=np.bool_) for kind in (False, True)}, {}
        for name, term in self.terms.terminations.items():
            value = self._call(name, term.function, self._env)
            mine = self._checks.flags(f"terminations[{name!r}]", value, self.num_envs)
            causes[name] = mine & self._mask(term.robots)
            ends[term.time_out] |= causes[name]
        return ends, causes

    def _add_rewards(self, rewards: FloatArray) -> FloatArray:
        if not self.terms.rewards:
            return rewards.copy()
        total, valid = rewards.astype(np.float64), self._env.valid
        for name, term in self.terms.rewards.items():
            what = f"rewards[{name!r}]"
            value = self._call(name, term.function, self._env)
            counted = valid & self._rewarded[name] & (self._weights[name] != 0.0)
            value = self._checks.per_env(what, value, counted) * (self._weights[name] * self.step_dt)
            self._checks.finite(f"{what} times its weight and step_dt", value)
            self._sums[name] += value
            total += value
        self._checks.finite("the sum of rewards", total)
        return total.astype(np.float32)

    def _measure(self) -> None:
        self._steps += 1
        for name, term in self.terms.metrics.items():
            value = self._call(name, term.function, self._env)
            self._measured[name] += self._checks.per_env(f"metrics[{name!r}]", value, self._env.valid)

    def _observe(self, mask: BoolArray | None) -> None:
        """Computes the columns of the terms, and writes those of the mask."""
        if not self._columns:
            return
        parts = [self._value(term, width) for term, width in self._columns]
        super().observe_external(np.ascontiguousarray(np.concatenate(parts, axis=1)), mask)

    def _value(self, term: Shown, width: int) -> FloatArray:
        """The columns of a term, [num_envs, width]."""
        if isinstance(term, Command):
            return self._checks_of_command(term)
        value = self._call(term.name, term.function, self._env)
        shape = (self.num_envs, width)
        return self._checks.rows(f"observations[{term.name!r}]", value, shape, self._env.valid)

    def _checks_of_command(self, command: Command) -> FloatArray:
        values = self._commands[command.name]
        return self._checks.rows(f"commands[{command.name!r}]", values, values.shape, self._env.valid)

    @property
    def view(self) -> TermEnv:
        """All envs as the terms see them."""
        return self._env

    # -- what curricula change ---------------------------------------------------------------------

    def episode_reward(self, term: str) -> npt.NDArray[np.float64]:
        """See `TermEnv.episode_reward`."""
        if term in self._sums:
            return self._sums[term].copy()
        sums, is_known = np.zeros(self.num_envs), False
        for robot, start, end in self._blocks:
            names = self.reward_terms(robot)
            if term in names:
                is_known = True
                sums[start:end] = self.reward_sums(robot)[:, names.index(term)]
        if not is_known:
            raise self._unknown_reward(term)
        return sums

    def set_weight(self, term: str, weight: float) -> None:
        """See `TermEnv.set_weight`."""
        if term in self._weights:
            self._checks.finite(f"the weight of {term!r}", np.asarray(weight, dtype=np.float64))
            self._weights[term] = float(weight)
            return
        owners = [robot for robot in self._robots if term in self.reward_terms(robot)]
        if not owners:
            raise self._unknown_reward(term)
        for robot in owners:
            self.set_reward_weight(robot, term, weight)

    def set_reward_weight(self, robot: str, term: str, weight: float) -> None:
        """See `VecSim.set_reward_weight`; here snapshots hold it."""
        before = self.reward_weights(robot).get(term)
        super().set_reward_weight(robot, term, weight)
        key = f"{robot}/{term}"
        self._first["weights"].setdefault(key, before)
        self._changed["weights"][key] = float(weight)

    def set_command_ranges(self, robot: str, **ranges: Sequence[float] | None) -> None:
        """See `VecSim.set_command_ranges`; here snapshots hold them."""
        before = self.command_ranges()[robot] if robot in self._robots else {}
        super().set_command_ranges(robot, **ranges)
        self._first["ranges"].setdefault(robot, {name: list(pair) for name, pair in before.items()})
        self._changed["ranges"][robot] = {name: list(pair) for name, pair in self.command_ranges()[robot].items()}

    def _unknown_reward(self, term: str) -> Exception:
        known = sorted({*self._weights, *(name for robot in self._robots for name in self.reward_terms(robot))})
        return _core.UnknownNameError(f"there is no reward term {term!r}; use one of {', '.join(known)}")

    # -- curves ------------------------------------------------------------------------------------

    def log(self) -> dict[str, float]:
        """The log of the task and of the terms, over episodes ended since the last call.

        `Episode_Reward/<robot>/<term>`: mean sum of the weighted term over an episode, divided by
        the full episode's length in seconds. `Episode_Termination/<robot>/<term>`: how many
        episodes the term ended. `Metrics/<robot>/<term>`: mean over an episode's control steps.
        `Curriculum/<term>`: what a curriculum returned last.
        """
        own = {name: float(np.mean(values)) for name, values in self._finished.items()}
        own |= {name: float(count) for name, count in self._ends.items()}
        self._finished, self._ends = {}, {}
        return {**super().log(), **own, **self._levels}

    def _log(self, done: BoolArray, causes: dict[str, BoolArray]) -> None:
        full = self.max_episode_length * self.step_dt
        for robot, start, end in self._blocks:
            ids = start + np.flatnonzero(done[start:end])
            if not ids.size:
                continue
            for name in self.terms.rewards:
                if self._rewarded[name][start]:
                    self._finished.setdefault(f"Episode_Reward/{robot}/{name}", []).extend(self._sums[name][ids] / full)
            for name, term in self.terms.metrics.items():
                if term.robots is None or robot in term.robots:
                    means = self._measured[name][ids] / np.maximum(self._steps[ids], 1)
                    self._finished.setdefault(f"Metrics/{robot}/{name}", []).extend(means)
            for name, cause in causes.items():
                key = f"Episode_Termination/{robot}/{name}"
                self._ends[key] = self._ends.get(key, 0) + int(cause[ids].sum())

    def _note(self, name: str, value: Any) -> None:
        """Keeps what a curriculum returned for its curve."""
        if value is None:
            return
        for key, number in value.items() if isinstance(value, dict) else [(None, value)]:
            what = f"curricula[{name!r}]" + ("" if key is None else f"[{key!r}]")
            array = self._checks.numbers(what, number)
            if array.ndim:
                raise _core.ConfigError(f"{self._checks.begin}{what} gives shape {array.shape}; return one number")
            self._checks.finite(what, array)
            self._levels[f"Curriculum/{name}" if key is None else f"Curriculum/{name}/{key}"] = float(array)

    def cost(self) -> dict[str, float]:
        """Share of the time of all control steps so far that each term took, the largest first."""
        total = max(self.seconds.get("step", 0.0), 1e-9)
        shares = {name: seconds / total for name, seconds in self.seconds.items() if name != "step"}
        return dict(sorted(shares.items(), key=lambda entry: -entry[1]))

    # -- snapshots ---------------------------------------------------------------------------------

    def snapshot(self, env_ids: Any = None) -> bytes:
        """The simulator's snapshot with the memory of the terms; of all envs."""
        self._check_all(env_ids)
        core, buffer = super().snapshot(), io.BytesIO()
        np.savez(buffer, allow_pickle=False, **self._arrays())
        return b"".join([MAGIC, len(core).to_bytes(8, "little"), core, buffer.getvalue()])

    def restore(self, data: bytes, env_ids: Any = None) -> None:
        """Restores a snapshot of a simulator with the same terms.

        Raises ConfigError for another one; the simulator is then as it was.
        """
        self._check_all(env_ids)
        start = len(MAGIC) + 8
        if not data.startswith(MAGIC) or len(data) < start:
            raise _core.ConfigError(
                f"{self._checks.begin}the snapshot holds no memory of terms; restore it without them, or begin anew"
            )
        end = start + int.from_bytes(data[len(MAGIC) : start], "little")
        own = self._arrays()
        try:
            with np.load(io.BytesIO(data[end:]), allow_pickle=False) as archive:
                found = {name: archive[name] for name in archive.files}
        except Exception as error:  # NumPy and zipfile have many
            raise _core.ConfigError(f"{self._checks.begin}the memory of terms is damaged: {error}") from error
        for name in sorted(own.keys() | found.keys()):
            a, b = own.get(name), found.get(name)
            if a is None or b is None or a.dtype.kind != b.dtype.kind or (name != "texts" and a.shape != b.shape):
                raise _core.ConfigError(
                    f"{self._checks.begin}the snapshot was made with other terms: {name} differs; use the same file"
                )
        texts = json.loads(str(found.pop("texts")))
        super().restore(data[start:end])
        for name, array in found.items():
            own[name][...] = array
        self._random.begin(self.seed)
        self._random.counters[:] = found["random"]
        self._restore_texts(texts)
        self._env.refresh()
        self._final = {}

    def _check_all(self, env_ids: Any) -> None:
        if env_ids is not None:
            raise _core.ConfigError(
                f"{self._checks.begin}env_ids: terms in Python are kept for all envs together; leave env_ids out"
            )

    def _arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All numbers that the next step depends on, by name; `texts` is JSON."""
        kinds = {
            "memory": self._memory,
            "command": self._commands,
            "timer": self._timers,
            "sum": self._sums,
            "metric": self._measured,
        }
        arrays = {f"{kind}/{name}": array for kind, of in kinds.items() for name, array in of.items()}
        texts = {
            "weights": self._weights,
            "changed": self._changed,
            "finished": self._finished,
            "ends": self._ends,
            "levels": self._levels,
        }
        return {
            **arrays,
            "random": self._random.counters,
            "steps": self._steps,
            "reward": self._reward,
            "terminated": self._terminated,
            "truncated": self._truncated,
            "texts": np.array(json.dumps(texts)),
        }

    def _restore_texts(self, texts: dict[str, Any]) -> None:
        """Takes over weights and curves; changes of the task that the snapshot lacks are undone."""
        changed = {kind: {**self._first[kind], **texts["changed"][kind]} for kind in self._first}
        for key, weight in changed["weights"].items():
            robot, term = key.split("/", 1)
            self.set_reward_weight(robot, term, weight)
        for robot, ranges in changed["ranges"].items():
            self.set_command_ranges(robot, **ranges)
        self._changed = texts["changed"]
        self._weights = texts["weights"]
        self._finished, self._ends, self._levels = texts["finished"], texts["ends"], texts["levels"]

    # -- sizes -------------------------------------------------------------------------------------

    def _mask(self, robots: Sequence[str] | None) -> BoolArray:
        """Bool [num_envs], the envs of these robots, or all."""
        mask = np.zeros(self.num_envs, dtype=np.bool_)
        for robot, start, end in self._blocks:
            mask[start:end] = robots is None or robot in robots
        return mask

    def _own(self, robots: Sequence[str] | None, ids: Ids) -> Ids:
        """Rows among `ids` that hold these robots."""
        return ids if robots is None else ids[self._mask(robots)[ids]]

    def _check_robots(self) -> None:
        """Refuses names of robots that do not exist."""
        kinds: dict[str, Iterable[tuple[str, Any]]] = {
            kind: getattr(self.terms, kind).items()
            for kind in ("rewards", "terminations", "observations", "commands", "events", "curricula", "metrics")
        }
        known = {entry["name"] for entry in _core.robots()} | set(self._robots)
        for kind, terms in kinds.items():
            for name, term in terms:
                for robot in term.robots or ():
                    if robot not in known:
                        raise _core.UnknownNameError(
                            f"{self._checks.begin}{kind}[{name!r}].robots: there is no {robot!r} in this env; use "
                            f"{', '.join(self._robots)}"
                        )

    def _find_columns(self) -> list[tuple[Shown, int]]:
        """Terms that fill the columns of the task's caller, with their widths, in their order."""
        by_place = {(term.group, term.name): term for term in self.terms.shown}
        columns = []
        per = {"per_joint": self.num_actions, "per_foot": len(self.feet_names)}
        for group, name in declared_in(simulated.config(self)["task"]):
            term = by_place.get((group, name))
            if term is None and self.terms.options is not None:
                term = self.terms.observations.get(name)
            if term is None:
                raise _core.ConfigError(
                    f"{self._checks.begin}the task observes {name!r} in the group {group!r}, which this file does not "
                    "declare; use the file that the task was made with"
                )
            columns.append((term, term.size * per.get(term.mirror, 1)))
        return columns
