"""The loop behind the page: a simulation that is watched and controlled while it runs."""

import contextlib
import dataclasses
import math
import sys
import threading
import time
from collections.abc import Callable, Hashable

import numpy as np
import numpy.typing as npt

from polypod import _core
from polypod.play.player import Player
from polypod.play.plots import History
from polypod.play.viewer import GROUP, NOTHING, Viewer

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Simulated seconds per second."""
HOLD = 4.0
"""Time for which all robots follow one drawn command, s."""
PUSH = 1.0
"""Velocity of a push, m/s."""
PICTURES = 30.0
"""Most frames that are shown in a second."""
FROM_TASK, TOGETHER, OWN = "drawn by the task", "drawn, one for all robots", "my own"
SOURCES = (FROM_TASK, TOGETHER, OWN)
"""Sources of commands."""
MOST_WAITING = 256
"""Actions that wait for the next control step; further ones are dropped."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """Choices of the page: policy, task and robots."""

    policy: str
    """Name of a policy in the list of the page."""
    task: str | None = None
    """Full name; None: the policy's own."""
    robot: str | None = None
    """One robot; None: all of the policy's."""


class Live:
    """A player, its page, and what a user of the page does with them.

    `run` does everything that the page asks for, between two control steps: code that the page
    calls uses `later`. Failures are shown on the page, and the simulation goes on.
    """

    def __init__(
        self,
        player: Player,
        viewer: Viewer,
        build: Callable[[Choice], Player] | None = None,
        choice: Choice | None = None,
        *,
        seed: int = 0,
    ) -> None:
        """Begins with `player`.

        Args:
            player: the simulation.
            viewer: its page.
            build: makes the player of a choice, or raises a PolypodError; None: there is nothing to
                choose.
            choice: what `player` is.
            seed: of drawn commands and pushes.
        """
        self.player, self.viewer = player, viewer
        self.paused = False
        self.speed = 1.0
        self.env = 0
        """Number of the env that is plotted and pushed."""
        self.source = FROM_TASK
        self.own = np.zeros(3)
        """The user's command: forward and left velocity, m/s, and yaw rate, rad/s."""
        self.choice = choice
        self.history = History(player, self.env)
        self.pace = 0.0
        """Simulated seconds per second, over the last second or so."""
        self.changed: Callable[[], None] = lambda: None
        """Called after something was done that the panel shows."""
        self.opened: Callable[[], None] = lambda: None
        """Called after another player was opened."""
        self.shown: Callable[[], None] = lambda: None
        """Called again and again, whether something was simulated or not."""
        self._build = build
        self._draw = np.random.default_rng(seed)
        self._due = 0.0
        self._steps = 0
        self._todo: dict[Hashable, Callable[[], None]] = {}
        self._asked = threading.Condition()

    def later(self, action: Callable[[], None], control: Hashable = None) -> None:
        """Lets `run` do something before its next control step; of any thread.

        Args:
            action: what to do.
            control: what the page used; a newer action of the same control replaces one that still
                waits. None: the action stands for itself.
        """
        with self._asked:
            key = object() if control is None else control
            if key in self._todo or len(self._todo) < MOST_WAITING:
                self._todo.pop(key, None)
                self._todo[key] = action
                self._asked.notify()

    def run(self, seconds: float | None = None) -> None:
        """Steps and shows until so much time was simulated; None: until Ctrl-C."""
        left = None if seconds is None else round(seconds / self.player.step_dt)
        due, shown, since, steps = time.monotonic(), 0.0, time.monotonic(), 0
        while left is None or left > 0:
            self._do(wait=self.paused and not self._steps)
            self.shown()
            if self.paused and not self._steps:
                due = since = time.monotonic()
                steps = 0
                continue
            self._steps = max(0, self._steps - 1)
            self.step()
            steps += 1
            left = None if left is None else left - 1
            now = time.monotonic()
            if self.paused or now - shown >= 1.0 / PICTURES:
                self.viewer.show(self.player.frame())
                shown = now
            if now - since > 0.5:
                self.pace = steps * self.player.step_dt / (now - since)
                since, steps = now, 0
            # a machine that is too slow does not catch up for longer than half a second
            due = max(due + self.player.step_dt / self.speed, time.monotonic() - 0.5)
            time.sleep(max(0.0, due - time.monotonic()))

    def step(self) -> None:
        """One control step, with the command that is due."""
        if self.source == TOGETHER and self.player.time >= self._due:
            self._due = self.player.time + HOLD
            low, high = self.player.ranges.T
            self.player.command(self._draw.uniform(low, high))
        self.player.step()
        self.history.add()

    def pause(self, paused: bool) -> None:
        """Stops or goes on."""
        self.paused = paused
        self.changed()

    def single(self) -> None:
        """Pauses, and takes one control step."""
        self.paused = True
        self._steps += 1
        self.changed()

    def reset(self) -> None:
        """Begins new episodes."""
        self.player.reset()
        self._command()
        self.history.clear()
        self.viewer.show(self.player.frame())

    def push(self) -> None:
        """Pushes the chosen robot, or all where the group is followed, in a random direction."""
        angle = self._draw.uniform(-np.pi, np.pi)
        env = self.env if isinstance(self.viewer.followed, int) else None
        self.player.push((PUSH * np.cos(angle), PUSH * np.sin(angle), 0.0), env)

    def choose_env(self, env: int) -> None:
        """Shows plots of an env, and follows its robot if a single one is followed.

        Raises:
            ConfigError: for an env that there is not.
        """
        self._check_env(env)
        self.env = env
        self.history = History(self.player, env)
        if isinstance(self.viewer.followed, int):
            self.viewer.follow(env)
        self.changed()

    def follow(self, what: int | str) -> None:
        """Lets the view go with a robot, the group or nothing.

        Raises ConfigError for anything else.
        """
        if isinstance(what, int):
            self._check_env(what)
        elif what not in (GROUP, NOTHING):
            raise _core.ConfigError(f"follow {str(what)[:80]!r}: choose a robot, {GROUP!r} or {NOTHING!r}")
        if isinstance(what, int) and what != self.env:
            self.env = what
            self.history = History(self.player, what)
        self.viewer.follow(what)
        self.changed()

    def command_by(self, source: str) -> None:
        """Takes commands from one of `SOURCES`.

        Raises ConfigError for anything else, and for another source than the task where the task
        gives no velocity command.
        """
        if source not in SOURCES:
            raise _core.ConfigError(f"commands from {str(source)[:80]!r}: choose one of {', '.join(SOURCES)}")
        if source != FROM_TASK and not self.player.has_velocity:
            given = ", ".join(self.player.config["commands"]) or "no command"
            raise _core.ConfigError(
                f"commands: {self.player.sim.task_name} gives {given}, and no velocity command (`base_velocity`)"
            )
        self.source = source
        self._command()
        self.changed()

    def steer(self, command: npt.ArrayLike) -> None:
        """The user's own command, within the task's ranges; commands are the user's from then on.

        Raises:
            ConfigError: for a command that is not three finite numbers.
        """
        wanted = np.asarray(command, dtype=np.float64)
        if wanted.shape != (3,) or not np.isfinite(wanted).all():
            raise _core.ConfigError(f"command {wanted.tolist()}: steer with three finite numbers")
        low, high = self.player.ranges.T
        self.own = np.clip(wanted, low, high)
        self.command_by(OWN)

    def run_at(self, speed: float) -> None:
        """Simulated seconds per second from now on.

        Raises ConfigError for a speed that is not above 0.
        """
        if not (math.isfinite(speed) and speed > 0.0):
            raise _core.ConfigError(f"speed {speed}: choose a number above 0")
        self.speed = speed

    def nudge(self, axis: int, share: float) -> None:
        """Changes one number of the user's command by a share of its largest value."""
        change = np.zeros(3)
        change[axis] = share * np.abs(self.player.ranges[axis]).max()
        self.steer(self.own + change)

    def open(self, choice: Choice) -> None:
        """Simulates something else from now on.

        An error is shown on the page and changes nothing.
        """
        if self._build is None or choice == self.choice:
            return
        try:
            player = self._build(choice)
        except _core.PolypodError as error:
            self.viewer.tell("This does not go together", str(error))
            self.opened()
            return
        self.player, self.choice, self.env = player, choice, 0
        self.viewer.open(player, columns_of(player))
        self.history = History(player, 0)
        self.own = np.zeros(3)
        is_kept = player.has_velocity and (self.source != TOGETHER or player.alone)
        self.command_by(self.source if is_kept else FROM_TASK)
        self.opened()

    def _command(self) -> None:
        if self.source == OWN:
            self.player.command(self.own)
        elif self.source == FROM_TASK:
            self.player.command(None)
        self._due = 0.0

    def _check_env(self, env: int) -> None:
        if not 0 <= env < self.player.sim.num_envs:
            raise _core.ConfigError(f"env {env}: the envs are 0 to {self.player.sim.num_envs - 1}")

    def _do(self, wait: bool) -> None:
        """Runs the actions that the page has asked for so far.

        With `wait` it waits a short time for the first one. No action runs elsewhere, and none ends
        the program.
        """
        with self._asked:
            if wait and not self._todo:
                self._asked.wait(timeout=0.05)
            actions, self._todo = list(self._todo.values()), {}
        for action in actions:
            try:
                action()
            except _core.PolypodError as error:
                self._tell(str(error))
            except Exception as error:
                print(f"polypod: a wish of the page failed: {error!r}"[:500], file=sys.stderr, flush=True)
                self._tell(repr(error))

    def _tell(self, problem: str) -> None:
        """Shows on all pages what went wrong."""
        with contextlib.suppress(Exception):  # a page that has just been closed
            self.viewer.tell("This cannot be done", problem)


def columns_of(player: Player) -> int | None:
    """Robots side by side in the opening shot: a block twice as wide as deep; None: no block."""
    if not player.alone:
        return None
    return int(np.ceil(np.sqrt(2.0 * player.sim.num_envs)))
