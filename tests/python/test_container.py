"""The container file is one that a build can follow: no engine is needed to see that what it names exists."""

import re
import shlex
from pathlib import Path

import pytest

from polypod.compat import tomllib

ROOT = Path(__file__).resolve().parents[2]
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


def test_instructions_are_known_and_bases_have_versions():
    assert {name for name, _ in instructions()} <= INSTRUCTIONS
    bases = [arguments.split()[0] for name, arguments in instructions() if name == "FROM"]
    assert len(bases) == 2
    for base in bases:
        assert re.fullmatch(r"docker\.io/library/python:3\.\d+-slim-\w+", base), base


def test_what_is_copied_exists():
    for name, arguments in instructions():
        if name == "COPY":
            *sources, _ = shlex.split(arguments)
            assert all((ROOT / source).exists() for source in sources), arguments


def test_nothing_that_is_built_of_is_ignored():
    """Members of the workspace, targets of cargo and what maturin packs."""
    manifest = tomllib.loads((ROOT / "Cargo.toml").read_text(encoding="utf-8"))
    needed = ["Cargo.lock", "rust-toolchain.toml", "README.md", "pyproject.toml", "requirements.lock", "python/polypod"]
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
    (sed,) = re.findall(r"sed -n \"s/(.*?)/\\1/p\"", (ROOT / "Containerfile").read_text(encoding="utf-8"))
    pattern = sed.replace(r"\(", "(").replace(r"\)", ")")
    found = [
        match[1]
        for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
        if (match := re.match(pattern, line))
    ]
    assert len(found) == 1
    assert re.fullmatch(r"torch==\d+\.\d+\.\d+", found[0])


def test_it_runs_the_program_as_no_root():
    last = dict(instructions())
    assert last["USER"] == "polypod"
    assert last["ENTRYPOINT"] == '["polypod"]'


@pytest.mark.parametrize("extra", ["train", "play", "export", "bench"])
def test_all_is_all(extra):
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    (everything,) = extras["all"]
    assert extra in re.findall(r"\w+", everything)
