"""The published gate of nanoG1, measured here: `eval --gate`.

Source: kingjulio8238/nanoG1, RESULTS.md, 17 June 2026.

A battery of six commands, each held for 20 s by four envs, counts falls and scores how well
commands are followed. A walk ahead at 0.5 m/s for 40 s tells how smooth the motion is. `BOUNDS` are
nanoG1's; commands and times are those of a public reimplementation. Two figures differ between the
projects: the score's formula is not published, so the one here is `measures.tracking`; actions are
in the units of the policy, and the jerk grows with the action scale.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polypod import _core, simulated
from polypod.arrays import Array
from polypod.evaluation import measures
from polypod.evaluation.rollout import play_task, undisturbed
from polypod.networks.policies import Policy, reset

COMMANDS = ((0.8, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.3, 0.0, 1.0), (0.3, 0.0, -1.0), (0.0, 0.4, 0.0), (0.0, 0.0, 0.0))
"""Commands of the battery: forward and left velocity, m/s, and yaw rate, rad/s."""
ENVS_PER_COMMAND = 4
BATTERY_S = 20.0
WALK = (0.5, 0.0, 0.0)
"""Command of the walk ahead."""
WALK_S = 40.0
BOUNDS = {
    "battery_falls": 1.0,
    "battery_perf": 0.90,
    "action_jerk_rms": 0.21,
    "ang_vel_xy_rms": 0.21,
    "yaw_rate_rms": 0.20,
    "leg_qvel_rms": 1.22,
}
"""nanoG1's; `battery_perf` is the least, the others are the most."""
_LEG_ROLES = ("HIP", "KNEE", "ANKLE", "HAA", "HFE", "KFE")


@dataclasses.dataclass(frozen=True)
class Gate:
    """One robot's figures."""

    battery_falls: int
    """Falls over all envs and commands."""
    battery_perf: float
    """Mean over time of `measures.tracking`, at most 1."""
    action_jerk_rms: float
    """Root of the mean square of the change of the legs' actions from one control step to the
    next."""
    ang_vel_xy_rms: float
    """Root mean square of roll and pitch rate together, rad/s."""
    yaw_rate_rms: float
    """Root mean square of the yaw rate, rad/s."""
    leg_qvel_rms: float
    """Root mean square of the speeds of the legs' joints, rad/s."""
    walk_falls: int
    """Falls in the walk ahead; not bounded."""

    @property
    def passes(self) -> bool:
        """Whether all bounds hold."""
        return not self.missed

    @property
    def missed(self) -> list[str]:
        """Names of the bounds that do not hold; none holds for NaN."""
        values = {name: float(getattr(self, name)) for name in BOUNDS}
        return [
            name
            for name, bound in BOUNDS.items()
            if not (values[name] >= bound if name == "battery_perf" else values[name] <= bound)
        ]


