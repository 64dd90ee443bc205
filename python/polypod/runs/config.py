"""`configs/train/*.toml`: how they are read, merged and checked.

Their types: `polypod.runs.schema`.
"""

import contextlib
import dataclasses
import difflib
import json
import types
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, get_args, get_origin

from polypod import _core
from polypod.compat import tomllib
from polypod.files import read_bytes, real_path
from polypod.runs.engines import SAME_BITS
from polypod.runs.manifest import MAX_LAYER, Activation, check_size
from polypod.runs.schema import (
    ALTERNATE,
    ARITHMETICS,
    EQUALS,
    LEARNERS,
    LOSSES,
    MLP,
    OBSERVATION_GROUP,
    OTHERS,
    RNN,
    RNN_TYPES,
    UNKNOWN_JOINTS,
    URMA,
    ActorConfig,
    AlgorithmConfig,
    AnnealConfig,
    CriticConfig,
    DistillationConfig,
    ObsGroupsConfig,
    RndConfig,
    RunConfig,
    TrainConfig,
)

DEFAULT = "flat"
"""Name of the train config that trainings use by default."""
OVERRIDE = "train."
"""Prefix of a `--set` that changes the train config instead of the task."""
MAX_BYTES = 1 << 20
"""Largest size of a train config, bytes."""
MAX_EXTENDS = 100
"""Files that a train config may extend, directly or not."""


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

    `extends` is a name, a path relative to the file, or a list of them, of which the later ones
    win. A file may extend the one of the same name that it hides.

    Args:
        name: the name or the path.
        overrides: `key=value` pairs, the key dotted as in the file, the value in TOML syntax.

    Raises:
        ConfigError: for an unknown name, a file that cannot be read, TOML errors, unknown or
            missing keys, wrong types.
    """
    return changed(parse(_load_tables(name), name), overrides, name)


def layers(name: str) -> list[tuple[str, dict[str, Any]]]:
    """The files of a train config with what they say, the one that extends no other first.

    Raises ConfigError for a file that cannot be read.
    """
    found: dict[str, dict[str, Any]] = {}
    _add_layers(name, None, (), found)
    return list(found.items())


def changed(config: TrainConfig, overrides: Sequence[str], source: str) -> TrainConfig:
    """A config with overrides, as of `load`; `source` names it in errors. Raises ConfigError."""
    if not overrides:
        return config
    # TOML keeps infinities and NaN, which JSON lacks
    tables = tomllib.loads(_core.with_overrides(json.dumps(config.as_dict()), list(overrides)))
    return parse(tables, f"{source} with --set {OVERRIDE}{f' {OVERRIDE}'.join(overrides)}"[:200])


def with_run(config: TrainConfig, **values: Any) -> TrainConfig:
    """A config with other values in `[run]`; None leaves a value alone. Raises ConfigError."""
    given = {key: value for key, value in values.items() if value is not None}
    return parse({**config.as_dict(), "run": {**dataclasses.asdict(config.run), **given}}, "the command line")


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
    merged: dict[str, Any] = {}
    for file, tables in layers(name):
        merged = _merged(merged, tables, file)
    return merged


def _add_layers(name: str, folder: Path | None, above: tuple[str, ...], layers: dict[str, dict[str, Any]]) -> None:
    """Adds what a config extends, in order, then the config.

    A layer that is there already stays where it is.

    Args:
        name: of the config, or a path that ends in `.toml`.
        folder: where a relative path begins; None: the working directory.
        above: ids of the configs that lead here. A config may extend the one of its name that it
            hides, and not itself.
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
    return {"text": text, "id": str(real_path(path)), "folder": str(path.parent)}


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
    """Tables are merged; a table in the place of an array changes elements by their numbers.

    All else is replaced.
    """
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
            raise _core.ConfigError(f"{where}: unknown key {key!r}; did you mean {nearest!r}? (see polypod schema)")
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
    elif get_origin(expected) is dict:
        _, item = get_args(expected)
        if isinstance(value, dict):
            return {key: _checked(element, item, f"{where}.{key}") for key, element in value.items()}
    elif isinstance(expected, types.UnionType):
        for some in get_args(expected):
            with contextlib.suppress(_core.ConfigError):
                return _checked(value, some, where)
    elif expected is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    elif type(value) is expected:
        return value
    raise _core.ConfigError(f"{where} = {value!r} must be of type {_named(expected)}")


def _named(expected: Any) -> str:
    """A type in words.

    A value that may be left out is of the types that it has where it is given.
    """
    if isinstance(expected, types.UnionType):
        return " or ".join(_named(some) for some in get_args(expected) if some is not type(None))
    return str(getattr(expected, "__name__", expected))


