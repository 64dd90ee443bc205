"""`configs/train/*.toml`: what is typed there, checked, and turned into rsl_rl's configuration."""

import contextlib
import dataclasses
import difflib
import json
import types
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_origin

from polypod import _core, bundled
from polypod.compat import tomllib
from polypod.files import read_bytes
from polypod.observation import check_memory, layout_of, terms_of
from polypod.training.manifest import MAX_LAYER, Activation, check_size
from polypod.training.manifest import read as read_manifest

DEFAULT = "flat"
"""Name of the train config that trainings use by default."""
OVERRIDE = "train."
"""What a `--set` begins with that changes the train config instead of the task."""
MAX_BYTES = 1 << 20
"""Of a train config."""
MAX_EXTENDS = 100
"""Files that a train config may extend, directly or not."""
OBSERVATION_GROUP = "policy"
"""Name of the observation group that actor and critic read."""

ALTERNATE = "alternate"
"""Symmetry that learns from each sample or its mirror image, in turn from epoch to epoch."""
LEARNERS = ("auto", "native", "rsl_rl")
RNN_TYPES = ("lstm", "gru")
LOSSES = ("mse", "huber")
NATIVE_ACTIVATIONS = ("elu", "relu", "tanh")

MLP = "MLPModel"
RNN = "RNNModel"
URMA = "polypod.networks:UrmaModel"
JOINT_GAUSSIAN = "polypod.networks:JointGaussian"
MASKED_MLP = "polypod.networks:MaskedMLPModel"
MASKED_GAUSSIAN = "polypod.networks:MaskedGaussian"
"""Class names as rsl_rl resolves them."""


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """`[run]`: how much to simulate."""

    task: str
    num_envs: int
    max_iterations: int
    num_steps_per_env: int
    save_interval: int
    normalize_reward_per_robot: bool
    normalize_advantage_per_robot: bool
    symmetry: bool | str
    learner: str = "rsl_rl"
    """What learns: native, rsl_rl, or auto. Runs from before there was a choice are rsl_rl's."""


@dataclasses.dataclass(frozen=True)
class AlgorithmConfig:
    """`[algorithm]`: PPO, in rsl_rl's words."""

    num_learning_epochs: int
    num_mini_batches: int
    learning_rate: float
    schedule: str
    desired_kl: float
    gamma: float
    lam: float
    clip_param: float
    use_clipped_value_loss: bool
    value_loss_coef: float
    entropy_coef: float
    max_grad_norm: float
    normalize_advantage_per_mini_batch: bool
    mixed_precision: str


