"""Checks that every page of a report must pass."""

from __future__ import annotations

import base64
import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

from evedrop.show.report.writing import REPORT

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Checked(HTMLParser):
    """A page whose tags are all closed in order; collects its texts, ids, attributes and headings."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: Counter[str] = Counter()
        self.attributes: list[tuple[str, str, str]] = []
        self.texts: list[str] = []
        self.headings: list[str] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Remember an element that is open."""
        self.tags[tag] += 1
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """Check that it closes the element that was opened last."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Keep a text that is not blank."""
        if self.open and self.open[-1] != "style" and data.strip():
            self.texts.append(data)
        if self.open and self.open[-1] in {"h1", "h2"}:
            self.headings.append(data)

    def values(self, name: str) -> list[str]:
        """The values of an attribute, in order."""
        return [value for _, key, value in self.attributes if key == name]


def checked(folder: Path) -> Checked:
    """The page of a folder, with what every page must be: without scripts and requests, and readable without eyes or mouse."""
    text = (folder / REPORT).read_text(encoding="utf-8")
    page = Checked(text)
    assert text.startswith("<!doctype html>")
    assert page.tags["script"] == page.tags["link"] == page.tags["iframe"] == 0
    without_files = re.sub(r";base64,[A-Za-z0-9+/=]*", "", text)  # a picture's bytes may spell anything
    assert not re.search(r"(https?:)?//[a-z]", without_files.replace("http-equiv", ""))
    assert all(source.startswith("data:image/png;base64,") for source in page.values("src"))
    assert "url(" not in text
    assert "default-src 'none'; style-src 'unsafe-inline'; img-src data:" in page.values("content")
    assert "@import" not in text
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    files, links = downloads(page), page.values("href")
    assert {link.removeprefix("#") for link in links if not link.startswith("data:")} <= set(ids)
    assert len(files) == sum(link.startswith("data:") for link in links)
    assert page.tags["img"] == sum(bool(words) for words in page.values("alt"))
    assert page.tags["svg"] == len(
        [attribute for attribute in page.attributes if attribute == ("svg", "aria-hidden", "true")]
    )
    scrolling = page.tags["table"] + page.tags["svg"]
    assert page.values("role").count("region") == page.values("tabindex").count("0") == scrolling
    assert page.headings[0]
    return page


def downloads(page: Checked) -> dict[str, str]:
    """The files that the page lets its reader save: name → text."""
    links = [
        value for _, key, value in page.attributes if key == "href" and value.startswith("data:text/plain;base64,")
    ]
    texts = [base64.b64decode(link.partition(",")[2]).decode() for link in links]
    return dict(zip(page.values("download"), texts, strict=True))
