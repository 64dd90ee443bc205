"""All names in the workflows exist: paths, targets, packages, filters, jobs, commands."""

import itertools
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from common import ROOT
from polypod.compat import tomllib

WORKFLOWS = sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob(".github/workflows/*.yml"))
PYTHONS = ["3.10", "3.11", "3.12", "3.13", "3.14"]

PATH = re.compile(r"(?<![\w./$-])((?:[\w.-]+/)*[\w-]+\.(?:rs|py|toml|lock|md|yml|txt)|(?:[\w-]+/)+[\w.-]*)")
"""Words of a comment, a name or a script that are files of the repository or paths in it."""
NOT_OF_THE_REPOSITORY = ("actions/", "venv/", "target/", "dist/", "whl/", "bin/", "CPU/")
"""Beginnings of what looks like a path and is an action, an output or an address."""
WRITTEN = {"miri.log"}


def text_of(workflow: str) -> str:
    return (ROOT / workflow).read_text(encoding="utf-8")


def jobs_of(workflow: str) -> dict[str, Any]:
    return dict(YAML(typ="safe").load(text_of(workflow))["jobs"])


def steps() -> Iterator[tuple[str, dict[str, Any]]]:
    """Pairs of a place's name and a step."""
    for workflow in WORKFLOWS:
        for job, tables in jobs_of(workflow).items():
            for step in tables["steps"]:
                yield f"{workflow}: {job}: {step.get('name') or step.get('uses') or step['run']}", step


def commands() -> Iterator[tuple[str, list[str]]]:
    """Pairs of a place's name and the words of a command in a script."""
    for place, step in steps():
        for line in step.get("run", "").replace("\\\n", " ").splitlines():
            for command in re.split(r"\||&&|;", line.partition("# ")[0]):
                if words := command.split():
                    yield place, words


def test_there_are_workflows():
    assert len(WORKFLOWS) >= 4
    assert len(list(steps())) > 30


@pytest.mark.parametrize("workflow", WORKFLOWS)
def test_every_path_exists(workflow):
    text = re.sub(r"uses: .*|https://\S+|\$\{\{.*?\}\}", "", text_of(workflow))
    named = {match[1] for match in PATH.finditer(text)}
    files = {path for path in named if not path.startswith(NOT_OF_THE_REPOSITORY)} - WRITTEN
    known = {path.name for path in ROOT.iterdir()} | {Path(workflow).name for workflow in WORKFLOWS}
    missing = sorted(path for path in files if path not in known and not (ROOT / path).exists())
    assert not missing, f"{workflow} names what the repository does not have: {missing}"


def test_every_script_exists():
    scripts = [(place, words[0]) for place, words in commands() if re.fullmatch(r"[\w.-]+/[\w./-]+", words[0])]
    assert len(scripts) >= 5
    assert [(place, script) for place, script in scripts if not os.access(ROOT / script, os.X_OK)] == []


