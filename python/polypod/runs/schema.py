"""`configs/train/*.toml`: what is typed there, and turned into the configuration of a learner."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from polypod import _core, runs
from polypod.files import real_path
from polypod.observation import layout_of, terms_of
from polypod.runs.manifest import read as read_manifest

OBSERVATION_GROUP = "policy"
"""Name of the observation group that actor and critic read."""

ALTERNATE = "alternate"
"""Symmetry that learns from each sample or its mirror image, in turn from epoch to epoch."""
LEARNERS = ("auto", "native", "rsl_rl")
ARITHMETICS = ("torch", "native")
RNN_TYPES = ("lstm", "gru")
LOSSES = ("mse", "huber")
UNKNOWN_JOINTS = ("seen", "held")
"""Values of `unknown_joints` of a distillation."""
EQUALS = ("robots", "envs")
"""Values of `weights` of a distillation."""
OTHERS = "*"
"""Key of `[distillation.teachers]` for all robots that it does not name."""
NATIVE_ACTIVATIONS = ("elu", "relu", "tanh")

MLP = "MLPModel"
RNN = "RNNModel"
URMA = "polypod.networks:UrmaModel"
JOINT_GAUSSIAN = "polypod.networks:JointGaussian"
MASKED_MLP = "polypod.networks:MaskedMLPModel"
MASKED_GAUSSIAN = "polypod.networks:MaskedGaussian"
MANY_TEACHERS = "polypod.training.teachers:ManyTeachers"
"""Class names as rsl_rl resolves them."""


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """`[run]`: how much to simulate."""

    task: str
    """Name, alias or path of the task."""
    num_envs: int
    """Number of envs, of all robots together."""
    max_iterations: int
    """Iterations of a training."""
    num_steps_per_env: int
    """Control steps of each env in an iteration."""
    save_interval: int
    """Iterations between two checkpoints."""
    normalize_reward_per_robot: bool
    """Whether rewards are divided by the deviation of their robot's returns."""
    normalize_advantage_per_robot: bool
    """Whether advantages are normalised among the envs of each robot."""
    symmetry: bool | str
    """Whether each sample is learned from together with its mirror image; "alternate": from the
    one or the other, in turn from epoch to epoch."""
    learner: str = "rsl_rl"
    """Learner: native, rsl_rl, or auto. Runs of manifests without this key are rsl_rl's."""
    arithmetic: str = "torch"
    """Arithmetic of the native learner's update on a GPU: "torch", or "native", which gives the
    policy of the CPU, bit for bit."""
    task_changes: list[str] = dataclasses.field(default_factory=list)
    """Task overrides used only during training, as `key=value` of `--set`."""
    clip_actions: float | None = None
    """Greatest magnitude of the actions that robots act with, and see as `last_action`; None: no
    limit."""


@dataclasses.dataclass(frozen=True)
class AlgorithmConfig:
    """`[algorithm]`: PPO, in rsl_rl's words."""

    num_learning_epochs: int
    """Passes over an iteration's samples."""
    num_mini_batches: int
    """Mini-batches of a pass."""
    learning_rate: float
    """Step size of Adam; with the schedule "adaptive" the first one."""
    schedule: str
    """Whether the learning rate follows the divergence of the policies."""
    desired_kl: float
    """Divergence of the policy before and after an update that the adaptive schedule aims at."""
    gamma: float
    """Discount of rewards per control step."""
    lam: float
    """Decay of generalised advantage estimates."""
    clip_param: float
    """Largest change of an action's probability that the loss rewards, as a share."""
    use_clipped_value_loss: bool
    """Whether changes of values are clipped in the same way."""
    value_loss_coef: float
    """Weight of the loss of values."""
    entropy_coef: float
    """Weight of the entropy, which keeps the policy exploring."""
    max_grad_norm: float
    """Largest norm of a gradient; greater ones are scaled down."""
    normalize_advantage_per_mini_batch: bool
    """Whether advantages are normalised in each mini-batch, not over all samples."""
    mixed_precision: str
    """Whether networks compute in bfloat16; "auto": where that is faster."""
    critic_warmup_iterations: int = 0
    """First iterations, in which the critic learns alone: weights and deviations of the actor stay
    as they begin, with `--init` those of a policy that walks."""
    mirror_loss_coef: float = 0.0
    """Weight of the mirror loss, which leads the policy back to symmetry; needs `[run] symmetry`.

    The loss is the squared difference between the policy's mean at a mirror image and the mirrored
    mean of the policy that collected the sample. It is averaged over images and a robot's actions.
    rsl_rl's `mirror_loss_coeff` mirrors the mean of the policy that learns instead."""


