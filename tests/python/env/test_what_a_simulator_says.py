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
        assert set(stated) - {"actuator_networks"} <= set(info) <= set(stated)
        joints = len(info["joint_names"])
        for key in ("default_pose", "stiffness", "damping", "effort_limit", "velocity_limit", "lower", "upper"):
            assert len(info[key]) == joints
        for key in ("joint_of_slot", "slot_signs", "columns", "mirror"):
            assert len(info[key]) == len(info["slots"])
    assert set(simulated.config(sim)["robots"]) == set(found)
    assert set(simulated.shapes(sim)) == set(found)
