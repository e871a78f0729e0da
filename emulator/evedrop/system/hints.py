"""Hints for mistyped names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def near(word: object, names: Iterable[str], before: str = "") -> str:
    """A hint, `; did you mean NAME?`, if the value found is close to one of the names; otherwise an empty string.

    before: what to write before the name.
    """
    close = difflib.get_close_matches(str(word), list(names), 1)
    return f"; did you mean {before}{close[0]}?" if close else ""
