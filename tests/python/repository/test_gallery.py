"""The gallery has a row for every shipped task and train config, and no other."""

import re
import subprocess
import sys

from common import ROOT

PAGE = ROOT / "docs" / "gallery.md"


def test_the_page_is_what_the_configs_say():
    line = [sys.executable, str(ROOT / "tools" / "gallery.py"), "--check"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_every_config_has_a_row():
    """Read from the page itself, so that a config that the generator leaves out is seen."""
    rows = re.findall(r"^\| `(\w+)` \|", PAGE.read_text(), re.MULTILINE)
    watched = re.findall(r"\| `(\w+_play)` \|$", PAGE.read_text(), re.MULTILINE)
    shipped = sorted(path.stem for folder in ("tasks", "train") for path in (ROOT / "configs" / folder).glob("*.toml"))
    assert sorted([*rows, *watched]) == shipped
