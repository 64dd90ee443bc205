"""docs/task.md names files, keys, functions and tests that exist.

The tables of terms are those of the code.
"""

import json
import re
from functools import cache
from pathlib import Path

import pytest

from common import ROOT
from polypod import _core
from polypod.compat import tomllib

PAGE = (ROOT / "docs" / "task.md").read_text(encoding="utf-8")
FILES = r"(?:src|systems|configs|tests|python)/[\w/.]+\.(?:rs|py|toml)"
NAMED = sorted(set(re.findall(rf"`({FILES})(?:::([\w.]+))?`", PAGE)))


@cache
def text(file):
    return (ROOT / file).read_text(encoding="utf-8")


@cache
def table(file):
    found = tomllib.loads(text(file))
    if "extends" not in found:
        return found
    below = {}
    for base in [found["extends"]] if isinstance(found["extends"], str) else found["extends"]:
        below = merged(below, table(f"{Path(file).parent}/{base}.toml"))
    return merged(below, found)


def merged(below, above):
    both = dict(below)
    for key, value in above.items():
        both[key] = merged(both[key], value) if isinstance(value, dict) and isinstance(both.get(key), dict) else value
    return both


def has_key(file, path):
    at = table(file)
    for key in path.split("."):
        if isinstance(at, list):
            at = {entry["term"]: entry for entry in at}
        if key not in at:
            return False
        at = at[key]
    return True


@pytest.mark.parametrize(("file", "name"), NAMED, ids=lambda part: part.rpartition("/")[2] or "file")
def test_what_is_named_exists(file, name):
    assert (ROOT / file).is_file()
    if not name:
        return
    if file.endswith(".toml"):
        assert has_key(file, name)
    else:
        keyword = "fn" if file.endswith(".rs") else "def"
        assert re.search(rf"\b{keyword} {name}\b", text(file))


def test_every_row_names_code_and_a_test():
    """Each table with a column `test` fills it.

    The reward tables share the tests that stand above them.
    """
    rows = 0
    header = None
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else None
        if cells is None:
            header = None
        elif header is None:
            header = cells
        elif "where" in header and not set(line) <= set("|- "):
            rows += 1
            assert re.search(FILES, cells[header.index("where")]), line
            assert "test" not in header or "tests/" in cells[header.index("test")], line
    assert rows > 80
    assert len(NAMED) > 120


def test_every_term_of_the_flat_task_has_a_row():
    task = tomllib.loads(text("configs/tasks/velocity_flat.toml"))
    terms = {entry["term"] for entry in task["observations"]["policy"]}
    terms |= {*task["terminations"], *task["events"]}
    terms |= {term for rewards in task["rewards"].values() for term in rewards}
    # the two reset events have a row for each quantity that they draw
    assert {term for term in terms if f"| `{term}`" not in PAGE} == {"reset_base", "reset_joints"}


def test_the_table_of_observation_terms_is_what_they_state():
    page = (ROOT / "docs" / "write-a-term.md").read_text(encoding="utf-8")
    specs = json.loads(_core.observation_specs())
    rows = []
    for term, spec in specs.items():
        cells = [f"`{term}`", f"`{spec['kind']}`", spec["units"], f"`{spec['source']}`", spec["description"]]
        rows.append("|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|")
    found = [line for line in page.splitlines() if re.match(r"\| `\w+` \|(?: [^|]*\|){4}$", line)]
    assert found == rows
    assert {term for term in specs if f"| `{term}` (" not in PAGE} == {
        # they have separate tables
        "joint_descriptors",
        "morphology",
    }
