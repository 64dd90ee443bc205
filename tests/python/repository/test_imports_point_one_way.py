"""Modules import from lower layers, in no cycle: `[tool.importlinter]` of pyproject.toml."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from common import ROOT


def lint(folder: Path) -> tuple[int, str]:
    """Exit code and output of `lint-imports` on the package in `folder`."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()", "--no-cache"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}
    config = ["--config", str(ROOT / "pyproject.toml")]
    done = subprocess.run([*command, *config], cwd=folder, env=environment, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("module", "line", "named"),
    [
        ("files", "from polypod.training import session", "polypod.files -> polypod.training.session"),
        ("new_module", "", "polypod.new_module"),
        ("cli", "from lab import results", "polypod.cli -> lab.results"),
        ("runs/schema", "from polypod.runs import config", ".schema -> .config"),
    ],
)
def test_a_wrong_direction_is_named(tmp_path, module, line, named):
    for package in (ROOT / "python" / "polypod", ROOT / "lab"):
        for file in package.rglob("*.py"):
            copy = tmp_path / package.name / file.relative_to(package)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, copy)
    assert lint(tmp_path)[0] == 0
    with (tmp_path / "polypod" / f"{module}.py").open("a", encoding="utf-8") as file:
        file.write(f"\n{line}\n")
    code, output = lint(tmp_path)
    assert code == 1
    assert named in output
