"""The contract in an exported file follows its schema and says what the simulator says.

A file that contradicts itself or lacks a key is refused with the name of the element.
"""

import copy
import json
import math
import random
import re
import shutil

import jsonschema
import onnx
import pytest

import polypod
from deployed import CASES
from polypod.deploy.onboard.policy_contract import ContractError, read_contract
from polypod.deploy.onboard.policy_loop import open_file
from polypod.export import contract as contracts

SCHEMA = jsonschema.Draft202012Validator(json.loads(contracts.SCHEMA.read_text(encoding="utf-8")))


def said(path):
    return {entry.key: entry.value for entry in onnx.load(path).metadata_props}


@pytest.fixture(scope="module")
def document(deployed_policies):
    return json.loads(said(deployed_policies / "legged" / "policy_cassie.onnx")[contracts.KEY])


@pytest.mark.parametrize(("policy", "robot"), CASES)
def test_contracts_follow_the_schema(deployed_policies, policy, robot):
    path = deployed_policies / policy / f"policy_{robot}.onnx"
    found = json.loads(said(path)[contracts.KEY])
    jsonschema.Draft202012Validator.check_schema(SCHEMA.schema)
    SCHEMA.validate(found)
    _, contract = open_file(path)
    assert contract.robot == robot
    assert ("base_lin_vel" in found["needs"]["estimated"]) == (policy in ("flat", "rough"))
    assert found["needs"]["mapped"] == (["height_scan"] if policy == "rough" else [])
    assert bool(found["states"]) == (policy in ("legged", "quadruped"))
    assert contract.num_rays == (187 if policy == "rough" else 0)


@pytest.mark.parametrize(("policy", "robot"), CASES)
def test_joints_are_those_of_the_simulator(deployed_policies, policy, robot):
    found = json.loads(said(deployed_policies / policy / f"policy_{robot}.onnx")[contracts.KEY])
    sim = polypod.Simulation(robot, ground=None)
    joints = found["joints"]
    assert [joint["name"] for joint in joints] == sim.joint_names
    limits = [[joint["lower"], joint["upper"]] for joint in joints]
    wanted = [
        [None if math.isinf(limit) else pytest.approx(limit, rel=1e-6) for limit in row] for row in sim.joint_range
    ]
    assert limits == wanted
    config = polypod._core.VecSim("velocity_flat_legged_play", 1, robots=[robot], threads=1).resolved_config()
    assert 'model = "network"' not in config
    # physics steps of 5 ms; the training of these policies delays targets by up to two more
    for joint in joints:
        assert 0.0 <= joint["delay"][0] <= joint["delay"][1] <= 0.03
        assert abs(joint["action_scale"]) > 0.0
        assert joint["sign"] * joint["action_scale"] > 0.0
    masked = [column for column in found["columns"] if column["joint"] is None]
    assert len(found["columns"]) - len(masked) == len(joints)


def test_the_damping_mode_is_stiffer_than_the_training(deployed_policies):
    """A joint without stiffness, damped as in the training, falls as if it were free."""
    found = json.loads(said(deployed_policies / "flat" / "policy_unitree_go2.onnx")[contracts.KEY])
    for joint, damping in zip(found["joints"], found["safety"]["damping"], strict=True):
        assert damping == pytest.approx(0.1 * joint["stiffness"])
        assert damping > joint["damping"]


