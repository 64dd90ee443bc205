"""The page's buttons, sliders, plots and keys."""

import functools
import time
from collections.abc import Callable, Hashable, Sequence
from typing import Any

from polypod import _core
from polypod.play.gate import offers
from polypod.play.live import OWN, SOURCES, SPEEDS, Choice, Live
from polypod.play.plots import AXES
from polypod.play.viewer import GROUP, NOTHING

REFRESH = 0.2
"""Time between two drawings of a plot, s."""
ALL = "all"
"""Every robot of the policy."""
OWN_TASK = "the policy's own"
"""The task that the policy was trained in."""
STEP = 0.1
"""A key changes a command by this share of its largest value."""
COMMAND_COLOR, VELOCITY_COLOR = "#20a048", "#3a6ed6"
COLORS = ("#3a6ed6", "#e0943e", "#20a048", "#d63c3c", "#8a5cc8", "#1d9aa8", "#b8860b", "#d6589c", "#6b7280", "#7cb342")
"""Colours of the reward terms, in turn."""
KEYS = (
    ("space", "Pause or go on"),
    ("N", "One control step"),
    ("R", "Reset"),
    ("P", "Push"),
    ("F", "Frame what is followed"),
    ("I", "Faster forward"),
    ("K", "Faster backward"),
    ("J", "Turn left"),
    ("L", "Turn right"),
    ("U", "Step left"),
    ("O", "Step right"),
    ("0", "Stand still"),
)
"""Key and what it does. W, A, S, D, Q, E and the arrows move viser's camera."""


