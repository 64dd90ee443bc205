"""The distance of a description: 0 for training bodies, larger for less similar ones."""

import base64
import json

import numpy as np
import pytest

from polypod import _core, bundled, descriptions
from polypod.descriptions import Body, Training
from polypod.runs import run_dir

POLICY = bundled.checkpoint("quadruped")


@pytest.fixture(scope="module")
def manifest():
    return run_dir.read_manifest(POLICY)


@pytest.fixture(scope="module")
def training(manifest):
    return descriptions.training_of(manifest)


def test_the_bundled_policy_tells_its_143_bodies(manifest, training):
    assert len(training.bodies) == 143
    assert set(manifest["robots"]) < set(training.bodies)
    assert {len(body.joints) for body in training.bodies.values()} == {8, 12}


def test_a_training_body_is_at_0_a_neighbour_near_a_wrong_description_farther_and_a_biped_farthest(training):
    found = descriptions.describe(["unitree_go1", "solo12", "bolt"])
    for robot in ("unitree_go1", "solo12"):
        # as it is described here today, to the bit of its float32 numbers
        assert training.distance(found[robot]).distance == pytest.approx(0.0, abs=1e-6)
    own = found["unitree_go1"]
    without = Training({name: body for name, body in training.bodies.items() if name != "unitree_go1"})
    neighbour = without.distance(own)
    assert neighbour.nearest == "unitree_go2"
    factors = np.random.default_rng(0).uniform(0.8, 1.2, own.numbers.shape).astype(np.float32)
    wrong = training.distance(Body(own.joints, own.numbers * factors))
    biped = training.distance(found["bolt"])
    assert 0.0 < neighbour.distance < wrong.distance < biped.distance
    # a small error counts less than a large one
    little = training.distance(Body(own.joints, own.numbers * (1.0 + 0.1 * (factors - 1.0))))
    assert 0.0 < little.distance < wrong.distance


def test_the_farthest_number_is_named(training):
    body = training.bodies["unitree_go1"]
    numbers = body.numbers.copy()
    joint, stiffness = body.joints.index("RF_KFE"), descriptions.DESCRIPTORS.index("stiffness")
    numbers[joint, stiffness] *= 20.0
    found = training.distance(Body(body.joints, numbers))
    assert (found.nearest, found.joint, found.descriptor) == ("unitree_go1", "RF_KFE", "stiffness")
    assert found.value == pytest.approx(20.0 * found.nearest_value)
    assert "RF_KFE, stiffness" in str(found)


def test_the_distance_by_hand():
    """Two bodies of one joint that differ in one number.

    Two of 57 features differ, none within the body.
    """
    width = len(descriptions.DESCRIPTORS)
    low, high = np.zeros((1, width), np.float32), np.zeros((1, width), np.float32)
    low[0, 9], high[0, 9] = 1.0, 3.0
    other = np.zeros((1, width), np.float32)
    other[0, 9] = 2.0
    found = Training({"low": Body(("A",), low), "high": Body(("A",), high)}).distance(Body(("A",), other))
    logarithm = np.log(3.01 / 1.01) / 2.0
    parts = (1.0 / 1.0, np.log(3.01 / 2.01) / logarithm)
    assert found.distance == pytest.approx(np.sqrt(sum(part**2 for part in parts) / (3 * width)), rel=1e-6)
    assert (found.nearest, found.descriptor) == ("high", "largest effort")


def test_the_order_of_joints_does_not_matter_and_a_joint_too_many_does(training):
    body = training.bodies["unitree_go1"]
    turned = Body(body.joints[::-1], body.numbers[::-1])
    assert training.distance(turned).distance == pytest.approx(0.0, abs=1e-6)
    arm = np.array(body.numbers[:1])
    arm[0, 0:3] += 0.5
    assert training.distance(Body((*body.joints, "ARM"), np.concatenate([body.numbers, arm]))).distance > 0.1
    legs = Body(body.joints[:6], body.numbers[:6])
    assert training.distance(legs).distance > 0.0


