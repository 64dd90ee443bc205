"""The metadata of an exported file define its actions and observations: a loop needs nothing else.

`targets_of` and `observation_of` are such a loop. They know the file's metadata and what a robot
measures.
"""

import json

import numpy as np
import onnxruntime
import pytest

import polypod
from common import FLAT_POLICY, MASKED_POLICY
from polypod.export import export_checkpoint, metadata
from polypod.observation import Term

ROBOTS = {
    "flat": (FLAT_POLICY, ["unitree_go2"], "velocity_flat_universal"),
    "masked": (MASKED_POLICY, ["limx_tron1", "cassie", "box_quadruped", "unitree_go2"], "velocity_flat_legged"),
}
CASES = [(name, robot) for name, (_, robots, _) in ROBOTS.items() for robot in robots]
MEASURED = {
    "base_angular_velocity": "angular_velocity",
    "projected_gravity": "gravity",
    "velocity_command": "command",
    "last_action": "last_action",
}
"""Raw readings of a robot, by the source of the term."""


def words(text):
    return text.split(",") if text else []


def numbers(text):
    return np.array(words(text), dtype=np.float64)


def targets_of(said, actions):
    """Joint targets [joints], rad, of actions [columns]."""
    joints = words(said["joint_names"])
    targets, scale = numbers(said["default_joint_pos"]), numbers(said["action_scale"])
    for joint, column in zip(words(said["action_joint_names"]), words(said["action_columns"]), strict=True):
        j = joints.index(joint)
        targets[j] += scale[j] * actions[int(column)]
    return targets


def observation_of(said, measured):
    """The observation [columns] of a robot's measurements, in its own order and signs."""
    columns = words(said["observation_columns"])
    joints, slots = words(said["joint_names"]), words(said["action_names"])
    signs, pose = numbers(said["joint_signs"]), numbers(said["default_joint_pos"])
    joint_of_slot = {
        slots[int(column)]: joints.index(joint)
        for joint, column in zip(words(said["action_joint_names"]), words(said["action_columns"]), strict=True)
    }
    constants = list(numbers(said.get("observation_constants", "")))

    def of_joints(values, names):
        return [
            signs[joint_of_slot[slot]] * values[joint_of_slot[slot]] if slot in joint_of_slot else 0.0 for slot in names
        ]

    values = []
    terms = [words(said[f"observation_{key}"]) for key in ("names", "sizes", "sources", "offsets", "clips", "scales")]
    for name, size, source, offset, clip, scale in zip(*terms, strict=True):
        here = columns[len(values) : len(values) + int(size)]
        if source == "robot_constant":
            values += constants[: int(size)]
            del constants[: int(size)]
            continue
        elements = [column.removeprefix(f"{name}.") for column in here]
        if source == "center_of_mass_velocity":
            term = measured["velocity"] + np.cross(measured["angular_velocity"], numbers(said["base_com"]))
        elif source == "joint_position_minus_default":
            term = of_joints(measured["joint_pos"] - pose, elements)
        elif source == "joint_velocity":
            term = of_joints(measured["joint_vel"], elements)
        else:
            term = measured[MEASURED[source]]
        term = np.array(term) - float(offset)
        if clip:
            term = np.clip(term, *(float(limit) for limit in clip.split(":")))
        values += list(term * float(scale))
    assert len(values) == len(columns)
    return np.array(values)


@pytest.fixture(scope="module")
def folders(built_once):
    def export(folder):
        for name, (file, robots, _) in ROBOTS.items():
            export_checkpoint(file, folder / name, robots, formats=("onnx",))

    return built_once("deployment_contract", export)


def session_of(folder, robot):
    session = onnxruntime.InferenceSession(folder / f"policy_{robot}.onnx")
    return session, session.get_modelmeta().custom_metadata_map


@pytest.mark.parametrize(("policy", "robot"), CASES)
def test_the_metadata_define_the_targets(folders, policy, robot):
    session, said = session_of(folders / policy, robot)
    random = np.random.default_rng(0)
    feeds = {i.name: random.standard_normal((1, i.shape[1]), dtype=np.float32) for i in session.get_inputs()}
    names = [output.name for output in session.get_outputs()]
    given = {name: values[0] for name, values in zip(names, session.run(None, feeds), strict=True)}
    assert len(given["actions"]) == len(feeds["last_action"][0]) == len(words(said["action_names"]))
    np.testing.assert_allclose(targets_of(said, given["actions"]), given["joint_pos_target"], atol=1e-5)
    # an action for a joint that the robot lacks is 0, and every joint of the robot has one
    mine = [int(column) for column in words(said["action_columns"])]
    assert not np.delete(given["actions"], mine).any()
    assert len(set(mine)) == len(words(said["action_joint_names"])) == len(words(said["joint_names"]))


