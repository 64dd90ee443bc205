"""Policies of any learner: what `eval`, `play`, `export` and `sim2sim` run.

>>> import polypod.policy
>>> policy = polypod.policy.load("logs/.../model_300.pt")
>>> actions = policy.act(observations)

A policy is a checkpoint of `polypod train` with its manifest, or an ONNX file with one input, the
observation, and as its first output the action. `save_onnx` writes such a file of any torch module,
with the data that the commands need.
"""

import dataclasses
import hashlib
import io
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from polypod import _core, bundled, runs
from polypod.descriptions import for_one_env_each
from polypod.extras import package
from polypod.files import read_bytes, write_bytes
from polypod.networks.agreement import TOLERANCE, difference, expected, untouched
from polypod.networks.onnx_network import OnnxNetwork
from polypod.networks.policies import NetworkPolicy, load_network
from polypod.networks.transfer import emptied, has_actions_for, numbers_of, perceptron_for, with_joints
from polypod.observation import layout_of, terms_of
from polypod.registration import task_of
from polypod.runs import manifest as manifests
from polypod.runs import run_dir
from polypod.runs.schema import MLP, URMA
from polypod.vector_env import FloatArray, VectorEnv

if TYPE_CHECKING:
    from rsl_rl.models import MLPModel

METADATA = "polypod"
"""Key of an ONNX model's metadata under which the manifest stands, as JSON."""
MAX_BYTES = 1 << 30
"""Largest size of an ONNX file, bytes."""
OPSET = 17
"""Opset of the files that `save_onnx` writes."""
_ROWS = 64


class Policy(Protocol):
    """A deterministic policy, and what it was made for."""

    @property
    def task(self) -> str:
        """Name of the task."""

    @property
    def robots(self) -> Sequence[str]:
        """Names of the robots, or paths of their configs."""

    @property
    def observation_names(self) -> Sequence[str]:
        """Terms of the observation, in order."""

    @property
    def joint_names(self) -> Sequence[str]:
        """Slots of the action."""

    def act(self, observations: FloatArray) -> FloatArray:
        """Actions [num_envs, num_actions] for observations [num_envs, num_obs]."""


@dataclasses.dataclass(frozen=True)
class LoadedPolicy:
    """A policy of a file. It is a `Policy`."""

    network: "MLPModel | OnnxNetwork"
    manifest: dict[str, Any]
    """`polypod.runs.manifest.Manifest`, of an ONNX file the part of it that `OnnxManifest`
    describes."""
    file: Path
    sha256: str
    """Checksum of the file, hexadecimal."""
    iteration: int | None = None
    """Iteration of the training, if known."""

    @property
    def task(self) -> str:
        """Name of the task."""
        return str(self.manifest["task"])

    @property
    def robots(self) -> list[str]:
        """Names of the robots, or paths of their configs."""
        return list(self.manifest["robot_sources"])

    @property
    def observation_names(self) -> list[str]:
        """Terms of the observation, in order."""
        return [entry["term"] for entry in self.manifest["observation_layout"]]

    @property
    def joint_names(self) -> list[str]:
        """Slots of the action."""
        return list(self.manifest["canonical_joint_names"])

    def act(self, observations: FloatArray) -> FloatArray:
        """Actions [num_envs, num_actions] for observations [num_envs, num_obs].

        Another width raises ConfigError.
        """
        return self.runner()(observations)

    def runner(self) -> NetworkPolicy:
        """The policy as `polypod.evaluation.evaluate` runs it.

        A recurrent one is told when episodes end.
        """
        return NetworkPolicy(self.network, self.manifest["policy"]["num_obs"])


def load(path: Path | str, task: str | None = None, robots: Sequence[str] | None = None) -> LoadedPolicy:
    """Loads a policy; nothing in the file is executed.

    Weights of a network of joints know no slots: it is made ready for the slots of the task and
    robots that are named. A perceptron holds joints of these robots that it does not know in their
    default pose.

    Args:
        path: a `model_<n>.pt` next to its manifest, a `.onnx`, or a bundled policy: flat, rough,
            legged, quadruped or two_legs.
        task: of an ONNX file that does not say so itself, and of a network of joints; others are
            taken at their word.
        robots: names, as `task`; None: those that the file names, or those of the task.

    Raises:
        ConfigError: for a file that is missing or broken, and for an ONNX file of unknown origin
            without `task`.
    """
    path = runs.resolve(Path(path))
    if path.suffix == ".onnx":
        return _load_onnx(path, task, robots)
    data = run_dir.read_checkpoint(path)
    state, manifest = run_dir.checkpoint_of(data, path), run_dir.read_manifest(path)
    digest = hashlib.sha256(data).hexdigest()
    if manifest["policy"]["class_name"] == URMA and (task is not None or robots is not None):
        manifest = _for_bodies(manifest, task, robots)
    elif robots is not None:
        state, manifest = _with_still_joints(state, manifest, task, robots)
    elif "robot_info" not in manifest and bundled.shown(path) != str(path):
        # it names robots of the library that it was not trained with as they are
        state, manifest = _with_still_joints(state, manifest, task, manifest["robot_sources"])
    return LoadedPolicy(load_network(state, manifest["policy"]), manifest, path, digest, state.get("iter"))