CHANGES = [
    (["version"], 2, "contract.version is 2, but this loop reads version 1"),
    (["version"], True, "contract.version"),
    (["graph"], "both", "contract.graph is 'both'; it must be one of folded, network"),
    (["joints"], [], "contract.joints is empty"),
    (["joints"], {}, "contract.joints is a table; it must be a list"),
    (["joints", 3, "stiffness"], -1.0, r"contract.joints\[3\].stiffness is -1; it must be a number from 0"),
    (["joints", 3, "stiffness"], "1", r"contract.joints\[3\].stiffness is a text"),
    (["joints", 3, "stiffness"], True, r"contract.joints\[3\].stiffness is true"),
    (["joints", 3, "lower"], 9.0, r"contract.joints\[3\].lower is 9, above contract.joints\[3\].upper"),
    (["joints", 3, "sign"], 0.5, r"contract.joints\[3\].column contradicts its slot and its sign"),
    (["joints", 3, "action_scale"], 0.5, r"contract.joints\[3\].action_scale is 0.5, but the joint has the sign -1"),
    (["joints", 3, "column"], 68, r"contract.joints\[3\].column is 68|contract.columns\[\d+\].joint"),
    (["joints", 3, "delay"], [0.2, 0.1], r"contract.joints\[3\].delay"),
    (["joints", 3, "drive"], "hydraulic", r"contract.joints\[3\].drive"),
    (["joints", 3, "name"], "", r"contract.joints\[3\].name"),
    (["columns", 0, "joint"], 99, r"contract.columns\[0\].joint is 99"),
    (["columns", 0, "joint"], 3, r"contract.columns\[0\].joint is 3, but contract.joints\[3\].column"),
    (
        ["observation", "order"],
        "newest_first",
        "contract.observation.order is 'newest_first'; it must be one of oldest",
    ),
    (["observation", "size"], 5, "contract.observation.size is 5, but its terms have 2379"),
    (["observation", "terms", 4, "size"], 10, r"contract.observation.terms\[4\].size gives 2 numbers a step"),
    (["observation", "terms", 4, "start"], 13, r"contract.observation.terms\[4\].start is 13"),
    (["observation", "terms", 4, "history"], 7, r"contract.observation.terms\[4\].history is 7, which does not divide"),
    (["observation", "terms", 4, "source"], "sonar", r"contract.observation.terms\[4\].source is 'sonar'"),
    (["observation", "terms", 4, "clip"], [1.0, -1.0], r"contract.observation.terms\[4\].clip"),
    (
        ["observation", "terms", 4, "constant"],
        [1.0],
        r"contract.observation.terms\[4\].constant has 1 numbers, not 345",
    ),
    (["inputs", 0, "size"], 4, "contract.inputs gives base_ang_vel 4 numbers, but the robot has 3"),
    (["inputs", 0, "name"], "odometry", "contract.inputs holds odometry"),
    (["outputs"], [{"name": "actions", "size": 69}], "contract.outputs lacks joint_pos_target"),
    (["states"], [{"input": "h_in", "output": "h_out", "shape": [1, 1 << 30]}], r"contract.states\[0\].shape"),
    (["command", "low"], [2.0, 0.0, 0.0], "contract.command.low is above contract.command.high"),
    (["command", "low"], [0.0, 0.0], "contract.command.low has 2 numbers, not 3"),
    (["safety", "damping"], [1.0], "contract.safety.damping has 1 numbers, not 12"),
    (["safety", "max_tilt"], 0.0, "contract.safety.max_tilt is 0"),
    (["safety", "behaviour"], "ignore", "contract.safety.behaviour"),
    (["rates", "control_dt"], 0.0, "contract.rates.control_dt is 0"),
    (["robot", "base_com"], [0.0, 0.0, 1e99], r"contract.robot.base_com\[2\] is 1e\+99"),
    (["motors"], {"interface": "x", "joints": ["no"], "modes": [1]}, "contract.motors.joints names no, which is no"),
    (["motors"], {"interface": "x", "joints": [], "modes": []}, "contract.motors.joints lacks"),
]


def changed(document, path, value):
    document = copy.deepcopy(document)
    place = document
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return document


@pytest.mark.parametrize(("path", "value", "message"), CHANGES)
def test_what_no_loop_obeys_is_named(document, path, value, message):
    with pytest.raises(ContractError, match=f"^x.onnx: (?:{message}).*; "):
        read_contract(json.dumps(changed(document, path, value)), "x.onnx")


USED = [
    *(["version"], ["graph"], ["policy"], ["robot"], ["rates"], ["joints"], ["columns"], ["observation"], ["inputs"]),
    *(["outputs"], ["states"], ["command"], ["height_scan"], ["needs"], ["safety"], ["motors"]),
    *(
        ["joints", 0, key]
        for key in ("name", "slot", "column", "sign", "action_scale", "default_pos", "lower", "upper")
    ),
    *(["joints", 0, key] for key in ("stiffness", "damping", "armature", "effort_limit", "velocity_limit", "delay")),
    *(["safety", key] for key in ("stale_after", "max_tilt", "joint_margin", "damping", "stand_time", "behaviour")),
    *(
        ["observation", "terms", 0, key]
        for key in ("name", "size", "start", "source", "inputs", "offset", "clip", "scale")
    ),
]


@pytest.mark.parametrize("path", USED, ids=lambda path: ".".join(map(str, path)))
def test_a_key_that_is_missing_is_named(document, path):
    lacking = copy.deepcopy(document)
    place = lacking
    for key in path[:-1]:
        place = place[key]
    del place[path[-1]]
    name = "contract" + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)
    with pytest.raises(ContractError) as caught:
        read_contract(json.dumps(lacking), "x.onnx")
    shown = name if path != ["version"] else "contract.version is None"
    assert shown in str(caught.value)
    assert not SCHEMA.is_valid(lacking)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "metadata polypod_contract is missing; export the policy for one robot"),
        ("", "contract is no JSON"),
        ("{", "contract is no JSON"),
        ("[" * 100_000, "contract is no JSON"),
        ('{"version": NaN}', "NaN is no number of JSON"),
        ('{"version": 1, "version": 1}', "a key stands twice"),
        ('{"version": 1' + "0" * 5000 + "}", "contract"),
        ("3", "contract is a number; it must be a table"),
        ("null", "contract is null; it must be a table"),
        (" " * (5 << 20), "contract has more than 4 MiB"),
    ],
)
def test_a_text_that_is_no_contract_is_refused(text, message):
    with pytest.raises(ContractError, match=f"^x.onnx: .*{message}"):
        read_contract(text, "x.onnx")


def leaves(value, path=()):
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from leaves(value[key], (*path, key))
        if path:
            yield path
    else:
        yield path


def error_of(text):
    try:
        read_contract(text, "x.onnx")
    except ContractError as error:
        return str(error)
    return None


