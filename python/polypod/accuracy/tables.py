"""The tables of a report, in Markdown."""

import dataclasses
import math

from polypod.accuracy.report import Report
from polypod.accuracy.standing import DT
from polypod.text import markdown_table


def sections(report: Report) -> dict[str, str]:
    """Tables that are not empty, by their titles; docs/accuracy.md explains them."""
    made = {
        "Bounds": _bounds(report),
        "Against the MJCF file": _files(report) if report.files else "",
        "Identities": _statics(report),
        "Step responses": _responses(report),
        "Drops from 0.3 m": _drops(report) if report.drops else "",
        "Forces on standing feet": _standing(report) if report.standing else "",
        "At rest on a slope of 20 degrees": _rests(report) if report.rests else "",
    }
    return {title: text for title, text in made.items() if text}


def _bounds(report: Report) -> str:
    return markdown_table(
        ("quantity", "measured", "worst", "of", "bound", "why"),
        [
            (bound.quantity, bound.measured, bound.text(worst[1]), worst[0], bound.limit, bound.reason)
            for bound in report.bounds
            if (worst := report.worst(bound)) is not None
        ],
    )


def _files(report: Report) -> str:
    head = ("robot", "precision", "mass", "com", "limits", "mass matrix", "bias", "forward", "step")
    return markdown_table(
        head,
        [(r.robot, r.dtype, *(f"{error:.1e}" for error in dataclasses.astuple(r.errors))) for r in report.files],
    )


def _statics(report: Report) -> str:
    head = ("robot", "mass", "com", "position", "rotation", "mass matrix", "bias", "forward", "inverse")
    return markdown_table(
        head,
        [
            (
                r.robot,
                *(
                    f"{value:.1e}"
                    for value in (
                        r.total_mass,
                        r.center_of_mass,
                        r.link_position,
                        r.link_rotation,
                        r.mass_matrix,
                        r.bias_force,
                        r.forward_dynamics,
                        r.inverse_dynamics,
                    )
                ),
            )
            for r in report.statics
        ],
    )


def _responses(report: Report) -> str:
    head = ("robot", "0.5 ms", "MuJoCo 0.5 ms", "5 ms", "MuJoCo 5 ms", "further")
    return markdown_table(
        head,
        [
            (
                r.robot,
                *(f"{1e3 * x:.2f}" for x in (r.fine, r.mujoco_fine, r.coarse, r.mujoco_coarse)),
                str(r.joints_further),
            )
            for r in report.responses
        ],
    )


def _drops(report: Report) -> str:
    head = (
        "robot",
        "gains",
        "dt (ms)",
        "height (m)",
        "MuJoCo (m)",
        "difference (mm)",
        "pitch (degrees)",
        "MuJoCo (degrees)",
        "difference (degrees)",
        f"at {1e3 * DT:g} ms (mm)",
        f"at {1e3 * DT:g} ms (degrees)",
    )
    return markdown_table(
        head,
        [
            (
                r.robot,
                f"{r.gains:g}",
                f"{1e3 * r.dt:g}",
                f"{r.height:.4f}",
                f"{r.mujoco_height:.4f}",
                f"{1e3 * r.height_error:.1f}",
                f"{math.degrees(r.pitch):+.2f}",
                f"{math.degrees(r.mujoco_pitch):+.2f}",
                f"{math.degrees(r.pitch_error):.2f}",
                f"{1e3 * r.coarse_height_error:.1f}",
                f"{math.degrees(r.coarse_pitch_error):.2f}",
            )
            for r in report.drops
        ],
    )


def _standing(report: Report) -> str:
    return markdown_table(
        ("robot", "weight (N)", "normal forces (N)", "MuJoCo (N)", "worst foot", "worst horizontal"),
        [
            (
                r.robot,
                f"{r.weight:.1f}",
                " ".join(f"{x:.1f}" for x in r.normal),
                " ".join(f"{x:.1f}" for x in r.mujoco_normal),
                f"{100 * r.normal_error:.2f} %",
                f"{100 * r.tangential_error:.2f} %",
            )
            for r in report.standing
        ],
    )


def _rests(report: Report) -> str:
    return markdown_table(
        ("robot", "up the slope", "polypod (mm)", "MuJoCo (mm)"),
        [(r.robot, r.uphill, f"{1e3 * r.creep:.4f}", f"{1e3 * r.mujoco_creep:.4f}") for r in report.rests],
    )
