"""rsl_rl's on-policy runner, made exactly resumable."""

import contextlib
import io
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import msgspec
import numpy as np
import torch
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils import check_nan
from tensordict import TensorDict

from polypod import _core
from polypod.networks import UrmaModel
from polypod.networks.clipped import clip_actions
from polypod.networks.transfer import numbers_of, numbers_of_run, perceptron_for
from polypod.python_terms import TermSim
from polypod.rsl_rl import VecEnv
from polypod.runs import run_dir
from polypod.runs.schema import TrainConfig
from polypod.training import deviations
from polypod.training.advantages import normalize_per_robot
from polypod.training.logger import TrainingLogger, scalars_of
from polypod.training.report import Iteration, Reporter
from polypod.training.reward_scale import RewardScale
from polypod.training.symmetry import Mirror, MirrorLoss
from polypod.training.teachers import ManyTeachers
from polypod.training.workers import Workers, slow_workers

STOP_SIGNALS = [signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if name in signal.Signals.__members__]
"""Ctrl-C; what Slurm, Docker and spot machines send; a closed terminal."""
SAME_SIGNAL_S = 1.0
"""Time in which a further SIGTERM or SIGHUP is the first one again, s.

Tools that end a whole group of processes signal make too, which passes the signal on.
"""
STATS_INTERVAL = 25
"""Iterations between the per-robot tables."""


_STUDENT_AND_TEACHER = {"student": True, "teacher": True, "optimizer": True}
"""Parts that a resumed distillation loads."""


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


class Goal(Protocol):
    """Goal that may end a training before its last iteration."""

    def ends(self, runner: "Runner", is_last: bool) -> bool:
        """Whether the training ends after the iteration just finished, maybe its last anyway.

        It may save and measure checkpoints.
        """