def measure(
    policy: Policy,
    task: str,
    robots: Sequence[str],
    *,
    seed: int = 0,
    threads: int | None = None,
    trained: Sequence[str] = (),
    overrides: Sequence[str] = (),
    slots: Sequence[str] = (),
) -> dict[str, Gate]:
    """The gate's figures of each robot, by name.

    Args:
        policy: see `Policy`.
        task: name or alias of the task, or of its Play variant.
        robots: names, or paths of configs.
        seed: of initial states.
        threads: of the simulator; None: one per core.
        trained: `key=value` pairs that the policy was trained with; their noise and events are off.
        overrides: further pairs.
        slots: names of the policy's actions, where it knows more robots than are here.

    Raises:
        ConfigError: for an unknown task or robot.
    """
    play = play_task(task)
    changes = [*trained, *undisturbed(play, trained), f"sim.episode_length_s={2.0 * WALK_S}", *overrides]

    def sim_of(envs_per_robot: int) -> _core.VecSim:
        return _core.VecSim(
            play,
            envs_per_robot * len(robots),
            robots=list(robots),
            seed=seed,
            threads=threads,
            overrides=changes,
            autoreset="disabled",
            slots=list(slots),
        )

    sim = sim_of(len(COMMANDS) * ENVS_PER_COMMAND)
    commands = np.tile(np.repeat(np.array(COMMANDS, dtype=np.float32), ENVS_PER_COMMAND, axis=0), (len(robots), 1))
    battery = _run(sim, policy, commands, BATTERY_S)
    sim = sim_of(1)
    walk = _run(sim, policy, np.tile(np.array(WALK, dtype=np.float32), (len(robots), 1)), WALK_S)
    found = {}
    infos = simulated.robots(sim)
    for index, robot in enumerate(sim.robots):
        envs = slice(index * len(COMMANDS) * ENVS_PER_COMMAND, (index + 1) * len(COMMANDS) * ENVS_PER_COMMAND)
        info = infos[robot]
        legs = [
            column
            for slot, column in zip(info["slots"], info["columns"], strict=True)
            if any(role in slot for role in _LEG_ROLES)
        ]
        found[robot] = Gate(
            battery_falls=int(battery.fell[:, envs].sum()),
            battery_perf=float(battery.score[:, envs].mean()),
            action_jerk_rms=_rms(walk.jerk[:, index][walk.is_on[:, index]][:, legs]),
            ang_vel_xy_rms=_rms(np.linalg.norm(walk.rates[:, index, :2], axis=1)[~walk.fell[:, index]]),
            yaw_rate_rms=_rms(walk.rates[:, index, 2][~walk.fell[:, index]]),
            leg_qvel_rms=_rms(walk.speeds[:, index][~walk.fell[:, index]][:, legs]),
            walk_falls=int(walk.fell[:, index].sum()),
        )
    return found


@dataclasses.dataclass(frozen=True)
class _Motion:
    """Motion of the robots, by control steps and envs."""

    fell: npt.NDArray[np.bool_]
    score: Array
    jerk: Array
    """Change of the actions, [steps, envs, slots]."""
    is_on: npt.NDArray[np.bool_]
    """Whether the step before was of the same episode, [steps, envs]."""
    rates: Array
    """Angular velocities of the bases, [steps, envs, 3]."""
    speeds: Array
    """Speeds of the joints, [steps, envs, slots]."""


def _run(sim: _core.VecSim, policy: Policy, commands: npt.NDArray[np.float32], seconds: float) -> _Motion:
    sim.set_command(commands)
    sim.reset()
    reset(policy)
    fell, score, jerk, is_on, rates, speeds = ([] for _ in range(6))
    before, goes_on = np.zeros((sim.num_envs, sim.num_actions)), np.zeros(sim.num_envs, dtype=np.bool_)
    for _ in range(round(seconds / sim.step_dt)):
        actions = policy(sim.observation)
        sim.step(actions)
        velocity, turning = sim.state("base_lin_vel"), sim.state("base_ang_vel").astype(np.float64)
        errors = np.linalg.norm(commands[:, :2] - velocity[:, :2], axis=1), np.abs(commands[:, 2] - turning[:, 2])
        fallen = sim.terminated.copy()
        fell.append(fallen)
        score.append(np.where(fallen, 0.0, measures.tracking(*errors)))
        jerk.append(actions.astype(np.float64) - before)
        is_on.append(goes_on & ~fallen)
        rates.append(turning)
        speeds.append(sim.state("joint_vel").astype(np.float64))
        before, goes_on = actions.astype(np.float64), ~fallen
        done = sim.terminated | sim.truncated
        if done.any():
            sim.reset(mask=done)
            reset(policy, done)
            goes_on &= ~done
    return _Motion(*(np.stack(of) for of in (fell, score, jerk, is_on, rates, speeds)))


def _rms(values: Array) -> float:
    """Root of the mean square; NaN without a value."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")