@dataclasses.dataclass(frozen=True)
class AnnealConfig:
    """`[anneal]`: values of PPO's goals at the end of a run, for ever less exploration.

    From the iteration `start * max_iterations` on, each goal moves linearly from its value in
    `[algorithm]` to the value here, which it has in the last iteration and after it.
    """

    start: float
    """Share of the iterations after which the goals begin to move."""
    entropy_coef: float
    """Weight of the entropy in the end."""
    desired_kl: float
    """Divergence that the adaptive schedule aims at in the end."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CriticConfig:
    """`[critic]`: a multi-layer perceptron, a recurrent network, or a network of joints."""

    class_name: str = MLP
    """Kind of network."""
    hidden_dims: list[int]
    """Widths of the hidden layers."""
    activation: str
    """Function between layers."""
    obs_normalization: bool
    """Whether observations are normalised by their mean and deviation so far."""
    joint_dim: int | None = None
    """Width of the vector of a joint; networks of joints need it."""
    num_heads: int | None = None
    """Heads of the attention over joints; networks of joints need it."""
    leg_heads: int | None = None
    """Heads that look at legs alone, the others at all other limbs; networks of joints have
    them."""
    rnn_type: str | None = None
    """Kind of recurrent layer; recurrent networks need it."""
    rnn_hidden_dim: int | None = None
    """Width of a recurrent layer; recurrent networks need it."""
    rnn_num_layers: int | None = None
    """Number of recurrent layers; recurrent networks need it."""

    def model_cfg(self, sim: _core.VecSim | None, groups: Sequence[str] = (OBSERVATION_GROUP,)) -> dict[str, Any]:
        """The network's constructor arguments, with the class names that rsl_rl resolves.

        Args:
            sim: whose observations and joints the network is for; a multi-layer perceptron does
                without.
            groups: the observation groups that it sees, side by side.

        Raises:
            ConfigError: for a network of joints without `sim`.
        """
        network = {key: value for key, value in dataclasses.asdict(self).items() if value is not None}
        if self.class_name != URMA:
            return network
        if sim is None:
            raise _core.ConfigError(
                f"{self.class_name} is made for the joints of an env: call rsl_rl_cfg(env.sim) of the train config"
            )
        layout = layout_of([term for group in groups for term in terms_of(sim, group)])
        return {**network, "observation_layout": layout, "joint_names": sim.canonical_joint_names}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorConfig(CriticConfig):
    """`[actor]`: a network whose output is the mean of a Gaussian with a learned deviation."""

    init_std: float
    """Standard deviation of the actions at the beginning."""

    def model_cfg(self, sim: _core.VecSim | None, groups: Sequence[str] = (OBSERVATION_GROUP,)) -> dict[str, Any]:
        """The network's configuration with that of the distribution."""
        network = super().model_cfg(sim, groups)
        distribution = {"class_name": "GaussianDistribution", "init_std": network.pop("init_std")}
        if self.class_name == URMA:
            distribution["class_name"] = JOINT_GAUSSIAN
        return {**network, "distribution_cfg": distribution}


class Goals(NamedTuple):
    """Goals of PPO in an iteration."""

    entropy_coef: float
    desired_kl: float


