"""Distillation of many teachers into one student, each for its robots.

A teacher reads the numbers that it was trained on. They are found in the observation groups of the
student's task by term, control step, place within the term and joint or leg, so the columns of
teacher and student may differ.
"""

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from rsl_rl.algorithms import Distillation
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from rsl_rl.utils import resolve_class, resolve_obs_groups
from tensordict import TensorDict

from polypod import _core, simulated
from polypod.descriptions import for_one_env_each
from polypod.networks import UrmaModel
from polypod.networks.masked import ACTION_MASK
from polypod.networks.policies import load_network
from polypod.networks.urma import JointCounts, counted
from polypod.observation import terms_of
from polypod.policy import with_slots
from polypod.rsl_rl import VecEnv
from polypod.runs import run_dir
from polypod.runs.schema import OTHERS, URMA
from polypod.training.gpu_update import ask_policy
from polypod.training.workers import Workers

GOLDEN = 0.6180339887498949
"""Fractions of its multiples are spread evenly, however many there are."""
OF_TRAINING = ("term", "noise", "history_length", "error")
"""Keys of an observation term in which a teacher's task may differ from the student's: the mapping
takes care of terms and histories, and noise and errors are the training's."""


class Number(NamedTuple):
    """A number of an observation."""

    term: str
    owner: str
    """Slot or leg that the number belongs to; empty: the body."""
    place: int
    """Place among the numbers of the term that this owner has at one control step."""
    age: int
    """Control steps since it was measured."""


class Teacher:
    """A policy that says for the envs of some robots what it would do."""

    def __init__(
        self, path: str, rows: torch.Tensor, source: "_Source", ratios: torch.Tensor, device: str, holds: bool = False
    ) -> None:
        """Loads the policy and finds its numbers.

        Args:
            path: of the checkpoint, next to its manifest.
            rows: int64 [n], its envs.
            source: the student's simulation.
            ratios: [n, 1], the student's action scale over the teacher's, by env.
            device: where it acts.
            holds: whether it neither sees nor moves joints that no robot of its training had.

        Raises:
            ConfigError: for a task or a robot of the teacher that is not on this machine, for a
                number that the student's groups lack, and for a robot with joints that the teacher
                does not know.
        """
        checkpoint = Path(path)
        state, manifest = run_dir.load_checkpoint(checkpoint), run_dir.read_manifest(checkpoint)
        sim = _sim_of(path, manifest, [] if holds else source.slots_of(rows.tolist()))
        if manifest["policy"]["class_name"] == URMA:
            manifest = with_slots(manifest, sim)
        elif lacking := [slot for slot in sim.canonical_joint_names if slot not in manifest["canonical_joint_names"]]:
            raise _core.ConfigError(
                f"[distillation.teachers] {path} was trained without the joints {', '.join(lacking[:6])}; name a "
                'network of joints, or a teacher that knows these joints, or write unknown_joints = "held"'
            )
        if manifest["policy"]["num_obs"] != sim.num_obs:
            raise _core.ConfigError(
                f"[distillation.teachers] {path} reads {manifest['policy']['num_obs']} numbers, and its task "
                f"{manifest['task']} has {sim.num_obs} today; train it again"
            )
        self.network: MLPModel = load_network(state, manifest["policy"]).to(device)
        self.rows = rows.to(device)
        columns = source.columns_of(sim, rows.tolist(), path)
        self._columns = torch.tensor(columns, device=device)
        taken = {slot: column for column, slot in enumerate(sim.canonical_joint_names)}
        pairs = [(taken[slot], column) for column, slot in enumerate(source.slots) if slot in taken]
        self._given, self._wanted = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2).T.to(device)
        joints = source.mask[rows][:, self._wanted.cpu()].sum(dim=1)
        if not joints.all():
            raise _core.ConfigError(f"[distillation.teachers] {path} has a robot whose joints it does not know at all")
        self._ratios = None if bool((ratios == 1.0).all()) else ratios.to(device)
        acted = [number.term in source.actions for number in _numbers(sim, "policy")]
        self._acted = torch.tensor(acted, device=device)
        if isinstance(self.network, UrmaModel):
            self.network.mlp.counts = JointCounts(len(rows), int(joints.sum()), int(joints.max()))

    def write(self, observations: torch.Tensor, labels: torch.Tensor) -> None:
        """Writes the teacher's actions to its rows of `labels`, [num_envs, num_actions].

        `observations` are the student's groups side by side, with a last column of zeros.
        """
        seen = observations.index_select(0, self.rows).index_select(1, self._columns)
        if self._ratios is not None:
            seen = torch.where(self._acted, seen * self._ratios, seen)
        actions = self.network(TensorDict({"policy": seen}, batch_size=[len(seen)])).float()
        if self._ratios is not None:
            actions = actions / self._ratios
        labels[self.rows.unsqueeze(1), self._wanted] = actions.index_select(1, self._given)


