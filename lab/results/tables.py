"""The tables of a folder of results, in Markdown."""

import math
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lab.results.runs import Results, Run, final, reached, smoothed
from polypod import _core
from polypod.evaluation import CONFIDENCE, Evaluation, RobotResult, command, walking
from polypod.evaluation.seeds import Interval, interval
from polypod.provenance import Measured, sentence
from polypod.text import markdown_table

FIGURES = {
    "error_vel_xy": ("velocity error (m/s)", ".3f"),
    "still_error_vel_xy": ("still (m/s)", ".3f"),
    "error_vel_yaw": ("yaw rate error (rad/s)", ".3f"),
    "still_error_vel_yaw": ("still (rad/s)", ".3f"),
    "fall_rate": ("falls per episode", ".1%"),
    "tracking_reward": ("tracking reward", ".3f"),
    "power": ("power (W)", ".0f"),
    "cost_of_transport": ("cost of transport", ".2f"),
    "foot_slip": ("foot slip (m/s)", ".2f"),
}
"""Figures of an evaluation, how they are called and written."""
SCORE_TAG = "Metrics/{robot}/error_vel_xy"
"""Tag of the curve that tells how long a training takes: the exploring policy's velocity error."""
SMOOTHING = 10
"""Iterations over which a curve is averaged before it counts as having reached a score."""
_LEGEND = f"±: {CONFIDENCE:.0%} interval over the policies of a group, by Student's t."
_WIDTH = 100
_DRAWN = {
    "task": "commands as the task draws them",
    "walking": f"a new command every {walking.SEGMENT_S:g} s, with pure turns, side-steps and stops",
}
WALKING = {
    "turn_reached": ("turn", ".0%"),
    "side_reached": ("side-step", ".0%"),
    "drift_xy": ("drift (m/s)", ".3f"),
    "drift_yaw": ("drift (rad/s)", ".3f"),
}
"""Figures of `polypod.evaluation.walking` that stand next to `FIGURES`."""
_TRANSFERS = {
    True: "A robot transfers if it walks in MuJoCo.",
    False: "A robot transfers if it falls in at most 5 % of the episodes in MuJoCo and its planar error there is at "
    "most 0.1 m/s above polypod's.",
}
"""By whether the files hold the figures of walking: those of builds before it judge by another
bound."""
COMPARED = {
    "error_vel_xy": ("err xy", ".3f"),
    "error_vel_yaw": ("err yaw", ".3f"),
    "fall_rate": ("falls", ".1%"),
}
"""Figures that stand side by side for several groups."""

Condition = tuple[str, bool, tuple[int, int, int] | None, float, tuple[str, ...], str]


def document(results: Results, score: float, baseline: str | None) -> str:
    """All tables.

    Args:
        results: a folder's content.
        score: velocity error, m/s, whose reaching is counted in iterations.
        baseline: group whose final error is the score instead, robot by robot.

    Raises:
        ConfigError: for a baseline that is no group with curves.
    """
    parts = [_trainings(results)] if any(run.manifest for run in results.runs) else []
    for condition in _conditions(results.runs):
        parts.append(_evaluations(results, condition))
    if any(run.curves for run in results.runs):
        parts.append(_reached(results, score, baseline))
    elif baseline is not None:
        raise _core.ConfigError(f"--baseline {baseline}, but no run has curves: copy the events.out.tfevents files")
    if results.sim2sim:
        order = [robot for run in results.runs for each in run.evaluations.values() for robot in each.robots]
        parts.append(_sim2sim(results.sim2sim, list(dict.fromkeys(order))))
    text = "\n\n".join(parts)
    return f"{_LEGEND}\n\n{text}" if "±" in text else text


def _with_interval(found: Interval, form: str) -> str:
    if math.isnan(found.mean):
        return "-"
    reach = found.high - found.mean
    return format(found.mean, form) if found.seeds < 2 else f"{found.mean:{form}} ±{reach:{form}}"


