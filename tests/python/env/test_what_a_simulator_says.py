"""`polypod.simulated` reads all that a simulator says of its robots, with the types it states."""

import pytest

from polypod import _core, simulated


@pytest.mark.parametrize("task", ["velocity_flat_universal", "velocity_flat_legged", "velocity_rough_legged"])
def test_every_key_is_stated(task: str) -> None:
    sim = _core.VecSim(task, len(_core.task_robots(task)))
    found = simulated.robots(sim)
    assert found.keys() == set(sim.robots)
    stated = simulated.RobotInfo.__annotations__
    for info in found.values():
        assert set(stated) - {"actuator_networks", "held_joints"} <= set(info) <= set(stated)
        joints = len(info["joint_names"])
        for key in ("default_pose", "stiffness", "damping", "effort_limit", "velocity_limit", "lower", "upper"):
            assert len(info[key]) == joints
        for key in ("joint_of_slot", "slot_signs", "columns", "mirror"):
            assert len(info[key]) == len(info["slots"])
    assert set(simulated.config(sim)["robots"]) == set(found)
    assert set(simulated.shapes(sim)) == set(found)


def test_held_joints_are_those_that_the_task_does_not_drive() -> None:
    narrowed = ['actions.joint_pos.joint_names=["*_KNEE"]']
    (info,) = simulated.robots(
        _core.VecSim("velocity_flat_humanoid", 1, robots=["unitree_h1"], overrides=narrowed)
    ).values()
    (whole,) = simulated.robots(_core.VecSim("velocity_flat_humanoid", 1, robots=["unitree_h1"])).values()
    assert info["slots"] == ["L_KNEE", "R_KNEE"]
    assert info["mirror"] == [[1, 1.0], [0, 1.0]]
    assert set(info["held_joints"][0]) == set(simulated.HeldJoint.__annotations__)
    assert simulated.slot_of_joint(info) == simulated.slot_of_joint(whole)