class _Source:
    """The student's simulation as teachers read it."""

    def __init__(self, sim: _core.VecSim, groups: Sequence[str]) -> None:
        self.sim, self.groups = sim, list(groups)
        self.slots: list[str] = sim.canonical_joint_names
        self.mask = torch.from_numpy(sim.action_mask)
        self._places: dict[Number, tuple[int, str]] = {}
        """Column and group of each number; the first group with it counts."""
        self.width = 0
        for group in groups:
            for number in _numbers(sim, group):
                self._places.setdefault(number, (self.width, group))
                self.width += 1
        self._treatments = {group: _treatments(sim, group) for group in groups}
        terms = [term for group in groups for term in terms_of(sim, group)]
        self.actions = {term.term for term in terms if term.source == "last_action"}

    def slots_of(self, rows: list[int]) -> list[str]:
        """Slots of the robots of some envs."""
        here = self.mask[rows].any(dim=0).tolist()
        return [slot for slot, is_there in zip(self.slots, here, strict=True) if is_there]

    def columns_of(self, sim: _core.VecSim, rows: list[int], path: str) -> list[int]:
        """Columns of the numbers that a policy of `sim` reads for the robots of some envs.

        A number of a joint or leg that these robots lack has the last column, of zeros.
        """
        owners = {"", *self.slots_of(rows), *self.sim.feet_names}
        columns: list[int] = []
        taken: set[tuple[str, str]] = set()
        for number in _numbers(sim, "policy"):
            place = self._places.get(number)
            if place is not None:
                columns.append(place[0])
                taken.add((number.term, place[1]))
            elif number.owner not in owners:
                columns.append(self.width)
            else:
                past = f", {number.age} control steps before the present one" if number.age else ""
                raise _core.ConfigError(
                    f"[distillation.teachers] {path} reads the term {number.term}{past}, which the observation groups "
                    f"{', '.join(self.groups)} of {self.sim.task_name} lack; add it to [[observations.teacher]], or "
                    "name its group in [obs_groups] teacher"
                )
        wanted = _treatments(sim, "policy")
        for term, group in sorted(taken):
            if wanted[term] != (here := self._treatments[group][term]):
                raise _core.ConfigError(
                    f"[distillation.teachers] {path} reads the term {term} with {_shown(wanted[term])}, and the "
                    f"student's task gives it with {_shown(here)}; give the term of [[observations.{group}]] the same "
                    "values"
                )
        return columns