def _trainings(results: Results) -> str:
    """One row per group: what its runs have in common, and the range of what they do not."""
    rows = []
    for group, runs in results.groups.items():
        known = [run for run in runs if run.manifest is not None]
        if not known:
            continue
        manifests = [run.manifest for run in known if run.manifest is not None]
        samples = [run.iterations * run.samples_per_iteration / 1e6 for run in known]
        rows.append(
            (
                group,
                ", ".join(dict.fromkeys(f"`{manifest['task']}`" for manifest in manifests)),
                _range([len(run.robots) for run in known]),
                str(len(known)),
                ", ".join(dict.fromkeys(str(run.seed) for run in known)),
                _range([run.iterations for run in known]),
                _range(samples),
                _range([run.minutes for run in known]),
                ", ".join(dict.fromkeys(_commit(manifest) for manifest in manifests)),
            )
        )
    head = ("group", "task", "robots", "runs", "seed", "iterations", "million samples", "minutes", "commit")
    return "### Trainings\n\n" + markdown_table(head, rows)


def _range(values: Sequence[float]) -> str:
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return "-"
    ends = dict.fromkeys(f"{end:.0f}" for end in (min(known), max(known)))
    return " to ".join(ends)


def _commit(manifest: dict[str, Any]) -> str:
    git = manifest.get("git")
    return f"{git['commit'][:9]}{'+' * git['dirty']}" if git else "-"


def condition_of(evaluation: Evaluation) -> Condition:
    """Settings that two evaluations must share to be compared."""
    return (
        evaluation.task,
        evaluation.randomized,
        evaluation.grid,
        evaluation.duration_s,
        tuple(evaluation.overrides),
        evaluation.commands,
    )


def _conditions(runs: Sequence[Run]) -> list[Condition]:
    return list(dict.fromkeys(condition_of(each) for run in runs for each in run.evaluations.values()))


def _title(condition: Condition) -> str:
    task, randomized, grid, _, overrides, commands = condition
    parts = [f"`{task}`"]
    parts += [f"{'x'.join(map(str, grid))} commands"] if grid else []
    parts += ["walking"] if commands == "walking" else []
    parts += ["randomised"] if randomized else []
    parts += [f"{len(overrides)} change{'s' * (len(overrides) > 1)} to the task"] if overrides else []
    return ", ".join(parts)


def _conditions_of(condition: Condition) -> str:
    _, randomized, grid, duration, overrides, commands = condition
    parts = [f"Episodes of {duration:g} s"]
    parts.append("noise, pushes and randomisation as in training" if randomized else "no noise, no pushes")
    parts.append("each holds one command of the grid" if grid else _DRAWN[commands])
    parts += [f"`{change}`" for change in overrides]
    return ", ".join(parts) + "."


def _wrapped(text: str) -> str:
    return textwrap.fill(text, _WIDTH, break_long_words=False, break_on_hyphens=False)


def _origins(found: Sequence[tuple[str, Measured | None]]) -> str:
    """When and where groups were measured, each sentence with the groups that it is about.

    Empty if no file says.
    """
    groups: dict[str, list[str]] = {}
    for group, origin in found:
        if origin is not None:
            groups.setdefault(sentence(origin), []).append(group)
    if len(groups) < 2:
        return "".join(groups)
    return " ".join(f"{', '.join(dict.fromkeys(names))}: {text[0].lower()}{text[1:]}" for text, names in groups.items())


def _found(results: Results, condition: Condition, seen: bool) -> dict[str, dict[str, list[RobotResult]]]:
    """Figures by group and robot, of robots in the training, or of robots it never saw."""
    found: dict[str, dict[str, list[RobotResult]]] = {}
    for run in results.runs:
        for evaluation in run.evaluations.values():
            if condition_of(evaluation) != condition:
                continue
            for robot, result in evaluation.robots.items():
                if (robot in _trained_on(run, evaluation)) == seen:
                    found.setdefault(run.group, {}).setdefault(robot, []).append(result)
    return found


