"""Description of a robot that both simulators use: one URDF and one set of actuators."""

import contextlib
import dataclasses
import functools
import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, simulated
from polypod.add.root import rooted
from polypod.arrays import Array
from polypod.compat import tomllib
from polypod.mujoco_model import contact_shapes
from polypod.mujoco_model.origin import Origin, origin_of


@dataclasses.dataclass(frozen=True)
class Actuators:
    """Position actuators in the order of the robot's joints; infinity where there is no limit.

    The effort is `stiffness (target - q) - damping qd`, held within the torque-speed line of a DC
    motor, where there is one, and within the effort limit or its table over the joint angle.
    """

    stiffness: Array
    """Stiffness of each actuator, N m/rad."""
    damping: Array
    """Damping of each actuator, N m s/rad."""
    armature: Array
    """Rotor inertia as seen at the joint, kg m^2."""
    joint_damping: Array
    """Viscous friction of the joint, N m s/rad; NaN: the URDF's."""
    friction: Array
    """Dry friction of the joint, N m; NaN: the URDF's."""
    spring: Array
    """Stiffness, N m/rad, and angle at rest, rad, of the joint's passive spring, [joints, 2]."""
    effort_limit: Array
    """Effort limit of each actuator, N m."""
    saturation_effort: Array
    """Torque of a DC motor at standstill, N m."""
    no_load_speed: Array
    """Speed of a DC motor without load, rad/s."""
    speed_limit: Array
    """Largest speed of a joint that no DC motor drives, rad/s."""
    effort_tables: tuple[Array | None, ...]
    """Rows of (rad, N m) in place of the effort limit."""
    delay: Array
    """Fewest and most physics steps by which targets come late, [joints, 2]."""
    groups: tuple[str, ...]
    """Name of each joint's group; joints of a group are late together."""
    networks: npt.NDArray[np.bool_]
    """Joints whose torque a network gives in the place of the gains, [joints]."""

    def effort_range(self, position: Array, velocity: Array) -> Array:
        """Least and most effort [..., joints, 2] at these joint positions and velocities."""
        limit = np.broadcast_to(self.effort_limit, position.shape).copy()
        for joint, table in enumerate(self.effort_tables):
            if table is not None:
                limit[..., joint] = np.interp(position[..., joint], table[:, 0], table[:, 1])
        motor = np.isfinite(self.saturation_effort)
        stall = np.where(motor, self.saturation_effort, 0.0)
        speed = velocity / self.no_load_speed
        most = np.where(motor, np.clip(stall * (1.0 - speed), 0.0, limit), limit)
        least = np.where(motor, np.clip(-stall * (1.0 + speed), -limit, 0.0), -limit)
        return np.stack([least, most], axis=-1)


@dataclasses.dataclass(frozen=True)
class Surface:
    """Surface of some links where they touch the ground."""

    bodies: tuple[str, ...]
    """Patterns on names of links."""
    friction: float = 1.0
    """Factor on the coefficient of sliding friction."""
    torsional_friction: float = 0.0
    rolling_friction: float = 0.0
    """Least coefficients, m."""
    contact_margin: float = 0.0
    """Distance from the ground at which contact begins, m."""


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot of the library, or of a config."""

    name: str
    urdf: str
    """The URDF's text; without shapes where `outline` has them."""
    joint_names: tuple[str, ...]
    """Names of the joints in polypod's order."""
    default_position: Array
    """Default position of each joint, rad."""
    joint_range: Array
    """Position limits, rad, [joints, 2]."""
    base_height: float
    """Height of the base above the lowest foot in the default pose, m."""
    actuators: Actuators
    locked_joints: dict[str, float]
    """Joints of the URDF that are held for good, by name, and where, rad or m."""
    source: str
    """Name of the robot in the library, or the path of its config."""
    needs_policy: bool
    """Whether its config says that only a policy can balance it."""
    urdf_file: str
    """`urdf` of its config."""
    narrowed: tuple[tuple[float, float], ...]
    """Position limits that its config states in the place of the file's, in the directions of
    slots, rad or m."""
    origin: Origin | None = None
    """The MJCF file that it comes from; None: it is compared with MuJoCo's model of its URDF."""
    surfaces: tuple[Surface, ...] = ()
    outline: Mapping[str, Any] | None = None
    """The robot's entry of `VecSim.robot_shapes` where its URDF names meshes."""

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def with_gains(self, factor: float) -> "Robot":
        """The same robot with `factor` times the stiffness and damping."""
        actuators = self.actuators
        stiffness, damping = factor * actuators.stiffness, factor * actuators.damping
        return dataclasses.replace(self, actuators=dataclasses.replace(actuators, stiffness=stiffness, damping=damping))

    def without_speed_limits(self) -> "Robot":
        """The same robot with joints that turn at any speed; torque-speed lines of motors stay."""
        actuators = dataclasses.replace(self.actuators, speed_limit=np.full(self.num_joints, np.inf))
        return dataclasses.replace(self, actuators=actuators)


TASK = "velocity_flat_legged_play"
"""Has a reward set for every robot of the library."""


def names(*, standing: bool = False) -> list[str]:
    """The robots of the library.

    `standing`: but for those whose config says that they need a policy to stand.
    """
    return [entry["name"] for entry in _core.robots() if not (standing and entry["needs_policy"])]


