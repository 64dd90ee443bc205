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
        """[envs, n] by observation group, on the device."""
        self.observed = TensorDict({**observed, **self.inputs}, batch_size=[env.num_envs], device=device)
        """`inputs`, with the mask of actions where there is one."""
        self.drawn = torch.zeros((env.num_envs, env.num_actions), device=device)
        """Actions, on the device."""
        self._actions = torch.zeros(self.drawn.shape, pin_memory=is_cuda)
        names = ("rewards", "dones", "time_outs")
        self.told = {name: torch.zeros((steps, env.num_envs), pin_memory=is_cuda) for name in names}
        """[steps, envs], on the host."""

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