def test_no_value_of_any_element_raises_another_error(document):
    """Whatever stands in the place of an element, the reader takes it or names what is wrong."""
    paths = sorted(leaves(document), key=str)
    drawn, refused = random.Random(0), 0
    values = [None, True, -1, 0, 1e300, -1e300, 10**30, "", "x" * 5000, [], {}, [[]], [None] * 70, "é,\n"]
    for _ in range(600):
        error = error_of(json.dumps(changed(document, drawn.choice(paths), drawn.choice(values))))
        refused += error is not None
        assert error is None or (error.startswith("x.onnx: ") and len(error) < 5500)
    assert refused > 400


METADATA = [
    (contracts.KEY, None, "metadata polypod_contract is missing; export the policy for one robot"),
    (contracts.SUM_KEY, "0" * 64, "metadata polypod_contract_sha256 is not that of the contract"),
    ("robot", "spot", "metadata robot is 'spot', which the contract contradicts"),
    ("joint_names", None, "metadata joint_names is missing"),
    ("joint_names", "a,b", "metadata joint_names is 'a,b', which the contract contradicts"),
    ("joint_stiffness", "1,2", "metadata joint_stiffness has 2 numbers, but the contract has 12"),
    ("joint_damping", ",".join(["nan"] * 12), r"metadata joint_damping\[0\] is nan, but the contract says"),
    ("default_joint_pos", ",".join(["x"] * 12), "metadata default_joint_pos is .*, no list of numbers"),
    ("action_scale", ",".join(["0.5"] * 11 + ["0.6"]), r"metadata action_scale\[\d+\] is"),
    ("step_dt", "0.01", r"metadata step_dt\[0\] is 0.01, but the contract says 0.02"),
    ("observation_names", "a", "metadata observation_names"),
    ("observation_scales", "1,1,1,1,1,1,2", r"metadata observation_scales\[6\] is 2"),
    ("polypod", None, "metadata polypod is missing"),
    ("polypod", "{", "metadata polypod"),
]


@pytest.mark.parametrize(("key", "value", "message"), METADATA)
def test_metadata_that_contradict_the_contract_are_named(deployed_policies, tmp_path, cli, key, value, message):
    model = onnx.load(deployed_policies / "legged" / "policy_cassie.onnx")
    props = {entry.key: entry.value for entry in model.metadata_props} | {key: value}
    onnx.helper.set_model_props(model, {name: text for name, text in props.items() if text is not None})
    path = tmp_path / "changed.onnx"
    onnx.save(model, path)
    done = cli("deploy", "check", str(path), "--steps", "1", "--simulators", "polypod")
    assert done.returncode == 2, done.stdout + done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert re.search(f"changed.onnx: {message}", done.stderr), done.stderr


def test_a_graph_of_another_contract_is_refused(deployed_policies, tmp_path):
    """The tensors of one policy's graph with the metadata of another robot's."""
    model = onnx.load(deployed_policies / "flat" / "policy_unitree_go2.onnx")
    onnx.helper.set_model_props(model, said(deployed_policies / "rough" / "policy_unitree_go2.onnx"))
    onnx.save(model, tmp_path / "mixed.onnx")
    with pytest.raises(ContractError, match=r"mixed\.onnx: input height_scan is in the contract alone"):
        open_file(tmp_path / "mixed.onnx")


@pytest.mark.parametrize("content", [b"", b"x" * 100, b"\x08\x08\x12"])
def test_a_file_that_is_no_graph_is_refused(tmp_path, cli, content):
    path = tmp_path / "broken.onnx"
    path.write_bytes(content)
    with pytest.raises(ContractError, match=r"broken.onnx"):
        open_file(path)
    for action in ("check", "show"):
        done = cli("deploy", action, str(path))
        assert done.returncode == 2
        assert "broken.onnx" in done.stderr


def test_a_file_of_all_robots_is_told_what_to_do(deployed_policies, tmp_path, cli):
    path = shutil.copy(deployed_policies / "flat" / "policy.onnx", tmp_path)
    done = cli("deploy", "check", str(path))
    assert done.returncode == 2
    assert "export the policy for one robot: polypod export --robots NAME" in done.stderr


def test_makers_motors_move_every_joint_of_their_robot_once():
    """And in the order of Unitree's quadrupeds: front right, front left, rear right, rear left."""
    robots = json.loads(contracts.MOTORS.read_text(encoding="utf-8"))["robots"]
    assert {"unitree_aliengo", "unitree_b1", "unitree_b2"} <= set(robots)
    for name, motors in robots.items():
        (info,) = json.loads(polypod.make("velocity_flat_legged", 1, robots=[name]).sim.robot_info()).values()
        assert sorted(joint for joint in motors["joints"] if joint) == sorted(info["joint_names"]), name
        assert len(motors["modes"]) == len(motors["joints"])
        assert motors["source"].startswith("https://github.com/unitreerobotics/")
        if len(info["joint_names"]) == 12:
            assert [joint[:2] for joint in motors["joints"][::3]] == ["FR", "FL", "RR", "RL"], name
