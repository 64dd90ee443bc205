"""Measures terms in Python next to the same terms in Rust: `python -m lab.terms_cost [ENVS]`.

Prints the table of docs/write-a-term.md. One thread; the time is the processor's, of which a busy
machine changes less.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import polypod
from polypod import terms
from polypod.vector_env import VectorEnv

ROBOT = "unitree_go2"
ENVS = 4096
STEPS, ROUNDS = 4, 60
"""Control steps of a measurement, and measurements of which the shortest counts."""
WEIGHTS = {
    "track_lin_vel_xy_exp": 1.5,
    "track_ang_vel_z_exp": 0.75,
    "lin_vel_z_l2": -2.0,
    "ang_vel_xy_l2": -0.05,
    "flat_orientation_l2": -2.5,
    "dof_torques_l2": -2e-4,
    "dof_acc_l2": -2.5e-7,
    "action_rate_l2": -0.01,
}
"""Reward terms of Go2 in the task `velocity_flat`, all but the one that remembers flights."""

Array = npt.NDArray[Any]


def squares(array: Array) -> Array:
    """Sum of squares of each env."""
    total: Array = np.square(array).sum(axis=1)
    return total


FORMULAS: dict[str, Any] = {
    "track_lin_vel_xy_exp": lambda env: np.exp(-squares(env.command[:, :2] - env.base_lin_vel[:, :2]) / 0.25),
    "track_ang_vel_z_exp": lambda env: np.exp(-np.square(env.command[:, 2] - env.base_ang_vel[:, 2]) / 0.25),
    "lin_vel_z_l2": lambda env: np.square(env.base_lin_vel[:, 2]),
    "ang_vel_xy_l2": lambda env: squares(env.base_ang_vel[:, :2]),
    "flat_orientation_l2": lambda env: squares(env.projected_gravity[:, :2]),
    "dof_torques_l2": lambda env: squares(env.joint_effort),
    "dof_acc_l2": lambda env: squares(env.joint_acc),
    "action_rate_l2": lambda env: squares(env.last_action - env.previous_action),
}
"""The same terms in Python."""


@terms.observation(size=1, mirror="per_joint", history_length=3, name="speeds")
def speeds(env: Any) -> Array:
    """Joint velocities, rad/s."""
    velocities: Array = env.joint_vel
    return velocities


@terms.termination(name="leans")
def leans(env: Any) -> Array:
    """The base leans by more than 1 rad."""
    angle: Array = np.arccos(np.clip(-env.projected_gravity[:, 2], -1.0, 1.0))
    return angle > 1.0


@terms.command(size=3, resampling_time_s=(5.0, 10.0), name="stance")
def stance(env: Any, ids: Array) -> Array:
    """Height, roll and pitch."""
    values: Array = env.random.uniform(-0.1, 0.1, ids, size=3)
    return values


@terms.event(mode="interval", interval_range_s=(10.0, 15.0), name="push")
def push(env: Any, ids: Array) -> None:
    """A push to any side."""
    velocity = np.zeros((env.num_envs, 3), dtype=np.float32)
    velocity[ids, :2] = env.random.uniform(-0.5, 0.5, ids, size=2)
    env.sim.push(velocity)


@terms.metric(name="nothing")
def nothing(env: Any) -> Array:
    """Zero: a simulation with terms in Python, and the least that they do."""
    return np.zeros(env.num_envs)


@dataclass(frozen=True)
class Row:
    """A line of the table."""

    name: str
    rust: Sequence[str]
    """Changes of the task."""
    python: Sequence[Any]
    """Declarations."""


NONE = [*(f"rewards.unitree.{name}=null" for name in (*WEIGHTS, "feet_air_time")), "events.push_robot.enabled=false"]
"""Changes that leave a task without the terms below."""


def in_rust(name: str) -> str:
    """The change that adds a reward term."""
    more = ", std = 0.5" if name.startswith("track") else ""
    return f"rewards.unitree.{name}={{ weight = {WEIGHTS[name]}{more} }}"


def in_python(name: str) -> Any:
    """The declaration of a reward term."""
    return terms.reward(weight=WEIGHTS[name], name=f"own_{name}")(FORMULAS[name])


ROWS = [
    *(Row(f"reward `{name}`", [in_rust(name)], [in_python(name)]) for name in ("lin_vel_z_l2", "dof_torques_l2")),
    Row("eight rewards of `velocity_flat`", [in_rust(name) for name in WEIGHTS], [in_python(n) for n in WEIGHTS]),
    Row(
        "observation of joint velocities, 3 steps",
        ['observations.policy.+={ term = "joint_vel_rel", history_length = 3 }'],
        [speeds],
    ),
    Row("termination by the base's angle", ["terminations.bad_orientation={ limit_angle = 1.0 }"], [leans]),
    Row(
        "command of a pose, observed",
        ["commands.pose={}", 'observations.policy.+={ term = "pose_commands" }'],
        [stance],
    ),
    Row("pushes", ["events.push_robot.enabled=true"], [push]),
]


def make(envs: int, rust: Sequence[str] = (), python: Sequence[Any] = ()) -> VectorEnv:
    """The task on flat ground with some terms."""
    overrides = [*NONE, *rust]
    options: dict[str, Any] = {"terms": list(python)} if python else {}
    return polypod.make("velocity_flat", envs, robots=[ROBOT], seed=1, threads=1, overrides=overrides, **options)


def milliseconds(envs: int, sims: Sequence[VectorEnv]) -> list[float]:
    """Shortest time of a control step of each, ms; measured in turn."""
    least = [np.inf] * len(sims)
    actions = np.random.default_rng(0).normal(0.0, 0.3, (envs, sims[0].sim.num_actions)).astype(np.float32)
    for sim in sims:
        sim.reset(seed=1)
    for _ in range(ROUNDS):
        for index, sim in enumerate(sims):
            started = time.process_time()
            for _ in range(STEPS):
                sim.sim.step(actions)
            least[index] = min(least[index], (time.process_time() - started) / STEPS * 1e3)
    return least


def main(arguments: Sequence[str]) -> int:
    """Prints the table."""
    envs = int(arguments[0]) if arguments else ENVS
    pairs = [(make(envs, row.rust), make(envs, python=[nothing, *row.python])) for row in ROWS]
    sims = [make(envs), make(envs, python=[nothing]), *(sim for pair in pairs for sim in pair)]
    plain, empty, *both = milliseconds(envs, sims)
    print("| term | in Rust, ms | in Python, ms |")
    print("|---|---|---|")
    for row, rust, python in zip(ROWS, both[::2], both[1::2], strict=True):
        print(f"| {row.name} | {rust - plain:.2f} | {python - empty:.2f} |")
    print(f"| a simulation with any term in Python | - | {empty - plain:.2f} |")
    print(f"\nA step of {envs} envs of {ROBOT} without them takes {plain:.1f} ms of one core.")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