def _trained_on(run: Run, evaluation: Evaluation) -> list[str]:
    return list(evaluation.checkpoint["robots"]) if evaluation.checkpoint else run.robots


def _evaluations(results: Results, condition: Condition) -> str:
    alike = [
        (run.group, each)
        for run in results.runs
        for each in run.evaluations.values()
        if condition_of(each) == condition
    ]
    origins = _origins([(group, each.measured) for group, each in alike])
    parts = [f"### {_title(condition)}", _wrapped(f"{_conditions_of(condition)} {origins}".strip())]
    seen, unseen = (_found(results, condition, kind) for kind in (True, False))
    if seen:
        parts += _by_robot(seen)
        parts += _terrain(seen)
        parts += _against_specialists(results, seen)
    if unseen:
        parts.append("Robots that the policy was not trained on. *Up* is the share of episodes without a fall.")
        columns: dict[str, Callable[[RobotResult], float]] = {
            "up": lambda result: 1.0 - result.fall_rate,
            "velocity error (m/s)": lambda result: result.error_vel_xy,
        }
        forms = {"up": ".0%", "velocity error (m/s)": ".3f"}
        head = ["robot", *(f"{group}: {name}" for group in unseen for name in columns)]
        rows = []
        for robot in _robots(unseen):
            cells = [robot]
            for group in unseen:
                for name, read in columns.items():
                    cells.append(_cell([read(result) for result in unseen[group].get(robot, [])], forms[name]))
            rows.append(cells)
        parts.append(markdown_table(head, rows))
    commands: dict[str, list[str]] = {}
    for group, each in alike:
        commands.setdefault(group, []).append(command(each))
    parts.append(_first_of_each(commands))
    return "\n\n".join(parts)


def _first_of_each(commands: dict[str, list[str]]) -> str:
    """A block with one command of each group, and how many more there are."""
    lines = ["```bash"]
    for group, found in commands.items():
        lines.append(found[0])
        others = len(dict.fromkeys(found)) - 1
        lines += [f"# {others} more of {group}, likewise"] if others else []
    return "\n".join([*lines, "```"])


def _robots(found: dict[str, dict[str, list[RobotResult]]]) -> list[str]:
    return list(dict.fromkeys(robot for robots in found.values() for robot in robots))


def _cell(values: Sequence[float], form: str) -> str:
    return _with_interval(interval(values), form) if values else "-"


def _by_robot(found: dict[str, dict[str, list[RobotResult]]]) -> list[str]:
    def values(group: str, robot: str, key: str) -> list[float]:
        return [getattr(result, key) for result in found[group].get(robot, [])]

    of_other_robots = len({tuple(robots) for robots in found.values()}) > 1
    of_walking = {group: all(_judged(results) for results in robots.values()) for group, robots in found.items()}
    if of_other_robots and all(of_walking.values()):
        # policies of different bodies, each judged: a table each
        return [part for group, robots in found.items() for part in _by_robot({group: robots})]
    if len(found) == 1:
        (group,) = found
        judged = of_walking[group]
        extra = [*(label for label, _ in WALKING.values()), "walks"] if judged else []
        head = ["robot", "episodes", *(label for label, _ in FIGURES.values()), *extra]
        rows = []
        for robot, results in found[group].items():
            episodes = str(sum(result.episodes for result in results))
            figures = (_cell(values(group, robot, key), form) for key, (_, form) in FIGURES.items())
            rows.append([robot, episodes, *figures, *(_walking(results) if judged else [])])
        return [f"Group {group}, {_seeds(found[group])}:", markdown_table(head, rows)]
    rows = []
    for robot in _robots(found):
        row = [robot]
        for group in found:
            row += [_cell(values(group, robot, key), form) for key, (_, form) in COMPARED.items()]
            row += [_walking(found[group].get(robot, []))[-1]] if of_walking[group] else []
        rows.append(row)
    heads = [
        f"{group}: {label}"
        for group in found
        for label in (*(label for label, _ in COMPARED.values()), *(["walks"] if of_walking[group] else []))
    ]
    groups = ", ".join(f"{group} ({_seeds(robots)})" for group, robots in found.items())
    return [
        _wrapped(f"Velocity error (m/s), yaw rate error (rad/s) and falls per episode of {groups}:"),
        markdown_table(["robot", *heads], rows),
    ]


