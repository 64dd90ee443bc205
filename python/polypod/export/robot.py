"""Interface of a policy and one robot: sensors to observation, action to joints."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polypod import _core, simulated
from polypod.arrays import Floats
from polypod.export.sources import check
from polypod.observation import Term, placed, terms_of

INPUTS = {
    "base_lin_vel": "velocity of the base link's origin, base axes, m/s",
    "base_ang_vel": "angular velocity of the base, base axes, rad/s",
    "projected_gravity": "unit vector of gravity in base axes: (0, 0, -1) for a level robot",
    "velocity_commands": "forward and left velocity, m/s, and yaw rate, rad/s, that the robot is to follow",
    "joint_pos": "joint positions in the robot's own order, rad",
    "joint_vel": "joint velocities in the robot's own order, rad/s",
    "height_scan": "height of the base link's origin above the ground below each point of `height_scan_points`, m",
    "last_action": "the output `actions` of the control step before; zeros at first",
}
"""Inputs of a folded graph and what they are, each `[batch, size]`."""

OUTPUTS = {
    "joint_pos_target": "joint position targets in the robot's own order, rad",
    "actions": "the action in canonical order, 0 where the robot has no joint: the next step's `last_action`",
}
"""Outputs of the network."""


@dataclasses.dataclass(frozen=True)
class RobotInterface:
    """Numbers of one robot, in the order of its joints unless stated otherwise."""

    name: str
    terms: tuple[Term, ...]
    """Terms of the policy's observation, in order."""
    joint_names: tuple[str, ...]
    joint_of_slot: npt.NDArray[np.int64]
    """Index of the joint in each of the robot's slots."""
    columns: npt.NDArray[np.int64]
    """Column of each of these slots in the policy's action."""
    signs: Floats
    """Sign of each slot: 1, or -1 where the joint's own positive direction is opposite to the
    slot's."""
    action_names: tuple[str, ...]
    """Columns of the policy's action: slots, of which the robot has some."""
    default_pose: Floats
    """Joint positions of the default pose, rad."""
    action_scale: float
    """rad per unit of action."""
    base_com: Floats
    """Centre of mass of the base in its frame, m: the task observes its velocity."""
    constants: Mapping[str, Floats]
    """Values of the terms that describe the body, as the policy observes them."""
    scan_points: Floats
    """Points where the height scanner looks, m, [rays, 2]: ahead of the base's origin and to its
    left, along its heading."""
    command_ranges: Mapping[str, Sequence[float]]
    """`lin_vel_x`, `lin_vel_y` (m/s) and `ang_vel_z` (rad/s) of the training's commands: [low,
    high]."""
    info: simulated.RobotInfo
    """All that the simulator says of the robot (`VecSim.robot_info`)."""
    config: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The robot's config, with all defaults (`VecSim.resolved_config`)."""
    task: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Config of the task, its events included."""

    @property
    def num_actions(self) -> int:
        """Columns of the policy's action."""
        return len(self.action_names)

    def inputs(self) -> dict[str, int]:
        """Names and sizes of what the robot's sensors give to the folded graph."""
        joints = len(self.joint_names)
        sizes = {term.inputs[0]: term.width for term in self.terms if len(term.inputs) == 1}
        sizes |= {"joint_pos": joints, "joint_vel": joints, "last_action": self.num_actions}
        needed = [name for term in self.terms for name in term.inputs]
        in_order = [name for name in INPUTS if name in needed] + [name for name in needed if name not in INPUTS]
        return {name: sizes.get(name, 3) for name in dict.fromkeys(in_order)}

    def remembered(self) -> int:
        """Past numbers of the terms that the folded graph remembers."""
        return sum(term.size - term.width for term in self.terms if term.inputs)

    def states(self) -> dict[str, tuple[int, ...]]:
        """States of the folded graph without the network's own states.

        See `polypod.export.states`.
        """
        return {"history_in": (1 + self.remembered(),)} if self.remembered() else {}

    def meaning(self, name: str) -> str:
        """Describes an input or output of the folded graph."""
        known = INPUTS.get(name) or OUTPUTS.get(name)
        return known or next(f"{term.description} {term.units}".strip() for term in self.terms if term.term == name)

    def lever(self) -> Floats:
        """Matrix from an angular velocity to the centre of mass' about the origin, [3, 3]."""
        x, y, z = self.base_com
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=np.float32)

    def spread(self) -> Floats:
        """Matrix of the actions in `default_pose + action @ spread`, [num_actions, joints]."""
        spread = np.zeros((self.num_actions, len(self.joint_names)), dtype=np.float32)
        spread[self.columns, self.joint_of_slot] = self.action_scale * self.signs
        return spread

    def is_plain(self) -> bool:
        """Whether the action has the robot's columns alone, and no joint's sign is turned."""
        return len(self.columns) == self.num_actions and bool((self.signs == 1.0).all())

    def gather(self) -> Floats:
        """Matrix that maps numbers of joints to the policy's columns, [joints, num_actions].

        Columns of other joints get 0.
        """
        gather = np.zeros((len(self.joint_names), self.num_actions), dtype=np.float32)
        gather[self.joint_of_slot, self.columns] = self.signs
        return gather

    def mask(self) -> Floats:
        """Mask of the actions, [num_actions]: 1 where the robot has a joint, else 0."""
        mask = np.zeros(self.num_actions, dtype=np.float32)
        mask[self.columns] = 1.0
        return mask