@dataclasses.dataclass(frozen=True)
class AnnealConfig:
    """`[anneal]`: what the goals of PPO become towards the end of a run, for a policy that explores less and less.

    From the iteration `start * max_iterations` on, each goal moves linearly from its value in `[algorithm]` to the
    value here, which it has in the last iteration and after it.
    """

    start: float
    entropy_coef: float
    desired_kl: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class CriticConfig:
    """`[critic]`: a multi-layer perceptron, a recurrent network, or a network of joints."""

    class_name: str = MLP
    hidden_dims: list[int]
    activation: str
    obs_normalization: bool
    joint_dim: int | None = None
    num_heads: int | None = None
    rnn_type: str | None = None
    rnn_hidden_dim: int | None = None
    rnn_num_layers: int | None = None

    def model_cfg(self, sim: _core.VecSim | None) -> dict[str, Any]:
        """The network's constructor arguments, with the class names that rsl_rl resolves.

        Args:
            sim: whose observations and joints the network is for; a multi-layer perceptron does without.

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
        terms = terms_of(sim)
        check_memory(terms, f"{self.class_name} takes")
        layout = layout_of(terms)
        return {**network, "observation_layout": layout, "joint_names": sim.canonical_joint_names}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorConfig(CriticConfig):
    """`[actor]`: a network whose output is the mean of a Gaussian with a learned deviation."""

    init_std: float

    def model_cfg(self, sim: _core.VecSim | None) -> dict[str, Any]:
        """As of the critic, with the distribution."""
        network = super().model_cfg(sim)
        distribution = {"class_name": "GaussianDistribution", "init_std": network.pop("init_std")}
        if self.class_name == URMA:
            distribution["class_name"] = JOINT_GAUSSIAN
        return {**network, "distribution_cfg": distribution}


class Goals(NamedTuple):
    """What PPO aims at in an iteration."""

    entropy_coef: float
    desired_kl: float


@dataclasses.dataclass(frozen=True)
class ObsGroupsConfig:
    """`[obs_groups]`: which of the task's observation groups each network sees, side by side, in rsl_rl's words."""

    actor: list[str] = dataclasses.field(default_factory=lambda: [OBSERVATION_GROUP])
    critic: list[str] = dataclasses.field(default_factory=lambda: [OBSERVATION_GROUP])
    rnd_state: list[str] = dataclasses.field(default_factory=lambda: [OBSERVATION_GROUP])
    teacher: list[str] = dataclasses.field(default_factory=lambda: ["teacher"])


@dataclasses.dataclass(frozen=True, kw_only=True)
class RndConfig:
    """`[rnd]`: random network distillation, a reward for observations that are new, in rsl_rl's words."""

    weight: float
    num_outputs: int = 1
    predictor_hidden_dims: list[int] = dataclasses.field(default_factory=lambda: [64, 64])
    target_hidden_dims: list[int] = dataclasses.field(default_factory=lambda: [64, 64])
    activation: str = "elu"
    state_normalization: bool = True
    reward_normalization: bool = True
    learning_rate: float = 1e-3


