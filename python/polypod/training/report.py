"""Output of a training: a live progress line or plain lines, and tables per robot."""

import contextlib
import dataclasses
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import timedelta

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from polypod.evaluation import CONFIDENCE, Evaluation, Interval, RobotResult, Summary, rising, walking
from polypod.tables import Rows, console_of_output, shown

_PLAIN_INTERVAL_S = 10.0


@dataclasses.dataclass(frozen=True)
class Iteration:
    """One iteration's figures.

    Rewards and lengths (control steps) are means over the last 100 episodes.
    """

    done: int
    total: int
    reward: float
    episode_length: float
    steps_per_second: float


class Reporter:
    """Writes to standard output: live on a terminal, line by line elsewhere."""

    def __init__(self, quiet: bool = False) -> None:
        """Looks at standard output, or shows nothing."""
        self.console = console_of_output()
        self.console.quiet = quiet
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._start = 0
        self._started = self._printed = time.monotonic()

    def message(self, text: str) -> None:
        """Prints one line."""
        self.console.print(text, markup=False)

    @contextlib.contextmanager
    def training(self, start: int, stop: int) -> Iterator[None]:
        """Shows progress from iteration `start` to `stop` while the context lasts."""
        self._start = start
        self._started = self._printed = time.monotonic()
        if not self.console.is_terminal:
            yield
            return
        columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
        with Progress(*columns, console=self.console) as self._progress:
            self._task = self._progress.add_task("", total=stop, completed=start)
            yield
        self._progress = None

    def iteration(self, figures: Iteration) -> None:
        """Shows one finished iteration.

        Elsewhere than on a terminal, the first, the last and one each 10 s.
        """
        now = time.monotonic()
        done = figures.done - self._start
        left = timedelta(seconds=round((now - self._started) / done * (figures.total - figures.done)))
        summary = (
            f"reward {figures.reward:.2f}  length {figures.episode_length:.0f}  "
            f"{figures.steps_per_second:,.0f} steps/s  ETA {left}"
        )
        if self._progress is not None:
            self._progress.update(self._task, completed=figures.done, description=summary)
        elif done == 1 or figures.done == figures.total or now - self._printed >= _PLAIN_INTERVAL_S:
            self._printed = now
            elapsed = timedelta(seconds=round(now - self._started))
            self.message(f"iteration {figures.done}/{figures.total}  {summary}  elapsed {elapsed}")

    def slow_worker(self, index: int, host: str, seconds: float, count: int) -> None:
        """Warns of a worker that keeps the others waiting."""
        self.message(
            f"polypod: warning: worker {index} of {count} on {host} works {seconds:.2f} s an iteration, and the others "
            "wait for it; see Perf/worker_*/work_time in the curves"
        )

    def robots(self, stats: Mapping[str, Mapping[str, float]]) -> None:
        """Prints one line per robot about the episodes that ended lately."""
        table = Rows("robot", "reward/s", "falls", "err xy", "still", "err yaw", "still", "length", "episodes")
        for robot, values in stats.items():
            table.add_row(
                robot,
                f"{values['reward_per_s']:.2f}",
                f"{values['fall_rate']:.1%}",
                f"{values['error_vel_xy']:.3f}",
                f"{values['command_xy']:.3f}",
                f"{values['error_vel_yaw']:.3f}",
                f"{values['command_yaw']:.3f}",
                f"{values['episode_length_s']:.1f} s",
                f"{values['episodes']:.0f}",
            )
        table.print(self.console)

    def evaluation(self, evaluation: Evaluation) -> None:
        """Prints the figures of the deterministic policy per robot, and which robots walk."""
        is_judged = evaluation.commands == "walking"
        units = "turn: share of a pure turn; drift: when told to stop" if is_judged else "power in W, slip in m/s"
        self.message(
            f"deterministic policy, {_conditions(evaluation)} "
            f"(errors in m/s and rad/s; still: the error of a robot that stands still; {units})"
        )
        rows = {robot: (_walking if is_judged else _figures)(result) for robot, result in evaluation.robots.items()}
        table = Rows("robot", *next(iter(rows.values())))
        for robot, row in rows.items():
            table.add_row(robot, *row.values())
        table.print(self.console)
        if is_judged:
            self._verdict(evaluation)
        self._rising(evaluation)
        for robot, distance in evaluation.distances.items():
            self.message(f"  {robot}: its description is {distance}")
        self._tiles(list(evaluation.robots.values()), list(evaluation.robots))

    def _tiles(self, results: Sequence[RobotResult], robots: Sequence[str]) -> None:
        """Prints success by robot, class, type and level of tile, and what feet do on each type."""
        kinds = list(dict.fromkeys(kind for result in results for kind in result.terrain))
        if not kinds:
            return
        self.message("success by type of tile, all levels: no fall, and the commands were followed")
        table = Rows("robot", *kinds, "all")
        for robot, result in zip(robots, results, strict=True):
            table.add_row(robot, *(shown(result.success(kind), ".0%") for kind in (*kinds, None)))
        classes = list(dict.fromkeys(result.robot_class for result in results))
        if len(classes) > 1:
            for name in classes:
                of_class = [result for result in results if result.robot_class == name]
                cells = (_mean([result.success(kind) for result in of_class], ".0%") for kind in (*kinds, None))
                table.add_row(f"{name} ({len(of_class)})", *cells)
        table.print(self.console)
        levels = sorted({tile.level for result in results for tiles in result.terrain.values() for tile in tiles})
        self.message("success by level, mean over the robots")
        table = Rows("level", *kinds, "all")
        for level in levels:
            cells = (_mean([result.success(kind, level) for result in results], ".0%") for kind in (*kinds, None))
            table.add_row(str(level), *cells)
        table.print(self.console)
        self.message(
            "by type of tile, mean over the robots; stumbles: share of the contacts in which a foot meets a wall"
        )
        table = Rows("type", *_OF_TILES)
        for kind in kinds:
            cells = (
                _mean([result.on_tiles(key, kind) for result in results], form) for key, form in _OF_TILES.values()
            )
            table.add_row(kind, *cells)
        table.print(self.console)

    def _verdict(self, evaluation: Evaluation) -> None:
        """Says how many robots walk, and of the others why not."""
        reasons = {
            robot: walking.why_not(result.walking)
            for robot, result in evaluation.robots.items()
            if result.walking is not None
        }
        self.message(f"{sum(not found for found in reasons.values())} of {len(reasons)} walk")
        for robot, found in reasons.items():
            if found:
                self.message(f"  {robot}: {'; '.join(found)}")

    def _rising(self, evaluation: Evaluation) -> None:
        """Prints how well robots get up, in a task that rewards it."""
        found = {robot: result.rising for robot, result in evaluation.robots.items() if result.rising is not None}
        if not found:
            return
        self.message(
            f"up: within {math.degrees(rising.TILT):.0f} degrees of the direction that the task rewards, at "
            f"{rising.HEIGHT:.0%} of its height; held: the longest time up"
        )
        table = Rows("robot", f"up within {rising.WITHIN_S:g} s", "after", "held", "held by 95 %")
        for robot, figures in found.items():
            after = "-" if math.isnan(figures.time_s) else f"{figures.time_s:.1f} s"
            held = f"{figures.held_s:.1f} s", f"{figures.least_held_s:.1f} s"
            table.add_row(robot, f"{figures.rate:.1%}", after, *held)
        table.print(self.console)

    def summary(self, summary: Summary) -> None:
        """Prints means and intervals over seeds per robot."""
        first, seeds = summary.evaluations[0], len(summary.evaluations)
        self.message(f"{seeds} policies, {_conditions(first)}: mean and {CONFIDENCE:.0%} interval (Student's t)")
        columns = {
            "err xy": ("error_vel_xy", ".3f"),
            "still": ("still_error_vel_xy", ".3f"),
            "err yaw": ("error_vel_yaw", ".3f"),
            "still yaw": ("still_error_vel_yaw", ".3f"),
        }
        is_judged = first.commands == "walking"
        if is_judged:
            columns |= {
                "turn": ("turn_reached", ".0%"),
                "drift": ("drift_xy", ".3f"),
                "yaw drift": ("drift_yaw", ".3f"),
                "falls": ("fall_rate", ".1%"),
            }
        else:
            columns |= {
                "falls": ("fall_rate", ".1%"),
                "success": ("success_rate", ".1%"),
                "CoT": ("cost_of_transport", ".2f"),
                "slip": ("foot_slip", ".2f"),
            }
        table = Rows("robot", *columns, *(["walks"] if is_judged else []))
        for robot, figures in summary.robots.items():
            cells = [with_interval(figures[key], form) for key, form in columns.values()]
            if is_judged:
                results = [each.robots[robot].walking for each in summary.evaluations]
                walked = sum(result is not None and walking.walks(result) for result in results)
                cells.append(f"{walked} of {seeds}")
            table.add_row(robot, *cells)
        table.print(self.console)


