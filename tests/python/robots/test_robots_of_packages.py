"""Robots of other packages' MJCF and URDF files move as MuJoCo's models of them.

The core tier reads what gymnasium brings along, which polypod needs anyway; the extended tier reads
every package that is installed. `lab/added_robots.py` says which packages there are and writes
docs/added-robots.md.
"""

import pytest

from common import size
from lab.added_robots import PACKAGES, files, row
from polypod.add import judge

FILES = list(files(size({"gymnasium": PACKAGES["gymnasium"]}, PACKAGES)))
REFUSED = {
    "half_cheetah": "its base moves on the joints rootx, rootz, rooty",
    "hopper": "its base moves on the joints rootx, rootz, rooty",
    "walker2d": "its base moves on the joints rootx, rootz, rooty",
    "walker2d_v5": "its base moves on the joints rootx, rootz, rooty",
}
"""Files of gymnasium that are no robot on a floating base."""


def test_there_is_something_to_read():
    assert {file.stem for package, _, file in FILES if package == "gymnasium"} >= {"ant", "humanoid", *REFUSED}


@pytest.mark.parametrize(
    ("package", "folder", "file"), FILES, ids=[f"{package}-{file.stem}" for package, _, file in FILES]
)
def test_a_robot_is_refused_with_a_reason_or_moves_as_in_mujoco(package, folder, file):
    read = row(package, folder, file)
    if package == "gymnasium":
        assert (read.refused == "") == (file.stem not in REFUSED), read.refused
        assert REFUSED.get(file.stem, "") in read.refused
        assert read.kind == {"ant": "quadruped", "humanoid": "humanoid", "humanoidstandup": "humanoid"}.get(
            file.stem, ""
        )
        assert read.errors or read.refused
    if read.refused:
        # for what it is, not because it moves differently
        assert "differs from MuJoCo" not in read.refused
        return
    for dtype, error in read.errors.items():
        assert error <= judge.BOUNDS[dtype], (dtype, error)
    assert read.errors or any("not compared with MuJoCo" in note for note in read.notes)