class Teachers(torch.nn.Module):
    """All teachers of a simulation, as one that has an action for every env."""

    def __init__(
        self, sim: _core.VecSim, groups: Sequence[str], paths: Mapping[str, str], device: str, *, holds: bool = False
    ) -> None:
        """Loads the teachers of the robots that have envs here.

        Args:
            sim: of the student.
            groups: observation groups that teachers read.
            paths: a checkpoint by robot; `OTHERS` for all that are not named.
            device: where they act.
            holds: as of `Teacher`.

        Raises:
            ConfigError: as `Teacher`, for a robot without a teacher, and for an unknown robot.
        """
        super().__init__()
        self._groups, self._num_actions = list(groups), sim.num_actions
        source, infos = _Source(sim, groups), _infos(sim)
        known = {*sim.robots, *(entry["name"] for entry in _core.robots()), OTHERS}
        for robot in paths:
            if robot not in known:
                nearest = difflib.get_close_matches(robot, known, n=1, cutoff=0.0)[0]
                raise _core.ConfigError(
                    f"[distillation.teachers] {robot[:80]!r} is no robot of the run or the library; did you mean "
                    f"{nearest!r}?"
                )
        robots_of: dict[str, list[str]] = {}
        for robot in sim.robots:
            if (path := paths.get(robot, paths.get(OTHERS))) is None:
                raise _core.ConfigError(
                    f'[distillation.teachers] names no teacher of {robot}; add {robot} = "...", or "{OTHERS}" for all '
                    "others"
                )
            robots_of.setdefault(path, []).append(robot)
        self.teachers: list[Teacher] = []
        for path, robots in robots_of.items():
            blocks = {robot: range(*sim.env_ids(robot)) for robot in robots}
            rows = torch.tensor([row for block in blocks.values() for row in block], dtype=torch.int64)
            if not len(rows):
                continue
            trained = run_dir.read_manifest(Path(path)).get("robot_info", {})
            ratios = [
                infos[robot]["action_scale"] / trained.get(robot, infos[robot])["action_scale"]
                for robot, block in blocks.items()
                for _ in block
            ]
            scales = torch.tensor(ratios, dtype=torch.float32).unsqueeze(1)
            self.teachers.append(Teacher(path, rows, source, scales, device, holds))
        self.networks = torch.nn.ModuleList(teacher.network for teacher in self.teachers)

    @torch.no_grad()
    def forward(self, obs: TensorDict) -> torch.Tensor:
        """Actions [num_envs, num_actions] in the student's slots; 0 where a robot has no joint."""
        groups = [obs[group] for group in self._groups]
        observations = torch.cat([*groups, groups[0].new_zeros(len(groups[0]), 1)], dim=1)
        labels = observations.new_zeros(len(observations), self._num_actions)
        for teacher in self.teachers:
            teacher.write(observations, labels)
        return labels

    def reset(self, dones: torch.Tensor | None = None, hidden_state: Any = None) -> None:
        """Tells recurrent teachers which episodes have ended, [num_envs]."""
        if dones is not None:
            for teacher in self.teachers:
                teacher.network.reset(dones.view(-1)[teacher.rows])


