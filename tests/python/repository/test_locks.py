"""Installations have the packages of the lock, to the hash.

The locks of all workspaces name the same versions.
"""

import functools
import hashlib
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from common import ROOT
from polypod.compat import tomllib

EXPORT = ["--frozen", "--quiet", "--no-emit-project", "--no-default-groups", "--no-annotate", "--no-header"]
ENVIRONMENTS = {
    ".venv": ["--extra", "all", "--group", "dev"],
    "target/learners": ["--extra", "all", "--extra", "ray", "--extra", "learners", "--group", "tests"],
    "target/docs": ["--only-group", "docs"],
}
"""Entries of the lock that the Makefile takes for each."""
ENTRY = re.compile(r"^([a-z0-9][\w.-]*)==(\S+?)(?: ; [^\n\\]*)? \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)")


@functools.cache
def exported(*arguments: str) -> str:
    """Requirements of the lock, as the Makefile exports them."""
    uv = Path(sys.executable).with_name("uv")
    command = [uv, "export", *EXPORT, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def packages() -> list[dict[str, Any]]:
    return list(tomllib.loads((ROOT / "uv.lock").read_text(encoding="utf-8"))["package"])


def entries(text: str) -> Iterator[str]:
    """The entries of a lock: a line and the indented ones below it."""
    for entry in re.split(r"^(?=\S)", text, flags=re.MULTILINE):
        if entry.strip() and not entry.startswith("#"):
            yield entry


def show(shell: str, folder: Path) -> str:
    """Output of a recipe of the Makefile, with `folder` in place of .venv."""
    command = ["make", "--no-print-directory", "-s", "-C", ROOT, f"VENV={folder}", f"--eval=show: ; @{shell}", "show"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_every_entry_has_hashes(environment):
    found = list(entries(exported(*ENVIRONMENTS[environment])))
    assert len(found) > 30
    assert [entry.split("\n")[0] for entry in found if not ENTRY.match(entry)] == []


def test_the_makefile_exports_these():
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert f"EXPORT := $(BIN)/uv export {' '.join(EXPORT)}\n" in text
    used = re.findall(r"\$\(EXPORT\) (.*?) [|>]", text)
    assert used == [" ".join(arguments) for arguments in ENVIRONMENTS.values()]


def test_the_lock_names_no_mirror():
    """It is written on machines with another index, and read on all."""
    text = (ROOT / "uv.lock").read_text(encoding="utf-8")
    assert set(re.findall(r'registry = "([^"]+)"', text)) == {"https://pypi.org/simple"}
    urls = re.findall(r'url = "([^"]+)"', text)
    assert len(urls) > 1000
    assert [url for url in urls if not url.startswith("https://files.pythonhosted.org/packages/")] == []


def test_the_lock_is_that_of_pyproject():
    """A requirement that was added without `make lock` would not be installed."""
    tables = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project, groups = tables["project"], tables["dependency-groups"]
    extras = [line for lines in project["optional-dependencies"].values() for line in lines]
    (ours,) = [package["metadata"] for package in packages() if package["name"] == "polypod"]
    of_groups = [line for lines in groups.values() for line in lines if isinstance(line, str)]
    for wanted, locked in (
        ([*project["dependencies"], *extras], ours["requires-dist"]),
        (of_groups, [entry for entries in ours["requires-dev"].values() for entry in entries]),
    ):
        needed = {(found.name.lower().replace("_", "-"), str(found.specifier)) for found in map(Requirement, wanted)}
        known = {(entry["name"], str(Requirement(f"x{entry.get('specifier', '')}").specifier)) for entry in locked}
        assert known == needed


def test_the_learners_have_the_torch_of_the_others():
    pattern = re.compile(r"^(?:torch|triton|numpy|mujoco|rsl-rl-lib)==.*$", re.MULTILINE)
    found = [pattern.findall(exported(*ENVIRONMENTS[name])) for name in (".venv", "target/learners")]
    assert len(found[0]) >= 5
    assert found[0] == found[1]


def test_every_installation_checks_them():
    """In the Makefile and in the container; torch alone comes from a separate index there."""
    for file in ("Makefile", "Containerfile"):
        text = re.sub(r"^#.*\n", "", (ROOT / file).read_text(encoding="utf-8"), flags=re.MULTILINE)
        lines = [part for line in text.replace("\\\n", " ").splitlines() for part in line.split("&&")]
        installs = [line.strip() for line in lines if re.search(r"\bpip install\b", line)]
        assert len(installs) >= 3
        loose = [line for line in installs if not re.search(r"--(require|verify)-hashes", line)]
        assert [line for line in loose if "--index-url" not in line or "torch.txt" not in line] == [], file
    lines = (ROOT / "Makefile").read_text(encoding="utf-8").splitlines()
    used = [line for line in lines if line.startswith("\t$(INSTALL)")]
    assert len(used) == 4
    assert "-m pip install --quiet --no-deps --require-hashes" in (ROOT / ".ci" / "torch").read_text(encoding="utf-8")


def test_the_base_torch_is_left_out_with_its_hashes(tmp_path):
    """No line of a left out entry stays.

    A hash without its package would belong to the package above it.
    """
    lock = exported(*ENVIRONMENTS[".venv"])
    (tmp_path / "all.txt").write_text(lock, encoding="utf-8")
    shell = f"cat {tmp_path / 'all.txt'} | {{ $(without_base_torch); }}"
    assert show(shell, tmp_path) == lock
    (tmp_path / ".base-torch").touch()
    left = show(shell, tmp_path)
    ours = re.compile(r"(torch|triton)==|nvidia-|cuda-")
    assert any(ours.match(entry) for entry in entries(lock))
    assert list(entries(left)) == [entry for entry in entries(lock) if not ours.match(entry)]


@pytest.mark.parametrize("package", ["uv", "maturin"])
def test_one_package_is_taken_whole(package):
    """With the hashes of all files, for pip, before there is a uv."""
    command = ["awk", "-v", f"package={package}", "-f", ".ci/locked.awk", "uv.lock"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    (entry,) = (entry for entry in entries(exported(*ENVIRONMENTS[".venv"])) if entry.startswith(f"{package}=="))
    assert sorted(found.split()) == sorted(entry.replace("\\\n", "").split())


@pytest.fixture
def index(tmp_path):
    """A folder with the wheel of a package, and its SHA-256."""
    wheel = tmp_path / "index" / "sound-1.0-py3-none-any.whl"
    wheel.parent.mkdir()
    with zipfile.ZipFile(wheel, "w") as file:
        file.writestr("sound.py", "")
        file.writestr("sound-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: sound\nVersion: 1.0\n")
        tag = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        file.writestr("sound-1.0.dist-info/WHEEL", tag)
        file.writestr("sound-1.0.dist-info/RECORD", "")
    return wheel.parent, hashlib.sha256(wheel.read_bytes()).hexdigest()


@pytest.mark.parametrize("kind", ["sound", "flipped", "missing"])
def test_a_file_of_another_hash_is_refused(tmp_path, index, kind):
    folder, digest = index
    flipped = f"{int(digest[0], 16) ^ 1:x}{digest[1:]}"
    hashes = {"sound": f" --hash=sha256:{digest}", "flipped": f" --hash=sha256:{flipped}", "missing": ""}
    lock = tmp_path / "some.lock"
    lock.write_text(f"sound==1.0{hashes[kind]}\n")
    command = show("echo $(INSTALL)", ROOT / ".venv").split()
    if not Path(command[0]).is_file():
        pytest.skip("needs the environment of make build")
    options = ["--offline", "--no-index", "--find-links", folder, "--target", tmp_path / "into", "--no-cache"]
    done = subprocess.run(
        [*command, "--python", sys.executable, *options, "--requirement", lock], capture_output=True, text=True
    )
    assert (done.returncode == 0) == (kind == "sound"), done.stderr
    assert (tmp_path / "into" / "sound.py").exists() == (kind == "sound")


@pytest.mark.parametrize("other", ["fuzz/Cargo.lock"])
def test_workspaces_apart_have_the_same_versions(other):
    """Else `--locked` refuses the lock, or the fuzz targets run other code than what is shipped."""
    ours, theirs = (
        {(package["name"], package["version"]): package.get("dependencies", []) for package in tables["package"]}
        for tables in (tomllib.loads((ROOT / path).read_text(encoding="utf-8")) for path in ("Cargo.lock", other))
    )
    names = {name for name, _ in ours}
    assert sorted(package for package in theirs.keys() - ours.keys() if package[0] in names) == []
    members = [package for package in theirs if package[0].startswith("polypod") and package in ours]
    assert len(members) >= 3
    manifests = [tomllib.loads(path.read_text(encoding="utf-8")) for path in ROOT.glob("crates/**/Cargo.toml")]
    manifests.append(tomllib.loads((ROOT / "Cargo.toml").read_text(encoding="utf-8")))
    of_tests = {
        manifest["package"]["name"]: manifest.get("dev-dependencies", {}).keys()
        - manifest.get("dependencies", {}).keys()
        for manifest in manifests
    }
    for package in members:
        left_out = {*of_tests[package[0]], "workspace-hack"}
        wanted = {line.split()[0] for line in ours[package]} - left_out
        assert {line.split()[0] for line in theirs[package]} - left_out == wanted
