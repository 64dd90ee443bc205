"""Heights of a user's picture or array are the ground that robots stand on, holes included."""

import numpy as np
import pytest
from PIL import Image

import polypod
from polypod import ConfigError, height_fields
from polypod.cli import main


def ground(task, places):
    """Heights below places (x, y) about the origin of an env, m."""
    env = polypod.make(str(task), 1, robots=["unitree_go2"], threads=1)
    heights = env.sim.terrain()
    cell, origin = heights["cell"], heights["origin"]
    return [heights["heights"][tuple(np.rint((np.array(place) - origin) / cell).astype(int))] for place in places]


@pytest.fixture
def stairs():
    """[x, y]: rises along x, has a hole of 20 cm at the smallest x and y."""
    heights = np.repeat(np.linspace(0.0, 0.2, 41)[:, None], 21, axis=1)
    heights[:5, :5] = -0.2
    return heights


def test_an_array_is_the_ground(tmp_path, stairs, capsys):
    np.save(tmp_path / "field.npy", stairs)
    task = tmp_path / "my_field.toml"
    line = ["terrain", "--heights", str(tmp_path / "field.npy"), "--cell", "0.1", "--out", str(task)]
    assert main(line) == 0
    assert "4.00 x 2.00 m, heights from -0.200 to 0.200 m" in capsys.readouterr().out
    # the middle of the field is the origin of the env: x from -2 to 2, y from -1 to 1
    found = ground(task, [(1.9, 0.0), (0.0, 0.0), (-1.0, 0.5), (-1.9, -0.9), (-1.9, 0.9)])
    assert found == pytest.approx([0.195, 0.1, 0.05, -0.2, 0.005], abs=2e-3)
    env = polypod.make(str(task), 4, robots=["unitree_go2"], threads=1)
    assert env.sim.task_name == "My-Field-v0"
    env.reset(seed=0)


@pytest.mark.parametrize(("mode", "most"), [("L", 255), ("I;16", 65535)])
def test_a_picture_lies_as_it_is_seen(tmp_path, mode, most):
    """Pixels lie with x to the right and y upwards: the white corner has the largest x and y."""
    grey = np.zeros((5, 9), np.uint8 if mode == "L" else np.uint16)
    grey[0, 8] = most
    grey[4, 0] = most // 2
    Image.fromarray(grey).save(tmp_path / "map.png")
    heights = height_fields.read(tmp_path / "map.png", (-0.1, 0.3))
    assert heights.shape == (9, 5)
    assert heights[8, 4] == pytest.approx(0.3)
    assert heights[0, 0] == pytest.approx(0.1, abs=1e-3)
    assert heights[4, 2] == pytest.approx(-0.1)


def refused(tmp_path, name, content, *options):
    path = tmp_path / name
    path.write_bytes(content)
    return main(["terrain", "--heights", str(path), "--out", str(tmp_path / "t.toml"), *options])


def npy(tmp_path, array):
    np.save(tmp_path / "made.npy", array, allow_pickle=True)
    return (tmp_path / "made.npy").read_bytes()


def test_bad_files_are_refused_by_name(tmp_path, capsys):
    bad = [
        ("x.npy", b"no array", (), "no array of NumPy's"),
        ("x.npy", npy(tmp_path, np.array([{"a": 1}], object)), (), "no array of NumPy's"),
        ("x.npy", npy(tmp_path, np.zeros(5)), (), "5 numbers are no table"),
        ("x.npy", npy(tmp_path, np.zeros((1, 5))), (), "1 x 5 numbers are no table"),
        ("x.npy", npy(tmp_path, np.array([["a", "b"]])), (), "holds no numbers"),
        ("x.npy", npy(tmp_path, np.array([[0.0, np.nan], [0.0, 0.0]])), (), "height [0, 1] is nan"),
        ("x.npy", npy(tmp_path, np.zeros((400, 400))), (), "160,000 heights are more than 100,000"),
        ("x.npy", npy(tmp_path, np.zeros((2, 2))), ("--range", "0", "1"), "leave out --range"),
        ("x.npy", npy(tmp_path, np.zeros((2, 2))), ("--cell", "0"), "--cell 0.0"),
        ("x.png", b"no picture", ("--range", "0", "1"), "is no PNG"),
        ("x.png", b"no picture", (), "add --range LOW HIGH"),
        ("x.png", b"", ("--range", "1", "0"), "black must be lower than white"),
        ("x.txt", b"", (), "heights come as .npy or .png"),
    ]
    Image.new("RGB", (4, 4)).save(tmp_path / "colour.png")
    bad.append(("x.png", (tmp_path / "colour.png").read_bytes(), ("--range", "0", "1"), "save it in grey"))
    for name, content, options, said in bad:
        assert refused(tmp_path, name, content, *options) == 2, said
        assert said in capsys.readouterr().err
    assert not (tmp_path / "t.toml").exists()
    assert main(["terrain", "--range", "0", "1", "--out", str(tmp_path / "x.png")]) == 2
    assert "--heights" in capsys.readouterr().err