class Panel:
    """The controls of a `Live`."""

    def __init__(self, live: Live, policies: Sequence[str] = (), tasks: Sequence[str] = ()) -> None:
        """Adds everything to the page.

        Args:
            live: what is controlled.
            policies: names to choose from.
            tasks: full names to choose from.
        """
        self.live = live
        self._drawn = 0.0
        self._show_choice: Callable[[], None] = lambda: None
        gui = live.viewer.gui
        # viser's button to share would open a tunnel from the internet
        gui.configure_theme(control_width="medium", dark_mode=False, show_share_button=False)
        gui.set_panel_label("polypod")
        self._status = gui.add_markdown("")
        self._run(gui)
        self._command(gui)
        self._view(gui)
        if policies:
            self._choice(gui, policies, tasks)
        self._plots: list[Any] = []
        self._rewards: Any = None
        with gui.add_folder("Command and velocity") as self._velocity_folder:
            pass
        with gui.add_folder("Reward terms (per second)") as self._reward_folder:
            pass
        self._add_plots()
        self._add_keys(gui)
        live.changed = self.refresh
        live.opened = self._opened
        live.shown = self.tick
        self.refresh()

    def tick(self) -> None:
        """Draws what has changed, a few times a second."""
        now = time.monotonic()
        if now - self._drawn < REFRESH:
            return
        self._drawn = now
        live = self.live
        state = "paused" if live.paused else f"{live.pace:.2f} x real time"
        self._status.content = f"**{live.player.sim.task_name}**  \n{live.player.time:.1f} s, {state}"
        for axis, plot in enumerate(self._plots):
            plot.data = live.history.velocities(axis)
        self._rewards.data = live.history.rewards()

    def refresh(self) -> None:
        """Shows what `live` is set to."""
        live = self.live
        self._source.value = live.source
        for slider, value in zip(self._sliders, live.own, strict=True):
            slider.value = float(value)
            slider.disabled = live.source != OWN
        self._follow.value = self._followed()
        self._env.value = self._envs()[live.env]
        if (live.history.robot, live.env) != self._plotted:
            self._add_plots()

    def _run(self, gui: Any) -> None:
        live = self.live
        with gui.add_folder("Simulation"):
            buttons = gui.add_button_group("do", ("pause", "step", "reset", "push"), hint="keys: space, N, R, P")
            actions = {
                "pause": lambda: live.pause(not live.paused),
                "step": live.single,
                "reset": live.reset,
                "push": live.push,
            }
            live.viewer.gate.offer(buttons)
            buttons.on_click(lambda event: live.later(actions[event.target.value]))
            speeds = {f"{speed:g} x": speed for speed in SPEEDS}
            speed = gui.add_dropdown("speed", list(speeds), initial_value="1 x")
            self._on_update(speed, lambda value: live.run_at(speeds[value]))

    def _command(self, gui: Any) -> None:
        live = self.live
        with gui.add_folder("Command"):
            self._source = gui.add_dropdown("from", SOURCES, initial_value=live.source)
            self._on_update(self._source, live.command_by)
            self._sliders = [
                gui.add_slider(name, min=float(low), max=float(high), step=0.05, initial_value=0.0)
                for name, (low, high) in zip(AXES, _wide(live.player.ranges), strict=True)
            ]
            for slider in self._sliders:
                self._on_update(slider, lambda _: live.steer([slider.value for slider in self._sliders]))

    def _view(self, gui: Any) -> None:
        live, viewer = self.live, self.live.viewer
        with gui.add_folder("View"):
            self._env = gui.add_dropdown("env", self._envs())
            self._on_update(self._env, lambda value: live.choose_env(self._envs().index(value)))
            self._follow = gui.add_dropdown("follow", [GROUP, NOTHING, *self._envs()], initial_value=self._followed())
            self._on_update(self._follow, self._follow_by_name)
            self._on_click(gui.add_button("Frame it (F)"), lambda: live.follow(viewer.followed))
            for label, name in (
                ("names", "names"),
                ("velocity arrows", "velocity"),
                ("contact forces", "forces"),
                ("height scan", "scan"),
            ):
                box = gui.add_checkbox(label, initial_value=getattr(viewer, f"shows_{name}"))
                self._on_update(box, functools.partial(self._show, name))

    def _show(self, name: str, shown: bool) -> None:
        viewer = self.live.viewer
        if name == "names":
            viewer.show_names(shown)
        else:
            setattr(viewer, f"shows_{name}", shown)
            viewer.show(self.live.player.frame())

    def _choice(self, gui: Any, policies: Sequence[str], tasks: Sequence[str]) -> None:
        live = self.live
        choice = live.choice or Choice(policies[0])
        with gui.add_folder("Policy, task and robots"):
            policy = gui.add_dropdown("policy", list(policies), initial_value=choice.policy)
            task = gui.add_dropdown("task", self._tasks(tasks), initial_value=choice.task or OWN_TASK)
            robot = gui.add_dropdown("robots", self._robots(), initial_value=choice.robot or ALL)

        def opened() -> None:
            now = live.choice or choice
            robot.options = self._robots()
            policy.value, task.value, robot.value = now.policy, now.task or OWN_TASK, now.robot or ALL

        def choose(_: Any) -> None:
            known = live.choice
            # the list of robots may have changed since the page sent its choice
            if not all(offers(handle, handle.value) for handle in (policy, task, robot)):
                opened()
                return
            # another policy begins with its own task and robots
            same = known is not None and known.policy == policy.value
            live.open(
                Choice(
                    policy.value,
                    task.value if same and task.value != OWN_TASK else None,
                    robot.value if same and robot.value != ALL else None,
                )
            )

        self._show_choice = opened
        for handle in (policy, task, robot):
            self._on_update(handle, choose, "choice")

    def _tasks(self, tasks: Sequence[str]) -> list[str]:
        """The tasks to choose from, with the one that the command line named."""
        given = self.live.choice.task if self.live.choice is not None else None
        return [OWN_TASK, *([given] if given is not None and given not in tasks else []), *tasks]

    def _robots(self) -> list[str]:
        """Names of the policy's robots, then of robots that it may not know.

        The page then says so.
        """
        own = list(self.live.player.policy_robots)
        choice = self.live.choice
        if choice is not None and choice.robot is not None and choice.robot not in own:
            own.append(choice.robot)
        return [ALL, *own, *(entry["name"] for entry in _core.robots() if entry["name"] not in own)]

    def _opened(self) -> None:
        """Shows another player."""
        self._show_choice()
        self._env.options = self._envs()
        self._follow.options = [GROUP, NOTHING, *self._envs()]
        for slider, (low, high) in zip(self._sliders, _wide(self.live.player.ranges), strict=True):
            slider.value = 0.0
            slider.min, slider.max = float(low), float(high)
        self._add_plots()
        self.refresh()

    def _add_plots(self) -> None:
        """Plots of the chosen env, in place of those of another."""
        gui, history = self.live.viewer.gui, self.live.history
        for plot in [*self._plots, self._rewards]:
            if plot is not None:
                plot.remove()
        self._plotted = (history.robot, self.live.env)
        with self._velocity_folder:
            series = ({"label": "s"}, _line("command", COMMAND_COLOR), _line("velocity", VELOCITY_COLOR))
            self._plots = [
                gui.add_uplot(history.velocities(axis), series, title=name, height=130, scales=_scales())
                for axis, name in enumerate(AXES)
            ]
        with self._reward_folder:
            lines = [_line(term, COLORS[place % len(COLORS)]) for place, term in enumerate(history.terms)]
            title = f"{self.live.env}: {history.robot}"
            self._rewards = gui.add_uplot(
                history.rewards(), ({"label": "s"}, *lines), title=title, height=260, scales=_scales()
            )

    def _add_keys(self, gui: Any) -> None:
        live = self.live
        actions: dict[str, Callable[[], None]] = {
            "space": lambda: live.pause(not live.paused),
            "N": live.single,
            "R": live.reset,
            "P": live.push,
            "F": lambda: live.follow(live.viewer.followed),
            "0": lambda: live.steer((0.0, 0.0, 0.0)),
        }
        for key, axis, share in (
            ("I", 0, STEP),
            ("K", 0, -STEP),
            ("U", 1, STEP),
            ("O", 1, -STEP),
            ("J", 2, STEP),
            ("L", 2, -STEP),
        ):
            actions[key] = functools.partial(live.nudge, axis, share)
        for key, label in KEYS:
            command = gui.add_command(label, hotkey=key)
            live.viewer.gate.offer_key(command)
            command.on_trigger(lambda _, action=actions[key]: live.later(action))

    def _envs(self) -> list[str]:
        return [f"{index}: {robot.name}" for index, robot in enumerate(self.live.viewer.frame.robots)]

    def _followed(self) -> str:
        followed = self.live.viewer.followed
        return self._envs()[followed] if isinstance(followed, int) else followed

    def _follow_by_name(self, name: str) -> None:
        self.live.follow(name if name in (GROUP, NOTHING) else self._envs().index(name))

    def _on_click(self, button: Any, action: Callable[[], None]) -> None:
        self.live.viewer.gate.offer(button)
        button.on_click(lambda _: self.live.later(action))

    def _on_update(self, handle: Any, action: Callable[[Any], None], control: Hashable = None) -> None:
        """Calls `action` with a value that a page has set, and not with one that `refresh` has.

        The gate lets pages send values that the control offers. Between that and the call, another
        player may have been opened: a value that is not offered any more is dropped.

        Args:
            handle: the control.
            action: is called by `Live.run`.
            control: controls of the same name replace each other's actions that still wait. None:
                the control itself.
        """

        def act() -> None:
            if offers(handle, handle.value):
                action(handle.value)

        def updated(event: Any) -> None:
            if event.client_id is not None:
                self.live.later(act, id(handle) if control is None else control)

        self.live.viewer.gate.offer(handle)
        handle.on_update(updated)


def _wide(ranges: Any) -> list[tuple[float, float]]:
    """Ranges of sliders: a task with one value only still gets a range to slide along."""
    return [(float(low), float(high)) if high > low else (float(low), float(low) + 0.05) for low, high in ranges]


def _line(label: str, color: str) -> dict[str, Any]:
    return {"label": label, "stroke": color, "width": 2}


def _scales() -> dict[str, Any]:
    return {"x": {"time": False}}
