"""`polypod deploy check` plays every bundled policy through its loop and finds differences."""

import json

import numpy as np
import onnx
import pytest
import torch

import polypod
import polypod.policy as policies
from common import SMALL_TERRAIN
from deployed import CASES
from polypod.deploy import check
from polypod.export import contract as contracts
from polypod.export import export_checkpoint


def options(policy, **changes):
    overrides = SMALL_TERRAIN if policy == "rough" else ()
    return check.Options(**({"num_envs": 2, "steps": 25, "overrides": overrides} | changes))


@pytest.mark.parametrize(("policy", "robot"), CASES)
def test_every_bundled_policy_acts_through_the_loop_as_it_does(deployed_policies, policy, robot):
    found = check.check(deployed_policies / policy / f"policy_{robot}.onnx", options(policy))
    assert found.reference == f"the checkpoint {policy}" or policy == "rough"
    for played in found.played.values():
        assert played.steps >= 40
        assert max(played.observation, played.action) <= 1e-5
        assert played.target <= 1e-5
        # two roundings of the same numbers differ: zeros would be those of a comparison with itself
        assert played.action > 0.0
        assert not played.faults
    assert found.holds


def changed(path, to, change):
    """A graph whose contract consistently contradicts its network."""
    model = onnx.load(path)
    props = {entry.key: entry.value for entry in model.metadata_props}
    document = json.loads(props[contracts.KEY])
    change(document, props)
    onnx.helper.set_model_props(model, props | contracts.entries(document))
    onnx.save(model, to)
    return to


def turned_round(document, props):
    """A joint with the other sign: its observation changes, and what its action would do."""
    joint = document["joints"][2]
    joint["sign"], joint["action_scale"] = -joint["sign"], -joint["action_scale"]
    for key, value in (("joint_signs", joint["sign"]), ("action_scale", joint["action_scale"])):
        numbers = props[key].split(",")
        numbers[2] = f"{value:.9g}"
        props[key] = ",".join(numbers)


def scaled(document, props):
    document["observation"]["terms"][5]["scale"] = 0.05
    props["observation_scales"] = "1,1,1,1,1,0.05,1,1"


def test_an_observation_that_the_contract_gets_wrong_is_found(deployed_policies, tmp_path):
    path = changed(deployed_policies / "flat" / "policy_unitree_go2.onnx", tmp_path / "scaled.onnx", scaled)
    found = check.check(path, options("flat", simulators=("polypod",)))
    assert not found.holds
    assert found.played["polypod"].observation > 0.1
    assert found.played["polypod"].action < 1e-5


def test_a_network_that_is_another_is_found(deployed_policies, tmp_path):
    model = onnx.load(deployed_policies / "flat" / "policy_unitree_go2.onnx")
    (weights,) = [entry for entry in model.graph.initializer if entry.name == "layer_2_weight"]
    array = onnx.numpy_helper.to_array(weights).copy()
    array[3, 5] += 0.01
    weights.CopyFrom(onnx.numpy_helper.from_array(array, weights.name))
    onnx.save(model, tmp_path / "other.onnx")
    found = check.check(tmp_path / "other.onnx", options("flat"))
    for played in found.played.values():
        assert played.action > 1e-5
        assert played.observation < 1e-5
        assert not played.holds


def test_a_loop_that_forgets_its_last_action_is_found(deployed_policies, monkeypatch):
    monkeypatch.setattr(check.Loop, "_walk", lambda loop: setattr(loop, "mode", "walk"))
    step = check.Loop._walking

    def forgetful(loop, read):
        loop.action = np.zeros_like(loop.action)
        return step(loop, read)

    monkeypatch.setattr(check.Loop, "_walking", forgetful)
    found = check.check(deployed_policies / "flat" / "policy_unitree_go2.onnx", options("flat"))
    for played in found.played.values():
        assert played.action > 1e-3
        assert played.observation > 1e-3


def test_a_contract_of_another_robot_is_refused(deployed_policies, tmp_path):
    path = changed(deployed_policies / "flat" / "policy_unitree_go2.onnx", tmp_path / "turned.onnx", turned_round)
    with pytest.raises(polypod.ConfigError, match=r"contract\.joints: FL_calf_joint: action_scale is -0\.25, but"):
        check.check(path, options("flat"))
    with pytest.raises(polypod.ConfigError, match=r"contract\.joints are not those of cassie; name its config"):
        check.check(deployed_policies / "legged" / "policy_unitree_h1.onnx", options("legged", robot="cassie"))


