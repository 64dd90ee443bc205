"""Adapts the pages for MkDocs: files of the root are pages, links out of docs/ lead to GitHub."""

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


OF_ROOT = {"index.md": "README.md", "changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}
"""Pages that are files of the repository's root."""


def on_files(files: Files, config: Any) -> Files:
    """Adds the pages of the root and the page of all keys."""
    for page, source in OF_ROOT.items():
        text = (ROOT / source).read_text(encoding="utf-8").replace("](docs/", "](").replace("]: docs/", "]: ")
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, "reference.md", content=reference.page()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Turns links to files outside docs/ into links to the repository."""

    def link(match: re.Match[str]) -> str:
        before, target, anchor = match[1], match[2], match[3] or ""
        inside = (ROOT / "docs" / target).resolve()
        if not target or (inside.is_file() and inside.is_relative_to(ROOT / "docs")):
            return match[0]
        outside = (ROOT / target).resolve() if page.file.src_uri in OF_ROOT else inside
        if not outside.exists():
            return match[0]  # MkDocs warns of it, which is an error
        return f"{before}{config.repo_url}/blob/main/{outside.relative_to(ROOT)}{anchor}"

    return LANGUAGE.sub(r"```\1", LINK.sub(link, markdown))
