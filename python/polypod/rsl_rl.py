"""The adapter for rsl_rl: `polypod.rsl_rl.VecEnv` is an `rsl_rl.env.VecEnv`.

>>> import polypod, polypod.rsl_rl
>>> env = polypod.rsl_rl.VecEnv(polypod.make("Velocity-Flat-HeteroQuadruped-v0", num_envs=4096), device="cpu")

Where the simulator makes whole control steps on the learner's card, all of a step stays there. Else
the simulator's arrays are the CPU's; with a CUDA device, observations, rewards and flags cross over
through pinned memory.
"""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from polypod._core import ConfigError, VecSim
from polypod.extras import missing
from polypod.terms import CustomTerms
from polypod.vector_env import VectorEnv

try:
    import rsl_rl.env
    import torch
    from tensordict import TensorDict

    from polypod.tensors import tensor_over
except ModuleNotFoundError as error:
    raise missing(error, "polypod.rsl_rl", "train") from error


_COPIERS = 4
"""Threads that copy a large array into pinned memory: one reaches a part of the memory's speed."""
_LARGE = 1 << 22
"""Least size of an array that several threads copy, bytes."""


class VecEnv(rsl_rl.env.VecEnv):
    """A polypod vector env as rsl_rl wants it.

    rsl_rl stores the observation of step t after it has taken step t + 1, so observations survive
    one further step: on the CPU they are views of the simulator's two alternating buffers. All
    other tensors are fresh, and so are observations on a GPU.
    """

    def __init__(
        self,
        env: VectorEnv | CustomTerms,
        device: str | torch.device = "cpu",
        log_extras: bool = True,
        clip_actions: float | None = None,
    ) -> None:
        """Wraps `env`.

        Args:
            env: with same-step autoreset, as in `polypod.terms.CustomTerms`.
            device: where the learner lives.
            clip_actions: greatest magnitude of the actions that the robots act with, as of rsl_rl's
                runners; None: no limit.
            log_extras: put the simulator's log into `extras["log"]` at each step that ends an
                episode. A learner which reads `unwrapped.sim.log()` by itself switches it off.

        Raises:
            ConfigError: for an env with another autoreset mode, and for CUDA where there is none.
        """
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ConfigError(
                f"this env has {env.autoreset_mode}, but rsl_rl needs polypod.make(..., autoreset='same_step')"
            )
        self.device = torch.device(device)
        if self.device.type == "cuda" and not torch.cuda.is_available():
            raise ConfigError("device='cuda', but torch finds no CUDA device; use device='cpu'")
        self.unwrapped = env
        self._sim = env.sim
        self._source: VecSim | CustomTerms = env if isinstance(env, CustomTerms) else env.sim
        self._log_extras = log_extras
        self._clip_actions = clip_actions
        self.num_envs = env.num_envs
        self.num_actions = self._sim.num_actions
        self.max_episode_length = self._sim.max_episode_length
        self.step_dt = self._sim.step_dt
        self.cfg = {"task": self._sim.task_name, "robots": self._sim.robots, "seed": self._sim.seed}
        self._actions = torch.zeros(
            self.num_envs, self.num_actions, dtype=torch.float32, pin_memory=self.device.type == "cuda"
        )
        self._pinned: dict[str, torch.Tensor] = {}
        self._copiers = ThreadPoolExecutor(_COPIERS, "copier") if self.device.type == "cuda" else None
        mask = torch.from_numpy(self._sim.action_mask.astype(np.float32)).to(self.device)
        self._mask = mask if self._sim.is_padded else None
        self._other_groups = [group for group in self._sim.observation_groups if group != "policy"]
        self._card = self._find_card()

    def _find_card(self) -> dict[str, torch.Tensor] | None:
        """The simulator's arrays, where they are on the learner's card and no Python takes part."""
        if self.device.type != "cuda" or type(self._source) is not VecSim:
            return None
        arrays = self._source.device_arrays()
        index = torch.cuda.current_device() if self.device.index is None else self.device.index
        if arrays is None or arrays["actions"].__dlpack_device__()[1] != index:
            return None
        return {name: torch.as_tensor(array, device=self.device) for name, array in arrays.items()}

    @property
    def clip_actions(self) -> float | None:
        """Greatest magnitude of the actions that the robots act with; None: no limit."""
        return self._clip_actions

    @property
    def card(self) -> Mapping[str, torch.Tensor] | None:
        """The simulator's arrays on the learner's card, which `step_on_card` reads and writes.

        See `VecSim.device_arrays`. None: the simulator's steps are not made there.
        """
        return self._card

    @property
    def could_have_card(self) -> bool:
        """Whether a card could make the control steps, also where the CPU is faster."""
        return type(self._source) is VecSim and self._source.lacks_on_device() is None

    @property
    def has_state_on_card(self) -> bool:
        """Whether `card` has the current observations; brings the state there if it can go."""
        return self._card is not None and self._sim.device_arrays() is not None

    def step_on_card(self) -> None:
        """Begins a control step with the actions that `card` has, and does not wait for it.

        torch's current stream orders it: what it gets later finds the outcome in `card`.
        """
        self._sim.step_device(torch.cuda.current_stream(self.device).cuda_stream)

    def observed_on_card(self) -> dict[str, torch.Tensor]:
        """The current observations by group, float32 [num_envs, n]: views of `card`."""
        assert self._card is not None
        columns = self._sim.observation_groups
        return {
            group: self._card["observation"][:, slice(*columns[group])] for group in ("policy", *self._other_groups)
        }

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """int64 [num_envs], control steps of the current episodes.

        A copy: what is written into it changes nothing. Assign a whole tensor,
        `env.episode_length_buf = lengths`.
        """
        return torch.from_numpy(self._sim.episode_length.copy()).to(self.device)

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        if value.shape != (self.num_envs,) or value.is_floating_point():
            raise ValueError(
                f"episode_length_buf must be an integer tensor of shape ({self.num_envs},), "
                f"not {value.dtype} of shape {tuple(value.shape)}"
            )
        self._sim.set_episode_length(value.to(device="cpu", dtype=torch.int64).contiguous().numpy())

    def get_observations(self) -> TensorDict:
        """The current observations by group, float32 [num_envs, n] each.

        Groups: `policy`, and those that the task adds.

        Where some robots lack some of the actions also `action_mask`, float32 [num_envs,
        num_actions]: 1 where an env's robot has a joint, else 0. The rollout stores it, and
        `polypod.networks.MaskedMLPModel` reads it.
        """
        if self.has_state_on_card:
            groups = {group: rows.clone() for group, rows in self.observed_on_card().items()}
        else:
            groups = {"policy": self._tensor("policy", self._source.observation)}
            for group in self._other_groups:
                groups[group] = self._tensor(group, self._sim.observation_of(group))
        if self._mask is not None:
            groups["action_mask"] = self._mask
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Begins new episodes in every env."""
        self._source.reset()
        return self.get_observations(), {}

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advances every env by one control step.

        Args:
            actions: [num_envs, num_actions], on any device.

        Returns:
            Observations; rewards float32 [num_envs]; dones int64 [num_envs]; extras with
            `time_outs`, float32 [num_envs]: 1 where the episode was truncated and did not
            terminate: its return is bootstrapped.

        Raises:
            ValueError: for another shape, and for a NaN or an infinity.
        """
        if actions.shape != self._actions.shape:
            raise ValueError(f"actions have shape {tuple(actions.shape)}, expected {tuple(self._actions.shape)}")
        # a policy that is asked outside of inference mode gives tensors with gradients
        if self._card is not None:
            return self._step_with(self._card, actions.detach())
        self._actions.copy_(actions.detach())
        rewards, dones, time_outs = self.step_on_host(self._actions)
        extras: dict[str, Any] = {"time_outs": self._tensor("time_outs", time_outs.astype(np.float32))}
        if self._log_extras and self._source.final_mask.any():
            extras["log"] = self.log()
        return (
            self.get_observations(),
            self._tensor("reward", rewards.copy()),
            self._tensor("done", dones.astype(np.int64)),
            extras,
        )

    def _step_with(
        self, card: dict[str, torch.Tensor], actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """`step` on the learner's card."""
        limit = self._clip_actions
        card["actions"].copy_(actions if limit is None else actions.clamp(-limit, limit))
        self.step_on_card()
        terminated, truncated = card["terminated"], card["truncated"]
        dones = terminated | truncated
        extras: dict[str, Any] = {"time_outs": (truncated & ~terminated).float()}
        if self._log_extras and bool(dones.any()):
            extras["log"] = self.log()
        return self.get_observations(), card["reward"].clone(), dones.long(), extras

    def step_on_host(self, actions: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advances every env by one control step, and moves nothing to the learner's device.

        Args:
            actions: float32 [num_envs, num_actions] in the memory of the CPU.

        Returns:
            Rewards, float32; whether each episode ended; whether it was truncated and did not
            terminate. Each is [num_envs]; the rewards are a view that the next step overwrites.
        """
        sim, limit = self._source, self._clip_actions
        sim.step((actions if limit is None else actions.clamp(-limit, limit)).numpy())
        return sim.reward, sim.terminated | sim.truncated, sim.truncated & ~sim.terminated

    def observe_into(self, buffers: Mapping[str, torch.Tensor]) -> None:
        """Copies the current observations into tensors on the learner's device.

        The copy may still be under way.

        Args:
            buffers: float32 [num_envs, n] by observation group.
        """
        for group, buffer in buffers.items():
            is_policy = group == "policy"
            host = tensor_over(self._source.observation if is_policy else self._sim.observation_of(group))
            if self.device.type == "cuda":
                host = self._in_pinned_memory(group, host)
            buffer.copy_(host, non_blocking=True)

    def log(self) -> dict[str, float]:
        """Means over the episodes that ended since the last call, see `VecSim.log`.

        With those of terms in Python.
        """
        return self._source.log()

    def refresh(self) -> None:
        """Observes the state of a restored snapshot."""
        if isinstance(self._source, CustomTerms):
            self._source.refresh()

    def close(self) -> None:
        """Closes the wrapped env."""
        self._card = None
        if self._copiers is not None:
            self._copiers.shutdown()
        self.unwrapped.close()

    def _tensor(self, name: str, array: np.ndarray) -> torch.Tensor:
        """`array` on the learner's device: a view on the CPU, else a new tensor by pinned memory.

        The pinned buffer is free again when the next step begins, because the actions of that step
        came off the device after this copy was queued.
        """
        host = tensor_over(array)
        if self.device.type == "cpu":
            return host
        return self._in_pinned_memory(name, host).to(self.device, non_blocking=True)

    def _in_pinned_memory(self, name: str, host: torch.Tensor) -> torch.Tensor:
        pinned = self._pinned.get(name)
        if pinned is None:
            pinned = self._pinned[name] = torch.empty_like(host, pin_memory=True)
        if self._copiers is None or host.nbytes < _LARGE:
            return pinned.copy_(host)
        parts = zip(np.array_split(pinned.numpy(), _COPIERS), np.array_split(host.numpy(), _COPIERS), strict=True)
        list(self._copiers.map(lambda part: np.copyto(*part), parts))
        return pinned