def renamed(document, props):
    document["robot"]["name"] = props["robot"] = "my_robot"


def test_a_robot_that_is_not_in_the_library_is_named(deployed_policies, tmp_path):
    path = changed(deployed_policies / "flat" / "policy_unitree_go2.onnx", tmp_path / "mine.onnx", renamed)
    with pytest.raises(
        polypod.ConfigError, match=r"contract\.robot\.name is 'my_robot', which is no robot.*--robot FILE"
    ):
        check.check(path, options("flat"))
    assert check.check(path, options("flat", robot="unitree_go2", simulators=("polypod",))).holds


def test_without_its_checkpoint_the_network_in_the_file_is_compared_with(deployed_policies, tmp_path, monkeypatch):
    """For a perceptron and for a policy that remembers."""
    monkeypatch.setattr(check, "_sum", lambda path: None)
    for policy in ("flat", "quadruped"):
        path = deployed_policies / policy / "policy_unitree_go2.onnx"
        found = check.check(path, options(policy, simulators=("polypod",)))
        assert found.reference == "the network in the file"
        assert found.holds


def test_a_policy_of_another_learner_is_checked(tmp_path):
    """A file of one robot: both its graphs have a contract.

    The bare network's is over the observation.
    """
    torch.manual_seed(0)
    env = polypod.make("Velocity-Flat-Spot-v0", 1, seed=0)
    module = torch.nn.Sequential(torch.nn.Linear(48, 32), torch.nn.ELU(), torch.nn.Linear(32, 12))
    policies.save_onnx(module, env, tmp_path / "mine.onnx")
    env.close()
    export_checkpoint(tmp_path / "mine.onnx", tmp_path / "out", ["spot"], formats=("onnx",))
    for name, graph in (("policy", "network"), ("policy_spot", "folded")):
        found = check.check(tmp_path / "out" / f"{name}.onnx", options("flat"))
        assert found.contract.graph == graph
        assert found.contract.motors is None
        assert found.reference == f"the checkpoint {tmp_path / 'mine.onnx'}"
        assert found.holds


def test_another_checkpoint_is_refused(deployed_policies, cli):
    path = str(deployed_policies / "flat" / "policy_unitree_go2.onnx")
    done = cli("deploy", "check", path, "--checkpoint", "legged")
    assert done.returncode == 2
    assert "was not exported of legged: metadata checkpoint_sha256 is another; name its checkpoint" in done.stderr


def test_the_command_prints_a_table(deployed_policies, tmp_path, cli):
    path = str(deployed_policies / "flat" / "policy_unitree_go2.onnx")
    short = ("--num-envs", "1", "--steps", "3")
    done = cli("deploy", "check", path, *short, "--json", "out.json")
    assert done.returncode == 0, done.stderr
    rows = {
        line.split()[0]: line.split()[-1] for line in done.stdout.splitlines() if line.startswith(("polypod", "mujoco"))
    }
    assert rows == {"polypod": "yes", "mujoco": "yes"}
    assert "base_lin_vel: no sensor measures it; the robot needs an estimator" in done.stdout
    written = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert written["holds"] is True
    assert written["needs"] == ["base_lin_vel"]
    assert written["simulators"]["mujoco"]["steps"] == 3
    wrong = changed(deployed_policies / "flat" / "policy_unitree_go2.onnx", tmp_path / "scaled.onnx", scaled)
    done = cli("deploy", "check", str(wrong), *short, "--simulators", "polypod")
    assert done.returncode == 3
    assert " no" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("check", "{}", "--simulators", "gazebo"), "--simulators names gazebo; choose polypod, mujoco"),
        (("check", "{}", "--steps", "0"), "--steps 0 must be at least 1"),
        (("check", "{}", "--num-envs", "1000", "--steps", "10000"), "are more than 1,000,000 steps"),
        (("check", "{}", "--out", "x"), "--out belongs to polypod deploy write; leave it out"),
        (("write", "{}", "--steps", "3", "--out", "x"), "--steps belongs to polypod deploy check; leave it out"),
        (("write", "{}"), "--out is missing: name the folder to write to"),
        (("check", "nothing.onnx"), "nothing.onnx cannot be read: No such file or directory"),
        (("check", "{}", "--robot", "spott"), "spott"),
    ],
)
def test_bad_arguments_are_named(deployed_policies, cli, arguments, message):
    path = str(deployed_policies / "flat" / "policy_unitree_go2.onnx")
    done = cli("deploy", *(word.format(path) for word in arguments))
    assert done.returncode == 2
    assert message in done.stderr
