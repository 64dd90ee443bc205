"""The conditions of the battery, as data: a new one is an entry of `CONDITIONS`."""

import dataclasses
import difflib
from collections.abc import Sequence

from polypod import _core
from polypod.robustness import overrides, schedules, twins
from polypod.robustness.body import Body
from polypod.robustness.overrides import Overrides
from polypod.robustness.schedules import Commands

CONDIMS = (3, 4, 6)
"""Dimensions of MuJoCo's contacts: sliding, with torsional friction, with rolling friction too."""


@dataclasses.dataclass(frozen=True)
class Bound:
    """Bounds that a robot must keep in a condition."""

    falls: float = 0.05
    """Largest share of episodes with a fall."""
    turn_error: float | None = None
    """Largest error of the yaw rate in pure turns, mean over their time, rad/s."""
    kept: float | None = None
    """Least share of the episode until a fall, mean over the episodes."""
    walks: bool = False
    """Whether it also has to walk, see `polypod.evaluation.walking`."""

    def of(self, body: Body) -> "Bound":
        """The bound of a robot.

        Bipeds and humanoids may miss twice as much, by all but the definition of walking.
        """
        if not body.is_upright:
            return self
        return dataclasses.replace(
            self,
            falls=2.0 * self.falls,
            turn_error=None if self.turn_error is None else 2.0 * self.turn_error,
            kept=None if self.kept is None else 1.0 - 2.0 * (1.0 - self.kept),
        )


@dataclasses.dataclass(frozen=True)
class Condition:
    """One condition: what it changes, in each simulator."""

    name: str
    family: str
    """Conditions that vary the same quantity."""
    varies: str
    """Quantity that it varies and its value, with its unit."""
    bound: Bound
    overrides: Overrides = overrides.nothing
    """Changes of the task in polypod, for one robot."""
    twin: twins.Change | None = twins.nothing
    """Change of a robot in MuJoCo; None: the condition is one of polypod's alone."""
    condims: tuple[int, ...] = (3,)
    """Dimensions of MuJoCo's contacts that it is run with."""
    torsional: float = twins.TORSIONAL
    """Torsional friction of MuJoCo's contacts with `condim` 4 and 6, m."""
    commands: Commands = schedules.walking
    """Commands of the episodes."""
    delay_s: float = 0.0
    """Time by which all targets come late, on top of the actuators' own delays, s."""
    is_pushed: bool = False
    """Whether robots are pushed, see `schedules.Pushes`."""
    is_randomized: bool = False
    """Whether the noise, the pushes and the randomisation of the training are on."""
    description_error: float = 0.0
    """Largest relative error of each number by which the observation describes the robot."""


def _conditions() -> tuple[Condition, ...]:
    nominal, usual = Bound(falls=0.01), Bound()
    feet = CONDIMS
    conditions = [
        Condition("nominal", "nominal", "nothing", Bound(falls=0.01, walks=True), condims=feet),
        *(
            Condition(
                f"friction_{value}",
                "friction",
                f"friction {value}, sliding {overrides.SLIDING * value:.3g}",
                usual,
                overrides.friction(value),
                twins.friction(value),
            )
            for value in (0.3, 0.4, 0.6, 1.0, 1.2)
        ),
        *(
            Condition(
                f"torsional_friction_{value}",
                "torsional_friction",
                f"torsional friction {value} m",
                usual,
                overrides.foot_friction(value, 0.0),
                condims=(4,),
                torsional=value,
            )
            for value in (0.005, 0.01, 0.02)
        ),
        Condition(
            "rolling_friction_0.01",
            "rolling_friction",
            "torsional friction 0.02 m, rolling friction 0.01 m",
            usual,
            overrides.foot_friction(twins.TORSIONAL, twins.ROLLING),
            condims=(6,),
        ),
        *(
            Condition(
                f"joint_damping_{value}",
                "joint_damping",
                f"viscous friction of every joint {value} N m s/rad",
                usual,
                overrides.of_actuators("joint_damping", value),
                twins.joint_damping(value),
                condims=feet if value == 2.0 else (3,),
            )
            for value in (0.0, 0.5, 1.0, 2.0)
        ),
        *(
            Condition(
                f"dry_friction_{value}",
                "dry_friction",
                f"dry friction of every joint {value} N m",
                usual,
                overrides.of_actuators("friction", value),
                twins.dry_friction(value),
            )
            for value in (0.2, 0.5)
        ),
        *(
            Condition(
                f"armature_{value}",
                "armature",
                f"rotor inertia of every joint {value} kg m^2",
                usual,
                overrides.of_actuators("armature", value),
                twins.armature(value),
            )
            for value in (0.0, 0.03)
        ),
        *(
            Condition(
                name,
                "payload",
                f"mass of the trunk {100.0 * change:+.0f} %",
                usual,
                overrides.trunk_mass(change),
                twins.trunk_mass(1.0 + change),
            )
            for name, change in (("payload_plus_20", 0.2), ("payload_minus_20", -0.2))
        ),
        *(
            Condition(
                f"com_{name}",
                "com",
                f"trunk's centre of mass {name} by {100.0 * max(map(abs, shift)):.0f} % of the robot's height",
                usual,
                overrides.trunk_com(*shift),
                twins.trunk_com(*shift),
            )
            for name, shift in (("forward", (0.1, 0.0)), ("backward", (-0.1, 0.0)), ("left", (0.0, 0.05)))
        ),
        Condition(
            "torque_minus_20", "torque", "torque of every motor -20 %", usual, overrides.torque(0.8), twins.torque(0.8)
        ),
        *(Condition(f"delay_{ms}", "delay", f"targets late by {ms} ms", usual, delay_s=1e-3 * ms) for ms in (10, 20)),
        Condition(
            "description_20",
            "description",
            "numbers that describe the robot wrong by up to 20 %",
            Bound(falls=1.0, kept=0.85),
            description_error=0.2,
        ),
        Condition("pushes", "pushes", "pushes of up to 0.5 m/s every 5 s", Bound(falls=0.03), is_pushed=True),
        Condition(
            "randomized",
            "randomized",
            "noise, pushes and randomisation of the training",
            Bound(falls=0.03),
            twin=None,
            is_randomized=True,
        ),
        Condition(
            "commands_2s", "commands", "a new command every 2 s", nominal, condims=feet, commands=schedules.every_2s
        ),
        Condition(
            "turn",
            "commands",
            "turns in place at 0.6 rad/s",
            Bound(falls=0.01, turn_error=0.15),
            condims=feet,
            commands=schedules.turns,
        ),
        Condition(
            "side_step", "commands", "side-steps at 0.5 m/s", nominal, condims=feet, commands=schedules.side_steps
        ),
        Condition("stop", "commands", "stops after motions", nominal, condims=feet, commands=schedules.stops),
    ]
    return tuple(conditions)


CONDITIONS: tuple[Condition, ...] = _conditions()
"""All conditions, in the order of the table."""


def chosen(names: Sequence[str] | None) -> tuple[Condition, ...]:
    """The conditions of these names and families, in the order of the table; None: all.

    Raises:
        UnknownNameError: for a name that neither a condition nor a family has.
    """
    if names is None:
        return CONDITIONS
    known = list(dict.fromkeys(word for entry in CONDITIONS for word in (entry.family, entry.name)))
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=3)
            guess = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
            every = ", ".join(entry.name for entry in CONDITIONS)
            raise _core.UnknownNameError(f"there is no condition {name[:80]!r}; {guess}Conditions: {every}")
    return tuple(entry for entry in CONDITIONS if entry.name in names or entry.family in names)
