"""Pictures of many faces: few calls per solid, no polygon outside the picture, the same pixels."""

from typing import Any

import numpy as np
import pytest
from PIL import ImageDraw

import polypod
from polypod.render import raster
from polypod.render.camera import NEAR, Camera, Lens
from polypod.render.scene import Frame, Scene

SIZE = (160, 90)
NEAR_THE_ROBOT = Camera((2.0, 0.4, 0.8), (0.0, 0.0, 0.2))


def of_field(side: int, depth: float = 0.0) -> tuple[Scene, Frame]:
    """Two robots, each in the middle of a field of side x side heights on 8 x 8 m."""
    x = np.linspace(0.0, 8.0, side)
    heights = 0.05 + 0.05 * np.sin(3.0 * x)[:, None] * np.cos(2.0 * x) - depth
    field = {"shape": "heightfield", "size": [8.0, 8.0], "position": [0.0, 0.0, 0.0], "heights": heights.tolist()}
    env = polypod.make("velocity_flat", 2, robots=["unitree_go2"], seed=1, overrides={"scene.obstacles": [field]})
    env.reset()
    scene = Scene(env.sim)
    return scene, scene.frame()


def calls(scene: Scene, frame: Frame, monkeypatch: pytest.MonkeyPatch, owner: type, name: str) -> int:
    """Calls of a method during a picture."""
    count, method = 0, getattr(owner, name)

    def counted(*arguments: Any, **options: Any) -> Any:
        nonlocal count
        count += 1
        return method(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, counted)
        raster.render(scene, frame, NEAR_THE_ROBOT, SIZE)
    return count


def test_a_solid_is_projected_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse, fine = (calls(*of_field(side), monkeypatch, Lens, "project") for side in (9, 65))
    assert fine == coarse
    assert fine < 300


def test_polygons_outside_the_picture_are_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, frame = of_field(65)
    few = calls(scene, frame, monkeypatch, ImageDraw.ImageDraw, "polygon")
    monkeypatch.setattr(raster._Canvas, "_seen", before_the_camera)
    assert few < 0.5 * calls(scene, frame, monkeypatch, ImageDraw.ImageDraw, "polygon")


@pytest.mark.parametrize("depth", [0.0, 0.06, 0.5])
def test_pixels_are_those_of_all_polygons(monkeypatch: pytest.MonkeyPatch, depth: float) -> None:
    scene, frame = of_field(33, depth)
    for camera in (NEAR_THE_ROBOT, raster.follow(scene, frame, SIZE)):
        some = np.asarray(raster.render(scene, frame, camera, SIZE))
        with monkeypatch.context() as patch:
            patch.setattr(raster._Canvas, "_seen", before_the_camera)
            every = np.asarray(raster.render(scene, frame, camera, SIZE))
        np.testing.assert_array_equal(some, every)


def before_the_camera(canvas: Any, pixels: Any, depths: Any, part: Any = None) -> Any:
    """All polygons before the camera, in the picture or not."""
    return depths.min(axis=1) > NEAR
