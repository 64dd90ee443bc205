"""The text of docs/accuracy.md around its tables, and the summary of README.md."""

import math
import textwrap
from collections.abc import Iterable

from lab.accuracy import engines, sweeps
from lab.accuracy.report import Report
from polypod.accuracy.standing import DT, FINE, FIRM, FRICTION, MUJOCO_COARSE, SLOPE_FINE
from polypod.accuracy.tables import sections
from polypod.provenance import measured, sentence
from polypod.text import markdown_table

COMMAND = "make accuracy"


def tables(report: Report, command: str = COMMAND) -> str:
    """Everything, for docs/accuracy.md; `command` makes them."""
    parts = {
        **sections(report),
        "Error of the contact solver": _sweeps(report),
        "The two engines": _engines(report),
        "The friction cone": _slides(report) + "\n\n" + _slopes(report),
    }
    values = {
        "mujoco": report.mujoco,
        "states": report.statics[0].states,
        "friction": FRICTION,
        "firm": FIRM,
        "dt": 1e3 * DT,
        "fine": 1e3 * FINE,
        "slope_fine": 1e3 * SLOPE_FINE,
        "command": command,
        "sweeps": sweeps.USUAL,
        "converged": sweeps.CONVERGED,
        "amplitude": sweeps.AMPLITUDE,
        "sweeps_fine": 1e3 * sweeps.FINE,
        "control": 1e3 * sweeps.CONTROL,
        "steps": ", ".join(f"{1e3 * step:g}" for step in engines.STEPS),
        "speed_envs": engines.SPEED_ENVS,
        "timings": engines.TIMINGS,
        "measured": sentence(measured()),
        "sensitive_height": 1e3 * _worst(abs(r.mujoco_coarse_height - r.mujoco_height) for r in report.drops),
        "sensitive_pitch": math.degrees(_worst(abs(r.mujoco_coarse_pitch - r.mujoco_pitch) for r in report.drops)),
        "standing": _standing_robots(report),
        "sources": _sources(report),
        "slowest": _slowest(report),
        "hanging": _hanging_robots(report),
        "mujoco_coarse": 1e3 * MUJOCO_COARSE,
    }
    said = {title: _prose(text.format(**values)) for title, text in PROSE.items()}
    return "\n\n".join([said[""], *(f"### {title}\n\n{said[title]}\n\n{rows}" for title, rows in parts.items())])


def summary(report: Report) -> str:
    """The worst figures of all robots, for README.md."""
    head = _prose(
        f"The largest deviations from MuJoCo {report.mujoco}, over {len(report.statics)} robots; "
        f"{len(report.standing)} stand without a policy (`{COMMAND}`). {sentence(measured())}"
    )
    rows = [
        (bound.quantity, bound.measured, bound.text(worst[1]), bound.limit)
        for bound in report.bounds
        if bound.front_page and (worst := report.worst(bound)) is not None
    ]
    return head + "\n\n" + markdown_table(("quantity", "measured", "worst", "bound"), rows)


def _worst(values: Iterable[float]) -> float:
    """The largest; 0 of none, where no robot stands."""
    return max(values, default=0.0)


def _standing_robots(report: Report) -> str:
    """Sentence that names the robots without a table of standing."""
    standing = {r.robot for r in report.standing}
    others = [r.robot for r in report.statics if r.robot not in standing and r.robot not in report.fallen]
    said = f"A policy has to balance {', '.join(others)}, as their configs say." if others else "All robots stand."
    return f"{said} Against their configs, {', '.join(report.fallen)} fell." if report.fallen else said


def _sources(report: Report) -> str:
    """Kinds of the robots' files."""
    return "files" if report.origins else "URDFs"


def _slowest(report: Report) -> str:
    """Sentence that names the robots whose usual number of sweeps leaves more than the step."""
    names = [r.robot for r in report.sweeps if r.left[sweeps.USUAL] > r.step]
    if not names:
        return f"{sweeps.USUAL} sweeps leave less than the step."
    return f"For {', '.join(names)}, {sweeps.USUAL} sweeps leave more than the step."


