"""Arguments of calls from Python, refused in words unless they have the type that is needed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any

from evedrop.errors import UsageError

CHANGES = 'a dict by dotted key, such as {"legitimate.link.quality": 0.8}'
"""What changes of a scenario are, for a message."""


def refuse_unless(fits: bool, name: str, value: object, expected: str) -> None:
    """Raise UsageError for an argument that does not fit; expected: what would, in words."""
    if not fits:
        raise UsageError(f"{name}={value!r:.60}: expected {expected}")


def table_argument(name: str, value: Mapping[str, Any] | None, expected: str) -> Mapping[str, Any]:
    """A dict whose keys are texts; empty for None. Raises UsageError for anything else."""
    if value is None:
        return {}
    refuse_unless(isinstance(value, Mapping) and all(isinstance(key, str) for key in value), name, value, expected)
    return value


def path_argument(name: str, value: object, expected: str) -> None:
    """Raise UsageError for an argument that is neither a text nor a path."""
    refuse_unless(isinstance(value, (str, os.PathLike)), name, value, expected)


def number_argument(name: str, value: object, whole: bool = False) -> None:
    """Raise UsageError for an argument that is not a number, or not a whole one if it must be; numpy's numbers are numbers."""
    fits = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
    refuse_unless(fits, name, value, "a whole number" if whole else "a number")