def walking_cells(figures: walking.Walking) -> dict[str, str]:
    """The cells of a table of walking, by their headers."""
    return {
        "err xy": f"{figures.error_vel_xy:.3f}",
        "still": f"{figures.still_error_vel_xy:.3f}",
        "err yaw": f"{figures.error_vel_yaw:.3f}",
        "still yaw": f"{figures.still_error_vel_yaw:.3f}",
        "turn": shown(figures.turn_reached, ".0%"),
        "drift": shown(figures.drift_xy, ".3f"),
        "yaw drift": shown(figures.drift_yaw, ".3f"),
        "falls": f"{figures.fall_rate:.1%}",
        "walks": "yes" if walking.walks(figures) else "no",
    }


_OF_TILES = {
    "falls": ("fall_rate", ".1%"),
    "slip": ("foot_slip", ".2f"),
    "stumbles": ("stumbles", ".1%"),
    "power": ("power", ".0f"),
}


def _mean(values: Sequence[float], form: str) -> str:
    """The mean of the values that are numbers; a dash where none is."""
    met = [value for value in values if not math.isnan(value)]
    return format(sum(met) / len(met), form) if met else "-"


def _walking(result: RobotResult) -> dict[str, str]:
    return walking_cells(result.walking) if result.walking is not None else _figures(result)


