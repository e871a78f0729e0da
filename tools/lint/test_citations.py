"""Docstrings cite sections that the pages have."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CITED = re.compile(r"docs/(?P<page>[\w/-]+\.md)(?:, (?P<sections>[A-Za-z`μ][^.;:()\"]*(?:\.(?:json|html))?))?")


def words(text: str) -> str:
    """Text to compare: small letters and single spaces."""
    return " ".join(re.findall(r"[a-zμ_]+", text.lower()))


def sections(page: Path) -> list[str]:
    """The headings of a page, and the bold beginnings of its paragraphs."""
    text = page.read_text(encoding="utf-8")
    matches = re.findall(r"^(?:#+ (.+)|\*\*(.+?)\*\*)", text, re.MULTILINE)
    return [words(heading or beginning) for heading, beginning in matches]


def _names(cited: str, titles: list[str]) -> bool:
    """Whether words name a section; `metric` and `metrics` are the same."""
    return any(words(cited).removesuffix("s") in title for title in titles)


def missing(source: str, where: dict[str, list[str]]) -> list[str]:
    """The pages and sections that "Source:" cites and that are not there."""
    absent = []
    for paragraph in re.findall(r"Source: (.+?)(?:\n\s*\n|\"\"\")", source, re.DOTALL):
        for match in CITED.finditer(" ".join(paragraph.split())):
            page, cited = match["page"], match["sections"] or ""
            if page not in where:
                absent.append(page)
                continue
            titles = where[page]
            parts = [] if not cited or _names(cited, titles) else re.split(r",? and |, ", cited)
            absent += [f"{page}, {part}" for part in parts if not _names(part, titles)]
    return absent


PAGES = {path.relative_to(ROOT / "docs").as_posix(): sections(path) for path in (ROOT / "docs").rglob("*.md")}
FILES = [
    path.relative_to(ROOT).as_posix() for folder in ("emulator", "peers") for path in (ROOT / folder).rglob("*.py")
]


def test_every_cited_section_exists() -> None:
    """In all of the program."""
    wrong = {name: missing((ROOT / name).read_text(encoding="utf-8"), PAGES) for name in FILES}
    assert {name: absent for name, absent in wrong.items() if absent} == {}


def test_every_cited_section_of_the_mathematics_exists() -> None:
    """Wherever code cites a page of docs/mathematics/, as its source or in passing."""
    headings = {
        path.stem: re.findall(r"^##+ (.+)$", path.read_text(encoding="utf-8").lower(), re.MULTILINE)
        for path in (ROOT / "docs" / "mathematics").glob("*.md")
    }
    cited = [
        (name, page, section.lower())
        for name in FILES
        for page, section in re.findall(
            r"docs/mathematics/(\w+)\.md, ([A-Za-z][\w -]*\w)", (ROOT / name).read_text(encoding="utf-8")
        )
    ]
    assert len(cited) > 100
    assert [
        (name, page, section)
        for name, page, section in cited
        if not any(section.startswith(title) for title in headings[page])
    ] == []


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ('"""Values.\n\nSource: docs/a.md, what a thing cannot have.\n"""', ["a.md, what a thing cannot have"]),
        ('"""Values.\n\nSource: docs/a.md, things and plants; docs/b.md.\n"""', ["b.md"]),
        ('"""Values. Source: docs/a.md, things, more.\n\nMore.\n"""', ["a.md, more"]),
        ('"""Values. Source: docs/a.md, how it\nworks."""', []),
    ],
)
def test_what_is_not_there_is_found(source: str, expected: list[str]) -> None:
    """So that the test above tests something."""
    assert missing(source, {"a.md": ["things", "plant", "how it works"]}) == expected
