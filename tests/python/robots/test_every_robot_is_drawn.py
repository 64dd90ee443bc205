"""Every robot of the library can be drawn: all groups of its bodies have a colour."""

import json

import numpy as np

from polypod import _core
from polypod.play import Frame, Scene, looks
from polypod.render import raster

SIZE = (48, 36)
NAMES = [entry["name"] for entry in _core.robots()]


def test_there_is_a_small_picture_of_every_robot():
    """Each from nearby; without the robot, the picture would be the empty ground's."""
    sim = _core.VecSim("velocity_flat_legged_play", len(NAMES), robots=NAMES, threads=1)
    scene = Scene(sim, 3.0)
    frame = scene.frame()
    assert [robot.name for robot in frame.robots] == NAMES
    for robot in frame.robots:
        camera = raster.follow_one(scene, robot, SIZE)
        shown, empty = (
            np.asarray(raster.render(scene, Frame(0.0, robots), camera, SIZE, caption="")).astype(int)
            for robots in ([robot], [])
        )
        assert (np.abs(shown - empty).max(axis=2) > 40).mean() > 0.02, robot.name


def test_every_group_of_bodies_has_a_colour_of_its_own():
    sim = _core.VecSim("velocity_flat_legged_play", len(NAMES), robots=NAMES, threads=1)
    shapes = json.loads(sim.robot_shapes())
    groups = {body["group"] for robot in shapes.values() for body in robot["bodies"]}
    assert {"torso", "arm"} <= groups
    assert groups <= set(raster.COLORS)
    assert groups <= {*looks.BODY, "thigh"}
    assert raster.color_of("tail") == raster.COLORS["other"]


def test_a_humanoid_renders_and_films(tmp_path, capsys):
    import polypod.cli
    from common import LEGGED_POLICY

    env = polypod.make("velocity_flat_legged", 1, robots=["unitree_g1"], render_mode="rgb_array", seed=0)
    env.reset()
    (picture,) = env.render()
    assert picture.shape == (360, 640, 3)
    film = tmp_path / "g1.webp"
    line = ["play", "--checkpoint", str(LEGGED_POLICY), "--robots", "unitree_g1", "--seconds", "0.2"]
    assert polypod.cli.main([*line, "--video", str(film), "--size", "64", "48"]) == 0
    assert film.stat().st_size > 0
    capsys.readouterr()


def test_a_long_film_tells_how_far_it_is(tmp_path, capsys, monkeypatch):
    from PIL import Image

    from polypod.render import film

    monkeypatch.setattr(film, "INTERVAL", 0.0)
    frames = film.Film(tmp_path / "x.gif", 10, (16, 16), 0.2)
    for _ in range(2):
        frames.add(Image.new("RGB", (16, 16)))
    assert capsys.readouterr().err == "x.gif: frame 1 of 2\nx.gif: frame 2 of 2\n"
    monkeypatch.setattr(film, "INTERVAL", 1e9)
    frames.add(Image.new("RGB", (16, 16)))
    frames.close()
    assert capsys.readouterr().err == ""
