"""Printed output of `polypod sim2sim --model`: the map, the figures, and the ranked differences."""

import math

from polypod.sim2sim.differences import Difference
from polypod.sim2sim.mapping import Pair
from polypod.sim2sim.on_model import ModelComparison, Played
from polypod.tables import Rows, console_of_output, shown

SHOWN = 14
"""Differences in the table."""


def show(comparison: ModelComparison) -> None:
    """Prints the figures."""
    console = console_of_output()
    console.print(
        f"{comparison.model['file']}: {comparison.robot}, {comparison.task}; {comparison.episodes} episodes of "
        f"{comparison.duration_s:g} s; MuJoCo {comparison.mujoco_version}, {comparison.integrator} at "
        f"{1e3 * comparison.dt:g} ms, actuators {comparison.actuators}, contact {comparison.contact}",
        markup=False,
    )
    for note in comparison.notes:
        console.print(f"  {note}", markup=False)
    console.print(f"  {base_line(comparison)}", markup=False)
    for line in map_lines(comparison.joints):
        console.print(f"  {line}", markup=False)
    _show_map(comparison.joints)
    if comparison.on_model.phases:
        _show_phases(comparison)
    _show_walking(comparison)
    for reason in comparison.why_not:
        console.print(f"  on the model: {reason}", markup=False)
    if comparison.differences:
        _show_differences(comparison.differences)


def base_line(comparison: ModelComparison) -> str:
    """Says how the base's frame lies in polypod's."""
    if comparison.base_frame == "equal":
        return f"base: {comparison.base}, the same frame"
    rows = "; ".join(" ".join(f"{number:.3g}" for number in row) for row in comparison.base_turn)
    shift = " ".join(f"{number:.4g}" for number in comparison.base_shift)
    how = {"geometry": "found by geometry", "map": "of the map file"}[comparison.base_frame]
    return f"base: {comparison.base}, turned by [{rows}] and shifted by [{shift}] m, {how}"


def map_lines(joints: list[Pair]) -> list[str]:
    """The map in a few lines."""
    lines = []
    for how, text in (("name", "by name"), ("geometry", "by geometry"), ("map", "by the map file")):
        count = sum(pair.how == how for pair in joints)
        if count:
            lines.append(f"{count} joints {text}")
    flipped = sum(pair.sign < 0.0 for pair in joints)
    moved = sum(pair.offset != 0.0 for pair in joints)
    apart, tilt = max(pair.apart for pair in joints), max(pair.tilt for pair in joints)
    lines.append(f"{flipped} turn the other way round, {moved} have another zero")
    lines.append(f"axes at most {1e3 * apart:.1f} mm and {math.degrees(tilt):.2f} degrees apart, over poses")
    return ["joints: " + "; ".join(lines)]


def _show_map(joints: list[Pair]) -> None:
    """All pairs, unless each joint is its namesake and counts the same way."""
    if all(pair.how == "name" and pair.sign > 0.0 and pair.offset == 0.0 for pair in joints):
        return
    table = Rows("joint", "of the model", "by", "sign", "offset", "apart mm", "degrees")
    for pair in joints:
        table.add_row(
            pair.ours,
            pair.theirs,
            pair.how,
            f"{pair.sign:+.0f}",
            f"{pair.offset:.4f}",
            f"{1e3 * pair.apart:.1f}",
            f"{math.degrees(pair.tilt):.2f}",
        )
    table.print(console_of_output())


def _show_phases(comparison: ModelComparison) -> None:
    table = Rows(
        "phase", "err xy", "model", "err yaw", "model", "reached", "model", "drift", "model", "falls", "model", "limit"
    )
    for ours, theirs in zip(comparison.polypod.phases, comparison.on_model.phases, strict=True):
        table.add_row(
            ours.phase,
            *(shown(value, ".3f") for value in (ours.error_vel_xy, theirs.error_vel_xy)),
            *(shown(value, ".3f") for value in (ours.error_vel_yaw, theirs.error_vel_yaw)),
            *(shown(value, ".0%") for value in (ours.reached, theirs.reached)),
            *(shown(value, ".3f") for value in (ours.drift, theirs.drift)),
            *(shown(value, ".0%") for value in (ours.falls, theirs.falls)),
            shown(theirs.worst_saturated, ".0%"),
        )
    console = console_of_output()
    table.print(console)
    console.print(
        "errors and drift in m/s and rad/s, polypod's first; reached: share of the asked motion; limit: share of the "
        "time in which the model's most loaded joint was at its limit of effort",
        markup=False,
    )


def _show_walking(comparison: ModelComparison) -> None:
    table = Rows("in", "err xy", "still", "err yaw", "still", "turn", "side", "drift", "falls", "length s")

    def row(name: str, played: Played) -> None:
        figures, found = played.figures, played.figures.walking
        table.add_row(
            name,
            f"{figures.error_vel_xy:.3f}",
            f"{figures.still_error_vel_xy:.3f}",
            f"{figures.error_vel_yaw:.3f}",
            f"{figures.still_error_vel_yaw:.3f}",
            shown(math.nan if found is None else found.turn_reached, ".0%"),
            shown(math.nan if found is None else found.side_reached, ".0%"),
            shown(math.nan if found is None else found.drift_xy, ".3f"),
            f"{figures.fall_rate:.1%}",
            f"{figures.episode_length_s:.1f}",
        )

    row("polypod", comparison.polypod)
    row("the model", comparison.on_model)
    table.print(console_of_output())


def _show_differences(differences: list[Difference]) -> None:
    console = console_of_output()
    console.print(
        "what sets the model apart, and how far polypod's robot in MuJoCo strays when it takes that over, alone, in "
        "one step response (base m, heading rad, joints rad, root mean square):",
        markup=False,
    )
    table = Rows("item", "ours", "model", "base", "heading", "joints", "falls")
    for entry in differences[:SHOWN]:
        table.add_row(
            entry.item,
            entry.ours,
            entry.theirs,
            shown(entry.base, ".3f"),
            shown(entry.heading, ".3f"),
            shown(entry.joints, ".3f"),
            "yes" if entry.falls else "no",
        )
    table.print(console)
    if len(differences) > SHOWN:
        console.print(f"{len(differences) - SHOWN} more are in --json", markup=False)