@functools.cache
def load(source: str) -> Robot:
    """Reads a robot with its actuators, by its name or the path of its config.

    Raises:
        UnknownNameError: for another name.
        ConfigError: for a config that cannot be read, and for a robot whose actuators are networks.
    """
    sim = _core.VecSim(TASK, 1, robots=[source], threads=1)
    (name,) = sim.robots
    robot = of(sim, name, source)
    base = str(_core.Simulation(source, threads=1, ground=None).link_names[0])
    robot = dataclasses.replace(robot, origin=origin_of(source, robot.urdf_file, base))
    if robot.actuators.networks.any():
        raise _core.ConfigError(
            f"{name}: its actuators are networks, and simulators are compared under gains; compare the robot it "
            "extends, or its policy with polypod sim2sim"
        )
    return robot


@contextlib.contextmanager
def with_actuators(robot: Robot, groups: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    """The path of a config that differs from the robot's in these keys of its actuator groups."""
    tables = (
        f"[actuators.{group}]\n" + "".join(f"{key} = {float(value)!r}\n" for key, value in keys.items())
        for group, keys in groups.items()
    )
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / f"{robot.name}.toml"
        above = str(Path(robot.source).absolute()) if robot.source.endswith(".toml") else robot.source
        identity = f'extends = {json.dumps(above)}\nname = "{robot.name}"\ntitle = "{robot.name}"\n'
        config.write_text(identity + "".join(tables), encoding="utf-8")
        yield str(config)


def of(sim: _core.VecSim, name: str, source: str) -> Robot:
    """The robot `name` of a simulation.

    `source` is its name, or the path of its config.
    """
    info = simulated.robots(sim)[name]
    config = simulated.config(sim)["robots"][name]
    groups = config["actuators"]
    of_slot = simulated.slot_of_joint(info)
    slots = [of_slot[joint] for joint in range(len(info["joint_names"]))]
    of_joint = [
        next(key for key, group in groups.items() if any(fnmatchcase(slot, p) for p in group["joints"]))
        for slot, _ in slots
    ]
    urdf = rooted(_core.robot_urdf(source), _core.Simulation(source, threads=1, ground=None).link_names[0])
    bare = contact_shapes.without_shapes(urdf)
    return Robot(
        name=name,
        urdf=urdf if bare is None else bare,
        joint_names=tuple(info["joint_names"]),
        default_position=np.array(info["default_pose"]),
        joint_range=np.stack([_limits(info["lower"], -np.inf), _limits(info["upper"], np.inf)], axis=1),
        base_height=info["base_height"],
        actuators=_actuators(
            [groups[key] for key in of_joint],
            tuple(of_joint),
            [sign for _, sign in slots],
            effort_limit=_limits(info["effort_limit"], np.inf),
            velocity_limit=_limits(info["velocity_limit"], np.inf),
        ),
        locked_joints=config.get("locked_joints", {}),
        source=source,
        needs_policy=_needs_policy(source),
        urdf_file=config["urdf"],
        narrowed=tuple((lower, upper) for lower, upper in config.get("joint_limits", {}).values()),
        surfaces=tuple(
            Surface(**{**table, "bodies": tuple(table["bodies"])}) for table in config.get("surfaces", {}).values()
        ),
        outline=None if bare is None else simulated.shapes(sim)[name],
    )


def _needs_policy(source: str) -> bool:
    """Whether a robot's config, or one that it extends, says that only a policy can balance it.

    A resolved task does not hold the key: it sets nothing.
    """
    texts, _ = _core.explain_robot(source)
    stated = [tables["needs_policy"] for _, text in texts if "needs_policy" in (tables := tomllib.loads(text))]
    return bool(stated and stated[-1])


def _limits(values: Sequence[float | None], absent: float) -> Array:
    """Limits of all joints; JSON has no infinity."""
    return np.array([absent if value is None else value for value in values], dtype=np.float64)


def _actuators(
    rows: list[dict[str, Any]],
    groups: tuple[str, ...],
    signs: list[float],
    effort_limit: Array,
    velocity_limit: Array,
) -> Actuators:
    """Actuators of all joints from their groups' tables.

    `signs` are -1 where a joint turns the other way round than its slot, whose direction configs
    are in. The limits are those that polypod holds, wherever they are stated.
    """

    def table(row: dict[str, Any], sign: float) -> Array | None:
        if not row.get("effort_table"):
            return None
        angles = np.array(row["effort_table"]) * [sign, 1.0]
        return angles if sign > 0 else angles[::-1]

    def column(key: str, default: float) -> Array:
        return np.array([row.get(key, default) for row in rows], dtype=np.float64)

    motor = np.array(["saturation_effort" in row for row in rows])
    networks = np.array(["network_file" in row for row in rows])
    return Actuators(
        stiffness=np.where(networks, 0.0, column("stiffness", 0.0)),
        damping=np.where(networks, 0.0, column("damping", 0.0)),
        armature=column("armature", 0.0),
        joint_damping=column("joint_damping", np.nan),
        friction=column("friction", np.nan),
        spring=np.stack([column("spring_stiffness", 0.0), signs * column("spring_reference", 0.0)], axis=-1),
        effort_limit=effort_limit,
        saturation_effort=np.where(motor, column("saturation_effort", np.inf), np.inf),
        no_load_speed=np.where(motor, velocity_limit, np.inf),
        speed_limit=np.where(motor, np.inf, velocity_limit),
        effort_tables=tuple(table(row, sign) for row, sign in zip(rows, signs, strict=True)),
        delay=np.array([row.get("delay", [0, 0]) for row in rows], dtype=np.float64),
        groups=groups,
        networks=networks,
    )
