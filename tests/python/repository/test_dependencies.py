"""The crates of the dependency tree keep to deny.toml.

`cargo deny` checks it in full in the public workflow.
"""

import collections
import json
import re
import subprocess
from pathlib import Path
from typing import Any

from common import ROOT
from polypod.compat import tomllib

REGISTRY = "registry+https://github.com/rust-lang/crates.io-index"


def is_allowed(expression: str, allowed: list[str]) -> bool:
    """Whether an SPDX expression can be met by the licences in `allowed`.

    `/` is the older way to write `OR`.
    """
    words = re.findall(r"[()]|[^\s()]+(?: WITH [^\s()]+)?", expression.replace("/", " OR "))
    python = {"(": "(", ")": ")", "AND": "and", "OR": "or"}
    # nothing but True, False, and, or and parentheses is left
    return eval(" ".join(python.get(word, str(word in allowed)) for word in words))


def resolved() -> dict[str, Any]:
    """Cargo's metadata of the dependencies that this platform builds."""
    host = subprocess.run(["rustc", "--print=host-tuple"], capture_output=True, text=True, check=True).stdout.strip()
    command = ["cargo", "metadata", "--locked", "--offline", "--format-version=1", f"--filter-platform={host}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=60)
    return dict(json.loads(done.stdout))


def rules() -> dict[str, Any]:
    return tomllib.loads((ROOT / "deny.toml").read_text(encoding="utf-8"))


def test_licences_and_sources() -> None:
    packages = resolved()["packages"]
    assert len(packages) > 100
    allowed = rules()["licenses"]["allow"]
    assert [p["id"] for p in packages if not is_allowed(p["license"] or "none", allowed)] == []
    assert {p["source"] for p in packages} == {None, REGISTRY}
    own = [p for p in packages if p["source"] is None]
    assert [
        (p["name"], d["name"]) for p in own for d in p["dependencies"] if d["req"] == "*" and not d.get("path")
    ] == []


def test_every_second_version_has_a_reason() -> None:
    metadata = resolved()
    built = {node["id"] for node in metadata["resolve"]["nodes"]}
    versions = collections.defaultdict(set)
    for package in metadata["packages"]:
        if package["id"] in built:
            versions[package["name"]].add(package["version"])
    skipped = {skip["crate"]: skip["reason"] for skip in rules()["bans"]["skip"]}
    assert all(len(reason.split()) > 2 for reason in skipped.values())
    for name, found in versions.items():
        of_it = [version for version in found if not any(_is(name, version, crate) for crate in skipped)]
        assert len(of_it) <= 1, f"{name} {sorted(of_it)}: give deny.toml a reason for all but one"
    for crate in skipped:
        others = [
            name for name, found in versions.items() if len(found) > 1 and any(_is(name, v, crate) for v in found)
        ]
        assert others, f"{crate} of deny.toml has no second version any more"


def _is(name: str, version: str, crate: str) -> bool:
    """Whether a version is one that `crate`, such as `syn@2`, means."""
    wanted, _, prefix = crate.partition("@")
    return name == wanted and (version == prefix or version.startswith(f"{prefix}."))


def test_every_ignored_advisory_has_a_crate_and_a_reason() -> None:
    lock = tomllib.loads((ROOT / "Cargo.lock").read_text(encoding="utf-8"))
    names = {package["name"] for package in lock["package"]}
    for advisory in rules()["advisories"]["ignore"]:
        crate, _, reason = advisory["reason"].partition(" ")
        assert re.fullmatch(r"RUSTSEC-\d{4}-\d{4}", advisory["id"])
        assert crate in names, f"{advisory['id']}: {crate} is no dependency any more"
        assert len(reason.split()) > 5


def test_all_that_a_published_crate_needs_is_published() -> None:
    """Cargo asks the registry for each dependency with a version."""
    own = {package["name"]: package for package in resolved()["packages"] if package["source"] is None}
    published = {name for name, package in own.items() if package["publish"] is None}
    assert {"polypod", "polypod-dynamics", "polypod-cuda"} <= published
    needed = {
        (name, dep["name"], "no version" if dep["req"] == "*" else "version")
        for name in published
        for dep in own[name]["dependencies"]
        if dep["name"] in own and dep["kind"] != "dev"
    }
    assert [entry for entry in sorted(needed) if entry[1] not in published or entry[2] == "no version"] == []
    of_tests = {
        (name, dep["name"])
        for name in published
        for dep in own[name]["dependencies"]
        if dep["name"] in own and dep["kind"] == "dev" and dep["req"] != "*"
    }
    assert of_tests == set(), "a crate of the workspace that tests need is named by its path alone"


def crates_of(name: str) -> set[str]:
    """Folders in crates/ of a package of the workspace and of all that it is built from."""
    metadata = resolved()
    packages = {package["id"]: package for package in metadata["packages"]}
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    found, todo = set(), [package["id"] for package in packages.values() if package["name"] == name]
    while todo:
        package = todo.pop()
        if package in found or packages[package]["source"] is not None:
            continue
        found.add(package)
        kinds = {dep["pkg"]: {kind["kind"] for kind in dep["dep_kinds"]} for dep in nodes[package]["deps"]}
        todo += [dep for dep, of in kinds.items() if of - {"dev"}]
    folders = [Path(packages[package]["manifest_path"]).parent.relative_to(ROOT).as_posix() for package in found]
    return {folder for folder in folders if folder.startswith("crates/")}


def test_make_builds_again_after_a_change_in_any_crate() -> None:
    database = subprocess.run(["make", "-pn", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    [sources] = re.findall(r"^LIBRARY_SOURCES :?= (.*)$", database, re.MULTILINE)
    watched = {"/".join(source.split("/")[:2]) for source in sources.split()}
    crates = crates_of("polypod-python")
    assert {"crates/cuda", "crates/dynamics", "crates/lanes"} <= crates
    assert crates - watched == set()
