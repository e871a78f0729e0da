"""Tables of texts as HTML: they scroll by themselves where the page is narrow, also with the keyboard."""

from __future__ import annotations

from evedrop.report.markup import Node, element
from evedrop.report.text_table import TextTable


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
    shown = element("table", element("thead", element("tr", *heads)), body, aria_label=caption)
    region = element("div", shown, class_="scroll", tabindex="0", role="region", aria_label=caption)
    return element("div", element("p", caption, class_="caption"), region)  # a caption would be as wide as its table


def _class(number: bool) -> str | None:
    return "number" if number else None