@pytest.mark.parametrize(("policy", "robot"), CASES)
def test_the_metadata_define_the_observation(folders, policy, robot):
    _, said = session_of(folders / policy, robot)
    slots = words(said["action_names"])
    overrides = [
        "observations.enable_noise=false",
        "events.base_com.enabled=false",
        "events.add_base_mass.enabled=false",
    ]
    sim = polypod.VecSim(
        ROBOTS[policy][2], 4, robots=[robot], seed=2, threads=1, overrides=overrides, slots=slots, autoreset="disabled"
    )
    action = np.random.default_rng(1).normal(scale=0.3, size=(4, len(slots))).astype(np.float32)
    action *= sim.action_mask
    sim.step(action)
    sim.step(action)
    for env in range(4):
        qpos, qvel = sim.qpos(robot)[env], sim.qvel(robot)[env]
        w, x, y, z = qpos[3:7]
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        measured = {
            "velocity": turn.T @ qvel[:3],
            "angular_velocity": qvel[3:6],
            "gravity": turn.T @ [0.0, 0.0, -1.0],
            "command": sim.command[env],
            "joint_pos": qpos[7:],
            "joint_vel": qvel[6:],
            "last_action": action[env],
        }
        np.testing.assert_allclose(observation_of(said, measured), sim.observation[env], atol=1e-4)


@pytest.mark.parametrize(("policy", "robot"), CASES)
def test_limits_and_gains_are_in_the_order_of_the_joints(folders, policy, robot):
    _, said = session_of(folders / policy, robot)
    joints = len(words(said["joint_names"]))
    lower, upper, pose = (numbers(said[key]) for key in ("joint_pos_lower", "joint_pos_upper", "default_joint_pos"))
    assert (lower <= pose).all()
    assert (pose <= upper).all()
    robot = polypod.Simulation(robot)
    order = [robot.joint_names.index(joint) for joint in words(said["joint_names"])]
    np.testing.assert_allclose(np.asarray(robot.default_qpos).reshape(-1)[7:][order], pose, atol=1e-6)
    for key in ("joint_stiffness", "joint_damping", "joint_effort_limit", "joint_signs", "action_scale"):
        assert len(numbers(said[key])) == joints, key
    low, high = np.array([pair.split(":") for pair in words(said["command_ranges"])], dtype=np.float64).T
    assert (low <= high).all()
    assert (low < high).any()


def test_the_manifest_defines_the_targets_too(folders):
    session, _ = session_of(folders / "masked", "cassie")
    manifest = json.loads((folders / "masked" / "policy_cassie.json").read_text())
    info = manifest["robot_info"]["cassie"]
    feeds = {i.name: np.full((1, i.shape[1]), 0.3, dtype=np.float32) for i in session.get_inputs()}
    targets, actions = (values[0] for values in session.run(["joint_pos_target", "actions"], feeds))
    found = np.array(info["default_pose"])
    for joint, sign, column in zip(info["joint_of_slot"], info["slot_signs"], info["columns"], strict=True):
        found[joint] += info["action_scale"] * sign * actions[column]
    np.testing.assert_allclose(found, targets, atol=1e-5)
    (described,) = [tensor for tensor in manifest["inputs"] if tensor["name"] == "last_action"]
    assert described["columns"] == manifest["canonical_joint_names"]


def test_columns_of_terms_that_remember():
    terms = [
        Term(term="leaning", size=4, kind="per_joint", history_length=2),
        Term(term="speed", size=3, kind="vector"),
        Term(term="numbers", size=4, kind="per_joint"),
        Term(term="warmth", size=1),
    ]
    assert metadata.observation_columns(terms, ["A", "B"]) == [
        *("leaning.A[-1]", "leaning.B[-1]", "leaning.A[0]", "leaning.B[0]"),
        *("speed.x", "speed.y", "speed.z"),
        *("numbers.A.0", "numbers.B.0", "numbers.A.1", "numbers.B.1"),
        "warmth",
    ]


def test_a_name_that_a_list_would_not_give_back_is_refused():
    with pytest.raises(polypod.ConfigError, match="'knee,left' holds a comma"):
        metadata._list(["hip", "knee,left"])
