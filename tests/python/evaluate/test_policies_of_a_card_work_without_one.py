"""A policy that was trained with `physics.engine=cuda` is used on a machine without a card.

The CPU has the same bits, so the engine of a training says nothing about its policy.
"""

import json
import shutil

import pytest
from conftest import same_process

from polypod import policy, sim2sim
from polypod.evaluation import evaluate_checkpoint
from polypod.export import export_checkpoint, interfaces
from polypod.play.player import Player
from polypod.runs import run_dir
from polypod.runs.engines import ENGINE, ON_THE_CPU
from polypod.training import session

ROBOT, OTHER = "unitree_go1", "anymal_c"


@pytest.fixture(scope="module")
def of_the_cpu(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    options = session.Options(
        robots=[ROBOT], log_dir=folder, device="cpu", logger="none", max_iterations=1, num_envs=16, threads=1
    )
    with same_process():
        assert session.train(options) == 0
    return run_dir.find_checkpoint(folder, "latest")


@pytest.fixture(scope="module", params=["cuda", "auto"])
def of_a_card(of_the_cpu, tmp_path_factory, request):
    run = tmp_path_factory.mktemp("card") / "run"
    shutil.copytree(of_the_cpu.parent, run)
    file = run / run_dir.MANIFEST
    manifest = json.loads(file.read_text(encoding="utf-8"))
    manifest["overrides"].append(f"physics.engine={request.param}")
    file.write_text(json.dumps(manifest), encoding="utf-8")
    return run / of_the_cpu.name


def test_it_walks_with_robots_of_its_training_and_with_others(of_the_cpu, of_a_card):
    of_each = (of_the_cpu, of_a_card)
    for robots in (None, [OTHER]):
        found = [evaluate_checkpoint(file, robots=robots, num_envs=2, steps=10, threads=1) for file in of_each]
        assert found[0].robots == found[1].robots


def test_it_plays(of_a_card):
    player = Player(of_a_card, robots=[OTHER], envs_per_robot=1, threads=1)
    player.step()


def test_its_graph_names_no_card(of_a_card, tmp_path):
    export_checkpoint(of_a_card, tmp_path, robots=[ROBOT])
    overrides = policy.load(tmp_path / "policy.onnx").manifest["overrides"]
    assert [change for change in overrides if change.startswith(ENGINE)] == [ON_THE_CPU]
    assert list(interfaces(policy.load(of_a_card).manifest, [ROBOT])) == [ROBOT]


def test_it_plays_in_mujoco(of_a_card):
    pytest.importorskip("mujoco")
    sim2sim.compare(of_a_card, [ROBOT], sim2sim.Options(envs_per_robot=1, steps=4))


def test_its_run_still_names_the_card(of_a_card):
    begun = run_dir.read_manifest(of_a_card, as_begun=True)["overrides"]
    assert begun[-1] in ("physics.engine=cuda", "physics.engine=auto")
