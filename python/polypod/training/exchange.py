"""Memory through which a learner's device and the simulator exchange a control step."""

import numpy as np
import torch
from tensordict import TensorDict

from polypod.networks.masked import ACTION_MASK
from polypod.rsl_rl import VecEnv
from polypod.tensors import tensor_over


class Exchange:
    """Observations on their way to the device, actions on their way back, and what the envs tell.

    Graphs of the device read and write `inputs`, `observed` and `drawn`, so these tensors stay.
    """

    def __init__(self, env: VecEnv, steps: int) -> None:
        """Reserves memory for an iteration of `steps` control steps of `env`."""
        observed, device = env.get_observations(), torch.device(env.device)
        is_cuda = device.type == "cuda"
        self._env = env
        self.widths = {name: tensor.shape[1] for name, tensor in observed.items() if name != ACTION_MASK}
        """Numbers of each observation group."""
        self.inputs = {name: torch.zeros((env.num_envs, width), device=device) for name, width in self.widths.items()}
        """Inputs by observation group, [envs, n], on the device."""
        self.observed = TensorDict({**observed, **self.inputs}, batch_size=[env.num_envs], device=device)
        """`inputs`, with the mask of actions where there is one."""
        self.drawn = torch.zeros((env.num_envs, env.num_actions), device=device)
        """Actions, on the device."""
        self._actions = torch.zeros(self.drawn.shape, pin_memory=is_cuda)
        names = ("rewards", "dones", "time_outs")
        self.told = {name: torch.zeros((steps, env.num_envs), pin_memory=is_cuda) for name in names}
        """Numbers of a rollout that the host is told, [steps, envs], on the host."""

    def observe(self) -> None:
        """Copies the present observations to the device."""
        self._env.observe_into(self.inputs)

    def fetch_actions(self) -> None:
        """Begins to copy the drawn actions to the host; the device may still draw them."""
        self._actions.copy_(self.drawn, non_blocking=True)

    def step(self, step: int) -> None:
        """Takes a control step with the fetched actions, the number `step` of the iteration."""
        for told, figure in zip(self.told.values(), self._env.step_on_host(self._actions), strict=True):
            told[step].copy_(tensor_over(np.asarray(figure)))


class CardExchange(Exchange):
    """Exchange where the simulator makes whole control steps on the learner's card.

    Observations and actions are the simulator's own arrays. The host queues the steps of an
    iteration and waits for none of them.
    """

    def __init__(self, env: VecEnv, steps: int) -> None:
        """Finds the simulator's arrays, and reserves memory for what an iteration tells."""
        super().__init__(env, steps)
        assert env.card is not None
        self._card, self._limit = env.card, env.clip_actions
        self.inputs = env.observed_on_card()
        self.observed = TensorDict({**self.observed, **self.inputs}, batch_size=[env.num_envs], device=env.device)
        if self._limit is None:
            self.drawn = self._card["actions"]
        self.on_host = self.told
        """`told` of the last iteration in the memory of the CPU, see `fetch_told`."""
        self.told = {name: torch.zeros_like(tensor, device=env.device) for name, tensor in self.on_host.items()}
        self._is_late = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)

    def observe(self) -> None:
        """Brings the state to the card where it is not: the observations are there then."""
        if not self._env.has_state_on_card:
            super().observe()

    def fetch_actions(self) -> None:
        """Hands the drawn actions to the simulator, within their limit."""
        if self._limit is not None:
            torch.clamp(self.drawn, -self._limit, self._limit, out=self._card["actions"])

    def step(self, step: int) -> None:
        """Begins a control step with these actions, the number `step` of the iteration."""
        self._env.step_on_card()
        terminated, truncated = self._card["terminated"], self._card["truncated"]
        self.told["rewards"][step].copy_(self._card["reward"])
        self.told["dones"][step].copy_(torch.logical_or(terminated, truncated, out=self._is_late))
        self.told["time_outs"][step].copy_(torch.gt(truncated, terminated, out=self._is_late))

    def fetch_told(self) -> None:
        """Begins to copy what the steps told to `on_host`."""
        for name, tensor in self.on_host.items():
            tensor.copy_(self.told[name], non_blocking=True)
