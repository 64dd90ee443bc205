"""rsl_rl's on-policy runner, made exactly resumable."""

import contextlib
import io
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils import check_nan
from tensordict import TensorDict

from polypod import _core
from polypod.rsl_rl import VecEnv
from polypod.training import run_dir
from polypod.training.advantages import normalize_per_robot
from polypod.training.config import TrainConfig
from polypod.training.logger import TrainingLogger, scalars_of
from polypod.training.report import Iteration, Reporter
from polypod.training.reward_scale import RewardScale
from polypod.training.symmetry import Mirror

STOP_SIGNALS = [signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if name in signal.Signals.__members__]
"""Ctrl-C; what Slurm, Docker and spot machines send; a closed terminal."""
SAME_SIGNAL_S = 1.0
"""Time in which a further SIGTERM or SIGHUP is the first one again, s.

Who tells a whole group of processes to end tells make too, which passes it on.
"""
STATS_INTERVAL = 25
"""Iterations between the per-robot tables."""


_STUDENT_AND_TEACHER = {"student": True, "teacher": True, "optimizer": True}
"""What a resumed distillation loads."""


def check_groups(env: VecEnv, obs_groups: dict[str, list[str]]) -> None:
    """Raises ConfigError for an observation group that the task does not have."""
    known = env.unwrapped.sim.observation_groups
    for network, groups in obs_groups.items():
        for group in groups:
            if group not in known:
                raise _core.ConfigError(
                    f"[obs_groups] {network} = {groups}: {env.unwrapped.sim.task_name} has no group {group!r}, but "
                    f"{', '.join(known)}; add [[observations.{group}]] terms to the task"
                )


