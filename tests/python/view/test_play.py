"""A policy can be seen: as a film without a display, as a recording, and in the browser."""

import sys

import numpy as np
import pytest

import polypod
import polypod.cli
from common import FLAT_POLICY
from polypod.play import Player, render
from polypod.render import mesh, raster

PLAY = ("play", "--checkpoint", str(FLAT_POLICY))


def volume(solid):
    """By the divergence theorem: right only for a closed surface whose faces look outward."""
    corners = solid.vertices[solid.triangles()]
    return np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0


@pytest.mark.parametrize(
    ("description", "exact"),
    [
        ({"shape": "box", "size": [0.4, 0.1, 0.3]}, 0.012),
        ({"shape": "sphere", "radius": 0.5}, np.pi / 6.0),
        ({"shape": "cylinder", "radius": 0.5, "length": 2.0}, np.pi / 2.0),
        ({"shape": "capsule", "radius": 0.5, "length": 2.0}, np.pi / 2.0 + np.pi / 6.0),
        ({"shape": "ramp", "size": [2.0, 1.0, 0.5], "position": [1.0, 0.0, 0.0]}, 0.5),
        ({"shape": "stairs", "size": [0.5, 1.0, 0.2], "steps": 2, "position": [0.0, 1.0, 0.0], "rpy": [0, 0, 1]}, 0.3),
    ],
    ids=lambda value: value["shape"] if isinstance(value, dict) else "",
)
def test_meshes_are_closed_and_look_outward(description, exact):
    parts = mesh.obstacle({"position": [0.1, 0.2, 0.3], **description})
    found = sum(volume(part) for part in parts)
    tolerance = 0.13 if description["shape"] in ("sphere", "cylinder", "capsule") else 1e-9
    assert found == pytest.approx(exact, rel=tolerance)
    assert found <= exact * (1.0 + 1e-9)


def test_hulls_are_closed(tmp_path):
    """A mesh's hull comes with its faces."""
    points = [[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]
    triangles = [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2]]
    triangles += [[2, 4, 6], [1, 3, 5], [3, 7, 5]]
    assert abs(volume(mesh.shape({"shape": "hull", "points": points, "triangles": triangles}))) == pytest.approx(1.0)