@dataclasses.dataclass(frozen=True)
class ObsGroupsConfig:
    """`[obs_groups]`: observation groups that each network sees, side by side.

    Names are rsl_rl's.
    """

    actor: list[str] = dataclasses.field(default_factory=lambda: [OBSERVATION_GROUP])
    """Groups that the actor sees."""
    critic: list[str] = dataclasses.field(default_factory=lambda: [OBSERVATION_GROUP])
    """Groups that the critic sees."""
    rnd_state: list[str] = dataclasses.field(default_factory=lambda: [OBSERVATION_GROUP])
    """Groups in which random network distillation looks for new states."""
    teacher: list[str] = dataclasses.field(default_factory=lambda: ["teacher"])
    """Groups that the teacher of a distillation sees."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RndConfig:
    """`[rnd]`: random network distillation, a reward for new observations, as in rsl_rl."""

    weight: float
    """Weight of the reward."""
    num_outputs: int = 1
    """Numbers that the networks give."""
    predictor_hidden_dims: list[int] = dataclasses.field(default_factory=lambda: [64, 64])
    """Widths of the hidden layers of the network that learns."""
    target_hidden_dims: list[int] = dataclasses.field(default_factory=lambda: [64, 64])
    """Widths of the hidden layers of the network that is learned."""
    activation: str = "elu"
    """Function between layers."""
    state_normalization: bool = True
    """Whether observations are normalised."""
    reward_normalization: bool = True
    """Whether the reward is divided by its deviation."""
    learning_rate: float = 1e-3
    """Step size of Adam."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DistillationConfig:
    """`[distillation]`: `[actor]` learns to act as a teacher does, in place of PPO.

    `num_learning_epochs`, `learning_rate` and `max_grad_norm` of `[algorithm]` count.
    """

    teacher: str | None = None
    """A model_<n>.pt next to its manifest.json, or a bundled policy: flat, rough, legged, quadruped
    or two_legs."""
    teachers: dict[str, str] | None = None
    """Teachers by robot, in the place of `teacher`; `OTHERS` is the one of all others. Teachers may
    have been trained on other robots, slots and terms than the student sees."""
    teacher_share: float = 0.0
    """Share of each robot's envs in which its teacher acts in the first iteration, with
    `teachers`."""
    teacher_iterations: int = 100
    """Iterations in which that share falls linearly to 0."""
    gradient_length: int = 15
    """Control steps between two steps of the optimiser."""
    loss_type: str = "mse"
    """Loss between the actions of student and teacher."""
    weights: str = "robots"
    """With `teachers`, what counts equally in the loss: "robots", however many envs they have, or
    "envs", so that `[env_shares]` of the task say how much a robot counts."""
    unknown_joints: str = "seen"
    """With `teachers`, what a teacher does with slots that no robot of its training had: "seen",
    which networks of joints alone can, or "held": it neither sees nor moves them."""
    final_learning_rate: float | None = None
    """With `teachers`, the learning rate of the last iteration, to which it falls from that of
    `[algorithm]` along a cosine; none: it stays."""

    def learning_rate(self, first: float, iteration: int, iterations: int) -> float:
        """Learning rate of an iteration, counted from 0, of a training that begins at `first`."""
        if self.final_learning_rate is None:
            return first
        share = min(iteration / max(iterations - 1, 1), 1.0)
        return self.final_learning_rate + (first - self.final_learning_rate) * 0.5 * (1.0 + math.cos(math.pi * share))

    def share_of_teachers(self, iteration: int) -> float:
        """Share of the envs in which teachers act in an iteration, counted from 0."""
        return self.teacher_share * max(0.0, 1.0 - iteration / self.teacher_iterations)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """One train config, complete."""

    run: RunConfig
    algorithm: AlgorithmConfig
    actor: ActorConfig
    critic: CriticConfig
    anneal: AnnealConfig | None = None
    obs_groups: ObsGroupsConfig = dataclasses.field(default_factory=ObsGroupsConfig)
    rnd: RndConfig | None = None
    distillation: DistillationConfig | None = None

    def as_dict(self) -> dict[str, Any]:
        """The config as it would stand in its file."""
        sections = {name: table for name, table in dataclasses.asdict(self).items() if table is not None}
        return {name: {k: v for k, v in table.items() if v is not None} for name, table in sections.items()}

    @property
    def observed_groups(self) -> dict[str, list[str]]:
        """Observation groups of each network, by rsl_rl's names of the networks' purposes."""
        groups = self.obs_groups
        if self.distillation is not None:
            return {"student": [*groups.actor], "teacher": [*groups.teacher]}
        of_rnd = {} if self.rnd is None else {"rnd_state": [*groups.rnd_state]}
        return {"actor": [*groups.actor], "critic": [*groups.critic], **of_rnd}

    def policy_cfg(self, sim: _core.VecSim) -> dict[str, Any]:
        """The actor's constructor arguments for a manifest, with the limit of its actions.

        Arguments and errors are those of `CriticConfig.model_cfg`.
        """
        limit = self.run.clip_actions
        return {**self.actor.model_cfg(sim), **({} if limit is None else {"clip_actions": limit})}

    def goals(self, iteration: int) -> Goals:
        """Goals of PPO in an iteration, counted from 0."""
        begin = Goals(self.algorithm.entropy_coef, self.algorithm.desired_kl)
        if self.anneal is None:
            return begin
        first = self.anneal.start * self.run.max_iterations
        share = min(max((iteration + 1 - first) / max(self.run.max_iterations - first, 1.0), 0.0), 1.0)
        return Goals(
            begin.entropy_coef + share * (self.anneal.entropy_coef - begin.entropy_coef),
            begin.desired_kl + share * (self.anneal.desired_kl - begin.desired_kl),
        )

    def with_teacher_located(self) -> "TrainConfig":
        """The config with the absolute paths of its teachers, for runs from any directory."""
        if (of := self.distillation) is None:
            return self

        def located(name: str) -> str:
            return str(real_path(runs.resolve(Path(name))))

        teacher = None if of.teacher is None else located(of.teacher)
        teachers = None if of.teachers is None else {robot: located(name) for robot, name in of.teachers.items()}
        return dataclasses.replace(self, distillation=dataclasses.replace(of, teacher=teacher, teachers=teachers))

    def with_mixed_precision_resolved(self, device_type: str) -> "TrainConfig":
        """The config with "auto" decided for this machine, so that a resumed run does the same.

        The learner must be resolved: the native one computes in f32, unless "on" asks for bfloat16
        on a GPU.
        """
        if self.algorithm.mixed_precision != "auto":
            return self
        is_faster = self.run.learner != "native" and _computes_in_bfloat16(device_type)
        mode = "on" if is_faster else "off"
        return dataclasses.replace(self, algorithm=dataclasses.replace(self.algorithm, mixed_precision=mode))

    def with_learner_resolved(self, learner: str | None, device_type: str = "cpu") -> "TrainConfig":
        """The config with "auto" decided: the native learner if it knows the networks, else rsl_rl.

        Args:
            learner: what is to learn instead of what the config says; None: that.
            device_type: where it learns, in torch's words.

        Raises:
            ConfigError: for an unknown learner, and for one that cannot learn what the config asks
                for.
        """
        chosen = self.run.learner if learner is None else learner
        if chosen not in LEARNERS:
            raise _core.ConfigError(f"the learner {chosen!r} is not one of {', '.join(LEARNERS)}")
        why_not = self._why_not_native(device_type)
        if chosen == "auto":
            chosen = "rsl_rl" if why_not else "native"
        config = dataclasses.replace(self, run=dataclasses.replace(self.run, learner=chosen))
        if config.run.learner == "native" and why_not:
            raise _core.ConfigError(f"the native learner {why_not}; use --learner rsl_rl or auto")
        if config.run.learner == "rsl_rl" and self.run.arithmetic == "native":
            raise _core.ConfigError(
                '[run] arithmetic = "native" is of the native learner, and rsl_rl learns this; leave it out, or use '
                "--learner native"
            )
        if config.run.learner == "rsl_rl" and config.run.symmetry == ALTERNATE and not config.can_be_graphs:
            raise _core.ConfigError(
                f'[run] symmetry = "{ALTERNATE}" goes with neither [rnd] nor [distillation]; use symmetry = true'
            )
        return config

    @property
    def can_be_graphs(self) -> bool:
        """Whether a `GraphRunner` learns this: PPO without [rnd] and recurrent networks."""
        networks = (self.actor, self.critic)
        return self.rnd is None and self.distillation is None and all(of.class_name != RNN for of in networks)

    @property
    def distils_without_memory(self) -> bool:
        """Whether a `TaughtRunner` learns this: many teachers, no recurrent network.

        Raises:
            ConfigError: for a teacher without a manifest.
        """
        if self.distillation is None or self.distillation.teachers is None or self.actor.class_name == RNN:
            return False
        teachers = sorted(set(self.distillation.teachers.values()))
        return all(
            read_manifest(Path(path).parent / "manifest.json")["policy"]["class_name"] != RNN for path in teachers
        )

    def _why_not_native(self, device_type: str) -> str | None:
        """Reason why the native learner cannot train this config."""
        is_on_cpu = device_type == "cpu"
        if self.rnd is not None:
            return "has no random network distillation, and the train config has [rnd]"
        if self.distillation is not None:
            return "does not distil, and the train config has [distillation]"
        for name in ("actor", "critic"):
            if (groups := getattr(self.obs_groups, name)) != [OBSERVATION_GROUP] and not is_on_cpu:
                return f"sees the group {OBSERVATION_GROUP} alone on a GPU, and {name} sees {', '.join(groups)}"
        for section, network in (("actor", self.actor), ("critic", self.critic)):
            if network.class_name == RNN:
                return f"learns perceptrons and networks of joints, and [{section}] is a {network.class_name}"
            if network.class_name != MLP and not is_on_cpu:
                return f"learns perceptrons alone on a GPU, and [{section}] is a {network.class_name}"
            if network.activation not in NATIVE_ACTIVATIONS:
                return f"knows {', '.join(NATIVE_ACTIVATIONS)}, and [{section}] has activation {network.activation}"
        return None

    def native_options(self, sim: _core.VecSim | None = None) -> dict[str, Any]:
        """Options of `polypod._core.Learner`.

        Args:
            sim: whose observations the networks read; without it, perceptrons read the only
                observation group.

        Raises:
            ConfigError: for a network of joints without `sim`.
        """
        run, algorithm = self.run, dataclasses.asdict(self.algorithm)
        for key in ("learning_rate", "mixed_precision", "critic_warmup_iterations"):
            del algorithm[key]
        if algorithm.pop("schedule") == "fixed":
            algorithm["desired_kl"] = None
        return {
            "num_steps_per_env": run.num_steps_per_env,
            "actor": _native_network(self.actor, sim, self.obs_groups.actor),
            "critic": _native_network(self.critic, sim, self.obs_groups.critic),
            "algorithm": algorithm,
            "normalize_reward_per_robot": run.normalize_reward_per_robot,
            "normalize_advantage_per_robot": run.normalize_advantage_per_robot,
            "symmetry": run.symmetry if isinstance(run.symmetry, str) else "both" if run.symmetry else "none",
        }

    def rsl_rl_cfg(self, sim: _core.VecSim | None = None) -> dict[str, Any]:
        """The configuration that rsl_rl's runner reads.

        Arguments and errors are those of `CriticConfig.model_cfg`.
        """
        algorithm = dataclasses.asdict(self.algorithm)
        algorithm["use_mixed_precision"] = algorithm.pop("mixed_precision") == "on"
        for key in ("critic_warmup_iterations", "mirror_loss_coef"):
            del algorithm[key]
        if self.distillation is not None:
            return self._distillation_cfg(algorithm, sim)
        if self.rnd is not None:
            algorithm["rnd_cfg"] = dataclasses.asdict(self.rnd)
        return {
            "num_steps_per_env": self.run.num_steps_per_env,
            "save_interval": self.run.save_interval,
            "max_iterations": self.run.max_iterations,
            "normalize_reward_per_robot": self.run.normalize_reward_per_robot,
            "normalize_advantage_per_robot": self.run.normalize_advantage_per_robot,
            "symmetry": self.run.symmetry,
            "obs_groups": self.observed_groups,
            "algorithm": {"class_name": "PPO", **algorithm},
            "actor": _masked(self.actor, sim, self.obs_groups.actor),
            "critic": _masked(self.critic, sim, self.obs_groups.critic),
            "check_for_nan": True,
        }

    def _distillation_cfg(self, algorithm: dict[str, Any], sim: _core.VecSim | None) -> dict[str, Any]:
        of = self.distillation
        assert of is not None
        own = ("num_learning_epochs", "learning_rate", "max_grad_norm", "use_mixed_precision")
        cfg: dict[str, Any] = {
            "num_steps_per_env": self.run.num_steps_per_env,
            "save_interval": self.run.save_interval,
            "max_iterations": self.run.max_iterations,
            "normalize_reward_per_robot": False,
            "normalize_advantage_per_robot": False,
            "symmetry": False,
            "obs_groups": self.observed_groups,
            "algorithm": {
                "class_name": "Distillation",
                **{key: algorithm[key] for key in own},
                "gradient_length": of.gradient_length,
                "loss_type": of.loss_type,
            },
            "check_for_nan": True,
        }
        if of.teachers is not None:
            many = {**cfg["algorithm"], "class_name": MANY_TEACHERS, "teachers": of.teachers, "weights": of.weights}
            many["unknown_joints"] = of.unknown_joints
            return {**cfg, "algorithm": many, "student": _masked(self.actor, sim, self.obs_groups.actor)}
        assert of.teacher is not None
        if sim is not None and sim.is_padded:
            raise _core.ConfigError(
                f"[distillation] teacher is for bodies with the same joints, and those of {', '.join(sim.robots)} "
                f'differ; write [distillation.teachers] with "{OTHERS}" = "{of.teacher}"'
            )
        teacher = dict(read_manifest(Path(of.teacher).parent / "manifest.json")["policy"])
        for key in ("num_obs", "num_actions", "clip_actions"):
            teacher.pop(key, None)
        return {**cfg, "student": self.actor.model_cfg(sim), "teacher": teacher}


