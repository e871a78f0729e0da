"""How messages write values and choices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evedrop.model.checks import as_toml
from evedrop.system.hints import near

__all__ = ["as_toml", "dotted", "listed", "no_entry"]


def no_entry(name: str, names: Sequence[str]) -> str:
    """The message about an entry that a table does not have."""
    choice = near(name, names) or f"; expected one of {', '.join(names)}"
    return f"is not an entry of this table{choice}"


def listed(names: Sequence[str]) -> str:
    """Names as a choice: a, b or c."""
    return ", ".join(names[:-1]) + (" or " if len(names) > 1 else "") + names[-1]


def dotted(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Changes by dotted key, of keywords in which `__` stands for the dot."""
    return {name.replace("__", "."): value for name, value in keywords.items()}
