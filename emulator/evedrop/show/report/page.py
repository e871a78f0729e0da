"""The page of a report: one file without scripts, which asks no other host for anything.

It is readable in a light and a dark theme, on a narrow and a wide screen, on paper, with the keyboard, and by screen readers.
The templates escape every text that they are given.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup

from evedrop.errors import UsageError
from evedrop.score.verdict import SecrecyOutcome
from evedrop.show.report.text_table import TextTable, aligned, far
from evedrop.show.view import palette
from evedrop.show.view.palette import hexadecimal

SourceT = TypeVar("SourceT")
_NO_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # not allowed in HTML, escaped or not


@dataclass(frozen=True)
class Part:
    """A section of the page."""

    title: str
    nodes: Sequence[Markup]

    @property
    def anchor(self) -> str:
        """Its name in links."""
        return self.title.lower().replace(" ", "-")


@dataclass(frozen=True)
class Page:
    """The contents of a report."""

    title: str
    about: str
    """What was run, and how much of it, in a line."""
    outcome: str
    """The outcome in a sentence."""
    good: bool | None
    """Whether the outcome is good; None if there is nothing to judge."""
    parts: Sequence[Part]

    @property
    def mark(self) -> str:
        """The glyph before the outcome; empty if the outcome begins with one, as a verdict does."""
        begins = self.outcome[:2] in {f"{outcome.glyph} " for outcome in SecrecyOutcome}
        return "" if begins else {True: "✓ ", False: "✗ ", None: ""}[self.good]

    @property
    def html(self) -> str:
        """The page as an HTML document."""
        colours = {
            "good": palette.BLUE,
            "bad": palette.RED,
            "ground": palette.GROUND,
            "truth": palette.TRUTH,
        }
        inks = {name: hexadecimal(colour) for name, colour in colours.items()}
        return printable(_template("page.html").render(page=self, version=version("evedrop"), **inks))


def parts_of(sections: Mapping[str, Callable[[SourceT], Iterable[Markup]]], source: SourceT) -> list[Part]:
    """The parts of the page, in order, without those that have nothing to show. If tables cannot be read, a part says why.

    sections: title → the function that makes the contents.
    """
    parts = []
    for title, section in sections.items():
        try:
            nodes = [node for node in section(source) if node.strip()]
        except UsageError as error:
            nodes = [made("paragraph", f"not shown: {error}")]
        if nodes:
            parts.append(Part(title, nodes))
    return parts


def made(macro: str, *contents: object) -> Markup:
    """A piece of the page, made by a macro of parts.html, which escapes all contents that are not Markup."""
    piece: Markup = getattr(_template("parts.html").module, macro)(*contents)
    return piece


def facts_table(facts: Mapping[str, object], caption: str) -> Markup:
    """A table of what is known about a run: name → value."""
    table = TextTable.headed(["what"], [], ["value"])
    for name, value in facts.items():
        table.add(name, str(value))
    return made("table", table, caption)


def printable(text: str) -> str:
    """A text whose characters HTML allows; others become U+FFFD."""
    return _NO_XML.sub("\ufffd", text)


@cache
def _template(name: str) -> Template:
    loader = FileSystemLoader(Path(__file__).with_name("templates"))
    templates = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    templates.filters |= {"aligned": aligned, "far": far}
    return templates.get_template(name)
