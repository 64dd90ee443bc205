"""The tables of a report."""

import math
from collections.abc import Sequence

from polypod.accuracy.report import Report
from polypod.accuracy.standing import DT, FRICTION, GAINS, MUJOCO_DT

COMMAND = "make accuracy"


def tables(report: Report) -> str:
    """Everything, for docs/physics.md."""
    parts = [
        _settings(report),
        "#### Identities\n\n" + _statics_text(report),
        _statics(report),
        "#### Step responses\n\n" + _responses_text(),
        _responses(report),
        "#### Dropped from 0.3 m\n\n" + _drops_text(),
        _drops(report),
        "#### Forces on standing feet\n\n" + _standing_text(),
        _standing(report),
        "#### At rest on a slope of 20 degrees\n\n" + _rests_text(),
        _rests(report),
        "#### The friction cone\n\n" + _cone_text(),
        _slides(report),
        _slopes(report),
    ]
    return "\n\n".join(parts)


def summary(report: Report) -> str:
    """The worst figures of all robots, for README.md."""
    steps = [(r.coarse / r.mujoco_coarse) for r in report.responses]
    bound = [
        ("mass matrix, bias force, kinematics, forward dynamics", "relative error", _statics_worst(report), "1e-4"),
        ("step response at 0.5 ms", "deviation", f"{1e3 * max(r.fine for r in report.responses):.2f} mrad", "1 mrad"),
        ("step response at 5 ms", "of MuJoCo's own deviation", f"{max(steps):.2f}", "1"),
        ("base height after a drop from 0.3 m", "difference", f"{1e3 * _drop_height(report):.1f} mm", "5 mm"),
        ("pitch after the drop", "difference", f"{math.degrees(_drop_pitch(report)):.2f} degrees", "0.5 degrees"),
        ("force on a standing foot", "difference", f"{100 * _foot(report):.2f} %", "2 %"),
        ("creep on a slope of 20 degrees", "in 10 s", f"{1e3 * max(r.creep for r in report.rests):.3f} mm", "1 mm"),
    ]
    rows = [(quantity, measure, value, limit) for quantity, measure, value, limit in bound]
    head = f"Against MuJoCo {report.mujoco}, on the same URDFs, {len(report.statics)} robots, the worst of all (`{COMMAND}`):"
    return head + "\n\n" + _table(("quantity", "measured as", "worst", "bound"), rows)


def _settings(report: Report) -> str:
    return (
        f"MuJoCo {report.mujoco} compiles the same URDFs, with the settings of `python/polypod/accuracy/reference.py`; "
        f"polypod in `f32`. Written by `{COMMAND}`."
    )


def _statics_text(report: Report) -> str:
    states = report.statics[0].states if report.statics else 0
    return (
        f"Worst of {states} random states. The error of a vector or matrix is the largest difference of an entry over the "
        "largest entry of MuJoCo's; for forward dynamics, over the largest entry of that state's acceleration."
    )


def _statics(report: Report) -> str:
    head = ("robot", "mass", "com", "position", "rotation", "mass matrix", "bias force", "acceleration", "inverse dynamics")
    return _table(
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


def _responses_text() -> str:
    return (
        "Base fixed, gravity on, no ground; from the default pose at rest, the target of one joint jumps by 0.1 rad for "
        "1 s, each joint in turn. Worst deviation of any joint from the converged answer (MuJoCo, RK4, 0.25 ms), mrad. "
        "MuJoCo's columns are position actuators with the same gains under `implicitfast` and, last, under its default, "
        "`Euler`. *further*: joints that polypod follows less closely than `implicitfast` at 5 ms."
    )


def _responses(report: Report) -> str:
    head = ("robot", "0.5 ms", "MuJoCo 0.5 ms", "5 ms", "MuJoCo 5 ms", "`Euler` 5 ms", "further")
    return _table(
        head,
        [
            (
                r.robot,
                *(f"{1e3 * x:.2f}" for x in (r.fine, r.mujoco_fine, r.coarse, r.mujoco_coarse, r.mujoco_euler)),
                str(r.joints_further),
            )
            for r in report.responses
        ],
    )


def _drops_text() -> str:
    return (
        f"Feet 0.3 m above the ground, friction {FRICTION}, 3 s; polypod at {1e3 * DT:g} ms, MuJoCo at "
        f"{1e3 * MUJOCO_DT:g} ms. The gains are {GAINS:g} times the robot's."
    )


def _drops(report: Report) -> str:
    head = ("robot", "height (m)", "MuJoCo (m)", "difference (mm)", "pitch (degrees)", "MuJoCo", "difference")
    return _table(
        head,
        [
            (
                r.robot,
                f"{r.height:.4f}",
                f"{r.mujoco_height:.4f}",
                f"{1e3 * (r.height - r.mujoco_height):+.1f}",
                f"{math.degrees(r.pitch):+.2f}",
                f"{math.degrees(r.mujoco_pitch):+.2f}",
                f"{math.degrees(r.pitch - r.mujoco_pitch):+.2f}",
            )
            for r in report.drops
        ],
    )


def _standing_text() -> str:
    return ""


def _standing(report: Report) -> str:
    return _table(
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


def _rests_text() -> str:
    return ""


def _rests(report: Report) -> str:
    return _table(
        ("robot", "up the slope", "polypod (mm)", "MuJoCo (mm)"),
        [(r.robot, r.uphill, f"{1e3 * r.creep:.4f}", f"{1e3 * r.mujoco_creep:.4f}") for r in report.rests],
    )


def _cone_text() -> str:
    return (
        "A block of 2 kg, both simulators at 1 ms. Pushed over a level plane it stops after `v^2 / (2 mu g)`; on a slope it "
        "holds below `atan(mu)` and slides with `g (sin - mu cos)` above."
    )


def _slides(report: Report) -> str:
    return _table(
        ("friction", "speed (m/s)", "direction (degrees)", "formula (m)", "polypod (m)", "MuJoCo (m)"),
        [
            (
                f"{r.friction:g}",
                f"{r.speed:g}",
                f"{math.degrees(r.direction):.0f}",
                f"{r.formula:.4f}",
                f"{r.distance:.4f}",
                f"{r.mujoco:.4f}",
            )
            for r in report.slides
        ],
    )


def _slopes(report: Report) -> str:
    return _table(
        ("friction", "slope (degrees)", "formula (m/s^2)", "polypod (m/s^2)", "MuJoCo (m/s^2)"),
        [
            (
                f"{r.friction:g}",
                f"{math.degrees(r.angle):g}",
                f"{r.formula:.4f}",
                f"{r.acceleration:.4f}",
                f"{r.mujoco:.4f}",
            )
            for r in report.slopes
        ],
    )


def _statics_worst(report: Report) -> str:
    return f"{max(r.worst() for r in report.statics):.1e}"


def _drop_height(report: Report) -> float:
    return max(abs(r.height - r.mujoco_height) for r in report.drops)


def _drop_pitch(report: Report) -> float:
    return max(abs(r.pitch - r.mujoco_pitch) for r in report.drops)


def _foot(report: Report) -> float:
    return max(r.normal_error for r in report.standing)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