def _native_network(network: CriticConfig, sim: _core.VecSim | None, groups: Sequence[str]) -> dict[str, Any]:
    """The network for the native learner, which sees these observation groups side by side."""
    native: dict[str, Any] = {key: getattr(network, key) for key in ("hidden_dims", "activation", "obs_normalization")}
    if sim is None or (network.class_name == MLP and len(sim.observation_groups) == 1):
        network.model_cfg(sim, groups)
        return native
    seen = [column for group in groups for column in range(*sim.observation_groups[group])]
    if network.class_name == MLP:
        return {**native, "columns": seen}
    from polypod.networks.joints import joint_columns  # its package imports torch

    layout = layout_of([term for group in groups for term in terms_of(sim, group)])
    columns = joint_columns(layout, sim.canonical_joint_names)
    # torch divides in float32 too
    scales = (np.float32(1.0) / columns.magnitudes).tolist()

    def of_rows(places: Any) -> Any:
        return np.asarray(seen, np.int64)[places].tolist()

    joints = {
        "joint_dim": network.joint_dim,
        "num_heads": network.num_heads,
        "states": of_rows(columns.states),
        "scales": scales,
        "descriptions": of_rows(columns.descriptions),
        "general": of_rows(columns.general),
        "leg_heads": network.leg_heads,
        "legs": columns.legs.tolist(),
    }
    return {**native, "joints": joints}


def _masked(network: CriticConfig, sim: _core.VecSim | None, groups: Sequence[str]) -> dict[str, Any]:
    """The network for a batch of different bodies, whose robots may lack some actions."""
    model = network.model_cfg(sim, groups)
    # a network of joints reads off the observation which joints a robot has
    if sim is None or not sim.is_padded or model["class_name"] == URMA:
        return model
    if model["class_name"] != MLP:
        raise _core.ConfigError(
            f"{model['class_name']} learns bodies with the same joints, and those of {', '.join(sim.robots)} differ; "
            f'use class_name = "{MLP}" or "{URMA}"'
        )
    shares = [share for group in groups for share in sim.observation_shares(group)]
    masked = {**model, "class_name": MASKED_MLP, "shares": shares}
    if "distribution_cfg" in model:
        masked["distribution_cfg"] = {**model["distribution_cfg"], "class_name": MASKED_GAUSSIAN}
    return masked


def _computes_in_bfloat16(device_type: str) -> bool:
    """Whether bfloat16 is faster than float32 here, rather than emulated."""
    import torch

    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    supported = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return supported is not None and bool(supported())