def _judged(results: Sequence[RobotResult]) -> bool:
    return all(result.walking is not None for result in results)


def _walking(results: Sequence[RobotResult]) -> list[str]:
    """The cells of `WALKING`, and whether the robot walks or under how many policies."""
    found = [result.walking for result in results if result.walking is not None]
    walked = sum(map(walking.walks, found))
    verdict = "-" if not found else ("yes" if walked else "no") if len(found) == 1 else f"{walked} of {len(found)}"
    return [*(_cell([getattr(each, key) for each in found], form) for key, (_, form) in WALKING.items()), verdict]


def _seeds(robots: dict[str, list[RobotResult]]) -> str:
    counts = sorted({len(results) for results in robots.values()})
    text = "-".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    return f"{text} polic{'y' if counts == [1] else 'ies'}"


def _terrain(found: dict[str, dict[str, list[RobotResult]]]) -> list[str]:
    parts = []
    for group, robots in found.items():
        results = [result for entries in robots.values() for result in entries]
        kinds = list(dict.fromkeys(kind for result in results for kind in result.terrain))
        if not kinds:
            continue
        levels = sorted({tile.level for result in results for tiles in result.terrain.values() for tile in tiles})
        rows = [
            [robot, *(_share(entries, kind, None) for kind in kinds), _share(entries, None, None)]
            for robot, entries in robots.items()
        ]
        parts += [
            f"Success by type of tile, group {group}, all levels:",
            markdown_table(["robot", *kinds, "all"], rows),
        ]
        rows = [
            [str(level), *(_share(results, kind, level) for kind in kinds), _share(results, None, level)]
            for level in levels
        ]
        parts += [
            f"Success by level, group {group}, mean over the robots:",
            markdown_table(["level", *kinds, "all"], rows),
        ]
    return parts


def _share(results: Sequence[RobotResult], kind: str | None, level: int | None) -> str:
    shares = [share for result in results if not math.isnan(share := result.success(kind, level))]
    return f"{np.mean(shares):.0%}" if shares else "-"


def _against_specialists(results: Results, found: dict[str, dict[str, list[RobotResult]]]) -> list[str]:
    """Tracking reward of policies for several robots over that of policies for one."""
    alone = [group for group, runs in results.groups.items() if all(len(run.robots) == 1 for run in runs)]
    specialists = [group for group in alone if group in found]
    others = [group for group in found if group not in alone]
    if not specialists or not others:
        return []
    rows = []
    for robot in _robots(found):
        cells = [robot]
        for special in specialists:
            for group in others:
                pair = [[r.tracking_reward for r in found[name].get(robot, [])] for name in (group, special)]
                ratio = np.mean(pair[0]) / np.mean(pair[1]) if all(pair) else math.nan
                cells.append("-" if math.isnan(ratio) else f"{ratio:.1%}")
        rows.append(cells)
    head = ["robot", *(f"{group} / {special}" for special in specialists for group in others)]
    return ["Tracking reward beside that of policies trained on the robot alone:", markdown_table(head, rows)]