class ManyTeachers(Distillation):
    """rsl_rl's distillation with `Teachers`: robots or envs count equally, missing joints not.

    In a share of each robot's envs the teacher acts in the student's place: a student that falls at
    once sees nothing of walking.
    """

    teacher: Teachers
    last_hidden_states: tuple[Any, Any]

    def __init__(self, *args: Any, weights: str = "robots", **kwargs: Any) -> None:
        """Distillation as in rsl_rl; `weights` says what counts equally, "robots" or "envs"."""
        super().__init__(*args, **kwargs)
        self._by_robot = weights == "robots"
        self.teacher_share = 0.0
        """Share of each robot's envs in which the teacher acts."""
        self.counts: JointCounts | None = None
        """Joints of the robots of all envs."""

    @staticmethod
    def construct_algorithm(obs: TensorDict, env: VecEnv, cfg: dict[str, Any], device: str) -> "ManyTeachers":
        """Builds the student and its teachers, as rsl_rl asks for it."""
        _, algorithm = resolve_class(cfg["algorithm"])
        student_class, student_cfg = resolve_class(cfg["student"])
        groups = cfg["obs_groups"] = resolve_obs_groups(obs, cfg["obs_groups"], ["student", "teacher"])
        sim = env.unwrapped.sim
        student = student_class(obs, groups, "student", env.num_actions, **student_cfg).to(device)
        holds = algorithm.pop("unknown_joints") == "held"
        teachers = Teachers(sim, groups["teacher"], algorithm.pop("teachers"), device, holds=holds)
        storage = RolloutStorage(
            "distillation", env.num_envs, cfg["num_steps_per_env"], _seen(obs, groups), [env.num_actions], device
        )
        made = ManyTeachers(student, teachers, storage, device=device, **algorithm, multi_gpu_cfg=cfg["multi_gpu"])
        made.weigh(sim, groups, Workers.alone())
        return made

    def weigh(self, sim: _core.VecSim, groups: Mapping[str, list[str]], workers: Workers) -> None:
        """Weighs errors: the mean over the joints of a robot, then over robots or over all envs.

        Args:
            sim: of the student.
            groups: observation groups of student and teachers.
            workers: those that have the other envs.
        """
        self._student_groups = groups
        mask = torch.from_numpy(sim.action_mask.astype(np.float32))
        blocks = [sim.env_ids(robot) for robot in sim.robots]
        counts = workers.sum(torch.tensor([float(stop - start) for start, stop in blocks], dtype=torch.float64))
        weights = torch.zeros_like(mask)
        order = torch.zeros(len(mask))
        joints = mask.sum(dim=1, keepdim=True).clamp(min=1.0)
        total = float(counts.sum())
        for (start, stop), count in zip(blocks, counts.tolist(), strict=True):
            equal = count * len(blocks) if self._by_robot else total
            weights[start:stop] = mask[start:stop] / (joints[start:stop] * equal)
            order[start:stop] = (torch.arange(stop - start, dtype=torch.float64) * GOLDEN % 1.0).float()
        # workers average their gradients
        self._weights = (weights * workers.count).to(self.device)
        self._order = order.unsqueeze(1).to(self.device)
        self.counts = JointCounts(len(mask), int(mask.sum()), int(mask.sum(dim=1).max()))
        shares = [1.0 / len(blocks) if self._by_robot else count / total for count in counts.tolist()]
        of_robots = zip(sim.robots, blocks, shares, strict=True)
        self._robots = [(robot, *block, share) for robot, block, share in of_robots if block[0] < block[1]]

    def set_learning_rate(self, rate: float) -> None:
        """Sets the step of the optimiser."""
        self.learning_rate = rate
        for group in self.optimizer.param_groups:
            group["lr"] = rate

    @torch.no_grad()
    def choose(self, obs: TensorDict, share: torch.Tensor | float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Draws what the robots do, and asks teachers what they would do; nothing waits for a GPU.

        Args:
            obs: by group.
            share: of each robot's envs in which the teacher acts, with the student's noise.

        Returns:
            Actions and labels, [num_envs, num_actions], and the deviations of the noise.
        """
        with counted([self.student], self.counts):
            ask_policy(self.student, obs)
        mean, std, *mask = self.student.output_distribution_params
        noise = std * torch.randn_like(mean)
        if mask:
            noise = noise * mask[0]
        labels = self.teacher(obs)
        return torch.where(self._order < share, labels, mean) + noise, labels, std

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Actions of the student, or of the teacher with the student's noise."""
        actions, labels, _ = self.choose(obs, self.teacher_share)
        self.transition.actions, self.transition.privileged_actions = actions, labels
        self.transition.observations = _seen(obs, self._student_groups)
        return actions

    def update(self) -> dict[str, float]:
        """Learns from the stored steps; returns the mean loss, of all robots and of each."""
        self.num_updates += 1
        errors = torch.zeros_like(self._weights)
        loss, count = torch.zeros((), device=self.device), 0
        with counted([self.student], self.counts):
            for _ in range(self.num_learning_epochs):
                self.student.reset(hidden_state=self.last_hidden_states[0])
                self.student.detach_hidden_state()
                for batch in self.storage.generator():
                    error = self.errors(batch.observations, batch.privileged_actions)
                    errors += error.detach()
                    loss = loss + self.loss(error)
                    count += 1
                    if count % self.gradient_length == 0:
                        self._learn(loss)
                        loss = torch.zeros((), device=self.device)
                    self.student.reset(batch.dones.view(-1))
                    self.student.detach_hidden_state(batch.dones.view(-1))
        self.last_hidden_states = (self.student.get_hidden_state(), None)
        self.student.detach_hidden_state()
        self.student.update_normalization(self.storage.observations.flatten(0, 1))
        self.storage.clear()
        return self.figures(errors / count)

    def errors(self, observations: TensorDict, labels: torch.Tensor) -> torch.Tensor:
        """Error of each action of the student, [num_envs, num_actions]."""
        with torch.amp.autocast(
            torch.device(self.device).type,
            dtype=torch.bfloat16,
            enabled=self.use_mixed_precision,
            cache_enabled=False,  # a graph reads the weights at each replay
        ):
            actions = self.student(observations)
        errors: torch.Tensor = self.loss_fn(actions.float(), labels, reduction="none")
        return errors

    def loss(self, errors: torch.Tensor) -> torch.Tensor:
        """The weighted mean of the errors of one control step."""
        return (errors * self._weights).sum()

    def _learn(self, loss: torch.Tensor) -> None:
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self.is_multi_gpu:
            self.reduce_parameters()
        if self.max_grad_norm:
            torch.nn.utils.clip_grad_norm_(self.student.parameters(), self.max_grad_norm)
        self.optimizer.step()
        self.student.detach_hidden_state()

    def figures(self, errors: torch.Tensor) -> dict[str, float]:
        """The mean loss, of all robots and of each, of mean errors [num_envs, num_actions]."""
        of_envs = (errors * self._weights).sum(dim=1)
        sums = torch.stack([of_envs.sum(), *(of_envs[start:stop].sum() for _, start, stop, _ in self._robots)]).tolist()
        own = zip(self._robots, sums[1:], strict=True)
        return {"behavior": sums[0], **{f"behavior/{robot}": own_sum / share for (robot, *_, share), own_sum in own}}

    def save(self) -> dict[str, Any]:
        """The student and its optimiser; teachers stay where they are."""
        state: dict[str, Any] = super().save()
        del state["teacher_state_dict"]
        return state

    def load(self, loaded_dict: dict[str, Any], load_cfg: dict[str, bool] | None, strict: bool) -> bool:
        """Goes on with the student and its optimiser."""
        self._raw_student.load_state_dict(loaded_dict["student_state_dict"], strict=strict)
        self.optimizer.load_state_dict(loaded_dict["optimizer_state_dict"])
        return True

    def broadcast_parameters(self) -> None:
        """Gives all workers the student of the first one."""
        for tensor in self._raw_student.state_dict().values():
            torch.distributed.broadcast(tensor, src=0)


def _seen(obs: TensorDict, groups: Mapping[str, list[str]]) -> TensorDict:
    """The student's observations: labels are stored, not what teachers saw."""
    seen: TensorDict = obs.select(*groups["student"], *([ACTION_MASK] if ACTION_MASK in obs.keys() else []))  # noqa: SIM118
    return seen


def _sim_of(path: str, manifest: Mapping[str, Any], slots: Sequence[str]) -> _core.VecSim:
    """A simulation of a teacher's task and robots, with more slots where it lacks some."""
    robots = list(manifest["robot_sources"])
    try:
        return _core.VecSim(
            manifest["task"],
            len(robots),
            robots=robots,
            threads=1,
            overrides=for_one_env_each(manifest["overrides"]),
            slots=list(dict.fromkeys([*manifest["canonical_joint_names"], *slots])),
        )
    except _core.PolypodError as error:
        raise _core.ConfigError(
            f"[distillation.teachers] {path}: its task {manifest['task']} with {', '.join(robots)[:200]} cannot be "
            f"built here: {error}"
        ) from error


def _numbers(sim: _core.VecSim, group: str) -> list[Number]:
    """Numbers of an observation group, in order."""
    numbers: list[Number] = []
    for term in terms_of(sim, group):
        of_kind = {"per_joint": sim.canonical_joint_names, "per_foot": sim.feet_names}.get(term.kind)
        owners = of_kind if of_kind and term.width % len(of_kind) == 0 else [""]
        for age in reversed(range(term.history_length)):
            places = range(term.width // len(owners))
            numbers += [Number(term.term, owner, place, age) for place in places for owner in owners]
    return numbers


def _treatments(sim: _core.VecSim, group: str) -> dict[str, dict[str, Any]]:
    """Treatment of the terms of a group in a task, by name, without `OF_TRAINING`."""
    task = simulated.config(sim)["task"]
    entries = task["observations"][group]
    return {entry["term"]: {key: value for key, value in entry.items() if key not in OF_TRAINING} for entry in entries}


def _infos(sim: _core.VecSim) -> dict[str, Any]:
    infos: dict[str, Any] = simulated.robots(sim)
    return infos


def _shown(treatment: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} = {value}" for key, value in treatment.items()) or "no treatment"
