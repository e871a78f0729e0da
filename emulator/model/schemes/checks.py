"""Checks that schemes share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evedrop.model.links.checks import probability_mistakes

__all__ = ["choice_mistakes", "count_mistakes", "probability_mistakes"]

MOST_SLOTS = 1_000_000


def count_mistakes(given: Mapping[str, Any], name: str) -> list[tuple[str, str]]:
    """A mistake if the entry is given and is not a number of slots from 1 on."""
    value = given.get(name, 1)
    if type(value) is int and 1 <= value <= MOST_SLOTS:
        return []
    return [(name, f"is {value!r}; expected a whole number from 1 to {MOST_SLOTS}")]


def choice_mistakes(given: Mapping[str, Any], name: str, choices: Sequence[str]) -> list[tuple[str, str]]:
    """A mistake if the entry is given and is not one of the choices."""
    value = given.get(name, choices[0])
    if isinstance(value, str) and value in choices:
        return []
    return [(name, f"is {value!r}; expected {' or '.join(choices)}")]
