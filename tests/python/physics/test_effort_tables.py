"""An effort table is exact in its rows, linear in between, and never larger."""

import numpy as np
import pytest

import polypod
from common import ROOT


@pytest.fixture
def spot(tmp_path):
    """Writes a Spot with another effort table of its knees."""

    def write(rows):
        text = (ROOT / "configs/robots/spot.toml").read_text()
        start = text.index("effort_table = [")
        end = text.index("\n]", start) + 2
        path = tmp_path / "s.toml"
        text = text[:start] + f"effort_table = {rows}" + text[end:]
        path.write_text(text.replace('"assets', f'"{ROOT}/assets').replace('name = "spot"', 'name = "s"'))
        return str(path)

    return write


def efforts(path, angles, dtype="float64"):
    """Largest effort of a knee at each angle, N m."""
    sim = polypod.Simulation(path, len(angles), fixed_base=True, ground=None, gravity=(0, 0, 0), dtype=dtype)
    qpos = np.tile(sim.default_qpos, (len(angles), 1))
    (knee,) = (i for i, name in enumerate(sim.joint_names) if name == "front_left_knee" or name.endswith("fl_kn"))
    qpos[:, knee] = angles
    sim.set_state(qpos=qpos)
    sim.step(torque=1000.0)
    return sim.joint_torque[:, knee]


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(
    "rows",
    [
        [[-2.7, 10.0], [-1.7, 10.0], [-1.4, 30.0], [-0.3, 30.0]],
        [[-2.7, 10.0], [-2.6999, 90.0], [-0.3, 30.0]],
        [[-2.0, 5.0], [-1.9, 50.0], [-1.1, 20.0], [-1.09999, 40.0], [-0.4, 1.0]],
    ],
)
def test_rows_are_exact(spot, rows, dtype):
    corners = np.array(rows)
    middles = 0.5 * (corners[1:] + corners[:-1])
    found = efforts(spot(rows), corners[:, 0], dtype)
    np.testing.assert_allclose(found, corners[:, 1], rtol=0.02 if dtype == "float32" else 1e-6)
    found = efforts(spot(rows), middles[:, 0], dtype)
    np.testing.assert_allclose(found, middles[:, 1], rtol=0.02 if dtype == "float32" else 1e-2)


def test_beyond_its_ends_a_table_is_constant(spot):
    rows = [[-2.0, 10.0], [-1.0, 30.0]]
    np.testing.assert_allclose(efforts(spot(rows), np.array([-2.6, -0.4])), [10.0, 30.0], rtol=1e-6)
    np.testing.assert_allclose(efforts(spot([[-1.0, 17.0]]), np.array([-2.6, -0.4])), 17.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([[-2.7, 10.0], [-2.699999999, 20.0], [-0.3, 30.0]], "effort_table[1]"),
        ([[-2.7, 10.0], [-2.7, 20.0]], "effort_table[1]"),
        ([[900.0, 10.0], [900.00002, 20.0]], "effort_table[1]"),
        ([[-2.7, 10.0], [1e12, 20.0]], "effort_table[1]"),
        ([[-2.7, 1e39], [-1.0, 20.0]], "effort_table[0]"),
        ([[-2.7, 0.0], [-1.0, 0.0]], "every torque"),
        ([[i * 1e-3, 1.0] for i in range(5401)], "at most 5400"),
    ],
)
def test_a_table_that_single_precision_loses_is_refused(spot, rows, words):
    with pytest.raises(polypod.ConfigError, match="effort_table") as caught:
        polypod.Simulation(spot(rows), 1)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_limit_is_as_good_as_a_large_one(spot):
    sim = polypod.Simulation(spot([[-2.7, 0.0], [-1.0, 20.0]]), 1, fixed_base=True, ground=None, gravity=(0, 0, 0))
    sim.step(torque=100.0, effort_limit=np.inf)
    assert np.isfinite(sim.joint_torque).all()
    assert np.isfinite(sim.qpos).all()
