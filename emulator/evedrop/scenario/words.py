"""How values are written: values and choices in messages, and tables as the text of a TOML file that people can read.

In such a file, a list of numbers or words, or a row of a matrix, is on one line.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import tomli_w

from evedrop.model.checks import as_toml, toml_of
from evedrop.system.hints import near

__all__ = ["as_toml", "dotted", "listed", "no_entry", "toml_text"]


def no_entry(name: str, names: Sequence[str], places: Sequence[str] = ()) -> str:
    """The message about an entry that a table does not have; places: the dotted keys that may be meant, if any."""
    hint = near(name, names) or (f"; did you mean {listed(places)}?" if places else "")
    choice = hint or f"; expected one of {', '.join(names)}"
    return f"is not an entry of this table{choice}"


def listed(names: Sequence[str]) -> str:
    """Names as a choice: a, b or c."""
    return ", ".join(names[:-1]) + (" or " if len(names) > 1 else "") + names[-1]


def dotted(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Changes by dotted key, of keywords in which `__` stands for the dot, and of dotted keys, whose names may contain `__`."""
    return {name if "." in name else name.replace("__", "."): value for name, value in keywords.items()}


def options_of(changes: Mapping[str, Any]) -> list[str]:
    """The words of a command that make these changes."""
    return [word for key, value in dotted(changes).items() for word in ("--set", f"{key}={toml_of(value)}")]


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
