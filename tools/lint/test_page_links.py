"""Links of pages lead somewhere, and the site has every page, without building it; `make docs` checks the rest."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
MADE = {"screens.md", "index.md", "gallery.md", "contributing.md", "security.md", "changelog.md"}
"""Pages of the site that tools/site/pages.py makes, besides those in reference/."""


def heading(title: str) -> str:
    """How a heading is linked to."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def test_the_navigation_has_every_page_once() -> None:
    """A page without a place in mkdocs.yml cannot be found, and one that is not there cannot be built."""
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    named = re.findall(r"^ +- .*: (\S+\.md)$", settings, re.MULTILINE)
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert sorted(name for name in named if name not in MADE and not name.startswith("reference/")) == sorted(pages)


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"])
def test_links_of_pages_outside_docs_lead_somewhere(name: str) -> None:
    """The file is there, and the heading in it."""
    for target in re.findall(r"\]\(([^):\s]+)\)", (ROOT / name).read_text(encoding="utf-8")):
        path, _, anchor = target.partition("#")
        other = ROOT / (path or name)
        assert other.exists(), target
        if anchor:
            titles = re.findall(r"^#+ (.*)$", other.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {heading(title) for title in titles}, target


@pytest.mark.parametrize("page", PAGES)
def test_links_between_documents_lead_somewhere(page: str) -> None:
    """The page is there, and the heading in it."""
    text = (DOCS / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:\s]*(?:#[^)\s]*)?)\)", text):
        name, _, anchor = target.partition("#")
        other = (DOCS / page).parent / name if name else DOCS / page
        assert other.is_file(), target
        if anchor:
            titles = re.findall(r"^#+ (.*)$", other.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {heading(title) for title in titles}, target


def test_a_heading_is_linked_to_without_its_signs() -> None:
    """So that the tests above test something."""
    assert heading("`[plant]` and a `key`: what it is") == "plant-and-a-key-what-it-is"
