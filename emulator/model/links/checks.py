"""Checks that loss models share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def is_probability(value: Any) -> bool:
    """Whether a value is a number from 0 to 1."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0.0 <= value <= 1.0


def probability_mistakes(given: Mapping[str, Any], *names: str) -> list[tuple[str, str]]:
    """A mistake for every one of the names that is given and no probability."""
    return [
        (name, f"is {given[name]!r}; expected a number from 0 to 1")
        for name in names
        if name in given and not is_probability(given[name])
    ]
