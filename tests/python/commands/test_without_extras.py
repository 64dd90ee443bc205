"""`pip install polypod` gives the env and the commands that run no policy.

The others name the extra that they need.
"""

import json
import os
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from common import ROOT
from polypod.compat import tomllib

SCRIPT = """
import contextlib, io, json, sys
import polypod
from polypod.__main__ import main
polypod.make("velocity_flat", num_envs=8).reset(seed=0)
ends = []
for words in json.load(sys.stdin):
    sys.argv[1:] = words
    with contextlib.redirect_stdout(io.StringIO()) as output, contextlib.redirect_stderr(io.StringIO()) as errors:
        code = main()
    ends.append((code, output.getvalue(), errors.getvalue()))
print(json.dumps(ends))
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder with polypod and the packages that an installation without extras brings."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "polypod").symlink_to(ROOT / "python" / "polypod")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    left, brought = list(project["dependencies"]), set()
    while left:
        requirement = Requirement(left.pop())
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        package = metadata.distribution(requirement.name)
        if package.name not in brought:
            brought.add(package.name)
            left += package.requires or []
            for name in {file.parts[0] for file in package.files or []} - {".."}:
                (folder / name).symlink_to(Path(str(package.locate_file(name))))
    assert brought >= {"gymnasium", "numpy", "tyro"}
    assert brought.isdisjoint({"torch", "rich", "msgspec"})
    return folder


COMMANDS = {
    ("--version",): (0, "polypod 0."),
    ("list", "robots"): (0, "spot"),
    ("info",): (0, "simd"),
    ("check", "dog.urdf"): (0, "12 joints"),
    ("robot", "new", "dog.urdf"): (0, "16 of 16 stand"),
    ("train",): (2, "pip install 'polypod[train]'"),
    ("eval", "--checkpoint", "flat"): (2, "pip install 'polypod[train]'"),
    ("play",): (2, "pip install 'polypod[train]'"),
    ("bench", "--learner"): (2, "pip install 'polypod[train]'"),
    ("bench", "--quick"): (2, "pip install 'polypod[bench]'"),
}
"""Exit code of each, and words that it prints."""


def test_commands_run_or_name_their_extra(site, tmp_path):
    shutil.copy(ROOT / "assets" / "robots" / "spot" / "robot.urdf", tmp_path / "dog.urdf")
    environment = {**os.environ, "PYTHONPATH": str(site)}
    command = [sys.executable, "-S", "-c", SCRIPT]
    given = json.dumps(list(COMMANDS))
    done = subprocess.run(command, input=given, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for (words, (code, shown)), (found, output, errors) in zip(COMMANDS.items(), json.loads(done.stdout), strict=True):
        assert found == code, f"{words}: {errors}"
        assert shown in (errors if code else output), words
        assert errors.count("\n") == (1 if code else 0), words
