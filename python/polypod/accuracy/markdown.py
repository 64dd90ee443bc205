"""The tables of a report."""

import math
import textwrap

from polypod import _core
from polypod.accuracy import engines, sweeps
from polypod.accuracy.report import Report
from polypod.accuracy.standing import DT, FINE, FIRM, FRICTION, MUJOCO_COARSE, SLOPE_FINE
from polypod.documents import table

COMMAND = "make accuracy"


def tables(report: Report) -> str:
    """Everything, for docs/physics.md."""
    parts = (
        (_SETTINGS, ""),
        (_STATICS, _statics(report)),
        (_RESPONSES, _responses(report)),
        (_DROPS, _drops(report)),
        (_STANDING, _standing(report)),
        (_RESTS, _rests(report)),
        (_SWEEPS, _sweeps(report)),
        (_ENGINES, _engines(report)),
        (_CONE, _slides(report) + "\n\n" + _slopes(report)),
    )
    values = {
        "mujoco": report.mujoco,
        "states": report.statics[0].states,
        "friction": FRICTION,
        "firm": FIRM,
        "dt": 1e3 * DT,
        "fine": 1e3 * FINE,
        "slope_fine": 1e3 * SLOPE_FINE,
        "command": COMMAND,
        "sweeps": sweeps.USUAL,
        "converged": sweeps.CONVERGED,
        "amplitude": sweeps.AMPLITUDE,
        "sweeps_fine": 1e3 * sweeps.FINE,
        "control": 1e3 * sweeps.CONTROL,
        "steps": ", ".join(f"{1e3 * step:g}" for step in engines.STEPS),
        "speed_envs": engines.SPEED_ENVS,
        "timings": engines.TIMINGS,
        "simd": _core.info()["simd"],
        "sensitive_height": 1e3 * max(abs(r.mujoco_coarse_height - r.mujoco_height) for r in report.drops),
        "sensitive_pitch": math.degrees(max(abs(r.mujoco_coarse_pitch - r.mujoco_pitch) for r in report.drops)),
        "mujoco_coarse": 1e3 * MUJOCO_COARSE,
    }
    return "\n\n".join(f"{_prose(text.format(**values))}\n\n{table}".strip() for text, table in parts)


def summary(report: Report) -> str:
    """The worst figures of all robots, for README.md."""
    statics = max(r.worst() for r in report.statics)
    fine = max(r.fine for r in report.responses)
    coarse = max(r.coarse / r.mujoco_coarse for r in report.responses)
    height, pitch = max(r.height_error for r in report.drops), max(r.pitch_error for r in report.drops)
    foot = max(r.normal_error for r in report.standing)
    creep = max(r.creep for r in report.rests)
    stops = max(abs(r.distance / r.formula - 1.0) for r in report.slides)
    head = f"MuJoCo {report.mujoco} on the same URDFs, {len(report.statics)} robots, the worst of all (`{COMMAND}`):"
    rows = (
        ("inertia, bias forces, kinematics, forward dynamics", "relative error in `f32`", f"{statics:.1e}", "1e-4"),
        ("step responses, 0.5 ms", "deviation", f"{1e3 * fine:.2f} mrad", "1 mrad"),
        ("step responses, 5 ms", "share of MuJoCo's own deviation", f"{coarse:.2f}", "1"),
        ("height after a drop from 0.3 m", "difference, same step", f"{1e3 * height:.1f} mm", "5 mm"),
        ("pitch after the drop", "difference, same step", f"{math.degrees(pitch):.2f} degrees", "0.5 degrees"),
        ("normal force on a standing foot", "difference", f"{100 * foot:.2f} %", "2 %"),
        ("creep on a slope of 20 degrees", "in 10 s", f"{1e3 * creep:.2f} mm", "1 mm"),
        ("distance in which a block stops", "error against the formula", f"{100 * stops:.2f} %", "1 %"),
    )
    return head + "\n\n" + table(("quantity", "measured", "worst", "bound"), rows)


_SETTINGS = """
MuJoCo {mujoco} compiles the same URDFs, with the settings that `python/polypod/accuracy/reference.py` explains;
polypod computes in `f32` with {sweeps} sweeps. Written by `{command}`.
"""

_STATICS = """#### Identities

Worst of {states} random states. The error of a vector or matrix is the largest difference of an entry over the
largest entry of MuJoCo's; for forward dynamics, over the largest entry of that state's acceleration.
"""

