"""Files of drawn bodies: URDFs, configs and tasks."""

import math
from collections.abc import Sequence

from polypod import _core
from polypod.bodies.parts import Body, Link

GRAVITY = _core.EARTH_GRAVITY
"""Gravity, m/s^2."""
LEAST_BASE = 1.1 * _core.LEAST_BASE_MASS
"""Mass that randomisation leaves of a base, kg: what a simulation asks for, and a tenth more."""


def _number(x: float) -> str:
    return f"{x:.6g}" if abs(x) > 1e-12 else "0"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(_number, values))


def _shape(link: Link) -> str:
    if link.shape == "box":
        return f'<box size="{_numbers(link.size)}"/>'
    if link.shape == "sphere":
        return f'<sphere radius="{_number(link.size[0])}"/>'
    return f'<cylinder radius="{_number(link.size[0])}" length="{_number(link.size[1])}"/>'


_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


def urdf(body: Body) -> str:
    """The URDF of a body. Feet are links without mass, fixed to their legs."""
    limits = _limits(body)
    friction = body.friction * body.mass * GRAVITY * body.leg_length
    out = [
        '<?xml version="1.0" encoding="utf-8"?>',
        f"<!-- A {body.kind} that was drawn by `polypod bodies generate`. -->",
    ]
    out += [f'<robot name="{body.name}">', "  <!-- MuJoCo only: feet have no mass. -->"]
    out += ['  <mujoco><compiler inertiafromgeom="false"/></mujoco>']
    by_child = {joint.child: joint for joint in body.joints}
    for link in body.links:
        joint = by_child.get(link.name)
        if joint is not None:
            effort, velocity = limits[joint.group]
            axis = _AXES[joint.axis] if isinstance(joint.axis, str) else _numbers(joint.axis)
            out += [
                f'  <joint name="{joint.name}" type="revolute">',
                f'    <origin xyz="{_numbers(joint.at)}" rpy="0 0 {_number(joint.yaw)}"/>',
                f'    <parent link="{joint.parent}"/><child link="{joint.child}"/><axis xyz="{axis}"/>',
                f'    <limit lower="{_number(joint.lower)}" upper="{_number(joint.upper)}" effort="{_number(effort)}" '
                f'velocity="{_number(velocity)}"/>',
                *([f'    <dynamics damping="0" friction="{_number(friction)}"/>'] if friction > 0.0 else []),
                "  </joint>",
            ]
        x, y, z = link.inertia()
        own = f' rpy="{_numbers(link.turned)}"' if any(link.turned) else ""
        turned = ' rpy="0 1.5707963267948966 0"' if link.along == "x" else own
        inertia = f'ixx="{_number(x)}" iyy="{_number(y)}" izz="{_number(z)}" ixy="0" ixz="0" iyz="0"'
        shape = f'<origin xyz="{_numbers(link.at)}"{turned}/><geometry>{_shape(link)}</geometry>'
        out += [
            f'  <link name="{link.name}">',
            f'    <inertial><origin xyz="{_numbers(link.at)}"{own}/><mass value="{_number(link.mass)}"/>',
            f"      <inertia {inertia}/></inertial>",
            f"    <visual>{shape}</visual>",
            f"    <collision>{shape}</collision>",
            "  </link>",
        ]
    for name, parent, at, radius in body.feet:
        sphere = f'<geometry><sphere radius="{_number(radius)}"/></geometry>'
        out += [
            f'  <joint name="{name}_fixed" type="fixed">',
            f'    <origin xyz="{_numbers(at)}"/><parent link="{parent}"/><child link="{name}"/>',
            "  </joint>",
            f'  <link name="{name}"><visual>{sphere}</visual><collision>{sphere}</collision></link>',
        ]
    return "\n".join([*out, "</robot>", ""])


def _limits(body: Body) -> dict[str, tuple[float, float]]:
    """Effort (N m) and speed (rad/s) of each group.

    Gains can hold the body, and speeds are those of like motion.
    """
    load = body.mass * GRAVITY * body.leg_length
    speed = 20.0 * body.speed * math.sqrt(0.4 / body.leg_length)
    return {group: (drive.effort * load, speed * drive.speed) for group, drive in body.drives.items()}