def interfaces(manifest: Mapping[str, Any], robots: Sequence[str] | None = None) -> dict[str, RobotInterface]:
    """The interfaces of a policy to robots.

    Args:
        manifest: the checkpoint's manifest.
        robots: names or paths of configs; None: those that the policy was trained on.

    Raises:
        ConfigError: for an unknown task or robot, and for a task that has changed since the
            training.
    """
    sim, configs = _undisturbed(manifest, robots)
    task = configs["task"]
    scan_points = _scan_points(task.get("sensors", {}).get("height_scanner"))
    layout = tuple(sim.observation_layout)
    trained = tuple((entry["term"], entry["size"]) for entry in manifest["observation_layout"])
    if layout != trained:
        raise _core.ConfigError(
            f"{manifest['task']} observes {_terms(layout)}, but the policy was trained on {_terms(trained)}; "
            "use the version of the task that it was trained on"
        )
    terms = terms_of(sim)
    for term in terms:
        check(term, INPUTS)
    constants = {term.term: columns for term, columns in placed(terms) if term.source == "robot_constant"}
    infos, shapes = simulated.robots(sim), simulated.shapes(sim)
    observation = sim.observation
    return {
        robot: RobotInterface(
            name=robot,
            terms=terms,
            joint_names=tuple(infos[robot]["joint_names"]),
            joint_of_slot=np.array(infos[robot]["joint_of_slot"], dtype=np.int64),
            columns=np.array(infos[robot]["columns"], dtype=np.int64),
            signs=np.array(infos[robot]["slot_signs"], dtype=np.float32),
            action_names=tuple(sim.canonical_joint_names),
            default_pose=np.array(infos[robot]["default_pose"], dtype=np.float32),
            action_scale=infos[robot]["action_scale"],
            base_com=np.array(shapes[robot]["base_com"], dtype=np.float32),
            constants={term: observation[sim.env_ids(robot)[0], columns].copy() for term, columns in constants.items()},
            scan_points=scan_points,
            command_ranges=sim.command_ranges()[robot],
            info=infos[robot],
            config=configs["robots"][robot],
            task=task,
        )
        for robot in sim.robots
    }


def changes(manifest: Mapping[str, Any], robots: Mapping[str, RobotInterface]) -> list[str]:
    """Changes of the robots since the training, one line each."""
    lines = []
    for name, robot in robots.items():
        trained = manifest.get("robot_info", {}).get(name)
        for key, value in robot.info.items() if trained is not None else ():
            if key in trained and trained[key] != value:
                lines.append(f"{name}: {key} is not what the policy was trained on")
    return lines


def _undisturbed(manifest: Mapping[str, Any], robots: Sequence[str] | None) -> tuple[_core.VecSim, dict[str, Any]]:
    """One env per robot of the policy's task without noise and events.

    Returns it with the configs of the robots and the task.
    """
    names = list(manifest["robot_sources"] if robots is None else robots)
    overrides = [*manifest["overrides"], "observations.enable_noise=false"]
    slots = manifest["canonical_joint_names"]
    sim = _core.VecSim(manifest["task"], len(names), robots=names, threads=1, overrides=overrides, slots=slots)
    configs = simulated.config(sim)
    off = [f"events.{name}.enabled=false" for name in configs["task"].get("events", {})]
    sim = _core.VecSim(manifest["task"], len(names), robots=names, threads=1, overrides=[*overrides, *off], slots=slots)
    return sim, configs


def _scan_points(scanner: Mapping[str, Any] | None) -> Floats:
    """Points of the scan in the simulator's order: from back to front, rows from right to left."""
    if scanner is None:
        return np.zeros((0, 2), dtype=np.float32)
    size, resolution = scanner["size"], scanner["resolution"]
    x, y = (np.arange(int(length / resolution + 1e-9) + 1) * resolution - 0.5 * length for length in size)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float32)


def _terms(layout: Sequence[tuple[str, int]]) -> str:
    return ", ".join(f"{term} ({size})" for term, size in layout)
