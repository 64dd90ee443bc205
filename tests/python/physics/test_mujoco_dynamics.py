"""Every robot has MuJoCo's dynamics at random states.

Masses, kinematics, inertia, bias forces and accelerations.
"""

import functools
import math
from xml.etree import ElementTree

import numpy as np
import pytest

from common import size
from polypod.accuracy.bounds import exceeded
from polypod.accuracy.statics import compare_statics
from polypod.add.root import rooted
from polypod.mujoco_model import reference
from polypod.mujoco_model.robot import load, names


@pytest.mark.parametrize("name", names())
def test_f32_agrees_within_the_bound(name: str) -> None:
    assert not exceeded(compare_statics(load(name), states=size(200, 2000)))


def test_f64_agrees_to_rounding() -> None:
    # the rest is no error of the formulas: inertias and poses are stated to ten digits in the URDF
    assert compare_statics(load("anymal_c"), states=20, dtype="float64").worst() < 1e-9


@pytest.mark.parametrize(
    "origins",
    [['xyz="0 0 0.3"'], ['xyz="0.1 -0.2 0.3" rpy="0.4 -0.7 2.0"', 'rpy="0 0 1.5"']],
    ids=["footprint", "chain"],
)
def test_a_robot_below_an_empty_root_has_the_same_twin(origins):
    """MuJoCo's free joint is then that of the base, as polypod's is."""
    plain = load("unitree_go2")
    names = [f"empty_{index}" for index in range(len(origins))]
    root = ElementTree.fromstring(plain.urdf).find("link").get("name")
    above = "".join(
        f'<link name="{name}"/><joint name="j_{name}" type="fixed"><origin {origin}/><parent link="{name}"/>'
        f'<child link="{child}"/></joint>'
        for name, child, origin in zip(names, [*names[1:], root], origins, strict=True)
    )
    at = plain.urdf.index("<link")
    text = plain.urdf[:at] + above + plain.urdf[at:]
    twins = [
        reference.Reference(urdf, joint_names=plain.joint_names, dt=0.005) for urdf in (plain.urdf, rooted(text, root))
    ]
    assert rooted(plain.urdf, root) is plain.urdf
    assert [twin.root for twin in twins] == [root, root]
    rng = np.random.default_rng(0)
    qpos = np.concatenate([[0.1, 0.2, 1.0, 0.8, 0.0, 0.6, 0.0], rng.uniform(-0.5, 0.5, len(plain.joint_names))])
    for twin in twins:
        twin.set_state(qpos)
    np.testing.assert_allclose(twins[0].mass_matrix(), twins[1].mass_matrix(), atol=1e-12)
    # the frames of the file are where they were: the root is above the base by the inverse of the
    # chain
    data, model = twins[1].data, twins[1].model
    top = model.body(names[0]).id
    expected = np.linalg.inv(functools.reduce(np.matmul, map(pose, origins)))
    base = model.body(root).id
    turn = data.xmat[base].reshape(3, 3)
    np.testing.assert_allclose(turn.T @ (data.xpos[top] - data.xpos[base]), expected[:3, 3], atol=1e-12)
    np.testing.assert_allclose(turn.T @ data.xmat[top].reshape(3, 3), expected[:3, :3], atol=1e-12)


def pose(origin):
    """[4, 4] of the attributes of an `<origin>`."""
    attributes = ElementTree.fromstring(f"<origin {origin}/>")
    x, y, z = (float(number) for number in attributes.get("xyz", "0 0 0").split())
    roll, pitch, yaw = (float(number) for number in attributes.get("rpy", "0 0 0").split())
    about = {
        "x": lambda c, s: [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": lambda c, s: [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": lambda c, s: [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    x_turn, y_turn, z_turn = (
        np.array(about[axis](math.cos(angle), math.sin(angle)))
        for axis, angle in zip("xyz", (roll, pitch, yaw), strict=True)
    )
    out = np.eye(4)
    out[:3, :3] = z_turn @ y_turn @ x_turn
    out[:3, 3] = x, y, z
    return out