_OF_MOTIONS = ("motions.rewards.", "motions.terminations.", "motions.reset.", "motions.sampling.")
CHANGEABLE = ("commands.", "events.", "rewards.", "env_shares.", *_OF_MOTIONS)
"""Prefixes of keys in `[run] task_changes`: a policy of the changed task is one of the task."""
MAX_ACTION = 1e6
"""Largest limit of actions."""
MAX_RNN = 4096
"""Width of a recurrent layer."""
MAX_RNN_LAYERS = 8
MAX_SAMPLES = 50_000_000
"""Env-steps of an iteration, some 100 numbers each."""
_POSITIVE = (
    ("run", "num_envs", 1, 2**24),
    ("run", "num_steps_per_env", 1, 100_000),
    ("run", "save_interval", 1, 2**31),
    ("algorithm", "num_learning_epochs", 1, 1000),
    ("algorithm", "num_mini_batches", 1, 2**24),
    ("algorithm", "learning_rate", 1e-12, 1.0),
    ("algorithm", "desired_kl", 1e-12, 100.0),
    ("anneal", "desired_kl", 1e-12, 100.0),
    ("algorithm", "clip_param", 1e-6, 10.0),
    ("algorithm", "max_grad_norm", 1e-12, 1e6),
    ("actor", "init_std", 1e-6, 100.0),
)
"""Section, key, least and greatest value of numbers that are greater than 0."""
_RANGES: tuple[tuple[str, str, float, float], ...] = (
    ("run", "max_iterations", 0, 2**31),
    ("algorithm", "gamma", 0.0, 1.0),
    ("algorithm", "lam", 0.0, 1.0),
    ("algorithm", "value_loss_coef", 0.0, 1e6),
    ("algorithm", "entropy_coef", 0.0, 1e3),
    ("algorithm", "critic_warmup_iterations", 0, 2**31),
    ("algorithm", "mirror_loss_coef", 0.0, 1e6),
    ("anneal", "start", 0.0, 1.0),
    ("anneal", "entropy_coef", 0.0, 1e3),
)
"""Section, key, least and greatest value of the other numbers."""
NUMBERS = (*_POSITIVE, *_RANGES)
"""Section, key, least and greatest value of all numbers with bounds."""
_CHOICES: tuple[tuple[str, str, tuple[Any, ...]], ...] = (
    ("algorithm", "schedule", ("adaptive", "fixed")),
    ("algorithm", "mixed_precision", ("off", "on", "auto")),
    ("run", "learner", LEARNERS),
    ("run", "arithmetic", ARITHMETICS),
    ("run", "symmetry", (False, True, ALTERNATE)),
)
"""Section, key and the values that it may have."""
CHOICES: dict[str, tuple[Any, ...]] = {
    **{key: allowed for _, key, allowed in _CHOICES},
    "activation": get_args(Activation),
    "class_name": (MLP, RNN, URMA),
    "loss_type": LOSSES,
    "weights": EQUALS,
    "unknown_joints": UNKNOWN_JOINTS,
    "rnn_type": RNN_TYPES,
}
"""Values of the keys of all sections that have one of a few."""


