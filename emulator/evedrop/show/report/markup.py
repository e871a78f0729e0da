"""HTML as a tree of elements: every text and attribute is escaped when the tree is written."""

from __future__ import annotations

import re
from collections.abc import Iterable
from xml.etree import ElementTree as ET

Node = ET.Element | str

_NO_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # not allowed in XML, escaped or not


def printable(text: str) -> str:
    """A text whose characters XML and HTML allow; others become U+FFFD."""
    return _NO_XML.sub("\ufffd", text)


def element(tag: str, *children: Node | None, **attributes: str | float | None) -> ET.Element:
    """An element.

    attributes: a `_` at the end of a name is left out, others become `-`; an attribute that is None is left out. Only the
    text of a `style` element is not escaped when it is written.
    """
    given = {
        name.rstrip("_").replace("_", "-"): printable(str(value))
        for name, value in attributes.items()
        if value is not None
    }
    found = ET.Element(tag, given)
    add(found, *children)
    return found


def add(parent: ET.Element, *children: Node | None) -> None:
    """Add children to an element, in order; None is left out."""
    for child in children:
        if isinstance(child, ET.Element):
            parent.append(child)
        elif child is not None and len(parent):
            parent[-1].tail = (parent[-1].tail or "") + printable(child)
        elif child is not None:
            parent.text = (parent.text or "") + printable(child)


def paragraphs(lines: Iterable[str]) -> list[Node]:
    """A list of sentences; empty without any."""
    items = [element("li", line) for line in lines]
    return [element("ul", *items)] if items else []


def fragment(root: ET.Element) -> str:
    """The tree as a part of an HTML document."""
    return ET.tostring(root, encoding="unicode", method="html")


def written(root: ET.Element) -> str:
    """The tree as an HTML document."""
    return f"<!doctype html>\n{fragment(root)}\n"
