"""Writes docs/gallery.md: what each shipped task and train config is for.

The text of a row is the first sentence of its file's own comment.

    python tools/gallery.py [--check]
"""

import sys
from pathlib import Path

from generated import ROOT, main

from polypod.compat import tomllib

PAGE = ROOT / "docs" / "gallery.md"

HEAD = """# Gallery of configs

`configs/` has these tasks and train configs. `polypod list` prints their names, `polypod train
--train-config NAME` trains a config, `--task ALIAS` another task. A task of your own begins with
`extends = "ALIAS"` ([write-a-term.md](write-a-term.md)). `polypod list robots` has the robots.
`python tools/gallery.py` writes this page.
"""


def about(path: Path) -> str:
    """First sentence of the comment at the top of a file."""
    lines = []
    for line in path.read_text().splitlines():
        if not line.startswith("#") or line == "#":
            break
        lines.append(line.removeprefix("#").strip())
    text = " ".join(lines)
    if not text:
        raise SystemExit(f"{path} begins with no comment; say in its first line what it is for")
    end = text.find(". ")
    return (text if end < 0 else text[: end + 1]).rstrip(".").replace("|", "\\|")


def configs(folder: str) -> dict[Path, dict[str, object]]:
    """Files of a folder of `configs/` and what is in them."""
    return {path: tomllib.loads(path.read_text()) for path in sorted((ROOT / "configs" / folder).glob("*.toml"))}


def page() -> str:
    """The whole page."""
    tasks = configs("tasks")
    play = {path.stem.removesuffix("_play") for path in tasks if path.stem.endswith("_play")}
    lines = ["## Tasks", "", "| task | what it is | for watching |", "|---|---|---|"]
    for path in tasks:
        if not path.stem.endswith("_play"):
            watched = f"`{path.stem}_play`" if path.stem in play else "made by the library"
            lines.append(f"| `{path.stem}` | {about(path)} | {watched} |")
    lines += ["", "## Train configs", "", "| config | begins with | what it is |", "|---|---|---|"]
    for path, content in configs("train").items():
        lines.append(f"| `{path.stem}` | {_base(content)} | {about(path)} |")
    return HEAD + "\n" + "\n".join(lines) + "\n"


def _base(content: dict[str, object]) -> str:
    extends = content.get("extends", [])
    names = [extends] if isinstance(extends, str) else extends
    return ", ".join(f"`{name}`" for name in names) if isinstance(names, list) else ""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], __doc__, PAGE, page))