def _hanging_robots(report: Report) -> str:
    """Sentence that names the robots whose step responses are measured without gravity."""
    names = [r.robot for r in report.responses if not r.gravity]
    if not names:
        return "Gravity acts."
    return f"Gravity acts, but for {', '.join(names)}: gains that do not hold a joint up let it topple to its stop."


PROSE = {
    "": """
MuJoCo {mujoco} compiles the same {sources}; polypod computes in `f32` with {sweeps} sweeps. Written by `{command}`.
{measured}
""",
    "Bounds": """
The largest figure of each quantity over all robots and cases, and the bound that it may not exceed. The command fails
where one does (`python/polypod/accuracy/bounds.py`, `lab/accuracy/bounds.py`).
""",
    "Against the MJCF file": """
Robots that `polypod add` made of an MJCF file are compared with MuJoCo's model of it. Largest relative error over 8
random states, in both precisions; *step* is what one physics step with damping and dry friction adds to the velocity.
The tables below compare with the same model.
""",
    "Identities": """
Largest error over {states} random states. The error of a vector or matrix is the largest difference of an entry,
relative to MuJoCo's largest entry. For forward dynamics it is relative to the largest acceleration of that state.
""",
    "Step responses": """
The base is fixed, without ground. From rest in the default pose, the target of one joint jumps by 0.1 rad for 1 s, each
joint in turn. {hanging} The table shows the largest deviation of any joint from the converged answer (MuJoCo, `RK4`,
0.25 ms), in mrad. MuJoCo's columns are position actuators with the same gains under `implicitfast`. Both simulators
hold the limits of effort, speed and position: `python/polypod/mujoco_model/limits.py`. *Further* is the number of jumps
that polypod follows less closely than MuJoCo, both at 5 ms.
""",
    "Drops from 0.3 m": """
This table and those of standing, slopes and engines are of robots that stand by themselves. {standing}

The feet begin 0.3 m above the ground. Friction is {friction:g}, targets are the default pose, torques stay within
the actuators' limits. Joints have no speed limits here, in both simulators: a landing drives legs into them, and the
impulse of a rigid limit between rigid contacts depends on how stiff the contacts are. The table shows the base after
3 s: both simulators at the step *dt*, then polypod at {dt:g} ms, with its speed limits as in the tasks, against the
same run of MuJoCo.

With {firm:g} times the gains the robots land and stand. With the gains of the training some land in a deep crouch and
drag their feet. Where they end depends on the step: MuJoCo's own answers at {mujoco_coarse:g} ms differ from those at
*dt* by up to {sensitive_height:.1f} mm and {sensitive_pitch:.1f} degrees. At 0.1 ms the simulators agree, so what
remains at {dt:g} ms is the error of the step and the speed limits, and not a difference between contact models.
""",
    "Forces on standing feet": """
The robot is set on its feet in the default pose, with its own gains and friction {friction:g}. Forces are those after
10 s, polypod at {dt:g} ms, MuJoCo at {fine:g} ms. Legs with PD gains are springs, so the pose determines each foot's
normal force. *Worst foot* is the largest difference of a normal force, relative to MuJoCo's on that foot. Horizontal
forces also depend on where feet and joints with dry friction (A1, Spot) came to rest. *Worst horizontal* is the
largest difference of a horizontal force, relative to the normal force on that foot.
""",
    "At rest on a slope of 20 degrees": """
Friction is {friction:g}, gains are {firm:g} times the robot's own; with their own gains some robots fall over, in
MuJoCo too. After 10 s to settle, the table shows the largest distance of the base from where it was, over another
10 s, polypod at {dt:g} ms and MuJoCo at {slope_fine:g} ms. MuJoCo's soft contacts always creep.
""",
    "Error of the contact solver": """
Robots kick about on the ground: new random targets every {control:g} ms, within {amplitude:g} rad of the default
position, with self-collision and friction {friction:g}. The table shows the error of the base's velocity after
{control:g} ms from one state, root mean square, mm/s, against {converged} sweeps; there is no warm start at the
beginning. *Step* is the error of physics steps of {dt:g} ms against {sweeps_fine:g} ms, {converged} sweeps in both.
{slowest}
""",
    "The two engines": """
Each robot under `physics.engine = "articulated"` and `"avian"`, both at {dt:g} ms.

*Height*, *pitch*, *force / weight*: after 10 s on its feet in the default pose, with its own gains and friction
{friction:g}. *Torques apart*: the largest difference of the engines' joint torques over the largest torque, without
dry friction of joints and with it. Dry friction leaves the torque of a resting joint open (A1, Spot). *Response*: the
step responses above, over all jumps, joints and times. *Drift*: the largest distance of a link's origin from where
base pose and joint positions put it; zero in reduced coordinates. *Largest step*: the largest one with which the robot
stands calmly for 2 s, of {steps} ms. *Steps per second*: physics steps on one core, {speed_envs} standing envs, median
of {timings} timings.
""",
    "The friction cone": """
A block of 2 kg, both simulators at 1 ms. Pushed over a level plane it stops after `v^2 / (2 mu g)`, less the way of
half a step. On a slope it holds below `atan(mu)` and slides with `g (sin - mu cos)` above. Just below the limit
MuJoCo's soft contacts creep.
""",
}
"""Paragraphs before each table, by the title of the section; the first stands before all."""