def test_bodies_survive_a_manifest(training):
    entries = json.loads(json.dumps(descriptions.to_manifest(training.bodies)))
    again = descriptions.from_manifest(entries, "here")
    for name, body in training.bodies.items():
        assert again[name].joints == body.joints
        np.testing.assert_array_equal(again[name].numbers, body.numbers)


@pytest.mark.parametrize(
    "numbers",
    ["", "AAAA", "!", base64.b64encode(np.full(19, np.nan, "<f4").tobytes()).decode()],
    ids=["none", "few", "no Base64", "no numbers"],
)
def test_broken_bodies_are_named(numbers):
    with pytest.raises(_core.ConfigError, match=r"here: trained_bodies 'spot'.*copy the manifest again"):
        descriptions.from_manifest([{"name": "spot", "joints": ["LF_HAA"], "numbers": numbers}], "here")


def test_policies_without_bodies_are_compared_with_the_robots_that_they_name():
    named = {"robot_sources": ["unitree_go1"]}
    (found,) = descriptions.distances(named, ["unitree_go1", "unitree_go2"]).values()
    assert found.nearest == "unitree_go1"
    assert found.distance > 0.05
    assert descriptions.distances({"robot_sources": ["nowhere.toml"]}, ["unitree_go2"]) == {}


def test_evaluations_tell_it_of_other_bodies_alone(cli, tmp_path):
    flags = ("--num-envs", "4", "--steps", "2", "--json", "out.json")
    done = cli("eval", "--checkpoint", "quadruped", "--robots", "unitree_go1,unitree_go2w", *flags)
    assert done.returncode == 0, done.stderr
    text = " ".join(done.stdout.split())
    assert "unitree_go2w: its description is 0." in text
    assert "unitree_go1: its description" not in text
    (told,) = json.loads((tmp_path / "out.json").read_text())["distances"].items()
    assert told[0] == "unitree_go2w"
    assert told[1]["distance"] > 0.1
    done = cli("play", "--checkpoint", "quadruped", "--robots", "unitree_go2w", "--headless", "--seconds", "0.1")
    assert "unitree_go2w: its description is 0." in " ".join(done.stdout.split())


def test_shares_of_envs_do_not_keep_a_policy_from_other_bodies(manifest):
    """One env of each robot is enough to describe bodies, for any shares in the training."""
    from polypod.policy import _for_bodies

    trained = {**manifest, "robot_sources": ["unitree_go1", "solo12"], "overrides": ["env_shares.unitree_go1=9"]}
    slots = _for_bodies(trained, None, ["box_quadruped", "bolt"])["canonical_joint_names"]
    assert {"LF_HAA", "L_KNEE"} < set(slots)
    overrides = trained["overrides"]
    assert set(descriptions.describe(["unitree_go1", "solo12"], overrides=overrides)) == {"unitree_go1", "solo12"}


def test_shares_of_a_tasks_own_do_not_either(tmp_path, monkeypatch):
    """A task may hold shares itself; then one env of each robot is still enough."""
    (tmp_path / "configs/tasks").mkdir(parents=True)
    robots = 'robots = ["spot", "unitree_go1", "anymal_c"]'
    text = f'extends = "velocity_flat"\nname = "Shared"\n{robots}\n[env_shares]\nspot = 9\n'
    (tmp_path / "configs/tasks/shared.toml").write_text(text)
    monkeypatch.setenv("POLYPOD_PATH", str(tmp_path))
    with pytest.raises(_core.PolypodError, match="env_shares"):
        _core.VecSim("Shared", 3)
    for task in ("Shared", "velocity_flat_universal"):
        changes = descriptions.for_one_env_each(["env_shares.unitree_go1=3", "sim.decimation=2"])
        sim = _core.VecSim(task, 2, robots=["unitree_go1", "spot"], overrides=changes)
        assert sim.env_ids("spot") == (1, 2)
