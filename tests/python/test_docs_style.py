"""The pages stay light: bounds on their bytes, their lines and the README's length."""

import re
import subprocess
from pathlib import Path

import pytest
import torch

from common import FLAT_POLICY, LEGGED_POLICY, ROUGH_POLICY

ROOT = Path(__file__).resolve().parents[2]
PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    *sorted(page.relative_to(ROOT).as_posix() for page in ROOT.glob("docs/**/*.md")),
)
MOST_BYTES = 3_000_000
MOST_PROSE = 200
"""Lines of text of a page, without its tables and its code."""
UNWRAPPED = re.compile(r"\||#|!\[|<!--|\[[^\]]+\]: ")
"""How lines begin that cannot be wrapped: tables, headings, pictures, marks and addresses of
links."""


def prose(page: str) -> list[tuple[int, str]]:
    """Number and text of the lines that can be wrapped."""
    lines, is_code = [], False
    for number, line in enumerate((ROOT / page).read_text(encoding="utf-8").splitlines(), start=1):
        if line.lstrip().startswith("```"):
            is_code = not is_code
        elif not is_code and not UNWRAPPED.match(line):
            lines.append((number, line))
    return lines


@pytest.mark.parametrize("page", PAGES)
def test_pages_are_short(page):
    assert len([line for _, line in prose(page) if line.strip()]) <= MOST_PROSE


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_the_docs_are_light():
    listed = subprocess.run(
        ["git", "ls-files", "-z", "docs"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=30
    )
    if listed.returncode != 0:
        pytest.skip("no git checkout")
    sizes = {name: (ROOT / name).stat().st_size for name in listed.stdout.split("\0") if (ROOT / name).is_file()}
    assert sum(sizes.values()) <= MOST_BYTES, sorted(sizes, key=sizes.__getitem__)[-5:]


@pytest.mark.parametrize("checkpoint", [FLAT_POLICY, ROUGH_POLICY, LEGGED_POLICY], ids=lambda path: path.parent.name)
def test_bundled_policies_hold_weights_only(checkpoint):
    """No optimiser and no simulator: what `eval`, `play`, `export`, `sim2sim` and `--init` read."""
    state = torch.load(checkpoint, weights_only=True)
    assert state.keys() - {"critic_state_dict"} == {"actor_state_dict", "iter", "infos"}
    assert not state["infos"]
    weights = [*state["actor_state_dict"].values(), *state.get("critic_state_dict", {}).values()]
    assert checkpoint.stat().st_size <= 1.1 * sum(tensor.nbytes for tensor in weights) + 20_000