def test_a_task_of_another_folder_is_extended(tmp_path, monkeypatch, stairs):
    """Paths of `extends` are relative to the file that has them."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "base.toml").write_text('extends = "velocity_flat"\nname = "Base-v0"\n[sim]\ndt = 0.004\n')
    (tmp_path / "out").mkdir()
    height_fields.write_task(tmp_path / "out" / "mine.toml", stairs, 0.1, "base.toml")
    env = polypod.make(str(tmp_path / "out" / "mine.toml"), 1, robots=["unitree_go2"], threads=1)
    assert env.sim.step_dt == pytest.approx(4 * 0.004)


def test_a_negative_zero_and_digits_are_plain(tmp_path):
    height_fields.write_task(tmp_path / "t.toml", np.array([[-0.0, 1 / 3], [0.0, 2e-5]]), 0.5, "velocity_flat")
    text = (tmp_path / "t.toml").read_text()
    assert "[0.0000, 0.3333]" in text
    assert "size = [0.5, 0.5]" in text
    with pytest.raises(ConfigError, match=r"use \.toml"):
        height_fields.write_task(tmp_path / "t.txt", np.zeros((2, 2)), 0.5, "velocity_flat")


def test_files_become_levels_of_tiles(tmp_path, capsys):
    """A level for each file, or levels by a factor; both engines' ground has them."""
    x = np.linspace(-1.0, 1.0, 41)[:, None] * np.ones(41)
    for name, heights in {"a.npy": 0.1 * np.abs(x), "b.npy": 0.3 * np.abs(x)}.items():
        np.save(tmp_path / name, heights)
    grey = np.full((41, 41), 128, np.uint8)
    Image.fromarray(grey).save(tmp_path / "c.png")
    task = tmp_path / "levels.toml"
    files = [str(tmp_path / name) for name in ("a.npy", "b.npy", "c.png")]
    line = ["terrain", "--heights", *files, "--range", "-0.51", "0.0", "--cell", "0.1", "--tiles", "--out", str(task)]
    assert main(line) == 0
    assert "4.00 x 4.00 m, heights from -0.254 to 0.300 m" in capsys.readouterr().out
    env = polypod.make(str(task), 4, robots=["unitree_go2"], threads=1)
    terrain = env.sim.terrain()
    assert [(row, column) for row, column, _, _ in terrain["tiles"]] == [(r, c) for r in range(3) for c in range(4)]
    for row, column, _, middle in terrain["tiles"]:
        found = []
        for place in ((-1.9, 0.3), (1.5, -1.0), (0.2, 0.2)):
            at = np.rint((np.array(middle) + place - terrain["origin"]) / terrain["cell"]).astype(int)
            found.append(float(terrain["heights"][tuple(at)]))
        slope = (0.1, 0.3, None)[row]
        expected = [-0.254] * 3 if slope is None else [slope * 0.95, slope * 0.75, slope * np.abs(x[15:26]).mean()]
        assert found == pytest.approx(expected, abs=2e-3), (row, column)
    env.reset(seed=0)
    # one file at ten scales
    line = ["terrain", "--heights", files[0], "--cell", "0.1", "--tiles", "--scale", "0.0", "2.0", "--out", str(task)]
    assert main([*line, "--platform", "0"]) == 0
    terrain = polypod.make(str(task), 1, robots=["unitree_go2"], threads=1).sim.terrain()
    peaks = []
    for _, column, _, middle in terrain["tiles"]:
        if column == 0:
            place = np.add(middle, (-1.9, 0.3))
            at = np.rint((place - terrain["origin"]) / terrain["cell"]).astype(int)
            peaks.append(float(terrain["heights"][tuple(at)]) / 0.095)
    assert len(peaks) == 10
    assert all(0.2 * level <= peak <= 0.2 * (level + 1) + 1e-3 for level, peak in enumerate(peaks)), peaks


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["a.npy", "b.npy"], "add --tiles"),
        (["a.npy", "b.npy", "--tiles"], "make all of one size"),
        (["a.npy", "--scale", "0", "1"], "add --tiles"),
        (["a.npy", "--tiles", "--platform", "0", "--scale", "1", "0"], "the easiest level's factor comes first"),
        (["a.npy", "--tiles", "--platform", "9"], "--platform 9.0"),
    ],
)
def test_levels_that_are_none_are_refused(tmp_path, monkeypatch, capsys, options, said):
    monkeypatch.chdir(tmp_path)
    np.save("a.npy", np.zeros((5, 5)))
    np.save("b.npy", np.zeros((5, 6)))
    assert main(["terrain", "--out", "t.toml", "--heights", *options]) == 2
    assert said in capsys.readouterr().err
    assert main(["terrain", "--tiles", "--out", "t.toml"]) == 2
    assert "--heights" in capsys.readouterr().err
