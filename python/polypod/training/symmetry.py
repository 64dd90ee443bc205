"""Left and right exchanged: what a quadruped's observations and actions become in a mirror.

Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024: PPO learns faster when
every sample is also seen mirrored.
"""

import json

import torch
from tensordict import TensorDict

from polypod import _core
from polypod.compat import tomllib
from polypod.rsl_rl import VecEnv
from polypod.training.config import OBSERVATION_GROUP

_VECTOR = [(0, 1.0), (1, -1.0), (2, 1.0)]
_PSEUDOVECTOR = [(0, -1.0), (1, 1.0), (2, -1.0)]
_FIXED_TERMS = {
    "base_lin_vel": _VECTOR,
    "base_ang_vel": _PSEUDOVECTOR,
    "projected_gravity": _VECTOR,
    "velocity_commands": [(0, 1.0), (1, -1.0), (2, -1.0)],
}
_JOINT_TERMS = ("joint_pos_rel", "joint_vel_rel", "last_action")


class Mirror:
    """Mirrors observations and actions; `augment` is what rsl_rl's symmetry extension calls."""

    def __init__(self, env: VecEnv, device: str) -> None:
        """For the robots and the observation of `env`.

        Raises:
            ConfigError: when the robots of the run have different mirrors, or an observation term has none.
        """
        sim = env.unwrapped.sim
        infos = json.loads(sim.robot_info())
        mirrors = {name: [(int(slot), float(sign)) for slot, sign in info["mirror"]] for name, info in infos.items()}
        first, joints = next(iter(mirrors.items()))
        for name, mirror in mirrors.items():
            if mirror != joints:
                raise _core.ConfigError(
                    f"joints of {first} and {name} change sign differently in a mirror: set symmetry = false in [run]"
                )
        self._actions = _tensors(joints, device)
        self._observations = _tensors(_observation_mirror(sim.observation_layout, joints, _scan_rows(sim)), device)

    def augment(
        self, env: VecEnv, obs: TensorDict | None, actions: torch.Tensor | None
    ) -> tuple[TensorDict | None, torch.Tensor | None]:
        """Each sample, then each sample's mirror image.

        Args:
            env: the env, which is not looked at.
            obs: group `policy`, [n, num_obs].
            actions: [n, num_actions].

        Returns:
            Both with 2 n rows.
        """
        if obs is not None:
            policy = obs[OBSERVATION_GROUP]
            both = torch.cat([policy, _mirrored(policy, self._observations)])
            obs = TensorDict({OBSERVATION_GROUP: both}, batch_size=[both.shape[0]], device=obs.device)
        if actions is not None:
            actions = torch.cat([actions, _mirrored(actions, self._actions)])
        return obs, actions


def _scan_rows(sim: _core.VecSim) -> int:
    """Rows of the height scanner's rays from right to left; 0 without one."""
    scanner = tomllib.loads(sim.resolved_config())["task"].get("sensors", {}).get("height_scanner")
    # as the simulator counts them
    return int(scanner["size"][1] / scanner["resolution"] + 1e-9) + 1 if scanner else 0


def _observation_mirror(
    layout: list[tuple[str, int]], joints: list[tuple[int, float]], scan_rows: int
) -> list[tuple[int, float]]:
    mirror: list[tuple[int, float]] = []
    for name, size in layout:
        if name in _JOINT_TERMS:
            term = joints
        elif name == "morphology":
            # all but the default pose, 12 numbers before the last, are means over the legs
            term = [(i, 1.0) for i in range(size)]
            start = size - 1 - len(joints)
            term[start:-1] = [(start + slot, sign) for slot, sign in joints]
        elif name == "height_scan":
            # rows from right to left, each from back to front
            length = size // scan_rows
            rows = [range(row * length, (row + 1) * length) for row in reversed(range(scan_rows))]
            term = [(index, 1.0) for row in rows for index in row]
        elif name in _FIXED_TERMS:
            term = _FIXED_TERMS[name]
        else:
            raise _core.ConfigError(
                f"it is not known how the observation term {name} is mirrored: set symmetry = false in [run]"
            )
        start = len(mirror)
        mirror += [(start + index, sign) for index, sign in term]
    return mirror


def _tensors(mirror: list[tuple[int, float]], device: str) -> tuple[torch.Tensor, torch.Tensor]:
    indices = torch.tensor([index for index, _ in mirror], device=device)
    return indices, torch.tensor([sign for _, sign in mirror], device=device)


def _mirrored(rows: torch.Tensor, mirror: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    indices, signs = mirror
    return rows.index_select(1, indices) * signs