def toml(body: Body, seed: int) -> str:
    """The config of a body."""
    load = body.mass * GRAVITY * body.leg_length
    weight = body.mass * GRAVITY
    lines = [
        f"# Drawn by `polypod bodies generate` with seed {seed}. {body.mass:.2f} kg, legs of {body.leg_length:.3f} m.",
        f'name = "{body.name}"',
        f'title = "{body.name.replace("_", " ").title()}"',
        f'urdf = "assets/robots/{body.name}/robot.urdf"',
        f'reward_set = "{body.reward_set}"',
        f"action_scale = {_real(body.action_scale)}          # rad per unit of action",
        "self_collisions = false",
        "",
        "[joint_roles]",
        *(f'{joint.name} = "{joint.name}"' for joint in body.joints),
        "",
        "[default_pose]               # rad",
        *(f"{joint.name} = {_real(joint.angle)}" for joint in body.joints),
    ]
    for group, (effort, velocity) in _limits(body).items():
        joints = ", ".join(f'"{joint.name}"' for joint in body.joints if joint.group == group)
        drive = body.drives[group]
        stiffness = drive.stiffness * load
        lines += [
            "",
            f"[actuators.{group}]",
            f"joints = [{joints}]",
            'model = "ideal_pd"',
            f"stiffness = {_real(stiffness)}             # N m / rad",
            f"damping = {_real(stiffness * drive.damping_time)}               # N m s / rad",
            f"effort_limit = {_real(effort)}          # N m",
            f"velocity_limit = {_real(velocity)}        # rad/s",
            f"armature = {_real(drive.armature * load)}            # kg m^2",
        ]
    lines += ["", "[commands.base_velocity]      # what such a body can be asked for, m/s"]
    lines += [f"{key} = [{_real(low)}, {_real(high)}]" for key, (low, high) in _commands(body).items()]
    tenth = _real(0.1 * body.mass)
    base = body.links[0].mass
    lightest = _real(min(0.1 * body.mass, 0.9 * base, base - LEAST_BASE))
    lever = _real(0.05 * body.leg_length)
    lines += [
        "",
        "[reset]",
        'joint_position = { mode = "scale", range = [0.95, 1.05] }',
        "base_velocity = { range = [0.0, 0.0] }",
        "soft_limit_factor = 0.9",
        "spawn_margin = 0.01",
        "",
        "[randomization]",
        "static_friction = [0.5, 1.25]",
        "dynamic_friction = [0.4, 1.0]",
        f"base_mass_offset = [-{lightest}, {tenth}]             # kg",
        f"base_com_offset = {{ x = [-{lever}, {lever}], y = [-{lever}, {lever}], z = [-{lever}, {lever}] }}   # m",
        'stiffness = { operation = "scale", distribution_params = [0.9, 1.1] }',
        'damping = { operation = "scale", distribution_params = [0.9, 1.1] }',
        "motor_strength = [0.9, 1.1]",
        f"external_force = [-{_real(0.1 * weight)}, {_real(0.1 * weight)}]       # N",
        "action_delay = [0, 2]",
        "",
    ]
    return "\n".join(lines)


def _commands(body: Body) -> dict[str, tuple[float, float]]:
    """Command ranges: speeds of like motion, no side-steps for legs that cannot spread."""
    fast = min(1.0, math.sqrt(body.leg_length / 0.35))
    ahead, back, aside = {
        "quadruped": (fast, fast, fast),
        "quadruped8": (fast, fast, 0.0),
        "quadruped_arm": (fast, fast, fast),
        "biped": (fast, 0.5 * fast, 0.4 * fast),
        "humanoid": (fast, 0.5 * fast, 0.4 * fast),
        "hexapod": (0.6 * fast, 0.6 * fast, 0.4 * fast),
    }[body.kind]
    return {"lin_vel_x": (-back, ahead), "lin_vel_y": (-aside, aside)}


def _real(x: float) -> str:
    """A TOML float of six digits."""
    text = f"{x:.6g}" if abs(x) > 1e-12 else "0.0"
    return text if "." in text or "e" in text else f"{text}.0"


def tasks(task: str, names: list[str]) -> dict[str, str]:
    """Texts of the task of all bodies and of its Play variant, by name."""
    robots = "\n".join(f'    "{name}",' for name in names)
    flat = f"""# Velocity tracking on flat ground of all bodies of this library.
extends = "velocity_flat_any_legged"
name = "Velocity-Flat-Generated-v0"
aliases = ["{task}"]
experiment_name = "generated_flat"
robots = [
{robots}
]
"""
    play = f"""# The task for watching and measuring a policy: no noise, no randomisation, no pushes.
extends = ["{task}", "velocity_flat_play"]
name = "Velocity-Flat-Generated-Play-v0"
aliases = ["{task}_play"]
"""
    return {task: flat, f"{task}_play": play}
