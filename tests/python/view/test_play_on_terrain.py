"""Generated terrain is drawn where the simulator puts it, and robots stand on it."""

import itertools

import numpy as np
import pytest

import polypod.cli
from common import ROUGH_POLICY
from polypod.play import Player, picture, render, viewer
from polypod.render import mesh, raster, relief
from polypod.render.camera import Camera, Lens

# one row of ten columns: every type of tile
SMALL = ("scene.terrain.num_rows=1", "scene.terrain.border_width=2.0", "scene.terrain.difficulty_range=[0.3, 0.3]")
SIZE = (320, 180)


@pytest.fixture(scope="module")
def player():
    """Spot once on each column; it has walked off the platform in the middle and stands."""
    player = Player(ROUGH_POLICY, ["spot"], (0.6, 0.0, 0.0), envs_per_robot=10, threads=1, overrides=SMALL)
    for _ in range(150):
        player.step()
    player.command((0.0, 0.0, 0.0))
    for _ in range(75):
        player.step()
    return player


def drawn_heights(ground, places):
    """Height of the highest drawn face over each place [n, 2].

    Faces count, not the simulator's grid.
    """
    corners, _, normals = ground.around(np.append(places.mean(axis=0), 0.0), 1.5)
    corners = corners[np.abs(normals[:, 2]) > 0.05]
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    a, b, c = (triangles[:, i] for i in range(3))
    ab, ac = (b - a)[:, :2], (c - a)[:, :2]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    whole = np.abs(area) > 1e-9
    a, b, c, ab, ac, area = (x[whole] for x in (a, b, c, ab, ac, area))
    at = places[:, None] - a[None, :, :2]
    u = (at[..., 0] * ac[:, 1] - at[..., 1] * ac[:, 0]) / area
    v = (ab[:, 0] * at[..., 1] - ab[:, 1] * at[..., 0]) / area
    inside = (u > -1e-4) & (v > -1e-4) & (u + v < 1.0 + 1e-4)
    height = a[:, 2] + u * (b - a)[:, 2] + v * (c - a)[:, 2]
    return np.where(inside, height, -np.inf).max(axis=1)


def test_every_robot_has_a_tile_of_its_own(player):
    frame = player.frame()
    tiles = {robot.tile for robot in frame.robots}
    names = (
        "pyramid_stairs",
        "pyramid_stairs_inv",
        "boxes",
        "random_rough",
        "hf_pyramid_slope",
        "hf_pyramid_slope_inv",
    )
    assert tiles == {f"{name}, level 0" for name in names}
    for one, other in itertools.combinations(frame.robots, 2):
        assert np.linalg.norm(one.place - other.place) > 7.9
    origins = player.sim.env_origins()
    assert origins.shape == (10, 3)
    assert origins[:, 2] == pytest.approx(player.ground.heights(origins[:, :2]), abs=1e-6)
    assert np.ptp(origins[:, 2]) > 0.5, "platforms of stairs are high, those of pits are low"


def test_the_terrain_is_the_simulators(player):
    """The same as `polypod terrain` draws for the same overrides."""
    from polypod import _core

    shown = player.sim.terrain()
    alone = _core.terrain(player.sim.task_name, list(SMALL))
    for key in ("heights", "vertices", "triangles"):
        assert np.array_equal(shown[key], alone[key])
    assert shown["tiles"] == alone["tiles"]
    assert _core.VecSim("velocity_flat", 1, robots=["spot"], seed=0, threads=1).terrain() is None


def test_feet_touch_the_drawn_ground_on_every_type_of_tile(player):
    """Within 6 mm.

    At a wall, which the simulator has as a slope of one cell (2.5 cm), of either of its sides.
    """
    frame = player.frame()
    assert len(frame.robots) == 10
    forces = np.linalg.norm(player.sim.contact_forces("spot"), axis=2)
    cell = 0.025
    offsets = np.array([[x, y] for x in (-cell, 0.0, cell) for y in (-cell, 0.0, cell)])
    for robot, loads in zip(frame.robots, forces, strict=True):
        loaded = 0
        for foot in (part for part in player.parts[robot.name] if part.group == "foot"):
            points = foot.mesh.moved(robot.position[foot.link], robot.quaternion[foot.link]).vertices
            places = (points[:, None, :2] + offsets).reshape(-1, 2)
            heights = drawn_heights(player.ground, places).reshape(len(points), -1)
            assert (points[:, 2] - heights.min(axis=1)).min() > -0.006, robot.tile
            if loads[foot.body] > 5.0:
                loaded += 1
                assert (points[:, 2] - heights.max(axis=1)).min() < 0.006, robot.tile
        assert loaded >= 2, robot.tile


