"""Makes a bundled policy of a model: `python -m lab.bundle MODEL FOLDER --task NAME`.

The networks stay, and the manifest with the robots of the library. Drawn robots are reduced to
their descriptions, by which a policy says how far a body is from those of its training.

With `--pretrained` it makes a network with which separate networks of `polypod adapt` begin, of a
run whose robots need not be of the library.
"""

import argparse
import copy
import json
import shlex
import sys
from pathlib import Path
from typing import Any

import torch

from polypod import _core
from polypod.networks.transfer import of_observation
from polypod.observation import terms_of
from polypod.policy import with_slots
from polypod.runs import run_dir
from polypod.runs.schema import URMA

KEPT = ("actor_state_dict", "critic_state_dict")

LARGE = 4096
"""Numbers of a weight that is kept in half precision where that is asked for."""


def manifest_of(manifest: dict[str, Any], task: str, recipe: str) -> dict[str, Any]:
    """The manifest of a bundled policy.

    Args:
        manifest: of the run.
        task: that evaluates it: the group `policy` must be the run's.
        recipe: the command that trains it.

    Raises:
        ValueError: for a task whose policies see something else.
    """
    known = {entry["name"] for entry in _core.robots()}
    robots = [robot for robot in manifest["robots"] if robot in known]
    sim = _core.VecSim(task, len(robots), robots=robots, threads=1)
    if manifest["policy"]["class_name"] == URMA:
        manifest = _with_slots_of(sim, manifest)
    seen = [(term.term, term.size) for term in terms_of(sim)]
    if seen != (trained := [(entry["term"], entry["size"]) for entry in manifest["observation_layout"]]):
        raise ValueError(f"{task} shows {seen}, and the policy was trained on {trained}")
    return {
        **manifest,
        "task": sim.task_name,
        "command": recipe,
        "overrides": [],
        "checkpoints": {},
        "robots": robots,
        "robot_sources": robots,
        "joint_maps": {robot: manifest["joint_maps"][robot] for robot in robots},
        "robot_info": {robot: manifest["robot_info"][robot] for robot in robots},
        "train_config": _without_paths(manifest["train_config"]),
    }


def _without_paths(config: dict[str, Any]) -> dict[str, Any]:
    """A train config whose teachers go by the names of their folders."""
    config = copy.deepcopy(config)
    if (distillation := config.get("distillation")) is not None:
        teachers = distillation["teachers"]
        distillation["teachers"] = {robot: Path(path).parent.name for robot, path in teachers.items()}
    return config


def _with_slots_of(sim: _core.VecSim, manifest: dict[str, Any]) -> dict[str, Any]:
    """The manifest of a network of joints without the slots that drawn robots alone have."""
    slots, trained = list(sim.canonical_joint_names), manifest["canonical_joint_names"]
    known = [(term.term, term.size) for term in terms_of(_sim_with(sim, trained))]
    if known != [(entry["term"], entry["size"]) for entry in manifest["observation_layout"]]:
        return manifest
    maps = {
        robot: [{**joint, "column": slots.index(joint["slot"])} for joint in manifest["joint_maps"][robot]]
        for robot in sim.robots
    }
    infos = {
        robot: {**info, "columns": [slots.index(slot) for slot in info["slots"]]}
        for robot in sim.robots
        for info in [manifest["robot_info"][robot]]
    }
    return {**with_slots(manifest, sim), "joint_maps": maps, "robot_info": infos}


def _sim_with(sim: _core.VecSim, slots: list[str]) -> _core.VecSim:
    return _core.VecSim(sim.task_name, len(sim.robots), robots=sim.robots, threads=1, slots=slots)


def manifest_of_pretrained(manifest: dict[str, Any], command: str) -> dict[str, Any]:
    """The manifest of a network that others begin with, without paths.

    Separate networks keep its task, observation and sizes; other changes of the task are left out.
    """
    left_out = ("joint_maps", "config_hash", "slots")
    return {
        **{key: value for key, value in manifest.items() if key not in left_out},
        "command": command,
        "overrides": of_observation(manifest["overrides"]),
        "checkpoints": {},
        "robot_sources": manifest["robots"],
        "train_config": _without_paths(manifest["train_config"]),
    }


def halved(weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Large weights in half precision, which halves a file; small ones, with norms, stay."""
    return {
        key: value.half() if value.is_floating_point() and value.numel() > LARGE else value
        for key, value in weights.items()
    }


def main() -> None:
    """Writes the folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("folder", type=Path)
    for_what = parser.add_mutually_exclusive_group(required=True)
    for_what.add_argument("--task", help="task that evaluates the policy")
    for_what.add_argument("--pretrained", metavar="COMMAND", help="command line of the run")
    parser.add_argument("--recipe", default="lab/recipes/legged")
    parser.add_argument("--actor", action="store_true", help="leave out the critic, which --init alone reads")
    parser.add_argument("--half", action="store_true", help="keep large weights in half precision")
    arguments = parser.parse_args()
    state = run_dir.load_checkpoint(arguments.model)
    recipe = shlex.join(["python", "-m", "lab.recipe", arguments.recipe])
    try:
        manifest = run_dir.read_manifest(arguments.model)
        if arguments.pretrained is not None:
            manifest = manifest_of_pretrained(manifest, arguments.pretrained)
        else:
            manifest = manifest_of(manifest, arguments.task, recipe)
    except ValueError as error:
        sys.exit(str(error))
    arguments.folder.mkdir(parents=True)
    checkpoint = arguments.folder / f"model_{state['iter']}.pt"
    (arguments.folder / run_dir.MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")
    networks = KEPT[:1] if arguments.actor else KEPT
    kept = {**{key: state[key] for key in networks if key in state}, "iter": state["iter"], "infos": {}}
    if arguments.half:
        kept |= {network: halved(kept[network]) for network in networks if network in kept}
    run_dir.save_checkpoint(checkpoint, lambda file: torch.save(kept, file))
    print(f"{checkpoint}: {checkpoint.stat().st_size} bytes")


if __name__ == "__main__":
    main()
