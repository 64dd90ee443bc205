"""The two engines stand, respond and hold together alike, and what `polypod accuracy` tells of them is so."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from polypod import _core
from polypod.accuracy import engines, robot, standing
from polypod.training.config import tomllib

ROBOT = "unitree_go2"


@pytest.fixture(scope="module")
def both() -> engines.Engines:
    return engines.compare_engines(robot.load(ROBOT))


def test_both_engines_stand_alike(both: engines.Engines) -> None:
    for engine in (both.articulated, both.avian):
        assert engine.force == pytest.approx(1.0, abs=2e-3)
        assert engine.height > 0.8 * robot.load(ROBOT).base_height
    assert both.avian.height == pytest.approx(both.articulated.height, abs=1e-3)
    assert both.avian.pitch == pytest.approx(both.articulated.pitch, abs=2e-3)
    assert both.torque_difference < 0.03
    assert np.abs(both.articulated.torque).max() > 1.0


def test_joints_do_not_come_apart(both: engines.Engines) -> None:
    assert both.articulated.drift == 0.0
    assert 0.0 < both.avian.drift < 1e-3


def test_both_engines_answer_a_jump_like_mujoco(both: engines.Engines) -> None:
    for engine in (both.articulated, both.avian):
        assert 0.0 < engine.response_rms < engine.response_max < 5e-3


def test_the_largest_step_is_the_last_at_which_it_stands(both: engines.Engines) -> None:
    for engine in (both.articulated, both.avian):
        assert engine.largest_step >= 0.005
        place = engines.STEPS.index(engine.largest_step)
        for larger in engines.STEPS[place + 1 : place + 2]:
            assert not engines.stands(robot.load(ROBOT), engine.engine, larger)


def test_a_robot_without_gains_does_not_stand() -> None:
    limp = robot.load(ROBOT).with_gains(0.02)
    assert not any(engines.stands(limp, engine, 0.005) for engine in ("articulated", "avian"))


def test_the_articulated_engine_is_the_faster_one(both: engines.Engines) -> None:
    assert both.articulated.steps_per_second > 5.0 * both.avian.steps_per_second > 0.0


def test_torques_are_compared_with_the_largest() -> None:
    one = engines.Engine("articulated", 0.3, 0.0, 1.0, np.array([1.0, -10.0]), 0.0, 0.0, 0.0, 0.0, 0.0)
    other = dataclasses.replace(one, torque=np.array([1.5, -10.0]))
    assert engines.Engines("any", one, other).torque_difference == pytest.approx(0.05)


@pytest.mark.parametrize("name", robot.names())
def test_torques_agree_where_they_are_determined(name: str, tmp_path: Path) -> None:
    """Within 3 %, without dry friction: a joint at rest may hold any torque within its friction."""
    sim = _core.VecSim("velocity_flat_play", 1, robots=[name], threads=1)
    groups = tomllib.loads(sim.resolved_config())["robots"][name]["actuators"]
    config = tmp_path / f"{name}.toml"
    tables = "".join(f"[actuators.{group}]\nfriction = 0.0\n" for group in groups)
    config.write_text(f'extends = "{name}"\nname = "{name}"\ntitle = "without friction"\n{tables}')
    known = robot.load(name)
    torques = {}
    for engine in ("articulated", "avian"):
        simulation = _core.Simulation(config, engine=engine, friction=0.8, self_collision=False, threads=1)
        simulation.set_state(standing.pose(known, 0.0))
        simulation.step(targets=known.default_position, n=2000)
        torques[engine] = simulation.joint_torque[0]
    largest = np.abs(torques["articulated"]).max()
    assert largest > 1.0
    assert np.abs(torques["avian"] - torques["articulated"]).max() < 0.03 * largest