def _sweeps(report: Report) -> str:
    return markdown_table(
        ("robot", *(f"{count} sweeps" for count in sweeps.COUNTS), "step"),
        [
            (r.robot, *(f"{1e3 * r.left[count]:.1f}" for count in sweeps.COUNTS), f"{1e3 * r.step:.1f}")
            for r in report.sweeps
        ],
    )


def _engines(report: Report) -> str:
    head = (
        "robot",
        "engine",
        "height (m)",
        "pitch (rad)",
        "force / weight",
        "torques apart",
        "with dry friction",
        "response, max (mrad)",
        "rms (mrad)",
        "drift (mm)",
        "largest step (ms)",
        "steps per second",
    )
    return markdown_table(
        head,
        [
            (
                both.robot,
                r.engine,
                f"{r.height:.4f}",
                f"{r.pitch:+.4f}",
                f"{r.force:.5f}",
                f"{100 * both.torque_difference:.2f} %" if r is both.avian else "",
                f"{100 * both.torque_difference_with_friction:.2f} %" if r is both.avian else "",
                f"{1e3 * r.response_max:.2f}",
                f"{1e3 * r.response_rms:.3f}",
                f"{1e3 * r.drift:.4f}",
                f"{1e3 * r.largest_step:g}",
                f"{round(r.steps_per_second, -2):.0f}",
            )
            for both in report.engines
            for r in (both.articulated, both.avian)
        ],
    )


def _slides(report: Report) -> str:
    return markdown_table(
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
    return markdown_table(
        ("friction", "slope (degrees)", "formula (m/s^2)", "polypod (m/s^2)", "MuJoCo (m/s^2)"),
        [
            (
                f"{r.friction:g}",
                f"{math.degrees(r.angle):g}",
                f"{r.formula:.4f}",
                f"{round(r.acceleration, 4) + 0.0:.4f}",
                f"{round(r.mujoco, 4) + 0.0:.4f}",
            )
            for r in report.slopes
        ],
    )


def _prose(text: str) -> str:
    """Fills each paragraph to 100 columns."""
    paragraphs = text.strip().split("\n\n")
    return "\n\n".join(
        textwrap.fill(" ".join(paragraph.split()), 100, break_on_hyphens=False) for paragraph in paragraphs
    )