@dataclasses.dataclass(frozen=True, kw_only=True)
class DistillationConfig:
    """`[distillation]`: `[actor]` learns to act as a teacher does, in place of PPO.

    Of `[algorithm]`, `num_learning_epochs`, `learning_rate` and `max_grad_norm` count.
    """

    teacher: str
    """A model_<n>.pt beside its manifest.json, or the name of a bundled policy."""
    gradient_length: int = 15
    """Control steps between two steps of the optimiser."""
    loss_type: str = "mse"


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

    def goals(self, iteration: int) -> Goals:
        """What PPO aims at in an iteration, counted from 0."""
        begin = Goals(self.algorithm.entropy_coef, self.algorithm.desired_kl)
        if self.anneal is None:
            return begin
        first = self.anneal.start * self.run.max_iterations
        share = min(max((iteration + 1 - first) / max(self.run.max_iterations - first, 1.0), 0.0), 1.0)
        return Goals(
            begin.entropy_coef + share * (self.anneal.entropy_coef - begin.entropy_coef),
            begin.desired_kl + share * (self.anneal.desired_kl - begin.desired_kl),
        )

    def with_run(self, **values: Any) -> "TrainConfig":
        """The config with other values in `[run]`; None leaves a value alone."""
        given = {key: value for key, value in values.items() if value is not None}
        return parse({**self.as_dict(), "run": {**dataclasses.asdict(self.run), **given}}, "the command line")

    def with_teacher_located(self) -> "TrainConfig":
        """The config with the absolute path of its teacher, so that a run goes on from any directory."""
        if self.distillation is None:
            return self
        teacher = str(bundled.resolve(Path(self.distillation.teacher)).resolve())
        return dataclasses.replace(self, distillation=dataclasses.replace(self.distillation, teacher=teacher))

    def with_mixed_precision_resolved(self, device_type: str) -> "TrainConfig":
        """The config with "auto" decided for this machine, so that a resumed run computes in the same way."""
        if self.algorithm.mixed_precision != "auto":
            return self
        mode = "on" if _computes_in_bfloat16(device_type) else "off"
        return dataclasses.replace(self, algorithm=dataclasses.replace(self.algorithm, mixed_precision=mode))

    def with_learner_resolved(self, learner: str | None, device_type: str) -> "TrainConfig":
        """The config with "auto" decided: the native learner for perceptrons on a CPU, else rsl_rl.

        Args:
            learner: what is to learn instead of what the config says; None: that.
            device_type: cpu or cuda.

        Raises:
            ConfigError: for an unknown learner, and for one that cannot learn what the config asks for.
        """
        config = self.with_run(learner=learner)
        why_not = config._why_not_native(device_type)
        if config.run.learner == "auto":
            config = config.with_run(learner="rsl_rl" if why_not else "native")
        if config.run.learner == "native" and why_not:
            raise _core.ConfigError(f"the native learner {why_not}; use --learner rsl_rl or auto")
        if config.run.learner == "rsl_rl" and config.run.symmetry == ALTERNATE:
            raise _core.ConfigError(
                f'[run] symmetry = "{ALTERNATE}" is of the native learner; use --learner native, or symmetry = true'
            )
        return config

    def _why_not_native(self, device_type: str) -> str | None:
        """What keeps the native learner from this config."""
        if device_type != "cpu":
            return f"runs on the CPU, not on {device_type}"
        if self.rnd is not None:
            return "has no random network distillation, and the train config has [rnd]"
        if self.distillation is not None:
            return "does not distil, and the train config has [distillation]"
        for name in ("actor", "critic"):
            if (groups := getattr(self.obs_groups, name)) != [OBSERVATION_GROUP]:
                return f"sees the observation group {OBSERVATION_GROUP}, and {name} sees {', '.join(groups)}"
        for section, network in (("actor", self.actor), ("critic", self.critic)):
            if network.class_name != MLP:
                return f"learns perceptrons, and [{section}] is a {network.class_name}"
            if network.activation not in NATIVE_ACTIVATIONS:
                return f"knows {', '.join(NATIVE_ACTIVATIONS)}, and [{section}] has activation {network.activation}"
        return None

    def native_options(self) -> dict[str, Any]:
        """What `polypod._core.Learner` reads."""
        run, algorithm = self.run, dataclasses.asdict(self.algorithm)
        for key in ("learning_rate", "mixed_precision"):
            del algorithm[key]
        if algorithm.pop("schedule") == "fixed":
            algorithm["desired_kl"] = None
        of_network = ("hidden_dims", "activation", "obs_normalization")
        return {
            "num_steps_per_env": run.num_steps_per_env,
            "actor": {key: getattr(self.actor, key) for key in of_network},
            "critic": {key: getattr(self.critic, key) for key in of_network},
            "algorithm": algorithm,
            "normalize_reward_per_robot": run.normalize_reward_per_robot,
            "normalize_advantage_per_robot": run.normalize_advantage_per_robot,
            "symmetry": run.symmetry if isinstance(run.symmetry, str) else "both" if run.symmetry else "none",
        }

    def rsl_rl_cfg(self, sim: _core.VecSim | None = None) -> dict[str, Any]:
        """The configuration that rsl_rl's runner reads; arguments and errors are those of `CriticConfig.model_cfg`."""
        algorithm = dataclasses.asdict(self.algorithm)
        algorithm["use_mixed_precision"] = algorithm.pop("mixed_precision") == "on"
        if self.distillation is not None:
            return self._distillation_cfg(algorithm, sim)
        groups = dataclasses.asdict(self.obs_groups)
        del groups["teacher"]
        if self.rnd is None:
            del groups["rnd_state"]
        else:
            algorithm["rnd_cfg"] = dataclasses.asdict(self.rnd)
        return {
            "num_steps_per_env": self.run.num_steps_per_env,
            "save_interval": self.run.save_interval,
            "max_iterations": self.run.max_iterations,
            "normalize_reward_per_robot": self.run.normalize_reward_per_robot,
            "normalize_advantage_per_robot": self.run.normalize_advantage_per_robot,
            "symmetry": self.run.symmetry,
            "obs_groups": groups,
            "algorithm": {"class_name": "PPO", **algorithm},
            "actor": _masked(self.actor.model_cfg(sim), sim, self.obs_groups.actor),
            "critic": _masked(self.critic.model_cfg(sim), sim, self.obs_groups.critic),
            "check_for_nan": True,
        }

    def _distillation_cfg(self, algorithm: dict[str, Any], sim: _core.VecSim | None) -> dict[str, Any]:
        assert self.distillation is not None
        if sim is not None and not sim.action_mask.all():
            raise _core.ConfigError(
                f"[distillation] is for bodies with the same joints, and those of {', '.join(sim.robots)} differ; "
                "distil for robots of one kind"
            )
        teacher = dict(read_manifest(Path(self.distillation.teacher).parent / "manifest.json")["policy"])
        for key in ("num_obs", "num_actions"):
            del teacher[key]
        own = ("num_learning_epochs", "learning_rate", "max_grad_norm", "use_mixed_precision")
        return {
            "num_steps_per_env": self.run.num_steps_per_env,
            "save_interval": self.run.save_interval,
            "max_iterations": self.run.max_iterations,
            "normalize_reward_per_robot": False,
            "normalize_advantage_per_robot": False,
            "symmetry": False,
            "obs_groups": {"student": self.obs_groups.actor, "teacher": self.obs_groups.teacher},
            "algorithm": {
                "class_name": "Distillation",
                **{key: algorithm[key] for key in own},
                "gradient_length": self.distillation.gradient_length,
                "loss_type": self.distillation.loss_type,
            },
            "student": self.actor.model_cfg(sim),
            "teacher": teacher,
            "check_for_nan": True,
        }


