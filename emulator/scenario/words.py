"""How messages write values and choices."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import Any

from evedrop.model.links.checks import as_toml

__all__ = ["as_toml", "listed", "near"]


def no_entry(name: str, known: Sequence[str]) -> str:
    """The message about an entry that a table does not have."""
    close = difflib.get_close_matches(name, known, 1)
    hint = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(known)}"
    return f"is not an entry of this table; {hint}"


def near(found: Any, names: Iterable[str]) -> str:
    """A hint, `; did you mean NAME?`, if the value found is close to one of the names; otherwise an empty string."""
    close = difflib.get_close_matches(str(found), list(names), 1)
    return f"; did you mean {close[0]}?" if close else ""


def listed(names: Sequence[str]) -> str:
    """Names as a choice: a, b or c."""
    return ", ".join(names[:-1]) + (" or " if len(names) > 1 else "") + names[-1]