def _figures(result: RobotResult) -> dict[str, str]:
    return {
        "reward/s": f"{result.reward_per_s:.2f}",
        "err xy": f"{result.error_vel_xy:.3f}",
        "still": f"{result.still_error_vel_xy:.3f}",
        "err yaw": f"{result.error_vel_yaw:.3f}",
        "still yaw": f"{result.still_error_vel_yaw:.3f}",
        "falls": f"{result.fall_rate:.1%}",
        "length": f"{result.episode_length_s:.1f} s",
        "power": f"{result.power:.0f}",
        "CoT": f"{result.cost_of_transport:.2f}",
        "slip": f"{result.foot_slip:.2f}",
    }


def with_interval(interval: Interval, form: str) -> str:
    """The mean, and how far the interval reaches to either side."""
    if math.isnan(interval.mean):
        return "-"
    if interval.seeds < 2:
        return format(interval.mean, form)
    return f"{interval.mean:{form}} ±{interval.high - interval.mean:{form}}"


def _conditions(evaluation: Evaluation) -> str:
    randomized = f", {_named(evaluation.disturbances)}" if evaluation.randomized else ""
    grid = f", {'x'.join(map(str, evaluation.grid))} commands" if evaluation.grid is not None else ""
    drawn = {"walking": f", a new command every {walking.SEGMENT_S:g} s", "task": ", commands of the task"}
    commands = grid or drawn.get(evaluation.commands, "")
    return f"{evaluation.task}, {evaluation.num_envs} envs, {evaluation.duration_s:g} s{randomized}{commands}"


def _named(disturbances: Sequence[str]) -> str:
    """Names of the disturbances: `events.push_robot.enabled` is push_robot."""
    names = [key.removeprefix("events.").removesuffix(".enabled") for key in disturbances]
    noisy, pushed = "observations.enable_noise" in names, "push_robot" in names
    others = [name for name in names if name not in ("observations.enable_noise", "push_robot")]
    if not names or (noisy and pushed and others):
        return "randomised and pushed"
    return f"with {', '.join([*(['noise'] if noisy else []), *(['pushes'] if pushed else []), *others])}"
