"""How a message writes a value and a choice."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import Any

import tomli_w

_SHOWN = 60  # characters of a value that a message repeats


def near(found: Any, names: Iterable[str]) -> str:
    """A hint, `; did you mean NAME?`, where something found is almost one of the names; else nothing."""
    close = difflib.get_close_matches(str(found), list(names), 1)
    return f"; did you mean {close[0]}?" if close else ""


def as_toml(value: Any) -> str:
    """A value as a scenario writes it, cut where it is long."""
    if isinstance(value, dict):
        text = "{ " + ", ".join(f"{key} = {as_toml(inner)}" for key, inner in value.items()) + " }" if value else "{}"
    elif isinstance(value, list):
        text = f"[{', '.join(as_toml(inner) for inner in value)}]"
    else:
        text = tomli_w.dumps({"v": value}).removeprefix("v = ").strip()
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def listed(names: Sequence[str]) -> str:
    """Names as a choice: a, b or c."""
    return ", ".join(names[:-1]) + (" or " if len(names) > 1 else "") + names[-1]