def test_ground_hides_solids_and_solids_hide_ground(player):
    """A block behind a pyramid of stairs is seen from its own side only, one above it from both."""
    assert player.frame().robots[0].tile.startswith("pyramid_stairs,")
    x, y, top = player.sim.env_origins()[0]
    assert top > 0.5
    block = mesh.box((0.2, 0.2, 0.2))

    def seen(side, height):
        camera = Camera((x + 3.9 * side, y, 0.3), (x, y, 0.3), field_of_view=60.0)
        solids = [(block.moved((x + 3.5, y, height), (1.0, 0.0, 0.0, 0.0)), (250, 0, 250))]
        if side > 0.0:
            camera = Camera((x + 6.0, y, 0.5), (x, y, 0.3), field_of_view=60.0)
        lens = Lens(camera, SIZE)
        pixels = relief.picture(lens, player.ground, camera.target, solids, [], raster.LIGHT, raster.SKY).astype(int)
        return int(((pixels[..., 0] > 120) & (pixels[..., 1] < 20)).sum())

    assert seen(1.0, 0.1) > 50
    assert seen(-1.0, 0.1) == 0
    assert seen(1.0, 1.5) > 50
    assert seen(-1.0, 1.5) > 12, "7.4 m away its edges are 4 pixels long"


def test_the_camera_sees_each_robot(player):
    """No hill stands between them, also in a pit."""
    frame = player.frame()
    for robot in frame.robots:
        camera = raster.follow_one(player, robot, SIZE)
        sight = np.linspace(np.array(camera.position), robot.position[0], 60)
        assert (sight[:, 2] > player.ground.heights(sight[:, :2])).all(), robot.tile


def test_shadows_lie_on_the_ground(player, monkeypatch):
    frame = player.frame()
    robot = frame.robots[9]
    camera = raster.follow_one(player, robot, SIZE)
    lit = np.asarray(render(player, frame, camera, SIZE, caption="")).astype(int)
    monkeypatch.setattr(relief, "SHADED", 1.0)
    without = np.asarray(render(player, frame, camera, SIZE, caption="")).astype(int)
    darker = (without - lit).sum(axis=2) > 60
    assert darker.sum() > 100
    assert not ((lit - without) > 8).any()


def test_all_robots_share_a_picture_in_fields(player):
    image = np.asarray(picture(player, player.frame(), SIZE))
    assert image.shape == (180, 320, 3)
    columns, rows = raster.fields(10, SIZE)
    assert columns * rows >= 10
    for count in range(1, 40):
        columns, rows = raster.fields(count, SIZE)
        assert columns * rows >= count > (rows - 1) * columns


def test_the_viewers_mesh_is_the_terrain(player):
    import io

    trimesh = pytest.importorskip("trimesh")
    data = viewer.terrain_glb(player.ground)
    (mesh,) = trimesh.load(io.BytesIO(data), file_type="glb", process=False).geometry.values()
    assert len(mesh.faces) == len(player.ground.triangles)
    assert np.allclose(mesh.bounds, [player.ground.vertices.min(axis=0), player.ground.vertices.max(axis=0)])


def test_a_film_and_a_recording_of_a_rough_policy(tmp_path, capsys):
    import msgspec
    import zstandard
    from PIL import Image

    film, recording = tmp_path / "film.gif", tmp_path / "run.viser"
    changes = [argument for change in SMALL for argument in ("--set", change)]
    arguments = ("play", "--checkpoint", str(ROUGH_POLICY), "--robots", "spot,unitree_a1", "--seconds", "0.2", *changes)
    files = ("--fps", "10", "--size", "160", "90", "--video", str(film), "--record", str(recording), "--port", "8930")
    assert polypod.cli.main([*arguments, *files]) == 0
    assert str(film) in capsys.readouterr().out
    with Image.open(film) as animation:
        assert animation.n_frames == 2
    assert recording.stat().st_size < 10e6
    data = zstandard.ZstdDecompressor().decompressobj().decompress(recording.read_bytes()[8:])
    scene = msgspec.msgpack.decode(data[8 : 8 + int.from_bytes(data[:8], "little")])
    messages = [message for _, message in scene["messages"]]
    (ground,) = (message for message in messages if message.get("name") == "/world/ground" and "props" in message)
    assert ground["type"] == "GlbMessage"