def _masked(model: dict[str, Any], sim: _core.VecSim | None, groups: Sequence[str]) -> dict[str, Any]:
    """The network as a batch of different bodies needs it, where some of its robots lack some of the actions."""
    # a network of joints reads off the observation which joints a robot has
    if sim is None or sim.action_mask.all() or model["class_name"] == URMA:
        return model
    if model["class_name"] != MLP:
        raise _core.ConfigError(
            f"{model['class_name']} learns bodies with the same joints, and those of {', '.join(sim.robots)} differ; "
            f'use class_name = "{MLP}" or "{URMA}"'
        )
    joint_of_number: list[int] = []
    for term in (term for group in groups for term in terms_of(sim, group)):
        per_joint = term.kind == "per_joint"
        joint_of_number += [index % sim.num_actions if per_joint else -1 for index in range(term.size)]
    masked = {**model, "class_name": MASKED_MLP, "joint_of_number": joint_of_number}
    if "distribution_cfg" in model:
        masked["distribution_cfg"] = {**model["distribution_cfg"], "class_name": MASKED_GAUSSIAN}
    return masked


def split_overrides(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """The overrides of the task, and those of the train config without their `train.`."""
    of_training = [text.removeprefix(OVERRIDE) for text in overrides if text.startswith(OVERRIDE)]
    return [text for text in overrides if not text.startswith(OVERRIDE)], of_training


SECTIONS: dict[str, Any] = {
    "run": RunConfig,
    "algorithm": AlgorithmConfig,
    "actor": ActorConfig,
    "critic": CriticConfig,
    "anneal": AnnealConfig,
    "obs_groups": ObsGroupsConfig,
    "rnd": RndConfig,
    "distillation": DistillationConfig,
}
"""Tables of a train config and what is read of each."""
OPTIONAL_SECTIONS = ("anneal", "obs_groups", "rnd", "distillation")


def load(name: str, overrides: Sequence[str] = ()) -> TrainConfig:
    """Reads a train config by its name or, when `name` ends in `.toml`, from that file.

    `extends` is a name, a path relative to the file, or a list of them, of which the later ones win. A file may extend
    the one of the same name that it hides.

    Args:
        name: the name or the path.
        overrides: `key=value` pairs, the key dotted as in the file, the value in TOML syntax.

    Raises:
        ConfigError: for an unknown name, a file that cannot be read, TOML errors, unknown or missing keys, wrong types.
    """
    config = parse(_load_tables(name), name)
    if not overrides:
        return config
    tables = json.loads(_core.with_overrides(json.dumps(config.as_dict()), list(overrides)))
    return parse(tables, f"{name} with --set {OVERRIDE}{f' {OVERRIDE}'.join(overrides)}"[:200])


def parse(tables: dict[str, Any], source: str) -> TrainConfig:
    """Checks `tables` and builds the config; `source` names them in errors. Raises ConfigError."""
    _check_keys(tables, dict.fromkeys(SECTIONS), f"{source}: top level", OPTIONAL_SECTIONS)
    config = TrainConfig(
        **{
            key: _parse_section(type_, tables[key], f"{source}: [{key}]")
            for key, type_ in SECTIONS.items()
            if key in tables
        }
    )
    _check_ranges(config, source)
    return config


def _load_tables(name: str) -> dict[str, Any]:
    """The tables of a config on top of those that it extends, by the rules of tasks and robots."""
    layers: dict[str, dict[str, Any]] = {}
    _add_layers(name, None, (), layers)
    merged: dict[str, Any] = {}
    for name, tables in layers.items():
        merged = _merged(merged, tables, name)
    return merged


def _add_layers(name: str, folder: Path | None, above: tuple[str, ...], layers: dict[str, dict[str, Any]]) -> None:
    """Adds what a config extends, in order, then the config. A layer that is there already stays where it is.

    Args:
        name: of the config, or a path that ends in `.toml`.
        folder: where a relative path begins; None: the working directory.
        above: ids of the configs that lead here. A config may extend the one of its name that it hides, and not itself.
        layers: tables by the ids of their configs.
    """
    if len(above) > MAX_EXTENDS or len(layers) > MAX_EXTENDS:
        raise _core.ConfigError(f"train config {name} is the {MAX_EXTENDS}th of a chain of extends; shorten it")
    path = (folder or Path()) / name if name.endswith(".toml") else None
    file = _read_path(name, path) if path else _core.train_config(name, above)
    if file["id"] in above:
        raise _core.ConfigError(f"train config {name!r} extends itself ({' -> '.join((*above, file['id']))})")
    if file["id"] in layers:
        return
    tables = _read_tables(name, file["text"])
    inner = None if file["folder"] is None else Path(file["folder"])
    for base in _bases(tables.pop("extends", []), name):
        _add_layers(base, inner, (*above, file["id"]), layers)
    layers[file["id"]] = tables


def _read_path(name: str, path: Path) -> "_core.TrainFile":
    try:
        text = read_bytes(path, MAX_BYTES).decode()
    except OSError as error:
        raise _core.ConfigError(f"cannot read train config {name[:80]}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise _core.ConfigError(f"train config {name} is no text in UTF-8: {error}; save it as UTF-8") from error
    return {"text": text, "id": str(path.resolve()), "folder": str(path.parent)}


def _read_tables(name: str, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise _core.ConfigError(f"train config {name} is not valid TOML: {error}") from error


def _bases(extends: Any, name: str) -> list[str]:
    bases = extends if isinstance(extends, list) else [extends]
    for base in bases:
        if not isinstance(base, str):
            raise _core.ConfigError(
                f"train config {name}: extends = {base!r} is no name; write a string in quotes, or a list of strings"
            )
    return bases


def _merged(base: dict[str, Any], over: dict[str, Any], name: str) -> dict[str, Any]:
    """Tables are merged; a table in the place of an array changes elements by their numbers; all else is replaced."""
    merged = dict(base)
    for key, value in over.items():
        inner = merged.get(key)
        if isinstance(inner, dict) and isinstance(value, dict):
            merged[key] = _merged(inner, value, name)
        elif isinstance(inner, list) and isinstance(value, dict):
            elements = {str(index): element for index, element in enumerate(inner)}
            if unknown := [place for place in value if place not in elements]:
                raise _core.ConfigError(
                    f"train config {name}: {key}.{unknown[0]}: there is no such element; {key} has {len(inner)}"
                )
            merged[key] = list({**elements, **value}.values())
        else:
            merged[key] = value
    return merged


def _parse_section(type_: Any, table: Any, where: str) -> Any:
    if not isinstance(table, dict):
        raise _core.ConfigError(f"{where} must be a table")
    expected = {field.name: field.type for field in dataclasses.fields(type_)}
    optional = {
        field.name
        for field in dataclasses.fields(type_)
        if field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
    }
    _check_keys(table, expected, where, optional)
    return type_(**{key: _checked(value, expected[key], f"{where} {key}") for key, value in table.items()})


def _check_keys(table: dict[str, Any], expected: dict[str, Any], where: str, optional: Collection[str] = ()) -> None:
    for key in table:
        if key not in expected:
            nearest = difflib.get_close_matches(key, expected, n=1, cutoff=0.0)[0]
            raise _core.ConfigError(f"{where}: unknown key {key!r}; did you mean {nearest!r}?")
    missing = [key for key in expected if key not in table and key not in optional]
    if missing:
        raise _core.ConfigError(
            f'{where}: {", ".join(missing)} missing; set it, or start the file with extends = "flat"'
        )


def _checked(value: Any, expected: Any, where: str) -> Any:
    if get_origin(expected) is list:
        (item,) = get_args(expected)
        if isinstance(value, list):
            return [_checked(element, item, f"{where}[{i}]") for i, element in enumerate(value)]
    elif isinstance(expected, types.UnionType):
        for some in get_args(expected):
            with contextlib.suppress(_core.ConfigError):
                return _checked(value, some, where)
    elif expected is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    elif type(value) is expected:
        return value
    raise _core.ConfigError(f"{where} = {value!r} must be of type {getattr(expected, '__name__', expected)}")


MAX_RNN = 4096
"""Width of a recurrent layer."""
MAX_RNN_LAYERS = 8
MAX_SAMPLES = 50_000_000
"""Env-steps of an iteration, some 100 numbers each."""
_POSITIVE = (
    ("run", "num_envs", 2**24),
    ("run", "num_steps_per_env", 100_000),
    ("run", "save_interval", 2**31),
    ("algorithm", "num_learning_epochs", 1000),
    ("algorithm", "num_mini_batches", 2**24),
    ("algorithm", "learning_rate", 1.0),
    ("algorithm", "desired_kl", 100.0),
    ("anneal", "desired_kl", 100.0),
    ("algorithm", "clip_param", 10.0),
    ("algorithm", "max_grad_norm", 1e6),
    ("actor", "init_std", 100.0),
)
"""Section, key and greatest value of numbers that are greater than 0."""
_RANGES: tuple[tuple[str, str, float, float], ...] = (
    ("run", "max_iterations", 0, 2**31),
    ("algorithm", "gamma", 0.0, 1.0),
    ("algorithm", "lam", 0.0, 1.0),
    ("algorithm", "value_loss_coef", 0.0, 1e6),
    ("algorithm", "entropy_coef", 0.0, 1e3),
    ("anneal", "start", 0.0, 1.0),
    ("anneal", "entropy_coef", 0.0, 1e3),
)
"""Section, key, least and greatest value of the other numbers."""


def _check_ranges(config: TrainConfig, source: str) -> None:
    run, algorithm = config.run, config.algorithm
    sections = config.as_dict()
    for section, key, least, most in _RANGES:
        if section not in sections:
            continue
        value = sections[section][key]
        if not least <= value <= most:
            raise _core.ConfigError(f"{source}: [{section}] {key} = {value} must be from {least:g} to {most:g}")
    for section, key, most in _POSITIVE:
        if section not in sections:
            continue
        value = sections[section][key]
        if not value > 0:
            raise _core.ConfigError(f"{source}: [{section}] {key} = {value} must be greater than 0")
        if not value <= most:
            raise _core.ConfigError(f"{source}: [{section}] {key} = {value} must be at most {most:g}")
    if run.num_envs * run.num_steps_per_env > MAX_SAMPLES:
        raise _core.ConfigError(
            f"{source}: {run.num_envs} envs x {run.num_steps_per_env} steps are more than {MAX_SAMPLES:,} samples an "
            "iteration; lower num_envs or num_steps_per_env"
        )
    if run.num_envs * run.num_steps_per_env < algorithm.num_mini_batches:
        raise _core.ConfigError(
            f"{source}: {run.num_envs} envs x {run.num_steps_per_env} steps do not fill "
            f"{algorithm.num_mini_batches} mini-batches; raise num_envs"
        )
    if run.normalize_advantage_per_robot and algorithm.normalize_advantage_per_mini_batch:
        raise _core.ConfigError(
            f"{source}: [run] normalize_advantage_per_robot and [algorithm] normalize_advantage_per_mini_batch exclude "
            "each other; set one of them to false"
        )
    for section, network in (("actor", config.actor), ("critic", config.critic)):
        _check_network(network, f"{source}: [{section}]")
    _check_groups(config, source)
    _check_extensions(config, source)
    choices: tuple[tuple[str, str, tuple[Any, ...]], ...] = (
        ("algorithm", "schedule", ("adaptive", "fixed")),
        ("algorithm", "mixed_precision", ("off", "on", "auto")),
        ("run", "learner", LEARNERS),
        ("run", "symmetry", (False, True, ALTERNATE)),
    )
    for section, key, allowed in choices:
        value = getattr(getattr(config, section), key)
        if value not in allowed:
            names = ", ".join(str(name).lower() if isinstance(name, bool) else name for name in allowed)
            raise _core.ConfigError(f"{source}: [{section}] {key} = {value!r} is not one of {names}")


def _check_network(network: CriticConfig, where: str) -> None:
    if network.class_name not in (MLP, RNN, URMA):
        raise _core.ConfigError(f"{where} class_name = {network.class_name!r} is not one of {MLP}, {RNN}, {URMA}")
    if not network.hidden_dims or min(network.hidden_dims) < 1:
        raise _core.ConfigError(f"{where} hidden_dims = {network.hidden_dims} must hold sizes of at least 1")
    if max(network.hidden_dims) > MAX_LAYER:
        raise _core.ConfigError(f"{where} hidden_dims = {network.hidden_dims} must hold sizes of at most {MAX_LAYER}")
    check_size(network.hidden_dims, f"{where} hidden_dims")
    if network.activation not in get_args(Activation):
        raise _core.ConfigError(
            f"{where} activation = {network.activation!r} is not one of {', '.join(get_args(Activation))}"
        )
    check_size([network.joint_dim or 1, network.num_heads or 1], f"{where} joint_dim and num_heads")
    for key in ("joint_dim", "num_heads"):
        size = getattr(network, key)
        if network.class_name != URMA and size is not None:
            raise _core.ConfigError(
                f'{where} {key} is of networks of joints; leave it out or set class_name = "{URMA}"'
            )
        if network.class_name == URMA and (size is None or size < 1):
            raise _core.ConfigError(
                f"{where} {key} = {size} must be at least 1 for {URMA}; configs/train has an example"
            )

    for key in ("rnn_type", "rnn_hidden_dim", "rnn_num_layers"):
        value = getattr(network, key)
        if network.class_name != RNN and value is not None:
            raise _core.ConfigError(f'{where} {key} is of recurrent networks; leave it out or set class_name = "{RNN}"')
        if network.class_name == RNN and value is None:
            raise _core.ConfigError(
                f'{where} {key} is missing, which {RNN} needs; write rnn_type = "gru", rnn_hidden_dim = 256, '
                "rnn_num_layers = 1"
            )
    if network.class_name == RNN:
        if network.rnn_type not in RNN_TYPES:
            raise _core.ConfigError(f"{where} rnn_type = {network.rnn_type!r} is not one of {', '.join(RNN_TYPES)}")
        width, layers = network.rnn_hidden_dim or 0, network.rnn_num_layers or 0
        if not 1 <= width <= MAX_RNN or not 1 <= layers <= MAX_RNN_LAYERS:
            raise _core.ConfigError(
                f"{where} rnn_hidden_dim = {width} must be from 1 to {MAX_RNN}, rnn_num_layers = {layers} from 1 to "
                f"{MAX_RNN_LAYERS}"
            )


def _check_groups(config: TrainConfig, source: str) -> None:
    for field in dataclasses.fields(config.obs_groups):
        groups = getattr(config.obs_groups, field.name)
        if not groups or len(set(groups)) != len(groups):
            raise _core.ConfigError(f"{source}: [obs_groups] {field.name} = {groups} must name groups, each once")
    if config.obs_groups.actor != [OBSERVATION_GROUP]:
        raise _core.ConfigError(
            f"{source}: [obs_groups] actor = {config.obs_groups.actor}: a policy sees the group {OBSERVATION_GROUP} "
            "alone, since that is what a robot gives it; add the terms to that group"
        )
    for section, network in (("actor", config.actor), ("critic", config.critic)):
        if network.class_name == URMA and getattr(config.obs_groups, section) != [OBSERVATION_GROUP]:
            raise _core.ConfigError(
                f"{source}: [{section}] {URMA} sees the group {OBSERVATION_GROUP} alone; use {MLP} for other groups"
            )


def _check_extensions(config: TrainConfig, source: str) -> None:
    """What `[rnd]` and `[distillation]` may say."""
    recurrent = [name for name in ("actor", "critic") if getattr(config, name).class_name == RNN]
    if recurrent and config.run.symmetry:
        raise _core.ConfigError(
            f"{source}: [{recurrent[0]}] is recurrent, and rsl_rl mirrors no sequences; set symmetry = false in [run]"
        )
    if (rnd := config.rnd) is not None:
        check_size([*rnd.predictor_hidden_dims, rnd.num_outputs], f"{source}: [rnd] predictor_hidden_dims")
        check_size([*rnd.target_hidden_dims, rnd.num_outputs], f"{source}: [rnd] target_hidden_dims")
        sizes = [*rnd.predictor_hidden_dims, *rnd.target_hidden_dims, rnd.num_outputs]
        if not 0.0 < rnd.weight <= 1e6 or not 0.0 < rnd.learning_rate <= 1.0 or not 1 <= min(sizes) <= MAX_LAYER:
            raise _core.ConfigError(f"{source}: [rnd] weight, learning_rate and all sizes must be greater than 0")
        if rnd.activation not in get_args(Activation):
            raise _core.ConfigError(
                f"{source}: [rnd] activation = {rnd.activation!r} is not one of {', '.join(get_args(Activation))}"
            )
        if config.distillation is not None:
            raise _core.ConfigError(f"{source}: [rnd] and [distillation] exclude each other; leave one of them out")
    if (distillation := config.distillation) is not None:
        if distillation.loss_type not in LOSSES:
            raise _core.ConfigError(
                f"{source}: [distillation] loss_type = {distillation.loss_type!r} is not one of {', '.join(LOSSES)}"
            )
        if not 1 <= distillation.gradient_length <= config.run.num_steps_per_env:
            raise _core.ConfigError(
                f"{source}: [distillation] gradient_length = {distillation.gradient_length} must be from 1 to "
                f"num_steps_per_env = {config.run.num_steps_per_env}"
            )


def _computes_in_bfloat16(device_type: str) -> bool:
    """Whether bfloat16 is faster than float32 here, rather than emulated."""
    import torch

    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    supported = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return supported is not None and bool(supported())
