"""Tables as the text of a TOML file that people can read: a list of numbers or words, or a row of a matrix, on one line."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping
from typing import Any

import tomli_w

_ITEM = r'(?:"(?:[^"\\\n]|\\.)*"|[-+.\w]+)'
_LIST = re.compile(rf"^(?P<before>.*)\[\n(?P<items>(?: *{_ITEM},\n)+)(?P<indent> *)\]", re.MULTILINE)
"""A list of numbers or texts as tomli-w writes it: one item per line. Texts have no line breaks there, so none looks like it."""
_WIDTH = 120
_STEP = "    "


def toml_text(tables: Mapping[str, Any]) -> str:
    """The text of a file with these tables; reading it gives equal tables."""
    text: str = tomli_w.dumps(tables)
    return _LIST.sub(_joined, text)


def _joined(match: re.Match[str]) -> str:
    items = re.findall(_ITEM, match["items"])
    whole = f"{match['before']}[{', '.join(items)}]"
    if len(whole) < _WIDTH:
        return whole
    if any(item.startswith('"') for item in items):  # a text must not be broken at its spaces
        return match[0]
    indent = match["indent"] + _STEP
    wrapper = textwrap.TextWrapper(
        _WIDTH, initial_indent=indent, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    lines = wrapper.fill(", ".join(items))
    return f"{match['before']}[\n{lines},\n{match['indent']}]"
