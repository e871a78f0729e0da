"""Tables of texts as HTML: they scroll by themselves where the page is narrow, also with the keyboard."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree as ET

from evedrop.show.report.markup import Node, element
from evedrop.show.report.text_table import TextTable


def html_table(table: TextTable, caption: str) -> Node:
    """A table with its caption, which names it for screen readers, too. An empty first cell repeats the one above it."""
    heads = [element("th", column.heading, scope="col", class_=_class(column.number)) for column in table.columns]
    body = element("tbody")
    for row in table.rows:
        cells = [
            element("th", cell, scope="row") if i == 0 else element("td", cell, class_=_class(column.number))
            for i, (cell, column) in enumerate(zip(row, table.columns, strict=True))
        ]
        body.append(element("tr", *cells))
    return captioned(element("tr", *heads), body, caption)


def captioned(heads: ET.Element, body: ET.Element, caption: str) -> Node:
    """A table of elements with its caption."""
    shown = element("table", element("thead", heads), body, aria_label=caption)
    region = element("div", shown, class_="scroll", tabindex="0", role="region", aria_label=caption)
    return element("div", element("p", caption, class_="caption"), region)  # a caption would be as wide as its table


def facts_table(facts: Mapping[str, object], caption: str) -> Node:
    """A table of what is known about a run: name → value."""
    table = TextTable.headed(["what"], [], ["value"])
    for name, value in facts.items():
        table.add(name, str(value))
    return html_table(table, caption)


def _class(number: bool) -> str | None:
    return "number" if number else None
