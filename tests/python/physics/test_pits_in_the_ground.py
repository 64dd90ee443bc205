"""Heights below zero in a heightfield: what the simulator stands on is what pictures show."""

from typing import Any

import numpy as np
import pytest

import polypod
from polypod.render import mesh, raster
from polypod.render.camera import Camera, Lens
from polypod.render.scene import Scene

PIT = {"shape": "heightfield", "size": [4.0, 4.0], "position": [0.0, 0.0, 0.0], "heights": [[-1.0, -1.0], [-1.0, -1.0]]}


def make(obstacles: list[dict[str, Any]]) -> polypod.VectorEnv:
    return polypod.make(
        "velocity_flat",
        2,
        robots=["unitree_go2"],
        seed=1,
        overrides={
            "scene.obstacles": obstacles,
            "events.push_robot.enabled": False,
            "events.reset_base.x": [0, 0],
            "events.reset_base.y": [0, 0],
        },
    )


def test_heights_and_robots() -> None:
    env = make([PIT])
    env.reset()
    ground = env.sim.terrain()
    assert ground is not None
    assert ground["pits"] == [((-2.0, -2.0), (2.0, 2.0))]
    points = [ground["origin"][axis] + ground["cell"] * np.arange(ground["heights"].shape[axis]) for axis in (0, 1)]
    inside = np.ix_(*(np.abs(axis) < 1.99 for axis in points))
    assert (ground["heights"][inside] == -1.0).all()
    assert (ground["heights"][np.abs(points[0]) > 2.01] == 0.0).all()
    for _ in range(25):
        ended = env.step(np.zeros(env.action_space.shape, dtype=np.float32))[2]
    assert not ended.any()
    assert (np.abs(env.state.base_height - 0.3) < 0.1).all()
    assert (env.sim.qpos("unitree_go2")[:, 2] < -0.6).all()
    np.testing.assert_allclose(env.sim.env_origins()[:, 2], -1.0)


def test_a_field_below_the_ground_that_is_turned_is_refused() -> None:
    with pytest.raises(polypod.ConfigError, match=r"scene.obstacles\[0\]: it is turned.*leave out its rpy"):
        make([{**PIT, "rpy": [0.0, 0.1, 0.0]}])


def test_pictures_show_a_pit_through_its_opening_alone() -> None:
    env = make([PIT])
    env.reset()
    scene = Scene(env.sim)
    frame = scene.frame()
    openings = scene.openings(frame)
    assert len(openings) == 2
    middle = openings[0].mean(axis=0)
    camera = Camera((float(middle[0]) + 7.0, float(middle[1]), 2.0), (float(middle[0]), float(middle[1]), 0.0))
    size = (320, 240)
    pixels = np.asarray(raster.render(scene, frame, camera, size))
    lens = Lens(camera, size)

    def color(place: list[float]) -> tuple[int, ...]:
        (x, y), _ = lens.project(np.array(place))
        return tuple(int(value) for value in pixels[round(float(y)), round(float(x))])

    before = color([middle[0] + 2.4, middle[1] + 0.3, 0.0])
    assert before in raster.GROUND or before == raster.SHADOW
    within = color([middle[0] - 1.0, middle[1] + 1.0, 0.0])
    assert within not in raster.GROUND


def test_a_floor_leaves_out_its_openings() -> None:
    square = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [0.0, 2.0, 0.0]])
    for openings, area in (([], 400.0), ([square], 398.0), ([square, square + np.array([5.0, 0.5, 0.0])], 396.0)):
        floor = mesh.floor(openings, 10.0)
        corners = floor.vertices[floor.faces]
        assert np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])[:, 2].sum() / 2 == pytest.approx(
            area
        )