class Runner(OnPolicyRunner):
    """Collects, learns, records and saves.

    `current_learning_iteration` counts finished iterations, and so does the number in a checkpoint's name. A checkpoint
    is taken between iterations and holds the policy, the optimiser, torch's random streams and the simulator; training
    that goes on from it computes what it would have computed without the interruption, bit for bit.
    """

    env: VecEnv
    logger: TrainingLogger

    def __init__(
        self, env: VecEnv, config: TrainConfig, run: Path, device: str, reporter: Reporter, **changes: Any
    ) -> None:
        """Builds networks and storage.

        Args:
            env: the envs.
            config: what to train.
            run: the run's directory.
            device: torch's.
            reporter: what shows the progress.
            changes: values of rsl_rl's configuration other than those of `config`.
        """
        cfg = {**config.rsl_rl_cfg(env.unwrapped.sim), **changes}
        check_groups(env, cfg["obs_groups"])
        self._distils = cfg["algorithm"]["class_name"] == "Distillation"
        if cfg["symmetry"]:
            mirror = Mirror(env, device)
            symmetry = {"data_augmentation_func": mirror.augment, "use_data_augmentation": True}
            cfg = {**cfg, "algorithm": {**cfg["algorithm"], "symmetry_cfg": symmetry}}
        with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints its networks
            super().__init__(env, cfg, log_dir=str(run), device=device)
        self.logger = TrainingLogger(
            log_dir=str(run),
            cfg=cfg,
            env_cfg=env.cfg,
            num_envs=env.num_envs,
            is_distributed=False,
            gpu_world_size=1,
            gpu_global_rank=0,
            device=device,
        )
        self.config = config
        self.run = run
        self.reporter = reporter
        self.stopped_by: signal.Signals | None = None
        """The first signal that asked the training to end."""
        sim = env.unwrapped.sim
        self.blocks = [sim.env_ids(robot) for robot in sim.robots]
        self.reward_scale: RewardScale | None = None
        if cfg["normalize_reward_per_robot"]:
            self.reward_scale = RewardScale(self.blocks, cfg["algorithm"]["gamma"], device)

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Runs `num_learning_iterations` more iterations, or fewer after a signal, which sets `stopped_by`.

        A checkpoint that the disk does not take is tried again at the next save; the training goes on.

        Args:
            num_learning_iterations: how many.
            init_at_random_ep_len: start the envs at random points of their episodes, so that time-outs are spread.

        Raises:
            ConfigError: where the last checkpoint cannot be written, or the run's directory is gone.
        """
        if init_at_random_ep_len:
            lengths = torch.randint(int(self.env.max_episode_length), (self.env.num_envs,))
            self.env.episode_length_buf = lengths
        self.alg.train_mode()
        observations = self.env.get_observations()
        start = self.current_learning_iteration
        stop = start + num_learning_iterations
        with self._stop_on_signals(), self.reporter.training(start, stop):
            for iteration in range(start, stop):
                observations = self._iterate(iteration, stop, observations)
                last = iteration + 1 == stop or self.stopped_by is not None
                if last or (iteration + 1) % self.cfg["save_interval"] == 0:
                    self._try_to_save(run_dir.checkpoint_path(self.run, iteration + 1), last)
                if last:
                    break

    def _try_to_save(self, path: Path, last: bool) -> None:
        try:
            self.save(str(path))
        except OSError as error:
            reason = f"cannot write {path}: {error.strerror}"
            if last:
                raise _core.ConfigError(f"{reason}; make room and resume from the checkpoint before it") from error
            self.reporter.message(f"polypod: warning: {reason}; the training goes on and tries again at the next save")

    def _iterate(self, iteration: int, stop: int, observations: TensorDict) -> TensorDict:
        started = time.perf_counter()
        observations = self._collect(observations)
        collected = time.perf_counter()
        self.alg.entropy_coef, self.alg.desired_kl = self.config.goals(iteration)
        loss = self._update(observations)
        learned = time.perf_counter()
        self.current_learning_iteration = iteration + 1

        sim = self.env.unwrapped.sim
        scalars = scalars_of(loss, self.alg.learning_rate, self._action_std()) | self.env.log()
        steps_per_second = self.logger.record(iteration, collected - started, learned - collected, scalars)
        self.reporter.iteration(
            Iteration(iteration + 1, stop, self.logger.mean_reward, self.logger.mean_episode_length, steps_per_second)
        )
        if (iteration + 1) % STATS_INTERVAL == 0:
            self.reporter.robots(sim.episode_stats(clear=True))
        return observations

    @torch.inference_mode()
    def _collect(self, observations: TensorDict) -> TensorDict:
        """Takes the steps of an iteration; returns the observations after them."""
        for _ in range(self.cfg["num_steps_per_env"]):
            actions = self.alg.act(observations)
            observations, rewards, dones, extras = self.env.step(actions)
            check_nan(observations, rewards, dones)
            scaled = rewards if self.reward_scale is None else self.reward_scale(rewards, dones)
            self.alg.process_env_step(observations, scaled, dones, extras)
            self.logger.process_env_step(rewards, dones, extras)
        return observations

    def _update(self, observations: TensorDict) -> dict[str, float]:
        """Learns from the steps; returns the mean losses."""
        with torch.inference_mode():
            self.alg.compute_returns(observations)
            if self.cfg["normalize_advantage_per_robot"]:
                normalize_per_robot(self.alg.storage.advantages, self.blocks)
        loss: dict[str, float] = self.alg.update()
        return loss

    def _action_std(self) -> torch.Tensor:
        """Deviations of the actions, [num_actions] or [num_envs, num_actions]."""
        return self.alg.get_policy().output_std

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Writes a checkpoint, whole or not at all."""
        state = self.alg.save()
        if self._distils:
            # what evaluations and exports read
            state["actor_state_dict"] = state["student_state_dict"]
        state["iter"] = self.current_learning_iteration
        state["infos"] = {
            **(infos or {}),
            "sim": torch.from_numpy(np.frombuffer(self.env.unwrapped.sim.snapshot(), dtype=np.uint8).copy()),
            "rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state_all() if torch.device(self.device).type == "cuda" else [],
            "logger": self.logger.state(),
            "reward_scale": self.reward_scale.state() if self.reward_scale is not None else {},
        }
        run_dir.save_checkpoint(Path(path), lambda file: torch.save(state, file))

    def load(
        self, path: str, load_cfg: dict[str, Any] | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict[str, Any]:
        """Takes over a checkpoint. Raises ConfigError for a file that is none or that fits another run."""
        state = run_dir.load_checkpoint(Path(path), map_location or self.device)
        try:
            self.alg.load(state, load_cfg or (_STUDENT_AND_TEACHER if self._distils else None), strict)
        except (AttributeError, RuntimeError, KeyError, TypeError, ValueError) as error:
            raise _core.ConfigError(f"{path} does not fit this run's networks: {_first_line(error)}") from error
        try:
            infos: dict[str, Any] = state["infos"]
            self.env.unwrapped.sim.restore(infos["sim"].cpu().numpy().tobytes())
            self.env.refresh()
            torch.set_rng_state(infos["rng"].cpu())
            if infos["cuda_rng"] and torch.device(self.device).type == "cuda":
                torch.cuda.set_rng_state_all([stream.cpu() for stream in infos["cuda_rng"]])
            self.logger.restore(infos["logger"])
            if self.reward_scale is not None:
                self.reward_scale.restore(infos["reward_scale"])
            if type(state["iter"]) is not int or state["iter"] < 0:
                raise ValueError(f"iter is {state['iter']!r}")
            self.current_learning_iteration = state["iter"]
        except _core.PolypodError:  # of the snapshot, whose message says what is wrong with it
            raise
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise _core.ConfigError(
                f"{path} does not hold what a resumed training needs ({type(error).__name__}: {_first_line(error)}); "
                "use another checkpoint, or begin anew with --init"
            ) from error
        return infos

    def start_from(self, path: Path) -> None:
        """Takes over a checkpoint's networks and nothing else. Raises ConfigError where they do not fit."""
        state = run_dir.load_checkpoint(path, self.device)
        try:
            if self._distils:
                self.alg.get_policy().load_state_dict(state["actor_state_dict"])
            else:
                self.alg.load(state, {"actor": True, "critic": True}, True)
        except (AttributeError, RuntimeError, KeyError, TypeError, ValueError) as error:
            raise _core.ConfigError(
                f"--init {path} does not fit this run's networks, {_first_line(error)}: "
                "use its task and its train config's sizes"
            ) from error

    def learn_from(self, teacher: Path) -> None:
        """Takes over the network that a distillation learns from. Raises ConfigError where it does not fit."""
        state = run_dir.load_checkpoint(teacher, self.device)
        try:
            self.alg.load(state, {"teacher": True}, True)
        except (AttributeError, RuntimeError, KeyError, TypeError, ValueError) as error:
            raise _core.ConfigError(
                f"[distillation] teacher {teacher} does not fit the observation groups that [obs_groups] names for it: "
                f"{_first_line(error)}; give them the terms of the teacher's task"
            ) from error

    @contextlib.contextmanager
    def _stop_on_signals(self) -> Iterator[None]:
        """Lets `STOP_SIGNALS` end the training after the iteration under way; a second one ends it at once."""
        begin = 0.0

        def stop(number: int, frame: FrameType | None) -> None:
            nonlocal begin
            if self.stopped_by is not None:
                if number != signal.SIGINT and time.monotonic() - begin < SAME_SIGNAL_S:
                    return
                raise KeyboardInterrupt
            begin = time.monotonic()
            self.stopped_by = signal.Signals(number)
            again = "Ctrl-C again" if number == signal.SIGINT else "a second signal"
            self.reporter.message(f"stopping after this iteration ({again}: at once, without a checkpoint)")

        previous: dict[signal.Signals, Callable[[int, FrameType | None], Any] | int | None] = {}
        try:
            for number in STOP_SIGNALS:
                # nohup and the like have a signal ignored, which stays so
                if signal.getsignal(number) is not signal.SIG_IGN:
                    previous[number] = signal.signal(number, stop)
        except ValueError:  # not in the main thread, where no signals arrive
            yield
            return
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