def _check_ranges(config: TrainConfig, source: str) -> None:
    run, algorithm = config.run, config.algorithm
    sections = config.as_dict()
    for section, key, least, most in _RANGES:
        if section not in sections:
            continue
        value = sections[section][key]
        if not least <= value <= most:
            raise _core.ConfigError(f"{source}: [{section}] {key} = {value} must be from {least:g} to {most:g}")
    for section, key, least, most in _POSITIVE:
        if section not in sections:
            continue
        value = sections[section][key]
        if not value > 0:
            raise _core.ConfigError(f"{source}: [{section}] {key} = {value} must be greater than 0")
        if not value >= least:
            raise _core.ConfigError(f"{source}: [{section}] {key} = {value} must be at least {least:g}")
        if not value <= most:
            raise _core.ConfigError(f"{source}: [{section}] {key} = {value} must be at most {most:g}")
    if run.clip_actions is not None and not 0.0 < run.clip_actions <= MAX_ACTION:
        raise _core.ConfigError(
            f"{source}: [run] clip_actions = {run.clip_actions} must be above 0 and at most {MAX_ACTION:g}; leave it "
            "out for actions without limits"
        )
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
    for change in run.task_changes:
        if not change.startswith(CHANGEABLE) and change not in SAME_BITS:
            raise _core.ConfigError(
                f"{source}: [run] task_changes: {change[:100]!r} would change what the policy sees or moves; "
                f"begin with {', '.join(CHANGEABLE)}, or name another task"
            )
    if run.arithmetic == "native" and algorithm.mixed_precision == "on":
        raise _core.ConfigError(
            f'{source}: [run] arithmetic = "native" computes in single precision, and [algorithm] mixed_precision = '
            '"on" asks for bfloat16; set it to "off"'
        )
    if run.normalize_advantage_per_robot and algorithm.normalize_advantage_per_mini_batch:
        raise _core.ConfigError(
            f"{source}: [run] normalize_advantage_per_robot and [algorithm] normalize_advantage_per_mini_batch exclude "
            "each other; set one of them to false"
        )
    if algorithm.mirror_loss_coef and not run.symmetry:
        raise _core.ConfigError(
            f"{source}: [algorithm] mirror_loss_coef = {algorithm.mirror_loss_coef} needs mirror images, and [run] "
            f'symmetry is false; set symmetry to true or "{ALTERNATE}", or leave mirror_loss_coef out'
        )
    for section, network in (("actor", config.actor), ("critic", config.critic)):
        _check_network(network, f"{source}: [{section}]")
    _check_groups(config, source)
    _check_extensions(config, source)
    for section, key, allowed in _CHOICES:
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
    if network.leg_heads is not None and network.class_name != URMA:
        raise _core.ConfigError(
            f'{where} leg_heads is of networks of joints; leave it out or set class_name = "{URMA}"'
        )
    if network.leg_heads is not None and not 1 <= network.leg_heads <= (network.num_heads or 0):
        raise _core.ConfigError(f"{where} leg_heads = {network.leg_heads} must be from 1 to num_heads")
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


def _check_extensions(config: TrainConfig, source: str) -> None:
    """Checks `[rnd]` and `[distillation]`."""
    recurrent = [name for name in ("actor", "critic") if getattr(config, name).class_name == RNN]
    if recurrent and config.run.symmetry:
        raise _core.ConfigError(
            f"{source}: [{recurrent[0]}] is recurrent, and rsl_rl mirrors no sequences; set symmetry = false in [run]"
        )
    if (rnd := config.rnd) is not None:
        check_size([*rnd.predictor_hidden_dims, rnd.num_outputs], f"{source}: [rnd] predictor_hidden_dims")
        check_size([*rnd.target_hidden_dims, rnd.num_outputs], f"{source}: [rnd] target_hidden_dims")
        sizes = [*rnd.predictor_hidden_dims, *rnd.target_hidden_dims, rnd.num_outputs]
        for key, most in (("weight", 1e6), ("learning_rate", 1.0)):
            if not 1e-12 <= (value := getattr(rnd, key)) <= most:
                raise _core.ConfigError(f"{source}: [rnd] {key} = {value} must be from 1e-12 to {most:g}")
        if not 1 <= min(sizes) <= MAX_LAYER:
            raise _core.ConfigError(f"{source}: [rnd] all sizes must be greater than 0")
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
        _check_teachers(distillation, f"{source}: [distillation]")
        if config.algorithm.critic_warmup_iterations:
            raise _core.ConfigError(
                f"{source}: [algorithm] critic_warmup_iterations and [distillation] exclude each other: a distillation "
                "has no critic; set it to 0"
            )


def _check_teachers(distillation: DistillationConfig, where: str) -> None:
    if (distillation.teacher is None) == (not distillation.teachers):
        raise _core.ConfigError(
            f"{where} needs either teacher, for bodies with the same joints, or [distillation.teachers], a checkpoint "
            f'by robot and "{OTHERS}" for all others'
        )
    if not 0.0 <= distillation.teacher_share <= 1.0:
        raise _core.ConfigError(f"{where} teacher_share = {distillation.teacher_share} must be from 0 to 1")
    defaults = DistillationConfig()
    for key in ("teacher_share", "weights", "unknown_joints", "final_learning_rate"):
        if distillation.teacher is not None and getattr(distillation, key) != getattr(defaults, key):
            raise _core.ConfigError(f"{where} {key} is of [distillation.teachers]; name the teacher there")
    rate = distillation.final_learning_rate
    if rate is not None and not 0.0 < rate <= 1.0:
        raise _core.ConfigError(f"{where} final_learning_rate = {rate} must be above 0 and at most 1")
    for key, allowed in (("weights", EQUALS), ("unknown_joints", UNKNOWN_JOINTS)):
        if (value := getattr(distillation, key)) not in allowed:
            raise _core.ConfigError(f"{where} {key} = {value!r} is not one of {', '.join(allowed)}")
    if not 1 <= distillation.teacher_iterations <= 2**31:
        raise _core.ConfigError(f"{where} teacher_iterations = {distillation.teacher_iterations} must be at least 1")