_RESPONSES = """#### Step responses

Base fixed, gravity on, no ground; from the default pose at rest, the target of one joint jumps by 0.1 rad for 1 s,
each joint in turn. Worst deviation of any joint from the converged answer (MuJoCo, `RK4`, 0.25 ms), mrad. MuJoCo's
columns are position actuators with the same gains under `implicitfast`. *further*: jumps that polypod follows less
closely than MuJoCo, both at 5 ms.
"""

_DROPS = """#### Dropped from 0.3 m

Feet 0.3 m above the ground, friction {friction:g}, targets in the default pose, torques within the actuators' limits;
the base after 3 s. Both simulators at the step *dt*, then polypod at {dt:g} ms against the same run of MuJoCo. On
{firm:g} times the gains the robots land and stand. On the gains that policies are trained with, the Unitree robots and
Spot land in a deep crouch, their feet dragged along, and where they end depends on the step: MuJoCo's own answers at
{mujoco_coarse:g} ms lie up to {sensitive_height:.1f} mm and {sensitive_pitch:.1f} degrees from those at *dt*. Both
simulators come to the same answer at 0.1 ms; what is left at {dt:g} ms is the error of that step, not a difference
between models of contact.
"""

_STANDING = """#### Forces on standing feet

Set on its feet in the default pose, on its own gains, friction {friction:g}; after 10 s, polypod at {dt:g} ms,
MuJoCo at {fine:g} ms. On four rigid legs the forces would be undetermined; legs on gains are springs, and the
normal force of each foot follows from the pose. *worst foot*: the largest difference of a foot's normal force,
relative to MuJoCo's on that foot. The horizontal forces also depend on where each foot, and each joint with dry
friction (A1, Spot), came to stick while the robot settled. *worst horizontal*: the largest difference of a foot's
horizontal force, relative to the normal force on it.
"""

_RESTS = """#### At rest on a slope of 20 degrees

Friction {friction:g}, {firm:g} times the gains (on their own some robots fall over in the default pose, in MuJoCo
too), 10 s to settle; then the largest distance of the base from where it was, over 10 s, polypod at {dt:g} ms and
MuJoCo at {slope_fine:g} ms. MuJoCo's contacts are soft and always creep.
"""

_SWEEPS = """#### What the sweeps leave

Robots that kick about on the ground: new random targets every {control:g} ms, within {amplitude:g} rad of the default
position, self-collision on, friction {friction:g}. By how much the base's velocity is off after {control:g} ms from
one state, root mean square, mm/s: with so many sweeps of the contact solver against {converged} of them, no warm start
to begin with; and, *step*, with physics steps of {dt:g} ms against {sweeps_fine:g} ms, {converged} sweeps in both.
"""

_ENGINES = """#### The two engines

Each robot under `physics.engine = "articulated"` and `"avian"`, both at {dt:g} ms.
*Standing*: set on its feet in the default pose, on its own gains, friction {friction:g}; base, vertical contact
forces over the weight, and the largest difference of the engines' joint torques over the largest torque, after 10 s;
first without the joints' dry friction, then with it: a joint at rest may be held by any torque within it (A1, Spot).
*Response*: the step responses above, against the same converged answer of MuJoCo, over all jumps, joints and times.
*Drift*: how far a link's origin was at most from where base pose and joint positions put it while the robot stood;
zero by construction in reduced coordinates. *Largest step*: up to which the robot stands calmly for 2 s, of {steps}
ms. *Steps per second*: physics steps of an env in a second of one core's time, {speed_envs} standing envs, median of
{timings} timings, on the machine that wrote this table ({simd}); on another they differ.
"""

_CONE = """#### The friction cone

A block of 2 kg, both simulators at 1 ms. Pushed over a level plane it stops after `v^2 / (2 mu g)`, less half a
step's way (the block moves with the velocity of the end of the step); on a slope it holds below `atan(mu)` and
slides with `g (sin - mu cos)` above. Just below the limit MuJoCo's soft contacts creep.
"""


def _statics(report: Report) -> str:
    head = ("robot", "mass", "com", "position", "rotation", "mass matrix", "bias", "forward", "inverse")
    return table(
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
    return table(
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
    return table(
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
    return table(
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
    return table(
        ("robot", "up the slope", "polypod (mm)", "MuJoCo (mm)"),
        [(r.robot, r.uphill, f"{1e3 * r.creep:.4f}", f"{1e3 * r.mujoco_creep:.4f}") for r in report.rests],
    )


def _sweeps(report: Report) -> str:
    return table(
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
    return table(
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
    return table(
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
    return table(
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
    """Paragraphs, each filled anew."""
    paragraphs = text.strip().split("\n\n")
    return "\n\n".join(textwrap.fill(" ".join(paragraph.split()), 140) for paragraph in paragraphs)
