"""How a message writes a value and a choice."""

from __future__ import annotations

from collections.abc import Sequence

from emulator.model.links.checks import as_toml

__all__ = ["as_toml", "listed"]


def listed(names: Sequence[str]) -> str:
    """Names as a choice: a, b or c."""
    return ", ".join(names[:-1]) + (" or " if len(names) > 1 else "") + names[-1]
