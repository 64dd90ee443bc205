"""Adapts the pages for MkDocs: README.md is the front page, links out of docs/ lead to GitHub."""

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "docs"))
import reference  # noqa: E402

LINK = re.compile(r"(\]\(|^\[[^\]]+\]: )(?!https?:|#|mailto:)([^)\s#]*)(#[^)\s]*)?", re.MULTILINE)
LANGUAGE = re.compile(r"^```(\w+)[ ,].*$", re.MULTILINE)
"""The first line of a fenced block with remarks for the tests."""


def on_files(files: Files, config: Any) -> Files:
    """Adds the front page and the page of all keys."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "index.md", content=text.replace("](docs/", "](").replace("]: docs/", "]: ")))
    files.append(File.generated(config, "reference.md", content=reference.page()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Turns links to files outside docs/ into links to the repository."""

    def link(match: re.Match[str]) -> str:
        before, target, anchor = match[1], match[2], match[3] or ""
        inside = (ROOT / "docs" / target).resolve()
        if not target or (inside.is_file() and inside.is_relative_to(ROOT / "docs")):
            return match[0]
        outside = (ROOT / target).resolve() if page.file.src_uri == "index.md" else inside
        if not outside.exists():
            return match[0]  # MkDocs warns of it, which is an error
        return f"{before}{config.repo_url}/blob/main/{outside.relative_to(ROOT)}{anchor}"

    return LANGUAGE.sub(r"```\1", LINK.sub(link, markdown))
