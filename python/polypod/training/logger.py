"""Logger of a training: rsl_rl's scalars, written once per iteration and never printed."""

import importlib
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import torch
from rsl_rl.utils.log_writer import LogWriter
from rsl_rl.utils.logger import Logger

from polypod import _core


class ScalarWriter(Protocol):
    """Takes numbers, and writes them."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Records one number."""

    def flush(self) -> None:
        """Writes what is buffered."""

    def close(self) -> None:
        """Writes what is still buffered."""


class NoWriter:
    """Records nothing: `--logger none`."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Does nothing."""

    def flush(self) -> None:
        """Does nothing."""

    def close(self) -> None:
        """Does nothing."""


_SERVICES = {
    "wandb": "rsl_rl.utils.wandb_log_writer:WandbLogWriter",
    "neptune": "rsl_rl.utils.neptune_log_writer:NeptuneLogWriter",
}
"""rsl_rl's writers, which write TensorBoard's files as well."""


def _service(kind: str, log_dir: str, project: str, env_cfg: Any, train_cfg: dict[str, Any]) -> Any:
    """A writer of rsl_rl for a service.

    Raises ConfigError where its package or account is missing.
    """
    module, _, name = _SERVICES[kind].partition(":")
    try:
        writer = getattr(importlib.import_module(module), name)(log_dir, project)
    except ModuleNotFoundError as error:
        raise _core.ConfigError(f"--logger {kind} needs the package {kind}: pip install {kind}") from error
    except KeyError as error:
        raise _core.ConfigError(f"--logger {kind}: {error.args[0]}") from error
    # rsl_rl asks the env's configuration for a dict
    writer.store_config(types.SimpleNamespace(to_dict=lambda: dict(env_cfg)), train_cfg)
    return writer


class TrainingLogger(Logger):
    """rsl_rl's bookkeeping of rewards and episode lengths, with another output.

    rsl_rl's own logger prints some 150 lines per iteration, stores the diffs of foreign
    repositories, and averages the env's log over steps; here the simulator averages it over the
    episodes that ended in the iteration.
    """

    total_num_envs: int
    """Envs of all workers."""
    ended: list[tuple[int, int, float, float]]
    """Step, env, return and length in control steps of each episode that ended in the iteration."""

    def begin(self, first_env: int, total_num_envs: int) -> None:
        """Tells of the envs: the first one of this worker, and how many all workers have."""
        self.total_num_envs, self.ended = total_num_envs, []
        self._first_env, self._step = first_env, 0

    def keep_on_host(self) -> None:
        """Counts in the memory of the CPU, for a learner that tells of its steps from there."""
        self.device = "cpu"
        for name in ("cur_reward_sum", "cur_episode_length"):
            setattr(self, name, getattr(self, name).cpu())

    def process_env_step(
        self, rewards: torch.Tensor, dones: torch.Tensor, extras: dict[str, Any], intrinsic_rewards: Any = None
    ) -> None:
        """Counts a step, and notes the episodes that it ended."""
        self.cur_reward_sum += rewards
        self.cur_episode_length += 1
        envs = (dones > 0).nonzero().flatten()
        if envs.numel():
            figures = (envs + self._first_env, self.cur_reward_sum[envs], self.cur_episode_length[envs])
            for env, reward, length in zip(*(of.tolist() for of in figures), strict=True):
                self.ended.append((self._step, env, reward, length))
            self.cur_reward_sum[envs] = 0
            self.cur_episode_length[envs] = 0
        self._step += 1

    def finish(self, ended: list[tuple[int, int, float, float]]) -> None:
        """Takes in the episodes of all workers that ended in the iteration."""
        for _, _, reward, length in sorted(map(tuple, ended), key=lambda episode: episode[:2]):
            self.rewbuffer.append(reward)
            self.lenbuffer.append(length)
        self.ended, self._step = [], 0

    def open(self, kind: str, purge_step: int, warn: Callable[[str], None], project: str = "polypod") -> None:
        """Begins to record.

        Args:
            kind: "tensorboard", "wandb", "neptune" or "none".
            project: of wandb and neptune.
            warn: is told when the disk takes no curves.
            purge_step: records of this and later iterations, left by a run that went on after its
                last checkpoint, are dropped.

        Raises:
            ConfigError: where the package or the account of wandb or neptune is missing.
        """
        self.writer: ScalarWriter | None
        if kind == "tensorboard":
            from polypod.training.curves import Curves

            self.writer = Curves(Path(self.log_dir), purge_step or None, warn)
        elif kind in _SERVICES:
            self.writer = _service(kind, str(self.log_dir), project, self.env_cfg, self.cfg)
        else:
            self.writer = NoWriter()

    def record(self, iteration: int, collect_time: float, learn_time: float, scalars: dict[str, float]) -> float:
        """Records one iteration and returns its env-steps per second."""
        env_steps = self.cfg["num_steps_per_env"] * self.total_num_envs
        self.tot_timesteps += env_steps
        self.tot_time += collect_time + learn_time
        steps_per_second = env_steps / (collect_time + learn_time)
        scalars = {
            **scalars,
            "Perf/total_fps": steps_per_second,
            "Perf/collection_time": collect_time,
            "Perf/learning_time": learn_time,
        }
        if self.rewbuffer:
            scalars["Train/mean_reward"] = self.mean_reward
            scalars["Train/mean_episode_length"] = self.mean_episode_length
        if self.writer is not None:
            for tag, value in scalars.items():
                self.writer.add_scalar(tag, value, iteration)
            self.writer.flush()
        return steps_per_second

    @property
    def mean_reward(self) -> float:
        """Mean return of the last 100 episodes; NaN before the first one."""
        return sum(self.rewbuffer) / len(self.rewbuffer) if self.rewbuffer else float("nan")

    @property
    def mean_episode_length(self) -> float:
        """Mean length of the last 100 episodes in control steps; NaN before the first one."""
        return sum(self.lenbuffer) / len(self.lenbuffer) if self.lenbuffer else float("nan")

    def close(self) -> None:
        """Writes what is still buffered."""
        if self.writer is not None:
            self.writer.close()
            if isinstance(self.writer, LogWriter):
                self.writer.stop()

    def state(self) -> dict[str, Any]:
        """State with which a resumed run continues the curves."""
        return {
            "rewards": list(self.rewbuffer),
            "lengths": list(self.lenbuffer),
            "reward_sum": self.cur_reward_sum.cpu(),
            "episode_length": self.cur_episode_length.cpu(),
            "timesteps": self.tot_timesteps,
            "time": self.tot_time,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes over a `state`."""
        self.rewbuffer.extend(state["rewards"])
        self.lenbuffer.extend(state["lengths"])
        self.cur_reward_sum = state["reward_sum"].to(self.device)
        self.cur_episode_length = state["episode_length"].to(self.device)
        self.tot_timesteps = state["timesteps"]
        self.tot_time = state["time"]


def scalars_of(loss: dict[str, float], learning_rate: float, action_std: torch.Tensor) -> dict[str, float]:
    """The learner's scalars under rsl_rl's tags."""
    return {
        **{f"Loss/{key}": value for key, value in loss.items()},
        "Loss/learning_rate": learning_rate,
        "Policy/mean_std": action_std.mean().item(),
    }