class Runner(OnPolicyRunner):
    """Collects, learns, records and saves.

    `current_learning_iteration` counts finished iterations, and so does the number in a
    checkpoint's name. A checkpoint is taken between iterations and holds the policy, the optimiser,
    torch's random streams and the simulator; training that goes on from it computes what it would
    have computed without the interruption, bit for bit.
    """

    env: VecEnv
    logger: TrainingLogger
    draws = True
    """Whether torch's random streams decide the actions and the order of the samples."""
    storage: Mapping[str, Any] = {}
    """Values of rsl_rl's configuration, other than those of the train config, that its networks and
    storage are built with."""

    def __init__(
        self,
        env: VecEnv,
        config: TrainConfig,
        run: Path,
        device: str,
        reporter: Reporter,
        workers: Workers | None = None,
    ) -> None:
        """Builds networks and storage.

        Args:
            env: this worker's envs.
            config: the training.
            run: directory of the run, which worker 0 writes to.
            device: where the learner is.
            reporter: what the user sees, of worker 0.
            workers: those that have the other envs; None: there are none.
        """
        self.workers = workers or Workers.alone()
        check_groups(env, config.observed_groups)
        cfg = {**config.rsl_rl_cfg(env.unwrapped.sim), **self.storage}
        self._distils = config.distillation is not None
        images: dict[str, Any] = {}
        if cfg["symmetry"]:
            images = {"data_augmentation_func": Mirror(env, device).augment, "use_data_augmentation": True}
            cfg = {**cfg, "algorithm": {**cfg["algorithm"], "symmetry_cfg": dict(images)}}
        with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints its networks
            super().__init__(env, cfg, log_dir=str(run), device=device)
        if images and (weight := config.algorithm.mirror_loss_coef):
            self.alg.symmetry = MirrorLoss(env, **images, use_mirror_loss=True, mirror_loss_coeff=weight)
        sim = env.unwrapped.sim
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
        self.logger.begin(sim.share[0], sim.total_num_envs)
        if isinstance(self.alg, ManyTeachers) and self.workers.count > 1:
            self.alg.weigh(sim, cfg["obs_groups"], self.workers)
        self._distribution = self.alg.get_policy().distribution
        self.alg.optimizer.register_step_post_hook(lambda *_: deviations.limit(self._distribution))
        self.config = config
        self.run = run
        self.reporter = reporter
        self.stopped_by: signal.Signals | None = None
        """The first signal that asked the training to end."""
        self._told_all: signal.Signals | None = None
        """Signal that any worker was told, once all know of it."""
        self.watch: Callable[[int, Mapping[str, float]], None] | None = None
        """Is told the number of finished iterations and the scalars of each."""
        self.goal: Goal | None = None
        """Is asked after each iteration whether the training has reached it; of trainings in one
        process."""
        self.stats_of_robots: Mapping[str, Mapping[str, float]] = {}
        """Figures of the episodes that ended in the last `STATS_INTERVAL` iterations, by robot."""
        self.blocks = [sim.env_ids(robot) for robot in sim.robots]
        self.reward_scale: RewardScale | None = None
        if cfg["normalize_reward_per_robot"]:
            self.reward_scale = RewardScale(self.blocks, cfg["algorithm"]["gamma"], device, self.workers)
        self._prepare()

    def _prepare(self) -> None:
        """Builds what another learner than rsl_rl needs."""

    def _configure_multi_gpu(self) -> None:
        """Tells rsl_rl of the workers."""
        workers = self.workers
        self.gpu_global_rank, self.gpu_local_rank, self.gpu_world_size = (
            workers.index,
            workers.local_index,
            workers.count,
        )
        self.is_distributed = workers.count > 1
        ranks = {"global_rank": workers.index, "local_rank": workers.local_index, "world_size": workers.count}
        self.cfg["multi_gpu"] = ranks if self.is_distributed else None

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Runs `num_learning_iterations` iterations; a signal ends them and sets `stopped_by`.

        A checkpoint that the disk does not take is tried again at the next save; the training goes
        on.

        Args:
            num_learning_iterations: number of iterations.
            init_at_random_ep_len: start the envs at random points of their episodes, so that
                time-outs are spread.

        Raises:
            ConfigError: where the last checkpoint cannot be written, or the run's directory is
                gone.
        """
        if init_at_random_ep_len:
            sim = self.env.unwrapped.sim
            lengths = torch.randint(int(self.env.max_episode_length), (sim.total_num_envs,))
            self.env.episode_length_buf = lengths[slice(*sim.share)]
            self._seed_worker(sim.seed)
        self.alg.train_mode()
        if self.workers.count > 1 and self.draws:
            with self.workers.names_the_lost():
                self.alg.broadcast_parameters()
        observations = self.env.get_observations()
        start = self.current_learning_iteration
        stop = start + num_learning_iterations
        with self._stop_on_signals(), self.reporter.training(start, stop):
            for iteration in range(start, stop):
                observations = self._iterate(iteration, stop, observations)
                if iteration == start:
                    self._tell_cost()
                is_last = iteration + 1 == stop
                is_reached = self.goal is not None and self.stopped_by is None and self.goal.ends(self, is_last)
                last = is_last or self._is_to_stop() or is_reached
                if last or (iteration + 1) % self.cfg["save_interval"] == 0:
                    self.try_to_save(run_dir.checkpoint_path(self.run, iteration + 1), last)
                if last:
                    break

    def _tell_cost(self) -> None:
        """Says once how much of a control step the terms in Python take."""
        sim = self.env.unwrapped.sim
        if isinstance(sim, TermSim) and (cost := sim.cost()):
            most = ", ".join(f"{name} {share:.1%}" for name, share in list(cost.items())[:3])
            file = sim.terms.path.name if sim.terms.path is not None else "Python"
            self.reporter.message(f"terms of {file} take {sum(cost.values()):.1%} of a step: {most}")

    def _is_to_stop(self) -> bool:
        """Whether a signal ends the training now: for all workers after the same iteration."""
        if self.workers.count > 1 and self._told_all is None:
            return False
        self.stopped_by = self.stopped_by or self._told_all
        return self.stopped_by is not None

    def try_to_save(self, path: Path, last: bool = False) -> None:
        """Writes a checkpoint.

        Where the disk does not take it, says so and goes on, but for the last one.

        Raises:
            ConfigError: where the last one cannot be written, or the run's directory is gone.
        """
        try:
            self.save(str(path))
        except OSError as error:
            reason = f"cannot write {path}: {error.strerror}"
            if last:
                raise _core.ConfigError(f"{reason}; make room and resume from the checkpoint before it") from error
            self.reporter.message(f"polypod: warning: {reason}; the training goes on and tries again at the next save")

    def _iterate(self, iteration: int, stop: int, observations: TensorDict) -> TensorDict:
        started, waited = time.perf_counter(), self.workers.waited
        if isinstance(self.alg, ManyTeachers) and self.config.distillation is not None:
            of, run = self.config.distillation, self.config.run
            self.alg.teacher_share = of.share_of_teachers(iteration)
            rate = of.learning_rate(self.config.algorithm.learning_rate, iteration, run.max_iterations)
            self.alg.set_learning_rate(rate)
        with self.workers.names_the_lost():
            observations = self._collect(observations)
            collected = time.perf_counter()
            self.alg.entropy_coef, self.alg.desired_kl = self.config.goals(iteration)
            is_warming_up = iteration < self.config.algorithm.critic_warmup_iterations
            loss = (self._update_critic if is_warming_up else self._update)(observations)
        learned = time.perf_counter()
        self.current_learning_iteration = iteration + 1

        waited = self.workers.waited - waited
        figures = self._share_figures(learned - started - waited, waited)
        if not self.workers.is_first:
            return observations
        sim = self.env.unwrapped.sim
        scalars = scalars_of(loss, self.alg.learning_rate, self._action_std()) | self.env.log() | figures
        steps_per_second = self.logger.record(iteration, collected - started, learned - collected, scalars)
        self.reporter.iteration(
            Iteration(iteration + 1, stop, self.logger.mean_reward, self.logger.mean_episode_length, steps_per_second)
        )
        if self.watch is not None:
            self.watch(iteration + 1, scalars)
        if (iteration + 1) % STATS_INTERVAL == 0:
            self.stats_of_robots = sim.episode_stats(clear=True)
            self.reporter.robots(self.stats_of_robots)
        return observations

    def _share_figures(self, worked: float, waited: float) -> dict[str, float]:
        """Tells the other workers of the iteration, and worker 0 of the episodes that ended.

        All agree on whether to stop. Returns the seconds that each of several workers worked and
        waited.
        """
        workers, sim = self.workers, self.env.unwrapped.sim
        if workers.count == 1:
            self.logger.finish(self.logger.ended)
            return {}
        mine = {
            "ended": self.logger.ended,
            "logs": b"" if workers.is_first else sim.take_logs(),
            "times": (worked, waited),
            "stopped_by": self.stopped_by,
        }
        of_workers = workers.gather_messages(mine)
        signals = [of["stopped_by"] for of in of_workers if of["stopped_by"] is not None]
        self._told_all = signal.Signals(signals[0]) if signals else None
        self.logger.finish([episode for of in of_workers for episode in of["ended"]])
        times = [tuple(of["times"]) for of in of_workers]
        if workers.is_first:
            for of in of_workers[1:]:
                sim.add_logs(of["logs"])
            if (self.current_learning_iteration) % STATS_INTERVAL == 0:
                for index in slow_workers(times):
                    self.reporter.slow_worker(index, workers.places[index][0], times[index][0], len(times))
        return {
            f"Perf/worker_{index}/{name}_time": seconds
            for index, of in enumerate(times)
            for name, seconds in zip(("work", "wait"), of, strict=True)
        }

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
                if self.workers.count > 1:  # rsl_rl has scaled each worker's advantages separately
                    self.alg.storage.advantages = self.alg.storage.returns - self.alg.storage.values
                normalize_per_robot(self.alg.storage.advantages, self.blocks, self.workers)
        loss: dict[str, float] = self.alg.update()
        return loss

    def _update_critic(self, observations: TensorDict) -> dict[str, float]:
        """Learns from the steps, and puts the actor back to where it was.

        The learning rate stays: the actor's divergence says nothing of the critic.
        """
        self.alg.desired_kl = None
        state = self._actor_state()
        loss = self._update(observations)
        self._restore_actor(state)
        return loss

    def _actor_state(self) -> Any:
        """Weights of the actor, and the optimiser's state of each; a copy."""
        return [
            (parameter.detach().clone(), {key: value.clone() for key, value in state.items()})
            for parameter, state in self._actor_parameters()
        ]

    @torch.no_grad()
    def _restore_actor(self, state: Any) -> None:
        """The reverse of `_actor_state`, in place."""
        for (parameter, now), (weights, before) in zip(self._actor_parameters(), state, strict=True):
            parameter.copy_(weights)
            for key, value in now.items():
                value.copy_(before[key]) if key in before else value.zero_()

    def _actor_parameters(self) -> list[tuple[torch.nn.Parameter, dict[str, torch.Tensor]]]:
        """The actor's parameters, each with its state in the optimiser that moves it."""
        optimizer = self._optimizer()
        return [(parameter, optimizer.state.get(parameter, {})) for parameter in self.alg.actor.parameters()]

    def _optimizer(self) -> torch.optim.Optimizer:
        return self.alg.optimizer

    def _action_std(self) -> torch.Tensor:
        """Deviations of the actions, [n]: of those that the robots have."""
        # the deviations after the update, which a checkpoint holds; the policy's own are of the
        # last mini-batch
        learnt = deviations.of(self._distribution)
        std: torch.Tensor = self.alg.get_policy().output_std if learnt is None else learnt
        mask = getattr(self._distribution, "mask", None)
        return std if mask is None else std.expand_as(mask)[mask > 0]

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Writes a checkpoint, whole or not at all. All workers call it, and worker 0 writes."""
        self._give_to_rsl_rl()
        of_workers = self._of_workers()
        if not self.workers.is_first:
            return
        state = self.alg.save()
        if self._distils:
            # the key that evaluations and exports read
            state["actor_state_dict"] = state["student_state_dict"]
        state["iter"] = self.current_learning_iteration
        state["infos"] = {
            **(infos or {}),
            "sim": torch.from_numpy(np.frombuffer(of_workers["sim"], dtype=np.uint8).copy()),
            "rng": torch.get_rng_state(),
            "cuda_rng": self._cuda_streams(),
            "worker_rng": of_workers["worker_rng"],
            "logger": {**self.logger.state(), **of_workers["logger"]},
            "reward_scale": {}
            if self.reward_scale is None
            else {**self.reward_scale.state(), **of_workers["reward_scale"]},
        }
        run_dir.save_checkpoint(Path(path), lambda file: torch.save(state, file))

    def load(
        self, path: str, load_cfg: dict[str, Any] | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict[str, Any]:
        """Takes over a checkpoint.

        Raises ConfigError for a file that is none or that fits another run.
        """
        data = self.workers.from_first(lambda: run_dir.read_checkpoint(Path(path)))
        state = run_dir.checkpoint_of(data, Path(path), map_location or self.device)
        try:
            self.alg.load(state, load_cfg or (_STUDENT_AND_TEACHER if self._distils else None), strict)
            self._check_moments()
        except (AttributeError, RuntimeError, LookupError, TypeError, ValueError) as error:
            raise _core.ConfigError(f"{path} does not fit this run's networks: {_first_line(error)}") from error
        self._limit_deviations(path)
        try:
            infos: dict[str, Any] = state["infos"]
            self.env.unwrapped.sim.restore(infos["sim"].cpu().numpy().tobytes())
            self.env.refresh()
            self._restore_streams(infos, state["iter"])
            self.logger.restore(self._own_rows(infos["logger"], ("reward_sum", "episode_length")))
            if self.reward_scale is not None:
                self.reward_scale.restore(self._own_rows(infos["reward_scale"], ("returns",)))
            if type(state["iter"]) is not int or state["iter"] < 0:
                raise ValueError(f"iter is {state['iter']!r}")
            self.current_learning_iteration = state["iter"]
        except _core.PolypodError:  # from the snapshot; its message says what is wrong with it
            raise
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise _core.ConfigError(
                f"{path} does not hold what a resumed training needs ({type(error).__name__}: {_first_line(error)}); "
                "use another checkpoint, or begin anew with --init"
            ) from error
        self._take_from_rsl_rl()
        return infos

    def _check_moments(self) -> None:
        """Raises ValueError for moments of the optimiser that are not those of its parameters."""
        for parameter, state in self.alg.optimizer.state.items():
            for name in ("exp_avg", "exp_avg_sq"):
                moment = state.get(name)
                if moment is None:
                    continue
                if moment.shape != parameter.shape:
                    raise ValueError(
                        f"optimizer_state_dict {name} of shape {list(moment.shape)} for weights of shape "
                        f"{list(parameter.shape)}"
                    )
                least = float(moment.min()) if moment.numel() else 0.0
                if not torch.isfinite(moment).all() or (name == "exp_avg_sq" and least < 0.0):
                    raise ValueError(f"optimizer_state_dict {name} holds a number that no training leaves")

    def _limit_deviations(self, path: str) -> None:
        """Takes the deviations of a checkpoint as the policy acted with them."""
        count, of = deviations.outside(self._distribution)
        if count:
            self.reporter.message(
                f"polypod: warning: {path}: {count} of {of} deviations of the actions are out of the range that a "
                "policy acts with, and are taken as its end (1e-6 for a deviation below)"
            )
            deviations.limit(self._distribution)

    def _of_workers(self) -> dict[str, Any]:
        """State of all workers for a checkpoint, for worker 0.

        Whole arrays, and the simulator as of one process.
        """
        if self.workers.count == 1:
            return {"sim": self.env.unwrapped.sim.snapshot(), "worker_rng": [], "logger": {}, "reward_scale": {}}
        workers, logger = self.workers, self.logger.state()
        rows = {"reward_sum": logger["reward_sum"], "episode_length": logger["episode_length"]}
        if self.reward_scale is not None:
            rows["returns"] = self.reward_scale.returns
        streams = [] if workers.is_first or not self.draws else [torch.get_rng_state(), *self._cuda_streams()]
        mine = {
            "sim": self.env.unwrapped.sim.snapshot(),
            "rows": {name: tensor.cpu().numpy().tobytes() for name, tensor in rows.items()},
            "streams": [stream.numpy().tobytes() for stream in streams],
        }
        of_workers = [msgspec.msgpack.decode(data) for data in workers.bytes_for_first(msgspec.msgpack.encode(mine))]
        if not workers.is_first:
            return {}
        whole = {name: _floats(b"".join(of["rows"][name] for of in of_workers)) for name in rows}
        returns = {"returns": whole.pop("returns")} if "returns" in whole else {}
        return {
            "sim": _core.join_snapshots([of["sim"] for of in of_workers]),
            "worker_rng": [
                [_byte_tensor(stream) for stream in of["streams"]] for of in of_workers[1:] if of["streams"]
            ],
            "logger": whole,
            "reward_scale": returns,
        }

    def _own_rows(self, state: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
        """A state with this worker's rows of the arrays that have a row for each env."""
        return {**state, **{name: state[name][slice(*self.env.unwrapped.sim.share)] for name in names}}

    def _cuda_streams(self) -> list[torch.Tensor]:
        if torch.device(self.device).type != "cuda":
            return []
        return [torch.cuda.get_rng_state(self.device)]

    def _restore_streams(self, infos: dict[str, Any], iteration: int) -> None:
        """Goes on with this worker's random streams; a new worker gets new ones."""
        of_others = infos.get("worker_rng", [])
        if self.workers.is_first:
            stream, of_cuda = infos["rng"], infos["cuda_rng"]
        elif self.workers.index <= len(of_others):
            stream, *of_cuda = of_others[self.workers.index - 1]
        else:
            self._seed_worker(self.env.unwrapped.sim.seed + iteration)
            return
        torch.set_rng_state(stream.cpu())
        if of_cuda and torch.device(self.device).type == "cuda":
            torch.cuda.set_rng_state(of_cuda[0].cpu(), self.device)

    def _seed_worker(self, seed: int) -> None:
        """Gives every worker but the first one separate random streams.

        Networks start equal on all.
        """
        if not self.workers.is_first and self.draws:
            torch.manual_seed(int(np.random.SeedSequence([seed, self.workers.index]).generate_state(1, np.uint64)[0]))

    def _give_to_rsl_rl(self) -> None:
        """Brings rsl_rl's networks and optimiser up to date, of which checkpoints are made."""

    def _take_from_rsl_rl(self) -> None:
        """Takes over rsl_rl's networks and optimiser, into which a checkpoint was loaded."""

    def start_from(self, path: Path) -> None:
        """Takes over a checkpoint's networks and nothing else.

        Raises ConfigError where they do not fit.
        """
        data = self.workers.from_first(lambda: run_dir.read_checkpoint(path))
        state = run_dir.checkpoint_of(data, path, self.device)
        try:
            if self._distils:
                self.alg.get_policy().load_state_dict(state["actor_state_dict"])
            else:
                self.alg.load(state, {"actor": True, "critic": self._fit_critic(path, state)}, True)
        except (AttributeError, RuntimeError, LookupError, TypeError, ValueError) as error:
            raise _core.ConfigError(
                f"--init {path} does not fit this run's networks, {_first_line(error)}: "
                "use its task and its train config's sizes"
            ) from error
        self._limit_deviations(str(path))

    def _fit_critic(self, path: Path, state: dict[str, Any]) -> bool:
        """Makes a checkpoint's critic this run's; returns whether there is one to load.

        An actor whose weights know no slots acts for other bodies. Its critic goes on with the
        numbers that both know.
        """
        if "critic_state_dict" not in state:
            self.reporter.message(f"polypod: {path}: it has no critic; a new one learns from here on")
            return False
        if not isinstance(self.alg.actor, UrmaModel):
            return True
        own, other = self.alg.critic.state_dict(), state["critic_state_dict"]
        if own.keys() == other.keys() and all(own[key].shape == other[key].shape for key in own):
            return True
        groups, sim = self.config.obs_groups.critic, self.env.unwrapped.sim
        is_known = (path.parent / run_dir.MANIFEST).is_file()
        known = numbers_of_run(run_dir.read_manifest(path), groups) if is_known else None
        wanted = numbers_of(sim, groups)
        moved = None if known is None else perceptron_for(other, known, own, wanted)
        if moved is None:
            self.reporter.message(
                f"polypod: {path}: its critic is for other bodies or terms; a new one learns from here on"
            )
            return False
        kept = len(set(known or ()) & set(wanted))
        self.reporter.message(
            f"polypod: {path}: its critic goes on with {kept} of {len(wanted)} numbers; the others are new to it"
        )
        state["critic_state_dict"] = moved
        return True

    def learn_from(self, teacher: Path) -> None:
        """Takes over the network that a distillation learns from.

        Raises ConfigError where it does not fit.
        """
        state = run_dir.load_checkpoint(teacher, self.device)
        limit = run_dir.read_manifest(teacher)["policy"].get("clip_actions")
        if limit is not None:
            clip_actions(self.alg.teacher, limit)
        try:
            self.alg.load(state, {"teacher": True}, True)
        except (AttributeError, RuntimeError, KeyError, TypeError, ValueError) as error:
            raise _core.ConfigError(
                f"[distillation] teacher {teacher} does not fit the observation groups that [obs_groups] names for it: "
                f"{_first_line(error)}; give them the terms of the teacher's task"
            ) from error

    @contextlib.contextmanager
    def _stop_on_signals(self) -> Iterator[None]:
        """Lets `STOP_SIGNALS` end the training after the iteration under way.

        A second one ends it at once.
        """
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


def _floats(data: bytes) -> torch.Tensor:
    return torch.from_numpy(np.frombuffer(data, np.float32).copy())


def _byte_tensor(data: bytes) -> torch.Tensor:
    return torch.from_numpy(np.frombuffer(data, np.uint8).copy())


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