def _for_bodies(manifest: dict[str, Any], task: str | None, robots: Sequence[str] | None) -> dict[str, Any]:
    """The manifest of a network of joints with these bodies' slots added to its training's.

    In another task the slots are those of the bodies alone.
    """
    trained = list(manifest["robot_sources"])
    sources = trained if robots is None else list(robots)
    name = _core.play_task(task or manifest["task"])

    def batch(of: list[str]) -> _core.VecSim:
        return _core.VecSim(name, len(of), robots=of, threads=1, overrides=for_one_env_each(manifest["overrides"]))

    sim = batch(sources)
    if name == _core.play_task(manifest["task"]):
        if set(sim.canonical_joint_names) <= set(manifest["canonical_joint_names"]):
            return manifest
        sim = batch([*trained, *(robot for robot in sources if robot not in trained)])
    return with_slots(manifest, sim)


def _with_still_joints(
    state: dict[str, Any], manifest: dict[str, Any], task: str | None, robots: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Checkpoint and manifest of a perceptron for robots with joints that it does not know.

    It acts as if they were not there. Their actions are 0, so that they hold their default pose.
    """
    known, old = list(manifest["canonical_joint_names"]), state.get("actor_state_dict")
    if manifest["policy"]["class_name"] != MLP or old is None:
        return state, manifest
    sim = _core.VecSim(
        _core.play_task(task or manifest["task"]),
        len(robots),
        robots=list(robots),
        threads=1,
        overrides=for_one_env_each(manifest["overrides"]),
        slots=known,
    )
    if len(sim.canonical_joint_names) == len(known):
        return state, manifest
    numbers, wanted = numbers_of(sim, ["policy"], known), numbers_of(sim, ["policy"])
    old = {key: value.float() if value.is_floating_point() else value for key, value in old.items()}
    moved = perceptron_for(old, numbers, emptied(old, len(wanted)), wanted)
    if moved is None or not has_actions_for(moved, known):
        return state, manifest  # whoever steps it says what does not fit
    actor = with_joints(moved, known, sim.canonical_joint_names)
    return {**state, "actor_state_dict": actor}, with_slots(manifest, sim)


def with_slots(manifest: dict[str, Any], sim: _core.VecSim) -> dict[str, Any]:
    """The manifest of a policy with the slots and the observation of `sim`.

    A network of joints is built from their names and the layout.
    """
    slots = sim.canonical_joint_names
    policy = {**manifest["policy"], "num_obs": sim.num_obs, "num_actions": sim.num_actions}
    if policy["class_name"] == URMA:
        policy |= {"observation_layout": layout_of(terms_of(sim)), "joint_names": slots}
    sizes = [{"term": term, "size": size} for term, size in sim.observation_layout]
    return {**manifest, "canonical_joint_names": slots, "observation_layout": sizes, "policy": policy}


def save_onnx(module: torch.nn.Module, env: VectorEnv, path: Path | str) -> Path:
    """Writes a policy as an ONNX file that the commands take: `polypod eval --checkpoint FILE`.

    The module stays as it is, in its mode and on its device, and torch's random numbers go on as
    without the call.

    Args:
        module: takes observations [batch, num_obs], float32, and gives actions [batch, num_actions]
            as `env.step` takes them: what a learner does to either (normalisation, clipping)
            belongs into it.
        env: an env of the task and the robots that the policy was trained on.
        path: of the file; ends in `.onnx`.

    Returns:
        The path.

    Raises:
        ConfigError: for another ending, for a module that fails or gives something else, and where
            onnx is missing.
        PolypodError: for a graph that does not compute what the module does.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise _core.ConfigError(f"{path}: the name of an ONNX file ends in .onnx")
    onnx = package("onnx", "writing an ONNX file", "export")
    sim = env.sim
    example = torch.from_numpy(np.random.default_rng(0).standard_normal((_ROWS, sim.num_obs), dtype=np.float32))
    # other rows than those that the graph is traced with: what depends on them differs here
    others = -example[: _ROWS // 8]
    with untouched(module):
        _check_actions(module, example, sim.num_actions)
        try:
            model = onnx.load_model_from_string(_traced(module, example))
        except Exception as error:  # from torch's exporter, or from the caller's code
            reason = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
            raise _core.ConfigError(
                f"torch does not write the module as ONNX: {type(error).__name__}: {reason}; let it compute with "
                f"operators of opset {OPSET}"
            ) from error
        wanted = [expected(module, [rows], "the module") for rows in (example, others)]
    onnx.helper.set_model_props(model, {METADATA: json.dumps(_manifest_of(sim, sim.task_name, sim.robots))})
    data = model.SerializeToString()
    graph = OnnxNetwork(data, str(path))
    with torch.no_grad():
        found = [difference([graph(rows).numpy()], of) for rows, of in zip((example, others), wanted, strict=True)]
    if not max(found) <= TOLERANCE:
        raise _core.PolypodError(
            f"{path} would differ from the module by {max(found):.1e} of its actions, more than {TOLERANCE:g}; let the "
            "module compute without branches that depend on its input"
        )
    write_bytes(path, data)
    return path


def _check_actions(module: torch.nn.Module, observations: torch.Tensor, num_actions: int) -> None:
    """Raises ConfigError for a module that is no policy, or whose actions differ each time."""
    try:
        given = module(observations)
    except Exception as error:  # from the caller's code
        raise _core.ConfigError(
            f"the module fails for observations {tuple(observations.shape)} of float32 on the CPU: "
            f"{type(error).__name__}: {error}"
        ) from error
    if not isinstance(given, torch.Tensor) or given.shape != (len(observations), num_actions):
        found = tuple(given.shape) if isinstance(given, torch.Tensor) else type(given).__name__
        raise _core.ConfigError(
            f"the module gives {found} for observations {tuple(observations.shape)}; it must give actions "
            f"({len(observations)}, {num_actions})"
        )
    if given.dtype is not torch.float32:
        raise _core.ConfigError(f"the module gives actions of {given.dtype}; it must give float32")
    if not torch.equal(given, module(observations)) and bool(torch.isfinite(given).all()):
        raise _core.PolypodError(
            "the module gives other actions for the same observations; let it compute without random numbers and "
            "without memory"
        )


def _traced(module: torch.nn.Module, example: torch.Tensor) -> bytes:
    """The module as an ONNX model of any batch size.

    Uses torch's older exporter: the newer one takes seconds and another package.
    """
    buffer: Any = io.BytesIO()
    axes = {"obs": {0: "batch"}, "actions": {0: "batch"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            (example,),
            buffer,
            input_names=["obs"],
            output_names=["actions"],
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )
    return bytes(buffer.getvalue())


def _load_onnx(path: Path, task: str | None, robots: Sequence[str] | None) -> LoadedPolicy:
    try:
        data = read_bytes(path, MAX_BYTES)
    except OSError as error:
        raise _core.ConfigError(f"cannot read {path}: {error.strerror}") from error
    network = OnnxNetwork(data, str(path))
    if METADATA in network.metadata:
        manifest = manifests.read_onnx(network.metadata[METADATA], f"{path}: metadata {METADATA}")
    elif task is None:
        raise _core.ConfigError(
            f"{path} does not say for which task it is; name it with --task, or write the file with "
            "polypod.policy.save_onnx"
        )
    else:
        name = task_of(task)
        sim = VectorEnv(name, robots=None if robots is None else list(robots), seed=0, threads=1).sim
        manifest = _manifest_of(sim, sim.task_name, list(robots or sim.robots))
    sizes = {"num_obs": network.num_obs, "num_actions": network.num_actions}
    expected = {
        "num_obs": sum(entry["size"] for entry in manifest["observation_layout"]),
        "num_actions": len(manifest["canonical_joint_names"]),
    }
    if sizes != expected:
        raise _core.ConfigError(
            f"{path} takes observations of {sizes['num_obs']} numbers and gives actions of {sizes['num_actions']}; "
            f"{manifest['task']} has {expected['num_obs']} and {expected['num_actions']}"
        )
    policy = {**sizes, "class_name": "ONNX", "hidden_dims": [], "activation": ""}
    return LoadedPolicy(network, {**manifest, "policy": policy}, path, hashlib.sha256(data).hexdigest())


def _manifest_of(sim: _core.VecSim, task: str, robots: Sequence[str]) -> dict[str, Any]:
    """See `polypod.runs.manifest.OnnxManifest`."""
    return onnx_manifest(
        {
            "task": task,
            "robot_sources": [run_dir.source(robot) for robot in robots],
            "robots": sim.robots,
            "overrides": [],
            "step_dt": sim.step_dt,
            "canonical_joint_names": sim.canonical_joint_names,
            "observation_layout": [{"term": term, "size": size} for term, size in sim.observation_layout],
        }
    )


def onnx_manifest(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a training's manifest that an ONNX file holds."""
    return {"format": 1, **{key: manifest[key] for key in manifests.ONNX_KEYS}}
