"""`polypod terrain` saves what the simulator stands on."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from polypod import _core, cli

SMALL = [
    *("--set", "scene.terrain.num_rows=2"),
    *("--set", "scene.terrain.num_cols=3"),
    *("--set", "scene.terrain.border_width=1.0"),
]


def saved(tmp_path: Path, suffix: str, *arguments: str) -> Path:
    out = tmp_path / f"terrain{suffix}"
    assert cli.main(["terrain", "--out", str(out), *(arguments or SMALL)]) == 0
    return out


def test_a_picture_shows_the_ground(tmp_path: Path) -> None:
    with Image.open(saved(tmp_path, ".png")) as image:
        # x to the right, y upwards: 2 tiles by 3
        assert 1.3 < image.height / image.width < 1.6
        assert len(image.getcolors(1 << 24)) > 50


def test_the_mesh_is_the_ground(tmp_path: Path) -> None:
    data = saved(tmp_path, ".stl").read_bytes()
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets = np.frombuffer(data, facet, offset=84)
    assert int(np.frombuffer(data, "<u4", 1, offset=80)[0]) == len(facets) > 1000
    corners = facets["corners"].reshape(-1, 3)
    assert corners[:, 0].max() == pytest.approx(9.0)
    assert corners[:, 1].max() == pytest.approx(13.0)
    ground = _core.terrain("velocity_rough", [value for value in SMALL if "=" in value])
    assert corners[:, 2].max() == pytest.approx(float(ground["heights"].max()), abs=1e-4)
    assert corners[:, 2].min() == pytest.approx(float(ground["heights"].min()), abs=1e-4)
    # surfaces to stand on look up
    assert (facets["normal"][:, 2] > -1e-5).all()


def test_heights_are_those_of_the_simulator(tmp_path: Path) -> None:
    with np.load(saved(tmp_path, ".npz")) as saved_heights:
        ground = _core.terrain("velocity_rough", [value for value in SMALL if "=" in value])
        assert np.array_equal(saved_heights["heights"], ground["heights"])
        assert float(saved_heights["cell"]) == pytest.approx(0.025)
    assert len(ground["tiles"]) == 6


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--out", "t.bmp"], "suffix"),
        (["--out", "t.png", "--task", "velocity_flat"], "plane"),
        (["--out", "t.stl", "--task", "velocity_obstacles"], ".npz"),
        (["--out", "/proc/none/t.png", *SMALL], "--out"),
    ],
)
def test_mistakes_get_one_line(arguments: list[str], word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["terrain", *arguments]) == 2
    err = capsys.readouterr().err
    assert word in err
    assert err.count("\n") == 1
