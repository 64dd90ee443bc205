"""Changes of a robot in polypod: each function returns one that gives its `key=value` pairs."""

from collections.abc import Callable

from polypod.robustness.body import Body

Overrides = Callable[[Body], list[str]]

SLIDING = 0.75
"""Friction when sliding over that at rest, as in the flat task's nominal material."""


def nothing(body: Body) -> list[str]:
    """Leaves the robot as it is."""
    return []


def friction(coefficient: float) -> Overrides:
    """Friction at rest of every robot on the ground of a coefficient of 1.

    Sliding, `SLIDING` of it.
    """
    return lambda body: [
        f"robot_material.static_friction={coefficient}",
        f"robot_material.dynamic_friction={SLIDING * coefficient:.6g}",
    ]


def foot_friction(torsional: float, rolling: float) -> Overrides:
    """Torsional and rolling friction of every contact, m."""
    return lambda body: [
        f"robot_material.torsional_friction={torsional}",
        f"robot_material.rolling_friction={rolling}",
    ]


def of_actuators(key: str, value: float) -> Overrides:
    """A number of every joint, in the place of the robot's own."""
    return lambda body: [
        f"robot_overrides.{body.name}.actuators.{group}.{key}={value}" for group in body.actuator_groups
    ]


def trunk_mass(change: float) -> Overrides:
    """Relative change of the trunk's mass; its inertia goes along."""
    return lambda body: [
        *_event("add_base_mass"),
        "events.add_base_mass.recompute_inertia=true",
        _range(body, "base_mass_offset", change * body.trunk_mass),
    ]


def trunk_com(forward: float, left: float) -> Overrides:
    """Shift of the trunk's centre of mass in shares of the robot's height, base axes."""
    return lambda body: [
        *_event("base_com"),
        *(
            _range(body, f"base_com_offset.{axis}", share * body.height)
            for axis, share in (("x", forward), ("y", left), ("z", 0.0))
        ),
    ]


def torque(share: float) -> Overrides:
    """Share of its torque that each motor gives, limits included."""
    return lambda body: [
        *_event("randomize_motor_strength"),
        f"events.randomize_motor_strength.strength_range=[{share}, {share}]",
    ]


def delay(steps: int) -> list[str]:
    """Delay of all robots' targets in physics steps, on top of the actuators' own delays."""
    return [
        "events.action_delay.enabled=true",
        'events.action_delay.mode="reset"',
        f"events.action_delay.delay_range=[{steps}, {steps}]",
    ]


def _event(name: str) -> list[str]:
    return [f"events.{name}.enabled=true", f'events.{name}.mode="startup"']


def _range(body: Body, key: str, value: float) -> str:
    return f"robot_overrides.{body.name}.randomization.{key}=[{value!r}, {value!r}]"