def test_a_mesh_obstacle_is_drawn_where_it_stands():
    """Its triangles come from the resolved task; large ones are cut up and keep their surface."""
    corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    rows = f"vertices = {corners}, triangles = {faces}"
    scene = f'scene.obstacles=[{{ shape = "mesh", scale = [1.0, 2.0, 0.1], position = [2.0, 0.0, 0.0], {rows} }}]'
    player = Player(FLAT_POLICY, ["spot"], threads=1, overrides=[scene])
    (solid,) = player.obstacles
    assert volume(solid) == pytest.approx(1.0 * 2.0 * 0.1 / 6.0)
    np.testing.assert_allclose(solid.vertices.min(axis=0), [2.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(solid.vertices.max(axis=0), [3.0, 2.0, 0.1], atol=1e-12)
    edges = solid.vertices[solid.triangles()]
    assert np.linalg.norm(edges - np.roll(edges, 1, axis=1), axis=2).max() <= mesh.LARGEST_FACE + 1e-12


def test_shapes_stand_on_the_ground_where_the_simulator_has_them():
    """The lowest point of a standing robot touches the ground: shapes and poses match."""
    player = Player(FLAT_POLICY, ["unitree_go2", "spot"], command=(0.0, 0.0, 0.0), threads=1)
    for _ in range(75):
        player.step()
    carried: dict[str, list[float]] = {robot: [] for robot in player.sim.robots}
    for _ in range(100):
        player.step()
        for robot in player.frame().robots:
            lowest = min(
                part.mesh.moved(robot.position[part.link], robot.quaternion[part.link]).vertices[:, 2].min()
                for part in player.parts[robot.name]
            )
            assert -0.01 < lowest < 0.01
            assert len(robot.forces) >= 1
            for point, force in robot.forces:
                assert point[2] < 0.1
                assert force[2] > 0.0
            carried[robot.name].append(sum(force[2] for _, force in robot.forces) / robot.weight)
    # a policy may trot in place: the weight is what the ground carries on average
    for robot, shares in carried.items():
        assert np.mean(shares) == pytest.approx(1.0, abs=0.15), robot


def test_a_picture_shows_robots_shadows_and_commands():
    player = Player(FLAT_POLICY, ["spot"], command=(0.8, 0.0, 0.0), threads=1)
    for _ in range(20):
        player.step()
    frame = player.frame()
    size = (320, 180)
    picture = render(player, frame, raster.follow(player, frame, size), size)
    assert picture.size == size
    pixels = np.asarray(picture).reshape(-1, 3).astype(int)
    for color in (raster.SHADOW, raster.COMMAND, *raster.GROUND):
        assert (np.abs(pixels - color).max(axis=1) < 8).any(), color
    orange = (pixels[:, 0] > 140) & (pixels[:, 2] < 90)
    assert orange.sum() > 20, "the thighs"
    again = render(player, frame, raster.follow(player, frame, size), size)
    assert np.array_equal(np.asarray(picture), np.asarray(again))


@pytest.mark.parametrize("kind", ["gif", "webp", "mp4"])
def test_films(tmp_path, capsys, kind):
    film = tmp_path / f"film.{kind}"
    arguments = (*PLAY, "--robot", "unitree_a1", "--command", "0.5", "0", "0", "--seconds", "0.4", "--fps", "10")
    assert polypod.cli.main([*arguments, "--size", "160", "90", "--video", str(film)]) == 0
    assert str(film) in capsys.readouterr().out
    if kind == "mp4":
        import av

        with av.open(str(film)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    else:
        from PIL import Image, ImageSequence

        with Image.open(film) as animation:
            frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(animation)]
    assert len(frames) == 4
    assert frames[0].shape == (90, 160, 3)
    assert (frames[0] != frames[-1]).any()


def test_a_recording_holds_every_control_step(tmp_path):
    import msgspec
    import zstandard

    file = tmp_path / "run.viser"
    arguments = (*PLAY, "--robots", "spot", "--seconds", "0.2", "--record", str(file), "--port", "8900")
    assert polypod.cli.main(arguments) == 0
    # eight bytes of length come before the compressed part
    data = zstandard.ZstdDecompressor().decompressobj().decompress(file.read_bytes()[8:])
    recording = msgspec.msgpack.decode(data[8 : 8 + int.from_bytes(data[:8], "little")])
    assert recording["durationSeconds"] == pytest.approx(0.2)
    names = {message.get("name", "") for _, message in recording["messages"]}
    assert any(name.startswith("/world/0_spot/2/") for name in names)
    moves = {time for time, message in recording["messages"] if message.get("name") == "/world/0_spot"}
    assert len(moves) >= 10


def test_a_recording_as_a_page(tmp_path):
    file = tmp_path / "run.html"
    arguments = (*PLAY, "--robots", "spot", "--seconds", "0.04", "--record", str(file), "--port", "8910")
    assert polypod.cli.main(arguments) == 0
    assert "<html" in file.read_text()[:2000].lower()


def test_it_shows_what_the_evaluation_measures(capsys):
    """The play's errors are those of the simulator's own statistics."""
    player = Player(FLAT_POLICY, ["unitree_b2"], envs_per_robot=4, threads=1, overrides=["sim.episode_length_s=2.0"])
    player.sim.episode_stats()
    for _ in range(100):
        player.step()
    stats = player.sim.episode_stats()["unitree_b2"]
    assert stats["episodes"] == 4
    assert player.tallies["unitree_b2"].error_vel_xy == pytest.approx(stats["error_vel_xy"], rel=0.05)
    assert player.tallies["unitree_b2"].error_vel_yaw == pytest.approx(stats["error_vel_yaw"], rel=0.05)


def test_obstacles_are_shown():
    player = Player(FLAT_POLICY, ["spot"], task="velocity_obstacles", threads=1)
    assert len(player.obstacles) > 9
    size = (160, 90)
    frame = player.frame()
    pixels = np.asarray(render(player, frame, raster.follow(player, frame, size), size)).reshape(-1, 3).astype(int)
    brown = (pixels[:, 0] - pixels[:, 2] > 25) & (pixels[:, 0] > 90)
    assert brown.sum() > 50


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--video", "film.avi"), ".gif"),
        (("--video", "film.gif", "--fps", "0"), "--fps"),
        (("--video", "film.gif", "--size", "7", "9"), "--size"),
        (("--record", "run.rrd"), ".viser"),
        (("--headless", "--seconds", "-1"), "--seconds"),
        (("--headless", "--num-envs", "0"), "--num-envs"),
        (("--headless", "--task", "velocity_flat"), "48"),
    ],
)
def test_mistakes_get_one_line(capsys, arguments, message):
    assert polypod.cli.main([*PLAY, "--robots", "spot", *arguments]) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1


@pytest.mark.parametrize(("module", "arguments"), [("PIL.Image", ("--video", "film.gif")), ("viser", ())])
def test_the_missing_extra_is_named(monkeypatch, tmp_path, capsys, module, arguments):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    assert polypod.cli.main([*PLAY, "--robots", "spot", *arguments]) == 2
    assert "pip install 'polypod[play]'" in capsys.readouterr().err
