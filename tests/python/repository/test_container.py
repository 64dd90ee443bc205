"""A build can follow the container file: all that it names exists.

The test needs no engine.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from common import ROOT
from polypod.compat import tomllib

INSTRUCTIONS = {"FROM", "RUN", "COPY", "ENV", "ARG", "WORKDIR", "USER", "ENTRYPOINT", "CMD"}


def instructions():
    """Pairs of instruction and arguments, lines joined."""
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    joined = re.sub(r"^#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ")
    return [tuple(line.split(None, 1)) for line in joined.splitlines() if line.strip()]


def ignored():
    return [
        line
        for line in (ROOT / ".containerignore").read_text(encoding="utf-8").splitlines()
        if line and not line.startswith("#")
    ]


def test_instructions_are_known_and_bases_have_digests():
    assert {name for name, _ in instructions()} <= INSTRUCTIONS
    assert [arguments.split()[0] for name, arguments in instructions() if name == "FROM"] == ["${PYTHON}"] * 2
    (base,) = re.findall(r"^ARG PYTHON=(.*)$", (ROOT / "Containerfile").read_text(encoding="utf-8"), re.MULTILINE)
    assert re.fullmatch(r"docker\.io/library/python:3\.\d+\.\d+-slim-\w+@sha256:[0-9a-f]{64}", base)


def test_what_is_downloaded_is_compared_with_a_hash_before_it_runs():
    downloads = [arguments for name, arguments in instructions() if name == "RUN" and re.search(r"curl -", arguments)]
    assert len(downloads) == 1
    for arguments in downloads:
        assert not re.search(r"\| *(ba)?sh\b", arguments)
        file = re.search(r"--output (\S+)", arguments)[1]
        compared, run = arguments.index("sha256sum --check"), arguments.index(f"&& {file} ")
        assert arguments.index("curl -") < compared < run
        assert len(re.findall(r"sha256=[0-9a-f]{64} ;;", arguments)) == 2


def test_what_is_copied_exists():
    for name, arguments in instructions():
        if name == "COPY":
            *sources, _ = shlex.split(arguments)
            assert all((ROOT / source).exists() for source in sources), arguments


def test_nothing_that_is_built_of_is_ignored():
    """Members of the workspace, targets of cargo and what maturin packs."""
    manifest = tomllib.loads((ROOT / "Cargo.toml").read_text(encoding="utf-8"))
    needed = ["Cargo.lock", "rust-toolchain.toml", "README.md", "pyproject.toml", "uv.lock", ".ci/locked.awk"]
    needed += ["python/polypod"]
    needed += manifest["workspace"]["members"]
    targets = [target for kind in ("test", "bench", "example") for target in manifest.get(kind, [])]
    needed += [target["path"] for target in targets if "path" in target]
    needed += ["python/polypod/policies/flat_universal", "python/polypod/_core.pyi", "configs", "assets/robots"]
    for path in needed:
        assert (ROOT / path).exists(), path
        for pattern in ignored():
            top = pattern.removeprefix("**/")
            assert path != top, pattern
            assert not path.startswith(f"{top}/"), pattern


def test_the_lock_names_the_torch_that_is_installed():
    """One for the Python of the image, without the hashes of PyPI's files."""
    (script,) = re.findall(r"sed -nE '(/\^torch==.*?)'", (ROOT / "Containerfile").read_text(encoding="utf-8"))
    (export,) = re.findall(r"uv (export .*?) > locked.txt", " ".join(map(" ".join, instructions())))
    command = [Path(sys.executable).with_name("uv"), *export.split()]
    locked = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    command = ["sed", "-nE", script]
    lines = subprocess.run(command, input=locked, capture_output=True, text=True, check=True).stdout.splitlines()
    found = [re.fullmatch(r"torch==\d+\.\d+\.\d+ ; (python_full_version (?:<|>=) '3\.11')", line) for line in lines]
    assert sorted(match[1] for match in found) == ["python_full_version < '3.11'", "python_full_version >= '3.11'"]


def test_it_runs_the_program_as_no_root():
    last = dict(instructions())
    assert last["USER"] == "polypod"
    assert last["ENTRYPOINT"] == '["polypod"]'


@pytest.mark.parametrize("extra", ["train", "play", "export", "bench"])
def test_all_is_all(extra):
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    (everything,) = extras["all"]
    assert extra in re.findall(r"\w+", everything)
