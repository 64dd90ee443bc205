"""The crates of the dependency tree keep to deny.toml, which `cargo deny` checks in full in the public workflow."""

import json
import re
import subprocess
from pathlib import Path

from polypod.compat import tomllib

ROOT = Path(__file__).resolve().parents[2]
REGISTRY = "registry+https://github.com/rust-lang/crates.io-index"


def is_allowed(expression: str, allowed: list[str]) -> bool:
    """Whether an SPDX expression can be met by the licences in `allowed`; `/` is the older way to write `OR`."""
    words = re.findall(r"[()]|[^\s()]+(?: WITH [^\s()]+)?", expression.replace("/", " OR "))
    python = {"(": "(", ")": ")", "AND": "and", "OR": "or"}
    # nothing but True, False, and, or and parentheses is left
    return eval(" ".join(python.get(word, str(word in allowed)) for word in words))


def test_licences_and_sources() -> None:
    rules = tomllib.loads((ROOT / "deny.toml").read_text(encoding="utf-8"))
    host = subprocess.run(["rustc", "--print=host-tuple"], capture_output=True, text=True, check=True).stdout.strip()
    command = ["cargo", "metadata", "--locked", "--offline", "--format-version=1", f"--filter-platform={host}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=60)
    packages = json.loads(done.stdout)["packages"]
    assert len(packages) > 100
    allowed = rules["licenses"]["allow"]
    assert [p["id"] for p in packages if not is_allowed(p["license"] or "none", allowed)] == []
    assert {p["source"] for p in packages} == {None, REGISTRY}
    own = [p for p in packages if p["source"] is None]
    assert [
        (p["name"], d["name"]) for p in own for d in p["dependencies"] if d["req"] == "*" and not d.get("path")
    ] == []
