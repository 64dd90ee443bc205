"""Reader of manifests, with the schema that they must follow. Nothing in a manifest names code.

A class is one of a list, a number has a range, a size is checked before anything is allocated by
it. Other parts of a manifest are left out.
"""

import itertools
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta
from typing_extensions import NotRequired, TypedDict

from polypod import _core
from polypod.files import read_bytes
from polypod.runs import engines

MAX_LAYER = 65536
Size = Annotated[int, Meta(ge=1, le=MAX_LAYER)]
"""Size of a layer, an observation or a batch of actions."""
Name = Annotated[str, Meta(min_length=1, max_length=4096)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Activation = Literal[
    "elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish", "identity"
]
"""Names of rsl_rl's activations."""
MAX_BYTES = 64 << 20
"""Largest size of a manifest, bytes."""
MAX_WEIGHTS = 100_000_000
"""Largest number of weights of a network: 400 MB in float32."""
MAX_SEED = 2**64 - 1
MAX_ENVS = 2**31 - 1
"""Largest number of envs of a simulation."""


class TermSize(TypedDict):
    """A term of the observation."""

    term: Name
    size: Size


class BlockManifest(TypedDict):
    """Consecutive numbers of a term that describes the body, see `polypod.observation.Block`."""

    per: Name
    count: Size


class TermManifest(TypedDict):
    """Layout of a term for a network of joints, see `polypod.observation.layout_of`."""

    term: Name
    size: Size
    history_length: NotRequired[Size]
    kind: Name
    magnitude: Annotated[float, Meta(gt=0.0, le=1e9)]
    source: NotRequired[Name]
    blocks: Annotated[list[BlockManifest], Meta(max_length=1024)]


class DistributionManifest(TypedDict):
    """Distribution of actions around the network's output."""

    class_name: Literal["GaussianDistribution", "polypod.networks:JointGaussian"]
    init_std: Annotated[float, Meta(gt=0.0, le=1e3)]


class PolicyManifest(TypedDict):
    """The actor: its class, sizes and further constructor arguments."""

    num_obs: Size
    num_actions: Size
    class_name: Literal["MLPModel", "RNNModel", "polypod.networks:UrmaModel"]
    hidden_dims: Annotated[list[Size], Meta(min_length=1, max_length=64)]
    activation: Activation
    obs_normalization: bool
    distribution_cfg: DistributionManifest
    rnn_type: NotRequired[Literal["lstm", "gru"]]
    rnn_hidden_dim: NotRequired[Annotated[int, Meta(ge=1, le=4096)]]
    rnn_num_layers: NotRequired[Annotated[int, Meta(ge=1, le=8)]]
    joint_dim: NotRequired[Size]
    num_heads: NotRequired[Size]
    leg_heads: NotRequired[Size]
    observation_layout: NotRequired[list[TermManifest | tuple[Name, Size]]]
    """Manifests of earlier versions hold names and sizes alone."""
    joint_names: NotRequired[list[Name]]
    clip_actions: NotRequired[Annotated[float, Meta(gt=0.0, le=1e6)]]
    """Greatest magnitude of the actions, which the network clips."""


class BodyManifest(TypedDict):
    """The description of a training body, see `polypod.descriptions.to_manifest`."""

    name: Name
    joints: Annotated[list[Name], Meta(min_length=1, max_length=1024)]
    numbers: Annotated[str, Meta(max_length=1 << 20)]


class TermsManifest(TypedDict):
    """The Python file of terms of a run: a copy lies in `params/`, and nothing runs it."""

    file: Name
    sha256: Sha256


class Manifest(TypedDict):
    """`manifest.json` of a run."""

    format: Literal[1]
    command: NotRequired[str]
    task: Name
    experiment: NotRequired[str]
    robot_sources: Annotated[list[Name], Meta(min_length=1)]
    overrides: list[str]
    seed: Annotated[int, Meta(ge=0)]
    num_envs: NotRequired[Annotated[int, Meta(ge=1)]]
    step_dt: Annotated[float, Meta(gt=0.0, le=10.0)]
    config_hash: NotRequired[str]
    canonical_joint_names: list[Name]
    slots: NotRequired[Annotated[list[Name], Meta(max_length=65536)]]
    """Names of actions that the policy has on top of those of the run's robots."""
    observation_layout: Annotated[list[TermSize], Meta(min_length=1)]
    policy: PolicyManifest
    robots: Annotated[list[Name], Meta(min_length=1)]
    robot_info: NotRequired[dict[str, dict[str, Any]]]
    joint_maps: NotRequired[dict[str, list[dict[str, Any]]]]
    train_config: dict[str, dict[str, Any]]
    terms: NotRequired[TermsManifest]
    motions: NotRequired[dict[str, Any]]
    """Options of a task that tracks motions, see `polypod.motions.options`."""
    trained_bodies: NotRequired[Annotated[list[BodyManifest], Meta(max_length=65536)]]
    """Bodies of policies that read descriptions of joints."""
    versions: NotRequired[dict[str, str]]
    git: NotRequired[dict[str, Any] | None]
    checkpoints: NotRequired[dict[str, Sha256]]
    """Checksum of each checkpoint."""


class OnnxManifest(TypedDict):
    """Metadata of an ONNX policy, as JSON."""

    format: Literal[1]
    task: Name
    robot_sources: Annotated[list[Name], Meta(min_length=1)]
    robots: Annotated[list[Name], Meta(min_length=1)]
    overrides: list[str]
    step_dt: Annotated[float, Meta(gt=0.0, le=10.0)]
    canonical_joint_names: Annotated[list[Name], Meta(min_length=1)]
    observation_layout: Annotated[list[TermSize], Meta(min_length=1)]


ONNX_KEYS = tuple(key for key in OnnxManifest.__annotations__ if key != "format")
"""Keys that it shares with `Manifest`."""


class ExportManifest(TypedDict):
    """`policy.json` of an export or of a folded graph: the parts that Python reads."""

    format: Literal[1]
    files: dict[str, Sha256]
    """Checksums of the graphs that it describes."""


def read(path: Path, *, as_begun: bool = False) -> dict[str, Any]:
    """Reads a manifest and checks everything that is used of it.

    Args:
        path: of the manifest.
        as_begun: leave the task on the card that the run asked for. Otherwise it is on the CPU,
            which has the same bits, so that a policy can be used on machines without a card.

    Raises:
        ConfigError: when it is missing or broken; the message names the element.
    """
    manifest: Manifest = _decode(path, Manifest, "the training's run")
    policy = manifest["policy"]
    for key, most in (("seed", MAX_SEED), ("num_envs", MAX_ENVS)):
        if manifest.get(key, 0) > most:  # type: ignore[operator]
            raise _core.ConfigError(f"{path}: {key} is more than {most}; copy it again from the training's run")
    _check_layout(manifest, path)
    check_size([policy["num_obs"], *policy["hidden_dims"], policy["num_actions"]], f"{path}: policy")
    if policy["class_name"] == "polypod.networks:UrmaModel":
        _check_joints(policy, path)
    return dict(manifest) if as_begun else _on_the_cpu(dict(manifest))


def read_onnx(text: str, where: str) -> dict[str, Any]:
    """Reads the metadata of an ONNX policy, with its task on the CPU.

    Raises ConfigError, which begins with `where`.
    """
    manifest: OnnxManifest = _parse(text.encode(), OnnxManifest, where, "the learner's export")
    return _on_the_cpu(dict(manifest))


def _on_the_cpu(manifest: dict[str, Any]) -> dict[str, Any]:
    """A manifest whose task is on no card."""
    return {**manifest, "overrides": engines.on_the_cpu(manifest["overrides"])}


def export_sums(path: Path) -> dict[str, str]:
    """SHA-256 of the graphs that an export's manifest describes, by file name.

    Raises:
        ConfigError: when it is broken.
    """
    manifest: ExportManifest = _decode(path, ExportManifest, "the export")
    return manifest["files"]


def check_size(layers: list[int], where: str) -> None:
    """Raises ConfigError for layers that have more weights between them than `MAX_WEIGHTS`.

    `where` names them.
    """
    weights = sum(above * below for above, below in itertools.pairwise(layers))
    if weights > MAX_WEIGHTS:
        raise _core.ConfigError(
            f"{where}: layers of {', '.join(map(str, layers))} have {weights:,} weights, more than {MAX_WEIGHTS:,}; "
            "choose smaller hidden_dims"
        )


def _check_layout(manifest: Manifest, path: Path) -> None:
    total, width = sum(entry["size"] for entry in manifest["observation_layout"]), manifest["policy"]["num_obs"]
    if total != width:
        raise _core.ConfigError(
            f"{path}: policy num_obs = {width}, but the terms of observation_layout have {total} numbers; "
            "copy the manifest again from the training's run"
        )


def _check_joints(policy: PolicyManifest, path: Path) -> None:
    """Checks the arguments of a network of joints, and that their sizes fit one another."""
    missing = [key for key in ("joint_dim", "num_heads", "observation_layout", "joint_names") if key not in policy]
    if missing:
        raise _core.ConfigError(
            f"{path}: policy: {', '.join(missing)} missing, which {policy['class_name']} needs; "
            "copy the manifest again from the training's run"
        )
    if policy.get("leg_heads", 1) > policy["num_heads"]:
        raise _core.ConfigError(
            f"{path}: policy: leg_heads = {policy['leg_heads']} is more than num_heads = {policy['num_heads']}; "
            "copy the manifest again from the training's run"
        )
    check_size(
        [policy["num_obs"], policy["joint_dim"] * policy["num_actions"], policy["joint_dim"] * policy["num_heads"]],
        f"{path}: policy",
    )


def _decode(path: Path, schema: Any, source: str) -> Any:
    try:
        data = read_bytes(path, MAX_BYTES)
    except OSError as error:
        raise _core.ConfigError(
            f"cannot read {path}: {error.strerror}; keep the manifest beside what it describes"
        ) from error
    return _parse(data, schema, str(path), source)


def _parse(data: bytes, schema: Any, where: str, source: str) -> Any:
    try:
        return msgspec.json.decode(data, type=schema)
    except msgspec.ValidationError as error:
        raise _core.ConfigError(
            f"{where} is not a manifest of polypod: {_plain(str(error))}; copy it again from {source}"
        ) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _core.ConfigError(f"{where} is not valid JSON: {error}; copy it again from {source}") from error


def _plain(message: str) -> str:
    """Msgspec's message with the element first: "policy.num_actions: Expected `int`, got `str`"."""
    text, _, place = message.partition(" - at `$")
    return f"{place.rstrip('`').lstrip('.')}: {text}" if place else text