def test_every_target_of_make_exists():
    targets = set(re.findall(r"^([a-z-]+):(?!=)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    called = [(place, words[1]) for place, words in commands() if words[0] == "make"]
    assert len(called) >= 5
    assert [(place, target) for place, target in called if target not in targets] == []


def test_every_part_of_the_tests_exists():
    """`make test ONLY=...` of a workflow names parts, and a part names files of tests."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    parts = set(re.findall(r"^\.test-(\w+):", makefile, re.MULTILINE))
    assert parts == {"rust", "python", "learners", "fuzz", "instructions"}
    called = [word.removeprefix("ONLY=") for _, words in commands() for word in words if word.startswith("ONLY=")]
    assert called
    assert set(called) <= parts
    (files,) = re.findall(r"\$\(addprefix (\S+),([^)]*)\)", makefile)
    assert [name for name in files[1].split() if not (ROOT / f"{files[0]}{name}").is_file()] == []
    assert [
        path
        for path in re.findall(r"\b(?:tests|fuzz)/[\w./-]+\b", makefile)
        if "test_" not in path and not (ROOT / path).exists()
    ] == []


def test_the_makefile_has_ten_targets():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    documented = set(re.findall(r"^([a-z-]+):.* ## ", makefile, re.MULTILINE)) - {"help"}
    (phony, _) = re.findall(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)
    assert documented == set(phony.split()) - {"help"}
    assert len(documented) == 10


def test_every_package_and_module_that_cargo_is_given_exists():
    """A filter that matches no test is no error of cargo: it would pass for ever."""
    members = tomllib.loads((ROOT / "Cargo.toml").read_text(encoding="utf-8"))["workspace"]["members"]
    manifests = [ROOT / "Cargo.toml", *(ROOT / member / "Cargo.toml" for member in members)]
    packages = {tomllib.loads(path.read_text(encoding="utf-8"))["package"]["name"] for path in manifests}
    filters = 0
    for place, words in commands():
        if words[0] != "cargo":
            continue
        for flag, value in itertools.pairwise(words):
            if flag in ("--package", "-p", "--exclude"):
                assert value in packages, f"{place}: no package {value}"
            if flag == "--manifest-path":
                assert (ROOT / value).is_file(), f"{place}: no file {value}"
        for word in words:
            if re.fullmatch(r"\w+(::\w*)+", word):
                modules = list((ROOT / "src").rglob(word.split("::")[0] + ".rs"))
                assert len(modules) == 1, f"{place}: the filter {word} names no module of src/"
                (module,) = modules
                assert "#[test]" in module.read_text(encoding="utf-8"), f"{place}: {module} has no unit tests"
                filters += 1
    assert filters == 1, "the thread team is checked under Miri"


def test_every_command_of_polypod_exists():
    import polypod.cli

    called = [(place, words[1]) for place, words in commands() if words[0] == "polypod"]
    assert len(called) >= 2
    known = {path.stem.replace("_", "-") for path in Path(polypod.cli.__file__).parent.glob("commands/*.py")}
    known |= set(re.findall(r'"([a-z0-9]+)"', Path(polypod.cli.__file__).read_text(encoding="utf-8")))
    assert [(place, command) for place, command in called if command not in known] == []


@pytest.mark.parametrize("workflow", WORKFLOWS)
def test_every_job_and_artifact_that_is_waited_for_exists(workflow):
    jobs = jobs_of(workflow)
    left, taken = set(), set()
    for tables in jobs.values():
        needs = tables.get("needs", [])
        assert set([needs] if isinstance(needs, str) else needs) <= jobs.keys()
        for step in tables["steps"]:
            if "upload-artifact" in step.get("uses", ""):
                left.add(step["with"]["name"].partition("$")[0])
            if "download-artifact" in step.get("uses", ""):
                taken.add(step["with"]["name"].partition("$")[0])
    assert taken <= left


@pytest.mark.parametrize("workflow", WORKFLOWS)
def test_actions_are_pinned_by_commit(workflow):
    """A tag can be moved to other code.

    A commit cannot. The comment is what Dependabot reads and moves.
    """
    used = re.findall(r"uses: *(.*)", text_of(workflow))
    loose = [action for action in used if not re.fullmatch(r"[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action)]
    assert used
    assert not loose, f"{workflow}: name a commit and its version: {loose}"


def test_an_action_has_one_commit():
    used = {line for workflow in WORKFLOWS for line in re.findall(r"uses: *(.*)", text_of(workflow))}
    actions = [line.partition("@")[0] for line in used]
    assert sorted(actions) == sorted(set(actions))


def test_no_checkout_leaves_its_token():
    checkouts = [(place, step) for place, step in steps() if "actions/checkout" in step.get("uses", "")]
    assert len(checkouts) >= 10
    assert [place for place, step in checkouts if step.get("with", {}).get("persist-credentials") is not False] == []


@pytest.mark.parametrize("workflow", WORKFLOWS)
def test_tokens_read_and_no_more(workflow):
    loaded = YAML(typ="safe").load(text_of(workflow))
    assert loaded["permissions"] == {"contents": "read"}
    assert "pull_request_target" not in loaded[True if True in loaded else "on"]
    assert all("permissions" not in job for job in loaded["jobs"].values())


def test_every_python_is_tested_and_tried():
    """The tests run on each version of Python that the package names.

    Each wheel is installed into each of them.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [found[1] for line in project["classifiers"] if (found := re.search(r"Python :: (3\.\d+)$", line))]
    assert named == PYTHONS
    assert project["requires-python"] == f">={PYTHONS[0]}"
    ci = jobs_of(".github/workflows/ci.yml")
    (tested,) = {step["with"]["python-version"] for step in ci["test"]["steps"] if "setup-python" in str(step)}
    assert sorted([tested, *ci["test-python"]["strategy"]["matrix"]["python"]], key=PYTHONS.index) == PYTHONS
    assert jobs_of(".github/workflows/wheels.yml")["smoke"]["strategy"]["matrix"]["python"] == PYTHONS


def test_wheels_are_built_by_the_maturin_of_the_lock():
    lock = tomllib.loads((ROOT / "uv.lock").read_text(encoding="utf-8"))
    (locked,) = (package["version"] for package in lock["package"] if package["name"] == "maturin")
    built = [step["with"]["maturin-version"] for _, step in steps() if "maturin-action" in step.get("uses", "")]
    assert built == [f"v{locked}"] * 2
