"""Pages that docstrings and help texts name by their paths, such as docs/links.md, as links."""

from __future__ import annotations

import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
_PAGE = re.compile(r"(?<![\w/])docs/([\w/-]+)\.md\b")


def linked(text: str, to_docs: str) -> str:
    """The text with a link for each page that exists.

    to_docs: the way from the page with the text to the folder of pages.
    """

    def link(match: re.Match[str]) -> str:
        name = match[1]
        return f"[{name}]({to_docs}{name}.md)" if (DOCS / f"{name}.md").is_file() else match[0]

    return _PAGE.sub(link, text)
