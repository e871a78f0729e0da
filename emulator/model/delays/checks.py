"""Checks that delay models share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from evedrop.model.delays.delay import LONGEST


def is_number(value: Any) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def length_mistakes(given: Mapping[str, Any], *names: str) -> list[tuple[str, str]]:
    """A mistake for every one of the names that is given and is not a length of time."""
    return [
        (name, f"is {given[name]!r}; expected a number from 0 to {LONGEST:.0f}")
        for name in names
        if name in given and not (is_number(given[name]) and 0.0 <= given[name] <= LONGEST)
    ]