def _reached(results: Results, score: float, baseline: str | None) -> str:
    """How long each group took to a score, robot by robot."""
    groups = {group: [run for run in runs if run.curves] for group, runs in results.groups.items()}
    groups = {group: runs for group, runs in groups.items() if runs}
    if baseline is not None and baseline not in groups:
        raise _core.ConfigError(f"--baseline {baseline} is no group with curves; use one of {', '.join(groups)}")
    robots = list(dict.fromkeys(robot for runs in groups.values() for run in runs for robot in run.robots))
    rows = []
    for robot in robots:
        goal = score
        if baseline is not None:
            finals = [
                final(curve) for run in groups[baseline] if (curve := run.curves.get(SCORE_TAG.format(robot=robot)))
            ]
            if not finals:
                continue
            goal = float(np.mean(finals))
        cells = [robot, f"{goal:.3f}"]
        for runs in groups.values():
            curves = [curve for run in runs if (curve := run.curves.get(SCORE_TAG.format(robot=robot)))]
            cells.append(_iterations([reached(smoothed(curve, SMOOTHING), goal) for curve in curves]))
        rows.append(cells)
    what = f"the error that {baseline} ends with" if baseline is not None else f"{score:g} m/s"
    text = (
        f"The velocity error is the exploring policy's, averaged over {SMOOTHING} iterations. For several runs: the "
        "mean of those that reached it, and how many did."
    )
    return f"### Iterations to {what}\n\n{_wrapped(text)}\n\n" + markdown_table(["robot", "m/s", *groups], rows)


def _iterations(found: Sequence[float]) -> str:
    there = [value for value in found if not math.isnan(value)]
    if not there:
        return "-" if not found else f"never (0 of {len(found)})"
    return f"{np.mean(there):.0f}" + (f" ({len(there)} of {len(found)})" if len(found) > 1 else "")


def _sim2sim(comparisons: Sequence[dict[str, Any]], order: Sequence[str]) -> str:
    """Robots in the order of the evaluations, where there are any."""
    parts = ["### polypod beside MuJoCo"]
    conditions: dict[str, list[dict[str, Any]]] = {}
    for each in comparisons:
        physics = each["physics"]
        soft = ", soft contact" if physics["soft_contact"] else ""
        title = (
            f"`{each['task']}`, {each['envs_per_robot']} episodes per robot of {each['duration_s']:g} s, "
            f"seed {each['seed']}; MuJoCo {each['mujoco_version']}, {physics['integrator']} at "
            f"{1e3 * physics['dt']:g} ms, friction {physics['friction']:g}{soft}."
        )
        conditions.setdefault(title, []).append(each)
    for title, found in conditions.items():
        robots = {name: robot for each in found for name, robot in each["robots"].items()}
        judged = all(robot[engine].get("walking") for robot in robots.values() for engine in ("polypod", "mujoco"))
        rows = []
        for name in sorted(robots, key=lambda name: order.index(name) if name in order else len(order)):
            ours, theirs = robots[name]["polypod"], robots[name]["mujoco"]
            rows.append(
                (
                    name,
                    *(f"{each['error_vel_xy']:.3f}" for each in (ours, theirs)),
                    *(f"{each['error_vel_yaw']:.3f}" for each in (ours, theirs)),
                    *(_measured(each, "turn_reached", ".0%") for each in (ours, theirs) if judged),
                    *(_measured(each, "drift_xy", ".3f") for each in (ours, theirs) if judged),
                    *(f"{each['fall_rate']:.1%}" for each in (ours, theirs)),
                    "yes" if robots[name]["transfers"] else "no",
                )
            )
        more = ("turn", "MuJoCo", "drift (m/s)", "MuJoCo") if judged else ()
        head = ("robot", "err xy", "MuJoCo", "err yaw", "MuJoCo", *more, "falls", "MuJoCo", "transfers")
        title += f" {_TRANSFERS[judged]}"
        commands = list(dict.fromkeys(each["command"] for each in found))
        origins = _origins([("", each.get("measured")) for each in found]).removeprefix(": ")
        parts += [
            _wrapped(f"{title} {origins}".strip()),
            markdown_table(head, rows),
            _first_of_each({"robots": commands}),
        ]
    return "\n\n".join(parts)


def _measured(figures: dict[str, Any], key: str, form: str) -> str:
    """A figure of walking in a file of `polypod sim2sim`; a dash where it was not measured."""
    value = figures["walking"][key]
    return "-" if value is None else format(value, form)
