"""Identities: what both simulators compute from one state, at many random states."""

import dataclasses

import numpy as np

import polypod
from polypod import rotations
from polypod.accuracy.result import Result
from polypod.arrays import Array
from polypod.mujoco_model.reference import Reference
from polypod.mujoco_model.robot import Robot

NUM_STATES = 200
"""Random states per robot."""


@dataclasses.dataclass(frozen=True)
class StaticsResult(Result):
    """Worst relative error of each quantity over all states.

    The relative error of a vector or matrix is the largest absolute difference between entries over
    the largest absolute entry of MuJoCo's, in each state by itself. A force or acceleration mixes
    units, as in both simulators.
    """

    states: int
    total_mass: float
    center_of_mass: float
    link_position: float
    """Error of the origins of all links, world axes."""
    link_rotation: float
    """Error of the rotation matrices of all links."""
    mass_matrix: float
    bias_force: float
    forward_dynamics: float
    """Error of qacc under random torques, without damping, friction and joint limits; over the
    state's largest qacc."""
    inverse_dynamics: float
    """Error of the forces that MuJoCo's qacc needs."""

    def worst(self) -> float:
        """The largest of the errors."""
        return max(
            self.total_mass,
            self.center_of_mass,
            self.link_position,
            self.link_rotation,
            self.mass_matrix,
            self.bias_force,
            self.forward_dynamics,
            self.inverse_dynamics,
        )


def relative_error(value: Array, reference: Array) -> float:
    """Largest absolute difference over the largest absolute entry of `reference`."""
    return float(np.abs(value - reference).max() / np.abs(reference).max())


def compare_statics(robot: Robot, *, states: int = NUM_STATES, seed: int = 0, dtype: str = "float32") -> StaticsResult:
    """Compares a robot of the library at random states.

    Base: position within 1 m of the origin, uniform orientation, up to 1 m/s and 3 rad/s along each
    axis. Joints: uniform within their ranges (at most a half turn), up to 5 rad/s. Torques: up to
    the effort limit.
    """
    rng = np.random.default_rng(seed)
    sim = polypod.Simulation(robot.source, states, ground=None, dtype=dtype, self_collision=False, threads=1)
    mujoco = Reference.of(robot, dt=sim.dt)
    joints = robot.num_joints
    limits = np.clip(robot.joint_range, -np.pi, np.pi)
    quaternion = rng.standard_normal((states, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    qpos = np.hstack(
        [rng.uniform(-1.0, 1.0, (states, 3)), quaternion, rng.uniform(limits[:, 0], limits[:, 1], (states, joints))]
    )
    qvel = np.hstack([rng.uniform(-s, s, (states, n)) for s, n in ((1.0, 3), (3.0, 3), (5.0, joints))])
    # a joint without a limit is driven by as much as the strongest of the library
    torque = rng.uniform(-1.0, 1.0, (states, joints)) * np.minimum(sim.effort_limit, 1000.0)
    sim.set_state(qpos, qvel)

    # a body with several joints is a chain of links in polypod, of which MuJoCo has the last one
    links = [link for link in sim.link_names if mujoco.has_link(link)]
    kept = [place for place, link in enumerate(sim.link_names) if link in links]
    position, rotation = sim.link_pose()
    ours = {
        "center_of_mass": sim.center_of_mass(),
        "link_position": position[:, kept],
        "link_rotation": rotations.matrix(rotation[:, kept]),
        "mass_matrix": sim.mass_matrix(),
        "bias_force": sim.bias_force(),
        "forward_dynamics": sim.forward_dynamics(torque),
    }
    theirs: dict[str, list[Array]] = {name: [] for name in ours}
    for state in range(states):
        mujoco.set_state(qpos[state], qvel[state])
        at, turned = mujoco.link_pose(links)
        force = np.concatenate([np.zeros(6), torque[state]]) - mujoco.bias_force()
        for name, value in {
            "center_of_mass": mujoco.center_of_mass(),
            "link_position": at,
            "link_rotation": turned,
            "mass_matrix": mujoco.mass_matrix(),
            "bias_force": mujoco.bias_force(),
            "forward_dynamics": np.asarray(np.linalg.solve(mujoco.mass_matrix(), force), dtype=np.float64),
        }.items():
            theirs[name].append(value)
    qacc = np.array(theirs["forward_dynamics"])
    ours["inverse_dynamics"] = sim.inverse_dynamics(qacc)
    theirs["inverse_dynamics"] = [
        matrix @ acceleration + bias
        for matrix, acceleration, bias in zip(theirs["mass_matrix"], qacc, theirs["bias_force"], strict=True)
    ]
    errors = {
        name: max(relative_error(a, b) for a, b in zip(values, theirs[name], strict=True))
        for name, values in ours.items()
    }
    mass = float(np.sum(mujoco.model.body_mass))
    return StaticsResult(robot.name, states, abs(sim.total_mass - mass) / mass, **errors)
